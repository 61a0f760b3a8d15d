"""The loop: fit, look at the residual, add the best candidate, judge it on held-out data, again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from casest.closing.adequacy import Misfit, misfit
from casest.closing.axes import lighter, living_axes, narrowed, significant_axes
from casest.closing.candidates import Candidate, Skipped, candidates, prepared
from casest.closing.crossfit import (
    ENOUGH,
    ITERATIONS,
    Folds,
    cross_fitted,
    folded,
    gain,
    rms,
)
from casest.closing.evidence import (
    FALSE_ALARM,
    Fitted,
    as_promising,
    best_of_each,
    by_evidence,
    confirmed_by_flips,
    cost_of,
    gentlest_first,
    not_told_apart,
    with_rivals,
)
from casest.closing.formula import formula_instead, try_formula
from casest.closing.held import held_value, holding, strides, within
from casest.closing.noise_model import wander_of
from casest.closing.profile import freed_again, profiled
from casest.closing.restrict import restricted
from casest.closing.score import Score, scores, steadied, widened
from casest.closing.tails import outliers_p_value
from casest.closing.wandering import wanders
from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.effects import CATALOGUE
from casest.engine.kernel import patient
from casest.engine.threads import one_thread
from casest.errors import CasestError, DataError, NotTrusted
from casest.estimate import Estimate, attempt
from casest.identify import identify
from casest.modelling.effect import Effect
from casest.modelling.model import Model
from casest.noise import robust_scale, weighted
from casest.solve.certificate import PRACTICALLY_NULL
from casest.solve.trust_region import trust_region
from casest.stack import Point, Problem

#: The held-out gain must exceed this many of its own standard errors.
HELD_OUT = 1.64
#: What is refused where nothing can be held out.
HELD_OUT_DATA = "held-out data"
#: Candidates that are refitted in a round, those that score as well as the best of them, rounds.
CONTENDERS, MORE, ROUNDS = 6, 4, 8
#: Steps of one size that a level or moment may take from where the grid found it; rivals of the
#: best take them too, where they leave at most this share of what it explains.
STRIDES, NEAR = 6, 0.3
#: Variance of what a fit to the rest foretells of a part, in those of the noise, at most.
UNCERTAIN = 10.0
#: Effects that are a property of the noise, and leave a model adequate.
OF_NOISE = frozenset({"outliers", "bias_wander"})
#: Columns of the widest model that is evaluated at once.
WIDEST = 120


@dataclass(frozen=True)
class Found:
    """An effect that was added, with the evidence: a score, but for one on the noise.

    `rivals`: what the data do not tell apart from it, nearest first, each with how far the declared
    parameters would move were it the cause instead.
    """

    candidate: Candidate
    score: Score | None
    p_value: float
    gain: float
    names: tuple[str, ...] = ()
    rivals: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)

    @property
    def indistinguishable_from(self) -> tuple[str, ...]:
        """Names of the rivals."""
        return tuple(self.rivals)


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

    @cached_property
    def misfit(self) -> Misfit:
        """What is left after the loop, tested beside the noise as it is."""
        return misfit(self)

    @property
    def verdict(self) -> str | None:
        """adequate, extended or unexplained; None where nothing can be told.

        That is without a trusted estimate, and where nothing could be held out.
        """
        if not self.after.certificate.trusted or not self.folds.count:
            return None
        if self.misfit.significant:
            return "unexplained"
        named = {f.candidate.name for f in self.effects}
        return "extended" if named - OF_NOISE else "adequate"


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

    Where nothing can be held out, nothing is added, and `refused` says so. Raises NotTrusted, with
    the refused estimate, where the declared model itself has no trustworthy fit.
    """
    before = attempt(model, runs, start=start, seed=seed)
    if not before.certificate.trusted:
        error = NotTrusted("no trustworthy estimate: " + "; ".join(before.certificate.reasons))
        error.estimate = before
        raise error
    with np.errstate(all="ignore"), one_thread(), patient():
        try:
            loop = _Loop(before, prepared(model, runs), catalogue, seed, say)
        except DataError as error:
            return _as_it_is(before, prepared(model, runs), str(error))
        return loop.closed()


