"""`casest observe` and `casest filter`: what a trajectory shows, and the states along it."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casest import __version__
from casest.data.run import Run
from casest.data.timing import GAP
from casest.dynamics import Dynamics
from casest.dynamics.filter import Filtered, filtered
from casest.dynamics.gramian import Observed, gramian, observed, window_eigenvalues
from casest.dynamics.structural import Structure, structure
from casest.dynamics.transition import linearised
from casest.errors import DeclarationError, UsageError
from casest.estimate import Estimate, attempt
from casest.intensities import Tuned, intensities, units
from casest.modelling.model import Model
from casest.result import plain

#: Windows over which the smallest eigenvalue is followed: this share of the record unless told.
WINDOW = 0.1


def observe_parameters(model: Model, runs: Sequence[Run]) -> tuple[dict[str, Any], Estimate]:
    """What a static model's data determine: rank, null directions in words, std of each value."""
    found = attempt(model, runs)
    identified = found.identifiability
    return {
        "casest": __version__,
        "model": model.name,
        "rank": identified.rank,
        "unknowns": identified.unknowns,
        "unobservable": list(identified.unobservable),
        "weak": [
            {"direction": w.words, "inflation": plain(w.inflation), "std": plain(w.std)}
            for w in found.weak
        ],
        "std": {name: plain(value) for name, value in found.std.items()},
        "trusted": found.certificate.trusted,
    }, found


def observe_structure(model: Dynamics) -> dict[str, Any]:
    """What any record could show: structural rank with inputs that vary freely, and held constant.

    `std` is empty: how well needs a record.
    """
    free = structure(model)
    held = structure(model, varying=False) if free.inputs else free
    return {
        "casest": __version__,
        "model": model.name,
        "notes": [],
        "rank": free.rank,
        "unknowns": free.unknowns,
        "unobservable": list(free.unobservable),
        "std": {},
        "structural": _structural(free),
        "constant_inputs": _structural(held),
        "tolerance": "singular values below 1e-10 of the largest count as zero; the smallest that "
        f"counts is {min(free.gap, held.gap):.1g} times the largest that does not",
    }


def _structural(found: Structure) -> dict[str, Any]:
    return {
        "rank": found.rank,
        "undetermined": list(found.undetermined),
        "unobservable": list(found.unobservable),
        "order": found.order,
        "inputs": list(found.inputs),
        "gap": plain(found.gap),
    }


def _structural_rank(model: Dynamics) -> int | None:
    """What a better record could reach; None where it cannot be said."""
    try:
        return structure(model).rank
    except DeclarationError:
        return None


def observe_motion(model: Dynamics, run: Run, window: float | None = None) -> dict[str, Any]:
    """What a trajectory makes observable, by the Gramian over the whole record and over windows.

    `std` is what the readings alone allow at the beginning of the record, per state. A nonlinear
    model is linearised along its smoothed states.
    """
    along = None if model.linear else filtered(model, run).smoothed
    system = linearised(model, run, along)
    seen = observed(model, gramian(model, system))
    duration = float(system.time[-1] - system.time[0])
    if window is not None and not 2 * float(np.median(system.steps)) <= window < np.inf:
        raise UsageError(
            f"--window {window:g} s: a window must hold two steps of "
            f"{float(np.median(system.steps)):.3g} s at least; the record lasts {duration:.3g} s"
        )
    length = min(window or WINDOW * duration, duration)
    ends, eigenvalues = window_eigenvalues(model, system, length)
    telling = np.flatnonzero(eigenvalues[:, 0] > 1)
    std = {name: plain(seen.std[where]) for name, where in model.slices().items()}
    return {
        "casest": __version__,
        "model": model.name,
        "notes": [*assumed(run), *_readings_alone(model), *_too_short(seen, len(run), duration)],
        "rank": seen.rank,
        "unknowns": seen.unknowns,
        "structural_rank": _structural_rank(model),
        "unobservable": list(seen.unobservable),
        "std": std,
        "units": {s.name: s.unit for s in model.states},
        "eigenvalues": plain(seen.eigenvalues / max(float(seen.eigenvalues[0]), 1e-300)),
        "tolerance": "eigenvalues of the Gramian scaled to a unit diagonal, below 1e-11 of the "
        "largest, count as zero",
        "windows": {
            "length_s": plain(length),
            "end_s": plain(ends),
            "smallest_eigenvalue": plain(eigenvalues[:, 0]),
            "informative_from_s": plain(ends[telling[0]]) if telling.size else None,
            "eigenvalues": plain(eigenvalues),
        },
    }


