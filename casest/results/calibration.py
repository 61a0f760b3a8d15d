"""`result.json` and `residuals.csv`: what a calibration leaves behind, in the fixed form."""

from __future__ import annotations

import csv
import hashlib
import inspect
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casest import __version__
from casest.data.run import Run
from casest.declaration.effect import Attached
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Constant
from casest.diagnose.misfit.lack_of_fit import Finding
from casest.estimate.calibrate import Estimate
from casest.leastsquares.agreement import between_runs
from casest.results.file import plain, reproduce
from casest.results.units import entry_units, unit_table


def calibration_result(
    estimate: Estimate,
    *,
    model_name: str,
    data: Sequence[str],
    command: str = "",
    holdout: float | None = None,
    misfit: Sequence[Finding] | None = None,
) -> dict[str, Any]:
    """The content of `result.json` for `calibrate`. `verdict` is null: no effect was looked for.

    `misfit` is what speaks against the model, null where nobody asked.
    """
    problem, certificate = estimate.problem, estimate.certificate
    table = unit_table(problem.model, problem.runs)
    return {
        "casest": __version__,
        "model": model_name,
        "data": list(data),
        "runs": [run.name for run in problem.runs],
        "constants": {c.name: plain(c.array) for c in problem.model.constants},
        "scopes": {p.name: p.scope for p in problem.model.parameters},
        "verdict": None,
        "trusted": certificate.trusted,
        "noise": {
            "sigma": [plain(estimate.noise.sigma)] * len(problem.model.axes),
            "unit": table["residual"],
            "from_residual": plain(estimate.noise.residual),
            "from_repeats": plain(estimate.noise.repeats),
            "degrees_of_freedom": estimate.noise.degrees_of_freedom,
            "correlated_over_samples": plain(estimate.correlated_over),
        },
        "estimate": {
            "rmse_fit": plain(estimate.rmse),
            "rmse_holdout": plain(holdout),
            "certificate": {
                "trusted": certificate.trusted,
                "reasons": list(certificate.reasons),
                "step_left_in_std": plain(certificate.step),
                "relative_curvature": plain(certificate.curvature),
                "agreeing_starts": [certificate.agreeing, certificate.starts],
                "at_bound": list(certificate.at_bound),
            },
            "parameters": parameter_table(estimate, table),
            "correlation": {
                "names": list(estimate.names),
                "matrix": plain(_correlation(estimate.covariance)),
            },
        },
        "effects": [attachment(a) for a in problem.model.effects],
        "identifiability": {
            "rank": estimate.identifiability.rank,
            "unknowns": estimate.identifiability.unknowns,
            "unobservable": list(estimate.identifiability.unobservable),
            "weak": [
                {"direction": w.words, "inflation": plain(w.inflation), "std": plain(w.std)}
                for w in estimate.weak
            ],
        },
        "scatter_between_runs": _scatter(estimate),
        "invisible": None,
        "unexplained": None,
        "misfit": _doubts(misfit),
        "corrected": _corrected_range(estimate),
        "units": {name: unit for name, unit in table.items() if "[" not in name},
        "solver": _solver(estimate),
        "samples": [_sample_note(run) for run in problem.runs],
        "notes": [note for run in problem.runs for note in run.notes] + list(estimate.notes),
        "convention": inspect.getdoc(problem.model.function) or "",
        "declared_in": _declared_in(problem.model),
        "reproduce": reproduce(command, data),
    }


def _doubts(misfit: Sequence[Finding] | None) -> list[dict[str, Any]] | None:
    if misfit is None:
        return None
    return [{"where": f.where, "p_value": plain(f.p_value)} for f in misfit]


def doubt_sentence(misfit: Sequence[Mapping[str, Any]]) -> str:
    """What a reader must know before using the values."""
    where = "; ".join(f"{f['where']} (p = {f['p_value']:.1g})" for f in misfit)
    return (
        f"the residual is not noise: {where}. The model lacks something, which may have moved the "
        "values by many of their standard deviations, however small the residual: `casest close` "
        "looks for it"
    )


