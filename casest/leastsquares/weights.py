"""Effects on the noise: residuals that count less the further out they lie.

An effect on the noise gives the weight w(r) of a residual r (in standard deviations). Fitting with
these weights, again and again, is M-estimation with ψ(r) = w(r)·r.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.engine import Replay
from casest.leastsquares.kinds import noises, whitened
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import some_residuals

#: Residuals for each unknown from which on Huber's correction is enough: to 2 % of a variance.
FEW = 50


def has_noise_effects(model: Model) -> bool:
    """Does any effect of the model act on the noise?"""
    return any(a.kind == "noise" for a in model.effects)


def robust_scale(residuals: Sequence[Array]) -> float:
    """Standard deviation from the median of absolute residuals, which outliers do not move."""
    everything = np.abs(np.concatenate([r.ravel() for r in residuals]))
    return max(float(np.median(everything)) / 0.6745, 1e-300)


def scale_of_readings(residuals: Sequence[Array]) -> float:
    """The same without those that are exactly zero: there nothing was read."""
    read = [r[r != 0] for r in residuals]
    return robust_scale(read if any(r.size for r in read) else residuals)


def weights(problem: Problem, point: Point) -> tuple[Array, ...]:
    """Weight of every residual at a point, (N, m) per run."""
    residuals = problem.residuals(point)
    scale, curve = scale_of_readings(residuals), _curve(problem.model)
    return tuple(
        curve(np.zeros(0), (r / scale).reshape(-1, 1))[0].reshape(r.shape) for r in residuals
    )


def weighted(problem: Problem, values: Mapping[str, Array]) -> Problem:
    """The problem with the weights of its effects on the noise at these values; else as it is.

    Where residuals are of several kinds, in the deviations of each.
    """
    problem = whitened(problem, problem.point(values)) if noises(problem.model) else problem
    if not has_noise_effects(problem.model):
        return problem
    return problem.with_weights(weights(problem, problem.point(values)))


def _curve(model: Model) -> Replay:
    """w(r) and ψ′(r) of all effects on the noise together."""
    r = ca.SX.sym("r")
    w = ca.SX(1)
    for attached in model.effects:
        if attached.kind == "noise":
            w = w * attached.apply(r, {})
    slope = ca.jacobian(w * r, r)
    f = ca.Function(
        "noise",
        [ca.SX.sym("none", 0), r],
        [ca.densify(w), ca.densify(slope)],
        ["parameters", "sample"],
        ["w", "slope"],
    )
    return Replay(f)


def variance_factor(problem: Problem, point: Point) -> float:
    """σ² that multiplies the unweighted (JᵀJ)⁻¹: Huber's (1973) K²·mean(ψ²)/mean(ψ′)².

    K = 1 + (unknowns/residuals)·var(ψ′)/mean(ψ′)² corrects it where residuals are few. Of fewer
    than FEW for each unknown that is too little, and `_reach` takes the place of K/mean(ψ′).
    """
    residuals = some_residuals(problem, point)
    scale = scale_of_readings(residuals)
    r = np.concatenate([x.ravel() for x in residuals]) / scale
    w, slope = (out.ravel() for out in _curve(problem.model)(np.zeros(0), r.reshape(-1, 1)))
    count, dof = len(r), max(len(r) - problem.unknowns, 1)
    squares = float(scale**2 * np.sum((w * r) ** 2))
    share = problem.unknowns / count
    few = 1 + share * np.var(slope) / np.mean(slope) ** 2
    huber = float(few**2 * squares / dof / np.mean(slope) ** 2)
    if not 0 < share < 1 or share * FEW <= 1 or not np.ptp(slope) > 0:
        return huber
    return max(huber, (_reach(slope, share) / share) ** 2 * squares / count)


def _reach(slope: Array, share: float) -> float:
    """c: a residual foretold without its own sample exceeds the fitted one by c·ψ, on average.

    It solves mean(1/(1 + c·ψ′)) = 1 − unknowns/residuals (El Karoui, Bean, Bickel, Lim & Yu, PNAS
    110, 2013, 14557). Where ψ falls again, at most half of what would undo a residual.
    """
    from scipy.optimize import brentq

    def left(c: float) -> float:
        return float(np.mean(1 / (1 + c * slope))) - (1 - share)

    most = 0.5 / max(-float(np.min(slope)), 1e-3)
    return float(brentq(left, 0.0, most)) if left(most) < 0 else most
