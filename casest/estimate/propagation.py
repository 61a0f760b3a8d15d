"""What the uncertainty of known numbers does to an estimate (JCGM 100, 5.1.2 and 5.2.2).

An optimum moves with the numbers that the model takes as known: where the gradient g(x, c) of the
cost is zero, dx/dc = -(∂g/∂x)⁻¹ ∂g/∂c. Both are parts of one Hessian, that of the problem in which
these numbers are unknowns too. An error of a reference is common to all readings, so nothing of it
averages away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Constant
from casest.leastsquares.problem import Point, Problem


@dataclass(frozen=True)
class Inputs:
    """Known numbers that are not exact, and what the unknowns do when they move.

    `names` (k,) of single numbers, `units`, `values` (k,), their `covariance` (k, k), the
    `sensitivity` (n, k) of the unknowns: ∂x/∂c, and degrees of `freedom` (k,) of each standard
    uncertainty, infinite where it is known. Values of a direction are its coordinates: zero.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    covariance: Array
    sensitivity: Array
    freedom: Array

    @property
    def std(self) -> Array:
        """Standard uncertainty of each number, (k,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def carried(self) -> Array:
        """Covariance of the unknowns that comes of it, (n, n)."""
        return np.asarray(self.sensitivity @ self.covariance @ self.sensitivity.T)

    @property
    def shares(self) -> Array:
        """Part of each unknown's variance that is each number's, (n, k): its rows sum to that of
        `carried`. Of correlated numbers each has half of what they share, which may be negative."""
        return np.asarray(self.sensitivity * (self.sensitivity @ self.covariance))


def uncertain(model: Model) -> tuple[Constant, ...]:
    """The constants of a model that are not exact."""
    return tuple(c for c in model.constants if c.uncertainty is not None)


def propagated(problem: Problem, point: Point, free: NDArray[np.bool_]) -> Inputs | None:
    """How the unknowns follow the uncertain constants; None where all are exact.

    Unknowns that are not `free` stay where they are.
    """
    constants = uncertain(problem.model)
    if not constants:
        return None
    extended, there, own, more = extended_at(problem, point)
    hessian = extended.hessian(there)
    sensitivity = np.zeros((problem.unknowns, len(more)))
    inner = own[free]
    scale = np.sqrt(np.where(np.diag(hessian)[inner] > 0, np.diag(hessian)[inner], 1.0))
    curvature = hessian[np.ix_(inner, inner)] / np.outer(scale, scale)
    slope = hessian[np.ix_(inner, more)] / scale[:, None]
    solved = np.linalg.lstsq(curvature, slope, rcond=1e-12)[0]
    sensitivity[free] = -solved / scale[:, None]
    names = [extended.names[i] for i in more]
    return Inputs(
        tuple(names),
        tuple(extended.units[i] for i in more),
        there.x[more],
        _covariance(constants),
        sensitivity,
        np.concatenate([np.full(len(u), u.freedom) for c in constants if (u := c.uncertainty)]),
    )


def extended_at(
    problem: Problem, point: Point
) -> tuple[Problem, Point, NDArray[np.intp], NDArray[np.intp]]:
    """The problem in which uncertain constants are unknowns, the same point there, and the places
    of the problem's own unknowns and of the constants."""
    constants = uncertain(problem.model)
    extended = _extended(problem, constants)
    names = [c.name for c in constants]
    there = _same_place(problem, point, extended)
    return extended, there, *_places(problem, extended, names)


def _extended(problem: Problem, constants: Sequence[Constant]) -> Problem:
    """The problem in which these constants are unknowns, alike in all runs."""
    model = problem.model
    for c in constants:
        model = model.freed(c.name).scoped(c.name, "all")
    return Problem(model, problem.runs, problem.weights)


def _same_place(problem: Problem, point: Point, extended: Problem) -> Point:
    """The same point, charts and all, with the constants at their values."""
    there = extended.point({c.name: c.array for c in uncertain(problem.model)})
    x, references = there.x.copy(), there.references.copy()
    known = {(s.parameter.name, s.run): s for s in problem.slots}
    for slot in extended.slots:
        if old := known.get((slot.parameter.name, slot.run)):
            x[slot.x], references[slot.ref] = point.x[old.x], point.references[old.ref]
    return Point(x, references)


def _places(
    problem: Problem, extended: Problem, added: Sequence[str]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where the problem's unknowns are in the extended one, and where the added ones are."""
    own = np.zeros(problem.unknowns, dtype=np.intp)
    known = {(s.parameter.name, s.run): s.x for s in problem.slots}
    more = {}
    for slot in extended.slots:
        here = np.arange(slot.x.start, slot.x.stop)
        if slot.parameter.name in added:
            more[slot.parameter.name] = here
        else:
            own[known[slot.parameter.name, slot.run]] = here
    return own, np.concatenate([np.zeros(0, dtype=np.intp), *(more[name] for name in added)])


def _covariance(constants: Sequence[Constant]) -> Array:
    """Covariance (k, k) of all numbers of the constants, in their order."""
    known = [c.uncertainty for c in constants if c.uncertainty is not None]
    blocks = [[a.covariance if a is b else a.shared(b) for b in known] for a in known]
    return np.block(blocks)
