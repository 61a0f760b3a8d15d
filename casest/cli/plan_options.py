"""Options of `plan`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import click

from casest.cli.assignments import Assignment, Assignments
from casest.cli.flags import Kind, flag
from casest.cli.options import FOLDER, ModelOptions, MotionOptions, ReadingOptions, Words


@dataclass(frozen=True, slots=True)
class PossibleOptions:
    """What can be measured."""

    candidates: str | None = flag(
        None,
        "--candidates",
        type=click.Path(),
        metavar="FILE",
        help="Table of what can be measured, in the model's signals; `cost` is what each costs.",
    )
    vary: Assignments = flag(
        (),
        "--vary",
        of=Assignment,
        metavar="NAME=VALUES",
        help="What can be set: temperature=20,40,60 or 'tilt=20:60:10 deg'.",
    )
    step: float = flag(
        15.0, "--step", type=float, show_default=True, help="Degrees between tilts of a pose."
    )
    reach: float | None = flag(
        None, "--reach", type=float, metavar="DEGREES", help="Furthest tilt from z up."
    )
    duration: float | None = flag(
        None, "--duration", type=float, help="Seconds of a run, or of a motion."
    )


@dataclass(frozen=True, slots=True)
class FlyingOptions:
    """What a motion may do, and how it is searched for."""

    limits: Words = flag(
        (),
        "--limit",
        only=Kind.MOVING,
        metavar="'NAME=MAX UNIT'",
        help="Of an input, a state or 'rate of NAME': its greatest length, or LOW:HIGH.",
    )
    pieces: int | None = flag(
        None,
        "--pieces",
        type=int,
        only=Kind.MOVING,
        help="Pieces of an input: 30 straight lines of a motion, 8 constants of an experiment.",
    )
    searches: int = flag(
        1, "--searches", type=int, show_default=True, help="From so many of the random motions."
    )
    seed: int = flag(0, "--seed", show_default=True, help="Of random motions and values.")


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """While one measures."""

    source: str | None = flag(
        None,
        "--live",
        metavar="FILE|PORT|-",
        help="Follow a growing file, a serial port or a pipe: which pose is next.",
    )
    idle: float = flag(
        60.0, "--idle", type=float, show_default=True, help="Seconds without data that end --live."
    )
    baud: int = flag(115200, "--baud", type=int, show_default=True, help="Of a serial port.")


@dataclass(frozen=True, slots=True)
class PlanOptions:
    """Options of `plan`."""

    model: ModelOptions = field(default_factory=ModelOptions)
    values: Assignments = flag(
        (), "--value", of=Assignment, metavar="NAME=VALUE", help="What an unknown is about."
    )
    noise: Assignments = flag(
        (),
        "--sensor-noise",
        of=Assignment,
        metavar="SIGNAL=STD",
        help="Standard deviation of one reading, in the model's unit.",
    )
    possible: PossibleOptions = field(default_factory=PossibleOptions)
    flying: FlyingOptions = field(default_factory=FlyingOptions)
    motion: MotionOptions = field(default_factory=MotionOptions)
    reading: ReadingOptions = field(default_factory=ReadingOptions)
    separate: bool = flag(
        False, "--separate", help="After close: what tells the causes apart that it left open."
    )
    show: str | None = flag(
        None,
        "--show",
        metavar="EFFECT",
        help="After close: what shows an effect of typical size that stayed invisible.",
    )
    count: int | None = flag(None, "--count", type=int, metavar="N", help="How many to plan.")
    budget: float | None = flag(
        None,
        "--budget",
        type=float,
        metavar="COST",
        help="What all may cost together (of the column cost, or seconds of runs).",
    )
    until: Words = flag(
        (),
        "--until",
        metavar="'NAME<STD UNIT'",
        help="As many as it takes: 'offset<0.001 m/s^2', 'corrected<0.01'.",
    )
    most: int = flag(200, "--most", type=int, show_default=True, help="At most, with --until.")
    criterion: str = flag(
        "D",
        "--criterion",
        metavar="D|A|E|G|NAME",
        show_default=True,
        help="Volume, sum, worst combination, corrected readings, or one unknown.",
    )
    robust: Literal["average", "worst"] | None = flag(
        None,
        "--robust",
        type=click.Choice(["average", "worst"]),
        help="For values that the unknowns may have, not for the likeliest alone.",
    )
    live: LiveOptions = field(default_factory=LiveOptions)
    output: Path | None = flag(
        None,
        "-o",
        "--output",
        type=FOLDER,
        metavar="DIR",
        help="Folder for plan.json, plan.csv and plan.html.",
    )
    as_json: bool = flag(False, "--json", help="Print plan.json instead of text.")
