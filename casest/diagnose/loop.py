"""The loop: fit, look at the residual, add what is missing, judged where the fit never looked."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.effect import RANDOM_WALK, Effect
from casest.declaration.model import Model
from casest.declaration.symbols import Constant
from casest.diagnose.candidates.candidates import Candidate, Skipped
from casest.diagnose.closing import Closing
from casest.diagnose.cross_validation import Folds, cross_fitted, determined, folded
from casest.diagnose.evidence.score import Evidence, Trial
from casest.diagnose.found import HELD_OUT_DATA, Found, Undecided
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.left import refused_for
from casest.diagnose.noise.slow_course import slow_squares
from casest.diagnose.protocol import Kept, State, search, with_rivals
from casest.diagnose.protocol.confirming import falls_of_refit
from casest.diagnose.protocol.ranking import ranked
from casest.diagnose.protocol.refits import AS_MUCH
from casest.diagnose.sensor import Fit, Sensor
from casest.diagnose.sensor.courses import courses
from casest.diagnose.sensor.final import certified, chance_of_sizes, left_in, printed_chance
from casest.diagnose.sensor.foretelling import foretelling, on_the_same_samples
from casest.diagnose.sensor.outliers import spoilt, without_outliers
from casest.diagnose.sensor.to_both_sides import of_inputs
from casest.diagnose.visibility import Visible, visible
from casest.effects import CATALOGUE
from casest.effects.placing import prepared
from casest.engine.kernel import only_tried
from casest.engine.threads import one_thread
from casest.errors import DataError, NotTrusted
from casest.estimate.calibrate import attempt
from casest.estimate.estimate import Estimate
from casest.estimate.reasons import Code
from casest.leastsquares.kinds import noises

#: What no effect that is added could mend.
HOPELESS = Code.READING | Code.NOT_FINITE | Code.NO_REDUNDANCY | Code.NOT_DETERMINED


def close(
    model: Model,
    runs: Sequence[Run],
    *,
    catalogue: Sequence[Effect] = CATALOGUE,
    start: Mapping[str, Any] | None = None,
    known: Collection[str] = (),
    seed: int = 0,
    say: Callable[[str], None] = lambda _: None,
) -> Closing:
    """Fit, trace the residual to effects of the catalogue, add those that held-out data confirm.

    Where several causes explain the data alike, those that are `known` to be there come first: by
    name, or as `temperature_bias(temp)`. Where nothing can be held out, nothing is added, and
    `refused` says so. Raises NotTrusted, with the refused estimate, where the declared model itself
    has no trustworthy fit, and what it lacks is not found either.
    """
    closing = _once(model, runs, catalogue, start, known, seed, say)
    if all(noises(model).values()):
        return closing
    return _noises_anew(
        closing,
        model,
        catalogue,
        lambda wide, ready: _once(wide, ready, catalogue, None, known, seed, say),
    )


def _once(
    model: Model,
    runs: Sequence[Run],
    catalogue: Sequence[Effect],
    start: Mapping[str, Any] | None,
    known: Collection[str],
    seed: int,
    say: Callable[[str], None],
) -> Closing:
    before = attempt(model, runs, start=start, seed=seed)
    if before.certificate.trusted:
        return _searched(before, model, runs, catalogue, known, seed, say)
    error = NotTrusted("no trustworthy estimate: " + refused_for(before))
    error.estimate = before
    if not before.certificate.code & HOPELESS:  # what is missing may be why
        closing = _searched(before, model, runs, catalogue, known, seed, say)
        if closing.effects and closing.after.certificate.trusted:
            return closing
    raise error


def _noises_anew(
    closing: Closing,
    model: Model,
    catalogue: Sequence[Effect],
    again: Callable[[Model, Sequence[Run]], Closing],
) -> Closing:
    """The loop where residuals have noises of their own, which were found beside what is missing.

    With the first cause in the model they are found anew, and what else is missing is looked for
    with those; and so on, until nothing is.
    """
    first, added = closing, list[Found]()
    while cause := next((f for f in closing.effects if not f.of_noise), None):
        whole = _on_all_axes(cause.candidate, catalogue)
        model = whole.added_to(model)
        try:
            closing = again(model, closing.runs)
        except NotTrusted:
            break
        names = tuple(p.name for p in whole.parameters(model))
        added.append(replace(cause, candidate=whole, names=names))
    if not added:
        return closing
    before, after = first.before, closing.after
    # What is printed of them is this fit's: its noises are others, and outliers may have gone.
    least = [chance_of_sizes(f.candidate.label, after) for f in added]
    added = [replace(f, p_value=max(f.p_value, p)) for f, p in zip(added, least, strict=True)]
    judged = before.model.having(**noises(after.model))
    hidden = cross_fitted(judged, closing.runs, before.values, closing.folds)
    sides = on_the_same_samples(hidden, closing.after_held_out)
    return replace(
        closing,
        before=before,
        before_held_out=sides[0],
        after_held_out=sides[1],
        effects=(*added, *closing.effects),
    )


def _on_all_axes(what: Candidate, catalogue: Sequence[Effect]) -> Candidate:
    """A cause on every axis, as the catalogue has it: on which it shows hangs on the noises."""
    own = what.effect
    whole = next((e for e in catalogue if own is not None and e.name == own.name), None)
    if own is None or whole is None:
        return what
    told = {
        n: float(d.array) for n, d in own.declarations if isinstance(d, Constant) and not d.dims
    }
    return replace(what, effect=replace(whole, on=own.on).holding(**told), held=(), traced=None)


def _searched(
    before: Estimate,
    model: Model,
    runs: Sequence[Run],
    catalogue: Sequence[Effect],
    known: Collection[str],
    seed: int,
    say: Callable[[str], None],
) -> Closing:
    """The loop from a declared fit."""
    with np.errstate(all="ignore"), one_thread(), only_tried():
        # Stated noise is that at this fit: a start knows no more than its own slopes.
        ready = prepared(model, runs if model.noise is None else before.problem.runs)
        try:
            folds = determined(before, ready, seed)
        except DataError as error:
            return _as_it_is(before, ready, str(error))
        # True values are pulled towards a model that lacks something: it is looked for as read.
        if model.noise is not None:  # in the units that its residuals are told in
            model = replace(model, noise=before.model.noise).as_read
        sensor = Sensor(model, ready, tuple(catalogue), frozenset(known), seed)
        return _closed(sensor, before, folds, say)


def _as_it_is(before: Estimate, runs: tuple[Run, ...], why: str) -> Closing:
    """The declared model, where nothing can be held out to judge another by."""
    nothing = tuple(np.full((len(run), len(before.model.axes)), np.nan) for run in runs)
    folds = Folds(tuple(np.zeros(len(r), dtype=np.int_) for r in runs),
                  tuple(np.zeros(1, dtype=np.int_) for _ in runs), 0)  # fmt: skip
    refused = (Skipped(HELD_OUT_DATA, why),)
    return Closing(before, before, nothing, nothing, (), (), refused, folds, (), runs)


def _closed(sensor: Sensor, before: Estimate, folds: Folds, say: Callable[[str], None]) -> Closing:
    declared = sensor.fitted(before.model.as_read, before.values)
    if declared is None:
        raise NotTrusted("the residual is not finite at the optimum")
    # First, while what is tried beside it is at hand.
    seen, state, outliers = _visible(sensor, declared), State(declared), None
    if spoilt(declared.residuals):
        state, outliers = without_outliers(sensor, state, folds)
    first = state = search(sensor, state.fit, say, state)
    # What is missing may look like outliers, not they like it: far residuals count as less.
    if outliers is None:
        state, outliers = without_outliers(sensor, state, folds)
    if state is not first:
        state = search(sensor, state.fit, say, state)
    state, after = _proved(sensor, state, declared, before)
    if state.gone and not state.kept:
        state, after = _proved(sensor, search(sensor, state.fit, say, state), declared, before)
    if state.fit is not declared and folds.count == LEVELS.refits:
        # What was missing is no noise: parts that are held out are as long as what is left asks.
        folds = folded(sensor.runs, after.correlated_over, sensor.seed)
    state, after, hidden = foretelling(sensor, declared, state, before, after, folds)
    effects = [] if outliers is None else [outliers]
    effects += [_found(sensor, state, k, after) for k in state.kept]
    effects += [Found(Candidate(e), 0.0, 0.0) for e in _declared_walks(sensor)]
    return Closing(
        before,
        after,
        *on_the_same_samples(*hidden),
        tuple(effects),
        tuple(sensor.tried.found(declared)[1]),
        _refused(sensor, state, declared),
        folds,
        seen,
        sensor.runs,
        _undecided(sensor, state),
        courses(sensor, state.fit, state.last) if state.last else (),
        of_inputs(state.fit, sensor.rows),
    )


def _proved(
    sensor: Sensor, state: State[Fit], declared: Fit, before: Estimate
) -> tuple[State[Fit], Estimate]:
    """The end of a search: rivals of what was added, and the estimate with it."""
    alone = _without_events_of_a_course(sensor, state)
    state = with_rivals(sensor, alone)
    if state.fit is declared:
        return state, before
    proved, after = certified(sensor, state, before)
    if 0 < len(proved.kept) < len(state.kept):
        # What stays was judged beside what went.
        there = {id(r) for r in alone.refused}
        stale = {id(r) for r in state.refused if id(r) not in there}
        others = tuple(r for r in proved.refused if id(r) not in stale)
        proved = with_rivals(sensor, replace(proved, refused=others))
    return proved, after


def _without_events_of_a_course(sensor: Sensor, state: State[Fit]) -> State[Fit]:
    """Without events that explain less than the slow course they leave: slow noise has a largest
    excursion as well, and moments were looked for. The smallest goes first."""
    while events := [k for k in state.kept if _is_event(k) and not sensor.asked(k.what)]:
        least = min(events, key=lambda k: _fall(state.fit, k))
        less = sensor.without(state.fit, least.what)
        left = slow_squares(sensor.runs, state.fit.residuals)
        if less is None or _fall(state.fit, least) > left:
            break
        state = replace(left_in(state, less), open=(least.evidence, *state.open))
        state = state.refusing(least.what, AS_MUCH)
        state = replace(state, last=ranked(sensor, less))
    return state


def _is_event(kept: Kept) -> bool:
    """Does it begin, or end, at a moment of its own?"""
    effect = kept.what.effect
    return effect is not None and "time" in dict(effect.profile).values()


def _declared_walks(sensor: Sensor) -> list[Effect]:
    """What the user says of the noise: that the offset walks at random."""
    return [e for e in sensor.catalogue if e.seen_in == RANDOM_WALK and e.name in sensor.known]


def _found(sensor: Sensor, state: State[Fit], kept: Kept, after: Estimate) -> Found:
    """An added effect with its evidence, and what would have been in its place."""
    candidate: Candidate = sensor.final(state.fit, kept.what)
    names = tuple(p.name for p in candidate.parameters(after.model))
    fall = _fall(state.fit, kept)
    added = {k.what.label for k in state.kept}
    rivals = {
        r.what.label: sensor.moved_by(state.fit, r.fit)
        for r in kept.rivals
        if r.what.label not in added
    }
    chance = printed_chance(sensor, state, kept, after)
    return Found(candidate, chance, fall, names, rivals)


def _fall(fit: Fit, kept: Kept) -> float:
    """By which an effect lets the mean square of what is held out fall."""
    ratio = kept.falls["pieces"].ratio
    return float((1 - ratio) / max(ratio, 1e-300) * fit.noise**2)


def _refused(sensor: Sensor, state: State[Fit], declared: Fit) -> tuple[Skipped, ...]:
    added = {k.what.label for k in state.kept}
    several = sorted(reversed(state.refused), key=lambda r: not sensor.asked(r.what))
    said = {r.what.label: r.why for r in several if r.what.label not in added}
    asked, skipped = sensor.tried.unseen(declared, _shown(state))
    absent = [s for s in skipped if s.name not in said]
    before = {s.name for s in (*asked, *absent)}
    others = (Skipped(name, why) for name, why in said.items() if name not in before)
    return (*asked, *absent, *others)


def _shown(state: State[Fit]) -> set[str]:
    """What has something to show beside the declared unknowns."""
    return {e.trials[0].family for e in state.first.found} if state.first else set()


def _visible(sensor: Sensor, declared: Fit) -> tuple[Visible, ...]:
    plain = [t for t in sensor.trials(declared) if not t.what.held]
    return visible(sensor.linear(declared), plain)


def _undecided(sensor: Sensor, state: State[Fit]) -> Undecided | None:
    """Strong evidence for causes that were not added."""
    if not state.open:
        return None
    # Of a pair each explains something beside the other: neither does alone what both do.
    alone = [e for e in state.open if len(e.trials) == 1] or _first_of(sensor, state)
    there = {k.what.label for k in state.kept}
    unlike = {r.what.label for r in state.refused if r.another}
    shares = dict[tuple[str, ...], float]()
    for evidence in (e for e in alone if not there.issuperset(e.families)):
        if unlike.intersection(t.what.label for t in evidence.trials):
            continue
        share = _share(sensor, state, evidence.trials)
        if share is not None:
            shares[evidence.families] = share
        elif len(evidence.trials) > 1:  # both may stand in for the model where one does not
            parts = {(t.family,): _share(sensor, state, [t]) for t in evidence.trials}
            shares |= {family: one for family, one in parts.items() if one is not None}
    most = max(shares.values(), default=0.0)
    # None that leaves twice as much as the best.
    least = max(LEVELS.nested * most, 1 - (1 - most) / LEVELS.most)
    several = sorted(shares.items(), key=lambda one: -one[1])
    shares = {families: share for families, share in several if share >= least}
    names = tuple(dict.fromkeys(n for families in shares for n in families if n not in there))
    if not names:
        return None
    moves = {
        r.evidence.families[0]: sensor.moved_by(r.before, r.fit)
        for r in state.torn
        if len(r.evidence.families) == 1  # of a pair none moves them alone
    }
    return Undecided(names, next(iter(shares.values())), moves)


def _first_of(sensor: Sensor, state: State[Fit]) -> tuple[Evidence, ...]:
    """The first pair that is open and has a refit; the first of all where none has."""
    refits = ((e, sensor.refit(state.fit, e.trials)) for e in state.open)
    there = next((e for e, fit in refits if not isinstance(fit, str)), None)
    return state.open[:1] if there is None else (there,)


def _share(sensor: Sensor, state: State[Fit], trials: Sequence[Trial]) -> float | None:
    """Of the held-out squares, that a cause takes away when it is refitted: its columns promise
    what no refit may keep, and in coloured noise a likelihood is no share. None without a refit."""
    fit = sensor.refit(state.fit, trials)
    if isinstance(fit, str):
        return None
    before, after = sensor.linear(state.fit), sensor.linear_in(state.fit, fit)
    if before.residual.shape != after.residual.shape:
        return 0.0
    return max(0.0, 1 - falls_of_refit(before, after)["pieces"].ratio)


__all__ = ["Closing", "Found", "close"]
