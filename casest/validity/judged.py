"""The test: does a new record fit the old parameters, within their covariance and its noise?

With the parameters that belong to the new record alone fitted to it, what is left of its residual
in the columns of the shared ones is noise plus what the old errors make of it, both normal with a
known covariance: T = yᵀV⁻¹y is F distributed. No refit of the shared parameters is needed, so that
fewer samples than unknowns will do: T asks only what the record can see.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.effects.placing import prepared
from casest.errors import UsageError
from casest.estimate.covariance import inverse_normal
from casest.estimate.held_out import per_run, with_own
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.stated import UNLIKELY, at_true_values
from casest.leastsquares.sums import some_residuals
from casest.leastsquares.weights import weighted
from casest.validity.colour import spectrum_of
from casest.validity.old import STATED, Old
from casest.validity.whitened import Factor, Whitened

#: Degrees of freedom from which on a record's noise is known from itself; with fewer it is that of
#: the old record, as long as nothing speaks against it.
ENOUGH = 100
#: Standard deviations of noise over the old ones below which it counts as the same.
LOUDER = 1.1
#: Correlation of neighbours beyond the old colour from which on that is another one.
ALIKE = 0.1
#: Singular values below this share of the largest see nothing.
SEEN = 1e-8


@dataclass(frozen=True)
class Noise:
    """The new record's noise: standard deviation, its ratio to the `expected` one (the old one, or
    the one that was stated of this record), and the chance of a ratio as large while nothing
    changed; `freedom` of what judges the parameters. `known_by` is what the old covariance grows
    by, where both records together say how large the noise is.
    """

    sigma: float
    ratio: float
    p_value: float
    coloured: bool
    freedom: float
    known_by: float | None = None
    expected: float = float("nan")


@dataclass(frozen=True)
class Test:
    """T over its `rank`, F distributed with (rank, freedom): chance of one as large."""

    statistic: float
    rank: int
    freedom: float
    p_value: float


@dataclass(frozen=True)
class Subject:
    """One date's record under the old parameters, ready to be asked.

    `free` (n, k): directions that are the new record's own; `covariance` (n, n) of the rest.
    """

    old: Old
    rows: Whitened
    point: Point
    free: Array
    covariance: Array
    noise: Noise

    @property
    def problem(self) -> Problem:
        """The new record's least-squares problem."""
        return self.rows.problem

    @cached_property
    def power_known(self) -> float:
        """Variance of the logarithm of the noise's power where the shared unknowns are told."""
        return float(np.mean(self.rows.power_known(self.point)[self.shared]))

    @property
    def shared(self) -> Array:
        """Which unknowns the old calibration holds, (n,)."""
        return np.asarray(~self.free.any(axis=1))


def subject_of(old: Old, runs: tuple[Run, ...]) -> Subject:
    """A date's record with its own parameters fitted, and its noise."""
    runs = prepared(old.model, runs)
    values = dict(old.values)
    own = per_run(old.model)
    if own:
        kept = {name: value for name, value in values.items() if name not in own}
        values = with_own(old.model, kept, runs)
    problem = weighted(Problem(old.model, runs), values)
    if old.model.noise is not None:
        problem = at_true_values(problem, problem.point(values))
    covariance, loose = old.shared(problem)
    if loose.all():
        raise UsageError(
            f"{runs[0].file}: every parameter of {old.model.name} belongs to its run alone: there "
            "is nothing that an old calibration could hold"
        )
    free = np.eye(problem.unknowns)[:, loose]
    rows = Whitened(problem, old.colour, np.ones(len(problem.model.axes)))
    everything, _ = rows.fitted(problem.point(values), np.eye(problem.unknowns))
    if old.model.noise is None:
        rows = rows.with_own_axes(everything)
    else:  # what the noise makes of each residual is known, and the axes' with it
        rows = replace(rows, problem=at_true_values(problem, everything))
    everything, there = rows.fitted(everything, np.eye(problem.unknowns))
    noise = _noise(old, rows, everything, there)
    if noise.coloured:
        bread = inverse_normal(there.R)
        own_colour = spectrum_of(problem, everything, bread)
        rows = replace(rows, colour=own_colour) if own_colour else rows
    point, _ = rows.fitted(problem.point(values), free)
    return Subject(old, rows, point, free, (noise.known_by or 1.0) * covariance, noise)


def _noise(old: Old, rows: Whitened, point: Point, there: Factor) -> Noise:
    """How large the noise is, and whether that and its colour are the old ones."""
    from scipy.special import fdtrc

    problem = rows.problem
    left = problem.residual_count - _rank(there.R)
    correlation, count = rows.neighbours(point)
    coloured = count >= ENOUGH and correlation > max(ALIKE, 4 / np.sqrt(count))
    if problem.noise_scale is not None:
        return _by_stated(problem.noise_scale, there.rest, left, coloured)
    if left <= 0:
        if np.isnan(old.sigma):
            raise UsageError(
                f"{problem.runs[0].file}: {problem.residual_count} residuals for "
                f"{problem.unknowns} unknowns say nothing of the noise, and nor does the old "
                "calibration: more readings are needed"
            )
        return Noise(old.sigma, 1.0, 1.0, coloured, old.freedom, expected=old.sigma)
    sigma = there.rest / np.sqrt(left)
    if not old.sigma > 0:
        return Noise(sigma, np.nan, 1.0, coloured, float(left))
    ratio = sigma / old.sigma
    tails = _tails(problem, point)
    known = max(old.freedom * tails, 1.0)
    p = float(fdtrc(max(left * tails, 1.0), known, (ratio / LOUDER) ** 2))
    if left >= ENOUGH or p < 1e-3 or ratio < 1e-3:
        return Noise(sigma, ratio, p, coloured, float(left), expected=old.sigma)
    together = left + old.freedom
    pooled = np.sqrt((left * sigma**2 + old.freedom * old.sigma**2) / together)
    known_by = float(pooled / old.sigma) ** 2
    return Noise(float(pooled), ratio, p, coloured, float(together), known_by, old.sigma)


