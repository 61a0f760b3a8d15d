"""`apply`, `simulate`, `export` and `completion`: what a result or a model is used for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from casest.cli.options import model_options, reading_options
from casest.cli.shared import (
    FOLDER,
    Options,
    commands,
    echo,
    progress,
    typed,
    waiting,
    write,
)
from casest.cli.words import (
    declared_model,
    named_value,
    reading_arguments,
)
from casest.completing import EffectName, ModelName
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
    from casest import applying, exporting
    from casest.apply import LEFT
    from casest.following import following

    arguments = reading_arguments(options)
    progress(f"correcting {data}")
    if exporting.is_exported(result_path):
        text, left = exporting.applied(result_path, data, arguments)
    else:
        text, left = applying.corrected_csv(result_path, data, arguments, force=options["force"])
    waiting.done()
    if left:
        echo(f"casest: {LEFT}{', '.join(left)}", err=True)
    if path := applying.write_or_print(text, options["output"]):
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
@click.option("--noise", type=float, default=0.0, help="Standard deviation of each reading.")
@click.option("--duration", type=float, help="Seconds, with --rate, where time is all it needs.")
@click.option("--directions", type=int, metavar="N", help="N random directions or attitudes.")
@click.option("--input", "given", type=click.Path(), help="Record with the signals it needs.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("-o", "--output", type=FOLDER, default=Path("simulated"), metavar="DIR")
def simulate(model_name: str, **options: Any) -> None:
    """A record with known truth: DIR/record.csv and DIR/truth.json.

    Unknowns are at their declared start unless --value says otherwise, effects at a typical size.
    """
    simulation(model_name, options, typed())


def simulation(model_name: str, options: Options, command: str) -> None:
    """Signals, truth, readings, files."""
    import numpy as np

    from casest import simulating
    from casest.dynamics import Dynamics
    from casest.effects import CATALOGUE
    from casest.following import following
    from casest.problem import find_any, find_effects

    if isinstance(find_any(model_name), Dynamics):
        raise UsageError(f"{model_name} is an estimator in motion: it needs a trajectory of yours")
    own = tuple(e for path in options["effects"] for e in find_effects(path))
    model = declared_model(model_name, {**options, "effects": ()})
    rng = np.random.default_rng(options["seed"])
    if options["given"]:
        run = simulating.with_record(model, options["given"], reading_arguments(options))
    else:
        run = simulating.without_data(
            model,
            duration=options["duration"],
            rate=options["rate"],
            directions=options["directions"],
            rng=rng,
        )
    model = simulating.with_effects(model, run, options["effect"], (*CATALOGUE, *own))
    given = dict(named_value(text, "--value", model) for text in options["values"])
    values = simulating.truth(model, {name: value.array for name, value in given.items()})
    progress(f"simulating {model_name}")
    reading = simulating.simulated(model, run, values, options["noise"], rng)
    paths = simulating.written(
        options["output"], model, run, reading, values, options["noise"], options["seed"], command
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
    from casest import exporting
    from casest.following import following
    from casest.result import made_by

    if options["single"] and to != "c":
        raise UsageError("--float is for --to c")
    progress(f"exporting {result_path}")
    text = exporting.exported(result_path, to, **options)
    if output is None:
        echo(text, nl=False)
        return
    write(output, text)
    echo(f"Written: {output}")
    echo(f"\n{following(typed(), file=output, fitted=made_by(result_path))}")
