"""What is known of an old estimate: values, their covariance, and the noise it was made in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.leastsquares.problem import Problem
from casest.validity.colour import Colour

#: Degrees of freedom of noise that was stated.
STATED = 1e9


@dataclass(frozen=True)
class Old:
    """An old estimate as a new record is judged by it.

    `covariance` (n, n) of the unknowns `names`, NaN in those that nothing determined; `sigma` of
    one residual (NaN: unknown) with `freedom` degrees of it (in independent residuals), `colour` of
    the noise. `model` has a noise where that of a new record is stated.
    """

    model: Model
    values: Mapping[str, Any]
    names: tuple[str, ...]
    covariance: Array
    sigma: float
    freedom: float
    colour: Colour | None

    def shared(self, problem: Problem) -> tuple[Array, NDArray[np.bool_]]:
        """Covariance (n, n) of the new problem's unknowns, zero in its own ones; and which of them
        nothing holds, (n,): those of its runs alone, and what the old data did not determine."""
        n, place = problem.unknowns, {name: k for k, name in enumerate(self.names)}
        own = {i for s in problem.slots if s.run is not None for i in range(s.x.start, s.x.stop)}
        at = [-1 if i in own else place.get(name, -1) for i, name in enumerate(problem.names)]
        covariance, loose = np.zeros((n, n)), np.array([k < 0 for k in at])
        held = np.flatnonzero(~loose)
        old = np.array(at)[held]
        covariance[np.ix_(held, held)] = self.covariance[np.ix_(old, old)]
        lost = ~np.isfinite(np.diag(covariance))
        covariance[lost, :] = covariance[:, lost] = 0.0
        return np.nan_to_num(covariance), loose | lost
