"""From the words of a command line to models, records and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casest.cli.shared import Options, progress
from casest.errors import CasestError, UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model
    from casest.dynamics import Dynamics


def tuned_noise(moving: Dynamics, run: Run, options: Options) -> tuple[Any, Options]:
    """Noise intensities as --noise, --sensor-noise or --rest ask for them, and what a rest said."""
    from casest.data import load_runs
    from casest.dynamics import intensities

    if options["noise"] == "ml":
        if options["stated"] or options["rest"]:
            raise UsageError("--noise ml finds every intensity: leave --sensor-noise, --rest out")
        progress("looking for the most likely noise intensities")
        return intensities.most_likely(moving, run), {}
    stds = dict(number_pair(text, "--sensor-noise") for text in options["stated"])
    stated = intensities.from_stated(moving, run, stds) if stds else None
    if options["rest"] is None:
        return stated, {}
    inputs = [s for s in moving.signals if s.name not in (*moving.measured_signals, "t")]
    arguments = reading_arguments(options)
    names = {s.name for s in inputs}
    for key in ("columns", "units", "scales"):
        arguments[key] = {n: v for n, v in arguments[key].items() if n in (*names, "t")}
    (rest,) = load_runs([options["rest"]], inputs, **arguments)[:1]
    tuned, found = intensities.from_rest(moving, rest)
    if stated:
        both = intensities.from_stated(tuned.model, run, stds).model
        tuned = intensities.Tuned(both, f"{tuned.how} and {stated.how}")
    return tuned, {"allan": intensities.told(found)}


def moving_model(name: str, options: Options) -> Dynamics:
    """The estimator with its options applied."""
    from casest.dynamics import Dynamics
    from casest.results.find import find_any

    moving = find_any(name)
    if not isinstance(moving, Dynamics):
        raise UsageError(f"{name} is no estimator in motion: casest calibrate, close or observe it")
    constants = dict(number_pair(text, "--set") for text in options["constants"])
    moving = moving.having(**constants)
    intensities = dict(number_pair(text, "--intensity") for text in options["intensities"])
    sensed = {s.name: intensities.pop(s.name) for s in moving.signals if s.name in intensities}
    moving = moving.driven(**intensities).sensing(**sensed)
    return moving.known_to(**dict(number_pair(t, "--std") for t in options["stds"]))


def moving_record(name: str, data: Sequence[str], options: Options) -> tuple[Dynamics, Run]:
    """The estimator with its options applied, and its one record."""
    from casest.data import load_runs

    moving = moving_model(name, options)
    if len(data) != 1:
        raise UsageError(f"{name}: a trajectory is one file, not {len(data)}")
    progress(f"reading {data[0]}")
    gaps = moving.may_be_missing
    runs = load_runs(list(data), moving.signals, gaps=gaps, **reading_arguments(options))
    if len(runs) != 1:
        raise UsageError(f"{data[0]} holds {len(runs)} runs; a trajectory is one")
    return moving, runs[0]


def number_pair(text: str, option: str) -> tuple[str, float]:
    """`name=number`."""
    key, value = _pair(text, option)
    try:
        return key, float(value)
    except ValueError:
        raise UsageError(f"{option} {text}: {value!r} is no number") from None


def number_list(text: str, option: str) -> tuple[str, list[float]]:
    """`name=1,2,3`."""
    key, value = _pair(text, option)
    try:
        return key, [float(part) for part in value.split(",")]
    except ValueError:
        raise UsageError(f"{option} {text}: {value!r} are no numbers") from None


def declared_model(name: str, options: Options) -> Model:
    """The model with --set, --free, --fix, --shared, --per-run and --effects applied."""
    from casest.declaration.dimensions import check_units
    from casest.declaration.symbols import Constant, Parameter, constant
    from casest.effects.placing import placed_in
    from casest.results.find import find_effects, find_model

    model = find_model(name)
    for path in options["effects"]:
        for effect in find_effects(path):
            model = model.with_effect(placed_in(effect, model))
            check_units(model)
    for text in options["constants"]:
        key, value = named_value(text, "--set", model)
        if isinstance(model[key], Parameter):
            raise UsageError(
                f"{key} is an unknown of {name}, not a constant; hold it with --fix {text}"
            )
        model = model.having(**{key: value if isinstance(value, Constant) else constant(value, "")})
    for key in options["free"]:
        model = model.freed(key)
    for text in options["fix"]:
        key, value = named_value(text, "--fix", model)
        model = model.having(**{key: value})
    for key in options["shared"]:
        model = model.scoped(key, "all")
    for key in options["per_run"]:
        model = model.scoped(key, "run")
    return model


def named_value(text: str, option: str, model: Model) -> tuple[str, Any]:
    """`name=value` as a name and a number, array, or constant with unit."""
    from casest.cli.values import parse_value

    key, equals, value = text.partition("=")
    if not equals or not value:
        raise UsageError(f"{option} {text}: write it as {option} name=value")
    return key, parse_value(key, value, option, model)


def start_value(text: str, model: Model) -> tuple[str, Any]:
    """`name=value` as a start value in the parameter's own unit."""
    from casest.declaration.symbols import Parameter

    key, value = named_value(text, "--start", model)
    if not isinstance(model[key], Parameter):
        raise UsageError(f"--start {text}: {key} is no unknown of {model.name}")
    return key, model.having(**{key: value})[key].array


def reading_arguments(options: Options) -> Options:
    """Keyword arguments of `load_runs`."""
    pairs = {}
    for key, option in (("columns", "--columns"), ("units", "--unit"), ("scales", "--scale")):
        pairs[key] = dict(_pair(text, option) for text in options[key])
    for name, text in pairs["scales"].items():
        _checked_scale(name, text)
    columns = {name: tuple(value.split(",")) for name, value in pairs["columns"].items()}
    return {
        "columns": columns,
        "units": pairs["units"],
        "scales": pairs["scales"],
        "rate": options["rate"],
        "at_rest": options["at_rest"],
        "time_zero": options["time_zero"],
    }


def _checked_scale(name: str, text: str) -> None:
    from casest.data.scaling import parse_scale

    try:
        parse_scale(text)
    except CasestError as error:
        raise type(error)(f"--scale {name}={text}: {error}") from None


def _pair(text: str, option: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key or not value:
        raise UsageError(f"{option} {text}: write it as {option} name=value")
    return key, value


def records(model: Model, data: Sequence[str], options: Options) -> tuple[Run, ...]:
    """The runs in the files."""
    from casest.data import load_runs

    progress(f"reading {', '.join(data)}")
    seen: set[Path] = set()
    for name in data:
        if Path(name).resolve() in seen:
            raise UsageError(f"{name} is given twice: it would count as two records")
        seen.add(Path(name).resolve())
    return load_runs(list(data), model.signals, **reading_arguments(options))


def held_out(model: Model, data: Sequence[str], options: Options) -> tuple[Run, ...]:
    """Records that the fit never saw."""
    fitted = {Path(name).resolve() for name in data}
    for name in options["holdout"]:
        if Path(name).resolve() in fitted:
            raise UsageError(f"--holdout {name}: the fit has seen this file; give another record")
    return records(model, options["holdout"], options) if options["holdout"] else ()
