"""What closing the loop leaves: the estimates, what was added and why, what was refused."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Skipped
from casest.diagnose.cross_validation import Folds
from casest.diagnose.found import Course, Found, Undecided
from casest.diagnose.misfit.left import Misfit, left_over
from casest.diagnose.visibility import Visible
from casest.effects.placing import prepared
from casest.estimate.estimate import Estimate
from casest.leastsquares.problem import Problem


@dataclass(frozen=True)
class Closing:
    """What the loop leaves: the estimate before and after, what was added, what was refused.

    `visible`: what these data could show of each effect that was tried; `undecided`: causes that
    are there, of which none was added.
    """

    before: Estimate
    after: Estimate
    before_held_out: tuple[Array, ...]
    after_held_out: tuple[Array, ...]
    effects: tuple[Found, ...]
    skipped: tuple[Skipped, ...]
    refused: tuple[Skipped, ...]
    folds: Folds
    visible: tuple[Visible, ...]
    runs: tuple[Run, ...]
    undecided: Undecided | None = None
    #: What a slow course in the residual looks like, though its cause is not known.
    described: tuple[Course, ...] = ()
    #: Of what is left, as a share, that averages of inputs over the rows around take away.
    averaged: float = 0.0

    @cached_property
    def misfit(self) -> Misfit:
        """What is left after the loop, tested beside the noise as it is."""
        model, runs = self.after.model, self.runs
        if model.noise is not None:  # with true values, and noise, as they are there
            runs = prepared(model, self.after.problem.runs)
        problem = Problem(model, runs)
        evidence = self.after.evidence
        shared = evidence.scatter if evidence is not None and evidence.misfit else None
        with np.errstate(all="ignore"):
            return left_over(
                problem,
                problem.point(self.after.values),
                self.folds.batches,
                self.after_held_out,
                self.after.correlated_over,
                self.undecided,
                self.described,
                wanders=any(f.wanders for f in self.effects),
                shared=shared,
            )

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
