"""`apply` and `export`: the correction of a saved result."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import click

from casest.cli.flags import flag, taking
from casest.cli.options import RESULT, ReadingOptions
from casest.cli.shared import commands, echo, progress, shown, typed, write
from casest.errors import UsageError


@dataclass(frozen=True, slots=True)
class ApplyOptions:
    """Options of `apply`."""

    reading: ReadingOptions = field(default_factory=ReadingOptions)
    output: Path | None = flag(
        None,
        "-o",
        "--output",
        type=click.Path(path_type=Path),
        metavar="FILE|DIR",
        help="A .csv file, or a folder for corrected.csv; without it, standard output.",
    )
    force: bool = flag(False, "--force", help="Apply a result that was refused.")


@commands.command()
@RESULT
@click.argument("data", type=click.Path())
@taking(ApplyOptions)
def apply(result_path: Path, data: str, options: ApplyOptions) -> None:
    """Correct the readings in DATA with a saved RESULT (result.json, or its folder)."""
    from casest.correction.inverse import LEFT, TIMED
    from casest.report.next_command import following
    from casest.saved import apply as correcting
    from casest.saved.export import applied, is_exported

    arguments = options.reading.keywords()
    progress(f"correcting {data}")
    timed: tuple[str, ...] = ()
    if is_exported(result_path):
        text, left, remarks = applied(result_path, data, arguments)
    else:
        text, left, remarks = correcting.corrected_csv(
            result_path, data, arguments, force=options.force
        )
        timed = correcting.of_another_time(result_path, data)
    shown.done()
    for remark in remarks:
        echo(f"casest: {remark}", err=True)
    if left:
        echo(f"casest: {LEFT}{', '.join(left)}", err=True)
    if timed:
        echo(f"casest: {TIMED}{', '.join(timed)}", err=True)
    if options.output is None:
        echo(text, nl=False)
        return
    path = correcting.write_to(options.output, text)
    echo(f"Written: {path}")
    echo(f"\n{following(typed(), file=path)}")


@commands.command()
@RESULT
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
def export(
    result_path: Path,
    to: Literal["c", "python", "json"],
    single: bool,
    run: int,
    output: Path | None,
    force: bool,
) -> None:
    """The correction of a saved RESULT, ready to run on the device."""
    from casest.correction.inverse import TIMED
    from casest.report.next_command import following
    from casest.results.saved import saved_result
    from casest.saved import apply as correcting
    from casest.saved.export import exported

    if single and to != "c":
        raise UsageError("--float is for --to c")
    progress(f"exporting {result_path}")
    text = exported(result_path, to, single=single, run=run, force=force)
    if timed := correcting.of_another_time(result_path):
        echo(f"casest: {TIMED}{', '.join(timed)}", err=True)
    if output is None:
        echo(text, nl=False)
        return
    write(output, text)
    echo(f"Written: {output}")
    echo(f"\n{following(typed(), file=output, fitted=saved_result(result_path).reproduce.command)}")
