"""Options that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from casest.cli.completing import SolverName
from casest.cli.shared import FOLDER, Options


def reading_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options that say how columns become signals."""
    many: Options = {"multiple": True, "metavar": "NAME=…"}
    for option in (
        click.option(
            "--time-zero",
            type=click.Choice(["first", "column"]),
            default="first",
            help="t = 0 at each run's first sample, or where the column has it.",
        ),
        click.option("--at-rest", is_flag=True, help="Find and average the rest intervals."),
        click.option("--rate", type=float, help="Samples per second, where no column is the time."),
        click.option("--scale", "scales", help="Raw counts: temp=int16/256+25.", **many),
        click.option("--unit", "units", help="Unit of a signal's columns: v=g.", **many),
        click.option("--columns", help="Columns of a signal: v=ax,ay,az, v=a or v=0,1,2.", **many),
    ):
        command = option(command)
    return command


def model_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options that change what is unknown."""
    many: Options = {"multiple": True}
    for option in (
        click.option(
            "--effects",
            "effects",
            metavar="FILE|NAME",
            help="Your own effects; or a shipped one that you know to be there.",
            **many,
        ),
        click.option("--per-run", metavar="NAME", help="One value for each run.", **many),
        click.option("--shared", metavar="NAME", help="One value for all runs.", **many),
        click.option(
            "--fix",
            metavar="NAME=VALUE|@RESULT",
            **many,
            help="Hold a parameter: a number, 1,2,3, rows a,b;c,d, or @result.json.",
        ),
        click.option("--free", metavar="NAME", help="Make a constant an unknown.", **many),
        click.option(
            "--set",
            "constants",
            metavar="NAME=VALUE",
            **many,
            help="Set a constant: radius=0.28, 'norm=9.80665 m/s^2', 'gravity=gravity(45.5, 120)'.",
        ),
    ):
        command = option(command)
    return command


def output_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options for solving and for where results go."""
    for option in (
        click.option(
            "--json", "as_json", is_flag=True, help="Print result.json instead of a table."
        ),
        click.option(
            "-o",
            "--output",
            type=FOLDER,
            metavar="DIR",
            help="Folder for result.json, residuals.csv and report.html.",
        ),
        click.option("--seed", type=int, default=0, show_default=True, help="For random restarts."),
        click.option(
            "--start",
            "starts",
            multiple=True,
            metavar="NAME=VALUE",
            help="Start value in place of the automatic one.",
        ),
        click.option(
            "--solver",
            default="ipopt",
            show_default=True,
            type=SolverName(),
            help="ipopt, ipopt-exact, trust-region, or an estimator of the model's own.",
        ),
        click.option(
            "--holdout",
            multiple=True,
            type=click.Path(),
            metavar="FILE",
            help="Score the estimate on this record, which the fit does not see.",
        ),
    ):
        command = option(command)
    return command


def motion_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of estimators in motion."""
    for option in (
        click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text."),
        click.option("-o", "--output", type=FOLDER, metavar="DIR", help="Folder."),
        _known_and_driving,
    ):
        command = option(command)
    return command


def driving_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of a record in motion that is simulated."""
    return _known_and_driving(sensor_noise(command))


def sensor_noise(command: Callable[..., Any]) -> Callable[..., Any]:
    """Noise of the sensors as their data sheets say it."""
    return click.option(
        "--sensor-noise",
        "stated",
        multiple=True,
        metavar="SIGNAL=STD",
        help="In motion: std of one reading, in the model's unit; its rate is the record's.",
    )(command)


def _known_and_driving(command: Callable[..., Any]) -> Callable[..., Any]:
    many: Options = {"multiple": True, "metavar": "STATE=NUMBER"}
    for option in (
        click.option("--std", "stds", help="What is known of a state at the beginning.", **many),
        click.option(
            "--intensity",
            "intensities",
            help="Of a state's driving noise, unit^2/s, or of a signal's noise, unit^2 s.",
            **{**many, "metavar": "NAME=NUMBER"},
        ),
    ):
        command = option(command)
    return command
