"""The candidates of a model: what it asks for says whether they are poses, runs or settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.plan.candidates import poses, rows, runs, times
from casest.plan.candidates.attitudes import STEP
from casest.plan.candidates.candidates import Candidates, Noise, others
from casest.plan.candidates.varied import combined, values_of


@dataclass(frozen=True)
class Possible:
    """What can be set, as a person says it.

    varied: values by name, as typed. step, reach: of poses, degrees. duration, rate: of runs, s and
    1/s. table: rows of a file, in place of all that. also: values (N, 1) of columns that an effect
    reads.
    """

    varied: Mapping[str, str] = field(default_factory=dict)
    step: float = STEP
    reach: float | None = None
    duration: float | None = None
    rate: float | None = None
    table: Sequence[Run] | None = None
    also: Mapping[str, Array] = field(default_factory=dict)


def candidates(
    model: Model, values: Mapping[str, Any], noise: Noise, possible: Possible
) -> Candidates:
    """What could be measured next."""
    if not model.parameters:
        raise UsageError(f"{model.name}: every unknown is held: there is nothing to plan for")
    if not 1 <= possible.step <= 45:
        raise UsageError(f"--step {possible.step:g}: between 1 and 45 degrees")
    if possible.reach is not None and not 0 < possible.reach <= 180:
        raise UsageError(f"--reach {possible.reach:g}: an angle from upright, 0 to 180 degrees")
    if model.traced.integrates and not any(p.scope == "run" for p in model.parameters):
        return _times(model, values, noise, possible)
    if possible.table is not None:
        return rows.table(model, values, noise, possible.table)
    if _moves(model):
        return _runs(model, values, noise, possible)
    sizes = {s.name: (s.size, s.unit) for s in others(model)}
    varied = combined(_varied(model, possible, "nothing beside the pose"))
    turned = poses.rotation_signal(model) is not None
    if turned or poses.at_rest(model):
        missing = [name for name in sizes if name not in varied]
        if missing:
            raise UsageError(
                f"{model.name}: say what {missing[0]} can be: --vary {missing[0]}=20,40"
            )
        make = poses.told_attitudes if turned else poses.poses
        return make(model, values, noise, step=possible.step, reach=possible.reach, others=varied)
    return rows.settings(model, values, noise, varied)


def _varied(model: Model, possible: Possible, nothing: str) -> dict[str, Array]:
    """Values of each signal that can be set."""
    sizes = {s.name: (s.size, s.unit) for s in others(model)}
    wrong = [name for name in possible.varied if name not in sizes]
    if wrong:
        there = ", ".join(sizes) or nothing
        raise UsageError(f"--vary {wrong[0]}=…: of {model.name} one can vary {there}")
    return {
        name: values_of(name, text, sizes[name][1], sizes[name][0])
        for name, text in possible.varied.items()
    } | dict(possible.also)


def _times(model: Model, values: Mapping[str, Any], noise: Noise, possible: Possible) -> Candidates:
    """Of states that follow differential equations: when to read the run."""
    if possible.table is not None:
        return times.table(model, values, noise, possible.table)
    if possible.duration is None or possible.rate is None:
        raise UsageError(
            f"{model.name} follows differential equations: say --duration, and with --rate how "
            "often one can read"
        )
    held = _varied(model, possible, "nothing: only when it is read")
    long, rate = possible.duration, possible.rate
    return times.times(model, values, noise, held, duration=long, rate=rate)


def _moves(model: Model) -> bool:
    """Is a measurement of the model a run over time, not a sample?"""
    time = any(s.name == "t" for s in model.signals)
    return time and not model.implicit and not others(model)


def _runs(model: Model, values: Mapping[str, Any], noise: Noise, possible: Possible) -> Candidates:
    if possible.duration is None or possible.rate is None:
        raise UsageError(f"{model.name} is measured in runs: say --duration and --rate")
    own = {p.name: p for p in model.parameters if p.scope == "run"}
    varied = {}
    for name, text in possible.varied.items():
        known = own.get(name)
        unit = "s" if name == runs.DURATION else known.units[0] if known else None
        varied[name] = values_of(name, text, unit, known.shape.size if known else 1)
    return runs.runs(model, values, noise, varied, duration=possible.duration, rate=possible.rate)
