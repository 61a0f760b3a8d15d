"""The command line. Heavy modules are imported inside the commands: `--help` must be quick."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from casest import __version__
from casest.errors import CasestError, NotTrusted, UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.modelling.model import Model

Options = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: exit code 0 done, 1 bad input, 2 no trustworthy estimate."""
    sys.exit(run(arguments))


def run(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code; no traceback reaches the user."""
    try:
        result = commands.main(arguments, prog_name="casest", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except CasestError as error:
        click.echo(f"casest: {error}", err=True)
        return error.exit_code
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return 1
    except click.ClickException as error:
        click.echo(f"casest: {error.format_message()}", err=True)
        return 1
    except (click.Abort, KeyboardInterrupt):
        click.echo("casest: interrupted; nothing was written", err=True)
        return 2
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if os.environ.get("CASEST_TRACEBACK"):
            raise
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        click.echo(
            f"casest: internal error, please report it ({text}); CASEST_TRACEBACK=1 shows where",
            err=True,
        )
        return 2


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="casest")
def commands() -> None:
    """Calibrate sensors, prove the answer, and say what the data could not determine.

    MODEL is a shipped name (see `casest list`) or `file.py[:name]`.
    """


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
        click.option("--columns", help="Columns of a signal: v=ax,ay,az or v=0,1,2.", **many),
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
            metavar="FILE",
            help="Your own effects, added to the model.",
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
            type=click.Path(path_type=Path),
            metavar="DIR",
            help="Folder for result.json and residuals.csv.",
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


@commands.command("list")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
def list_command(as_json: bool) -> None:
    """Shipped problems with their symbols and estimators, and the catalogue of effects."""
    from casest.effects import CATALOGUE
    from casest.problem import SHIPPED, find_model
    from casest.terminal import listing

    models = [(name, find_model(name)) for name in SHIPPED]
    click.echo(listing(models, CATALOGUE, as_json=as_json))


@commands.command()
@click.argument("model_name", metavar="MODEL")
@click.argument("data", nargs=-1, required=True, type=click.Path())
@model_options
@reading_options
@output_options
def calibrate(model_name: str, data: tuple[str, ...], **options: Any) -> int:
    """Fit MODEL to DATA: values with uncertainty, certificate, what was not determined.

    Exit code 0: trusted; 1: bad input; 2: no trustworthy estimate (result.json says why).
    """
    return calibration(model_name, data, options, "casest " + " ".join(sys.argv[1:]))


def calibration(model_name: str, data: Sequence[str], options: Options, command: str) -> int:
    """Read, fit, save, print; the exit code says whether the estimate is trusted."""
    from casest import estimate, result, terminal

    model = declared_model(model_name, options)
    runs = records(model, data, options)
    start = dict(start_value(text, model) for text in options["starts"]) or None
    found = estimate.attempt(
        model, runs, start=start, solver=options["solver"], seed=options["seed"]
    )
    holdout = held_out(found, model, options) if options["holdout"] else None
    content = result.calibration_result(
        found, model_name=model_name, data=data, command=command, holdout=holdout
    )
    if options["output"]:
        result.save(options["output"], content, result.residual_rows(found))
    if options["as_json"]:
        click.echo(result.as_json(content), nl=False)
    else:
        click.echo(terminal.calibration_text(found, content, options["output"]))
    if not found.certificate.trusted:
        reason = found.certificate.reasons[0]
        click.echo(f"casest: no trustworthy estimate: {reason}", err=True)
        return NotTrusted.exit_code
    return 0


@commands.command()
@click.argument("model_name", metavar="MODEL")
@click.argument("data", nargs=-1, required=True, type=click.Path())
@model_options
@reading_options
@output_options
def close(model_name: str, data: tuple[str, ...], **options: Any) -> int:
    """Fit, trace the residual to missing effects, add them, judge by held-out data.

    Verdict `adequate`: nothing that these data can show is missing; `extended`: effects were added
    and what is left is noise; `unexplained`: a misfit remains. Exit code 0 whatever the verdict.
    """
    return closing(model_name, data, options, "casest " + " ".join(sys.argv[1:]))


def closing(model_name: str, data: Sequence[str], options: Options, command: str) -> int:
    """Read, close the loop, save, print."""
    from casest import result
    from casest.closing import loop, text, unseen, written
    from casest.effects import CATALOGUE
    from casest.problem import find_effects

    own = tuple(e for path in options["effects"] for e in find_effects(path))
    model = declared_model(model_name, {**options, "effects": ()})
    runs = records(model, data, options)
    start = dict(start_value(words, model) for words in options["starts"]) or None
    try:
        found = loop.close(
            model,
            runs,
            catalogue=(*CATALOGUE, *own),
            start=start,
            seed=options["seed"],
            say=progress,
        )
    except NotTrusted as error:
        return refused(error, model_name, data, options, command)
    hidden = None
    if options["holdout"]:
        hidden = unseen.scored(found, records(model, options["holdout"], options))
    content = written.closing_result(
        found, model_name=model_name, data=data, command=command, held_out=hidden and hidden[1:]
    )
    if options["output"]:
        result.save(options["output"], content, written.residual_rows(found, hidden))
    if options["as_json"]:
        click.echo(result.as_json(content), nl=False)
    else:
        click.echo(text.closing_text(found, content, options["output"]))
    return 0


def progress(words: str) -> None:
    """Say what is going on, where somebody watches."""
    if sys.stderr.isatty():
        click.echo(f"casest: {words}", err=True)


def refused(
    error: NotTrusted, model_name: str, data: Sequence[str], options: Options, command: str
) -> int:
    """Write and say what there is where the declared model itself has no trustworthy fit."""
    from casest import result

    if error.estimate is not None and options["output"]:
        content = result.calibration_result(
            error.estimate, model_name=model_name, data=data, command=command
        )
        result.save(options["output"], content, result.residual_rows(error.estimate))
        if options["as_json"]:
            click.echo(result.as_json(content), nl=False)
    click.echo(f"casest: {error}", err=True)
    return NotTrusted.exit_code


@commands.command()
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder for result.json and residuals.csv.",
)
def demo(output: Path | None) -> int:
    """Close the loop on a shipped record with an effect that its model lacks."""
    from casest import demonstration

    record = demonstration.WHEEL
    options: Options = {
        **dict.fromkeys(
            ("effects", "constants", "free", "fix", "shared", "per_run", "columns", "units"), ()
        ),
        **dict.fromkeys(("scales", "holdout", "starts"), ()),
        "rate": None,
        "at_rest": False,
        "time_zero": "first",
        "solver": "ipopt",
        "seed": 0,
        "output": output or Path("out"),
        "as_json": False,
    }
    words = f"casest close wheel {record} -o {options['output']}"
    click.echo(f"$ {words}\n")
    code = closing("wheel", (str(record),), options, words)
    click.echo("\n" + demonstration.comparison(options["output"]))
    return code


@commands.command()
@click.argument("result_path", metavar="RESULT", type=click.Path(path_type=Path))
@click.argument("data", type=click.Path())
@reading_options
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="FILE|DIR",
    help="A .csv file, or a folder for corrected.csv; without it, standard output.",
)
@click.option("--force", is_flag=True, help="Apply a result that was refused.")
def apply(result_path: Path, data: str, **options: Any) -> None:
    """Correct the readings in DATA with a saved RESULT (result.json, or its folder)."""
    from casest import applying

    text = applying.corrected_csv(
        result_path, data, reading_arguments(options), force=options["force"]
    )
    applying.write_or_print(text, options["output"])


# -- from the command line's words to values ------------------------------------------------------


def declared_model(name: str, options: Options) -> Model:
    """The model with --set, --free, --fix, --shared, --per-run and --effects applied."""
    from casest.declaring.symbols import Constant, Parameter, constant
    from casest.modelling.dimensions import check_units
    from casest.problem import find_effects, find_model

    model = find_model(name)
    for path in options["effects"]:
        for effect in find_effects(path):
            model = model.with_effect(effect)
            check_units(model)
    for text in options["constants"]:
        key, value = named_value(text, "--set", model)
        if isinstance(model[key], Parameter):
            raise UsageError(
                f"{key} is an unknown of {name}, not a constant; hold it with --fix {text}"
            )
        model = model.having(**{key: value if isinstance(value, Constant) else constant(value, "")})
    for key in options["free"]:
        model = model.freed(key)
    for text in options["fix"]:
        key, value = named_value(text, "--fix", model)
        model = model.having(**{key: value})
    for key in options["shared"]:
        model = model.scoped(key, "all")
    for key in options["per_run"]:
        model = model.scoped(key, "run")
    return model


def named_value(text: str, option: str, model: Model) -> tuple[str, Any]:
    """`name=value` as a name and a number, array, or constant with unit."""
    from casest.values import parse_value

    key, equals, value = text.partition("=")
    if not equals or not value:
        raise UsageError(f"{option} {text}: write it as {option} name=value")
    return key, parse_value(key, value, option, model)


def start_value(text: str, model: Model) -> tuple[str, Any]:
    """`name=value` as a start value in the parameter's own unit."""
    from casest.declaring.symbols import Parameter

    key, value = named_value(text, "--start", model)
    if not isinstance(model[key], Parameter):
        raise UsageError(f"--start {text}: {key} is no unknown of {model.name}")
    return key, model.having(**{key: value})[key].array


def reading_arguments(options: Options) -> Options:
    """Keyword arguments of `load_runs`."""
    pairs = {}
    for key, option in (("columns", "--columns"), ("units", "--unit"), ("scales", "--scale")):
        pairs[key] = dict(_pair(text, option) for text in options[key])
    for name, text in pairs["scales"].items():
        _checked_scale(name, text)
    columns = {name: tuple(value.split(",")) for name, value in pairs["columns"].items()}
    return {
        "columns": columns,
        "units": pairs["units"],
        "scales": pairs["scales"],
        "rate": options["rate"],
        "at_rest": options["at_rest"],
        "time_zero": options["time_zero"],
    }


def _checked_scale(name: str, text: str) -> None:
    from casest.data.scaling import parse_scale

    try:
        parse_scale(text)
    except CasestError as error:
        raise type(error)(f"--scale {name}={text}: {error}") from None


def _pair(text: str, option: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key or not value:
        raise UsageError(f"{option} {text}: write it as {option} name=value")
    return key, value


def records(model: Model, data: Sequence[str], options: Options) -> tuple[Run, ...]:
    """The runs in the files."""
    from casest.data import load_runs

    seen: set[Path] = set()
    for name in data:
        if Path(name).resolve() in seen:
            raise UsageError(f"{name} is given twice: it would count as two records")
        seen.add(Path(name).resolve())
    return load_runs(list(data), model.signals, **reading_arguments(options))


def held_out(found: Any, model: Model, options: Options) -> float:
    """Root mean square residual on records that the fit never saw."""
    from casest.estimate import score

    fitted = {Path(run.file).resolve() for run in found.problem.runs}
    for name in options["holdout"]:
        if Path(name).resolve() in fitted:
            raise UsageError(f"--holdout {name}: the fit has seen this file; give another record")
    return score(found, records(model, options["holdout"], options))
