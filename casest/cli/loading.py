"""The model and the records that a command line names, with its options applied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from casest.cli.assignments import Assignments
from casest.cli.options import ModelOptions, MotionOptions, ReadingOptions, SensorOptions
from casest.cli.shared import progress
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.effect import Effect
    from casest.declaration.model import Model
    from casest.dynamics import Dynamics


def declared_model(name: str, options: ModelOptions) -> Model:
    """The model with --set, --free, --fix, --shared, --per-run and --effects applied."""
    from casest.results.find import find_model

    model = _with_effects(find_model(name), options.effects)
    model = _with_constants(model, options.constants, name)
    for symbol in options.free:
        model = model.freed(symbol)
    for given in options.fix:
        symbol, value = given.of(model)
        model = model.having(**{symbol: value})
    for symbol in options.shared:
        model = model.scoped(symbol, "all")
    for symbol in options.per_run:
        model = model.scoped(symbol, "run")
    return model


def _with_effects(model: Model, files: Sequence[str]) -> Model:
    from casest.declaration.dimensions import check_units
    from casest.effects.placing import placed_in
    from casest.results.find import find_asked, without_grid

    for text in files:
        for effect, column in find_asked(text):
            columns = {name: column for name, _ in effect.columns} if column else {}
            effect = without_grid(effect) if column else effect
            model = model.with_effect(placed_in(effect, model), columns=columns)
            check_units(model)
    return model


def model_and_records(
    name: str,
    data: Sequence[str],
    options: ModelOptions,
    reading: ReadingOptions,
    sensors: SensorOptions | None = None,
) -> tuple[Model, tuple[Run, ...]]:
    """The declared model and the runs in the files, from which its effects are told numbers.

    With what is known of the noise of `sensors`, where a command asks for that.
    """
    from casest.effects.placing import told

    model = declared_model(name, options)
    runs = records(model, data, reading)
    model = with_prior(model, runs, options.prior)
    if sensors is not None:
        model, runs = noisy(model, runs, sensors)
    return told(model, runs), runs


def with_prior(model: Model, runs: Sequence[Run], prior: str | None) -> Model:
    """The model with --prior applied."""
    if prior is None:
        return model
    from casest.results.earlier import earlier_result
    from casest.results.units import unit_table

    if not prior.startswith("@"):
        raise UsageError(f"--prior {prior}: write it as --prior @old/result.json")
    earlier = earlier_result(prior[1:], model)
    found = earlier.prior(model, unit_table(model, runs))
    return replace(model, prior=found.beside(model.prior))


def noisy(
    model: Model, runs: Sequence[Run], sensors: SensorOptions
) -> tuple[Model, tuple[Run, ...]]:
    """The model and its runs with --sensor-noise applied."""
    from casest.interface.sensor_noise import with_sensor_noise

    return with_sensor_noise(model, runs, sensors.stated)


def _with_constants(model: Model, constants: Assignments, name: str) -> Model:
    from casest.declaration.symbols import Constant, Parameter, constant

    for given in constants:
        symbol, value = given.of(model)
        if isinstance(model[symbol], Parameter):
            raise UsageError(
                f"{symbol} is an unknown of {name}, not a constant; hold it with --fix {given.text}"
            )
        value = value if isinstance(value, Constant) else constant(value, "")
        model = model.having(**{symbol: value})
    return model


def records(
    model: Model, data: Sequence[str], options: ReadingOptions, followed: Sequence[str] = ()
) -> tuple[Run, ...]:
    """The runs in the files; `followed` columns matter as signals do (see `load_runs`)."""
    from casest.data import load_runs

    progress(f"reading {', '.join(data)}")
    seen: set[Path] = set()
    for name in data:
        if Path(name).resolve() in seen:
            raise UsageError(f"{name} is given twice: it would count as two records")
        seen.add(Path(name).resolve())
    known = {"t", *model.quantities, *(s.name for s in model.signals)}
    extra = [column for column in followed if column not in known]
    given = {**model.reading, **options.keywords()}
    given["at_rest"] = given["at_rest"] or model.resting
    return load_runs(list(data), model.signals, extra=extra, **given)


def held_out(
    model: Model,
    apart: Sequence[str],
    data: Sequence[str],
    options: ReadingOptions,
    followed: Sequence[str] = (),
) -> tuple[Run, ...]:
    """The runs in the files `apart`, which the fit to `data` never saw."""
    fitted = {Path(name).resolve() for name in data}
    for name in apart:
        if Path(name).resolve() in fitted:
            raise UsageError(f"--holdout {name}: the fit has seen this file; give another record")
    return records(model, apart, options, followed) if apart else ()


def in_motion(name: str, sensors: SensorOptions | None = None) -> bool:
    """Is it an estimator in motion, driven by noise? Without it equations are a calibration.

    With what `sensors` state: noise of an input drives the states.
    """
    from casest.dynamics import Dynamics
    from casest.results.find import find_any

    found = find_any(name)
    if not isinstance(found, Dynamics):
        return False
    stated = {given.pair()[0].strip() for given in sensors.stated} if sensors else set()
    return found.driven_by_noise or not found.driving.isdisjoint(stated)


def moving_model(name: str, constants: Assignments, options: MotionOptions) -> Dynamics:
    """The estimator in motion with --set, --intensity and --std applied."""
    from casest.dynamics import Dynamics
    from casest.results.find import find_any

    moving = find_any(name)
    if not isinstance(moving, Dynamics):
        raise UsageError(f"{name} is no estimator in motion: casest calibrate, close or observe it")
    units = {c.name: c.unit for c in moving.constants} | {s.name: s.unit for s in moving.states}
    moving = moving.having(**dict(given.number(units) for given in constants))
    intensities = dict(given.number() for given in options.intensities)
    sensed = {s.name: intensities.pop(s.name) for s in moving.signals if s.name in intensities}
    moving = moving.driven(**intensities).sensing(**sensed)
    return moving.known_to(**dict(given.number(units, spread=True) for given in options.stds))


def trajectory(moving: Dynamics, name: str, data: Sequence[str], options: ReadingOptions) -> Run:
    """The one record of the estimator that is called `name` on the command line."""
    from casest.data import load_runs

    if len(data) != 1:
        raise UsageError(f"{name}: a trajectory is one file, not {len(data)}")
    progress(f"reading {data[0]}")
    gaps = moving.may_be_missing
    own = options.keywords()
    runs = load_runs(list(data), moving.signals, gaps=gaps, between=moving.input_signals, **own)
    if len(runs) != 1:
        raise UsageError(f"{data[0]} holds {len(runs)} runs; a trajectory is one")
    return runs[0]


def asked_effects(
    asked: Sequence[str],
) -> tuple[set[str], tuple[Effect, ...], tuple[str, ...]]:
    """Names of shipped effects that --effects says are there; those to try beside the catalogue;
    columns that they are said to follow."""
    from casest.effects import CATALOGUE
    from casest.results.find import find_asked

    catalogue = {e.name for e in CATALOGUE}
    known, own, followed = catalogue & {*asked}, [], dict[str, None]()
    for text in asked:
        for effect, column in find_asked(text) if text not in known else ():
            if (column or effect.kind == "time") and effect.name in catalogue:
                known.add(text)
            followed |= {column: None} if column else {}
            columns = tuple((name, f"={column}") for name, _ in effect.columns)
            own.append(replace(effect, columns=columns) if column else effect)
    return known, tuple(own), tuple(followed)
