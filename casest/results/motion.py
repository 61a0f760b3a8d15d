"""What a loop closed in motion leaves: `result.json` in the form of `close`, `residuals.csv`."""

from __future__ import annotations

import csv
import inspect
import io
import re
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from msgspec import Struct

from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.diagnose.motion.fit import Fit, forgotten, rise
from casest.diagnose.motion.loop import Added, MotionClosing
from casest.diagnose.motion.visibility import Visible
from casest.dynamics.transition import usual
from casest.effects.moving import Candidate
from casest.results.closing import Detectable
from casest.results.file import plain
from casest.results.fitted import JudgedSection
from casest.results.observability import assumed
from casest.results.result import (
    Certificate,
    Explained,
    Number,
    Numbers,
    Parameter,
    Reproduced,
    Result,
    reproduced,
)
from casest.results.rounding import rounded
from casest.results.trajectory import Innovations, Trajectory, trajectory_of, weakly_told


class Intensities(Struct, frozen=True):
    """Noise intensities that match the record: of the declared and of the extended estimator."""

    before: dict[str, float]
    after: dict[str, float]


class MotionNoise(Struct, frozen=True):
    """Noise of the readings, and the intensities: matched ones beside those declared."""

    sigma: list[Number]
    unit: str
    intensities: Intensities
    declared: dict[str, float]


class MotionEffect(Struct, frozen=True):
    """An effect that was added, or noise with a colour, with the evidence."""

    name: str
    on: str
    parameters: dict[str, Parameter]
    column: str | None
    p_value: Number
    holdout_gain: Number
    formula: str
    indistinguishable_from: list[str]
    would_separate: list[str]


class MotionHidden(Struct, frozen=True):
    """An effect that the trajectory cannot show, and what a typical size of it would do unseen."""

    name: str
    on: str
    column: str | None
    typical: dict[str, float]
    would_move: dict[str, float]
    shown_by: str


class Left(Struct, frozen=True):
    """What of the innovations foretells others: its share of their variance, and how far."""

    fraction: Number
    where: str


class MotionSection(JudgedSection, frozen=True, kw_only=True):
    """An estimator before or after the loop, with its likelihood; no correlation is kept."""

    log_likelihood: float


class MotionClosed(Result, frozen=True, kw_only=True, dict=True):
    """The content of `result.json` of `close` of an estimator in motion: see the design, 10.

    Errors are one-step innovations, rms of one axis, after the start is forgotten; `parameters`
    are the states at the end of the record and the numbers of the effects.
    """

    unwritten = ("closing",)

    data: list[str]
    runs: list[str]
    constants: dict[str, Numbers]
    verdict: str | None
    trusted: bool
    noise: MotionNoise
    before: MotionSection
    after: MotionSection
    effects: list[MotionEffect]
    invisible: list[MotionHidden]
    unexplained: Left
    moved: dict[str, Numbers]
    smallest_detectable: list[Detectable]
    refused: list[Explained]
    innovations: Innovations
    units: dict[str, str]
    notes: list[str]
    convention: str
    reproduce: Reproduced
    closing: MotionClosing

    @property
    def risen(self) -> float:
        """Rise of the log-likelihood by what was added."""
        return self.after.log_likelihood - self.before.log_likelihood

    @cached_property
    def trajectory(self) -> Trajectory:
        """States and innovations along the record, after the loop."""
        return trajectory_of(self.closing.after.found)


def motion_result(
    closing: MotionClosing, *, model_name: str, data: Sequence[str], command: str = ""
) -> MotionClosed:
    """What `close` leaves of an estimator in motion."""
    declared, after, left = closing.declared, closing.after, closing.left
    period = usual(after.found.system.steps)
    complete = np.isfinite(after.found.innovations).all(axis=1)
    between = float(np.median(np.diff(after.found.time[complete])))
    where = f"innovations foretell those within {left.lag * between:.3g} s after them"
    return MotionClosed(
        model=model_name,
        data=list(data),
        runs=[closing.run.name],
        constants={c.name: plain(c.array) for c in declared.constants},
        verdict=closing.verdict,
        trusted=after.trusted,
        noise=MotionNoise(
            plain(np.sqrt(np.diag(after.model.noise_at(period)) / period)),
            _unit(closing),
            Intensities(plain_all(closing.before.intensities), plain_all(after.intensities)),
            _declared(closing),
        ),
        before=_section(closing.before, closing, 0),
        after=_section(after, closing, 1),
        effects=[_effect(a, closing) for a in closing.effects],
        invisible=[i for s in closing.first for i in _invisible(s, closing)],
        unexplained=Left(plain(left.share), where) if closing.coloured else Left(0.0, ""),
        moved=_moved(closing),
        smallest_detectable=[_detectable(s) for s in closing.first if np.any(s.information)],
        refused=[Explained(name, why) for name, why in closing.refused],
        innovations=_innovations(after),
        units={s.name: s.unit for s in declared.states},
        notes=[*assumed(closing.run), *weakly_told(after.found)],
        convention=inspect.getdoc(declared.function) or "",
        reproduce=reproduced(command, data),
        closing=closing,
    )


