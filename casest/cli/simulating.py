"""`simulate`: records of known truth."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from casest.cli.assignments import Assignment, Assignments
from casest.cli.completing import EffectName
from casest.cli.flags import Kind, flag, refuse, taking
from casest.cli.loading import declared_model, in_motion, moving_model
from casest.cli.options import (
    FOLDER,
    ModelOptions,
    MotionOptions,
    ReadingOptions,
    SensorOptions,
    Words,
    model_argument,
)
from casest.cli.shared import commands, echo, progress, typed
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model
    from casest.declaration.shapes import Array


@dataclass(frozen=True, slots=True)
class SimulateOptions:
    """Options of `simulate`."""

    model: ModelOptions = field(default_factory=ModelOptions)
    reading: ReadingOptions = field(default_factory=ReadingOptions)
    values: Assignments = flag(
        (), "--value", of=Assignment, metavar="NAME=VALUE", help="True value."
    )
    effect: Words = flag(
        (),
        "--effect",
        type=EffectName(),
        metavar="NAME[(COLUMN)]",
        help="An effect to add.",
    )
    noise: float | None = flag(
        None,
        "--noise",
        type=float,
        help="Standard deviation of each reading; in motion of each output, else as declared.",
    )
    motion: MotionOptions = field(default_factory=MotionOptions)
    sensors: SensorOptions = field(default_factory=SensorOptions)
    duration: float | None = flag(
        None,
        "--duration",
        type=float,
        help="Seconds, with --rate, where time is all it needs.",
    )
    directions: int | None = flag(
        None,
        "--directions",
        only=Kind.FITTED,
        type=int,
        metavar="N",
        help="N random directions or attitudes.",
    )
    given: str | None = flag(
        None, "--input", type=click.Path(), help="Record with the signals it needs."
    )
    seed: int = flag(0, "--seed", show_default=True)
    output: Path = flag(Path("simulated"), "-o", "--output", type=FOLDER, metavar="DIR")


@commands.command()
@model_argument(Kind.FITTED, Kind.MOVING)
@taking(SimulateOptions)
def simulate(model_name: str, options: SimulateOptions) -> None:
    """A record with known truth: DIR/record.csv and DIR/truth.json.

    Unknowns are at their declared start unless --value says otherwise, effects at a typical size.
    Of an estimator in motion the states over time are in DIR/truth.csv; the motion is a smooth
    random one, or follows the inputs of --input.
    """
    if in_motion(model_name):
        simulation_in_motion(model_name, options, typed())
    else:
        simulation(model_name, options, typed())


def simulation_in_motion(model_name: str, options: SimulateOptions, command: str) -> None:
    """A trajectory, states along it, readings, files."""
    import numpy as np

    from casest.data.run import Run
    from casest.dynamics import intensities
    from casest.dynamics.transition import checked_time
    from casest.report.next_command import following
    from casest.simulation import motion, record

    refuse(options, Kind.FITTED, "is no option of an estimator in motion")
    moving = moving_model(model_name, options.model.constants, options.motion)
    stds = options.sensors.stds(moving)
    values = dict(given.numbers() for given in options.values)
    inputs = None
    if options.given:
        along = motion.inputs_of(moving, options.given, options.reading.keywords())
        time, inputs = np.asarray(along.time, float), along.signals
    else:
        time = record.times(options.duration, options.reading.rate)
    blank = Run.raw("simulated", {"t": time[:, None]}, units={"t": "s"}, time=time)
    checked_time(blank)
    if stds:
        moving = intensities.from_stated(moving, blank, stds).model
    progress(f"simulating {model_name}")
    made = motion.simulated_motion(
        moving,
        time,
        np.random.default_rng(options.seed),
        inputs=inputs,
        noise=options.noise,
        effects=options.effect,
        values=values,
    )
    paths = motion.written_motion(options.output, made, options.seed, command)
    for path in paths:
        echo(f"Written: {path}")
    echo(f"\n{following(command, file=paths[0], moving=True)}")


def simulation(model_name: str, options: SimulateOptions, command: str) -> None:
    """Signals, truth, readings, files."""
    import numpy as np

    from casest.effects import CATALOGUE
    from casest.report.next_command import following
    from casest.results.find import find_effects
    from casest.simulation import record
    from casest.simulation.sensor_noise import with_noise

    refuse(options, Kind.MOVING, f"is for estimators in motion; {model_name} has --noise")
    own = tuple(e for path in options.model.effects for e in find_effects(path))
    model = declared_model(model_name, replace(options.model, effects=()))
    rng = np.random.default_rng(options.seed)
    if options.given:
        run = record.with_record(model, options.given, options.reading.keywords())
    else:
        run = record.without_data(
            model,
            duration=options.duration,
            rate=options.reading.rate,
            directions=options.directions,
            rng=rng,
        )
    model = record.with_effects(model, run, options.effect, (*CATALOGUE, *own))
    given = dict(given.of(model) for given in options.values)
    values = record.truth(model, {name: value.array for name, value in given.items()})
    progress(f"simulating {model_name}")
    noise = options.noise or 0.0
    readings = record.simulated(model, run, values, noise, rng)
    run = replace(run, signals={**run.signals, **readings})
    run, sensors = with_noise(run, _of_sensors(model, run, readings, options), rng)
    paths = record.written(
        options.output, model, run, values, noise, sensors, options.seed, command
    )
    for path in paths:
        echo(f"Written: {path}")
    echo(f"\n{following(command, file=paths[0])}")


def _of_sensors(
    model: Model, run: Run, measured: Collection[str], options: SimulateOptions
) -> dict[str, Array]:
    """Noise of single signals, as --sensor-noise says it, else as it is declared."""
    import numpy as np

    from casest.interface.sensor_noise import noise_of

    found = noise_of(model, [run], options.sensors.stated, look=False)[0]
    said = {name for key in found for name in key.split(",")}
    twice = sorted(said.intersection(measured))
    if options.noise is not None and twice:
        raise UsageError(
            f"--noise and --sensor-noise {twice[0]}=… both say the noise of {twice[0]}: give one"
        )
    said |= set(measured) if options.noise is not None else set()
    declared = {
        s.name: [np.array([s.std])]
        for s in model.signals
        if s.std is not None and s.name not in said
    }
    return {key: arrays[0] for key, arrays in {**declared, **found}.items()}
