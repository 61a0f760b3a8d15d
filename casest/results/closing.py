"""`result.json` and `residuals.csv` of a closed loop, in the fixed form."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from casest.declaration.effect import Attached
from casest.declaration.shapes import Array
from casest.declaration.symbols import Constant
from casest.diagnose.closing import Closing
from casest.diagnose.detectability import detectable, invisible
from casest.diagnose.formula.terms import source
from casest.diagnose.selection.cross_validation import rms
from casest.diagnose.selection.found import Found
from casest.estimate.calibrate import Estimate
from casest.leastsquares.problem import Problem
from casest.results.calibration import attachment, calibration_result, parameter_table
from casest.results.file import plain
from casest.results.units import resolved, unit_table

#: How many of those that are not told apart from an effect are named beside it; others come after.
NEAREST = 2


def closing_result(
    closing: Closing,
    *,
    model_name: str,
    data: Sequence[str],
    command: str = "",
    held_out: tuple[Sequence[Array], Sequence[Array]] | None = None,
) -> dict[str, Any]:
    """The content of `result.json` for `close`: see the design, 10.

    `held_out` are residuals before and after on a record of its own; else the cross-fitted ones.
    """
    left = closing.misfit
    common = calibration_result(closing.after, model_name=model_name, data=data, command=command)
    estimate = common.pop("estimate")
    before, after = held_out or (closing.before_held_out, closing.after_held_out)
    sections = {
        "before": _section(closing.before, closing, before),
        "after": _section(closing.after, closing, after) | {"correlation": estimate["correlation"]},
    }
    first = list(common)
    place = first.index("noise") + 1
    ordered = {k: common[k] for k in first[:place]} | sections
    ordered |= {k: common[k] for k in first[place:]}
    ordered["trusted"] = closing.after.certificate.trusted
    ordered["verdict"] = closing.verdict
    ordered["noise"] |= left.noise
    ordered["effects"] = [_effect(f, closing) for f in closing.effects]
    ordered["invisible"] = [
        {
            "name": i.name,
            "column": i.column,
            "typical": {k: plain(v) for k, v in i.typical.items()},
            "units": {k: resolved(u, common["units"]) for k, u in i.units.items()},
            "would_move": {k: plain(v) for k, v in i.would_move.items()},
            "share_left": plain(i.share),
            "shown_by": i.shown_by,
        }
        for i in invisible(closing)
    ]
    fraction = np.nan if closing.verdict is None else left.fraction
    ordered["unexplained"] = {
        "fraction": plain(fraction),
        "where": left.where,
        **_open(closing),
    }
    ordered["moved"] = _moved(closing)
    ordered["smallest_detectable"] = [
        {
            "name": d.name,
            "parameter": d.parameter,
            "size": plain(d.size),
            "unit": resolved(d.unit, common["units"]),
        }
        for d in detectable(closing)
    ]
    ordered["refused"] = [{"name": s.name, "reason": s.reason} for s in closing.refused]
    ordered["not_tried"] = [{"name": s.name, "reason": s.reason} for s in closing.skipped]
    return ordered


def _section(estimate: Estimate, closing: Closing, held_out: Sequence[Array]) -> dict[str, Any]:
    problem = Problem(estimate.model, closing.runs)
    residuals = problem.residuals(estimate.point)
    axes = estimate.model.axes
    by_axis = {axis: plain(rms([r[:, [k]] for r in held_out])) for k, axis in enumerate(axes)}
    certificate = estimate.certificate
    table = unit_table(estimate.model, closing.runs)
    return {
        "rmse_fit": plain(rms(residuals)),
        "rmse_holdout": plain(rms(held_out)),
        "rmse_holdout_by_axis": by_axis,
        "certificate": {"trusted": certificate.trusted, "reasons": list(certificate.reasons)},
        "parameters": parameter_table(estimate, table),
    }


def _effect(found: Found, closing: Closing) -> dict[str, Any]:
    table = unit_table(closing.after.model, closing.runs)
    everything = parameter_table(closing.after, table)
    attached = _attached(found, closing)
    return {
        "name": found.candidate.name,
        "on": found.candidate.on,
        "column": found.candidate.column,
        "parameters": {
            n.removeprefix(found.candidate.label + "."): everything[n] for n in found.names
        },
        "p_value": plain(found.p_value),
        "holdout_gain": plain(found.gain),
        "formula": _formula(found, attached),
        "indistinguishable_from": _alike(found, closing)[:NEAREST],
        "less_likely": _alike(found, closing)[NEAREST:],
        "would_separate": _separating(found, closing),
        "instead_would_move": {
            label: _shifts(found.rivals[label], closing)
            for label in _alike(found, closing)[:NEAREST]
        },
    } | ({} if attached is None else attachment(attached))


def _open(closing: Closing) -> dict[str, Any]:
    """Causes of which none was added, since the parameters hang on which of them it is."""
    left = closing.undecided
    names = left.names if left else ()
    moves = left.moves if left else {}
    return {
        "one_of": list(names),
        "would_move": {label: _shifts(moves[label], closing) for label in names if label in moves},
        "would_separate": _measurements(names, closing) if len(names) > 1 else [],
    }


def _alike(found: Found, closing: Closing) -> list[str]:
    """What explains the data as well, but for what has been added beside it since."""
    added = {f.candidate.label for f in closing.effects}
    return [label for label in found.indistinguishable_from if label not in added]


def _shifts(rival: Mapping[str, Array], closing: Closing) -> dict[str, Any]:
    """Largest shift of each declared parameter that is more than its standard deviation."""
    found = {}
    for name, shift in rival.items():
        if name in closing.after.std and np.any(np.abs(shift) > closing.after.std[name]):
            found[name] = plain(np.max(np.abs(shift)))
    return found


def formula_source(closing: Closing) -> str:
    """Python text of the formula that was found, for `--effects`; empty where there is none."""
    return "".join(source(a.effect) for a in closing.after.model.effects)


def name_file(content: dict[str, Any], path: Path) -> None:
    """Say where the formula's source has been written: `apply` reads it there."""
    for e in content["effects"]:
        if e["name"] == "formula":
            e["file"] = str(path.resolve())


