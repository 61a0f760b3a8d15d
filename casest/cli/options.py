"""Options that several commands have: flag, type, default and help of each, once."""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import click

from casest.cli.assignments import Assignment, Assignments
from casest.cli.completing import ModelName, SolverName
from casest.cli.flags import Kind, flag
from casest.errors import CasestError

if TYPE_CHECKING:
    from casest.dynamics import Dynamics

DATA = click.argument("data", nargs=-1, required=True, type=click.Path())
RESULT = click.argument("result_path", metavar="RESULT", type=click.Path(path_type=Path))

R = TypeVar("R")

#: A file in its place is refused before anything is computed.
FOLDER = click.Path(path_type=Path, file_okay=False)

#: Where fits are written.
RESULTS: dict[str, Any] = {
    "type": FOLDER,
    "metavar": "DIR",
    "help": "Folder for result.json, residuals.csv and report.html.",
}

Words = tuple[str, ...]


def model_argument(*kinds: Kind) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """MODEL of a command that takes these kinds of model."""
    return click.argument("model_name", metavar="MODEL", type=ModelName(*kinds))


@dataclass(frozen=True, slots=True)
class ModelOptions:
    """What is known, what is unknown, and what else acts."""

    constants: Assignments = flag(
        (),
        "--set",
        of=Assignment,
        metavar="NAME=VALUE",
        help="Set a constant: radius=0.28, 'norm=9.80665 m/s^2', 'gravity=gravity(45.5, 120)'.",
    )
    free: Words = flag(
        (), "--free", only=Kind.FITTED, metavar="NAME", help="Make a constant an unknown."
    )
    fix: Assignments = flag(
        (),
        "--fix",
        only=Kind.FITTED,
        of=Assignment,
        metavar="NAME=VALUE|@RESULT",
        help="Hold a parameter: a number, 1,2,3, rows a,b;c,d, or @result.json.",
    )
    prior: str | None = flag(
        None,
        "--prior",
        only=Kind.FITTED,
        metavar="@RESULT",
        help="What an earlier result knows, with its whole covariance: update it by these data. "
        "For a sensor of a fleet, or more of them: the folder of that fleet.",
    )
    shared: Words = flag(
        (), "--shared", only=Kind.FITTED, metavar="NAME", help="One value for all runs."
    )
    per_run: Words = flag(
        (), "--per-run", only=Kind.FITTED, metavar="NAME", help="One value for each run."
    )
    effects: Words = flag(
        (),
        "--effects",
        only=Kind.FITTED,
        metavar="FILE|NAME|NAME(COLUMN)",
        help="Your own effects; or a shipped one that you know to be there.",
    )


@dataclass(frozen=True, slots=True)
class ReadingOptions:
    """How columns become signals."""

    columns: Assignments = flag(
        (),
        "--columns",
        of=Assignment,
        metavar="NAME=…",
        help="Columns of a signal: v=ax,ay,az, v=a or v=0,1,2.",
    )
    units: Assignments = flag(
        (), "--unit", of=Assignment, metavar="NAME=…", help="Unit of a signal's columns: v=g."
    )
    scales: Assignments = flag(
        (), "--scale", of=Assignment, metavar="NAME=…", help="Raw counts: temp=int16/256+25."
    )
    rate: float | None = flag(
        None, "--rate", type=float, help="Samples per second, where no column is the time."
    )
    at_rest: bool = flag(False, "--at-rest", help="Find and average the rest intervals.")
    time_zero: Literal["first", "column"] = flag(
        "first",
        "--time-zero",
        type=click.Choice(["first", "column"]),
        help="t = 0 at each run's first sample, or where the column has it.",
    )
    project: str | None = flag(
        None,
        "--project",
        type=click.Path(),
        metavar="FILE",
        help="Options in a TOML file, written by `casest init`; what is typed overrides them.",
    )

    def keywords(self) -> dict[str, Any]:
        """Keyword arguments of `load_runs`."""
        columns = dict(given.pair() for given in self.columns)
        units = dict(given.pair() for given in self.units)
        scales = {given.pair()[0]: given for given in self.scales}
        return {
            "columns": {name: tuple(value.split(",")) for name, value in columns.items()},
            "units": units,
            "scales": {name: _checked_scale(given) for name, given in scales.items()},
            "rate": self.rate,
            "at_rest": self.at_rest,
            "time_zero": self.time_zero,
        }

    def of_signals(self, names: Container[str]) -> ReadingOptions:
        """The same, without what is said of other signals."""

        def own(option: Assignments) -> Assignments:
            return tuple(given for given in option if given.pair()[0] in names)

        return replace(
            self, columns=own(self.columns), units=own(self.units), scales=own(self.scales)
        )