def _as_it_is(before: Estimate, runs: tuple[Run, ...], why: str) -> Closing:
    """The declared model, where nothing can be held out to judge another by."""
    nothing = tuple(np.full((len(run), len(before.model.axes)), np.nan) for run in runs)
    folds = Folds(tuple(np.zeros(len(r), dtype=np.int_) for r in runs),
                  tuple(np.zeros(1, dtype=np.int_) for _ in runs), 0)  # fmt: skip
    refused = (Skipped(HELD_OUT_DATA, why),)
    return Closing(before, before, nothing, nothing, (), (), refused, folds, (), (), runs)


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
        _check_folds(before, runs, self.folds)
        self.refused: list[Skipped] = []
        self.skipped: list[Skipped] = []
        self.found: list[Found] = []
        #: Candidates as they are declared, by label: their profiles unknown, on all axes.
        self.original: dict[str, Candidate] = {}

    def closed(self) -> Closing:
        """Run the loop."""
        current = self._crossed(self._fitted(self.before.model, self.before.values))
        if current is None:
            raise NotTrusted("no part of the record can be predicted from the rest of it")
        first, first_scores = current, None
        declared: Fitted | None = None
        ranked: list[Score] = []
        for _ in range(ROUNDS):
            current = self._without_outliers(current)
            ranked = self._ranked(current)
            first_scores, declared = first_scores or ranked, declared or current
            better = self._better(current, ranked)
            if better is None:
                better = try_formula(self, current)
            if better is None:
                better = formula_instead(self, declared, current)
            if better is None:
                break
            current = better
        else:
            ranked = self._ranked(current)
        current = self._weeded(self._filled(current))
        current, after = self._proved(current)
        self._note_wander(current)
        return Closing(
            self.before,
            after,
            first.held_out,
            current.held_out,
            tuple(self.found),
            tuple(self.skipped),
            tuple(self.refused),
            self.folds,
            tuple(ranked),
            tuple(first_scores or ()),
            self.runs,
            current.noise,
        )

    # -- fits ----------------------------------------------------------------------------------

    def _fitted(self, model: Model, values: Mapping[str, Array]) -> Fitted | None:
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

    def _crossed(self, fitted: Fitted | None) -> Fitted | None:
        """The same with held-out residuals; None where a part cannot be predicted."""
        if fitted is None or fitted.held_out:
            return fitted
        held_out = cross_fitted(fitted.model, self.runs, fitted.values, self.folds)
        if not all(np.all(np.isfinite(r)) for r in held_out):
            return None
        return replace(fitted, held_out=held_out)

    def _certified(self, current: Fitted) -> Estimate:
        """An estimate whose trust is known; its intervals may be left for the end."""
        return attempt(
            current.model, self.runs, start=current.values, seed=self.seed, intervals=False
        )

    def _proved(self, current: Fitted) -> tuple[Fitted, Estimate]:
        """The last estimate, with intervals; without effects that leave one without an end."""
        while self.found:
            after = attempt(current.model, self.runs, start=current.values, seed=self.seed)
            if after.certificate.trusted:
                return current, after
            last = self.found.pop()
            self._refuse(last.candidate, f"its fit is refused: {after.certificate.reasons[0]}")
            left = {f.candidate.label for f in self.found}
            added = current.model.effects[len(self.before.model.effects) :]
            kept = self.before.model.effects + tuple(a for a in added if a.label in left)
            base = self.before.model if last.candidate.freed else current.model
            model = replace(base, effects=kept)
            names = {p.name for p in model.parameters}
            values = {name: v for name, v in current.values.items() if name in names}
            without = self._crossed(self._fitted(model, values))
            if without is None:
                break
            current = without
        return current, self.before

    def _without_outliers(self, current: Fitted) -> Fitted:
        """With the effect `outliers` where there are some: they would pull what follows."""
        effect = next((e for e in self.catalogue if e.name == "outliers"), None)
        if effect is None or any(a.label == effect.name for a in current.model.effects):
            return current
        problem = Problem(current.model, self.runs)
        levels = _readings(problem, problem.point(current.values))
        p_value = outliers_p_value(current.residuals, self.folds.batches, levels)
        if p_value is None:
            return current
        fitted = self._crossed(self._fitted(current.model.with_effect(effect), current.values))
        if fitted is None or not self._certified(fitted).certificate.trusted:
            return current
        gained = self._gain(current, fitted)[0]
        self.found.append(Found(Candidate(effect), None, p_value, gained))
        self.say("outliers: they count less from here on")
        return fitted

    def _note_wander(self, current: Fitted) -> None:
        """Say that the offset wanders: a property of the noise, which changes no fit."""
        effect = next((e for e in self.catalogue if e.name == "bias_wander"), None)
        p_value = wander_of(self.runs, current.residuals)
        if effect is not None and p_value is not None:
            self.found.append(Found(Candidate(effect), None, p_value, 0.0))

    # -- candidates ----------------------------------------------------------------------------

    def _ranked(self, current: Fitted) -> list[Score]:
        """Every candidate's score, the most significant first."""
        found, skipped = candidates(current.model, self.runs, self.catalogue)
        if not self.skipped:
            self.skipped = skipped
        problem = Problem(current.model, self.runs)
        readings = _readings(problem, problem.point(current.values))
        self.original |= {c.label: c for c in found}
        expanded = profiled(found, self.runs, current.residuals, readings, current.noise)
        ranked: list[Score] = []
        known = self.before.noise.repeats
        for part in _parts(expanded, WIDEST // max(len(current.model.axes), 1)):
            try:
                wide = widened(current.model, self.runs, current.values, part)
                ranked += scores(wide, part, current.noise, self.folds.batches, known)
            except CasestError as error:
                self.refused += [Skipped(c.label, str(error)) for c in part]
        ranked = steadied(ranked)
        return sorted(ranked, key=lambda s: (s.p_value, -s.gain / max(s.inflation, 1.0)))

    def _better(self, current: Fitted, ranked: list[Score]) -> Fitted | None:
        """The model with the best candidate that held-out data confirm; None if none does."""
        limit = _limit(ranked)
        significant = [s for s in ranked if s.p_value <= limit]
        confirmed = confirmed_by_flips(significant, ranked)
        if significant and not confirmed:
            self._refuse(
                significant[0].candidate, "no more than noise that is not alike everywhere"
            )
        if not confirmed:
            return None
        tried = self._contenders(current, with_rivals(confirmed, ranked), ranked)
        return self._first_accepted(current, tried, limit) or self._two_at_once(
            current, [pair for pair in tried if pair[0].p_value <= limit]
        )

    def _first_accepted(
        self, current: Fitted, tried: list[tuple[Score, Fitted]], limit: float
    ) -> Fitted | None:
        """The model with the best of those that are significant and that held-out data confirm."""
        for score, fitted in gentlest_first(tried, self.folds):
            if score.p_value > limit:
                continue  # It may be the cause as well, but speaks for itself too softly.
            best = tried[0]
            if fitted is not best[1] and not not_told_apart(best[1], fitted, best[0], self.folds):
                break  # What explains the data clearly less well is not the cause.
            if wanders(self.runs, current, fitted, score):
                self._refuse(score.candidate, "an offset that walks at random explains it as well")
                continue
            accepted = self._accepted(current, score, fitted)
            if accepted is None:
                continue
            self._keep(*accepted, score, self._rivals(fitted, score, tried))
            return accepted[0]
        return None

    def _rivals(
        self, fitted: Fitted, score: Score, tried: Sequence[tuple[Score, Fitted]]
    ) -> dict[str, dict[str, Array]]:
        """What is not told apart from a fit, and where it would have the declared parameters."""
        names = [p.name for p in self.before.model.parameters]
        return {
            s.candidate.label: {
                n: f.values[n] - fitted.values[n]
                for n in names
                if n in f.values and n in fitted.values
            }
            for s, f in tried
            if f is not fitted and not_told_apart(fitted, f, score, self.folds)
        }

    def _two_at_once(self, current: Fitted, tried: list[tuple[Score, Fitted]]) -> Fitted | None:
        """The best that was tried with the best beside it, if both together are confirmed.

        In few poses, what a second cause leaves can hide the gain of the first.
        """
        if not tried:
            return None
        score, first = tried[0]
        if _undetermined(Problem(first.model, self.runs), first.values):
            return None
        refused = list(self.refused)
        ranked = self._ranked(first)
        limit = _limit(ranked)
        beside = [s for s in ranked if s.p_value <= limit]
        best = self._contenders(first, beside, ranked) if beside else []
        both = self._first_accepted(current, best, limit)
        if both is None:
            self.refused = refused
            return None
        rivals = self._rivals(first, score, tried)
        candidate, second = self._whole(score, current.model), self.found.pop()
        self._keep(both, candidate, second.gain, score, rivals)
        self.found.append(second)
        label = candidate.label
        self.refused = [r for r in self.refused if r.name not in (label, second.candidate.label)]
        return both

    def _contenders(
        self, current: Fitted, significant: Sequence[Score], ranked: Sequence[Score]
    ) -> list[tuple[Score, Fitted]]:
        """The most promising candidates refitted, the best explanation first.

        With them those that may explain as much without being significant: they are not told apart.
        """
        best = best_of_each(significant, current)
        tried = self._refitted(current, best[:CONTENDERS])
        if not tried:
            return []
        winner, labels = tried[0][0], {s.candidate.label for s in best}
        rest = [s for s in ranked if s.candidate.label not in labels]
        near = best[CONTENDERS:] + best_of_each(rest, current)
        near = [s for s in near if s.freedom and as_promising(s, winner)]
        tried += self._refitted(current, near[:MORE])
        return by_evidence(tried)

    def _refitted(self, current: Fitted, chosen: Sequence[Score]) -> list[tuple[Score, Fitted]]:
        tried = [(score, self._with(current, score)) for score in chosen]
        found = by_evidence([(score, fitted) for score, fitted in tried if fitted is not None])
        if not found:
            return []
        best = found[0] = self._sharpened(current, *found[0])
        far = NEAR * (cost_of(current) - cost_of(best[1]))
        return [best] + [
            self._sharpened(current, *pair) if cost_of(pair[1]) - cost_of(best[1]) < far else pair
            for pair in found[1:]
        ]

    def _sharpened(self, current: Fitted, score: Score, fitted: Fitted) -> tuple[Score, Fitted]:
        """With the best level or moment near the one that was found: the grid is coarse."""
        held = held_value(score.candidate)
        if held is None:
            return score, fitted
        name, kind, value = held
        best, steps = (score, fitted), strides(kind, value, self.runs)
        for step in steps:
            for way in (-1, 1):
                for _ in range(STRIDES):
                    if not within(kind, value + way * step, self.runs, len(current.model.axes)):
                        break
                    moved = holding(score, name, value + way * step)
                    found = self._with(current, moved)
                    if found is None or cost_of(found) >= cost_of(best[1]):
                        break
                    best, value = (moved, found), value + way * step
        return best

    def _accepted(
        self, current: Fitted, score: Score, fitted: Fitted
    ) -> tuple[Fitted, Candidate, float] | None:
        """The fit without needless axes, its candidate and held-out gain; None if refused."""
        crossed = self._crossed(fitted)
        if crossed is None or not self._confirmed(current, crossed):
            self._refuse(
                score.candidate, "too small to matter here: held-out data do not confirm it"
            )
            return None
        why = _undetermined(Problem(crossed.model, self.runs), crossed.values)
        estimate = None if why else self._certified(crossed)
        if estimate is not None and not estimate.certificate.trusted:
            why = estimate.certificate.reasons[0]
        if estimate is None or why:
            self._refuse(score.candidate, f"its fit is refused: {why}")
            return None
        crossed = replace(crossed, values=estimate.values)
        pruned, candidate = self._plainer(*self._pruned(crossed, estimate, score))
        return pruned, candidate, self._gain(current, pruned)[0]

    def _keep(
        self,
        fitted: Fitted,
        candidate: Candidate,
        gained: float,
        score: Score,
        rivals: Mapping[str, Mapping[str, Array]],
    ) -> None:
        self.say(f"{candidate.label}: held-out error falls")
        names = tuple(p.name for p in candidate.parameters(fitted.model))
        self.found.append(Found(candidate, score, score.p_value, gained, names, rivals))

    def _refuse(self, candidate: Candidate, why: str) -> None:
        said = Skipped(candidate.label, why)
        if said not in self.refused:
            self.refused.append(said)

    def _gain(self, current: Fitted, better: Fitted) -> tuple[float, float]:
        """Held-out gain in mean squared error, and its standard error."""
        sigma = better.noise
        count = sum(r.size for r in better.held_out) / sigma**2
        gained, error = gain(current.held_out, better.held_out, self.folds, sigma)
        return gained / count, error / count

    def _confirmed(self, current: Fitted, better: Fitted) -> bool:
        gained, error = self._gain(current, better)
        return gained > HELD_OUT * error

    def _with(self, current: Fitted, score: Score) -> Fitted | None:
        """The model refitted with a candidate, from its first-order step."""
        try:
            candidate = self._whole(score, current.model)
            model = candidate.added_to(current.model)
            problem = Problem(model, self.runs)
            start = problem.point(current.values)
            moved = _stepped(problem, start, candidate, score)
            best = min((start, moved), key=lambda p: _finite(problem.cost(p)))
            fitted = self._fitted(model, problem.values(best))
        except (CasestError, np.linalg.LinAlgError) as error:
            self._refuse(score.candidate, f"its refit fails: {error}")
            return None
        if fitted is None:
            self._refuse(score.candidate, "its refit fails: the residual is not finite")
            return None
        return self._weighed(current, fitted, candidate)

    def _weighed(self, current: Fitted, fitted: Fitted, candidate: Candidate) -> Fitted:
        """With what could be left away of the candidate, and what it does to the others."""
        problem = weighted(Problem(fitted.model, self.runs), fitted.values)
        own = candidate.parameters(fitted.model)
        less = lighter(problem, problem.point(fitted.values), own, fitted.noise)
        names = [p.name for p in current.model.parameters if p.name in fitted.values]
        before = weighted(Problem(current.model, self.runs), current.values)
        there = before.point({**current.values, **{n: fitted.values[n] for n in names}})
        pairs = zip(before.residuals(there), current.residuals, strict=True)
        moved = sum(float(np.sum((a - b) ** 2)) for a, b in pairs) / fitted.noise**2
        return replace(fitted, lighter=less, moved=moved)

    def _whole(self, score: Score, model: Model) -> Candidate:
        """The candidate with its profile unknown again, on the axes where it does anything."""
        candidate = freed_again(score.candidate, self.original[score.candidate.label])
        if candidate.effect is None:
            return candidate
        kept = living_axes(score, model)
        if kept is None:
            return candidate
        effect = restricted(candidate.effect, kept, model)
        return replace(candidate, effect=effect, traced=None)

    def _pruned(self, fitted: Fitted, estimate: Estimate, score: Score) -> tuple[Fitted, Candidate]:
        """Without the axes on which the effect is nothing: an axis with nothing in it stays."""
        base = replace(fitted.model, effects=fitted.model.effects[:-1])
        candidate = self._whole(score, base)
        kept = significant_axes(candidate, estimate)
        if kept is None or candidate.effect is None:
            return fitted, candidate
        effect = restricted(candidate.effect, kept, fitted.model)
        smaller = replace(candidate, effect=effect, traced=None)
        try:
            again = self._crossed(
                self._fitted(smaller.added_to(base), narrowed(fitted.values, candidate, kept))
            )
        except CasestError:
            return fitted, candidate
        if again is None or self._confirmed(again, fitted):
            return fitted, candidate
        return again, smaller

    def _plainer(self, fitted: Fitted, candidate: Candidate) -> tuple[Fitted, Candidate]:
        """In the effect's plain form, where held-out data do not want more.

        What was held at a value of its grid is an unknown then.
        """
        effect = self.original[candidate.label].effect
        if effect is None or not effect.plain:
            return fitted, candidate
        held, label = held_value(candidate), candidate.label + "."
        begun = effect.starting(**{held[0]: held[2]}) if held else effect
        smaller = replace(candidate, effect=begun.holding(**dict(effect.plain)), traced=None)
        values = {n: v for n, v in fitted.values.items() if not n.startswith(label)}
        try:
            base = replace(fitted.model, effects=fitted.model.effects[:-1])
            again = self._crossed(self._fitted(smaller.added_to(base), values))
        except CasestError:
            return fitted, candidate
        if again is None or self._confirmed(again, fitted):
            return fitted, candidate
        estimate = self._certified(again)
        if not estimate.certificate.trusted:
            return fitted, candidate
        return replace(again, values=estimate.values), smaller

    def _filled(self, current: Fitted) -> Fitted:
        """Axes that were nothing beside what was still missing may be something now."""
        for k, found in enumerate(self.found[:-1]):
            fuller = self._on_all_axes(current, found)
            if fuller is None:
                continue
            current, candidate = fuller
            names = tuple(p.name for p in candidate.parameters(current.model))
            self.found[k] = replace(found, candidate=candidate, names=names)
        return current

    def _on_all_axes(self, current: Fitted, found: Found) -> tuple[Fitted, Candidate] | None:
        """The model with an effect on all the axes where it is something, if that is better."""
        if found.score is None or found.candidate.effect is None or not found.names:
            return None
        label = found.candidate.label
        declared = self.original[label].effect
        if declared is None or declared.plain:
            return None
        base = replace(
            current.model, effects=tuple(a for a in current.model.effects if a.label != label)
        )
        values = {k: v for k, v in current.values.items() if not k.startswith(label + ".")}
        try:
            whole = self._whole(found.score, base)
            model = whole.added_to(base)
            if Problem(model, self.runs).unknowns <= current.unknowns:
                return None
            fuller = self._crossed(self._fitted(model, values))
        except CasestError:
            return None
        if fuller is None or self._gain(current, fuller)[0] <= 0:
            return None
        estimate = self._certified(fuller)
        if not estimate.certificate.trusted:
            return None
        fuller = replace(fuller, values=estimate.values)
        pruned, candidate = self._pruned(fuller, estimate, found.score)
        if self._gain(current, pruned)[0] <= 0 or pruned.unknowns <= current.unknowns:
            return None
        return pruned, candidate

    def _weeded(self, current: Fitted) -> Fitted:
        """Each kept effect must still earn its place."""
        for found in list(self.found[:-1]):
            label = found.candidate.label
            if found.candidate.freed or not found.names:
                continue
            effects = tuple(a for a in current.model.effects if a.label != label)
            values = {k: v for k, v in current.values.items() if not k.startswith(label + ".")}
            model = replace(current.model, effects=effects)
            without = self._crossed(self._fitted(model, values))
            if without is not None and not self._confirmed(without, current):
                self.found.remove(found)
                self._refuse(found.candidate, "no longer needed beside what came later")
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


def _limit(ranked: Sequence[Score]) -> float:
    """The p-value up to which a candidate is significant, beside all others."""
    return FALSE_ALARM / max(len({s.candidate.label for s in ranked}), 1)


def _check_folds(before: Estimate, runs: Sequence[Run], folds: Folds) -> None:
    """Raise DataError where the rest of a record does not determine what a part is held out for.

    What a fit to the rest leaves uncertain of the part, in variances of the noise, is the trace
    of JᵀJ of the part times the inverse of that of the rest.
    """
    for k in range(folds.count):
        parts = [
            tuple(run.take((fold == k) == held) for run, fold in zip(runs, folds.of, strict=True))
            for held in (False, True)
        ]
        if any(len(run) == 0 for run in parts[0]) or not sum(map(len, parts[1])):
            continue  # the fits themselves say so
        rest, part = (Problem(before.model, p) for p in parts)
        words = "there are too few equations"
        if rest.residual_count >= rest.unknowns:
            words = _undetermined(rest, before.values)
        if not words:
            point = rest.point(before.values)
            own = part.normal(part.point(before.values)).matrix
            spread = float(np.trace(np.linalg.solve(rest.normal(point).matrix, own)))
            if spread < UNCERTAIN * part.residual_count:
                continue
            deviations = np.sqrt(spread / part.residual_count)
            words = f"the part is foretold to {deviations:.2g} standard deviations of the noise"
        raise DataError(
            f"without one part in {folds.count} of the record {words}; record more orientations, "
            "or each of them twice"
        )


def _undetermined(problem: Problem, values: Mapping[str, Array]) -> str:
    """What the data do not determine, in words: cheaper than to ask for a certificate."""
    point = problem.point(values)
    found = identify(problem, point, problem.factor(point)[0])
    if found.rank < found.unknowns:
        return f"not determined: {found.unobservable[0]}" if found.unobservable else "rank"
    if found.singular_values[-1] < PRACTICALLY_NULL * found.singular_values[0]:
        return f"practically not determined: {found.weakest}"
    return ""


__all__ = ["Closing", "Found", "close", "rms"]
