"""What a fit says: values with covariance, certificate, intervals and remarks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.estimate.before import against_prior
from casest.estimate.certificate import Certificate, one_sided
from casest.estimate.correlation import (
    ENOUGH,
    ENOUGH_ALIKE,
    alike_over,
    correlation_time,
    is_series,
)
from casest.estimate.covariance import inverse_normal, sandwich
from casest.estimate.evidence import Evidence, remarks
from casest.estimate.on_bounds import free_of
from casest.estimate.profile_likelihood import Profile, half_width
from casest.estimate.propagation import Inputs
from casest.estimate.remarks import notes, of_stated_noise
from casest.leastsquares.identifiability import Identifiability, Weak
from casest.leastsquares.kinds import freedom
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.stated import UNLIKELY, ChiSquare
from casest.solve.outcome import Outcome

#: Degrees of freedom from which on a standard deviation is as good as known.
UNLIMITED = 1_000_000


@dataclass(frozen=True)
class Noise:
    """Standard deviation of one residual, with where it comes from.

    `sigma` is what the covariance uses; `residual` the root of RSS over degrees of freedom;
    `repeats` the scatter that rest intervals show by themselves (None without any). `stated` is
    what it should be by the noise that was stated (None without), and `chi_square` compares.
    """

    sigma: float
    residual: float
    repeats: float | None
    degrees_of_freedom: int
    stated: float | None = None
    chi_square: ChiSquare | None = None

    @property
    def known(self) -> bool:
        """Was it stated, and is the residual not larger than that by more than chance?"""
        if self.stated is None:
            return False
        return self.chi_square is None or self.chi_square.larger >= UNLIKELY


@dataclass(frozen=True)
class Estimate:
    """Parameters by name with covariance, certificate, residuals.

    `values` and `std` have the parameters' shapes (a leading run axis for per-run ones if there
    are several runs). `std` is `robust`, the sandwich form, where residuals are correlated over
    more than one sample or are many for each unknown, else `plain`. All are taken at the
    least-squares `optimum`, where `point` is not it; `shift` (n, n) is what second-order noise
    adds, a bias of up to `bias` standard deviations, and what uncertain `inputs` do. Of a
    record that is few memories of its noise long, `colour_freedom` (n,) is what its variances have.
    `covariance` (n, n) is of the unknowns `names`. Where the data do not determine a value its std
    is NaN.
    """

    problem: Problem
    point: Point
    values: Mapping[str, Array]
    std: Mapping[str, Array]
    covariance: Array
    noise: Noise
    rmse: float
    certificate: Certificate
    identifiability: Identifiability
    weak: tuple[Weak, ...]
    outcomes: tuple[Outcome, ...]
    seconds: float
    correlated_over: float = 1.0
    bias: float = 0.0
    shift: Array | float = 0.0
    optimum: Point | None = None
    evidence: Evidence | None = None
    inputs: Inputs | None = None
    colour_freedom: Array | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def model(self) -> Model:
        """The model that was fitted."""
        return self.problem.model

    @cached_property
    def plain(self) -> Mapping[str, Array]:
        """Standard deviations if the noise were alike everywhere and independent: σ²(JᵀJ)⁻¹."""
        if self.identifiability.rank == 0:
            return self.std
        R = self.problem.factor(self.optimum or self.point)[0]
        return self._spread(self.noise.sigma**2 * inverse_normal(R, self.free))

    @cached_property
    def robust(self) -> Mapping[str, Array]:
        """Standard deviations from the sandwich form, shaped like `std`."""
        if self.identifiability.rank == 0:
            return self.std
        at = self.optimum or self.point
        R = self.problem.factor(at)[0]
        alike = alike_over(self.problem, at, self.correlated_over)
        return self._spread(sandwich(self.problem, at, R, alike, self.free))

    @cached_property
    def information(self) -> Array:
        """The inverse of the covariance (n, n); JᵀJ/σ² where that has none."""
        with np.errstate(all="ignore"):  # numbers of any size come through here
            if self.identifiability.rank == self.problem.unknowns and self.free.all():
                size = np.sqrt(np.diag(self.covariance))
                scaled = self.covariance / size / size[:, None]
                if np.isfinite(scaled).all():
                    return np.asarray(np.linalg.pinv(scaled, hermitian=True) / size / size[:, None])
            R = self.problem.factor(self.optimum or self.point)[0] / self.noise.sigma
            return np.asarray(R.T @ R)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which unknowns are on no bound, (n,)."""
        return free_of(self.problem.unknowns, self.certificate.at_bound)

    def _spread(self, covariance: Array) -> Mapping[str, Array]:
        """Standard deviations by name; NaN where nothing is determined, and on a bound."""
        covariance = covariance + self.shift
        unknown = np.logical_or(self.identifiability.touched, ~self.free)
        covariance[unknown, :] = covariance[:, unknown] = np.nan
        return self.problem.spread(self.optimum or self.point, covariance)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """What an engineer should know beside the numbers, a sentence each; looked for when asked.

        (The test of a wheel's speed law takes as long as its fit.)
        """
        if not self.outcomes:
            return ()
        problem, at = self.problem, self.optimum or self.point
        dof = problem.residual_count - self.identifiability.rank
        with np.errstate(all="ignore"):
            found = notes(problem, at, dof, self.correlated_over, self.bias)
            stated = of_stated_noise(self.noise.chi_square)
            before = against_prior(problem, at)
            first = [] if before is None or before.agrees else [before.words]
            return (
                *first,
                *stated,
                *remarks(problem, self.evidence),
                *found,
                *_of_tables(problem, at),
            )

    @cached_property
    def interval_reach(self) -> tuple[Mapping[str, Array], Mapping[str, Array]]:
        """How far the 95 % interval of every value reaches below and above it, shaped like `std`.

        Student's t times `std`, or the profile of the cost where that is no parabola (widened as
        `std` is, where residuals are correlated). No interval reaches beyond a bound; that of an
        unknown on one has one end, at 95 %.
        """
        at, ends = self.optimum or self.point, []
        quantile = one_sided(self.problem, self.correlated_over)
        for side, squares in enumerate(self._squared_reach()):
            reach = np.sqrt(np.diag(squares))
            for b in self.certificate.at_bound:
                reach[b.index] = 0.0 if b.upper == bool(side) else b.reach(quantile)
            reach = np.minimum(reach, np.maximum(np.abs(self.problem.bounds[side] - at.x), 0))
            np.fill_diagonal(squares, reach**2)
            ends.append(self.problem.spread(at, squares))
        return ends[0], ends[1]

    def profile(self, j: int, reach: float = 3.0, count: int = 13) -> tuple[Array, Array]:
        """Values (count,) of unknown j (as in `names`), and how far 2·cost/σ² rises there.

        They reach so many plain standard deviations to either side; everything else is fitted again
        at each. Of a linear model that is a parabola, one at one standard deviation.
        """
        around = self.around
        distances = np.linspace(-reach, reach, count) * np.sqrt(around.covariance[j, j])
        with np.errstate(all="ignore"):
            return around.best.x[j] + distances, around.curve(j, distances)

    @cached_property
    def around(self) -> Profile:
        """The cost around the optimum, as any unknown is held at other values."""
        at, sigma = self.optimum or self.point, self.noise.sigma
        covariance = sigma**2 * inverse_normal(self.problem.factor(at)[0], self.free)
        return Profile(self.problem, at, self.problem.cost(at), covariance, sigma)

    def _squared_reach(self) -> tuple[Array, Array]:
        """Squares of the reach below and above, (n, n) each as a covariance, as if unbounded."""
        profile = self.certificate.profile
        half = np.array([half_width(freedom) for freedom in self.effective_freedom])
        if profile is None:
            linear = np.outer(half, half) * self.covariance
            return linear.copy(), linear.copy()
        R = self.problem.factor(self.optimum or self.point)[0]
        plain = self.noise.sigma**2 * np.diag(inverse_normal(R, self.free))
        with np.errstate(invalid="ignore", divide="ignore"):
            wider = np.sqrt(np.diag(self.covariance) / plain)
        if self.correlated_over > 1:
            wider = wider * np.maximum(half / half_width(self.noise.degrees_of_freedom), 1.0)
        return np.diag((wider * profile[:, 0]) ** 2), np.diag((wider * profile[:, 1]) ** 2)

    @property
    def effective_freedom(self) -> tuple[int, ...]:
        """Degrees of freedom of each unknown's standard deviation (Welch & Satterthwaite).

        What comes of references counts as known exactly, but for those that say otherwise.
        """
        most, own = self.noise.degrees_of_freedom, freedom(self.problem, self.optimum or self.point)
        each = np.full(self.problem.unknowns, most) if own is None else np.minimum(own, most)
        each = np.trunc(each / self.correlated_over)
        if self.noise.known and self.correlated_over <= 1:
            each[:] = UNLIMITED
        if self.colour_freedom is not None:
            each = np.minimum(each, self.colour_freedom)
        if self.inputs is not None:
            variance, known = np.diag(self.covariance), np.diag(self.inputs.carried)
            with np.errstate(invalid="ignore", divide="ignore"):
                larger = np.square(variance / np.maximum(variance - known, 1e-12 * variance))
            each = each * np.where(np.isfinite(larger), larger, 1.0)
            with np.errstate(invalid="ignore", divide="ignore"):
                shares = np.nan_to_num(self.inputs.shares / variance[:, None])
                each = 1 / (1 / each + np.sum(shares**2 / self.inputs.freedom, axis=1))
        return tuple(int(min(f, UNLIMITED)) for f in each)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of the covariance."""
        return self.problem.names


def _of_tables(problem: Problem, point: Point) -> Iterator[str]:
    """That neighbouring rows of a table are alike, as if they followed each other in time."""
    tables = [run for run in problem.runs if not is_series(run)]
    over = correlation_time(problem, point, tables=ENOUGH_ALIKE) if tables else 1.0
    if over > 1:
        unknown = any(run.time is None and len(run) >= ENOUGH for run in tables)
        rate = "; if they followed each other, say so with --rate" if unknown else ""
        yield (
            f"residuals of neighbouring rows are alike (over {over:.2g} rows): standard deviations "
            f"and causes allow for that{rate}"
        )
