"""`apply` and `export`: the correction of a saved result."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import click

from casest.cli.filter_step import StepOptions, is_filtered, step_of, step_of_folder
from casest.cli.flags import Kind, flag, refuse, taking
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
    std: bool = flag(
        False,
        "--with-std",
        help="Standard deviations too: by parameters, noise, reference, together.",
    )
    force: bool = flag(False, "--force", help="Apply a result that was refused.")


@commands.command()
@RESULT
@click.argument("data", type=click.Path())
@taking(ApplyOptions)
def apply(result_path: Path, data: str, options: ApplyOptions) -> None:
    """Correct the readings in DATA with a saved RESULT (result.json, or its folder).

    Of differential equations: their states and the predicted readings along DATA, whose own
    beginning is fitted to it.
    """
    from casest.correction.formats_read import is_foreign
    from casest.correction.inverse import LEFT, TIMED
    from casest.report.next_command import following
    from casest.saved import apply as correcting
    from casest.saved.export import applied, applied_foreign, is_exported
    from casest.saved.following import followed_csv, follows

    arguments = options.reading.keywords()
    progress(f"correcting {data}")
    left: tuple[str, ...] = ()
    timed: tuple[str, ...] = ()
    if is_foreign(result_path):
        if options.std:
            raise UsageError("--with-std is for a result, or a correction that casest exported")
        text, left, remarks = applied_foreign(result_path, data, arguments)
    elif is_exported(result_path):
        text, left, remarks = applied(result_path, data, arguments, std=options.std)
    elif follows(result_path):
        if options.std:
            raise UsageError(
                "--with-std: of states that are followed along a record no standard deviations "
                "are told; casest budget RESULT tells those of the constants"
            )
        text, remarks = followed_csv(result_path, data, arguments, force=options.force)
    else:
        text, left, remarks = correcting.corrected_csv(
            result_path, data, arguments, force=options.force, std=options.std
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
@click.argument("result_path", metavar="RESULT|MODEL", type=click.Path(path_type=Path))
@click.option(
    "--to",
    required=True,
    type=click.Choice(["c", "python", "json", "ros", "kalibr", "ardupilot", "px4", "dcc"]),
    help="C99, a Python module with NumPy alone, JSON, or another project's file of offsets and "
    "matrices; `casest apply` reads these five. dcc: a Digital Calibration Certificate in XML.",
)
@click.option(
    "--certificate",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="dcc: TOML with laboratory, customer, item, serial, person, identifier, begin, end …",
)
@click.option(
    "--sensor",
    "sensors",
    multiple=True,
    type=click.Choice(["accelerometer", "gyroscope", "magnetometer"]),
    help="ros, kalibr, ardupilot, px4: this sensor alone, of several.",
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
@click.option(
    "--with-std", "std", is_flag=True, help="With the standard deviation of what it gives."
)
@taking(StepOptions)
def export(
    result_path: Path,
    to: Literal["c", "python", "json", "ros", "kalibr", "ardupilot", "px4", "dcc"],
    certificate: Path | None,
    sensors: tuple[str, ...],
    single: bool,
    run: int,
    output: Path | None,
    force: bool,
    std: bool,
    options: StepOptions,
) -> None:
    """The correction of a saved RESULT, or a filter's step, ready to run on the device.

    Of an estimator in motion, MODEL is its name or file, or the folder that `casest filter` wrote,
    and --to c writes one step of its filter.
    """
    from casest.correction.inverse import ONCE, TIMED
    from casest.report.next_command import following
    from casest.results.saved import saved_result
    from casest.saved import apply as correcting
    from casest.saved.export import exported, exported_as

    if single and to != "c":
        raise UsageError("--float is for --to c")
    progress(f"exporting {result_path}")
    if names_a_model(result_path):
        if run or force or std or to != "c":
            raise UsageError(
                "of an estimator in motion --to c alone is written, without --run, --force and "
                "--with-std: in Python the step is casest.dynamics.Estimator"
            )
        saved(step_of(str(result_path), options, single), output)
        return
    if is_filtered(result_path):
        if run or force or std or to != "c":
            raise UsageError(
                f"{result_path}: of a filter --to c alone is written, without --run, --force and "
                "--with-std: in Python the step is casest.dynamics.Estimator"
            )
        refuse(options, Kind.MOVING, f"is for a model; {result_path} says what its filter used")
        saved(step_of_folder(result_path, single), output)
        return
    refuse(options, Kind.MOVING, f"is for estimators in motion; {result_path} is a saved result")
    if certificate is not None and to != "dcc":
        raise UsageError("--certificate is for --to dcc")
    if to == "dcc":
        if sensors or run or force or std:
            raise UsageError("--to dcc takes --certificate alone: it has all values, with their U")
        certified(result_path, certificate, output)
        return
    remarks: list[str] = []
    if to == "c" or to == "python" or to == "json":
        if sensors:
            raise UsageError("--sensor is for --to ros, kalibr, ardupilot and px4")
        text = exported(result_path, to, single=single, run=run, force=force, std=std)
    else:
        if std:
            raise UsageError("--with-std is for --to c, python and json")
        text, remarks = exported_as(result_path, to, sensors=sensors, run=run, force=force)
    for remark in remarks:
        echo(f"casest: {remark}", err=True)
    if timed := correcting.of_another_time(result_path):
        echo(f"casest: {TIMED}{', '.join(timed)}", err=True)
    if once := correcting.left_out(result_path):
        echo(f"casest: {ONCE}{', '.join(once)}", err=True)
    saved(text, output)
    if output is not None:
        fitted = saved_result(result_path).reproduce.command
        echo(f"\n{following(typed(), file=output, fitted=fitted)}")


def certified(result_path: Path, certificate: Path | None, output: Path | None) -> None:
    """A Digital Calibration Certificate, and what it does not say."""
    from casest.saved.dcc import dcc

    text, remarks = dcc(result_path, certificate)
    for remark in remarks:
        echo(f"casest: {remark}", err=True)
    saved(text, output)


def saved(text: str, output: Path | None) -> None:
    """Write to a file, or to standard output."""
    if output is None:
        echo(text, nl=False)
        return
    write(output, text)
    echo(f"Written: {output}")


def names_a_model(given: Path) -> bool:
    """Is this a model, shipped or in a Python file, and no saved result?"""
    from casest.results.find import MOVING, SHIPPED

    own = str(given).partition(":")[0]
    return not given.is_dir() and (own.endswith(".py") or own in {*MOVING, *SHIPPED})
