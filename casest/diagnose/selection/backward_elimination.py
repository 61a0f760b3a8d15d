"""The end: axes that became something, effects that became nothing, the proof of the rest."""

from __future__ import annotations

from dataclasses import replace

from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.selection.acceptance import pruned
from casest.diagnose.selection.found import Found
from casest.diagnose.selection.model_evidence import Fitted
from casest.diagnose.selection.refit import whole
from casest.diagnose.selection.state import Work
from casest.engine.kernel import only_tried
from casest.errors import CasestError
from casest.estimate.calibrate import Estimate, attempt
from casest.leastsquares.problem import Problem


def on_all_axes(work: Work, current: Fitted) -> Fitted:
    """Axes that were nothing beside what was still missing may be something now."""
    for k, found in enumerate(work.found[:-1]):
        fuller = _on_all_axes(work, current, found)
        if fuller is None:
            continue
        current, candidate = fuller
        names = tuple(p.name for p in candidate.parameters(current.model))
        work.found[k] = replace(found, candidate=candidate, names=names)
    return current


def _on_all_axes(work: Work, current: Fitted, found: Found) -> tuple[Fitted, Candidate] | None:
    """The model with an effect on all the axes where it is something, if that is better."""
    if found.score is None or found.candidate.effect is None or not found.names:
        return None
    label = found.candidate.label
    declared = work.original[label].effect
    if declared is None or declared.plain:
        return None
    base, values = current.without(label)
    try:
        candidate = whole(work, found.score, base)
        model = candidate.added_to(base)
        if Problem(model, work.runs).unknowns <= current.unknowns:
            return None
        fuller = work.crossed(work.fitted(model, values))
    except CasestError:
        return None
    if fuller is None or work.gain(current, fuller)[0] <= 0:
        return None
    estimate = work.certified(fuller)
    if not estimate.certificate.trusted:
        return None
    fuller = replace(fuller, values=estimate.values)
    slim, candidate = pruned(work, fuller, estimate, found.score)
    if work.gain(current, slim)[0] <= 0 or slim.unknowns <= current.unknowns:
        return None
    return slim, candidate


def backward_eliminated(work: Work, current: Fitted) -> Fitted:
    """Each kept effect must still earn its place."""
    for found in list(work.found[:-1]):
        label = found.candidate.label
        if found.candidate.freed or not found.names:
            continue
        without = work.crossed(work.fitted(*current.without(label)))
        if without is not None and not work.confirmed(without, current):
            work.found.remove(found)
            work.refuse(found.candidate, "no longer needed beside what came later")
            current = without
    return current


def certified(work: Work, current: Fitted) -> tuple[Fitted, Estimate]:
    """The last estimate, with intervals; without effects that leave one without an end."""
    while work.found:
        with only_tried(False):
            after = attempt(current.model, work.runs, start=current.values, seed=work.seed)
        if after.certificate.trusted:
            return current, after
        last = work.found.pop()
        work.refuse(last.candidate, f"its fit is refused: {after.certificate.reasons[0]}")
        left = {f.candidate.label for f in work.found}
        added = current.model.effects[len(work.before.model.effects) :]
        kept = work.before.model.effects + tuple(a for a in added if a.label in left)
        base = work.before.model if last.candidate.freed else current.model
        model = replace(base, effects=kept)
        names = {p.name for p in model.parameters}
        values = {name: v for name, v in current.values.items() if name in names}
        without = work.crossed(work.fitted(model, values))
        if without is None:
            break
        current = without
    return current, work.before
