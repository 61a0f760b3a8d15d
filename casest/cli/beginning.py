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
@click.option(
    "--equations",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Of a PEtab problem: lines A' = -k*A and A(0) = a0, in place of its SBML.",
)
@click.option("--force", is_flag=True, help="Write over a file that is there.")
def init(
    data: tuple[str, ...],
    model_name: str | None,
    output: Path,
    equations: Path | None,
    force: bool,
) -> None:
    """A project file from what DATA shows: model, columns, units, rest, to be read and mended.

    casest calibrate --project bench.toml takes it, as close, observe, compare and apply do. Of a
    PEtab problem (problem.yaml) also the declaration, and a record for each condition.
    """
    from casest.petab.problem import is_petab

    if len(data) == 1 and is_petab(data[0]):
        if model_name is not None:
            raise UsageError("--model: a PEtab problem brings its own; --equations FILE writes one")
        _of_petab(Path(data[0]), equations, output, force)
        return
    if equations is not None:
        raise UsageError("--equations is for a PEtab problem: give its YAML file alone")
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


def _of_petab(path: Path, equations: Path | None, output: Path, force: bool) -> None:
    """The project file of a PEtab problem, its declaration and its records, beside each other."""
    from casest.cli.shared import write
    from casest.petab.problem import tables
    from casest.petab.written import written

    progress(f"reading {path}")
    found = written(tables(path, equations))
    files = {output.parent / f"{found.name}.py": found.model}
    files |= {output.parent / f"{name}.csv": text for name, text in found.records.items()}
    data = ", ".join(f'"{name}.csv"' for name in found.records)
    files[output] = f'model = "{found.name}.py"\ndata = [{data}]\n'
    for file in files:
        if file.exists() and not force:
            raise UsageError(f"{file} is there already; --force writes over it, or give another -o")
    for file, text in files.items():
        write(file, text)
    for note in found.notes:
        echo(f"  {note}")
    echo(f"\nWritten: {', '.join(map(str, files))}\n")
    echo(f"Next:\n  casest calibrate --project {shlex.quote(str(output))}")
