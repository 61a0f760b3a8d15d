"""States of stiff equations, and their slopes: where explicit steps would be too many.

[x, X] are integrated together by backward differentiation (CVODES of SUNDIALS, by CasADi; Hindmarsh
et al. 2005), every number in units of the largest size that it has along the record, so that the
error of each is kept below the same share of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.physics import SX
from casest.declaration.shapes import Array

#: Error of a step, of the size of each number, and steps between two samples at most.
TOLERANCE, STEPS = 1e-11, 5_000
#: Rounds in which sizes are found, and by how much they may still change.
ROUNDS, ALIKE = 3, 10.0


@dataclass(frozen=True)
class Stiff:
    """ẏ = rate(y, t, parameters) of y = [x, X]; `clock` is the symbol of t, None without."""

    y: SX
    rate: SX
    parameters: SX
    clock: SX | None
    _kept: dict[tuple[float, ...], Any] = field(default_factory=dict, repr=False, compare=False)

    def along(self, start: Array, parameters: Array, time: Array) -> Array | None:
        """y (N, n) at every time, the first `start`; None where it cannot be followed."""
        size = np.where(start != 0, np.abs(start), 1.0)
        follow = self._follow(time)
        for _ in range(ROUNDS):
            try:
                found = follow(x0=start / size, p=np.concatenate([parameters, size]))["xf"]
            except RuntimeError:  # what CVODES says is that it cannot go on
                return None
            y = np.vstack([start, np.array(found).T * size])
            if not np.isfinite(y).all():
                return None
            largest = np.max(np.abs(y), axis=0)
            largest = np.where(largest > 0, largest, 1.0)
            if np.all((largest < ALIKE * size) & (largest > size / ALIKE)):
                return y
            size = largest
        return y

    def _follow(self, time: Sequence[float] | Array) -> Any:
        """CVODES at these times; kept from one call to the next."""
        key = tuple(float(t) for t in time)
        if key not in self._kept:
            size, scaled = ca.SX.sym("size", self.y.numel()), ca.SX.sym("y", self.y.numel())
            t = ca.SX.sym("t") if self.clock is None else self.clock
            rate = ca.substitute(self.rate, self.y, scaled * size) / size
            dae = {"x": scaled, "t": t, "p": ca.vertcat(self.parameters, size), "ode": rate}
            settings = {
                "abstol": TOLERANCE,
                "reltol": TOLERANCE,
                "max_num_steps": STEPS,
                "linear_solver": "qr",
                "print_stats": False,
                "disable_internal_warnings": True,
                "show_eval_warnings": False,
            }
            self._kept.clear()
            self._kept[key] = ca.integrator("follow", "cvodes", dae, key[0], [*key[1:]], settings)
        return self._kept[key]
