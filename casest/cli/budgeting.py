"""`budget`: where the uncertainty of a saved result comes from."""

from __future__ import annotations

from pathlib import Path

import click

from casest.cli.options import FOLDER, RESULT
from casest.cli.shared import commands, echo, write


@commands.command()
@RESULT
@click.option(
    "-o", "--output", type=FOLDER, metavar="DIR", help="Folder for budget.json and budget.html."
)
@click.option("--json", "as_json", is_flag=True, help="Print budget.json instead of tables.")
def budget(result_path: Path, output: Path | None, as_json: bool) -> None:
    """Where the uncertainty of RESULT comes from: references, noise, priors, and their shares.

    Of every value, and of one corrected reading; correlations; effective degrees of freedom.
    """
    from casest.report.html.budget import PAGE, budget_page
    from casest.report.text.budget import budget_text
    from casest.results.budget import budget_of
    from casest.results.file import as_json as written

    found = budget_of(result_path)
    if output is not None:
        write(output / "budget.json", written(found.content()))
        write(output / PAGE, budget_page(found))
    if as_json:
        echo(written(found.content()), nl=False)
        return
    echo(budget_text(found))
    if output is not None:
        echo(f"\nWritten: {output}/budget.html, budget.json")
