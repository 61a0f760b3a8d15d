"""What is shipped: problems, estimators in motion, and the effects that the loop looks for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from msgspec import Struct

from casest.declaration.effect import Effect
from casest.declaration.model import Model
from casest.dynamics import Dynamics
from casest.results.result import Numbers
from casest.solve.strategy import SOLVERS


class ListedProblem(Struct, frozen=True):
    """A model: its symbols, and estimators of its own."""

    about: str
    signals: list[str]
    parameters: list[str]
    constants: dict[str, Numbers]
    estimators: list[str]

    @property
    def solvers(self) -> list[str]:
        """Names that --solver takes."""
        return [*SOLVERS, *self.estimators]


class ListedMotion(Struct, frozen=True):
    """An estimator in motion."""

    about: str
    signals: list[str]
    states: list[str]


class ListedEffect(Struct, frozen=True):
    """An effect of the catalogue."""

    name: str
    about: str
    on: str | None
    formula: str


class ListedMotionEffect(Struct, frozen=True):
    """An effect in motion: what it is on, and what it does."""

    name: str
    on: str
    formula: str


class Listing(Struct, frozen=True):
    """All that is shipped, by name."""

    problems: dict[str, ListedProblem]
    motion: dict[str, ListedMotion]
    effects: list[ListedEffect]
    motion_effects: list[ListedMotionEffect]


def listing(
    models: Sequence[tuple[str, Model]],
    effects: Sequence[Effect],
    moving: Sequence[tuple[str, Dynamics]],
    motion_effects: Sequence[tuple[str, str, str]],
) -> Listing:
    """Models, effects and estimators in motion; of effects in motion name, what on, and formula."""
    return Listing(
        {name: _problem(m) for name, m in models},
        {
            name: ListedMotion(_about(d), [s.name for s in d.signals], [s.name for s in d.states])
            for name, d in moving
        },
        [ListedEffect(e.name, e.doc.partition("\n")[0], e.on, e.formula) for e in effects],
        [ListedMotionEffect(*e) for e in motion_effects],
    )


def _problem(m: Model) -> ListedProblem:
    constants: dict[str, Any] = {c.name: c.array.tolist() for c in m.constants}
    return ListedProblem(
        _about(m),
        [s.name for s in m.signals],
        [p.name for p in m.parameters],
        constants,
        [n for n, _ in m.estimators],
    )


def _about(declared: Model | Dynamics) -> str:
    return (declared.function.__doc__ or "").strip().partition("\n")[0]
