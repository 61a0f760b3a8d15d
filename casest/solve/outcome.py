"""What every solver hands back."""

from __future__ import annotations

from dataclasses import dataclass

from casest.stack import Point


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
