"""Runs from whatever a caller has: runs, files, data frames, mappings of arrays, arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

from casest.data.bind import Frame, Path_, listed_data, load_runs
from casest.data.finding import Choice
from casest.data.run import Run
from casest.declaration.model import Model
from casest.effects.placing import told
from casest.errors import UsageError
from casest.interface.sensor_noise import SensorNoise, said, with_sensor_noise
from casest.results.find import find_model

#: What a fit is made from.
Data = Run | Path_ | Frame | Sequence[Run | Path_ | Frame]


class Reading(TypedDict, total=False):
    """How columns become signals, as in `casest.load_runs`."""

    columns: Choice | None
    units: Mapping[str, str] | None
    scales: Mapping[str, str] | None
    rate: float | None
    at_rest: bool | Sequence[str]
    time_zero: Literal["first", "column"]


def model_and_runs(
    model: Model | str, data: Data, reading: Reading, noise: SensorNoise | None = None
) -> tuple[Model, tuple[Run, ...]]:
    """The model, also by its name on the command line, and its runs, with the noise as stated.

    Where the data are read here, effects are told the numbers that data tell them.
    """
    found = find_model(model) if isinstance(model, str) else model
    if not isinstance(found, Model):
        raise UsageError(
            f"the model is {model!r:.60}, of type {type(model).__name__}: give one that @model "
            "declared, or a shipped name such as 'norm-triangular'"
        )
    given = [data] if isinstance(data, Run) else data
    if isinstance(given, Sequence) and any(isinstance(one, Run) for one in given):
        return _with_noise(found, _as_they_are(given, reading), noise)
    listed = listed_data(given)
    if not listed:
        return found, ()
    runs = load_runs(listed, found.signals, **stated(reading))
    return _with_noise(told(found, runs) if found.effects else found, runs, noise)


def _with_noise(
    model: Model, runs: tuple[Run, ...], noise: SensorNoise | None
) -> tuple[Model, tuple[Run, ...]]:
    """With the noise that is stated, declared or in columns, where none was stated before."""
    if model.noise is not None and not noise:
        return model, runs
    return with_sensor_noise(model, runs, said(noise, model))


def stated(reading: Reading) -> Any:
    """What is said of columns, without what nobody said."""
    return {name: value for name, value in reading.items() if value not in (None, {})}


def _as_they_are(given: Sequence[Any], reading: Reading) -> tuple[Run, ...]:
    """Runs that were read before."""
    other = next((one for one in given if not isinstance(one, Run)), None)
    if other is not None:
        raise UsageError(
            f"runs and a {type(other).__name__} are given together: give either runs, or files and "
            "frames"
        )
    said = [name for name, value in stated(reading).items() if value not in (False, "first")]
    if said:
        raise UsageError(
            f"{', '.join(f'{name}=…' for name in said)} says how files and frames are read, and "
            "these are runs already: say it where they are read, in load_runs"
        )
    return tuple(given)