def assumed(run: Run) -> list[str]:
    """What was assumed of a record, gaps included, one sentence each."""
    notes = list(run.notes)
    time = np.asarray(run.time, float)
    step = np.diff(time)
    gaps = np.flatnonzero(step > GAP * np.median(step))
    if gaps.size:
        worst = int(gaps[np.argmax(step[gaps])])
        notes.append(
            f"{gaps.size} {'gap' if gaps.size == 1 else 'gaps'} in time, the longest of "
            f"{step[worst]:.3g} s after row {int(run.rows[worst])} (t = {time[worst]:.6g} s): "
            "inputs were taken as straight lines across; the driving noise does not cover what "
            "happened there"
        )
    return notes


def _readings_alone(model: Dynamics) -> list[str]:
    if not model.traced.g.numel():
        return []
    return [
        "what the model knows exactly (constraint) is not counted: this the readings alone show"
    ]


def _too_short(seen: Observed, samples: int, duration: float) -> list[str]:
    if seen.rank == seen.unknowns or samples > seen.unknowns:
        return []
    return [
        f"the trajectory is too short for the question: {samples} samples over {duration:.3g} s "
        f"for {seen.unknowns} unknowns; what is called unobservable may only need a longer one"
    ]


def follow(
    model: Dynamics, run: Run, tuned: Tuned | None = None
) -> tuple[dict[str, Any], Filtered]:
    """States over time by the Kalman filter, and whether the innovations are as expected.

    `tuned`: the same model with other noise intensities, used in place of the declared ones, which
    are shown beside them.
    """
    declared = filtered(model, run, smooth=tuned is None)
    found = filtered(tuned.model, run) if tuned else declared
    model, before = found.model, model
    mean, normalised = _normalised_mean(found), found.normalised_innovations
    m = found.innovations.shape[1]
    final = {
        name: {
            "value": plain(found.x[-1][where]),
            "std": plain(found.std[-1][where]),
            "smoothed_std_median": plain(_median_std(found, where)),
            "unit": model[name].unit,
        }
        for name, where in model.slices().items()
    }
    return {
        "casest": __version__,
        "model": model.name,
        "notes": [*assumed(run), *_unsettled(found)],
        "samples": len(found.time),
        "states": final,
        "intensities": {
            "how": tuned.how if tuned else "as declared",
            "declared": _plain_values(intensities(before)),
            "used": _plain_values(intensities(model)),
            "spread": _plain_values(tuned.spread) if tuned else {},
            "units": units(model),
            "declared_normalised_mean": plain(_normalised_mean(declared)),
        },
        "innovations": {
            "rms": plain(np.sqrt(np.nanmean(found.innovations**2, axis=0))),
            "normalised_mean": plain(mean),
            "expected": m,
            "missing_readings": int(np.sum(~np.isfinite(normalised))),
            "lag1_correlation": plain(_lag1(found.innovations)),
        },
    }, found


def _plain_values(values: Mapping[str, float]) -> dict[str, Any]:
    return {name: plain(value) for name, value in values.items()}


def _unsettled(found: Filtered) -> list[str]:
    if found.settled:
        return []
    return [
        "the smoother's rounds did not settle: its states are those of one pass; nearer start "
        "values or a smaller std at the beginning may help"
    ]


