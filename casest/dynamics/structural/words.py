"""How a state may change without a trace, a sentence per hidden direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.gramian import sentence


@dataclass(frozen=True)
class Hidden:
    """A hidden direction: the states it touches, by their place, and its law as far as it has one.

    `along`: the input of three components that it follows; `shift` (n,): it is the same
    everywhere; `powers`: each touched state is multiplied by λ to its power.
    """

    touched: tuple[int, ...]
    along: str | None = None
    shift: Array | None = None
    powers: Array | None = None

    @property
    def says_all(self) -> bool:
        """Do the words name the function that is seen all the same, or have it no formula?"""
        if self.powers is None or len(self.touched) > 2:
            return bool(self.along)
        return bool(np.isclose(*np.abs(self.powers)))


def words(model: Dynamics, hidden: Hidden) -> str:
    """A hidden direction as a sentence."""
    names = [model.names[i] for i in hidden.touched]
    if hidden.along:
        where = model.slices().items()
        own = [n for n, w in where if any(w.start <= i < w.stop for i in hidden.touched)]
        if len(own) == 1:
            return f"{own[0]} along {hidden.along} changes no reading"
        return f"{listed(own)} along {hidden.along} cannot be told apart"
    if len(names) == 1:
        return f"{names[0]} changes no reading"
    if hidden.shift is not None:
        return sentence(model, hidden.shift)
    if hidden.powers is not None:
        return _scaling(names, hidden.powers)
    return f"{listed(names)} cannot all be told apart: only combinations of them are seen"


def _scaling(names: Sequence[str], powers: Array) -> str:
    """What is multiplied by λ to which power: `predator·λ, b/λ`."""
    if len(names) == 2 and np.allclose(powers, powers[0]):
        return f"only the quotient of {names[0]} and {names[1]} is seen"
    if len(names) == 2 and np.isclose(powers[0], -powers[1]):
        return f"only the product of {names[0]} and {names[1]} is seen"
    powers = np.round(powers / np.abs(powers).min() * np.sign(powers[0]), 6)
    terms = []
    for power in dict.fromkeys(powers.tolist()):
        same = [n for n, p in zip(names, powers, strict=True) if p == power]
        factor = {1.0: "λ", -1.0: "1/λ"}.get(power, f"λ^{power:.3g}")
        terms.append(f"{listed(same)} by {factor}")
    return f"multiplying {listed(terms)} changes no reading"


def listed(names: Sequence[str]) -> str:
    """ "a, b and c" """
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