def sentence(result: MotionClosed) -> str:
    """The verdict in one sentence."""
    names = list(map(_with_rivals, result.effects))
    if result.verdict is None:
        return "no trustworthy estimate"
    if result.verdict == "adequate":
        return "adequate: nothing that this trajectory can show is missing"
    if result.verdict == "extended":
        verb = "was" if len(names) == 1 else "were"
        return f"extended: {', '.join(names)} {verb} missing; what is left is noise"
    beside = f" beside {', '.join(names)}" if names else ""
    return f"unexplained: {_unexplained(result.closing)}{beside}"


def _with_rivals(effect: MotionEffect) -> str:
    """An effect, or the first of what it is not told apart from."""
    rivals = " or ".join(effect.indistinguishable_from[: LEVELS.nearest])
    return f"{called(effect)} (or {rivals})" if rivals else called(effect)


def _unexplained(closing: MotionClosing) -> str:
    """Why what is left is no noise, or not all that is missing is known."""
    if closing.loud:
        loud = " and ".join(_louder(closing, name, times) for name, times in closing.loud.items())
        return f"the innovations are white only if {loud}"
    if closing.undecided:
        several = " or ".join(closing.undecided)
        return f"{several} explains much of the innovations, and held-out time does not confirm it"
    return "the innovations are not white, and no candidate says why"


def _louder(closing: MotionClosing, name: str, times: float) -> str:
    """`a is 160 times as noisy …`: of a signal in standard deviations, of a state as declared."""
    if name in closing.run.signals:
        said = "it was stated to be or shows from sample to sample"
        return f"{name} is {np.sqrt(times):.2g} times as noisy as {said}"
    return f"{name} is driven by {times:.2g} times the intensity that was declared"


def called(effect: MotionEffect | MotionHidden) -> str:
    """`bias of omega`, `temperature_bias(temp) of a`."""
    column = f"({effect.column})" if effect.column else ""
    return f"{effect.name}{column} of {effect.on}"


def numbers_of(effect: MotionEffect) -> str:
    """`; k = 0.1996 ± 0.0004 s`: the numbers of an effect."""
    said = []
    for name, p in effect.parameters.items():
        values, stds = (np.atleast_1d(np.array(v, float)) for v in (p.value, p.std))
        pairs = zip(values, np.broadcast_to(stds, values.shape), strict=True)
        shown = [" ± ".join(rounded(v, s)) if np.isfinite(s) else f"{v:.4g}" for v, s in pairs]
        text = ", ".join(shown)
        unit = "" if p.unit == "1" else f" {p.unit}"
        said.append(f"{name} = {text}{unit}")
    return f"; {', '.join(said)}"


def plain_all(values: Mapping[str, float]) -> dict[str, float]:
    """Numbers by name, for JSON."""
    return {name: plain(value) for name, value in values.items()}


def rms_settled(closing: MotionClosing) -> tuple[float, float]:
    """Held-out error before and after: rms of one-step innovations, one axis."""
    counted = forgotten(closing.before) & forgotten(closing.after)
    before, after = (float(np.sqrt(np.nanmean(nu[counted] ** 2))) for nu in closing.held_out)
    return before, after


def axes(closing: MotionClosing) -> list[str]:
    """Name of every component of the readings: `v[0]`."""
    t, names = closing.declared.traced, []
    for name, o in zip(t.measured, t.outputs, strict=True):
        size = o.predicted.numel()
        names += [name] if size == 1 else [f"{name}[{k}]" for k in range(size)]
    return names


