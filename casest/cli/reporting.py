"""`report`: saved results side by side."""

from __future__ import annotations

from pathlib import Path

import click

from casest.cli.shared import commands, echo, write


@commands.command()
@click.argument("results", metavar="RESULT...", nargs=-1, required=True,
                type=click.Path(path_type=Path))  # fmt: skip
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="PAGE",
    help="The page, or a folder for report.html.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
def report(results: tuple[Path, ...], output: Path | None, as_json: bool) -> None:
    """Saved RESULTs side by side: each number with its intervals, and whether they agree.

    They stand in the order given, or over the dates or numbers in the names of their folders.
    """
    from casest.report.html import REPORT
    from casest.report.html.side_by_side import side_by_side_page
    from casest.report.text.side_by_side import side_by_side_text
    from casest.results.file import as_json as text_of
    from casest.results.side_by_side import side_by_side

    found = side_by_side(results)
    echo(text_of(found.content()) if as_json else side_by_side_text(found), nl=not as_json)
    if output is not None:
        page = output if output.suffix in (".html", ".htm") else output / REPORT
        write(page, side_by_side_page(found, page.parent))
        if not as_json:
            echo(f"\nWritten: {page}")
