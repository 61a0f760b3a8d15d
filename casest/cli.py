"""The command line. Heavy modules are imported inside the commands: `--help` must be quick."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from casest import __version__
from casest.completing import EffectName, ModelName, SolverName
from casest.errors import CasestError, NotTrusted, UsageError
from casest.waiting import Waiting

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.dynamics import Dynamics
    from casest.modelling.model import Model

Options = dict[str, Any]

#: A file in its place is refused before anything is computed.
FOLDER = click.Path(path_type=Path, file_okay=False)

_waiting = Waiting()
#: Say what is going on, where somebody watches.
progress = _waiting.say


def echo(text: str, **how: Any) -> None:
    """Print, after what was said of the waiting is wiped away."""
    _waiting.done()
    click.echo(text, **how)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: exit code 0 done, 1 bad input, 2 no trustworthy estimate."""
    sys.exit(run(arguments))


def run(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code; no traceback reaches the user."""
    try:
        words = list(sys.argv[1:] if arguments is None else arguments)
        result = commands.main(words, prog_name="casest", standalone_mode=False, obj=words)
        return result if isinstance(result, int) else 0
    except CasestError as error:
        echo(f"casest: {error}", err=True)
        return error.exit_code
    except click.exceptions.NoArgsIsHelpError as error:
        echo(error.format_message())
        return 1
    except click.ClickException as error:
        echo(f"casest: {error.format_message()}", err=True)
        return 1
    except (click.Abort, KeyboardInterrupt):
        echo("casest: interrupted; nothing was written", err=True)
        return 2
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if os.environ.get("CASEST_TRACEBACK"):
            raise
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        echo(
            f"casest: internal error, please report it ({text}); CASEST_TRACEBACK=1 shows where",
            err=True,
        )
        return 2
    finally:
        _waiting.done()


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


@commands.command("list")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
def list_command(as_json: bool) -> None:
    """Shipped problems with their symbols and estimators, and the catalogue of effects."""
    from casest.effects import CATALOGUE
    from casest.problem import MOVING, SHIPPED, find_any, find_model
    from casest.terminal import listing

    models = [(name, find_model(name)) for name in SHIPPED]
    moving: list[Any] = [(name, find_any(name)) for name in MOVING]
    echo(listing(models, CATALOGUE, moving, as_json=as_json))


@commands.command()
@click.argument("model_name", metavar="MODEL", type=ModelName())
@click.argument("data", nargs=-1, required=True, type=click.Path())
@model_options
@reading_options
@output_options
def calibrate(model_name: str, data: tuple[str, ...], **options: Any) -> int:
    """Fit MODEL to DATA: values with uncertainty, certificate, what was not determined.

    Exit code 0: trusted; 1: bad input; 2: no trustworthy estimate (result.json says why).
    """
    return calibration(model_name, data, options, typed())


def typed() -> str:
    """The command as it can be typed again."""
    return shlex.join(["casest", *click.get_current_context().obj])


def calibration(model_name: str, data: Sequence[str], options: Options, command: str) -> int:
    """Read, fit, save, print; the exit code says whether the estimate is trusted."""
    from casest import estimate, result, terminal, unseen
    from casest.report import calibration_page
    from casest.solve.interrupt import interruptible

    model = declared_model(model_name, options)
    runs = records(model, data, options)
    hidden = held_out(model, data, options)
    start = dict(start_value(text, model) for text in options["starts"]) or None
    progress(f"fitting {model_name}")
    with interruptible():
        found = estimate.attempt(
            model, runs, start=start, solver=options["solver"], seed=options["seed"]
        )
    holdout = unseen.score(found, hidden) if hidden else None
    content = result.calibration_result(
        found, model_name=model_name, data=data, command=command, holdout=holdout
    )
    if options["output"]:
        progress(f"writing {options['output']}")
        result.save(options["output"], content, result.residual_rows(found))
        reported(options["output"], calibration_page(found, content, str(options["output"])))
    if options["as_json"]:
        echo(result.as_json(content), nl=False)
    else:
        words = terminal.calibration_text(found, content, options["output"])
        echo(terminal.coloured(words, sys.stdout))
    if not found.certificate.trusted:
        reason = found.certificate.reasons[0]
        echo(f"casest: no trustworthy estimate: {reason}", err=True)
        return NotTrusted.exit_code
    return 0


@commands.command()
@click.argument("model_name", metavar="MODEL", type=ModelName())
@click.argument("data", nargs=-1, required=True, type=click.Path())
@model_options
@reading_options
@output_options
def close(model_name: str, data: tuple[str, ...], **options: Any) -> int:
    """Fit, trace the residual to missing effects, add them, judge by held-out data.

    Verdict `adequate`: nothing that these data can show is missing; `extended`: effects were added
    and what is left is noise; `unexplained`: a misfit remains. Exit code 0 whatever the verdict.
    Of an estimator in motion the one-step innovations are diagnosed.
    """
    from casest.dynamics import Dynamics
    from casest.problem import find_any

    if isinstance(find_any(model_name), Dynamics):
        return closing_in_motion(model_name, data, options, typed())
    return closing(model_name, data, options, typed())


def closing(model_name: str, data: Sequence[str], options: Options, command: str) -> int:
    """Read, close the loop, save, print."""
    from casest import result
    from casest.closing import loop, text, unseen, written
    from casest.effects import CATALOGUE
    from casest.problem import find_effects
    from casest.report import closing_page
    from casest.terminal import coloured

    own = tuple(e for path in options["effects"] for e in find_effects(path))
    model = declared_model(model_name, {**options, "effects": ()})
    runs = records(model, data, options)
    apart = held_out(model, data, options)
    start = dict(start_value(words, model) for words in options["starts"]) or None
    progress(f"fitting {model_name}, looking for effects")
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
    hidden = unseen.scored(found, apart) if apart else None
    content = written.closing_result(
        found, model_name=model_name, data=data, command=command, held_out=hidden and hidden[1:]
    )
    if options["output"]:
        progress(f"writing {options['output']}")
        formula = written.formula_source(found)
        if formula:
            write(options["output"] / "formula.py", formula)
            written.name_file(content, options["output"] / "formula.py")
        result.save(options["output"], content, written.residual_rows(found, hidden))
        reported(options["output"], closing_page(found, content, str(options["output"])))
    if options["as_json"]:
        echo(result.as_json(content), nl=False)
    else:
        echo(coloured(text.closing_text(found, content, options["output"]), sys.stdout))
    return 0


#: Options of `close` that only calibrations have.
FITTED = ("effects", "per_run", "shared", "fix", "free", "starts", "holdout")


def closing_in_motion(model_name: str, data: Sequence[str], options: Options, command: str) -> int:
    """Filter, diagnose the innovations, add what is missing, save, print."""
    from casest import result
    from casest.closing_motion import loop, text, written
    from casest.report import closing_motion_page
    from casest.terminal import coloured

    for name in FITTED:
        if options[name]:
            flag = {"starts": "start"}.get(name, name.replace("_", "-"))
            raise UsageError(
                f"--{flag} is for calibrations; {model_name} is an estimator in motion: its "
                "effects and noise are found from the record alone"
            )
    moving, run = moving_record(model_name, data, {**options, "intensities": (), "stds": ()})
    progress(f"filtering {model_name}, looking for effects")
    found = loop.close_motion(moving, run, say=progress)
    content = written.motion_result(found, model_name=model_name, data=data, command=command)
    if options["output"]:
        result.save(options["output"], content, written.residual_rows(found))
        reported(options["output"], closing_motion_page(found, content))
    if options["as_json"]:
        echo(result.as_json(content), nl=False)
    else:
        echo(coloured(text.motion_text(content, options["output"]), sys.stdout))
    if not content["trusted"]:
        reason = content["after"]["certificate"]["reasons"][-1]
        click.echo(f"casest: no trustworthy estimate: {reason}", err=True)
        return NotTrusted.exit_code
    return 0


def refused(
    error: NotTrusted, model_name: str, data: Sequence[str], options: Options, command: str
) -> int:
    """Write and say what there is where the declared model itself has no trustworthy fit."""
    from casest import result
    from casest.report import calibration_page

    if error.estimate is not None and options["output"]:
        content = result.calibration_result(
            error.estimate, model_name=model_name, data=data, command=command
        )
        result.save(options["output"], content, result.residual_rows(error.estimate))
        page = calibration_page(error.estimate, content, str(options["output"]))
        reported(options["output"], page)
        if options["as_json"]:
            echo(result.as_json(content), nl=False)
    echo(f"casest: {error}", err=True)
    return NotTrusted.exit_code


@commands.command()
@click.option(
    "-o",
    "--output",
    type=FOLDER,
    metavar="DIR",
    help="Folder for result.json, residuals.csv and report.html.",
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
    echo(f"$ {words}\n")
    code = closing("wheel", (str(record),), options, words)
    echo("\n" + demonstration.comparison(options["output"]))
    return code


def motion_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of estimators in motion."""
    many: Options = {"multiple": True, "metavar": "STATE=NUMBER"}
    for option in (
        click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text."),
        click.option("-o", "--output", type=FOLDER, metavar="DIR", help="Folder."),
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


@commands.command()
@click.argument("model_name", metavar="MODEL", type=ModelName())
@click.argument("data", nargs=-1, type=click.Path())
@model_options
@reading_options
@motion_options
@click.option("--window", type=float, metavar="SECONDS", help="Of the sliding eigenvalue.")
def observe(model_name: str, data: tuple[str, ...], **options: Any) -> int:
    """What these data, or this trajectory, can see: rank, and what is hidden, in words.

    Without DATA: what any record of an estimator in motion could show (structural rank). Exit
    code 0 even where something is not observable.
    """
    from casest import observing, result
    from casest.modelling.model import Model
    from casest.problem import find_any

    fits = isinstance(find_any(model_name), Model)
    if fits:
        model = declared_model(model_name, options)
        if not data:
            raise UsageError(f"{model_name}: what can be seen depends on the record: give DATA")
        runs = records(model, data, options)
        progress(f"fitting {model_name}")
        content, _ = observing.observe_parameters(model, runs)
    elif not data:
        content = observing.observe_structure(moving_model(model_name, options))
    else:
        moving, run = moving_record(model_name, data, options)
        progress("what the trajectory shows")
        content = observing.observe_motion(moving, run, options["window"])
    content |= {"data": list(data), "reproduce": result.reproduce(typed(), data)}
    if options["output"]:
        from casest.report import observe_page

        write(options["output"] / "observe.json", result.as_json(content))
        reported(options["output"], observe_page(content))
    if options["as_json"]:
        echo(result.as_json(content), nl=False)
        return 0
    echo(observing.observe_text(content))
    seen = content["rank"] == content["unknowns"]
    last_words(options["output"], "report.html, observe.json", trusted=seen, applies=fits)
    return 0


@commands.command("filter")
@click.argument("model_name", metavar="MODEL", type=ModelName())
@click.argument("data", nargs=-1, required=True, type=click.Path())
@click.option(
    "--set", "constants", metavar="NAME=VALUE", multiple=True, help="Set a constant of the model."
)
@reading_options
@motion_options
@click.option(
    "--noise",
    type=click.Choice(["declared", "ml"]),
    default="declared",
    help="Noise intensities: as declared, or the most likely ones for this record.",
)
@click.option(
    "--sensor-noise",
    "stated",
    multiple=True,
    metavar="SIGNAL=STD",
    help="Standard deviation of one reading, in the model's unit; its rate is the record's.",
)
@click.option(
    "--rest",
    type=click.Path(),
    metavar="FILE",
    help="A record at rest: noise of the inputs by its Allan deviation.",
)
def filter_command(model_name: str, data: tuple[str, ...], **options: Any) -> int:
    """States over time by the Kalman filter and smoother, with innovations diagnosed."""
    from casest import filtering, result

    moving, run = moving_record(model_name, data, options)
    tuned, told = tuned_noise(moving, run, options)
    progress("filter and smoother")
    content, found = filtering.follow(moving, run, tuned)
    content |= told
    content |= {"data": list(data), "reproduce": result.reproduce(typed(), data)}
    if options["output"]:
        from casest.report import filter_page

        write(options["output"] / "states.csv", filtering.states_csv(found))
        write(options["output"] / "filter.json", result.as_json(content))
        reported(options["output"], filter_page(found, content))
    if options["as_json"]:
        echo(result.as_json(content), nl=False)
        return 0
    echo(filtering.filter_text(content))
    last_words(options["output"], "report.html, filter.json, states.csv")
    return 0


def last_words(output: Path | None, files: str, **known: Any) -> None:
    """What has been written, and what to type next."""
    from casest.following import following

    if output is not None:
        echo(f"\nWritten: {output}/{files}")
    if words := following(typed(), output, **known):
        echo(f"\n{words}")


def tuned_noise(moving: Dynamics, run: Run, options: Options) -> tuple[Any, Options]:
    """Noise intensities as --noise, --sensor-noise or --rest ask for them, and what a rest said."""
    from casest import intensities
    from casest.data import load_runs

    if options["noise"] == "ml":
        if options["stated"] or options["rest"]:
            raise UsageError("--noise ml finds every intensity: leave --sensor-noise, --rest out")
        progress("looking for the most likely noise intensities")
        return intensities.most_likely(moving, run), {}
    stds = dict(number_pair(text, "--sensor-noise") for text in options["stated"])
    stated = intensities.from_stated(moving, run, stds) if stds else None
    if options["rest"] is None:
        return stated, {}
    inputs = [s for s in moving.signals if s.name not in (*moving.measured_signals, "t")]
    arguments = reading_arguments(options)
    names = {s.name for s in inputs}
    for key in ("columns", "units", "scales"):
        arguments[key] = {n: v for n, v in arguments[key].items() if n in (*names, "t")}
    (rest,) = load_runs([options["rest"]], inputs, **arguments)[:1]
    tuned, found = intensities.from_rest(moving, rest)
    if stated:
        both = intensities.from_stated(tuned.model, run, stds).model
        tuned = intensities.Tuned(both, f"{tuned.how} and {stated.how}")
    return tuned, {"allan": intensities.told(found)}


def reported(folder: Path, page: str) -> None:
    """`report.html` beside the results."""
    from casest.report import REPORT

    write(folder / REPORT, page)


def write(path: Path, text: str) -> None:
    """A file in a folder that is made if it is missing."""
    from casest.data.write import write_atomically
    from casest.errors import DataError

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{path.parent}: cannot be made ({error.strerror})") from None
    write_atomically(path, text)


def moving_model(name: str, options: Options) -> Dynamics:
    """The estimator with its options applied."""
    from casest.dynamics import Dynamics
    from casest.problem import find_any

    moving = find_any(name)
    if not isinstance(moving, Dynamics):
        raise UsageError(f"{name} is no estimator in motion: casest calibrate, close or observe it")
    constants = dict(number_pair(text, "--set") for text in options["constants"])
    moving = moving.having(**constants)
    intensities = dict(number_pair(text, "--intensity") for text in options["intensities"])
    sensed = {s.name: intensities.pop(s.name) for s in moving.signals if s.name in intensities}
    moving = moving.driven(**intensities).sensing(**sensed)
    return moving.known_to(**dict(number_pair(t, "--std") for t in options["stds"]))


def moving_record(name: str, data: Sequence[str], options: Options) -> tuple[Dynamics, Run]:
    """The estimator with its options applied, and its one record."""
    from casest.data import load_runs

    moving = moving_model(name, options)
    if len(data) != 1:
        raise UsageError(f"{name}: a trajectory is one file, not {len(data)}")
    progress(f"reading {data[0]}")
    gaps = moving.may_be_missing
    runs = load_runs(list(data), moving.signals, gaps=gaps, **reading_arguments(options))
    if len(runs) != 1:
        raise UsageError(f"{data[0]} holds {len(runs)} runs; a trajectory is one")
    return moving, runs[0]


def number_pair(text: str, option: str) -> tuple[str, float]:
    """`name=number`."""
    key, value = _pair(text, option)
    try:
        return key, float(value)
    except ValueError:
        raise UsageError(f"{option} {text}: {value!r} is no number") from None


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
    from casest import applying, exporting

    arguments = reading_arguments(options)
    progress(f"correcting {data}")
    if exporting.is_exported(result_path):
        text = exporting.applied(result_path, data, arguments)
    else:
        text = applying.corrected_csv(result_path, data, arguments, force=options["force"])
    _waiting.done()
    if path := applying.write_or_print(text, options["output"]):
        echo(f"Written: {path}")


@commands.command()
@click.argument("model_name", metavar="MODEL", type=ModelName())
@model_options
@reading_options
@click.option("--value", "values", multiple=True, metavar="NAME=VALUE", help="True value.")
@click.option(
    "--effect",
    multiple=True,
    type=EffectName(),
    metavar="NAME[(COLUMN)]",
    help="An effect to add.",
)
@click.option("--noise", type=float, default=0.0, help="Standard deviation of each reading.")
@click.option("--duration", type=float, help="Seconds, with --rate, where time is all it needs.")
@click.option("--directions", type=int, metavar="N", help="N random directions or attitudes.")
@click.option("--input", "given", type=click.Path(), help="Record with the signals it needs.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("-o", "--output", type=FOLDER, default=Path("simulated"), metavar="DIR")
def simulate(model_name: str, **options: Any) -> None:
    """A record with known truth: DIR/record.csv and DIR/truth.json.

    Unknowns are at their declared start unless --value says otherwise, effects at a typical size.
    """
    simulation(model_name, options, typed())


def simulation(model_name: str, options: Options, command: str) -> None:
    """Signals, truth, readings, files."""
    import numpy as np

    from casest import simulating
    from casest.dynamics import Dynamics
    from casest.effects import CATALOGUE
    from casest.following import following
    from casest.problem import find_any, find_effects

    if isinstance(find_any(model_name), Dynamics):
        raise UsageError(f"{model_name} is an estimator in motion: it needs a trajectory of yours")
    own = tuple(e for path in options["effects"] for e in find_effects(path))
    model = declared_model(model_name, {**options, "effects": ()})
    rng = np.random.default_rng(options["seed"])
    if options["given"]:
        run = simulating.with_record(model, options["given"], reading_arguments(options))
    else:
        run = simulating.without_data(
            model,
            duration=options["duration"],
            rate=options["rate"],
            directions=options["directions"],
            rng=rng,
        )
    model = simulating.with_effects(model, run, options["effect"], (*CATALOGUE, *own))
    given = dict(named_value(text, "--value", model) for text in options["values"])
    values = simulating.truth(model, {name: value.array for name, value in given.items()})
    progress(f"simulating {model_name}")
    reading = simulating.simulated(model, run, values, options["noise"], rng)
    paths = simulating.written(
        options["output"], model, run, reading, values, options["noise"], options["seed"], command
    )
    for path in paths:
        echo(f"Written: {path}")
    echo(f"\n{following(command, file=paths[0])}")


@commands.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """A script that completes what is typed: eval "$(casest completion bash)"."""
    from click.shell_completion import get_completion_class

    made = get_completion_class(shell)
    assert made is not None
    echo(made(commands, {}, "casest", "_CASEST_COMPLETE").source())


@commands.command()
@click.argument("result_path", metavar="RESULT", type=click.Path(path_type=Path))
@click.option(
    "--to",
    required=True,
    type=click.Choice(["c", "python", "json"]),
    help="C99, a Python module with NumPy alone, or JSON that `casest apply` reads.",
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
def export(result_path: Path, to: Any, output: Path | None, **options: Any) -> None:
    """The correction of a saved RESULT, ready to run on the device."""
    from casest import exporting
    from casest.following import following

    if options["single"] and to != "c":
        raise UsageError("--float is for --to c")
    progress(f"exporting {result_path}")
    text = exporting.exported(result_path, to, **options)
    if output is None:
        echo(text, nl=False)
        return
    write(output, text)
    echo(f"Written: {output}")
    if words := following(typed(), file=output):
        echo(f"\n{words}")


@commands.command()
@click.argument("model_name", metavar="MODEL", type=ModelName())
@click.argument("data", nargs=-1, required=True, type=click.Path())
@model_options
@reading_options
@click.option(
    "--solver", "solvers", multiple=True, metavar="NAME", help="Only this one (repeatable)."
)
@click.option(
    "--start", multiple=True, metavar="NAME=VALUE", help="Start value in place of the automatic."
)
@click.option(
    "--starts", type=int, default=8, show_default=True, help="More starts, spread around the first."
)
@click.option(
    "--spread",
    type=float,
    multiple=True,
    metavar="SHARE",
    help="How far, as a share of each unknown's size (repeatable; 0.001, 0.01, 0.1 and 0.3).",
)
@click.option("--seed", type=int, default=0, show_default=True, help="For the spread of starts.")
@click.option(
    "--limit",
    type=float,
    default=10,
    show_default=True,
    metavar="SECONDS",
    help="Stop a solver's run after this time.",
)
@click.option(
    "-o",
    "--output",
    type=FOLDER,
    metavar="DIR",
    help="Folder for compare.json, compare.png and compare.svg.",
)
@click.option("--json", "as_json", is_flag=True, help="Print compare.json instead of tables.")
def compare(model_name: str, data: tuple[str, ...], **options: Any) -> int:
    """Run every solver on MODEL and DATA, from one start and from a spread of starts.

    Each is judged by the certified optimum: where it ended, what it claims, what it took. Exit
    code 0: done; 1: bad input; 2: no certified optimum to judge by, or interrupted (what is done
    is shown and written all the same).
    """
    from casest import comparing_text, result
    from casest.compare import SIZES
    from casest.compare import compare as compared

    model = declared_model(model_name, options)
    runs = records(model, data, options)
    found = compared(
        model,
        runs,
        starts=options["starts"],
        seed=options["seed"],
        start=dict(start_value(text, model) for text in options["start"]) or None,
        sizes=options["spread"] or SIZES,
        solvers=options["solvers"],
        limit=options["limit"],
        say=progress,
    )
    command = typed()
    content = comparing_text.comparison_result(
        found, model_name=model_name, data=data, command=command
    )
    written = written_comparison(found, content, options["output"]) if options["output"] else []
    if options["as_json"]:
        echo(result.as_json(content), nl=False)
    else:
        echo(comparing_text.comparison_text(found, data, written, command))
    if found.interrupted:
        echo(f"casest: interrupted after {found.done} of {found.planned} runs", err=True)
    elif not found.certified:
        echo("casest: no certified optimum to judge by", err=True)
    return 0 if found.certified and not found.interrupted else NotTrusted.exit_code


def written_comparison(found: Any, content: Options, folder: Path) -> list[Path]:
    """compare.json, and the plot where matplotlib is there; says so where it is not."""
    from casest import comparing_plot, comparing_text

    paths = [comparing_text.save(folder, content)]
    try:
        paths += comparing_plot.draw(found, folder)
    except UsageError as error:
        echo(f"casest: {error}", err=True)
    return paths


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

    progress(f"reading {', '.join(data)}")
    seen: set[Path] = set()
    for name in data:
        if Path(name).resolve() in seen:
            raise UsageError(f"{name} is given twice: it would count as two records")
        seen.add(Path(name).resolve())
    return load_runs(list(data), model.signals, **reading_arguments(options))


def held_out(model: Model, data: Sequence[str], options: Options) -> tuple[Run, ...]:
    """Records that the fit never saw."""
    fitted = {Path(name).resolve() for name in data}
    for name in options["holdout"]:
        if Path(name).resolve() in fitted:
            raise UsageError(f"--holdout {name}: the fit has seen this file; give another record")
    return records(model, options["holdout"], options) if options["holdout"] else ()
