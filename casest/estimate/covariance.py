"""Covariance of an estimate: plain, or robust against unequal and correlated noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.estimate.correlation import batches, is_series
from casest.estimate.remembering import remembering
from casest.estimate.spectrum import Part, Stretch, by_frequency, noise_spectrum
from casest.estimate.spells import SPELLS, at_most, by_spells, contradicted
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import squares_of_batches, squares_of_gradients
from casest.leastsquares.weights import has_noise_effects, variance_factor

#: Batches per unknown from which on those say enough of correlated noise by themselves.
MANY_BATCHES = 20
#: Residuals for each unknown from which on the robust form is as sharp as the plain one, and right
#: where the noise differs from place to place. Of fewer the plain one makes more.
MANY_RESIDUALS = 10


@dataclass(frozen=True)
class Spread:
    """A covariance (n, n), and degrees of freedom (n,) of its variances where these are fewer than
    those of the fit, because little is known of the noise's colour."""

    covariance: Array
    freedom: Array | None = None


def covariance_of(
    problem: Problem,
    point: Point,
    R: Array,
    sigma: float,
    correlated_over: float,
    free: NDArray[np.bool_] | None = None,
) -> Spread:
    """The covariance that is printed: robust, but for few residuals in all or of an unknown.

    Unknowns that are not `free` are held where they are, and have none.
    """
    if has_noise_effects(problem.model):
        return _of_outliers(problem, point, R, correlated_over, free)
    many = problem.residual_count >= MANY_RESIDUALS * problem.unknowns
    if correlated_over > 1 or many:
        robust, told_by = _sandwich(problem, point, R, correlated_over, free)
        if told_by is None:
            return robust
        plain = sigma**2 * np.diag(inverse_normal(R, free))
        few = told_by < MANY_RESIDUALS
        return replace(robust, covariance=as_plain(robust.covariance, plain, few))
    return Spread(sigma**2 * inverse_normal(R, free))


def _of_outliers(
    problem: Problem,
    point: Point,
    R: Array,
    correlated_over: float,
    free: NDArray[np.bool_] | None,
) -> Spread:
    """That of residuals that count less the further out they lie: Huber's, and as many times that
    as their correlation makes of the covariance of weighted ones."""
    plain = problem.with_weights(None).factor(point)[0]
    alone = np.asarray(variance_factor(problem, point) * inverse_normal(plain, free))
    if correlated_over <= 1:
        return Spread(alone)
    robust, _ = _sandwich(problem, point, R, correlated_over, free)
    own, alike = np.diag(alone), np.diag(_plainly(problem, point, inverse_normal(R, free)))
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.where(alike > 0, np.sqrt(own / alike), 1.0)
    return replace(robust, covariance=robust.covariance * size[:, None] * size[None])


def _plainly(problem: Problem, point: Point, bread: Array) -> Array:
    """The covariance of independent noise that is alike everywhere."""
    left = max(problem.residual_count - problem.unknowns, 1)
    return np.asarray(2 * problem.cost(point) / left * bread)


def as_plain(robust: Array, plain: Array, few: NDArray[np.bool_]) -> Array:
    """The robust covariance (n, n, …) with the plain variances (n, …) of unknowns that a `few`
    (n, …) residuals tell, as where a trajectory begins: those say nothing of their own noise."""
    own = np.einsum("ii...->i...", robust)
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.where(few & (own > 0), np.sqrt(plain / own), 1.0)
    return np.asarray(robust * size[:, None] * size[None])


def as_stated(
    problem: Problem,
    point: Point,
    R: Array,
    sigma: float,
    correlated_over: float,
    free: NDArray[np.bool_] | None = None,
) -> Spread:
    """The covariance of independent noise that was stated of every reading."""
    return Spread(sigma**2 * inverse_normal(R, free))


def no_less(robust: Spread, other: Spread) -> Spread:
    """The robust covariance, no variance below another's, as that of the noise that was stated:
    where residuals look correlated by chance, they know less of it than who stated it."""
    own, less = np.diag(other.covariance), np.diag(robust.covariance)
    return replace(robust, covariance=as_plain(robust.covariance, own, less < own))


