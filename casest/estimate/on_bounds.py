"""Unknowns on a bound: a rate, a share, a variance that is zero.

There the cost need not be flat: it is an optimum if it rises inwards (the multiplier's sign), and
if it is one of the other unknowns. Their standard deviations are those with the bound held; what is
on the bound has an interval with one end.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.estimate.reasons import ON_BOUND, STEP
from casest.leastsquares.problem import Point, Problem


@dataclass(frozen=True)
class OnBound:
    """Unknown number `index` on its `bound`, an `upper` one or a lower.

    `std` is its standard deviation if it were free, `beyond` how many of them the data ask for a
    value outside (0: none). No solution lies on one that is `open`: on the zero that a positive
    diagonal may not reach, and of an implicit model, whose residual falls as the solution
    collapses.
    """

    index: int
    name: str
    bound: float
    upper: bool
    std: float
    beyond: float
    open: bool = False

    def reach(self, quantile: float) -> float:
        """How far inside the bound its one-sided interval ends, the cost taken as a parabola.

        There the cost has risen from the bound by quantile²/2 variances. However far the data ask
        for a value outside, this end is never below that of the usual interval.
        """
        return self.std * float(np.hypot(self.beyond, quantile) - self.beyond)


def on_bounds(
    problem: Problem, point: Point, factor: tuple[Array, Array, float], noise: float
) -> tuple[OnBound, ...]:
    """Unknowns nearer to a bound than ON_BOUND of their standard deviation that do not turn back.

    `factor` is the Jacobian's: R (n, n), t = Qᵀr (n,) and the length of the rest; `noise` the
    standard deviation of a residual, with the bounds held.
    """
    return tuple(_found(problem, point, factor, noise))


def _found(
    problem: Problem, point: Point, factor: tuple[Array, Array, float], noise: float
) -> Iterator[OnBound]:
    R, t, rest = factor
    lower, upper = problem.bounds
    norms = np.linalg.norm(R, axis=0)
    width = ON_BOUND * noise / np.where(norms > 0, norms, np.inf)
    above = point.x >= upper - width
    near = np.flatnonzero((point.x <= lower + width) | above)
    positive = {
        i
        for slot in problem.slots
        for i in range(slot.x.start, slot.x.stop)
        if slot.parameter.shape.positive_diagonal
    }
    freedom = max(problem.residual_count - problem.unknowns, 1)
    for i in near:
        others = np.setdiff1d(np.arange(len(norms)), near).astype(int)
        Q, triangle = np.linalg.qr(R[:, np.append(others, i)])
        length = float(triangle[-1, -1])
        pull = float(Q[:, -1] @ t) * float(np.sign(length))
        # What the bound costs is no noise.
        squares = float(t @ t) + rest**2 - pull**2
        free = float(np.sqrt(max(squares, 0.0) / freedom))
        # The step that the others' optimum leaves to this one goes against the slope.
        scale: float = max(min(noise, free), 1e-3 * noise, 1e-300)
        beyond = (-pull if above[i] else pull) / scale
        if beyond >= -STEP and length:
            bound = float(upper[i] if above[i] else lower[i])
            std, never = noise / abs(length), problem.model.implicit or i in positive
            at = bound, bool(above[i]), std, max(beyond, 0.0), never
            yield OnBound(int(i), problem.names[i], *at)


def free_of(unknowns: int, held: tuple[OnBound, ...]) -> NDArray[np.bool_]:
    """Which unknowns are on no bound."""
    free = np.ones(unknowns, dtype=bool)
    free[[b.index for b in held]] = False
    return free


def of_the_free(
    factor: tuple[Array, Array, float], free: NDArray[np.bool_]
) -> tuple[Array, Array, float]:
    """The triangular factor, Qᵀr and rest with the other unknowns held where they are."""
    R, t, rest = factor
    if free.all():
        return factor
    Q, inner = np.linalg.qr(R[:, free])
    kept = Q.T @ t
    return inner, kept, float(np.hypot(rest, np.linalg.norm(t - Q @ kept)))
