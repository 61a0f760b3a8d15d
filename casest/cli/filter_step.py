"""`casest export` of an estimator in motion: one step of its filter, of a model or of a folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casest.cli.assignments import Assignment, Assignments
from casest.cli.flags import Kind, flag
from casest.cli.loading import moving_model
from casest.cli.options import MotionOptions, SensorOptions
from casest.errors import DataError, UsageError

if TYPE_CHECKING:
    from casest.dynamics import Dynamics

#: What `casest filter` leaves in its folder.
FILTERED = "filter.json"


@dataclass(frozen=True, slots=True)
class StepOptions:
    """Options of `export` of an estimator in motion."""

    period: float | None = flag(
        None,
        "--period",
        only=Kind.MOVING,
        type=float,
        metavar="SECONDS",
        help="Of an estimator in motion: the usual time between two samples.",
    )
    constants: Assignments = flag(
        (),
        "--set",
        only=Kind.MOVING,
        of=Assignment,
        metavar="NAME=VALUE",
        help="Set a constant of the estimator.",
    )
    motion: MotionOptions = field(default_factory=MotionOptions)
    sensors: SensorOptions = field(default_factory=SensorOptions)


def step_of(name: str, options: StepOptions, single: bool) -> str:
    """C source of the filter's step of the estimator in motion called `name`."""
    import numpy as np

    from casest.data.run import Run
    from casest.dynamics.intensities import with_stated
    from casest.dynamics.stepwise import checked_period

    moving = moving_model(name, options.constants, options.motion)
    if options.period is None:
        raise UsageError(f"{name}: give the usual time between two samples: --period SECONDS")
    time = np.array([0.0, checked_period(moving, options.period)])
    blank = Run.raw("two samples", {"t": time[:, None]}, units={}, time=time)
    stated = with_stated(moving, blank, options.sensors.stds(moving))
    return _source(stated, options.period, single)


def is_filtered(given: Path) -> bool:
    """Is it the folder of `casest filter`, or its file?"""
    return given.name == FILTERED or (given / FILTERED).is_file()


def step_of_folder(given: Path, single: bool) -> str:
    """C source of the step of the very filter that left its states there."""
    from casest.dynamics.stepwise import checked_period
    from casest.report.next_command import typed_words

    file = given if given.name == FILTERED else given / FILTERED
    found = _read(file)
    try:
        words, step = typed_words(found["reproduce"]["command"]), found["step"]
        own = {str(n): float(q) for n, q in step["intensities"].items()}
        period = float(step["period"])
    except (AttributeError, KeyError, TypeError, ValueError):
        words = None
    if words is None or not words.arguments:
        raise DataError(
            f"{file}: does not say what step its filter took: an older casest wrote it, or another "
            "program; filter the record again"
        )
    constants, stds = (
        tuple(Assignment(flag, str(v)) for f, v in words.options if f == flag)
        for flag in ("--set", "--std")
    )
    moving = moving_model(
        _as_it_was(words.arguments[0], found), constants, MotionOptions(stds=stds)
    )
    states = {s.name: own.get(s.name, 0.0) for s in moving.states}
    signals = {s.name: own[s.name] for s in moving.signals if own.get(s.name)}
    moving = moving.driven(**states).sensing(**signals)
    return _source(moving, checked_period(moving, period), single)


def _as_it_was(name: str, found: Any) -> str:
    """The model where it was when the record was filtered; its file is run only if it is that."""
    from casest.saved.model import refuse_changed

    path, colon, own = name.partition(":")
    if not path.endswith(".py"):
        return name
    declared = found.get("declared_in") or {}
    file = Path(str(declared.get("file", path)))
    refuse_changed(file, declared.get("sha256"), "filter")
    return f"{file}{colon}{own}"


def _read(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{file}: cannot be read: {error}") from None


def _source(moving: Dynamics, period: float, single: bool) -> str:
    from casest.correction.filter_c import filter_source
    from casest.dynamics.stepwise import stepwise

    return filter_source(stepwise(moving, period), single)