def _checked_scale(given: Assignment) -> str:
    from casest.data.scaling import parse_scale

    _, text = given.pair()
    try:
        parse_scale(text)
    except CasestError as error:
        raise type(error)(f"{given.flag} {given.text}: {error}") from None
    return text


@dataclass(frozen=True, slots=True)
class MotionOptions:
    """What an estimator in motion is told of its states and its noise."""

    intensities: Assignments = flag(
        (),
        "--intensity",
        only=Kind.MOVING,
        of=Assignment,
        metavar="NAME=NUMBER",
        help="Of a state's driving noise, unit^2/s, or of a signal's noise, unit^2 s.",
    )
    stds: Assignments = flag(
        (),
        "--std",
        only=Kind.MOVING,
        of=Assignment,
        metavar="STATE=NUMBER",
        help="What is known of a state at the beginning.",
    )


@dataclass(frozen=True, slots=True)
class SensorOptions:
    """Noise of the sensors as their data sheets say it."""

    stated: Assignments = flag(
        (),
        "--sensor-noise",
        of=Assignment,
        metavar="SIGNAL=STD|%|COLUMN",
        help="Std of one reading: v=0.02 (model's unit), 'v=0.02 g', v=2%, v=u_x; x,y=… together.",
    )

    def stds(self, moving: Dynamics) -> dict[str, float]:
        """Standard deviation of one reading by signal of an estimator in motion, in its unit."""
        from casest.interface.sensor_noise import one_number

        return dict(one_number(given, moving.signals) for given in self.stated)


@dataclass(frozen=True, slots=True)
class FitOptions:
    """Options of `calibrate` and `close`."""

    model: ModelOptions = field(default_factory=ModelOptions)
    reading: ReadingOptions = field(default_factory=ReadingOptions)
    sensors: SensorOptions = field(default_factory=SensorOptions)
    holdout: Words = flag(
        (),
        "--holdout",
        only=Kind.FITTED,
        type=click.Path(),
        metavar="FILE",
        help="Score the estimate on this record, which the fit does not see.",
    )
    solver: str = flag(
        "ipopt",
        "--solver",
        show_default=True,
        type=SolverName(),
        help="ipopt, ipopt-exact, trust-region, multiple-shooting, or one of the model's own.",
    )
    starts: Assignments = flag(
        (),
        "--start",
        only=Kind.FITTED,
        of=Assignment,
        metavar="NAME=VALUE",
        help="Start value in place of the automatic one.",
    )
    law: str = flag(
        "normal",
        "--noise-law",
        show_default=True,
        metavar="normal|t|t:NU",
        help="Of calibrate alone. Heavy tails: Student's t, NU degrees of freedom or as it shows.",
    )
    seed: int = flag(0, "--seed", show_default=True, help="For random restarts.")
    output: Path | None = flag(None, "-o", "--output", **RESULTS)
    as_json: bool = flag(False, "--json", help="Print result.json instead of a table.")


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """A record that need not fit in memory."""

    partitions: bool = flag(
        False,
        "--partitions",
        only=Kind.FITTED,
        help="DATA is one record that need not fit in memory: Parquet files, or file.py:function.",
    )
    workers: int | None = flag(
        None,
        "--workers",
        only=Kind.FITTED,
        type=click.IntRange(min=1),
        metavar="N",
        help="Threads that add it up (as many as there are cores); the numbers are the same.",
    )


@dataclass(frozen=True, slots=True)
class CalibrateOptions(FitOptions):
    """Options of `calibrate`."""

    profile: bool = flag(
        False,
        "--profile",
        help="Draw the likelihood's profile of every unknown whose cost is no parabola.",
    )
    record: RecordOptions = field(default_factory=RecordOptions)


@dataclass(frozen=True, slots=True)
class CloseOptions(FitOptions):
    """Options of `close`."""

    sensor: str | None = flag(
        None,
        "--sensor",
        only=Kind.FITTED,
        metavar="COLUMN",
        help="DATA is a Parquet data set of many sensors, named there: what have they in common?",
    )
    keep: Words = flag(
        (),
        "--keep",
        only=Kind.FITTED,
        metavar="COLUMN",
        help="With --sensor: does it follow this column (line, supplier, fixture)?",
    )
    record: RecordOptions = field(default_factory=RecordOptions)
