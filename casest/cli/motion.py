"""`observe` and `filter`: what data can see, and states over time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from casest.cli.assignments import Assignment, Assignments
from casest.cli.flags import Kind, flag, refuse, taking
from casest.cli.loading import in_motion, model_and_records, moving_model, trajectory
from casest.cli.options import (
    DATA,
    FOLDER,
    ModelOptions,
    MotionOptions,
    ReadingOptions,
    SensorOptions,
    model_argument,
)
from casest.cli.shared import commands, echo, last_words, progress, reported, typed, write
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.dynamics import Dynamics
    from casest.dynamics.intensities import Tuned


@dataclass(frozen=True, slots=True)
class OutputOptions:
    """Where a result goes."""

    output: Path | None = flag(None, "-o", "--output", type=FOLDER, metavar="DIR", help="Folder.")
    as_json: bool = flag(False, "--json", help="Print JSON instead of text.")


@dataclass(frozen=True, slots=True)
class StructuralOptions:
    """What the structural rank supposes."""

    known: tuple[str, ...] = flag(
        (),
        "--known",
        only=Kind.MOVING,
        metavar="STATE",
        help="Without DATA: its value at the beginning is known.",
    )
    unmeasured: tuple[str, ...] = flag(
        (),
        "--unmeasured",
        only=Kind.MOVING,
        metavar="INPUT",
        help="Without DATA: an input that varies and nobody knows.",
    )
    experiments: int | None = flag(
        None,
        "--experiments",
        only=Kind.MOVING,
        type=int,
        metavar="NUMBER",
        help="Without DATA: so many records with the same parameters.",
    )


@dataclass(frozen=True, slots=True)
class ObserveOptions:
    """Options of `observe`."""

    model: ModelOptions = field(default_factory=ModelOptions)
    reading: ReadingOptions = field(default_factory=ReadingOptions)
    motion: MotionOptions = field(default_factory=MotionOptions)
    structural: StructuralOptions = field(default_factory=StructuralOptions)
    sensors: SensorOptions = field(default_factory=SensorOptions)
    result: OutputOptions = field(default_factory=OutputOptions)
    window: float | None = flag(
        None, "--window", type=float, metavar="SECONDS", help="Of the sliding eigenvalue."
    )


@commands.command()
@model_argument(Kind.FITTED, Kind.MOVING)
@click.argument("data", nargs=-1, type=click.Path())
@taking(ObserveOptions)
def observe(model_name: str, data: tuple[str, ...], options: ObserveOptions) -> int:
    """What these data, or this trajectory, can see: rank, and what is hidden, in words.

    Without DATA: what any record of an estimator in motion could show (structural rank). Exit
    code 0 even where something is not observable.
    """
    from casest.declaration.model import Model
    from casest.dynamics.intensities import with_stated
    from casest.report.text.observability import observe_text
    from casest.results.file import as_json
    from casest.results.find import find_any
    from casest.results.observability import (
        Observability,
        observe_motion,
        observe_parameters,
        observe_structure,
    )

    found = find_any(model_name)
    moves = in_motion(model_name, options.sensors)
    fits = isinstance(found, Model) or (bool(data) and found.without_noise and not moves)
    if fits or data:
        why = "is a question about an estimator in motion without DATA"
        refuse(options.structural, Kind.MOVING, why)
    if fits:
        if not data:
            raise UsageError(f"{model_name}: what can be seen depends on the record: give DATA")
        refuse(options, Kind.MOVING, f"is for estimators in motion; {model_name} is a calibration")
        model, runs = model_and_records(
            model_name, data, options.model, options.reading, options.sensors
        )
        progress(f"fitting {model_name}")
        result: Observability = observe_parameters(model, runs, data=data, command=typed())
    else:
        moving = moving_model(model_name, options.model.constants, options.motion)
        if data:
            run = trajectory(moving, model_name, data, options.reading)
            moving = with_stated(moving, run, options.sensors.stds(moving))
            progress("what the trajectory shows")
            result = observe_motion(moving, run, options.window, data=data, command=typed())
        else:
            said = options.structural
            result = observe_structure(
                moving,
                known=said.known,
                unmeasured=said.unmeasured,
                experiments=1 if said.experiments is None else said.experiments,
                command=typed(),
            )
    if options.result.output:
        from casest.report.html.motion import observe_page

        write(options.result.output / "observe.json", as_json(result.content()))
        reported(options.result.output, observe_page(result))
    if options.result.as_json:
        echo(as_json(result.content()), nl=False)
        return 0
    echo(observe_text(result))
    shown = result.observable
    last_words(options.result.output, "report.html, observe.json", trusted=shown, applies=fits)
    return 0


@dataclass(frozen=True, slots=True)
class FilterOptions:
    """Options of `filter`."""

    constants: Assignments = flag(
        (), "--set", of=Assignment, metavar="NAME=VALUE", help="Set a constant of the model."
    )
    reading: ReadingOptions = field(default_factory=ReadingOptions)
    motion: MotionOptions = field(default_factory=MotionOptions)
    result: OutputOptions = field(default_factory=OutputOptions)
    horizon: int | None = flag(
        None,
        "--horizon",
        type=click.IntRange(min=1),
        metavar="STEPS",
        help="States by so many steps at once (moving horizon): bounds are kept.",
    )
    noise: Literal["declared", "ml"] = flag(
        "declared",
        "--noise",
        type=click.Choice(["declared", "ml"]),
        help="Noise intensities: as declared, or the most likely ones for this record.",
    )
    sensors: SensorOptions = field(default_factory=SensorOptions)
    rest: str | None = flag(
        None,
        "--rest",
        type=click.Path(),
        metavar="FILE",
        help="A record at rest: noise of the inputs by its Allan deviation.",
    )


@commands.command("filter")
@model_argument(Kind.MOVING)
@DATA
@taking(FilterOptions)
def filter_command(model_name: str, data: tuple[str, ...], options: FilterOptions) -> int:
    """States over time by the Kalman filter and smoother, with innovations diagnosed.

    With --horizon by the last steps at once, within the bounds of states and unknown constants.
    """
    from casest.report.text.states import filter_text
    from casest.results import states
    from casest.results.file import as_json

    moving = moving_model(model_name, options.constants, options.motion)
    run = trajectory(moving, model_name, data, options.reading)
    tuned, told = tuned_noise(moving, run, options)
    progress("moving horizon" if options.horizon else "filter and smoother")
    said = {**told, "horizon": options.horizon}
    result = states.follow(moving, run, tuned, **said, data=data, command=typed())
    if options.result.output:
        from casest.report.html.motion import filter_page

        write(options.result.output / "states.csv", states.states_csv(result.filtered))
        write(options.result.output / "filter.json", as_json(result.content()))
        reported(options.result.output, filter_page(result))
    if options.result.as_json:
        echo(as_json(result.content()), nl=False)
        return 0
    echo(filter_text(result))
    last_words(options.result.output, "report.html, filter.json, states.csv")
    return 0


def tuned_noise(moving: Dynamics, run: Run, options: FilterOptions) -> tuple[Tuned | None, Any]:
    """Noise intensities as --noise, --sensor-noise or --rest ask for them, and what a rest said."""
    from casest.dynamics import intensities

    if options.noise == "ml":
        if options.sensors.stated or options.rest:
            raise UsageError("--noise ml finds every intensity: leave --sensor-noise, --rest out")
        progress("looking for the most likely noise intensities")
        return intensities.most_likely(moving, run), {}
    stds = options.sensors.stds(moving)
    stated = intensities.from_stated(moving, run, stds) if stds else None
    if options.rest is None:
        return stated, {}
    rest = record_at_rest(moving, options.rest, options.reading)
    tuned, found = intensities.from_rest(moving, rest)
    if stated:
        both = intensities.from_stated(tuned.model, run, stds).model
        tuned = intensities.Tuned(both, f"{tuned.how} and {stated.how}")
    return tuned, {"allan": intensities.told(found)}


def record_at_rest(moving: Dynamics, file: str, options: ReadingOptions) -> Run:
    """The inputs of an estimator in a record of their own; it need not have what is measured."""
    from casest.data import load_runs

    inputs = [s for s in moving.signals if s.name not in (*moving.measured_signals, "t")]
    names = {"t", *(s.name for s in inputs)}
    return load_runs([file], inputs, **options.of_signals(names).keywords())[0]
