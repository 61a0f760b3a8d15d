"""The candidates of a model: what it asks for says whether they are poses, runs or settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.plan.candidates import poses, rows, runs
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
    if model.traced.integrates:
        raise UsageError(
            f"{model.name} follows differential equations: a plan is of rows that stand for "
            "themselves. Simulate a record that could be taken (casest simulate) and calibrate it: "
            "its standard deviations are what that record would bring"
        )
    if not 1 <= possible.step <= 45:
        raise UsageError(f"--step {possible.step:g}: between 1 and 45 degrees")
    if possible.reach is not None and not 0 < possible.reach <= 180:
        raise UsageError(f"--reach {possible.reach:g}: an angle from upright, 0 to 180 degrees")
    if possible.table is not None:
        return rows.table(model, values, noise, possible.table)
    if _moves(model):
        return _runs(model, values, noise, possible)
    sizes = {s.name: (s.size, s.unit) for s in others(model)}
    wrong = [name for name in possible.varied if name not in sizes]
    if wrong:
        there = ", ".join(sizes) or "nothing beside the pose"
        raise UsageError(f"--vary {wrong[0]}=…: of {model.name} one can vary {there}")
    varied = combined(
        {
            name: values_of(name, text, sizes[name][1], sizes[name][0])
            for name, text in possible.varied.items()
        }
        | dict(possible.also)
    )
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
