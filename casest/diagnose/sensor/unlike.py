"""Why what a refit found is not what its name says, or takes the place of what is declared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.evidence.linear import Linear
from casest.diagnose.evidence.score import Trial
from casest.diagnose.levels import LEVELS
from casest.diagnose.noise.noise_model import step_of
from casest.diagnose.protocol.state import ANOTHER, STANDS_IN
from casest.diagnose.sensor.fits import Fit, problem_of
from casest.diagnose.sensor.rows import Rows, instant
from casest.leastsquares.problem import Problem
from casest.leastsquares.weights import scale_of_readings

#: Powers of what the sensor met, of which the best are a smooth bend.
POWERS = range(2, 9)
#: What a grid is searched for of an effect with a kink in what the sensor met.
KINKS = {"level", "floor", "threshold", "band"}


def another(model: Model, values: Mapping[str, Array], declared: Model) -> tuple[str, str]:
    """Label of an effect that is not what its name says at these values, and why; else empty.

    Of axes that have sizes of their own the largest decides. What the `declared` model has already
    is the user's word.
    """
    given = {a.label for a in declared.effects}
    for attached in (a for a in model.effects if a.label not in given):
        for name, (least, most) in attached.effect.within:
            own = [v for n, v in values.items() if _is_of(n, attached.label, name)]
            size = max((float(np.max(v)) for v in own), default=most)
            if not least <= size <= most:
                beyond = f"above {most:g}" if size > most else f"below {least:g}"
                why = f"{attached.label} would have {name} = {size:.3g}, {beyond}"
                return attached.label, f"{why}: {ANOTHER}"
    return "", ""


def _is_of(full: str, label: str, name: str) -> bool:
    """`creep.k`, and `creep.k_1` where the axes have sizes of their own."""
    own = full.removeprefix(f"{label}.")
    return own != full and own.partition("_")[0] == name


def at_one_input(what: Candidate, beyond: Array, noise: Array) -> str:
    """Why a cut-off is none: one value alone lies beyond it, which may be off itself; else empty.

    `beyond`: what it takes from each reading (N, m); what `noise` (m,) may as well do is not.
    """
    size = np.abs(beyond).max(initial=0.0)
    clear = beyond[np.abs(beyond) > LEVELS.clip * noise]
    if size > 0 and len(np.unique(np.round(clear / size, 6))) < 2:
        return f"one input alone lies clearly beyond the level of {what.label}"
    return ""


def smooth(before: Linear, after: Linear, added: Sequence[Candidate], met: Array) -> str:
    """Why a kink is none: over what the sensor met (N, 1) a smooth bend of as many unknowns leaves
    less; else empty."""
    kinks = [w for w in added if w.effect is not None and KINKS & {k for _, k in w.effect.profile}]
    alone = bool(kinks) and len(added) == 1 and met.shape[1] == 1
    if not alone or before.residual.shape != after.residual.shape:
        return ""
    z = (met - met.mean()) / max(float(np.abs(met - met.mean()).max()), 1e-300)
    powers = np.concatenate([(z**k * before.root).reshape(-1, 1) for k in POWERS], axis=1)
    Q, r = before.basis, before.residual.ravel()
    r = r - Q @ (Q.T @ r)  # a cause that was taken out just now: nothing was fitted again
    beyond = powers - Q @ (Q.T @ powers)
    size = np.linalg.norm(beyond, axis=0)
    kept = size > LEVELS.survives * np.linalg.norm(powers, axis=0)  # those that it has not already
    beyond = beyond[:, kept] / size[kept]
    square, product = beyond.T @ beyond, beyond.T @ r
    count = after.slopes.shape[2] - before.slopes.shape[2]
    gains = [0.0]
    for own in map(list, combinations(range(int(kept.sum())), count)):
        best = np.linalg.lstsq(square[np.ix_(own, own)], product[own], rcond=1e-9)[0]
        gains.append(float(product[own] @ best))
    if float(r @ r) - max(gains) >= float(np.sum(after.residual**2)):
        return ""
    return f"a smooth bend of as many unknowns leaves less than a kink: {ANOTHER}"


def within_rounding(before: Fit, after: Fit, runs: tuple[Run, ...]) -> str:
    """Why columns or effects are none: readings were rounded, to a step that may be all that is
    left, and no prediction changes by more than half of one; else empty.

    What rounding leaves is no noise: it hangs on the input, and so goes with anything that does.
    """
    measured = before.model.traced.measured
    step = step_of(runs, measured)
    if not step > 0 or after.model.traced.measured != measured:
        return ""
    left, other = (
        np.concatenate([r.ravel() for r in problem.residuals(point)])
        for problem, point in (problem_of(fit, runs) for fit in (before, after))
    )
    if left.shape != other.shape or scale_of_readings([left]) >= LEVELS.rounded * step:
        return ""
    most = float(np.abs(other - left).max(initial=0.0)) / step
    if most > LEVELS.half:
        return ""
    return f"nowhere more than {most:.2g} steps of the reading: rounding may be all of it"


def too_slow(
    values: Mapping[str, Array], added: Sequence[Candidate], spans: Sequence[float]
) -> str:
    """Why records of these spans (s) are too short for a memory: nobody saw it fade; else empty."""
    for what in added:
        profile = what.effect.profile if what.effect is not None else ()
        for name in (n for n, kind in profile if kind == "timescale"):
            value = float(np.max(values.get(f"{what.label}.{name}", 0.0)))
            if value > max(spans, default=np.inf) / LEVELS.fades:
                return f"its refit fails: {name} = {value:.3g} s is over half of the record"
    return ""


def between_levels(trial: Trial, linear: Linear, settled: NDArray[np.bool_]) -> str:
    """Why a bend is none: the rows show it in which an input goes from one level to the next, and
    not the `settled` ones (N,), which are most; else empty."""
    if np.mean(settled) < 1 - LEVELS.passing or settled.all():
        return ""
    falls = [_fall(linear.residual[rows], linear.slopes[rows], trial.columns[rows])
             for rows in (settled, slice(None))]  # fmt: skip
    if falls[0] >= LEVELS.alike * falls[1]:
        return ""
    moving = int(np.sum(~settled))
    return f"{moving} rows between levels show {trial.family}, the levels do not: {ANOTHER}"


def _fall(residual: Array, slopes: Array, columns: Array) -> float:
    """Of the squares, that columns take away beside the unknowns."""
    r, J = residual.ravel(), slopes.reshape(residual.size, -1)
    both = np.concatenate([J, columns.reshape(residual.size, -1)], axis=1)
    without, beside = (r - X @ np.linalg.lstsq(X, r, rcond=None)[0] for X in (J, both))
    return float(without @ without - beside @ beside)


def stands_in(before: Fit, after: Fit, added: Sequence[Candidate], rows: Rows) -> str:
    """Why columns are no influence: what inputs did to the reading, and was most of it, is theirs
    now, or stands against them; else empty.

    So is another output of the sensor, or of a second one: it tells the reading better than the
    input does, whatever that has to do with it. Of an implicit model it is what the readings do to
    each axis of what is corrected.
    """
    if not any(what.columns or (what.effect is not None and what.effect.extras) for what in added):
        return ""
    measured, implicit = before.model.traced.measured, before.model.implicit
    ours, theirs = (_response(fit, rows) for fit in (before, after))
    if ours is None or theirs is None or not (measured or implicit):
        return ""
    size = np.sum(ours**2, axis=0)
    shares = np.sum(ours * theirs, axis=0) / np.maximum(size, 1e-300)
    if not implicit:
        reading = rows.of([run.signals[str(measured)] for run in rows.runs])
        much = LEVELS.most * np.sum((reading - reading.mean(axis=0)) ** 2, axis=0)
        shares = shares[size >= much]
    share = float(max(shares, key=lambda one: abs(one - 1), default=1.0))
    if abs(share - 1) <= LEVELS.stays:
        return ""
    what = "readings do to what is corrected" if implicit else "inputs do to the reading"
    if share > 1:
        return f"what the {what} would be {share:.2g} times as much: {STANDS_IN}"
    return f"of what the {what} {max(share, 0.0):.0%} is left: {STANDS_IN}"


def _response(fit: Fit, rows: Rows) -> Array | None:
    """What inputs do to the prediction (N, m), of an implicit model readings to what is corrected,
    about its mean; None where nobody can tell."""
    model, traced = fit.model, fit.model.along
    own = {s.name for s in model.declared} - {"t"}
    own = own if model.implicit else own - {*traced.readings}
    names = [s.name for s in model.signals if s.kind == "plain" and s.name in own]
    if _told(fit) is None or traced.integrates or model.resting or not names:
        return None
    fit = instant(fit)
    problem, point = problem_of(fit, rows.runs)
    still = Problem(fit.model, tuple(_still(run, names) for run in rows.runs))
    told = _told(fit)
    moving, resting = (
        rows.of([f[0][:, :, 0] for f in p.evaluate(point, {"p": told})]) for p in (problem, still)
    )
    found = np.nan_to_num(moving - resting)
    return np.asarray(found - found.mean(axis=0))


def _told(fit: Fit) -> Any:
    """The prediction, or what is corrected, as an expression; None where there is neither."""
    traced = fit.model.along
    if not fit.model.implicit or traced.corrected is None:
        return traced.predicted
    return traced.quantities[traced.corrected].value


def _still(run: Run, names: Sequence[str]) -> Run:
    means = {n: np.full_like(x, x.mean(axis=0)) for n, x in run.signals.items() if n in names}
    return replace(run, signals={**run.signals, **means})
