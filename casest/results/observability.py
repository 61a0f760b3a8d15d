"""`casest observe`: what data, a trajectory, or any record of a model can show."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casest import __version__
from casest.data.run import Run
from casest.data.timing import GAP
from casest.declaration.model import Model
from casest.dynamics import Dynamics
from casest.dynamics.filter import filtered
from casest.dynamics.gramian import Observed, gramian, observed, window_eigenvalues
from casest.dynamics.structural import Structure, structure
from casest.dynamics.transition import linearised
from casest.errors import DeclarationError, UsageError
from casest.estimate.calibrate import Estimate, attempt
from casest.results.file import plain

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
        "notes": [*assumed(run), *_readings_alone(model), *_too_short(seen, run)],
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
            "inputs were taken as straight lines across; the states that they drive are known "
            "after it no better than at the beginning"
        )
    return notes


def _readings_alone(model: Dynamics) -> list[str]:
    if not model.traced.g.numel():
        return []
    return [
        "what the model knows exactly (constraint) is not counted: this the readings alone show"
    ]


def _too_short(seen: Observed, run: Run) -> list[str]:
    if seen.rank == seen.unknowns:
        return []
    words = too_short(run, seen.unknowns)
    return [f"{w}; what is called unobservable may only need a longer one" for w in words]


def too_short(run: Run, unknowns: int) -> list[str]:
    """Whether a record has no more samples than there are states to tell apart."""
    if len(run) > unknowns:
        return []
    duration = float(np.ptp(np.asarray(run.time, float)))
    return [
        f"the trajectory is too short for the question: {len(run)} samples over {duration:.3g} s "
        f"for {unknowns} unknowns"
    ]


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
            shown = ", ".join(map(number_or_not, row))
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
    return "\n".join(wrapped([*lines, *note_lines(content)]))


def wrapped(lines: Sequence[str]) -> list[str]:
    """Lines that fit 80 columns."""
    return [
        textwrap.fill(line, 80, subsequent_indent=" " * 4, break_on_hyphens=False) for line in lines
    ]


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
    return "\n".join(wrapped(lines))


def note_lines(content: Mapping[str, Any]) -> list[str]:
    """What was assumed, a line each."""
    notes = content.get("notes", [])
    return ["", *(f"  note: {note}" for note in notes)] if notes else []


def number_or_not(value: Any) -> str:
    """A number, or that there is none."""
    return "not determined" if value is None else f"{value:.3g}"
