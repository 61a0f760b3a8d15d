"""`observe` and `filter`: what data can see, and states over time."""

from __future__ import annotations

from typing import Any

import click

from casest.cli.completing import ModelName
from casest.cli.options import model_options, motion_options, reading_options, sensor_noise
from casest.cli.shared import (
    commands,
    echo,
    last_words,
    progress,
    reported,
    typed,
    write,
)
from casest.cli.words import (
    declared_model,
    moving_model,
    moving_record,
    records,
    tuned_noise,
)
from casest.errors import UsageError


@commands.command()
@click.argument("model_name", metavar="MODEL", type=ModelName())
@click.argument("data", nargs=-1, type=click.Path())
@model_options
@reading_options
@motion_options
@click.option("--window", type=float, metavar="SECONDS", help="Of the sliding eigenvalue.")
def observe(model_name: str, data: tuple[str, ...], **options: Any) -> int:
    """What these data, or this trajectory, can see: rank, and what is hidden, in words.

    Without DATA: what any record of an estimator in motion could show (structural rank). Exit
    code 0 even where something is not observable.
    """
    from casest.declaration.model import Model
    from casest.report.text.observability import observe_text
    from casest.results.file import as_json
    from casest.results.find import find_any
    from casest.results.observability import (
        Observability,
        observe_motion,
        observe_parameters,
        observe_structure,
    )

    fits = isinstance(find_any(model_name), Model)
    if fits:
        model = declared_model(model_name, options)
        if not data:
            raise UsageError(f"{model_name}: what can be seen depends on the record: give DATA")
        runs = records(model, data, options)
        progress(f"fitting {model_name}")
        result: Observability = observe_parameters(model, runs, data=data, command=typed())
    elif not data:
        result = observe_structure(moving_model(model_name, options), command=typed())
    else:
        moving, run = moving_record(model_name, data, options)
        progress("what the trajectory shows")
        result = observe_motion(moving, run, options["window"], data=data, command=typed())
    if options["output"]:
        from casest.report.html import observe_page

        write(options["output"] / "observe.json", as_json(result.content()))
        reported(options["output"], observe_page(result))
    if options["as_json"]:
        echo(as_json(result.content()), nl=False)
        return 0
    echo(observe_text(result))
    seen = result.observable
    last_words(options["output"], "report.html, observe.json", trusted=seen, applies=fits)
    return 0


@commands.command("filter")
@click.argument("model_name", metavar="MODEL", type=ModelName())
@click.argument("data", nargs=-1, required=True, type=click.Path())
@click.option(
    "--set", "constants", metavar="NAME=VALUE", multiple=True, help="Set a constant of the model."
)
@reading_options
@motion_options
@click.option(
    "--noise",
    type=click.Choice(["declared", "ml"]),
    default="declared",
    help="Noise intensities: as declared, or the most likely ones for this record.",
)
@sensor_noise
@click.option(
    "--rest",
    type=click.Path(),
    metavar="FILE",
    help="A record at rest: noise of the inputs by its Allan deviation.",
)
def filter_command(model_name: str, data: tuple[str, ...], **options: Any) -> int:
    """States over time by the Kalman filter and smoother, with innovations diagnosed."""
    from casest.report.text.states import filter_text
    from casest.results import states
    from casest.results.file import as_json

    moving, run = moving_record(model_name, data, options)
    tuned, told = tuned_noise(moving, run, options)
    progress("filter and smoother")
    result = states.follow(moving, run, tuned, **told, data=data, command=typed())
    if options["output"]:
        from casest.report.html import filter_page

        write(options["output"] / "states.csv", states.states_csv(result.filtered))
        write(options["output"] / "filter.json", as_json(result.content()))
        reported(options["output"], filter_page(result))
    if options["as_json"]:
        echo(as_json(result.content()), nl=False)
        return 0
    echo(filter_text(result))
    last_words(options["output"], "report.html, filter.json, states.csv")
    return 0
