"""`init` and `doctor`: a project file from what a record shows; what a bug report needs."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from casest.cli.options import DATA
from casest.cli.shared import commands, echo, progress
from casest.errors import UsageError


@commands.command()
@click.option("--json", "as_json", is_flag=True, help="For programs.")
def doctor(as_json: bool) -> int:
    """Versions, compiler, cache, linear algebra, optional readers, and a fit of known truth.

    Exit code 0: nothing is wrong; 1: something is missing or gives a wrong answer.
    """
    import json

    from casest.cli.health import health, health_text

    progress("looking around")
    found = health()
    text = json.dumps(found.content(), indent=2) + "\n" if as_json else health_text(found)
    echo(text, nl=not as_json)
    return 0 if found.ok else 1


@commands.command()
@DATA
@click.option("--model", "model_name", metavar="MODEL", help="Where it is known, or one's own.")
@click.option(
    "-o",
    "--output",
    default=Path("bench.toml"),
    show_default=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="The project file.",
)
@click.option("--force", is_flag=True, help="Write over a file that is there.")
def init(data: tuple[str, ...], model_name: str | None, output: Path, force: bool) -> None:
    """A project file from what DATA shows: model, columns, units, rest, to be read and mended.

    casest calibrate --project bench.toml takes it, as close, observe, compare and apply do.
    """
    from casest.cli.proposing import proposal
    from casest.cli.shared import write

    if output.exists() and not force:
        raise UsageError(f"{output} is there already; --force writes over it, or give another -o")
    progress(f"reading {', '.join(data)}")
    found = proposal(data, model_name, output.parent)
    write(output, found.text)
    for note in found.notes:
        echo(f"  {note}")
    echo(f"\nWritten: {output}; read it and mend what is wrong\n")
    echo(f"Next:\n  casest calibrate --project {shlex.quote(str(output))}")
