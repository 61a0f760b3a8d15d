"""The loop: fit, look at the residual, add what is missing, judged where the fit never looked."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.effect import RANDOM_WALK, TAILS, Attached, Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Constant
from casest.diagnose.candidates.candidates import Candidate, Skipped
from casest.diagnose.closing import Closing
from casest.diagnose.cross_validation import Folds, cross_fitted, determined, folded, rms
from casest.diagnose.evidence.linear import robust_sd
from casest.diagnose.evidence.score import Evidence
from casest.diagnose.found import HELD_OUT_DATA, Found, Undecided
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.left import predictions
from casest.diagnose.noise.slow_course import slow_squares
from casest.diagnose.noise.tails import outliers_p_value
from casest.diagnose.protocol import Kept, State, search, with_rivals
from casest.diagnose.protocol.choosing import NOT_HELD_OUT
from casest.diagnose.protocol.confirming import falls
from casest.diagnose.protocol.elimination import chance_alone
from casest.diagnose.protocol.ranking import ranked
from casest.diagnose.protocol.refits import AS_MUCH
from casest.diagnose.protocol.state import Ranking
from casest.diagnose.sensor import NOT_FINITE, Fit, Sensor
from casest.diagnose.sensor.courses import courses
from casest.diagnose.sensor.fits import problem_of
from casest.diagnose.sensor.unlike import another
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
from casest.leastsquares.weights import robust_scale

#: What no effect that is added could mend.
HOPELESS = Code.READING | Code.NOT_FINITE | Code.NO_REDUNDANCY | Code.NOT_DETERMINED

#: Why an effect is not kept that the last fit makes nothing of.
NO_SIZE = "in the end its size may as well be nothing"


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
        return _searched(before, model, catalogue, known, seed, say)
    error = NotTrusted("no trustworthy estimate: " + "; ".join(before.certificate.reasons))
    error.estimate = before
    if not before.certificate.code & HOPELESS:  # what is missing may be why
        closing = _searched(before, model, catalogue, known, seed, say)
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
    judged = before.model.having(**noises(after.model))
    hidden = cross_fitted(judged, closing.runs, before.values, closing.folds)
    sides = _on_the_same_samples(hidden, closing.after_held_out)
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
    catalogue: Sequence[Effect],
    known: Collection[str],
    seed: int,
    say: Callable[[str], None],
) -> Closing:
    """The loop from a declared fit."""
    with np.errstate(all="ignore"), one_thread(), only_tried():
        # Stated noise is that at this fit: a start knows no more than its own slopes.
        ready = prepared(model, before.problem.runs)
        try:
            folds = determined(before, ready, seed)
        except DataError as error:
            return _as_it_is(before, ready, str(error))
        # True values are pulled towards a model that lacks something: it is looked for as read.
        model = model.as_read
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
    declared = sensor.fitted(sensor.model, before.values)
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
    state = with_rivals(sensor, _without_events_of_a_course(sensor, state))
    after = before
    if state.fit is not declared:
        state, after = certified(sensor, state, before)
        # What was missing is no noise: parts that are held out are as long as what is left asks.
        if folds.count == LEVELS.refits:
            folds = folded(sensor.runs, after.correlated_over, sensor.seed)
    state, after, hidden = _foretelling(sensor, declared, state, before, after, folds)
    effects = [] if outliers is None else [outliers]
    effects += [_found(sensor, state, k, after) for k in state.kept]
    effects += [Found(Candidate(e), 0.0, 0.0) for e in _declared_walks(sensor)]
    return Closing(
        before,
        after,
        *_on_the_same_samples(*hidden),
        tuple(effects),
        tuple(sensor.tried.found(declared)[1]),
        _refused(sensor, state, declared),
        folds,
        seen,
        sensor.runs,
        _undecided(sensor, state),
        courses(sensor, state.fit, state.last) if state.last else (),
    )


def _without_events_of_a_course(sensor: Sensor, state: State[Fit]) -> State[Fit]:
    """Without events that explain less than the slow course they leave: slow noise has a largest
    excursion as well, and moments were looked for. The smallest goes first."""
    while events := [k for k in state.kept if _is_event(k) and not sensor.asked(k.what)]:
        least = min(events, key=lambda k: _fall(state.fit, k))
        less = sensor.without(state.fit, least.what)
        left = slow_squares(sensor.runs, state.fit.residuals)
        if less is None or _fall(state.fit, least) > left:
            break
        state = replace(_left_in(state, less), open=(least.evidence, *state.open))
        state = state.refusing(least.what, AS_MUCH)
        state = replace(state, last=ranked(sensor, less))
    return state


def _is_event(kept: Kept) -> bool:
    """Does it begin, or end, at a moment of its own?"""
    effect = kept.what.effect
    return effect is not None and "time" in dict(effect.profile).values()


def _foretelling(
    sensor: Sensor,
    declared: Fit,
    state: State[Fit],
    before: Estimate,
    after: Estimate,
    folds: Folds,
) -> tuple[State[Fit], Estimate, list[tuple[Array, ...]]]:
    """Without causes that came last, as long as held-out data are foretold no better with them.

    By fits that did not see their part: what columns or one refit promised may be another thing.
    What the user says is there stays. The last: held-out residuals before and after.
    """
    hidden = [held_out(sensor, fit, folds) for fit in (declared, state.fit)]
    while state.kept and not any(sensor.asked(k.what) for k in state.kept):
        less = sensor.without(state.fit, state.kept[-1].what)
        if less is None or _better(*_on_the_same_samples(*hidden)):
            break
        last = state.kept[-1].what
        state = _left_in(state, less).refusing(last, NOT_HELD_OUT)
        state, after = certified(sensor, state, before)
        hidden[1] = held_out(sensor, state.fit, folds)
    return state, after, hidden


def _better(before: Sequence[Array], after: Sequence[Array]) -> bool:
    """Are residuals smaller, counted as less where both are far out?"""
    there = [np.isfinite(b) for b in before]
    b, a = (
        np.abs(np.concatenate([r[k] for r, k in zip(x, there, strict=True)]))
        for x in (before, after)
    )
    nearer = np.minimum(a, b)
    beyond = nearer - np.minimum(nearer, LEVELS.far * robust_scale([b]))
    return bool(np.sum((a - beyond) ** 2) < np.sum((b - beyond) ** 2))


def _declared_walks(sensor: Sensor) -> list[Effect]:
    """What the user says of the noise: that the offset walks at random."""
    return [e for e in sensor.catalogue if e.seen_in == RANDOM_WALK and e.name in sensor.known]


def held_out(sensor: Sensor, fit: Fit, folds: Folds) -> tuple[Array, ...]:
    """Residuals (N, m) of each run, each from a fit that did not see its part."""
    problem, _ = problem_of(fit, sensor.runs)
    return cross_fitted(fit.model, problem.runs, fit.values, folds)


def _on_the_same_samples(
    before: tuple[Array, ...], after: tuple[Array, ...]
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """NaN in both where one of them foretells nothing."""
    there = [np.isfinite(b + a) for b, a in zip(before, after, strict=True)]
    one, other = (
        tuple(np.where(k, r, np.nan) for k, r in zip(there, several, strict=True))
        for several in (before, after)
    )
    return one, other


def spoilt(residuals: Sequence[Array]) -> bool:
    """Are most of the squares those of single samples, each far out between two that are not?"""
    total = alone = 0.0
    for r in residuals:
        far = np.abs(r - np.median(r, axis=0)) > LEVELS.clip * robust_sd(r)
        beside = np.zeros_like(far)
        beside[1:] |= far[:-1]
        beside[:-1] |= far[1:]
        total += float(np.sum(r**2))
        alone += float(np.sum(r[far & ~beside] ** 2))
    return alone > 0.5 * total


def without_outliers(
    sensor: Sensor, state: State[Fit], folds: Folds
) -> tuple[State[Fit], Found | None]:
    """With the effect `outliers` where there are some: they would pull what follows."""
    fit, effect = state.fit, next((e for e in sensor.catalogue if e.seen_in == TAILS), None)
    if effect is None or any(a.label == effect.name for a in fit.model.effects):
        return state, None
    problem, point = problem_of(fit, sensor.runs)
    levels = predictions(problem, point)
    p_value = outliers_p_value(fit.residuals, folds.batches, levels)
    if p_value is None:
        return state, None
    candidate = Candidate(effect)
    better = sensor.fitted(fit.model.with_effect(effect), fit.values)
    if better is None:
        return state.refusing(candidate, NOT_FINITE), None
    certificate = sensor.proved(better).certificate
    if not certificate.trusted:
        return state.refusing(candidate, f"its fit is refused: {certificate.reasons[0]}"), None
    return replace(state, fit=better), Found(candidate, p_value, 0.0)


def certified(sensor: Sensor, state: State[Fit], before: Estimate) -> tuple[State[Fit], Estimate]:
    """The last estimate, with intervals; without effects that leave one without an end.

    In the place of such a one comes what explains as much, if there is any.
    """
    while True:
        with only_tried(False):
            model = state.fit.model.having(**noises(sensor.model))  # as they are beside it
            model = model.at_true_values
            after = attempt(model, sensor.runs, start=state.fit.values, seed=sensor.seed)
        last, why = _at_fault(sensor, state, after)
        if not why:
            return state, after
        if last is None:
            return state, before
        state = state.refusing(last.what, why)
        instead = None if why == NO_SIZE else _replaced(sensor, state, last)
        if instead is not None:
            state = instead
            continue
        fit = sensor.without(state.fit, last.what)
        if fit is None:
            return state, before
        state = replace(_left_in(state, fit), open=(last.evidence, *state.open))


def _left_in(state: State[Fit], fit: Fit) -> State[Fit]:
    """At a fit with less in it: with a cause goes the lag of a column that it alone read."""
    there = {a.label for a in fit.model.effects}
    kept = tuple(k for k in state.kept if k.what.freed or k.what.label in there)
    return replace(state, fit=fit, kept=kept)


def _replaced(sensor: Sensor, state: State[Fit], kept: Kept) -> State[Fit] | None:
    """The state with the first rival of a cause in its place that is not refused at a glance.

    Its evidence stays that of the one that it replaces: they differ by little.
    """
    for k, rival in enumerate(kept.rivals):
        fit = sensor.replaced(state.fit, kept.what, rival.what, rival.fit)
        if fit is not None and not isinstance(sensor.certified(fit), str):
            other = replace(kept, what=rival.what, rivals=kept.rivals[k + 1 :])
            several = tuple(other if one is kept else one for one in state.kept)
            still = tuple(e for e in state.open if rival.what.label not in e.families)
            return replace(state, fit=fit, kept=several, open=still)
    return None


def _at_fault(sensor: Sensor, state: State[Fit], after: Estimate) -> tuple[Kept | None, str]:
    """Which cause a proved estimate speaks against, and why: one that is not what it is called, or
    where it is refused the one that the data determine least, else the last."""
    if not after.certificate.trusted:
        return _least(state, after), f"its fit is refused: {after.certificate.reasons[0]}"
    label, why = another(after.model, after.values, sensor.model)
    if not why:
        claimed = (a for k in reversed(state.kept) if not sensor.asked(k.what)
                   for a in after.model.effects if a.label == k.what.label)  # fmt: skip
        label = next((a.label for a in claimed if _is_nothing(a, after)), "")
        why = label and NO_SIZE
    return next((k for k in state.kept if k.what.label == label), None), why


def _is_nothing(attached: Attached, after: Estimate) -> bool:
    """Is each of an effect's sizes within two standard deviations of none, were noise alike
    everywhere? Then only rows that count less, or a colour of the noise, had spoken for it."""
    searched = dict(attached.effect.profile)
    sizes = [p.name for p in attached.parameters if p.name.rpartition(".")[2] not in searched]
    z = [np.abs(after.values[n]) / after.plain[n] for n in sizes if n in after.plain]
    return bool(z) and all(bool(np.all(one < LEVELS.apart)) for one in z)


def _least(state: State[Fit], after: Estimate) -> Kept | None:
    """The cause that has most of the direction of which the data say least, or is on a bound; the
    last one, where only the way to the solution is too long."""
    if after.certificate.code == Code.NOT_SETTLED:
        return state.kept[-1] if state.kept else None
    owner = {p.name: a.label for a in after.model.effects for p in a.parameters}
    at_bound = Code.BOUND in after.certificate.code
    direction = (~after.free).astype(float) if at_bound else after.identifiability.least
    parts = dict.fromkeys((k.what.label for k in state.kept), 0.0)
    for slot in after.problem.slots:
        label = owner.get(slot.parameter.name, "")
        if label in parts:
            parts[label] += float(np.sum(direction[slot.x] ** 2))
    # Of equal parts the last one.
    return max(reversed(state.kept), key=lambda k: parts[k.what.label], default=None)


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
    return Found(candidate, chance_alone(sensor, state, kept), fall, names, rivals)


def _fall(fit: Fit, kept: Kept) -> float:
    """By which an effect lets the mean square of what is held out fall."""
    ratio = kept.falls["pieces"].ratio
    return float((1 - ratio) / max(ratio, 1e-300) * fit.noise**2)


def _refused(sensor: Sensor, state: State[Fit], declared: Fit) -> tuple[Skipped, ...]:
    added = {k.what.label for k in state.kept}
    said = {r.what.label: r.why for r in reversed(state.refused) if r.what.label not in added}
    ranked = state.first.found if state.first else ()
    shown = {e.trials[0].family for e in ranked}
    asked, skipped = sensor.tried.unseen(declared, shown)
    return (
        *(Skipped(name, why) for name, why in said.items()),
        *asked,
        *(s for s in skipped if s.name not in said),
    )


def _visible(sensor: Sensor, declared: Fit) -> tuple[Visible, ...]:
    plain = [t for t in sensor.trials(declared) if not t.what.held]
    return visible(sensor.linear(declared), plain)


def _undecided(sensor: Sensor, state: State[Fit]) -> Undecided | None:
    """Strong evidence for causes that were not added."""
    if not state.open:
        return None
    best = state.open[0]
    # Of a pair each explains something beside the other: neither does alone what both do.
    alone = [e for e in state.open if len(e.trials) == 1] or state.open[:1]
    there = {k.what.label for k in state.kept}
    names = tuple(dict.fromkeys(n for e in alone for n in e.families if n not in there))
    if not names:
        return None
    moves = {
        r.evidence.families[0]: sensor.moved_by(r.before, r.fit)
        for r in state.torn
        if len(r.evidence.families) == 1  # of a pair none moves them alone
    }
    return Undecided(names, _share(best, state.last), moves)


def _share(best: Evidence, last: Ranking | None) -> float:
    """Of the held-out squares, that a cause takes away: in coloured noise its likelihood is no
    share, and what is likeliest there lets the squares be what they are."""
    if last is None or len(best.basis) != last.linear.residual.size:
        return 0.0
    return max(0.0, 1 - falls(last, best)["pieces"].ratio)


__all__ = ["Closing", "Found", "close", "rms"]
