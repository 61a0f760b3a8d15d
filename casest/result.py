"""`result.json` and `residuals.csv`: what a calibration leaves behind, in the fixed form."""

from __future__ import annotations

import csv
import hashlib
import inspect
import io
import json
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casest import __version__
from casest.data.logs import file_and_topics
from casest.data.run import Run
from casest.data.write import write_atomically
from casest.declaring.shapes import Array
from casest.declaring.symbols import Constant
from casest.errors import DataError
from casest.estimate import Estimate
from casest.modelling.effect import Attached
from casest.modelling.model import Model
from casest.naming import entry_units, unit_table
from casest.scatter import between_runs

RESULT, RESIDUALS = "result.json", "residuals.csv"


def calibration_result(
    estimate: Estimate,
    *,
    model_name: str,
    data: Sequence[str],
    command: str = "",
    holdout: float | None = None,
    misfit: list[dict[str, Any]] | None = None,
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
        "misfit": misfit,
        "corrected": _corrected_range(estimate),
        "units": {name: unit for name, unit in table.items() if "[" not in name},
        "solver": _solver(estimate),
        "samples": [_sample_note(run) for run in problem.runs],
        "notes": [note for run in problem.runs for note in run.notes] + list(estimate.notes),
        "convention": inspect.getdoc(problem.model.function) or "",
        "declared_in": _declared_in(problem.model),
        "reproduce": reproduce(command, data),
    }


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


def reproduce(command: str, data: Sequence[str]) -> dict[str, Any]:
    """Command, versions and digests: what is needed to get a result again."""
    return {
        "command": command,
        "python": platform.python_version(),
        **_versions(),
        "sha256": {name: _digest(name) for name in data},
    }


@cache
def _versions() -> dict[str, str]:
    """Versions of what computes; looked up once, for it takes as long as a small fit."""
    return {name: version(name) for name in ("casadi", "numpy", "scipy")}


def _digest(name: str) -> str:
    """SHA-256 of a data file; of a folder (a ROS 2 bag), of its files' in order of their names."""
    path = file_and_topics(name)[0]
    whole = hashlib.sha256()
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if file.is_file():
            with file.open("rb") as stream:
                part = hashlib.file_digest(stream, "sha256")
            if not path.is_dir():
                return part.hexdigest()
            whole.update(part.digest())
    return whole.hexdigest()


def plain(value: Any) -> Any:
    """Numbers and nested lists for JSON; what is not finite becomes null."""
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, np.ndarray) and value.ndim:
        return [plain(v) for v in value]
    number = float(value)
    return number if np.isfinite(number) else None


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


def save(folder: Path, result: Mapping[str, Any], residuals: str | None) -> None:
    """Write both files into a folder (made if missing), each whole or not at all."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made ({error.strerror}); give another -o") from None
    if residuals is not None:
        write_atomically(folder / RESIDUALS, residuals)
    write_atomically(folder / RESULT, as_json(result))


def as_json(result: Mapping[str, Any]) -> str:
    """The result as text: strict JSON, two blanks of indentation."""
    return json.dumps(result, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def load_result(path: Path) -> dict[str, Any]:
    """A saved result (a folder stands for the `result.json` in it)."""
    if path.is_dir():
        path = path / RESULT
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise DataError(f"{path}: no such result; {_instead(path.parent)}") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        near = path.with_name(RESULT)
        hint = f"; did you mean {near}?" if near.exists() and near != path else ""
        raise DataError(f"{path}: not a result.json ({error}){hint}") from None
    if not isinstance(result, dict) or "model" not in result:
        raise DataError(f"{path}: not a casest result: it names no model")
    if "format" in result:
        raise DataError(
            f"{path}: is a correction exported already, which `casest apply` reads; here the "
            "result.json is needed that it was exported from"
        )
    if not result.keys() & {"estimate", "before", "after"}:
        writer = _WRITERS.get(path.name)
        by = f", but what `casest {writer}` writes" if writer else ": it holds no estimate"
        raise DataError(f"{path}: not a result of calibrate or close{by}")
    return result


def made_by(path: Path) -> str:
    """The command that made a saved result; empty where Python did."""
    return str(load_result(path).get("reproduce", {}).get("command", ""))


#: What other commands leave in their folders.
_WRITERS = {
    "observe.json": "observe",
    "filter.json": "filter",
    "compare.json": "compare",
    "truth.json": "simulate",
}


def _instead(folder: Path) -> str:
    """What a folder without a result holds, and how one is made."""
    make = f"casest calibrate (or close) MODEL DATA -o {folder} makes one"
    found = next((name for name in _WRITERS if (folder / name).exists()), None)
    if found:
        return f"the folder holds {found} of `casest {_WRITERS[found]}`; {make}"
    return make


def saved_parameters(result: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of a saved result, after the loop was closed if it was."""
    block = result.get("after") or result.get("estimate") or {}
    found: dict[str, Any] = block.get("parameters", {})
    return found
