"""`apply`, `simulate`, `export` and `completion`: what a result or a model is used for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from casest.cli.completing import EffectName, ModelName
from casest.cli.options import driving_options, model_options, reading_options
from casest.cli.shared import (
    FOLDER,
    Options,
    commands,
    echo,
    progress,
    shown,
    typed,
    write,
)
from casest.cli.words import (
    declared_model,
    moving_model,
    named_value,
    number_list,
    number_pair,
    reading_arguments,
)
from casest.errors import UsageError


@commands.command()
@click.argument("result_path", metavar="RESULT", type=click.Path(path_type=Path))
@click.argument("data", type=click.Path())
@reading_options
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="FILE|DIR",
    help="A .csv file, or a folder for corrected.csv; without it, standard output.",
)
@click.option("--force", is_flag=True, help="Apply a result that was refused.")
def apply(result_path: Path, data: str, **options: Any) -> None:
    """Correct the readings in DATA with a saved RESULT (result.json, or its folder)."""
    from casest.correction import apply as correcting
    from casest.correction.export import applied, is_exported
    from casest.correction.inverse import LEFT, TIMED
    from casest.report.next_command import following

    arguments = reading_arguments(options)
    progress(f"correcting {data}")
    timed: tuple[str, ...] = ()
    if is_exported(result_path):
        text, left = applied(result_path, data, arguments)
    else:
        text, left = correcting.corrected_csv(result_path, data, arguments, force=options["force"])
        timed = correcting.of_another_time(result_path, data)
    shown.done()
    if left:
        echo(f"casest: {LEFT}{', '.join(left)}", err=True)
    if timed:
        echo(f"casest: {TIMED}{', '.join(timed)}", err=True)
    if path := correcting.write_or_print(text, options["output"]):
        echo(f"Written: {path}")
        echo(f"\n{following(typed(), file=path)}")


@commands.command()
@click.argument("model_name", metavar="MODEL", type=ModelName())
@model_options
@reading_options
@click.option("--value", "values", multiple=True, metavar="NAME=VALUE", help="True value.")
@click.option(
    "--effect",
    multiple=True,
    type=EffectName(),
    metavar="NAME[(COLUMN)]",
    help="An effect to add.",
)
@click.option(
    "--noise",
    type=float,
    help="Standard deviation of each reading; in motion of each output, else as declared.",
)
@driving_options
@click.option("--duration", type=float, help="Seconds, with --rate, where time is all it needs.")
@click.option("--directions", type=int, metavar="N", help="N random directions or attitudes.")
@click.option("--input", "given", type=click.Path(), help="Record with the signals it needs.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("-o", "--output", type=FOLDER, default=Path("simulated"), metavar="DIR")
def simulate(model_name: str, **options: Any) -> None:
    """A record with known truth: DIR/record.csv and DIR/truth.json.

    Unknowns are at their declared start unless --value says otherwise, effects at a typical size.
    Of an estimator in motion the states over time are in DIR/truth.csv; the motion is a smooth
    random one, or follows the inputs of --input.
    """
    from casest.dynamics import Dynamics
    from casest.results.find import find_any

    if isinstance(find_any(model_name), Dynamics):
        simulation_in_motion(model_name, options, typed())
    else:
        simulation(model_name, options, typed())


#: Options of `simulate` that only static models have, and that only estimators in motion have.
STILL = ("effects", "per_run", "shared", "fix", "free", "directions")
MOVING = ("stds", "intensities", "stated")


def simulation_in_motion(model_name: str, options: Options, command: str) -> None:
    """A trajectory, states along it, readings, files."""
    import numpy as np

    from casest.data.run import Run
    from casest.dynamics import intensities
    from casest.dynamics.transition import checked_time
    from casest.report.next_command import following
    from casest.simulation import motion, record

    for name in STILL:
        if options[name]:
            raise UsageError(f"--{name.replace('_', '-')} is no option of an estimator in motion")
    moving = moving_model(model_name, options)
    stds = dict(number_pair(text, "--sensor-noise") for text in options["stated"])
    values = dict(number_list(text, "--value") for text in options["values"])
    inputs = None
    if options["given"]:
        along = motion.inputs_of(moving, options["given"], reading_arguments(options))
        time, inputs = np.asarray(along.time, float), along.signals
    else:
        time = record.times(options["duration"], options["rate"])
    blank = Run.raw("simulated", {"t": time[:, None]}, units={"t": "s"}, time=time)
    checked_time(blank)
    if stds:
        moving = intensities.from_stated(moving, blank, stds).model
    progress(f"simulating {model_name}")
    made = motion.simulated_motion(
        moving,
        time,
        np.random.default_rng(options["seed"]),
        inputs=inputs,
        noise=options["noise"],
        effects=options["effect"],
        values=values,
    )
    paths = motion.written_motion(options["output"], made, options["seed"], command)
    for path in paths:
        echo(f"Written: {path}")
    echo(f"\n{following(command, file=paths[0], moving=True)}")


def simulation(model_name: str, options: Options, command: str) -> None:
    """Signals, truth, readings, files."""
    import numpy as np

    from casest.effects import CATALOGUE
    from casest.report.next_command import following
    from casest.results.find import find_effects
    from casest.simulation import record

    for name in MOVING:
        if options[name]:
            flag = {"stds": "std", "intensities": "intensity", "stated": "sensor-noise"}[name]
            raise UsageError(f"--{flag} is for estimators in motion; {model_name} has --noise")
    own = tuple(e for path in options["effects"] for e in find_effects(path))
    model = declared_model(model_name, {**options, "effects": ()})
    rng = np.random.default_rng(options["seed"])
    if options["given"]:
        run = record.with_record(model, options["given"], reading_arguments(options))
    else:
        run = record.without_data(
            model,
            duration=options["duration"],
            rate=options["rate"],
            directions=options["directions"],
            rng=rng,
        )
    model = record.with_effects(model, run, options["effect"], (*CATALOGUE, *own))
    given = dict(named_value(text, "--value", model) for text in options["values"])
    values = record.truth(model, {name: value.array for name, value in given.items()})
    progress(f"simulating {model_name}")
    noise = options["noise"] or 0.0
    reading = record.simulated(model, run, values, noise, rng)
    paths = record.written(
        options["output"], model, run, reading, values, noise, options["seed"], command
    )
    for path in paths:
        echo(f"Written: {path}")
    echo(f"\n{following(command, file=paths[0])}")


@commands.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """A script that completes what is typed: eval "$(casest completion bash)"."""
    from click.shell_completion import get_completion_class

    made = get_completion_class(shell)
    assert made is not None
    echo(made(commands, {}, "casest", "_CASEST_COMPLETE").source())


@commands.command()
@click.argument("result_path", metavar="RESULT", type=click.Path(path_type=Path))
@click.option(
    "--to",
    required=True,
    type=click.Choice(["c", "python", "json"]),
    help="C99, a Python module with NumPy alone, or JSON that `casest apply` reads.",
)
@click.option("--float", "single", is_flag=True, help="C: compute with float instead of double.")
@click.option("--run", default=0, help="Which run, where the correction differs between them.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Without it, standard output.",
)
@click.option("--force", is_flag=True, help="Export a result that was refused.")
def export(result_path: Path, to: Any, output: Path | None, **options: Any) -> None:
    """The correction of a saved RESULT, ready to run on the device."""
    from casest.correction import apply as correcting
    from casest.correction.export import exported
    from casest.correction.inverse import TIMED
    from casest.report.next_command import following
    from casest.results.file import made_by

    if options["single"] and to != "c":
        raise UsageError("--float is for --to c")
    progress(f"exporting {result_path}")
    text = exported(result_path, to, **options)
    if timed := correcting.of_another_time(result_path):
        echo(f"casest: {TIMED}{', '.join(timed)}", err=True)
    if output is None:
        echo(text, nl=False)
        return
    write(output, text)
    echo(f"Written: {output}")
    echo(f"\n{following(typed(), file=output, fitted=made_by(result_path))}")
