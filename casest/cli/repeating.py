"""The fit of a saved result once more, from the command that made it and the records it names."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casest.cli.flags import built
from casest.cli.loading import model_and_records
from casest.cli.options import CloseOptions, FitOptions
from casest.cli.project import expanded
from casest.cli.shared import commands, progress
from casest.errors import CasestError, UsageError

if TYPE_CHECKING:
    from casest.declaration.model import Model
    from casest.estimate.estimate import Estimate

#: Values that are as far from the saved ones, in standard deviations, are those of other data.
SAME = 0.01


def repeated(path: Path) -> Estimate:
    """The estimate of a result of calibrate or close; UsageError where it comes out differently."""
    from casest.estimate.calibrate import attempt
    from casest.results.file import load_result
    from casest.solve.strategy import SOLVERS

    result = load_result(path)
    command = (result.get("reproduce") or {}).get("command", "")
    words = shlex.split(command)
    if len(words) < 3 or words[0] != "casest" or words[1] not in ("calibrate", "close"):
        raise UsageError(
            f"{path}: was not made by casest calibrate or close, so that its fit cannot be made "
            "again: calibrate with -o"
        )
    name, data, options = _parsed(words[1:])
    if options.solver not in SOLVERS:
        raise UsageError(f"{path}: is by the estimator {options.solver}, which is no fit: leave it")
    own = replace(options.model, effects=()) if words[1] == "close" else options.model
    try:
        model, runs = model_and_records(name, data, own, options.reading, options.sensors)
    except (CasestError, OSError) as error:
        raise UsageError(f"{path}: its fit cannot be made again: {error}") from None
    values = (result.get("after") or result.get("estimate") or {}).get("parameters", {})
    if words[1] == "close":
        model = _with_what_was_found(model, result)
    start = {n: p["value"] for n, p in values.items()}
    progress(f"fitting {name}")
    found = attempt(model, runs, start=start, intervals=False)
    _refuse_other(path, found, values)
    return found


def _parsed(words: list[str]) -> tuple[str, tuple[str, ...], FitOptions]:
    """Model, data and options of a command line."""
    words = expanded(words, commands)
    command = commands.commands[words[0]]
    given = dict(command.make_context(words[0], words[1:], resilient_parsing=False).params)
    options = built(CloseOptions if words[0] == "close" else FitOptions, given)
    return given["model_name"], given["data"], options


def _with_what_was_found(model: Model, result: dict[str, Any]) -> Model:
    """The model as closing the loop left it, with what is known of noise and constants."""
    from casest.declaration.symbols import Constant
    from casest.saved.model import saved_model

    saved = saved_model(result)[0]
    for known in model.constants:
        if known.uncertainty is not None and isinstance(saved[known.name], Constant):
            saved = saved.having(**{known.name: known})
    return replace(saved, noise=model.noise, prior=model.prior)


def _refuse_other(path: Path, found: Estimate, values: dict[str, Any]) -> None:
    import numpy as np

    if not found.certificate.trusted:
        raise UsageError(f"{path}: the fit, made again, is refused: {found.certificate.reasons[0]}")
    for name, saved in values.items():
        std = np.maximum(found.std[name], 1e-12 * np.abs(found.values[name]) + 1e-300)
        off = np.abs(found.values[name] - np.array(saved["value"], dtype=float)) / std
        if not np.all(off <= SAME):
            raise UsageError(
                f"{path}: made again, {name} is {np.max(off):.2g} standard deviations off: the "
                "records or the model have changed since; calibrate again"
            )
