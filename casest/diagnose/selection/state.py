"""The work of one closing: the record and its folds, fits to it, and what has been found so far."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from casest.data.run import Run
from casest.declaration.effect import Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate, Skipped
from casest.diagnose.candidates.score_test import Score
from casest.diagnose.selection.cross_validation import (
    ENOUGH,
    ITERATIONS,
    check_folds,
    cross_fitted,
    folded,
    gain,
)
from casest.diagnose.selection.found import Found, Undecided
from casest.diagnose.selection.model_evidence import Fitted
from casest.engine.kernel import only_tried
from casest.estimate.calibrate import Estimate, attempt
from casest.leastsquares.problem import Problem
from casest.leastsquares.weights import robust_scale, weighted
from casest.solve.trust_region import trust_region

#: The held-out gain must exceed this many of its own standard errors.
HELD_OUT = 1.64


class Step(NamedTuple):
    """How an effect was added: the fit before it, its own, what else was tried, its share.

    The share is of the held-out mean square: what it takes away.
    """

    before: Fitted
    score: Score
    fitted: Fitted
    tried: Sequence[tuple[Score, Fitted]]
    share: float


class Work:
    """What the steps of the loop share: fits, their judgement on held-out data, the findings."""

    def __init__(
        self,
        before: Estimate,
        runs: tuple[Run, ...],
        catalogue: Sequence[Effect],
        seed: int,
        say: Callable[[str], None],
        known: Collection[str] = (),
    ) -> None:
        self.before, self.runs, self.catalogue, self.seed, self.say = (
            before, runs, catalogue, seed, say,
        )  # fmt: skip
        #: Names of effects that the user knows to be there.
        self.known = frozenset(known)
        self.folds = folded(runs, before.correlated_over, seed)
        check_folds(before, runs, self.folds)
        self.refused: list[Skipped] = []
        self.skipped: list[Skipped] = []
        self.found: list[Found] = []
        self.undecided: Undecided | None = None
        #: The last step that added one effect, which can be taken back while nothing follows it.
        self.last: Step | None = None
        #: What would have been added, were a random walk of the offset not as good a cause.
        self.walks: list[Undecided] = []
        #: What explains the data in this round, but has no fit that can be trusted.
        self.untrusted: list[tuple[Score, Fitted]] = []
        #: Candidates as they are declared, by label: their profiles unknown, on all axes.
        self.original: dict[str, Candidate] = {}

    def fitted(self, model: Model, values: Mapping[str, Array]) -> Fitted | None:
        """Fit to everything; None where it goes astray."""
        problem = weighted(Problem(model, self.runs), values)
        count = max(problem.residual_count, 1)
        fit = trust_region(
            problem, problem.point(values), max_iterations=ITERATIONS, tolerance=ENOUGH / count
        )
        if problem.weights is not None:  # the start had other weights
            problem = weighted(problem, problem.values(fit.point))
            fit = trust_region(
                problem, fit.point, max_iterations=ITERATIONS, tolerance=ENOUGH / count
            )
        residuals = problem.residuals(fit.point)
        if not (np.isfinite(fit.cost) and all(np.all(np.isfinite(r)) for r in residuals)):
            return None
        freedom = max(problem.residual_count - problem.unknowns, 1)
        noise = robust_scale(residuals) * float(np.sqrt(problem.residual_count / freedom))
        return Fitted(model, problem.values(fit.point), problem.unknowns, tuple(residuals), noise)

    def crossed(self, fitted: Fitted | None) -> Fitted | None:
        """The same with held-out residuals; None where a part cannot be predicted."""
        if fitted is None or fitted.held_out:
            return fitted
        held_out = cross_fitted(fitted.model, self.runs, fitted.values, self.folds)
        if not all(np.all(np.isfinite(r)) for r in held_out):
            return None
        return replace(fitted, held_out=held_out)

    def certified(self, current: Fitted) -> Estimate:
        """An estimate whose trust is known; its intervals may be left for the end."""
        with only_tried(False):
            return attempt(
                current.model, self.runs, start=current.values, seed=self.seed, intervals=False
            )

    def gain(self, current: Fitted, better: Fitted) -> tuple[float, float]:
        """Held-out gain in mean squared error, and its standard error."""
        sigma = better.noise
        count = sum(r.size for r in better.held_out) / sigma**2
        gained, error = gain(current.held_out, better.held_out, self.folds, sigma)
        return gained / count, error / count

    def confirmed(self, current: Fitted, better: Fitted) -> bool:
        """Does the held-out error fall by more than chance?"""
        gained, error = self.gain(current, better)
        return gained > HELD_OUT * error

    def keep(
        self,
        fitted: Fitted,
        candidate: Candidate,
        gained: float,
        score: Score,
        rivals: Mapping[str, Mapping[str, Array]],
    ) -> None:
        """Note an effect that was added, and say so."""
        self.say(f"{candidate.label}: held-out error falls")
        names = tuple(p.name for p in candidate.parameters(fitted.model))
        self.found.append(Found(candidate, score, score.p_value, gained, names, rivals))

    def refuse(self, candidate: Candidate, why: str) -> None:
        """Note why a candidate was not added."""
        said = Skipped(candidate.label, why)
        if said not in self.refused:
            self.refused.append(said)
