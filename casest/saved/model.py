"""Model and values of a saved result, as they were when it was made."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from casest import effects
from casest.declaration.effect import Effect, label_of
from casest.declaration.model import Model
from casest.declaration.symbols import constant
from casest.effects.on_axes import entry_name, lengths, restricted
from casest.errors import DataError, UsageError
from casest.results.find import find_effects, find_model


def saved_model(result: Mapping[str, Any]) -> tuple[Model, dict[str, Any]]:
    """Model and parameter values of a saved result: effects, constants and scopes as they were.

    Files of declarations are run for that: those that lie where they were, and whose SHA-256 is
    the one that the result has recorded.
    """
    model, units = _found_model(result), result.get("units", {})
    parameters = (result.get("after") or result.get("estimate") or {}).get("parameters", {})
    for saved in result.get("effects", []):
        if "file" not in saved:  # a constant that was freed
            continue
        columns, on = saved.get("columns") or {}, saved["on"]
        effect = _found_effect(saved)
        moved_label = label_of(effect, on, columns, moved=True)
        moved = any(n.startswith(f"{moved_label}.") for n in parameters)
        label = label_of(effect, on, columns, moved=moved)
        own = {n.removeprefix(label + ".") for n in parameters if n.startswith(label + ".")}
        effect = _as_it_was(effect, saved, own, model)
        if effect.kind == "time":  # which samples it tells of goes by where it begins
            effect = effect.starting(**_values(parameters, label, own))
        effect = effect if moved else replace(effect, on=on)
        model = model.with_effect(effect, on=on, columns=columns)
    for name in parameters:
        model = model.freed(name)
    for name, value in result["constants"].items():
        unit = units.get(name, "")
        model = model.having(**{name: constant(value, "" if "[" in unit else unit)})
    for name, scope in result.get("scopes", {}).items():
        model = model.scoped(name, scope)
    missing = [p.name for p in model.parameters if p.name not in parameters]
    if missing:
        raise DataError(f"the result has no value for {missing[0]!r} of model {model.name}")
    return model, {name: np.array(p["value"], dtype=float) for name, p in parameters.items()}


def _values(parameters: Mapping[str, Any], label: str, own: Collection[str]) -> dict[str, float]:
    return {n: float(parameters[f"{label}.{n}"]["value"]) for n in own}


def of_other_records(result: Mapping[str, Any]) -> tuple[Model, dict[str, Any]]:
    """The model of a saved result as it is for other records than its own, and its values."""
    model, values = saved_model(result)
    spans = [s.get("span") for s in result.get("samples", [])]
    lasting = model.elsewhere([(float(s[0]), float(s[1])) if s else None for s in spans])
    return lasting, lasting.among(values)


def _found_model(result: Mapping[str, Any]) -> Model:
    """The model where it was when the result was made, and as it was."""
    name, declared = str(result["model"]), result.get("declared_in") or {}
    path, colon, own = name.partition(":")
    if not path.endswith(".py"):
        return find_model(name)
    file = Path(declared.get("file", path))
    refuse_changed(file, declared.get("sha256"))
    return find_model(f"{file}{colon}{own}")


def _found_effect(saved: Mapping[str, Any]) -> Effect:
    """The effect of that name: casest's own, or from the file that declared it, as it was."""
    file, shipped = Path(saved["file"]), Path(effects.__file__).parent
    try:
        if file.parent == shipped:
            return next(e for e in (*effects.CATALOGUE, *effects.ASKED) if e.name == saved["name"])
        refuse_changed(file, saved.get("sha256"))
        return find_effects(f"{file}:{saved['name']}")[0]
    except (UsageError, StopIteration) as error:
        raise UsageError(
            f"the result was fitted with the effect {saved['name']}: {error or 'there is none'}"
        ) from None


def refuse_changed(source: Path, recorded: str | None, again: str = "calibrate") -> None:
    """Refuse a file of declarations that is not the one that the result was made with, unrun."""
    if source.is_file() and hashlib.sha256(source.read_bytes()).hexdigest() != recorded:
        raise UsageError(
            f"{source} has changed since the result was made: {again} again (the numbers belong to "
            "the old declaration)"
        )


def _as_it_was(effect: Effect, saved: Mapping[str, Any], own: set[str], model: Model) -> Effect:
    """The effect with the numbers it was told, on the axes where it has unknowns of its `own`."""
    effect = effect.holding(**saved.get("numbers", {}))
    if own <= {n for n, _ in effect.declarations} or saved["on"] not in model.quantities:
        return effect
    placed, ends = replace(effect, on=saved["on"]), {n.rpartition("_")[2] for n in own}
    size = max(lengths(placed, model))
    kept = [i for i in range(size) if entry_name(placed, i, size) in ends]
    return replace(restricted(placed, kept, model), on=effect.on)