def _unit(closing: MotionClosing) -> str:
    units = {s.unit or "1" for s in closing.declared.signals
             if s.name in closing.declared.measured_signals}  # fmt: skip
    return ", ".join(sorted(units))


def _declared(closing: MotionClosing) -> dict[str, float]:
    model, period = closing.declared, usual(closing.after.found.system.steps)
    readings = {name: model.intensity_of(name, period) for name in model.measured_signals}
    return plain_all({**{s.name: s.intensity for s in model.states}, **model.sensors, **readings})


def _section(fit: Fit, closing: MotionClosing, side: int) -> MotionSection:
    counted = forgotten(closing.before) & forgotten(closing.after)
    own = fit.by_reading(fit.found.innovations)[counted]
    hidden = closing.held_out[side][counted]
    names = axes(closing)
    by_axis = np.sqrt(np.nanmean(hidden**2, axis=0))
    mean = float(np.nanmean(fit.found.normalised_innovations[forgotten(fit)]))
    reasons = [f"normalised squared innovations: {mean:.3g} on average, {len(names)} expected"]
    if fit.added:
        reasons.append(f"the last step of the fit is {fit.last_step:.2g} standard deviations long")
    return MotionSection(
        rmse_fit=plain(np.sqrt(np.nanmean(own**2))),
        rmse_holdout=plain(np.sqrt(np.nanmean(hidden**2))),
        rmse_holdout_by_axis=dict(zip(names, map(plain, by_axis), strict=True)),
        log_likelihood=plain(closing.before.likelihood + rise(fit, closing.before)),
        certificate=Certificate(fit.trusted, reasons),
        parameters=_states(fit, closing) | _numbers(fit),
    )


def _states(fit: Fit, closing: MotionClosing) -> dict[str, Parameter]:
    """The declared states at the end of the record."""
    model, (x, P) = closing.declared, fit.found.end
    std = np.sqrt(np.diag(P))
    return {
        name: _number(x[where], std[where], model[name].unit)
        for name, where in model.slices().items()
    }


def _number(value: Numbers, std: Numbers, unit: str) -> Parameter:
    return Parameter(value=plain(value), std=plain(std), unit=unit)


def _numbers(fit: Fit) -> dict[str, Parameter]:
    """Of every effect: `omega_bias` where it has one sort of numbers, `v_vibration.sine` else."""
    if fit.answers is None:
        return {}
    found: dict[str, Parameter] = {}
    for (candidate, value), where in zip(fit.added, fit.answers.columns, strict=True):
        own = _by_name(candidate, value, fit.std[where])
        several = len(own) > 1
        found |= {f"{candidate.state}.{n}" if several else candidate.state: p
                  for n, p in own.items()}  # fmt: skip
    return found


def _by_name(candidate: Candidate, value: Array, std: Array) -> dict[str, Parameter]:
    """Numbers of an effect, and what it was searched over."""
    values, stds = candidate.named(value), candidate.named(std)
    found = {n.name: _number(values[n.name], stds[n.name], n.unit) for n in candidate.numbers}
    units = {p.name.rpartition(".")[2]: p.unit for p in candidate.parameters}
    return found | {n: _number(v, None, units[n]) for n, v in candidate.held}


def _effect(added: Added, closing: MotionClosing) -> MotionEffect:
    candidate, fit = added.candidate, closing.after
    evidence = None, plain(added.p_value), plain(added.gain)
    if not isinstance(candidate, Candidate):
        name, _, on = candidate.label.partition(" of ")
        q = fit.intensities[candidate.state]
        std = np.sqrt(q * candidate.tau / 2)
        parameters = {
            "correlation_time": _number(candidate.tau, None, "s"),
            "std": _number(std, None, candidate.unit),
        }
        said = f"{on} holds noise whose correlation falls by e over correlation_time"
        return MotionEffect(name, on, parameters, *evidence, said, [], [])
    assert fit.answers is not None
    labels = [c.label for c, _ in fit.added]
    k = labels.index(candidate.label)
    there, value = fit.added[k]
    by_label = {c.label: c for c in closing.tried}
    alike = list(added.indistinguishable_from)
    return MotionEffect(
        there.effect.name,
        there.on,
        _by_name(there, value, fit.std[fit.answers.columns[k]]),
        there.column,
        *evidence[1:],
        formula(there),
        alike,
        [f"{label}: {by_label[label].effect.shown_by}" for label in alike],
    )


