"""What a motion is to be best for: functions of what readings tell of the state at the beginning.

All are logarithms of standard deviations, so that a difference is a ratio of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.errors import UsageError
from casest.plan.goals import Goal

#: Power of the mean that stands for the largest, which has no slope: of 9 at most 15 % above it.
DOUBLINGS = 4
#: What is known beforehand of what nothing is said of, as a share of one of its size.
VAGUE = 1e-10


@dataclass(frozen=True)
class Wanted:
    """D, A, E or the entries of one state, of unknowns in units of `scale` (n,).

    free: which of the states are unknown. known (f, f): what is known of these beforehand, in
    units of `scale`. chosen: of `free`, the entries that a name stands for; asked: the standard
    deviation that each is compared with, in its own unit (none: the unit of `scale`).
    """

    name: str
    scale: Array
    free: tuple[int, ...]
    known: Array
    chosen: tuple[int, ...] = ()
    asked: tuple[float, ...] = ()

    @staticmethod
    def of(model: Dynamics, name: str, known: Array | None = None) -> Wanted:
        """Of a model's states; unknowns are measured in what is known of them beforehand.

        An estimator in motion is told its states' `std` at the beginning; an equation that nothing
        drives only those that it states.
        """
        exact = [s.known for s in model.states for _ in range(s.size)]
        free = tuple(i for i, e in enumerate(exact) if not e)
        if not free:
            raise UsageError(f"{model.name}: every state is known: there is nothing to plan for")
        scale = np.sqrt(np.diag(model.start_covariance))
        stated = [s.stated or model.driven_by_noise for s in model.states for _ in range(s.size)]
        if known is None:
            known = np.diag([1.0 if stated[i] else VAGUE for i in free])
        chosen = _chosen(model, name, free)
        return Wanted(name, scale, free, np.asarray(known), chosen)

    @staticmethod
    def for_goals(model: Dynamics, goals: Sequence[Goal]) -> Wanted:
        """The largest standard deviation over what is asked of it, as the readings alone allow."""
        wanted = Wanted.of(model, "D")
        pairs = [(int(i), goal.limit) for goal in goals
                 for i in np.flatnonzero(goal.columns.any(axis=1))]  # fmt: skip
        chosen = tuple(wanted.free.index(i) for i, _ in pairs)
        known = VAGUE * np.eye(len(wanted.free))
        asked = tuple(x for _, x in pairs)
        return replace(wanted, name="goals", known=known, chosen=chosen, asked=asked)

    def covariance(self, W: Array) -> Array:
        """Of the free unknowns, in units of `scale`; W (n, n) as `Task.information` gives it."""
        M = self.known + W[np.ix_(self.free, self.free)]
        size = 1 / np.sqrt(np.diag(M))
        return np.asarray(np.linalg.inv(M * np.outer(size, size)) * np.outer(size, size))

    def value(self, W: Array) -> float:
        """Logarithm of a standard deviation, times the number of unknowns."""
        return float(self.function(W)(W))

    def function(self, near: Array) -> Any:
        """The same as a function of W in CasADi's terms; exact anywhere, and even near `near`."""
        n, f = len(self.scale), len(self.free)
        W = ca.SX.sym("W", n, n)
        own = list(self.free)
        size = 1 / np.sqrt(np.diag(self.known) + np.maximum(np.diag(near)[own], 0.0))
        M = (0.5 * (W + W.T))[own, own] + ca.DM(self.known)
        even = ca.DM(np.diag(size)) @ M @ ca.DM(np.diag(size))
        L = ca.chol(ca.densify(even))
        shift = float(np.sum(np.log(size)))
        if self.name == "D":
            return ca.Function("wanted", [W], [shift - ca.sum1(ca.log(ca.diag(L)))])
        half = ca.solve(L.T, ca.DM(np.diag(size)))
        C = half.T @ half
        least = float(np.max(size) ** 2)
        if self.name == "A":
            return ca.Function("wanted", [W], [f / 2 * ca.log(ca.trace(C) / f)])
        if self.name == "E":
            power = C / least
            for _ in range(DOUBLINGS):
                power = power @ power
            most = ca.log(ca.trace(power)) / 2**DOUBLINGS
        else:
            entries = ca.diag(C)[list(self.chosen)] / least
            if self.asked:
                entries = entries * ca.DM(self._over_asked())
            most = ca.log(ca.sum1(entries ** (2**DOUBLINGS))) / 2**DOUBLINGS
        return ca.Function("wanted", [W], [f / 2 * (most + np.log(least))])

    def _over_asked(self) -> Array:
        """Squares of what one of each entry's size is of what is asked, the largest one."""
        own = self.scale[[self.free[k] for k in self.chosen]] / np.array(self.asked)
        return np.asarray((own / own.max()) ** 2)


def _chosen(model: Dynamics, name: str, free: tuple[int, ...]) -> tuple[int, ...]:
    if name in ("D", "A", "E"):
        return ()
    found = [i for i, n in enumerate(model.names) if n == name or n.partition("[")[0] == name]
    if not found or any(i not in free for i in found):
        unknown = dict.fromkeys(model.names[i].partition("[")[0] for i in free)
        raise UsageError(
            f"--criterion {name}: of the motion of {model.name} one can ask for D, A, E or one of "
            f"{', '.join(unknown)}"
        )
    return tuple(free.index(i) for i in found)
