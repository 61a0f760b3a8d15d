"""`result.json` and `residuals.csv` of a loop closed in motion, in the fixed form of `close`."""

from __future__ import annotations

import csv
import inspect
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casest import __version__
from casest.declaration.shapes import Array
from casest.diagnose.motion.fit import Fit, forgotten, rise
from casest.diagnose.motion.loop import UNEXPLAINED, Added, MotionClosing
from casest.diagnose.motion.score_test import Score
from casest.effects.moving import Candidate
from casest.results.file import plain, reproduce
from casest.results.observability import assumed

#: Noncentrality from which an effect is found nearly always, and below which nobody could find it.
SEEN, UNSEEN = 45.0, 9.0


def motion_result(
    closing: MotionClosing, *, model_name: str, data: Sequence[str], command: str = ""
) -> dict[str, Any]:
    """The content of `result.json` for `close` of an estimator in motion: see the design, 10.

    Errors are one-step innovations, rms of one axis, after the start is forgotten; `parameters`
    are the states at the end of the record and the numbers of the effects.
    """
    declared, after = closing.declared, closing.after
    left = closing.left
    misfit = left.p_value < UNEXPLAINED
    period = float(np.median(np.diff(after.found.time)))
    complete = np.isfinite(after.found.innovations).all(axis=1)
    between = float(np.median(np.diff(after.found.time[complete])))
    return {
        "casest": __version__,
        "model": model_name,
        "data": list(data),
        "runs": [closing.run.name],
        "constants": {c.name: plain(c.array) for c in declared.constants},
        "verdict": _verdict(closing, misfit) if _trusted(after) else None,
        "trusted": _trusted(after),
        "noise": {
            "sigma": plain(np.sqrt(np.diag(after.model.noise) / period)),
            "unit": _unit(closing),
            "intensities": {"before": plain_all(closing.before.intensities),
                            "after": plain_all(after.intensities)},
            "declared": _declared(closing),
        },
        "before": _section(closing.before, closing, 0),
        "after": _section(after, closing, 1),
        "effects": [_effect(a, closing) for a in closing.effects],
        "invisible": [i for s in closing.first for i in _invisible(s, closing)],
        "unexplained": {
            "fraction": plain(left.share if misfit else 0.0),
            "where": f"innovations foretell those within {left.lag * between:.3g} s after them"
            if misfit else "",
        },
        "moved": _moved(closing),
        "smallest_detectable": [_detectable(s) for s in closing.first if np.any(s.information)],
        "refused": [{"name": name, "reason": why} for name, why in closing.refused],
        "innovations": _innovations(after),
        "units": {s.name: s.unit for s in declared.states},
        "notes": assumed(closing.run),
        "convention": inspect.getdoc(declared.function) or "",
        "reproduce": reproduce(command, data),
    }  # fmt: skip


def plain_all(values: Mapping[str, float]) -> dict[str, Any]:
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


def _verdict(closing: MotionClosing, misfit: bool) -> str:
    if misfit:
        return "unexplained"
    return "extended" if closing.effects else "adequate"


def _trusted(fit: Fit) -> bool:
    return bool(np.isfinite(fit.likelihood)) and fit.last_step < 1.0


def _unit(closing: MotionClosing) -> str:
    units = {s.unit or "1" for s in closing.declared.signals
             if s.name in closing.declared.measured_signals}  # fmt: skip
    return ", ".join(sorted(units))


def _declared(closing: MotionClosing) -> dict[str, Any]:
    model = closing.declared
    outputs = zip(model.traced.measured, model.traced.outputs, strict=True)
    readings = {name: model.sensors.get(name, o.intensity) for name, o in outputs}
    return plain_all({**{s.name: s.intensity for s in model.states}, **model.sensors, **readings})


def _section(fit: Fit, closing: MotionClosing, side: int) -> dict[str, Any]:
    counted = forgotten(closing.before) & forgotten(closing.after)
    own = fit.by_reading(fit.found.innovations)[counted]
    hidden = closing.held_out[side][counted]
    names = axes(closing)
    by_axis = np.sqrt(np.nanmean(hidden**2, axis=0))
    mean = float(np.nanmean(fit.found.normalised_innovations[forgotten(fit)]))
    reasons = [f"normalised squared innovations: {mean:.3g} on average, {len(names)} expected"]
    if fit.added:
        reasons.append(f"the last step of the fit is {fit.last_step:.2g} standard deviations long")
    return {
        "rmse_fit": plain(np.sqrt(np.nanmean(own**2))),
        "rmse_holdout": plain(np.sqrt(np.nanmean(hidden**2))),
        "rmse_holdout_by_axis": dict(zip(names, map(plain, by_axis), strict=True)),
        "log_likelihood": plain(closing.before.likelihood + rise(fit, closing.before)),
        "certificate": {"trusted": _trusted(fit), "reasons": reasons},
        "parameters": _states(fit, closing) | _numbers(fit),
    }


