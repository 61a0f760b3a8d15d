"""`list`, `calibrate`, `close` and `demo`: fits, and what the models lack."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from casest.cli.flags import Kind, refuse, taking
from casest.cli.fleet_closing import fleet_closing
from casest.cli.loading import (
    asked_effects,
    declared_model,
    held_out,
    in_motion,
    model_and_records,
    moving_model,
    noisy,
    records,
    trajectory,
    with_prior,
)
from casest.cli.long_record import in_partitions, long_closing, long_record
from casest.cli.noise_law import with_noise_law
from casest.cli.options import (
    DATA,
    RESULTS,
    CalibrateOptions,
    CloseOptions,
    FitOptions,
    MotionOptions,
    model_argument,
)
from casest.cli.shared import commands, echo, progress, reported, typed, write
from casest.errors import NotTrusted, UsageError

if TYPE_CHECKING:
    from casest.estimate.estimate import Estimate
    from casest.results.profiles import ProfileOf


@commands.command("list")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
def list_command(as_json: bool) -> None:
    """Shipped problems with their symbols and estimators, and the catalogue of effects."""
    from casest.effects import CATALOGUE
    from casest.effects.moving import listed
    from casest.report.text.listing import listing_text
    from casest.results.find import MOVING, SHIPPED, find_any, find_model
    from casest.results.listing import listing

    models = [(name, find_model(name)) for name in SHIPPED]
    moving: list[Any] = [(name, find_any(name)) for name in MOVING]
    echo(listing_text(listing(models, CATALOGUE, moving, listed()), as_json=as_json))


@commands.command()
@model_argument(Kind.FITTED)
@DATA
@taking(CalibrateOptions)
def calibrate(model_name: str, data: tuple[str, ...], options: CalibrateOptions) -> int:
    """Fit MODEL to DATA: values with uncertainty, certificate, what was not determined.

    Exit code 0: trusted; 1: bad input; 2: no trustworthy estimate (result.json says why).
    """
    if options.profile and not options.output:
        raise UsageError("--profile draws on a page: say where with -o DIR")
    if in_partitions(options.record):
        return long_record(model_name, data, options, typed())
    return calibration(model_name, data, options, typed(), profile=options.profile)


def calibration(
    model_name: str,
    data: Sequence[str],
    options: FitOptions,
    command: str,
    *,
    profile: bool = False,
) -> int:
    """Read, fit, save, print; the exit code says whether the estimate is trusted."""
    from casest.diagnose.misfit.left import doubts, refused_for
    from casest.estimate.calibrate import attempt
    from casest.estimate.held_out import foretold
    from casest.report.html.calibration import calibration_page
    from casest.report.text.calibration import calibration_text
    from casest.results.calibration import calibration_result, residual_rows
    from casest.results.file import as_json, save

    model, runs = model_and_records(
        model_name, data, options.model, options.reading, options.sensors
    )
    model = with_noise_law(model, runs, options.law)
    hidden = held_out(model, options.holdout, data, options.reading)
    hidden = noisy(model, hidden, options.sensors)[1] if hidden else hidden
    start = dict(given.start(model) for given in options.starts) or None
    progress(f"fitting {model_name}")
    found = attempt(model, runs, start=start, solver=options.solver, seed=options.seed)
    holdout = foretold(found, hidden) if hidden else None
    progress("asking whether the residual is noise")
    result = calibration_result(
        found,
        model_name=model_name,
        data=data,
        command=command,
        holdout=holdout,
        apart=options.holdout,
        misfit=doubts(found),
    )
    if options.output:
        progress(f"writing {options.output}")
        save(options.output, result.content(), residual_rows(found))
        drawn = profiled(found, options.output) if profile else []
        reported(options.output, calibration_page(result, str(options.output), drawn))
    if options.as_json:
        echo(as_json(result.content()), nl=False)
    else:
        echo(calibration_text(result, options.output), verdict=True)
    if not found.certificate.trusted:
        echo(f"casest: no trustworthy estimate: {refused_for(found)}", err=True)
        return NotTrusted.exit_code
    return 0


def profiled(found: Estimate, folder: Path) -> list[ProfileOf]:
    """Profiles that are no parabola, and `profiles.csv` of all; of a trusted estimate."""
    from casest.results.profiles import profile_rows, profiles_of

    progress("following the likelihood's profiles")
    every = profiles_of(found)
    if not every:
        return []
    write(folder / "profiles.csv", "\n".join(profile_rows(every)) + "\n")
    bent = [p for p in every if p.bent]
    names = ", ".join(p.name for p in bent)
    said = f"no parabola: {names}: report.html draws it" if bent else "a parabola for every unknown"
    echo(f"casest: the cost is {said}; profiles.csv has every point", err=True)
    return bent


@commands.command()
@model_argument(Kind.FITTED, Kind.MOVING)
@DATA
@taking(CloseOptions)
def close(model_name: str, data: tuple[str, ...], options: CloseOptions) -> int:
    """Fit, trace the residual to missing effects, add them, judge by held-out data.

    Verdict `adequate`: nothing that these data can show is missing; `extended`: effects were added
    and what is left is noise; `unexplained`: a misfit remains. Exit code 0 whatever the verdict.
    Of an estimator in motion the one-step innovations are diagnosed; with --sensor the effects
    that many sensors have in common.
    """
    if in_motion(model_name, options.sensors):
        return closing_in_motion(model_name, data, options, typed())
    if options.sensor:
        return fleet_closing(model_name, data, options)
    if in_partitions(options.record):
        return long_closing(model_name, data, options, typed())
    if options.keep:
        raise UsageError("--keep is for a data set of many sensors: say --sensor COLUMN too")
    return closing(model_name, data, options, typed())


def closing(
    model_name: str,
    data: Sequence[str],
    options: FitOptions,
    command: str,
    first: Callable[[Path], str] | None = None,
) -> int:
    """Read, close the loop, save, print; `first` is what is said of the folder before the rest."""
    from casest.diagnose import loop
    from casest.diagnose.held_out import scored
    from casest.effects import CATALOGUE
    from casest.report.html.closed import closing_page
    from casest.report.text.closing import closing_text
    from casest.results.closing import (
        closing_result,
        formula_source,
        residual_rows,
        with_formula_in,
    )
    from casest.results.file import as_json, save

    if options.law != "normal":
        raise UsageError("--noise-law is for calibrate: close judges the tails of the noise itself")
    known, own, followed = asked_effects(options.model.effects)
    model = declared_model(model_name, replace(options.model, effects=()))
    runs = records(model, data, options.reading, followed)
    apart = held_out(model, options.holdout, data, options.reading, followed)
    model, runs = noisy(with_prior(model, runs, options.model.prior), runs, options.sensors)
    apart = noisy(model, apart, options.sensors)[1] if apart else apart
    start = dict(given.start(model) for given in options.starts) or None
    progress(f"fitting {model_name}, looking for effects")
    try:
        found = loop.close(
            model,
            runs,
            catalogue=(*CATALOGUE, *own),
            start=start,
            known=known,
            seed=options.seed,
            say=progress,
        )
    except NotTrusted as error:
        return refused(error, model_name, data, options, command)
    hidden = scored(found, apart) if apart else None
    result = closing_result(
        found,
        model_name=model_name,
        data=data,
        command=command,
        held_out=hidden and hidden[1:],
        apart=options.holdout,
    )
    if options.output:
        progress(f"writing {options.output}")
        formula = formula_source(found)
        if formula:
            write(options.output / "formula.py", formula)
            result = with_formula_in(result, options.output / "formula.py", formula)
        save(options.output, result.content(), residual_rows(found, hidden))
        reported(options.output, closing_page(result, str(options.output)))
        if first is not None:
            echo(first(options.output) + "\n")
    if options.as_json:
        echo(as_json(result.content()), nl=False)
    else:
        echo(closing_text(result, options.output), verdict=True)
    return 0


def closing_in_motion(
    model_name: str, data: Sequence[str], options: CloseOptions, command: str
) -> int:
    """Filter, diagnose the innovations, add what is missing, save, print."""
    from casest.diagnose.motion import loop
    from casest.dynamics.intensities import with_stated
    from casest.report.html.motion_closed import closing_motion_page
    from casest.report.text.motion import motion_text
    from casest.results.file import as_json, save
    from casest.results.motion import motion_result, residual_rows

    why = (
        f"is for calibrations; {model_name} is an estimator in motion: its effects and noise are "
        "found from the record alone"
    )
    refuse(options, Kind.FITTED, why)
    moving = moving_model(model_name, options.model.constants, MotionOptions())
    run = trajectory(moving, model_name, data, options.reading)
    if run.read:
        raise UsageError(
            f"close looks for its causes sample by sample, and the signals of {data[0]} have "
            "clocks of their own: filter it (--noise ml matches the noise), or close a record in "
            "which every row has all inputs"
        )
    moving = with_stated(moving, run, options.sensors.stds(moving))
    progress(f"filtering {model_name}, looking for effects")
    found = loop.close_motion(moving, run, say=progress)
    result = motion_result(found, model_name=model_name, data=data, command=command)
    if options.output:
        save(options.output, result.content(), residual_rows(found))
        reported(options.output, closing_motion_page(result))
    if options.as_json:
        echo(as_json(result.content()), nl=False)
    else:
        echo(motion_text(result, options.output), verdict=True)
    if not result.trusted:
        reason = result.after.certificate.reasons[-1]
        echo(f"casest: no trustworthy estimate: {reason}", err=True)
        return NotTrusted.exit_code
    return 0


def refused(
    error: NotTrusted, model_name: str, data: Sequence[str], options: FitOptions, command: str
) -> int:
    """Write and say what there is where the declared model itself has no trustworthy fit."""
    from casest.report.html.calibration import calibration_page
    from casest.results.calibration import calibration_result, residual_rows
    from casest.results.file import as_json, save

    if error.estimate is not None and options.output:
        result = calibration_result(
            error.estimate, model_name=model_name, data=data, command=command
        )
        save(options.output, result.content(), residual_rows(error.estimate))
        page = calibration_page(result, str(options.output))
        reported(options.output, page)
        if options.as_json:
            echo(as_json(result.content()), nl=False)
    echo(f"casest: {error}", err=True)
    return NotTrusted.exit_code


@commands.command()
@click.option("-o", "--output", default=Path("out"), **RESULTS)
def demo(output: Path) -> int:
    """Close the loop on a shipped record with an effect that its model lacks."""
    from casest.data.write import written_at_once
    from casest.demo import WHEEL, story

    words = f"casest close wheel {WHEEL} -o {output}"
    echo(f"$ {words}\n")
    with written_at_once():  # the story is read from them
        return closing("wheel", (str(WHEEL),), FitOptions(output=output), words, first=story)
