"""What every solver hands back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from casest.declaration.shapes import Array
from casest.engine import Normal
from casest.leastsquares.problem import Point


class LeastSquares(Protocol):
    """What a solver needs to know of a least-squares problem; see `leastsquares.problem`."""

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bound of every unknown."""

    @property
    def residual_count(self) -> int:
        """Number of residuals."""

    def moved(self, point: Point, step: Array) -> Point:
        """The point after a step."""

    def cost(self, point: Point) -> float:
        """Half the sum of squares."""

    def normal(self, point: Point) -> Normal:
        """Cost, gradient and Gauss-Newton matrix."""

    def factor(self, point: Point) -> tuple[Array, Array, float]:
        """Triangular factor of the Jacobian, Qᵀr, and the norm of the rest of r."""


@dataclass(frozen=True)
class Outcome:
    """End of one solver's run: where it stopped, the cost there, and what it claims."""

    solver: str
    point: Point
    cost: float
    iterations: int
    evaluations: int
    claims_success: bool
    status: str
    seconds: float