def formula(candidate: Candidate) -> str:
    """What the effect does, with the names of its signals."""
    said = candidate.effect.formula
    if candidate.attached is None:
        said = said.replace("prediction", f"predicted {candidate.on}")
        return said.replace("reading", candidate.on).replace("omega", candidate.turn or "omega")
    value = "predicted " + candidate.on if candidate.place == "output" else "true " + candidate.on
    for name, own in candidate.attached.columns:
        said = re.sub(rf"\b{name}\b", own, said)
    first = "u" if candidate.effect.on == "input" else "y"
    return re.sub(rf"\b{first}\b", value, said) + f" is read as {candidate.on}"


def _invisible(score: Visible, closing: MotionClosing) -> list[MotionHidden]:
    """An effect whose typical size the data could not have shown, if it would move a state."""
    candidate = score.candidate
    if any(a.candidate.label == candidate.label for a in closing.effects):
        return []
    typical = candidate.typical
    hidden = np.diag(score.information) * typical**2 < LEVELS.unseen
    moves = (score.moves * typical)[:, hidden].max(axis=1, initial=0.0)
    std = np.median(closing.before.found.std, axis=0)
    would = {
        name: plain(moves[where].max())
        for name, where in closing.declared.slices().items()
        if np.any(moves[where] > std[where])
    }
    if not would:
        return []
    sizes = {n.name: plain(n.typical) for n in candidate.numbers}
    name, shown_by = candidate.effect.name, candidate.effect.shown_by
    return [MotionHidden(name, candidate.on, candidate.column, sizes, would, shown_by)]


def _detectable(score: Visible) -> Detectable:
    """The size of an effect's first numbers that is found nearly always."""
    candidate, own = score.candidate, score.candidate.numbers[0]
    information = np.diag(score.information)[: own.size]
    alive = information * own.typical**2 > 1e-4
    size = float(np.sqrt(LEVELS.seen / information[alive]).max()) if alive.any() else np.nan
    return Detectable(candidate.label, candidate.state, plain(size), own.unit)


def _moved(closing: MotionClosing) -> dict[str, Numbers]:
    """How far each state moved at the end of the record, in its standard deviations before."""
    before, after = closing.before.found, closing.after.found
    n = closing.declared.size
    with np.errstate(all="ignore"):
        z = (after.x[-1][:n] - before.x[-1]) / before.std[-1]
    return {name: plain(z[where]) for name, where in closing.declared.slices().items()}


def _innovations(fit: Fit) -> Innovations:
    nu, counted = fit.found.innovations, forgotten(fit)
    normalised = fit.found.normalised_innovations
    whole = nu[np.isfinite(normalised)]
    lag1 = [np.corrcoef(own[:-1], own[1:])[0, 1] for own in whole.T]
    return Innovations(
        plain(np.sqrt(np.nanmean(nu[counted] ** 2, axis=0))),
        plain(np.nanmean(normalised[counted])),
        nu.shape[1],
        int(np.sum(~np.isfinite(normalised))),
        plain(np.array(lag1)),
    )


def residual_rows(closing: MotionClosing) -> str:
    """`residuals.csv`: innovations before and after; `fit` from the fit to everything, `holdout`
    from numbers of the other blocks of time; empty where a reading is missing."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["file", "run", "row", "t", "axis", "split", "before", "after"])
    run, names = closing.run, axes(closing)
    time = closing.after.found.time
    before_all, after_all = (
        f.by_reading(f.found.innovations) for f in (closing.before, closing.after)
    )
    fits: tuple[Array, Array] = (before_all, after_all)
    for split, (before, after) in (("fit", fits), ("holdout", closing.held_out)):
        for k in range(len(run)):
            for j, axis in enumerate(names):
                pair = (_cell(before[k, j]), _cell(after[k, j]))
                head = [run.file, run.name, int(run.rows[k]), repr(float(time[k]))]
                writer.writerow([*head, axis, split, *pair])
    return text.getvalue()


def _cell(value: float) -> str:
    return repr(float(value)) if np.isfinite(value) else ""