def _by_stated(scale: float, rest: float, left: int, coloured: bool) -> Noise:
    """As it was stated, unless a fit of everything leaves more than that by more than chance."""
    from scipy.special import chdtrc

    if left <= 0:
        return Noise(scale, 1.0, 1.0, coloured, STATED, expected=scale)
    ratio = rest / np.sqrt(left) / scale
    p = float(chdtrc(left, left * (ratio / LOUDER) ** 2))
    if p < UNLIKELY:
        return Noise(ratio * scale, ratio, p, coloured, float(left), expected=scale)
    return Noise(scale, ratio, p, coloured, STATED, expected=scale)


def _tails(problem: Problem, point: Point) -> float:
    """Share of the degrees of freedom that a variance of noise with such tails is worth: 2/(κ − 1)
    with κ the fourth moment over the squared second, 3 of normal noise."""
    r = np.concatenate([x.ravel() for x in some_residuals(problem, point)])
    second = float(np.mean(r**2))
    if len(r) < ENOUGH or not second > 0:
        return 1.0
    return min(1.0, 2 / max(float(np.mean(r**4)) / second**2 - 1, 1e-3))


def _rank(R: Array) -> int:
    singular = np.linalg.svd(R / _norms(R), compute_uv=False)
    return int(np.sum(singular > SEEN * singular.max(initial=0.0)))


def _norms(R: Array) -> Array:
    size = np.linalg.norm(R, axis=0)
    return np.where(size > 0, size, 1.0)


def tested(subject: Subject, factor: Factor, free: Array) -> Test:
    """What is left in the columns beside those along `free` (n, k), where the record was fitted."""
    from scipy.special import fdtrc

    R = factor.R
    rest = beside(R, free)
    U, singular, _ = np.linalg.svd(rest / _norms(R), full_matrices=False)
    U = U[:, singular > SEEN * max(singular.max(initial=0.0), 1.0)]
    if not U.shape[1]:
        return Test(0.0, 0, subject.noise.freedom, 1.0)
    y, A = U.T @ factor.b, U.T @ R
    sigma = max(subject.noise.sigma, 1e-300)
    V = sigma**2 * np.eye(len(y)) + A @ subject.covariance @ A.T
    size = np.sqrt(np.diag(V))
    statistic = float((y / size) @ np.linalg.solve(V / np.outer(size, size), y / size))
    k = len(y)
    freedom = _freedom(subject, 1 - sigma**2 * float(np.trace(np.linalg.inv(V))) / k)
    return Test(statistic, k, freedom, float(fdtrc(k, freedom, statistic / k)))


def _freedom(subject: Subject, share: float) -> float:
    """Degrees of freedom of V, of which so large a share is of the old errors (Satterthwaite).

    What is told slowly has the noise of slow frequencies, of which a record shows few, in both
    parts alike: a variance of ν degrees of freedom has a logarithm of variance 2/ν.
    """
    noise, old = subject.noise, max(subject.old.freedom, 1.0)
    if noise.known_by is not None:
        return max(noise.freedom, 1.0)
    share = min(max(share, 0.0), 1.0)
    each = share**2 / old + (1 - share) ** 2 / max(noise.freedom, 1.0)
    return 1 / (each + 0.5 * subject.power_known)


def beside(R: Array, free: Array) -> Array:
    """The columns of R without what the `free` directions (n, k) explain of them."""
    Q = _span(R @ free)
    return R - Q @ (Q.T @ R)


def _span(columns: Array) -> Array:
    """Orthonormal columns that span these."""
    if not columns.shape[1]:
        return np.zeros((len(columns), 0))
    U, singular, _ = np.linalg.svd(columns / _norms(columns), full_matrices=False)
    return np.asarray(U[:, singular > SEEN * singular.max(initial=0.0)])


def judged(subject: Subject) -> Test:
    """The test of the old parameters themselves."""
    return tested(subject, subject.rows.factor(subject.point), subject.free)


def repaired_variance(subject: Subject, factor: Factor, free: Array) -> Array:
    """Variance (n,) of the unknowns after a fit along `free`: its noise, and what the old errors of
    the others make of it."""
    columns = factor.R @ free
    norms = _norms(columns)
    inverse = free @ (np.linalg.pinv(columns / norms, rcond=SEEN) / norms[:, None])
    others = np.eye(len(inverse)) - inverse @ factor.R
    noise = subject.noise.sigma**2 * np.sum(inverse**2, axis=1)
    return np.asarray(noise + np.einsum("ij,jk,ik->i", others, subject.covariance, others))
