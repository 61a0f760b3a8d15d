"""The last proof of what the loop added: without what leaves an estimate no end, or no size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import fdtrc

from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Index
from casest.diagnose.formula.search import NAME as FORMULA
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol import Kept, State
from casest.diagnose.protocol.elimination import (
    chance_alone,
    chance_in_rows,
    on_its_own,
)
from casest.diagnose.protocol.ranking import ranked
from casest.diagnose.protocol.state import ANOTHER, Rival
from casest.diagnose.sensor.fits import Fit
from casest.diagnose.sensor.sensor import Sensor
from casest.diagnose.sensor.unlike import another
from casest.engine.kernel import only_tried
from casest.estimate.calibrate import attempt
from casest.estimate.estimate import Estimate
from casest.estimate.reasons import Code
from casest.leastsquares.kinds import noises

#: Why an effect is not kept that the last fit makes nothing of.
NO_SIZE = "beside what is left unexplained its size may be chance"


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
        if ANOTHER in why:
            state = replace(state, gone=state.gone | {last.what.label})
        # What may be nothing by its own size explains as much all the same.
        still = (Rival(last.what, state.fit),) if why == NO_SIZE else ()
        instead = _replaced(sensor, state, last, still)
        if instead is not None:
            state = instead
            continue
        fit = sensor.without(state.fit, last.what)
        if fit is None:
            return state, before
        # What it leaves, it explains again: what has a name, under that name, and its rivals.
        beside = ranked(sensor, fit)
        others = {rival.what.label for rival in last.rivals}
        rivals = (e for e in beside.found if others.issuperset(e.families))
        nameless = ANOTHER in why or last.what.label == FORMULA
        # Of a pair the evidence is both's.
        again = tuple(e for e in beside.found if e.families == (last.what.label,))
        own = (*rivals,) if nameless else (*(again or (last.evidence,)), *rivals)
        state = replace(left_in(state, fit), open=(*own, *state.open), last=beside)


def left_in(state: State[Fit], fit: Fit) -> State[Fit]:
    """At a fit with less in it: with a cause goes the lag of a column that it alone read."""
    there = {a.label for a in fit.model.effects} | {p.name for p in fit.model.parameters}
    kept = tuple(k for k in state.kept if k.what.label in there)
    return replace(state, fit=fit, kept=kept)


def _replaced(
    sensor: Sensor, state: State[Fit], kept: Kept, still: tuple[Rival, ...]
) -> State[Fit] | None:
    """The state with the first rival of a cause in its place that is not refused, and has strong
    evidence of its own; `still`: more that are its rivals."""
    refused = [r.what for r in state.refused]
    for k, rival in enumerate(kept.rivals):
        fit = sensor.replaced(state.fit, kept.what, rival.what, rival.fit)
        if rival.what in refused or fit is None or isinstance(sensor.certified(fit), str):
            continue
        other = replace(kept, what=rival.what, rivals=(*still, *kept.rivals[k + 1 :]))
        several = tuple(other if one is kept else one for one in state.kept)
        others = tuple(e for e in state.open if rival.what.label not in e.families)
        found = replace(state, fit=fit, kept=several, open=others)
        score, chance = on_its_own(sensor, found, other) or (-np.inf, 1.0)
        if score > (LEVELS.strong if sensor.linear(fit).series else 0.0):
            own = replace(other, evidence=replace(other.evidence, p_value=chance))
            return replace(found, kept=tuple(own if one is other else one for one in several))
    return None


def _at_fault(sensor: Sensor, state: State[Fit], after: Estimate) -> tuple[Kept | None, str]:
    """Which cause a proved estimate speaks against, and why: one that is not what it is called, or
    where it is refused the one that the data determine least, else the last."""
    if not after.certificate.trusted:
        return _least(state, after), f"its fit is refused: {after.certificate.reasons[0]}"
    label, why = another(after.model, after.values, sensor.model)
    if not why:
        claimed = [k for k in reversed(state.kept) if not sensor.asked(k.what)]
        chances = [(_chance_of_nothing(sensor, state, k, after), k.what.label) for k in claimed]
        chance, label = max(chances, key=lambda c: c[0], default=(0.0, ""))
        label = label if chance > LEVELS.chance else ""
        why = label and NO_SIZE
    return next((k for k in state.kept if k.what.label == label), None), why


def _chance_of_nothing(sensor: Sensor, state: State[Fit], kept: Kept, after: Estimate) -> float:
    """The chance of a cause as it is printed; one where each of its sizes is within two standard
    deviations of none, were noise alike everywhere: then only rows that count less, or a colour of
    the noise, had spoken for it. Of a formula each term is one more that was looked for: none may
    be nothing."""
    names, none = _sizes(kept.what.label, after), _none(sensor, kept)
    z = [np.abs(after.values[n] - none) / after.plain[n] for n in names if n in after.plain]
    if z and all(bool(np.all(one < LEVELS.apart)) for one in z):
        return 1.0
    if kept.what.name == FORMULA:
        z = [np.abs(after.values[n]) / after.std[n] for n in names]
        if any(bool(np.any(one < LEVELS.apart)) for one in z):
            return 1.0
    return printed_chance(sensor, state, kept, after)


def chance_of_sizes(label: str, after: Estimate, none: float = 0.0) -> float:
    """The chance of a cause's sizes by the standard deviations that are printed of them; 0 of one
    that has none. A likelihood beside slow noise weighs what is quick, they weigh all of it.

    `none`: the size at which it is none.
    """
    own = _places(_sizes(label, after), after)
    C = after.covariance[np.ix_(own, own)]
    if not own.size or not np.isfinite(C).all():
        return 0.0
    freedom = float(np.array(after.effective_freedom)[own].min())
    return _by_chance(after.point.x[own] - none, C, freedom)


def printed_chance(sensor: Sensor, state: State[Fit], kept: Kept, after: Estimate) -> float:
    """The chance of a cause beside the others: no less than that of its sizes, or of one that has
    none, in rows without a time, than what rows that are alike leave of it."""
    label = kept.what.label
    if _sizes(label, after):
        least = chance_of_sizes(label, after, _none(sensor, kept))
    else:
        least = chance_in_rows(sensor, state, kept, after.correlated_over)
    return max(least, chance_alone(sensor, state, kept))


def _none(sensor: Sensor, kept: Kept) -> float:
    """The size at which a cause is none: of a constant that is wrong, what was declared."""
    held = sensor.model[kept.what.freed].array if kept.what.freed else np.zeros(())
    return float(held) if not held.ndim else 0.0


def _sizes(label: str, after: Estimate) -> set[str]:
    """Parameters of a cause that are none where it is none: those that are searched over a grid
    only where there are no others (a lag)."""
    attached = next((a for a in after.model.effects if a.label == label), None)
    if attached is None:
        return {label} & set(after.values)
    searched, null = dict(attached.effect.profile), attached.effect.null_of
    own = {p.name: p.name.rpartition(".")[2] for p in attached.parameters}
    sizes = {name for name, word in own.items() if word not in searched}
    return sizes or {name for name, word in own.items() if null(word) == 0}


def _places(names: set[str], after: Estimate) -> Index:
    """Numbers of the unknowns of these parameters."""
    own = [np.arange(s.x.start, s.x.stop) for s in after.problem.slots if s.parameter.name in names]
    return np.concatenate([*own, np.zeros(0, int)])


def _by_chance(values: Array, covariance: Array, freedom: float) -> float:
    """The chance of values (k,) that far from none, by their F test; 0 of what is exact."""
    if not np.diag(covariance).any() and values.any():
        return 0.0
    F = float(values @ np.linalg.lstsq(covariance, values, rcond=1e-12)[0]) / len(values)
    return float(fdtrc(len(values), max(freedom, 1.0), max(F, 0.0)))


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
