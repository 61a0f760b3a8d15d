"""What a plan begins with: a model before any data, or what a saved result knows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casest.cli.assignments import Assignment, Assignments
from casest.cli.loading import declared_model
from casest.cli.options import ReadingOptions
from casest.cli.plan_options import PlanOptions
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model
    from casest.declaration.symbols import Signal
    from casest.plan.candidates.candidates import Candidates, Noise
    from casest.plan.goals import Measures


@dataclass(frozen=True)
class Situation:
    """What a plan begins with: the model, what is known of it, the noise."""

    name: str
    model: Model
    values: Mapping[str, Any]
    noise: Noise
    units: Mapping[str, str]
    names: tuple[str, ...] = ()
    information: Any = None
    after: str | None = None
    content: Mapping[str, Any] = field(default_factory=dict)


def of_model(name: str, options: PlanOptions) -> Situation:
    """A model before any data: its declared starts, or --value."""
    from casest.data.run import Run
    from casest.results.units import unit_table
    from casest.simulation.record import truth

    model = declared_model(name, options.model)
    given = dict(given.of(model) for given in options.values)
    values = truth(model, {n: model.having(**{n: v})[n].array for n, v in given.items()})
    stated = dict(given.pair() for given in options.reading.units)
    units = {s.name: s.unit or stated.get(s.name) for s in model.signals}
    empty = Run.raw("planned", {s.name: _no_rows(s.size) for s in model.signals}, units=units)
    return Situation(name, model, values, _noise(model, options, units), unit_table(model, [empty]))


def _no_rows(size: int) -> Any:
    import numpy as np

    return np.zeros((0, size))


def of_result(path: Path, options: PlanOptions) -> Situation:
    """What a saved result knows."""
    from casest.saved.planning import started

    for name in ("constants", "free", "fix", "shared", "per_run", "effects"):
        if getattr(options.model, name):
            raise UsageError(
                f"{path} is a result, and has its model: leave --{name.replace('_', '-')} out"
                if name != "constants"
                else f"{path} is a result, and has its model: leave --set out"
            )
    if options.values:
        raise UsageError(f"{path} is a result, and has its values: leave --value out")
    start = started(path)
    noise = _noise(start.model, options, start.table, start.sigma, start.over)
    return Situation(
        str(start.content["model"]),
        start.model,
        start.values,
        noise,
        start.table,
        start.names,
        start.information,
        str(path),
        start.content,
    )


def _noise(
    model: Model,
    options: PlanOptions,
    known: Mapping[str, str | None],
    sigma: Any = None,
    over: float = 1.0,
) -> Noise:
    """The noise as stated, else that of the result, else of size one. `known`: units."""
    import numpy as np

    from casest.plan.candidates.candidates import Noise

    readings = {s.name: s for s in model.readings}
    stated = {} if sigma is not None else _declared(readings, options)
    for given in options.noise:
        name, text = given.pair()
        if name not in readings:
            raise UsageError(
                f"--sensor-noise {given.text}: {model.name} reads {', '.join(readings)}"
            )
        own = readings[name].unit or known.get(name)
        stated[name] = _std(f"--sensor-noise {given.text}", text, own)
    if sigma is None or stated:
        return Noise(np.ones(len(model.axes)), stated, known=bool(stated))
    return Noise(sigma * np.sqrt(max(over, 1.0)), {})


def _declared(readings: Mapping[str, Signal], options: PlanOptions) -> dict[str, float]:
    """Standard deviations of readings as the model declares them, where no option does."""
    given, found = {given.pair()[0] for given in options.noise}, {}
    for name, signal in readings.items():
        if signal.std is None or name in given:
            continue
        if len(set(signal.std)) > 1:
            raise UsageError(
                f"std of {name} is declared for each component, and a plan takes one number: "
                f"--sensor-noise {name}=STD"
            )
        found[name] = signal.std[0]
    return found


def _std(option: str, text: str, own: str | None) -> float:
    """A standard deviation in the signal's own unit."""
    from casest import units
    from casest.errors import CasestError

    try:
        number, unit = units.parse_quantity(text)
        factor = 1.0 if not unit or not own or unit == own else units.conversion(unit, own)[0]
    except CasestError as error:
        raise type(error)(f"{option}: {error}") from None
    if unit == "%" and own != "%":
        raise UsageError(f"{option}: a share of readings that are not there yet; give a number")
    if not 0 < number < float("inf"):
        raise UsageError(f"{option}: a standard deviation is above zero, and {text} is not")
    return number * factor


