"""`check`: is an old calibration still valid for new records?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from casest.cli.flags import flag, taking
from casest.cli.options import DATA, FOLDER, RESULT, ReadingOptions
from casest.cli.shared import commands, echo, progress, reported, typed, write
from casest.errors import UsageError

#: Exit code of a calibration that is valid no more.
NOT_VALID = 2


@dataclass(frozen=True, slots=True)
class CheckOptions:
    """Options of `check`."""

    reading: ReadingOptions = field(default_factory=ReadingOptions)
    false_alarms: float = flag(
        0.001,
        "--false-alarms",
        show_default=True,
        type=float,
        metavar="SHARE",
        help="Chance of calling a valid calibration invalid, at each date.",
    )
    output: Path | None = flag(
        None,
        "-o",
        "--output",
        type=FOLDER,
        metavar="DIR",
        help="Folder for check.json and report.html.",
    )
    as_json: bool = flag(False, "--json", help="Print check.json instead of text.")


@commands.command()
@RESULT
@DATA
@taking(CheckOptions)
def check(result_path: Path, data: tuple[str, ...], options: CheckOptions) -> int:
    """Is the calibration in RESULT still valid for the new records in DATA?

    Each file is a date, in the order given; several have a control chart. Parameters that belong
    to a run alone are fitted to the new record, shared ones are tested. Exit code 0: valid; 2: not.
    """
    from casest.report.html import check_page
    from casest.report.next_command import recalibrating
    from casest.report.text.check import check_text
    from casest.results.check import CHECK, checked_result
    from casest.results.file import as_json, result_file
    from casest.saved import check as saved
    from casest.validity.check import check as judge

    if not 0 < options.false_alarms < 0.5:
        raise UsageError(
            f"--false-alarms {options.false_alarms:g}: a chance above 0 and below 0.5, as 0.001"
        )
    old, result = saved.old_estimate(result_path)
    progress(f"reading {', '.join(data)}")
    records = saved.new_records(old, result, data, options.reading.keywords())
    found = judge(old, records, options.false_alarms, say=progress)
    file, command = result_file(result_path), typed()

    def again(name: str, hold: Sequence[str]) -> str:
        held = {parameter: f"@{file}" for parameter in hold}
        return recalibrating(command, result.reproduce.command, name, held)

    said = checked_result(
        found,
        model_name=result.model,
        result=str(file),
        data=data,
        notes=list(saved.remarks(result, data, records)),
        conditions=[saved.elsewhere(result_path, runs) for runs in records],
        command=command,
        recalibrating=again,
    )
    if options.output:
        progress(f"writing {options.output}")
        write(options.output / CHECK, as_json(said.content()))
        reported(options.output, check_page(said))
    if options.as_json:
        echo(as_json(said.content()), nl=False)
    else:
        echo(check_text(said, options.output), verdict=True)
    return 0 if said.valid else NOT_VALID
