"""The loop: fit, look at the residual, add the best candidate, judge it on held-out data, again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from casest.closing.candidates import Candidate, Skipped, candidates, prepared
from casest.closing.crossfit import (
    Folds,
    batch_losses,
    batch_sizes,
    cross_fitted,
    folded,
    rms,
)
from casest.closing.profile import freed_again, profiled
from casest.closing.restrict import restricted
from casest.closing.score import Score, scores, widened
from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.effects import CATALOGUE
from casest.engine.kernel import patient
from casest.engine.threads import one_thread
from casest.errors import CasestError, NotTrusted
from casest.estimate import Estimate, attempt
from casest.modelling.effect import Effect
from casest.modelling.model import Model
from casest.noise import robust_scale
from casest.solve.trust_region import trust_region
from casest.stack import Point, Problem

#: Chance, under a model that lacks nothing, that any candidate is called significant.
FALSE_ALARM = 0.002
#: The held-out gain must exceed this many of its own standard errors.
HELD_OUT = 2.5
#: Candidates whose held-out errors differ by fewer standard errors are not told apart.
ALIKE = 2.5
#: Candidates that are refitted in a round, and rounds.
CONTENDERS, ROUNDS = 6, 8
#: Columns of the widest model that is evaluated at once.
WIDEST = 120


@dataclass(frozen=True)
class Fitted:
    """A model fitted to all data, with its cross-fitted residuals."""

    model: Model
    values: Mapping[str, Array]
    cost: float
    unknowns: int
    held_out: tuple[Array, ...]
    losses: Array


@dataclass(frozen=True)
class Found:
    """An effect that was added, with the evidence."""

    candidate: Candidate
    score: Score
    p_value: float
    gain: float
    indistinguishable_from: tuple[str, ...]
    names: tuple[str, ...]


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
    extra: Mapping[str, Any] = field(default_factory=dict)


def close(
    model: Model,
    runs: Sequence[Run],
    *,
    catalogue: Sequence[Effect] = CATALOGUE,
    start: Mapping[str, Any] | None = None,
    seed: int = 0,
    say: Callable[[str], None] = lambda _: None,
) -> Closing:
    """Fit, trace the residual to effects of the catalogue, add those that held-out data confirm.

    Raises NotTrusted, with the refused estimate, where the declared model itself has no
    trustworthy fit, and DataError where nothing can be held out.
    """
    before = attempt(model, runs, start=start, seed=seed)
    if not before.certificate.trusted:
        error = NotTrusted("no trustworthy estimate: " + "; ".join(before.certificate.reasons))
        error.estimate = before
        raise error
    with np.errstate(all="ignore"), one_thread(), patient():
        return _Loop(before, prepared(model, runs), catalogue, seed, say).closed()


class _Loop:
    """The state of one closing: the model as it grows."""

    def __init__(
        self,
        before: Estimate,
        runs: tuple[Run, ...],
        catalogue: Sequence[Effect],
        seed: int,
        say: Callable[[str], None],
    ) -> None:
        self.before, self.runs, self.catalogue, self.seed, self.say = (
            before, runs, catalogue, seed, say,
        )  # fmt: skip
        self.folds = folded(runs, before.correlated_over, seed)
        self.refused: list[Skipped] = []
        self.skipped: list[Skipped] = []
        self.found: list[Found] = []

    def closed(self) -> Closing:
        """Run the loop."""
        current = self._fitted(self.before.model, self.before.values)
        assert current is not None
        first_held_out, first_scores = current.held_out, None
        ranked: list[Score] = []
        for _ in range(ROUNDS):
            ranked = self._ranked(current)
            first_scores = first_scores or ranked
            better = self._better(current, ranked)
            if better is None:
                break
            current = better
        else:
            ranked = self._ranked(current)
        current = self._weeded(current)
        after = self._certified(current) if self.found else self.before
        return Closing(
            self.before,
            after,
            first_held_out,
            current.held_out,
            tuple(self.found),
            tuple(self.skipped),
            tuple(self.refused),
            self.folds,
            tuple(ranked),
            tuple(first_scores or ()),
            self.runs,
            self._sigma(current),
        )

    # -- fits ----------------------------------------------------------------------------------

    def _fitted(self, model: Model, values: Mapping[str, Array]) -> Fitted | None:
        """Fit to everything and cross-fit; None where either goes astray."""
        problem = Problem(model, self.runs)
        fit = trust_region(
            problem, problem.point(values), tolerance=1e-7 / max(problem.residual_count, 1)
        )
        if not np.isfinite(fit.cost):
            return None
        found = problem.values(fit.point)
        held_out = cross_fitted(model, self.runs, found, self.folds)
        if not all(np.all(np.isfinite(r)) for r in held_out):
            return None
        limit = 4 * robust_scale(held_out)
        losses = batch_losses(held_out, self.folds, limit)
        return Fitted(model, found, fit.cost, problem.unknowns, held_out, losses)

    def _certified(self, current: Fitted) -> Estimate:
        return attempt(current.model, self.runs, start=current.values, seed=self.seed)

    def _sigma(self, current: Fitted) -> float:
        problem = Problem(current.model, self.runs)
        residuals = problem.residuals(problem.point(current.values))
        freedom = max(problem.residual_count - problem.unknowns, 1)
        return robust_scale(residuals) * float(np.sqrt(problem.residual_count / freedom))

    # -- candidates ----------------------------------------------------------------------------

    def _ranked(self, current: Fitted) -> list[Score]:
        """Every candidate's score, the most significant first."""
        found, skipped = candidates(current.model, self.runs, self.catalogue)
        if not self.skipped:
            self.skipped = skipped
        problem = Problem(current.model, self.runs)
        point = problem.point(current.values)
        residuals, sigma = problem.residuals(point), self._sigma(current)
        readings = _readings(problem, point)
        self.original = {c.label: c for c in found}
        expanded = profiled(found, self.runs, residuals, readings, sigma)
        ranked: list[Score] = []
        for part in _parts(expanded, WIDEST // max(len(current.model.axes), 1)):
            try:
                wide = widened(current.model, self.runs, current.values, part)
                ranked += scores(wide, part, sigma, self.folds.batches)
            except CasestError as error:
                self.refused += [Skipped(c.label, str(error)) for c in part]
        return sorted(ranked, key=lambda s: (s.p_value, -s.gain / max(s.inflation, 1.0)))

    def _better(self, current: Fitted, ranked: list[Score]) -> Fitted | None:
        """The model with the best candidate that held-out data confirm; None if none does."""
        limit = FALSE_ALARM / max(len({s.candidate.label for s in ranked}), 1)
        significant = [s for s in ranked if s.p_value <= limit]
        significant = _confirmed_by_flips(significant, ranked)
        contenders = _best_of_each(significant)[:CONTENDERS]
        tried: list[tuple[Score, Fitted]] = []
        for score in contenders:
            fitted = self._with(current, score)
            if fitted is not None and _gain(current, fitted, self.folds)[0] > 0:
                tried.append((score, fitted))
        tried.sort(key=lambda pair: _criterion(pair[1], current, self.folds))
        for score, fitted in tried:
            mean, error = _gain(current, fitted, self.folds)
            if not mean > HELD_OUT * error:
                self.refused.append(
                    Skipped(score.candidate.label, "held-out data do not confirm it")
                )
                continue
            estimate = self._certified(fitted)
            if not estimate.certificate.trusted:
                why = estimate.certificate.reasons[0]
                self.refused.append(Skipped(score.candidate.label, f"its fit is refused: {why}"))
                continue
            alike = tuple(
                other.candidate.label
                for other, theirs in tried
                if theirs is not fitted and _alike(fitted, theirs, self.folds)
            )
            self.say(f"{score.candidate.label}: held-out error falls")
            fitted, candidate = self._pruned(fitted, estimate, score)
            self.found.append(
                Found(
                    candidate,
                    score,
                    score.p_value,
                    mean,
                    alike,
                    tuple(p.name for p in candidate.parameters(fitted.model)),
                )
            )
            return fitted
        return None

    def _with(self, current: Fitted, score: Score) -> Fitted | None:
        """The model refitted with a candidate, from its first-order step."""
        candidate = freed_again(score.candidate, self.original[score.candidate.label])
        try:
            model = candidate.added_to(current.model)
            problem = Problem(model, self.runs)
            start = problem.point({k: v for k, v in current.values.items()})
            moved = _stepped(problem, start, candidate, score)
            best = min((start, moved), key=lambda p: _finite(problem.cost(p)))
            return self._fitted(model, problem.values(best))
        except CasestError as error:
            self.refused.append(Skipped(candidate.label, str(error)))
            return None

    def _pruned(self, fitted: Fitted, estimate: Estimate, score: Score) -> tuple[Fitted, Candidate]:
        """Without the axes on which the effect is nothing: an axis with nothing in it stays."""
        candidate = freed_again(score.candidate, self.original[score.candidate.label])
        kept = _significant_axes(candidate, estimate)
        if kept is None or candidate.effect is None:
            return fitted, candidate
        smaller = replace(candidate, effect=restricted(candidate.effect, kept, fitted.model))
        base = replace(fitted.model, effects=fitted.model.effects[:-1])
        try:
            again = self._fitted(smaller.added_to(base), _narrowed(fitted.values, candidate, kept))
        except CasestError:
            return fitted, candidate
        if again is None:
            return fitted, candidate
        mean, error = _gain(again, fitted, self.folds)
        return (fitted, candidate) if mean > HELD_OUT * error else (again, smaller)

    def _weeded(self, current: Fitted) -> Fitted:
        """Each kept effect must still earn its place."""
        for found in list(self.found[:-1]):
            label = found.candidate.label
            if found.candidate.freed:
                continue
            effects = tuple(a for a in current.model.effects if a.label != label)
            without = self._fitted(
                replace(current.model, effects=effects),
                {k: v for k, v in current.values.items() if not k.startswith(label + ".")},
            )
            if without is None:
                continue
            mean, error = _gain(without, current, self.folds)
            if not mean > HELD_OUT * error:
                self.found.remove(found)
                self.refused.append(Skipped(label, "no longer needed beside what came later"))
                current = without
        return current


def _finite(cost: float) -> float:
    return cost if np.isfinite(cost) else np.inf


def _stepped(problem: Problem, start: Point, candidate: Candidate, score: Score) -> Point:
    """The start moved by the score's first-order step in the candidate's own unknowns."""
    own = {p.name for p in candidate.parameters(problem.model)}
    x, used = start.x.copy(), 0
    for slot in problem.slots:
        if slot.parameter.name in own and slot.parameter.name.rpartition(".")[2] != "frequency":
            width = slot.x.stop - slot.x.start
            if used + width <= len(score.step):
                x[slot.x] = x[slot.x] + score.step[used : used + width]
                used += width
    # What the declared parameters had taken over goes back.
    return Point(problem.inside(x), start.references)


def _readings(problem: Problem, point: Point) -> list[Array] | None:
    """What the model predicts, (N, m) per run; None for an implicit model."""
    predicted = problem.model.traced.predicted
    if predicted is None or problem.sequential:
        return None
    return [v[0][:, :, 0] for v in problem.evaluate(point, {"p": predicted})]


def _parts(found: Sequence[Candidate], size: int) -> list[list[Candidate]]:
    return [list(found[k : k + size]) for k in range(0, len(found), size)]


def _best_of_each(ranked: Sequence[Score]) -> list[Score]:
    """The best of several trials of one effect."""
    seen: dict[str, Score] = {}
    for score in ranked:
        seen.setdefault(score.candidate.label, score)
    order = sorted(seen.values(), key=lambda s: -(s.gain / s.inflation - 2 * s.freedom))
    return order


def _confirmed_by_flips(significant: list[Score], ranked: list[Score]) -> list[Score]:
    """With few batches: the smallest p-value must be rare when the batches' signs are random.

    Flipping the sign of all that a batch contributes keeps unequal noise as it is, and the
    dependence between candidates (Westfall & Young 1993, with wild bootstrap weights).
    """
    if not significant or len(significant[0].batches) >= 200:
        return significant
    rng = np.random.default_rng(0)
    alive = [s for s in ranked if s.freedom]
    flips = rng.choice([-1.0, 1.0], (999, len(alive[0].batches)))
    smallest = np.ones(len(flips))
    from scipy.special import fdtrc

    for s in alive:
        total = flips @ s.batches
        F = np.sum(total**2, axis=1) / s.freedom / s.inflation
        p = np.minimum(1.0, fdtrc(s.freedom, 20 * len(s.batches), F) * s.candidate.trials)
        smallest = np.minimum(smallest, p)
    limit = float(np.quantile(smallest, 0.01))
    return [s for s in significant if s.p_value <= limit]


def _gain(current: Fitted, better: Fitted, folds: Folds) -> tuple[float, float]:
    """Held-out gain in mean squared error and its standard error, from batch to batch."""
    sizes = batch_sizes(current.held_out, folds)
    difference = current.losses - better.losses
    weights = sizes / sizes.sum()
    mean = float(weights @ difference)
    error = float(np.sqrt(np.sum(weights**2 * (difference - mean) ** 2)))
    return mean, error * float(np.sqrt(len(sizes) / max(len(sizes) - 1, 1)))


def _alike(one: Fitted, other: Fitted, folds: Folds) -> bool:
    """Do held-out data not tell two models apart?"""
    mean, error = _gain(other, one, folds)
    return abs(mean) <= ALIKE * error or abs(mean) <= 1e-9 * float(np.mean(one.losses))


def _criterion(fitted: Fitted, current: Fitted, folds: Folds) -> float:
    """Held-out loss, with a little more for every unknown: of two alike the simpler one."""
    sizes = batch_sizes(fitted.held_out, folds)
    loss = float(sizes @ fitted.losses)
    return loss + (fitted.unknowns - current.unknowns) * loss / float(sizes.sum())


def _significant_axes(candidate: Candidate, estimate: Estimate) -> list[int] | None:
    """Axes on which any parameter of the effect is beyond three standard deviations.

    None where all are, or where the effect is no matter of axes.
    """
    own = candidate.parameters(estimate.model)
    own = [p for p in own if p.shape.kind == "array" and len(p.shape.dims) == 1]
    sizes = {p.shape.size for p in own}
    if len(sizes) != 1 or next(iter(sizes)) < 2 or any(p.scope == "run" for p in own):
        return None
    z = np.zeros(next(iter(sizes)))
    for p in own:
        with np.errstate(all="ignore"):
            z = np.maximum(z, np.abs(estimate.values[p.name] / estimate.std[p.name]))
    kept = [int(i) for i in np.flatnonzero(z > 3.0)]
    return kept if 0 < len(kept) < len(z) else None


def _narrowed(
    values: Mapping[str, Array], candidate: Candidate, kept: list[int]
) -> dict[str, Array]:
    """Values of the restricted effect's unknowns, from those of the whole one."""
    found: dict[str, Array] = {}
    for name, value in values.items():
        if not name.startswith(candidate.label + ".") or np.ndim(value) != 1:
            found[name] = value
            continue
        for i in kept:
            found[f"{name}_{'xyz'[i] if len(value) == 3 else i}"] = np.asarray(value[i])
    return found


__all__ = ["Closing", "Found", "close", "rms"]