def _states(fit: Fit, closing: MotionClosing) -> dict[str, Any]:
    """The declared states at the end of the record."""
    model, found = closing.declared, fit.found
    return {
        name: {"value": plain(found.x[-1][where]), "std": plain(found.std[-1][where]),
               "unit": model[name].unit}
        for name, where in model.slices().items()
    }  # fmt: skip


def _numbers(fit: Fit) -> dict[str, Any]:
    if fit.answers is None:
        return {}
    return {
        candidate.state: {"value": plain(value), "std": plain(fit.std[where]),
                          "unit": candidate.unit}
        for (candidate, value), where in zip(fit.added, fit.answers.columns, strict=True)
    }  # fmt: skip


def _effect(added: Added, closing: MotionClosing) -> dict[str, Any]:
    candidate, fit = added.candidate, closing.after
    common = {"column": None, "p_value": plain(added.p_value), "holdout_gain": plain(added.gain)}
    if not isinstance(candidate, Candidate):
        name, _, on = candidate.label.partition(" of ")
        q = fit.intensities[candidate.state]
        parameters = {
            "correlation_time": {"value": candidate.tau, "std": None, "unit": "s"},
            "std": {"value": plain(np.sqrt(q * candidate.tau / 2)), "std": None,
                    "unit": candidate.unit},
        }  # fmt: skip
        return {"name": name, "on": on, "parameters": parameters, **common,
                "formula": f"{on} holds noise whose correlation falls by e over correlation_time",
                "indistinguishable_from": [], "would_separate": []}  # fmt: skip
    by_label = {s.candidate.label: s.candidate for s in closing.first}
    return {
        "name": candidate.effect.name,
        "on": candidate.on,
        "parameters": {"k": _numbers(fit)[candidate.state]},
        **common,
        "formula": formula(candidate),
        "indistinguishable_from": list(added.indistinguishable_from),
        "would_separate": [
            f"{label}: {by_label[label].effect.shown_by}" for label in added.indistinguishable_from
        ],
    }


def formula(candidate: Candidate) -> str:
    """What the effect does, with the names of its signals."""
    said = candidate.effect.formula.replace("prediction", f"predicted {candidate.on}")
    return said.replace("reading", candidate.on).replace("omega", candidate.turn or "omega")


def _invisible(score: Score, closing: MotionClosing) -> list[dict[str, Any]]:
    """An effect whose typical size the data could not have shown, if it would move a state."""
    candidate = score.candidate
    if any(a.candidate is candidate for a in closing.effects):
        return []
    hidden = np.diag(score.information) * candidate.typical**2 < UNSEEN
    moves = (score.moves[:, hidden] * candidate.typical).max(axis=1, initial=0.0)
    std = np.median(closing.before.found.std, axis=0)
    would = {
        name: plain(moves[where].max())
        for name, where in closing.declared.slices().items()
        if np.any(moves[where] > std[where])
    }
    if not would:
        return []
    return [
        {
            "name": candidate.effect.name,
            "on": candidate.on,
            "column": None,
            "typical": {"k": plain(candidate.typical)},
            "would_move": would,
            "shown_by": candidate.effect.shown_by,
        }
    ]


def _detectable(score: Score) -> dict[str, Any]:
    information = np.diag(score.information)
    alive = information * score.candidate.typical**2 > 1e-4
    size = float(np.sqrt(SEEN / information[alive]).max()) if alive.any() else np.nan
    return {"name": score.candidate.label, "parameter": score.candidate.state,
            "size": plain(size), "unit": score.candidate.unit}  # fmt: skip


def _moved(closing: MotionClosing) -> dict[str, Any]:
    """How far each state moved at the end of the record, in its standard deviations before."""
    before, after = closing.before.found, closing.after.found
    n = closing.declared.size
    with np.errstate(all="ignore"):
        z = (after.x[-1][:n] - before.x[-1]) / before.std[-1]
    return {name: plain(z[where]) for name, where in closing.declared.slices().items()}


def _innovations(fit: Fit) -> dict[str, Any]:
    nu, counted = fit.found.innovations, forgotten(fit)
    normalised = fit.found.normalised_innovations
    whole = nu[np.isfinite(normalised)]
    lag1 = [np.corrcoef(own[:-1], own[1:])[0, 1] for own in whole.T]
    return {
        "rms": plain(np.sqrt(np.nanmean(nu[counted] ** 2, axis=0))),
        "normalised_mean": plain(np.nanmean(normalised[counted])),
        "expected": nu.shape[1],
        "missing_readings": int(np.sum(~np.isfinite(normalised))),
        "lag1_correlation": plain(np.array(lag1)),
    }


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
