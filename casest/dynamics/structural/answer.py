"""What any record could show of a model: structural observability and identifiability."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from casest.dynamics.declare import Dynamics
from casest.dynamics.structural import floating
from casest.dynamics.structural.combinations import combinations, groups
from casest.dynamics.structural.exact import TOGETHER, Exact, Question
from casest.dynamics.structural.experiments import several
from casest.dynamics.structural.field import PRIME, Residues
from casest.dynamics.structural.laws import laws, sparse
from casest.dynamics.structural.program import Inexact
from casest.dynamics.structural.words import listed, words
from casest.errors import UsageError


@dataclass(frozen=True)
class Structure:
    """Structural rank among n states and parameters.

    `undetermined` are those that no record can show, after them inputs that were not measured and
    cannot be found either; `unobservable` says in words how they may change without a trace,
    `combinations` which functions of them are determined all the same, locally (`more` of them have
    no short formula). `order` is that of the highest derivative of the readings used; `varying`
    whether inputs were free functions of time, `inputs` their names. `rounded` says why the rank is
    one of floating-point numbers (empty: it is exact); `gap` is then the smallest singular value
    that counts over the largest that does not, and infinite where it is exact.
    """

    model: Dynamics
    rank: int
    order: int
    gap: float
    undetermined: tuple[str, ...]
    unobservable: tuple[str, ...]
    varying: bool
    inputs: tuple[str, ...]
    combinations: tuple[str, ...] = ()
    more: int = 0
    rounded: str = ""
    _question: Question | None = field(default=None, repr=False)

    @property
    def unknowns(self) -> int:
        """Number n of states and parameters."""
        return self.model.size

    @property
    def observable(self) -> bool:
        """Can suitable data determine every state and parameter?"""
        return self.rank == self.unknowns

    def determines(self, function: Callable[..., Any]) -> bool:
        """Can suitable data determine, locally, a function of states and parameters?

        `function` takes some of them by name: `found.determines(lambda k1, k2: k1 + k2)`. Raises
        UsageError where a name is none of the model's, or the model is not exact.
        """
        if self._question is None:
            raise UsageError(f"{self.model.name}: not known exactly: {self.rounded}")
        value = _applied(self.model, function)
        try:
            exact = Exact(self._question, seed=0, extra=value)
        except Inexact as why:
            raise UsageError(f"{self.model.name}: the function is not exact: {why}") from None
        gradients, null = exact.gradients(slice(0, 1))[0], exact.hidden(slice(0, 1))[0]
        return not any(_changes(row, null) for row in gradients)


def _changes(row: Residues, null: Residues) -> bool:
    """Is ∇φ·N anything but zero?"""
    return bool(((row[:, None] * null % PRIME).sum(axis=0) % PRIME).any())


def _applied(model: Dynamics, function: Callable[..., Any]) -> ca.SX:
    where = model.slices()
    names = list(inspect.signature(function).parameters)
    for name in names:
        if name not in where:
            raise UsageError(f"{model.name} has no state {name!r}; it has {', '.join(where)}")
    x = model.traced.x
    return ca.densify(ca.vec(ca.SX(function(**{n: x[where[n]] for n in names}))))


def structure(
    model: Dynamics,
    *,
    varying: bool = True,
    known: Sequence[str] = (),
    unmeasured: Sequence[str] = (),
    experiments: int = 1,
    per_run: Sequence[str] = (),
    seed: int = 0,
) -> Structure:
    """Structural rank of a model, from power series of its readings at random points.

    `varying`: inputs with free derivatives of every order; else constant. `known`: states whose
    value at the beginning is known. `unmeasured`: inputs that vary and nobody knows. `experiments`:
    so many records with the same parameters (states without rate and noise that are not
    `per_run`), each with states and inputs of its own; those of the second are called `x (2)`, and
    are known or not measured as those of the first.

    Exact, modulo a prime, where rates and outputs are made of arithmetic, roots, exponentials,
    logarithms, sines and what follows from them; else in floating point, and `rounded` says why.
    Raises DeclarationError where no point is found at which the readings' derivatives are finite,
    UsageError for names that are not the model's.
    """
    _checked(Question(model, varying, tuple(known), tuple(unmeasured)), per_run)
    model, copies = several(model, experiments, per_run)
    asked = Question(model, varying, copies(known), copies(unmeasured))
    floating.finite(model)
    try:
        return _exactly(asked, Exact(asked, seed))
    except Inexact as why:
        if asked.unmeasured:
            raise UsageError(
                f"{model.name}: an input that is not measured asks for exact arithmetic, and {why}"
            ) from None
        found = floating.ranked(model, varying, seed, asked.known_places)
        hidden = tuple(words(model, one) for one in found.hidden)
        return Structure(
            model, found.rank, found.order, found.gap, found.undetermined, hidden, varying,
            asked.measured, rounded=str(why),
        )  # fmt: skip


def _checked(asked: Question, per_run: Sequence[str]) -> None:
    model = asked.model
    for name in (*asked.known, *per_run):
        _ = model[name]
    for name in asked.unmeasured:
        if name not in asked.inputs or name == "t":
            known = ", ".join(n for n in asked.inputs if n != "t") or "none"
            raise UsageError(f"{model.name} has no input {name!r}; it has {known}")


def _exactly(asked: Question, exact: Exact) -> Structure:
    model = asked.model
    null = exact.hidden(slice(0, 1))[0]
    hidden = [bool(row.any()) for row in null]
    undetermined = tuple(n for n, h in zip(model.names, hidden, strict=True) if h)
    inputs = exact.hidden_inputs() if asked.unmeasured else ()
    sentences: list[str] = []
    formulas: list[str] = []
    more = 0
    if undetermined:
        told = _Sampled(exact)
        states, bases = told(TOGETHER)
        found_laws = list(laws(model, bases, states, told.vectors))
        sentences = [words(model, law) for law in found_laws]
        settled = [i for i, h in enumerate(hidden) if not h]
        for group in groups(bases[0]):
            if all(found_laws[k].says_all for k in group.hidden):
                continue
            found = combinations(group, model.names, settled, told)
            formulas += found.formulas
            more += found.more
    if asked.unmeasured:
        sentences = [f"{s} while {listed(asked.unmeasured)} is free" for s in sentences]
    return Structure(
        model, model.size - null.shape[1], exact.reached, np.inf, undetermined + inputs,
        tuple(sentences), asked.varying, asked.measured, tuple(formulas), more, _question=asked,
    )  # fmt: skip


class _Sampled:
    """Hidden directions at as many points as are asked for."""

    def __init__(self, exact: Exact) -> None:
        self.exact = exact
        self._nulls: list[Residues] = []

    def __call__(self, count: int) -> tuple[Residues, Residues]:
        """States (count, n) and sparse bases of the hidden directions (count, n, k)."""
        while len(self._nulls) < count:
            here = len(self._nulls)
            self._nulls += self.exact.hidden(slice(here, here + TOGETHER))
        return self.exact.pool.states[:count], sparse(self._nulls[:count])

    @property
    def vectors(self) -> dict[str, Residues]:
        """The inputs of three components at the first points."""
        inputs = self.exact.pool.inputs[:TOGETHER]
        places = {n: self.exact.asked.places([n]) for n in self.exact.asked.inputs}
        return {name: inputs[:, own] for name, own in places.items() if len(own) == 3}
