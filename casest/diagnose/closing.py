"""What closing the loop leaves: the estimates, what was added and why, what was refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Skipped
from casest.diagnose.candidates.score_test import Score
from casest.diagnose.misfit.lack_of_fit import Misfit, left_over, state_of
from casest.diagnose.selection.cross_validation import Folds
from casest.diagnose.selection.found import Found, Undecided
from casest.estimate.calibrate import Estimate
from casest.leastsquares.problem import Problem


@dataclass(frozen=True)
class Closing:
    """What the loop leaves: the estimate before and after, what was added, what was refused."""

    before: Estimate
    after: Estimate
    before_held_out: tuple[Array, ...]
    after_held_out: tuple[Array, ...]
    effects: tuple[Found, ...]
    skipped: tuple[Skipped, ...]
    refused: tuple[Skipped, ...]
    folds: Folds
    remaining: tuple[Score, ...]
    first: tuple[Score, ...]
    runs: tuple[Run, ...]
    noise: float = 0.0
    undecided: Undecided | None = None

    @cached_property
    def misfit(self) -> Misfit:
        """What is left after the loop, tested beside the noise as it is."""
        problem = Problem(self.after.model, self.runs)
        point = problem.point(self.after.values)
        with np.errstate(all="ignore"):
            state = state_of(problem, point, self.folds.batches)
            left = left_over(state, self.after_held_out, self.after.correlated_over)
        if self.undecided is None:
            return left
        names = self.undecided.names
        several = " and other shapes" if len(names) == 1 else ""
        where = f"which {' or '.join(names)}{several} explain alike"
        fraction = max(left.fraction, self.undecided.share)
        return replace(left, significant=True, fraction=fraction, where=where)

    @property
    def verdict(self) -> str | None:
        """adequate, extended or unexplained; None where nothing can be told.

        That is without a trusted estimate, and where nothing could be held out.
        """
        if not self.after.certificate.trusted or not self.folds.count:
            return None
        if self.misfit.significant:
            return "unexplained"
        return "adequate" if all(f.of_noise for f in self.effects) else "extended"