def _normalised_mean(found: Filtered) -> float:
    """Mean of νᵀS⁻¹ν after the first tenth, which belongs to the start values."""
    normalised = found.normalised_innovations
    whole = normalised[np.isfinite(normalised)]
    later = whole[len(whole) // 10 :]
    return float(np.mean(later)) if len(later) else float("nan")


def _median_std(found: Filtered, where: slice) -> Any:
    std = np.sqrt(np.diagonal(found.smoothed_P, axis1=1, axis2=2))[:, where]
    return np.median(std, axis=0)


def _lag1(innovations: Any) -> Any:
    """Correlation of neighbouring innovations, each component: zero for the right filter."""
    r = np.where(np.isfinite(innovations), innovations, 0.0)
    return np.sum(r[1:] * r[:-1], axis=0) / np.maximum(np.sum(r**2, axis=0), 1e-300)


def states_csv(found: Filtered) -> str:
    """Filtered and smoothed states with standard deviations, a row per sample."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names, own_units = found.model.names, found.model.state_units
    head = ["t [s]"]
    for kind in ("", "std_", "smoothed_", "smoothed_std_"):
        head += [f"{kind}{n} [{u}]" for n, u in zip(names, own_units, strict=True)]
    writer.writerow(head)
    smooth_std = np.sqrt(np.diagonal(found.smoothed_P, axis1=1, axis2=2))
    table = np.hstack([found.time[:, None], found.x, found.std, found.smoothed, smooth_std])
    writer.writerows([[repr(float(v)) for v in row] for row in table])
    return text.getvalue()


def observe_text(content: Mapping[str, Any]) -> str:
    """Rank, what is hidden in words, and the standard deviations that the data allow."""
    if "structural" in content:
        return structure_text(content)
    lines = [f"{content['model']}: rank {content['rank']} of {content['unknowns']}"]
    lines += [f"  - {words}" for words in content["unobservable"]]
    lines += [f"  {could}" for could in [could_reach(content)] if could]
    if not content["unobservable"]:
        lines.append("  every unknown is determined by these data")
    lines += ["", "  standard deviation that these data allow:"]
    shown_units = content.get("units", {})
    for name, std in content["std"].items():
        rows = std if isinstance(std, list) else [std]
        rows = rows if rows and isinstance(rows[0], list) else [rows]
        for k, row in enumerate(rows):
            shown = ", ".join(map(_number, row))
            unit = shown_units.get(name, "") if k == 0 else ""
            lines.append(f"    {name if k == 0 else '':<16} {shown} {unit}".rstrip())
    if "windows" in content:
        w = content["windows"]
        low, high = min(w["smallest_eigenvalue"]), max(w["smallest_eigenvalue"])
        lines += [
            "",
            f"  over windows of {w['length_s']:.3g} s the smallest eigenvalue (information over "
            f"prior) goes from {low:.3g} to {high:.3g};",
            f"  {window_words(w)}",
        ]
    return "\n".join([*lines, *_note_lines(content)])


def window_words(windows: Mapping[str, Any]) -> str:
    """Since when a window alone tells every state more than was known beforehand."""
    since = windows["informative_from_s"]
    if since is None:
        return "no window alone tells every state more than was known beforehand"
    return f"the first window that tells every state more than was known ends at {since:.4g} s"


def could_reach(content: Mapping[str, Any]) -> str:
    """Whether another record could show what this one hides; empty where it hides nothing."""
    could = content.get("structural_rank")
    if could is None or content["rank"] == content["unknowns"]:
        return ""
    if could > content["rank"]:
        return f"another motion could show more: the structural rank is {could}"
    return f"no motion shows more: the structural rank is {could} too"


def structure_text(content: Mapping[str, Any]) -> str:
    """Structural rank and what no record can determine, in words."""
    free, held, n = content["structural"], content["constant_inputs"], content["unknowns"]
    order = f"{free['order']} {'derivative' if free['order'] == 1 else 'derivatives'}"
    lines = [
        f"{content['model']}: structural rank {free['rank']} of {n} "
        f"(readings and {order} of them, at random points)"
    ]
    inputs = " and ".join(free["inputs"])
    if free["rank"] == n:
        how = ""
        if inputs:
            how = f" where {inputs} vary" if held["rank"] < n else f" even with {inputs} constant"
        lines.append(f"  suitable data determine every state and parameter{how}")
    else:
        lines += [f"  - {words}" for words in free["unobservable"]]
        lines.append(f"  not determined by any record: {', '.join(free['undetermined'])}")
    if held["rank"] < free["rank"]:
        lines += ["", f"  with {inputs} held constant: rank {held['rank']} of {n}"]
        lines += [f"  - {words}" for words in held["unobservable"]]
        lines.append(f"  then not determined: {', '.join(held['undetermined'])}")
    return "\n".join(lines)


def _note_lines(content: Mapping[str, Any]) -> list[str]:
    notes = content.get("notes", [])
    return ["", *(f"  note: {note}" for note in notes)] if notes else []


def _number(value: Any) -> str:
    return "not determined" if value is None else f"{value:.3g}"


def filter_text(content: Mapping[str, Any]) -> str:
    """Final states and the innovations' verdict."""
    lines = [f"{content['model']}: {content['samples']} samples", "", "  at the end of the record:"]
    for name, s in content["states"].items():
        for k, (value, std) in enumerate(zip(s["value"], s["std"], strict=True)):
            label = name if len(s["value"]) == 1 else f"{name}[{k}]"
            lines.append(f"    {label:<14} {value:>12.5g} ± {std:<10.2g} {s['unit']}")
    lines += ["", *intensity_lines(content)]
    i = content["innovations"]
    lines += ["", f"  innovations are {filter_verdict(content)}"]
    if i["missing_readings"]:
        lines.append(f"  {i['missing_readings']} samples without a complete reading")
    return "\n".join([*lines, *_note_lines(content)])


def intensity_lines(content: Mapping[str, Any]) -> list[str]:
    """Noise intensities, declared ones beside those that were used."""
    said, expected = content["intensities"], content["innovations"]["expected"]
    declared, used, spread = said["declared"], said["used"], said["spread"]
    same = declared == used
    lines = ["  noise intensities " + ("as declared:" if same else f"{said['how']}:")]
    if not same:
        lines.append(f"    {'':<14} {'declared':>12} {'used':>12}")
    for name in dict.fromkeys([*declared, *used]):
        columns = [declared.get(name)] if same else [declared.get(name), used.get(name)]
        shown = " ".join(f"{'-' if not v else format(v, '.3g'):>12}" for v in columns)
        share = "" if same else intensity_spread(spread, name)
        lines.append(f"    {name:<14} {shown} {said['units'][name]}{share and ' ' + share}")
    means = [said["declared_normalised_mean"]]
    means += [] if same else [content["innovations"]["normalised_mean"]]
    shown = " ".join(f"{_number(v):>12}" for v in means)
    return [*lines, f"    {'innovations²':<14} {shown} ({expected} expected)"]


def intensity_spread(spread: Mapping[str, Any], name: str) -> str:
    """How sure an intensity is, where the data gave it."""
    if name not in spread:
        return ""
    share = spread[name]
    if share is None:
        return "(not determined)"
    return f"± {100 * share:.2g} %" if share < 0.5 else f"(within a factor of {np.exp(share):.2g})"


def filter_verdict(content: Mapping[str, Any]) -> str:
    """How large the innovations are beside what the noise intensities say."""
    said = content["innovations"]
    ratio = (said["normalised_mean"] or float("nan")) / said["expected"]
    if 0.8 < ratio < 1.25:
        return "as large as the noise intensities say"
    return (
        f"{ratio:.2g} times as large (squared) as the noise intensities say: match them "
        "(--sensor-noise, --rest or --noise ml)"
    )
