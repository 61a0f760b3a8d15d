"""`check`: is an old calibration still valid for new records?"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from casest.cli.assignments import Assignment, Assignments
from casest.cli.flags import flag, taking
from casest.cli.options import DATA, FOLDER, RESULT, ReadingOptions, SensorOptions
from casest.cli.shared import commands, echo, progress, reported, typed, write
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model
    from casest.validity.old import Old

#: Exit code of a calibration that is valid no more.
NOT_VALID = 2


@dataclass(frozen=True, slots=True)
class CheckOptions:
    """Options of `check`."""

    reading: ReadingOptions = field(default_factory=ReadingOptions)
    sensors: SensorOptions = field(default_factory=SensorOptions)
    false_alarms: float = flag(
        0.001,
        "--false-alarms",
        show_default=True,
        type=float,
        metavar="SHARE",
        help="Chance of calling a valid calibration invalid, at each date.",
    )
    constants: Assignments = flag(
        (),
        "--set",
        of=Assignment,
        metavar="norm=VALUE",
        help="The known length, where RESULT is a file of ROS, Kalibr, ArduPilot or PX4.",
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
    from casest.report.html.check import check_page
    from casest.report.next_command import recalibrating
    from casest.report.text.check import check_text
    from casest.results.check import CHECK, checked_result
    from casest.results.file import as_json
    from casest.validity.check import check as judge

    if not 0 < options.false_alarms < 0.5:
        raise UsageError(
            f"--false-alarms {options.false_alarms:g}: a chance above 0 and below 0.5, as 0.001"
        )
    asked = _asked(result_path, data, options)
    found = judge(asked.old, asked.records, options.false_alarms, say=progress, models=asked.models)

    def again(name: str, hold: Sequence[str]) -> str:
        held = {parameter: asked.held(parameter) for parameter in hold}
        return recalibrating(asked.typed, asked.made, name, held)

    said = checked_result(
        found,
        model_name=asked.model,
        result=str(asked.file),
        data=data,
        notes=asked.notes,
        conditions=asked.conditions,
        command=typed(),
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


@dataclass(frozen=True, slots=True)
class _Asked:
    """What is judged: an old estimate and the new records, each with its own `models` where its
    noise is stated; the command as it was `typed`, the
    calibration that `made` the estimate, or would have; how a parameter is `held` as it was."""

    old: Old
    records: list[tuple[Run, ...]]
    models: list[Model]
    file: Path
    model: str
    typed: str
    made: str
    held: Callable[[str], str]
    notes: list[str]
    conditions: list[dict[str, tuple[list[float], list[float]]]]


def _asked(path: Path, data: Sequence[str], options: CheckOptions) -> _Asked:
    from casest.correction.formats_read import is_foreign
    from casest.results.file import result_file
    from casest.saved import check as saved

    progress(f"reading {', '.join(data)}")
    if is_foreign(path):
        return _foreign(path, data, options)
    if options.constants:
        raise UsageError(f"{path} is a result, and has its constants: leave --set out")
    old, result = saved.old_estimate(path)
    records = saved.new_records(old, result, data, options.reading.keywords())
    given = options.sensors.stated or _said_before(path, result.reproduce.command)
    models, records = _with_noise(old.model, records, given)
    return _Asked(
        old,
        records,
        models,
        result_file(path),
        result.model,
        typed(),
        result.reproduce.command,
        lambda parameter: f"@{result_file(path)}",
        list(saved.remarks(result, data, records)),
        [saved.elsewhere(path, runs) for runs in records],
    )


def _with_noise(
    model: Model, records: Sequence[tuple[Run, ...]], given: Assignments
) -> tuple[list[Model], list[tuple[Run, ...]]]:
    """Each record with what was stated of its noise, and its model; no models where nothing was."""
    from casest.interface.sensor_noise import with_sensor_noise

    found = [with_sensor_noise(model, runs, given) for runs in records]
    stated = any(m.noise is not None for m, _ in found)
    return [m for m, _ in found] if stated else [], [runs for _, runs in found]


def _said_before(path: Path, command: str) -> Assignments:
    """What the command that made a result stated of the noise, if the result stands by it."""
    from casest.cli.project import expanded
    from casest.report.next_command import typed_words
    from casest.saved.check import noise_stated

    words = shlex.split(command)
    if not noise_stated(path) or words[:1] != ["casest"]:
        return ()
    made = typed_words(shlex.join(["casest", *expanded(words[1:], commands)]))
    options = made.options if made else ()
    return tuple(
        Assignment("--sensor-noise", text) for flag, text in options
        if flag == "--sensor-noise" and text
    )  # fmt: skip


def _foreign(path: Path, data: Sequence[str], options: CheckOptions) -> _Asked:
    from casest.cli.loading import declared_model
    from casest.cli.options import ModelOptions
    from casest.saved import check_foreign as foreign

    if not options.constants:
        raise UsageError(
            f"{path} does not say to which length it corrects: --set 'norm=9.80665 m/s^2', or the "
            "field as --set 'norm=48 uT'"
        )
    name, arguments = "norm-triangular", options.reading.keywords()
    norm = declared_model(name, ModelOptions(constants=options.constants))["norm"]
    sensor = foreign.foreign_sensor(path, arguments.get("columns") or {})
    old = foreign.foreign_estimate(sensor, declared_model(name, ModelOptions()), norm)
    records = foreign.foreign_records(sensor, old.model, data, arguments)
    models, records = _with_noise(old.model, records, options.sensors.stated)
    notes = dict.fromkeys(note for runs in records for run in runs for note in run.notes)
    words = ["casest", "calibrate", name, *data]
    made = shlex.join([*words, *(w for c in options.constants for w in ("--set", c.text))])
    return _Asked(
        old,
        records,
        models,
        path,
        name,
        foreign.renamed(typed(), sensor, old.model),
        made,
        lambda parameter: foreign.in_words(old, parameter),
        [foreign.EXACT, *notes],
        [{} for _ in records],
    )