def _attached(found: Found, closing: Closing) -> Attached | None:
    labels = {a.label: a for a in closing.after.model.effects}
    return labels.get(found.candidate.label)


def _formula(found: Found, attached: Attached | None) -> str:
    """What the effect does, with the name of its column."""
    if attached is None:
        effect = found.candidate.effect
        return effect.formula if effect else f"{found.candidate.freed} is an unknown"
    return formula_of(attached)


def formula_of(attached: Attached) -> str:
    """What the effect does where it is attached, its columns and numbers put in."""
    formula = attached.effect.formula or attached.effect.doc.partition("\n")[0]
    for name, column in attached.columns:
        formula = formula.replace(name, column)
    for name, declared in attached.effect.declarations:
        if isinstance(declared, Constant) and not declared.dims:
            formula = re.sub(rf"\b{name}\b", f"{float(declared.array):.6g}", formula)
    return formula


def _separating(found: Found, closing: Closing) -> list[str]:
    """Measurements that would separate the effect from those that explain the data as well."""
    return _measurements(_alike(found, closing)[:NEAREST], closing)


def _measurements(labels: Sequence[str], closing: Closing) -> list[str]:
    """What would show each of these effects."""
    by_label = {s.candidate.label: s.candidate for s in closing.first}
    said = []
    for label in labels:
        other = by_label.get(label)
        if other is not None and other.effect is not None and other.effect.shown_by:
            said.append(f"{label}: {other.effect.shown_by}")
    return said


def _moved(closing: Closing) -> dict[str, Any]:
    """How far each declared parameter moved, in its own standard deviations before."""
    moved = {}
    for name, value in closing.before.values.items():
        if name in closing.after.values:
            with np.errstate(all="ignore"):
                z = (closing.after.values[name] - value) / closing.before.std[name]
            moved[name] = plain(np.where(np.isfinite(z), z, np.nan))
    return moved


def residual_rows(
    closing: Closing,
    held_out: tuple[Sequence[Any], Sequence[Array], Sequence[Array]] | None = None,
) -> str:
    """`residuals.csv`: `fit` rows from the fit to everything, `holdout` rows cross-fitted.

    `held_out`: runs, residuals before and after of a record of its own, in place of the latter.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["file", "run", "row", "t", "axis", "split", "before", "after"])
    axes = closing.before.model.axes
    fits = [
        Problem(e.model, closing.runs).residuals(e.point) for e in (closing.before, closing.after)
    ]
    hidden = held_out or (closing.runs, closing.before_held_out, closing.after_held_out)
    for split, runs, before, after in (("fit", closing.runs, *fits), ("holdout", *hidden)):
        for run, b, a in zip(runs, before, after, strict=True):
            for k in range(len(run)):
                t = "" if run.time is None else repr(float(run.time[k]))
                for j, axis in enumerate(axes):
                    pair = repr(float(b[k, j])), repr(float(a[k, j]))
                    row = [run.file, run.name, int(run.rows[k]), t, axis, split, *pair]
                    writer.writerow(row)
    return text.getvalue()


def formula_lines(content: Mapping[str, Any]) -> list[str]:
    """A line per effect for the terminal."""
    return [f"{e['name']}: {e['formula']}" for e in content["effects"]]
