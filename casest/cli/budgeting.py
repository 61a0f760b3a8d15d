"""`budget`: where the uncertainty of a saved result comes from."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from casest.cli.options import FOLDER, RESULT
from casest.cli.shared import commands, echo, progress, write

if TYPE_CHECKING:
    from casest.results.budget import Budget


@commands.command()
@RESULT
@click.option(
    "-o", "--output", type=FOLDER, metavar="DIR", help="Folder for budget.json and budget.html."
)
@click.option("--validate", is_flag=True, help="Check it by Monte Carlo (JCGM 101).")
@click.option(
    "--digits",
    type=click.IntRange(1, 2),
    default=1,
    show_default=True,
    help="Of --validate: digits of a standard uncertainty that count.",
)
@click.option(
    "--limit",
    type=click.FloatRange(min=0, min_open=True),
    default=60.0,
    show_default=True,
    metavar="SECONDS",
    help="Of --validate: no more trials after this time.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of --validate.")
@click.option("--json", "as_json", is_flag=True, help="Print budget.json instead of tables.")
def budget(
    result_path: Path,
    output: Path | None,
    validate: bool,
    digits: int,
    limit: float,
    seed: int,
    as_json: bool,
) -> None:
    """Where the uncertainty of RESULT comes from: references, noise, priors, and their shares.

    Of every value, and of one corrected reading; correlations; effective degrees of freedom.
    """
    from casest.report.html.budget import PAGE, budget_page
    from casest.report.text.budget import budget_text
    from casest.results.budget import budget_of
    from casest.results.file import as_json as written

    found = budget_of(result_path)
    if validate:
        found = _validated(found, result_path, digits=digits, limit=limit, seed=seed)
    if output is not None:
        write(output / "budget.json", written(found.content()))
        write(output / PAGE, budget_page(found))
    if as_json:
        echo(written(found.content()), nl=False)
        return
    echo(budget_text(found))
    if output is not None:
        echo(f"\nWritten: {output}/budget.html, budget.json")


def _validated(found: Budget, path: Path, **how: Any) -> Budget:
    """The budget with what Monte Carlo says of it; its fit is made again for that."""
    from msgspec.structs import replace

    from casest.cli.repeating import repeated
    from casest.results.validation import validated

    return replace(
        found, validation=validated(repeated(path), found.corrected, say=progress, **how)
    )
