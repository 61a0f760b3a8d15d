"""Where the covariance of the unknowns comes from: noise, signal by signal, priors, references.

With B = (JᵀJ)⁻¹, prior rows included, what a part of the rows has is B(J_aᵀ V_a J_a)B: these parts
sum to the covariance, as independent inputs do (JCGM 100, 5.1.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.declaration.noise import SLOPE, WHITENING, root_of
from casest.declaration.shapes import Array
from casest.estimate.covariance import inverse_normal
from casest.estimate.estimate import Estimate
from casest.leastsquares.problem import prior_rows


@dataclass(frozen=True)
class Source:
    """Something random: `std` of one reading, None where there is no such number; its part of the
    covariance (n, n); degrees of freedom, None where it is known."""

    name: str
    std: float | None
    unit: str
    covariance: Array
    degrees_of_freedom: float | None


def sources(estimate: Estimate, unit: str) -> list[Source]:
    """All that is random in a fit: the noise, or that of each signal; a prior; curvature.

    `unit` is that of the residual. References are `estimate.inputs`.
    """
    inputs = estimate.inputs
    carried = 0.0 if inputs is None else inputs.carried
    bend = np.asarray(estimate.shift - carried) if np.ndim(estimate.shift) else np.zeros(())
    random = estimate.covariance - estimate.shift
    noise, prior = estimate.noise, estimate.model.prior
    freedom: float | None = noise.degrees_of_freedom / estimate.correlated_over
    if noise.known and (estimate.correlated_over <= 1 or prior is not None):
        freedom = None
    found = []
    if prior is not None:
        problem, at = estimate.problem, estimate.optimum or estimate.point
        bread = inverse_normal(problem.factor(at)[0], estimate.free)
        J = prior_rows(problem, at)[:, :-1]
        before = noise.sigma**2 * bread @ (J.T @ J) @ bread
        found.append(Source(f"prior {prior.source}", None, "", before, None))
        random = random - before
    found += _of_signals(estimate, random, unit, freedom)
    if bend.shape and np.nan_to_num(bend).any():
        found.append(Source("curvature (second order)", None, "", bend, None))
    return found


def _of_signals(
    estimate: Estimate, random: Array, unit: str, freedom: float | None
) -> list[Source]:
    """The noise of each signal, where it was stated of several; else of a residual."""
    stated, sigma = estimate.model.noise, float(estimate.noise.sigma)
    if stated is None or not estimate.noise.known or estimate.correlated_over > 1:
        return [Source("noise of a residual", sigma, unit, random, freedom)]
    problem, at = estimate.problem, estimate.optimum or estimate.point
    bread = inverse_normal(problem.factor(at)[0], estimate.free)
    middles = {group: np.zeros_like(random) for group in stated.together}
    usual = dict.fromkeys(stated.together, 0.0)
    for block in problem.blocks(at):
        run, m = problem.runs[block.run], stated.residuals
        held = {k: run.signals[k][block.span] for k in run.signals if k.startswith("noise.")}
        W = held[WHITENING].reshape(-1, m, m)
        G = W @ held[SLOPE].reshape(len(W), m, -1)
        first = 0
        for group in stated.together:
            size, root = sum(run.signals[n].shape[1] for n in group), held[root_of(group)]
            part = _spread(G[:, :, first : first + size], root)
            first += size
            scores = np.einsum("nmk,nmr->nkr", block.jacobian, part)
            middle = np.einsum("nkr,nlr->kl", scores, scores)
            middles[group][np.ix_(block.x, block.x)] += middle
            usual[group] += float(np.sum(root**2)) / size
    count = sum(map(len, problem.runs))
    return [
        Source(
            f"noise of {' and '.join(group)}",
            float(np.sqrt(usual[group] / count)) if len(group) == 1 else None,
            f"[{group[0]}]" if len(group) == 1 else "",
            np.where(np.isnan(random), np.nan, bread @ middles[group] @ bread),
            freedom,
        )
        for group in stated.together
    ]


def _spread(slope: Array, root: Array) -> Array:
    """G·R (N, m, k) of one signal."""
    size = slope.shape[2]
    if root.shape[1] == size:
        return np.asarray(slope * root[:, None, :])
    return np.asarray(slope @ root.reshape(-1, size, size))