def inverse_normal(R: Array, free: NDArray[np.bool_] | None = None) -> Array:
    """(JᵀJ)⁻¹ from the triangular factor, with unit columns inside; pseudo-inverse if singular.

    Of the `free` unknowns alone where some are held: their rows and columns are zero.
    """
    if free is not None and not free.all():
        R = np.where(free, R, 0.0)
    norms = np.linalg.norm(R, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    _, singular, Vt = np.linalg.svd(R / scale)
    keep = singular > 1e-10 * singular.max(initial=0.0)
    half = Vt[keep].T / singular[keep]
    return np.asarray((half @ half.T) / np.outer(scale, scale))


def sandwich(
    problem: Problem,
    point: Point,
    R: Array,
    correlated_over: float,
    free: NDArray[np.bool_] | None = None,
) -> Array:
    """Covariance (n, n) that holds when noise differs from place to place, or is correlated.

    HC3 (MacKinnon & White 1985). Of correlated residuals over batches of samples at least ten
    correlation times long (Liang & Zeger 1986); where there are too few of those for n² numbers,
    JᵀSJ by frequencies, S the spectrum of noise that is `remembering`, or a smooth one:
    the larger variance of the two.
    """
    return _sandwich(problem, point, R, correlated_over, free)[0].covariance


def _sandwich(
    problem: Problem,
    point: Point,
    R: Array,
    correlated_over: float,
    free: NDArray[np.bool_] | None,
) -> tuple[Spread, Array | None]:
    """The same, and of independent residuals how many say what each unknown is.

    It takes a look at every residual, and who prints it asks again: the last one is kept.
    """
    asked = (correlated_over, None if free is None else free.tobytes())
    if problem.judged and problem.judged[0] is point and problem.judged[1] == asked:
        robust, told_by = problem.judged[2]
        return robust, told_by
    bread = inverse_normal(R, free)
    several = by_spells(problem, point, bread)
    robust, told_by = _baked(problem, point, bread, correlated_over, several)
    robust = _beside_spells(robust, several)
    problem.judged[:] = [point, asked, (robust, told_by)]
    return robust, told_by


def _beside_spells(robust: Spread, several: Sequence[tuple[Array, Array]]) -> Spread:
    """With the variances by spells of what these contradict."""
    if not several:
        return robust
    own = np.diag(robust.covariance)
    more, variance, freedom = contradicted(own, several)
    if not more.any():
        return robust
    known = np.full(len(own), np.inf) if robust.freedom is None else robust.freedom
    return Spread(as_plain(robust.covariance, variance, more), np.minimum(known, freedom))


def _baked(
    problem: Problem,
    point: Point,
    bread: Array,
    correlated_over: float,
    several: Sequence[tuple[Array, Array]],
) -> tuple[Spread, Array | None]:
    if correlated_over <= 1:
        middle, told_by = squares_of_gradients(problem, point, bread)
        return Spread(bread @ middle @ bread), told_by
    least, enough = 10 * correlated_over, MANY_BATCHES * problem.unknowns
    longest = min(len(run) for run in problem.runs) * len(problem.runs) / (2 * enough)
    firsts = [batches(run, int(np.ceil(max(least, longest)))) for run in problem.runs]
    groups = sum(len(first) for first in firsts)
    if groups >= enough and all(is_series(run) for run in problem.runs):
        middle = groups / (groups - 1) * squares_of_batches(problem, point, firsts)
        return Spread(bread @ middle @ bread), None
    parts = [part for block in stretches(problem, point) for part in by_frequency(block, bread)]
    # Each of the two has colours that it does not know: pink noise, and a knee with little below.
    smooth = np.asarray(bread @ _by_frequencies(problem, parts) @ bread)
    found = no_less(Spread(*remembering(parts, bread)), Spread(smooth))
    own = np.diag(found.covariance)
    rows = sum(map(len, problem.runs)) // SPELLS[0]
    less = at_most(own, several, rows, correlated_over)
    return replace(found, covariance=as_plain(found.covariance, less, less < own)), None


def _by_frequencies(problem: Problem, parts: Sequence[Part]) -> Array:
    """JᵀSJ (n, n): S the covariance of noise with a smooth spectrum, of each axis its own."""
    axes = range(len(problem.model.axes))
    spectra = [noise_spectrum([part.powers for part in parts if part.axis == k]) for k in axes]
    middle = np.zeros((problem.unknowns, problem.unknowns))
    for part in parts:
        power = spectra[part.axis](part.powers.frequency)
        middle[np.ix_(part.x, part.x)] += (part.jacobian.T * power) @ part.jacobian
    return middle


def stretches(problem: Problem, point: Point) -> Iterator[Stretch]:
    """Uninterrupted samples of each run, weighted."""
    for block in problem.blocks(point):
        root = 1.0 if block.weights is None else np.sqrt(block.weights)
        residual, jacobian = block.residual * root, (block.jacobian.T * np.transpose(root)).T
        run = problem.runs[block.run]
        where = np.zeros(len(residual)) if run.spread else run.block[block.span]
        for own in np.split(np.arange(len(where)), np.flatnonzero(np.diff(where)) + 1):
            yield Stretch(block.x, residual[own], jacobian[own])
