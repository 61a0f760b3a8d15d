"""Constraints of a model: held as residuals with multipliers, until they are kept to rounding.

Least is ½Σr² subject to c = 0 or c ≥ 0. Each round it is ½Σr² + ½ρ(λ/ρ − c)², of a limit only as
far as λ/ρ − c is positive, after which λ becomes ρ(λ/ρ − c) (method of multipliers: Hestenes 1969;
Powell 1969; Rockafellar 1973). So a constrained fit is a series of plain ones, with all that judges
these; where it ends the slope of Σr² is that of λᵀc (Karush, Kuhn & Tucker).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.declaration.model import Model
from casest.declaration.physics import Constraint
from casest.declaration.shapes import Array
from casest.declaration.tracing import sample_symbol
from casest.engine import Replay

#: How much harder than the data constraints are held at first, and at last.
FIRST, HARDEST = 100.0, 1e4


@dataclass(frozen=True)
class Force:
    """How constraints are held, run by run and row by row: `root` √ρ and `shift` λ/ρ, (M,) each,
    and which are `held` as equations; a limit that is not acts where it is passed alone."""

    root: tuple[Array, ...]
    shift: tuple[Array, ...]
    held: tuple[NDArray[np.bool_], ...]

    def rows(self, r: int, c: Array, slopes: Array) -> Array:
        """[J r] (M, k + 1) of values (M,) and slopes (M, k) of run r's constraints."""
        off = self.shift[r] - c
        acting = self.held[r] | (off > 0)
        both = np.column_stack([-slopes, off])
        return np.where(acting, self.root[r], 0.0)[:, None] * both

    @property
    def softer(self) -> Force:
        """The same, held as hard as the data alone would: what these tell apart is not hidden."""
        return replace(self, root=tuple(root / HARDEST for root in self.root))

    @property
    def spared(self) -> float:
        """What the rows cost where all is kept, ½Σρ(λ/ρ)², which is none of the data's."""
        parts = zip(self.root, self.shift, strict=True)
        return 0.5 * float(sum(np.sum((root * shift) ** 2) for root, shift in parts))

    def multipliers(self, r: int, c: Array) -> Array:
        """λ (M,) after a round that ended at c."""
        off = self.shift[r] - c
        return self.root[r] ** 2 * np.where(self.held[r], off, np.maximum(off, 0.0))


@dataclass(frozen=True)
class Constraints:
    """Those of a model as functions: of parameters `once`, of every sample `each`; None of none.

    `limits`: which of either are limits; `names`: their expressions.
    """

    once: Replay | None
    each: Replay | None
    limits: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    names: tuple[tuple[str, ...], tuple[str, ...]]

    def at(
        self, parameters: Array, samples: Array, given: Array, slopes: Array
    ) -> tuple[Array, Array]:
        """Values (M,) and slopes (M, n), of what stages give (N, k) with slopes (N, k, n)."""
        whole = np.hstack([samples, given])
        found = []
        for program, count in ((self.once, 1), (self.each, len(whole))):
            if program is not None:
                value, direct, through = program(parameters, whole[:count])
                moved = direct + through @ slopes[:count] if given.size else direct
                found.append((value.ravel(), moved.reshape(-1, moved.shape[2])))
        return np.concatenate([v for v, _ in found]), np.vstack([s for _, s in found])

    def named(self, row: int) -> tuple[str, int | None]:
        """The expression of a row, and its sample where every one has its own."""
        once, each = self.names
        if row < len(once):
            return once[row], None
        return each[(row - len(once)) % len(each)], (row - len(once)) // len(each)

    def limit(self, samples: int) -> NDArray[np.bool_]:
        """Which rows of a run of so many samples are limits, (M,)."""
        once, each = self.limits
        return np.concatenate([once, np.tile(each, samples)])


@lru_cache(maxsize=32)
def constraints_of(model: Model) -> Constraints | None:
    """What a model keeps to; None of one that keeps to nothing."""
    traced = model.staged if model.sequential else model.traced
    every: tuple[Constraint, ...] = traced.residual.constraints
    if not every:
        return None
    given = ca.vertcat(ca.SX(0, 1), *(stage.given for stage in traced.stages))
    sample = ca.vertcat(sample_symbol(model, traced), given)
    once = [c for c in every if not ca.depends_on(ca.vec(c.expression), sample)]
    each = [c for c in every if ca.depends_on(ca.vec(c.expression), sample)]

    def program(some: list[Constraint]) -> Any:
        if not some:
            return None
        value = ca.densify(ca.vertcat(*(ca.vec(c.expression) for c in some)))
        parameters = ca.vertcat(traced.coordinates, traced.references)
        outputs = [value, ca.jacobian(value, traced.coordinates), ca.jacobian(value, given)]
        names = ["parameters", "sample"], ["value", "direct", "through"]
        dense = [ca.densify(e) for e in outputs]
        return Replay(ca.Function("constraints", [parameters, sample], dense, *names))

    def limits(some: list[Constraint]) -> NDArray[np.bool_]:
        return np.repeat([c.limit for c in some], [c.expression.numel() for c in some]).astype(bool)

    def names(some: list[Constraint]) -> tuple[str, ...]:
        return tuple(str(part) for c in some for part in ca.vertsplit(ca.vec(c.expression)))

    return Constraints(
        program(once), program(each), (limits(once), limits(each)), (names(once), names(each))
    )