def possible_of(situation: Situation, options: PlanOptions) -> Any:
    """What can be measured, as the options say it."""
    from casest.plan.candidates.finding import Possible

    said = options.possible
    table = _table(situation.model, said.candidates, options.reading) if said.candidates else None
    return Possible(
        dict(given.pair() for given in said.vary),
        said.step,
        said.reach,
        said.duration,
        options.reading.rate,
        table,
    )


def _table(model: Model, file: str, reading: ReadingOptions) -> tuple[Run, ...]:
    """Rows of a file with the signals that are not predicted, and what each costs."""
    from casest.data import load_runs
    from casest.plan.candidates.rows import COST

    needed = [s for s in model.signals if s.name != model.traced.measured]
    called = [given for given in reading.columns if given.pair()[0] == COST]
    others = tuple(given for given in reading.columns if given not in called)
    runs = load_runs([file], needed, **replace(reading, columns=others).keywords())
    return tuple(_costing(run, given.pair()[1]) for given in called[-1:] for run in runs) or runs


def _costing(run: Run, column: str) -> Run:
    """The run with its costs where they are looked for."""
    from casest.errors import DataError
    from casest.plan.candidates.rows import COST

    if column not in run.columns:
        there = ", ".join(run.columns) or "no further columns"
        raise DataError(f"--columns {COST}={column}: {run.file} has {there}")
    return replace(run, columns={**run.columns, COST: run.columns[column]})


def covered(situation: Situation) -> Any:
    """Directions of up (N, 3) in the records that the result was made from, if they are there."""
    from casest.errors import CasestError
    from casest.plan.candidates.poses import upward

    runs = records_of(situation)
    try:
        return None if runs is None else upward(situation.model, situation.values, runs)
    except CasestError:  # a reading that has no pose: nothing is drawn
        return None


def records_of(situation: Situation, model: Model | None = None) -> tuple[Run, ...] | None:
    """The records that a result was made from, read as they were; None where they are gone.

    For another `model`, what that one does not read stays a column.
    """
    from casest.data import load_runs
    from casest.errors import CasestError
    from casest.report.next_command import typed_words

    words = typed_words(situation.content.get("reproduce", {}).get("command", ""))
    if words is None:
        return None

    def given(flag: str) -> Assignments:
        return tuple(Assignment(flag, v) for f, v in words.options if f == flag and v)

    flags = {flag for flag, _ in words.options}
    rate = next((float(v) for f, v in words.options if f == "--rate" and v), None)
    reading = ReadingOptions(
        given("--columns"), given("--unit"), given("--scale"), rate, "--at-rest" in flags
    )
    try:
        data = list(situation.content["data"])
        return load_runs(data, (model or situation.model).signals, **reading.keywords())
    except (CasestError, OSError, ValueError):  # moved or changed since
        return None


def measures_of(known: Any, found: Candidates) -> Measures:
    """What goals can be about: of anything that has a model, values and units."""
    from casest.plan.corrected import corrected_slopes
    from casest.plan.goals import Measures

    model, slopes = known.model, None
    if found.run is not None:
        slopes = corrected_slopes(model, known.values, found.run)
    name = model.traced.corrected or ""
    units = {n: known.units.get(n, "rad") for n in found.names}
    return Measures(found.names, units, name, known.units.get(name, ""), slopes)
