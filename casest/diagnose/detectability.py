"""What the loop says beside the numbers: what stays invisible, what would have been seen, what is
left unexplained."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casest.declaration.model import Model
from casest.declaration.symbols import Parameter
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.typical import largest_of, typical_sizes
from casest.diagnose.closing import Closing
from casest.diagnose.levels import LEVELS
from casest.diagnose.noise.attenuation import attenuated
from casest.diagnose.visibility import Visible
from casest.effects.placing import prepared
from casest.leastsquares.problem import Problem


@dataclass(frozen=True)
class Invisible:
    """An effect that these data cannot show: a typical size of it would move parameters unseen.

    `would_move`: largest shift of each declared parameter, in its own unit; `share` how much of
    the effect's own trace in the data survives beside the declared parameters.
    """

    name: str
    column: str | None
    typical: Mapping[str, float]
    would_move: Mapping[str, float]
    share: float
    shown_by: str
    units: Mapping[str, str]  # of `typical`, with placeholders


@dataclass(frozen=True)
class Detectable:
    """The smallest size of an effect's parameter that would nearly always have been found."""

    name: str
    parameter: str
    size: float
    unit: str


def invisible(closing: Closing) -> list[Invisible]:
    """Candidates whose typical size the data could not have shown."""
    model, added = closing.before.model, {f.candidate.label for f in closing.effects}
    found: dict[str, Invisible] = {}
    largest = largest_of(closing.before.problem, closing.before.point)
    for score in closing.visible:
        candidate = score.candidate
        if candidate.label in added or candidate.label in found:
            continue
        parameters = _own(candidate, model)
        typical = typical_sizes(candidate, parameters, model, largest)
        if typical is None or len(typical) > len(score.survives):
            continue
        seen = np.diag(score.information)[: len(typical)] * typical**2
        hidden = (seen < LEVELS.unseen) | (score.survives[: len(typical)] < LEVELS.survives)
        moves = _moves(closing, score, typical, hidden)
        if hidden.any() and moves:
            names = [p.name.rpartition(".")[2] for p in parameters]
            place = f"@{candidate.on}" if candidate.declared_on else ""
            found[candidate.label] = Invisible(
                candidate.name + place,
                candidate.column,
                dict(zip(names, _sizes(parameters, typical), strict=True)),
                moves,
                float(score.survives[: len(typical)][hidden].max()),
                _shown_by(candidate),
                {n: p.units[0] for n, p in zip(names, parameters, strict=True)},
            )
    several = [*found.values(), *_noise_of_inputs(closing)]
    # What would do most harm comes first; shares that are rounding say nothing of order.
    return sorted(several, key=lambda i: -_harm(closing, i))


def _noise_of_inputs(closing: Closing) -> Iterator[Invisible]:
    """Inputs whose own noise would have moved declared parameters."""
    if not closing.after.certificate.trusted:
        return
    declared = {p.name for p in closing.before.model.parameters}
    for name, size, moved in attenuated(closing.after):
        moves = {n: shift for n, shift in moved.items() if n in declared}
        if moves:
            shown_by = f"its scatter where it is held, stated as --sensor-noise {name}=STD"
            unit = closing.after.model[name].unit or f"[{name}]"
            yield Invisible(f"noise of {name}", None, {"std": size}, moves, 1.0, shown_by,
                            {"std": unit})  # fmt: skip


def beyond_their_ends(closing: Closing) -> Iterator[str]:
    """Thresholds that were added and beyond which all lies, on one side: what they are there."""
    added = {f.candidate.label for f in closing.effects}
    model, values = closing.after.model, closing.after.values
    for attached in (a for a in model.effects if a.label in added):
        ends = [n for n, kind in attached.effect.profile if kind in ("band", "threshold")]
        width = values.get(f"{attached.label}.{ends[0]}") if ends else None
        less = replace(model, effects=tuple(a for a in model.effects if a is not attached))
        place = less.along.quantities.get(attached.on)
        if width is None or place is None or np.min(width) <= 0:
            continue
        problem = Problem(less, prepared(less, closing.after.problem.runs))
        point = problem.point(less.among(values))
        met = [found[0][:, :, 0] for found in problem.evaluate(point, {"q": place.value})]
        every = np.concatenate(met)
        if np.all(every > width) or np.all(every < -width):
            size = ", ".join(f"{w:.4g}" for w in np.atleast_1d(width))
            yield (
                f"all of {attached.on} lies beyond the width of {attached.label}, on one side: "
                f"there it is an offset of {attached.on}, by {size}"
            )


def noise_of_inputs_in(closing: Closing) -> Iterator[str]:
    """How much of what is left is noise of the inputs, where that counts."""
    names = inputs_that_may_be_noisy(closing)
    if closing.averaged > LEVELS.most and names:
        said = " or ".join(names)
        yield (
            f"{100 * closing.averaged:.0f} % of what is left goes with how {said} differs from its "
            f"rows before and after: noise of {said}, or readings that were averaged"
        )


def inputs_that_may_be_noisy(closing: Closing) -> list[str]:
    """Names of what is recorded beside the reading, but for the time."""
    model = closing.after.model
    plain = [s.name for s in model.signals if s.kind == "plain" and s.name != "t"]
    return [name for name in plain if name not in model.traced.readings]


def _harm(closing: Closing, hidden: Invisible) -> float:
    """Largest unseen shift in standard deviations of the parameter, two digits."""
    std = {n: s[s > 0] for n, s in closing.before.std.items()}  # the rest is zero by its shape
    shifts = [v / float(np.min(std[n], initial=np.inf)) for n, v in hidden.would_move.items()]
    return float(f"{max(shifts, default=0.0):.2g}")


def _own(candidate: Candidate, model: Model) -> list[Parameter]:
    return candidate.parameters(candidate.added_to(model))


def _sizes(parameters: Sequence[Parameter], typical: np.ndarray) -> Iterator[float]:
    place = 0
    for p in parameters:
        yield float(typical[place])
        place += p.shape.coordinates


def _shown_by(candidate: Candidate) -> str:
    if candidate.effect is not None:
        return candidate.effect.shown_by
    return f"an independent measurement of {candidate.freed}, or a second setting of the motion"


def _moves(
    closing: Closing, score: Visible, typical: np.ndarray, hidden: np.ndarray
) -> dict[str, float]:
    """Shift of each declared parameter by a typical size of what is hidden, where it matters."""
    problem, std = closing.before.problem, np.sqrt(np.diag(closing.before.covariance))
    shift = np.abs(score.bias[:, : len(typical)] * typical)[:, hidden].max(axis=1, initial=0.0)
    found: dict[str, float] = {}
    for slot in problem.slots:
        size = float(shift[slot.x].max(initial=0.0))
        if np.any(shift[slot.x] > std[slot.x]):
            found[slot.parameter.name] = max(size, found.get(slot.parameter.name, 0.0))
    return found


def detectable(closing: Closing) -> list[Detectable]:
    """For every visible candidate parameter the smallest size that would have been found."""
    model, found = closing.before.model, []
    seen = {f.candidate.label for f in closing.effects}  # found, at the sizes that they have
    for score in closing.visible:
        candidate = score.candidate
        if candidate.label in seen:
            continue
        seen.add(candidate.label)
        place = 0
        for p in _own(candidate, model):
            width = p.shape.coordinates
            information = np.diag(score.information)[place : place + width]
            alive = score.survives[place : place + width] >= LEVELS.survives
            place += width
            if np.any(alive):
                size = float(np.sqrt(LEVELS.seen / information[alive]).max())
                found.append(Detectable(candidate.label, p.name, size, p.units[0]))
    return found
