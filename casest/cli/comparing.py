"""`compare`: solvers side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from casest.cli.completing import ModelName
from casest.cli.options import model_options, reading_options
from casest.cli.shared import (
    FOLDER,
    commands,
    echo,
    progress,
    typed,
)
from casest.cli.words import (
    declared_model,
    records,
    start_value,
)
from casest.errors import NotTrusted, UsageError

if TYPE_CHECKING:
    from casest.results.comparison import SolversCompared


@commands.command()
@click.argument("model_name", metavar="MODEL", type=ModelName())
@click.argument("data", nargs=-1, required=True, type=click.Path())
@model_options
@reading_options
@click.option(
    "--solver", "solvers", multiple=True, metavar="NAME", help="Only this one (repeatable)."
)
@click.option(
    "--start", multiple=True, metavar="NAME=VALUE", help="Start value in place of the automatic."
)
@click.option(
    "--starts", type=int, default=8, show_default=True, help="More starts, spread around the first."
)
@click.option(
    "--spread",
    type=float,
    multiple=True,
    metavar="SHARE",
    help="How far, as a share of each unknown's size (repeatable; 0.001, 0.01, 0.1 and 0.3).",
)
@click.option("--seed", type=int, default=0, show_default=True, help="For the spread of starts.")
@click.option(
    "--limit",
    type=float,
    default=10,
    show_default=True,
    metavar="SECONDS",
    help="Stop a solver's run after this time.",
)
@click.option(
    "-o",
    "--output",
    type=FOLDER,
    metavar="DIR",
    help="Folder for compare.json, compare.png and compare.svg.",
)
@click.option("--json", "as_json", is_flag=True, help="Print compare.json instead of tables.")
def compare(model_name: str, data: tuple[str, ...], **options: Any) -> int:
    """Run every solver on MODEL and DATA, from one start and from a spread of starts.

    Each is judged by the certified optimum: where it ended, what it claims, what it took. Exit
    code 0: done; 1: bad input; 2: no certified optimum to judge by, or interrupted (what is done
    is shown and written all the same).
    """
    from casest.comparison.judge import SIZES
    from casest.comparison.judge import compare as compared
    from casest.report.text.comparison import comparison_text
    from casest.results.comparison import comparison_result
    from casest.results.file import as_json

    model = declared_model(model_name, options)
    runs = records(model, data, options)
    found = compared(
        model,
        runs,
        starts=options["starts"],
        seed=options["seed"],
        start=dict(start_value(text, model) for text in options["start"]) or None,
        sizes=options["spread"] or SIZES,
        solvers=options["solvers"],
        limit=options["limit"],
        say=progress,
    )
    result = comparison_result(found, model_name=model_name, data=data, command=typed())
    written = written_comparison(result, options["output"]) if options["output"] else []
    if options["as_json"]:
        echo(as_json(result.content()), nl=False)
    else:
        echo(comparison_text(result, written))
    if found.interrupted:
        echo(f"casest: interrupted after {found.done} of {found.planned} runs", err=True)
    elif not found.certified:
        echo("casest: no certified optimum to judge by", err=True)
    return 0 if found.certified and not found.interrupted else NotTrusted.exit_code


def written_comparison(result: SolversCompared, folder: Path) -> list[Path]:
    """compare.json, and the plot where matplotlib is there; says so where it is not."""
    from casest.report.picture import draw
    from casest.results.comparison import save

    paths = [save(folder, result)]
    try:
        paths += draw(result, folder)
    except UsageError as error:
        echo(f"casest: {error}", err=True)
    return paths