def parameter_table(estimate: Estimate, table: Mapping[str, str]) -> dict[str, Any]:
    """Value, standard deviations, interval and unit of every parameter, for JSON."""
    reach = estimate.interval_reach
    known = {n: u for n, u in table.items() if "[" not in n}
    found = {}
    for p in estimate.model.parameters:
        value, std = estimate.values[p.name], estimate.std[p.name]
        below, above = reach[0][p.name], reach[1][p.name]
        own = entry_units(p, known)
        found[p.name] = {
            "value": plain(value),
            "std": plain(std),
            "robust_std": plain(estimate.robust[p.name]),
            "interval95": [plain(value - below), plain(value + above)],
            "unit": own[0] if len(set(own)) == 1 else own,
        }
    return found


def _correlation(covariance: Array) -> Array:
    std = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(covariance / np.outer(std, std))


def _scatter(estimate: Estimate) -> dict[str, Any] | None:
    """Agreement of several runs on what they share; null for one run, or a refused estimate."""
    if not estimate.certificate.trusted:
        return None
    found = between_runs(estimate.problem, estimate.point, estimate.correlated_over)
    if found is None:
        return None
    return {
        "F": plain(found.F),
        "freedom": [plain(f) for f in found.freedom],
        "p_value": plain(found.p_value),
        "furthest": found.worst,
    }


def attachment(attached: Attached) -> dict[str, Any]:
    """What is needed to attach the effect again: where, and the numbers it was told."""
    declared = attached.effect.declarations
    return {
        "name": attached.effect.name,
        "on": attached.on,
        "columns": dict(attached.columns),
        "numbers": {n: float(d.array) for n, d in declared
                    if isinstance(d, Constant) and not d.dims},
        "file": str(Path(inspect.unwrap(attached.effect.function).__code__.co_filename).resolve()),
    }  # fmt: skip


def _corrected_range(estimate: Estimate) -> dict[str, Any] | None:
    """Name of the corrected quantity and the range it had in the fit, for inverting it later."""
    name = estimate.model.traced.corrected
    if name is None:
        return None
    declared = ca.densify(ca.vec(estimate.model.traced.quantities[name].declared))
    values = estimate.problem.evaluate(estimate.point, {"c": declared})
    finite = np.concatenate([v[0][np.isfinite(v[0])] for v in values])
    if not finite.size:
        return {"name": name}
    return {"name": name, "low": float(finite.min()), "high": float(finite.max())}


def _solver(estimate: Estimate) -> dict[str, Any]:
    if not estimate.outcomes:
        return {"name": None}
    first = estimate.outcomes[0]
    return {
        "name": estimate.extra.get("estimator", first.solver),
        "iterations": first.iterations,
        "evaluations": first.evaluations,
        "seconds": plain(estimate.extra.get("seconds", first.seconds)),
        **{k: plain(v) for k, v in estimate.extra.items() if k == "least_squares_seconds"},
    }


def _sample_note(run: Run) -> dict[str, Any]:
    return {"run": run.name, "samples": len(run), "readings": int(np.sum(run.count))}


def _declared_in(model: Model) -> dict[str, str]:
    """File of the model's declaration and its digest, so that an edited model is noticed."""
    path = Path(model.function.__code__.co_filename).resolve()
    if not path.exists():
        return {}
    return {"file": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def residual_rows(estimate: Estimate) -> str:
    """`residuals.csv` of a calibration: the column `after` is empty, nothing was added."""
    problem = estimate.problem
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["file", "run", "row", "t", "axis", "split", "before", "after"])
    for run, residual in zip(problem.runs, problem.residuals(estimate.point), strict=True):
        for k, row in enumerate(residual):
            t = "" if run.time is None else repr(float(run.time[k]))
            for axis, value in zip(problem.model.axes, row, strict=True):
                writer.writerow(
                    [run.file, run.name, int(run.rows[k]), t, axis, "fit", repr(float(value)), ""]
                )
    return text.getvalue()
