"""`compare`: solvers side by side."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from casest.cli.assignments import Assignment, Assignments
from casest.cli.flags import Kind, flag, taking
from casest.cli.loading import model_and_records
from casest.cli.options import (
    DATA,
    FOLDER,
    ModelOptions,
    ReadingOptions,
    SensorOptions,
    Words,
    model_argument,
)
from casest.cli.shared import commands, echo, progress, typed
from casest.errors import NotTrusted, UsageError

if TYPE_CHECKING:
    from casest.results.comparison import SolversCompared


@dataclass(frozen=True, slots=True)
class CompareOptions:
    """Options of `compare`."""

    model: ModelOptions = field(default_factory=ModelOptions)
    reading: ReadingOptions = field(default_factory=ReadingOptions)
    sensors: SensorOptions = field(default_factory=SensorOptions)
    solvers: Words = flag((), "--solver", metavar="NAME", help="Only this one (repeatable).")
    start: Assignments = flag(
        (),
        "--start",
        of=Assignment,
        metavar="NAME=VALUE",
        help="Start value in place of the automatic.",
    )
    starts: int = flag(
        8, "--starts", show_default=True, help="More starts, spread around the first."
    )
    spread: tuple[float, ...] = flag(
        (),
        "--spread",
        type=float,
        metavar="SHARE",
        help="How far, as a share of each unknown's size (repeatable; 0.001, 0.01, 0.1 and 0.3).",
    )
    seed: int = flag(0, "--seed", show_default=True, help="For the spread of starts.")
    limit: float = flag(
        10,
        "--limit",
        type=float,
        show_default=True,
        metavar="SECONDS",
        help="Stop a solver's run after this time.",
    )
    output: Path | None = flag(
        None,
        "-o",
        "--output",
        type=FOLDER,
        metavar="DIR",
        help="Folder for compare.json, compare.png and compare.svg.",
    )
    as_json: bool = flag(False, "--json", help="Print compare.json instead of tables.")


@commands.command()
@model_argument(Kind.FITTED)
@DATA
@taking(CompareOptions)
def compare(model_name: str, data: tuple[str, ...], options: CompareOptions) -> int:
    """Run every solver on MODEL and DATA, from one start and from a spread of starts.

    Each is judged by the certified optimum: where it ended, what it claims, what it took. Exit
    code 0: done; 1: bad input; 2: no certified optimum to judge by (all is shown and written).
    """
    from casest.comparison.judge import SIZES
    from casest.comparison.judge import compare as compared
    from casest.report.text.comparison import comparison_text
    from casest.results.comparison import comparison_result
    from casest.results.file import as_json

    model, runs = model_and_records(
        model_name, data, options.model, options.reading, options.sensors
    )
    found = compared(
        model,
        runs,
        starts=options.starts,
        seed=options.seed,
        start=dict(given.start(model) for given in options.start) or None,
        sizes=options.spread or SIZES,
        solvers=options.solvers,
        limit=options.limit,
        say=progress,
    )
    result = comparison_result(found, model_name=model_name, data=data, command=typed())
    written = written_comparison(result, options.output) if options.output else []
    if options.as_json:
        echo(as_json(result.content()), nl=False)
    else:
        echo(comparison_text(result, written))
    if not found.certified:
        echo("casest: no certified optimum to judge by", err=True)
    return 0 if found.certified else NotTrusted.exit_code


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
