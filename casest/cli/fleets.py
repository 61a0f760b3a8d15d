"""`fleet`: a data set of many sensors, in partitions, on this machine or a cluster."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from casest.cli.flags import Kind, flag, taking
from casest.cli.loading import declared_model
from casest.cli.options import FOLDER, ModelOptions, ReadingOptions, Words, model_argument
from casest.cli.shared import commands, echo, progress, write
from casest.errors import INTERRUPTED, CasestError, NotTrusted, UsageError

if TYPE_CHECKING:
    from casest.data.options import Options
    from casest.dataset.partitions import Partition, Plan
    from casest.declaration.model import Model
    from casest.tasks.job import Job


@dataclass(frozen=True, slots=True)
class FleetOptions:
    """Options of `fleet`."""

    model: ModelOptions = field(default_factory=ModelOptions)
    reading: ReadingOptions = field(default_factory=ReadingOptions)
    sensor: str = flag(
        "sensor", "--sensor", show_default=True, metavar="COLUMN", help="Whose readings they are."
    )
    keep: Words = flag(
        (), "--keep", metavar="COLUMN", help="Copy a column to the results: date, line, supplier."
    )
    noise: float | None = flag(
        None,
        "--noise",
        type=click.FloatRange(min=0, min_open=True),
        metavar="STD",
        help="Of one residual of a sound sensor: one with significantly more is refused.",
    )
    covariance: bool = flag(False, "--covariance", help="Write each sensor's covariance too.")
    processes: int | None = flag(
        None,
        "--processes",
        type=click.IntRange(min=1),
        metavar="N",
        help="Processes on this machine (as many as it has cores).",
    )
    workers: int | None = flag(
        None,
        "--workers",
        type=click.IntRange(min=1),
        metavar="N",
        help="Dask workers on this machine instead.",
    )
    scheduler: str | None = flag(
        None, "--scheduler", metavar="ADDRESS", help="Workers of this Dask scheduler instead."
    )
    output: Path | None = flag(
        None,
        "-o",
        "--output",
        type=FOLDER,
        required=True,
        metavar="DIR",
        help="Folder for results/, rejected.parquet, fleet.json and fleet.html.",
    )
    as_json: bool = flag(False, "--json", help="Print fleet.json instead of a table.")


@commands.command()
@model_argument(Kind.FITTED)
@click.argument("dataset", type=click.Path())
@taking(FleetOptions)
def fleet(model_name: str, dataset: str, options: FleetOptions) -> int:
    """Fit MODEL to each of many sensors in DATASET, a Parquet file, folder or pattern.

    One row for each sensor with its readings as lists, or one for each reading. Interrupted or
    killed, the same command goes on where it was. Exit code 0: every partition is done, whatever
    was rejected; 1: bad input; 2: no sensor is trusted; 130: Ctrl-C, and what is done stays.
    """
    from casest.report.html.fleet import PAGE, fleet_page
    from casest.report.text.fleet import fleet_text
    from casest.results.file import as_json
    from casest.results.fleet import FLEET, fleet_result
    from casest.results.fleet_rows import drawn, estimated
    from casest.tasks.folder import swept, tallies, write_rejected
    from casest.tasks.tally import added

    assert options.output is not None
    model = declared_model(model_name, options.model)
    plan, job = planned(model, dataset, options)
    computed(job, plan, options)
    progress("counting")
    total = added(tallies(job, plan.partitions))
    result = fleet_result(
        job,
        total,
        dataset=dataset,
        partitions=len(plan.partitions),
        unreadable=plan.unreadable,
        found=estimated(job, plan.partitions, total),
    )
    swept(job, plan.partitions)
    write_rejected(job, plan.partitions, plan.unreadable)
    write(options.output / FLEET, as_json(result.content()))
    progress("drawing")
    looks = drawn(job, plan.partitions, total.sensors)
    write(options.output / PAGE, fleet_page(result, looks))
    if options.as_json:
        echo(as_json(result.content()), nl=False)
    else:
        echo(fleet_text(result, options.output, looks.misread.count), verdict=True)
    if not result.trusted:
        echo("casest: no sensor is trusted; rejected.parquet says why", err=True)
        return NotTrusted.exit_code
    return 0


def planned(model: Model, dataset: str, options: FleetOptions) -> tuple[Plan, Job]:
    """The partitions of a data set, and what they have in common; all that can be refused is."""
    from casest.dataset.partitions import plan
    from casest.fleet.calibrate_many import check_model, refuse_equations
    from casest.results.file import versions
    from casest.results.fleet import known
    from casest.tasks.job import Job

    assert options.output is not None
    if options.workers and (options.scheduler or options.processes):
        raise UsageError("--workers starts workers here: leave out --scheduler and --processes")
    for word in (dataset, str(options.output)) if options.scheduler else ():
        if "://" not in word and not Path(word).is_absolute():
            raise UsageError(
                f"--scheduler: its workers may be in another folder; give {word} as "
                f"{Path(word).resolve()}"
            )
    prior = options.model.prior
    if prior and options.noise:
        raise UsageError("--noise: with --prior the noise is that of the fleet; leave it out")
    if Path(dataset).resolve() in options.output.resolve().parents:
        raise UsageError(
            f"-o {options.output}: lies in the data set {dataset}, which it would become a part "
            "of; give a folder beside it"
        )
    check_model(model)
    if prior:
        refuse_equations(model, "--prior: a fleet is no prior for")
    reading = read_options(options.reading)
    progress(f"looking through {dataset}")
    found = plan(dataset, model.in_records, reading, sensor=options.sensor, kept=options.keep)
    computing = {name: v for name, v in versions().items() if name != "python"}
    units = units_of(model, found)
    job = Job(
        model,
        found.layout,
        reading,
        options.output,
        options.noise,
        options.covariance,
        known(Path(prior.removeprefix("@")), model, units) if prior else None,
        units,
        computing,
    )
    return found, job


def units_of(model: Model, plan: Plan) -> dict[str, str]:
    """Units of all symbols of a model, as the data set has its signals."""
    import numpy as np

    from casest.data.run import Run
    from casest.results.units import unit_table

    nothing = {s.name: np.zeros((1, s.size)) for s in model.signals}
    return unit_table(model, [Run.raw("fleet", nothing, units=dict(plan.layout.units))])


def read_options(options: ReadingOptions) -> Options:
    """How columns become signals, checked."""
    from casest.data import timing
    from casest.data.options import Options, stated_units
    from casest.data.scaling import parse_scale

    if options.at_rest:
        raise UsageError(
            "--at-rest finds rests in one record; a fleet's rows are poses: average each rest first"
        )
    given = options.keywords()
    return Options(
        given["columns"],
        stated_units(given["columns"], given["units"]),
        {name: parse_scale(text) for name, text in given["scales"].items()},
        None if options.rate is None else timing.checked_rate(options.rate),
        options.time_zero,
        (),
    )


def computed(job: Job, plan: Plan, options: FleetOptions) -> None:
    """Run what is not done yet; whatever ends it early says what is."""
    from casest.tasks.executors import Stopped
    from casest.tasks.folder import missing, prepared, refuse_others

    refuse_others(job)
    left = missing(job, plan.partitions)
    if not left:
        return
    try:
        with executor(options, len(left)) as run:
            prepared(job)
            for _ in _watched(run(job, left), left, len(plan.partitions)):
                pass
    except KeyboardInterrupt:
        raise _unfinished("interrupted", job, plan, INTERRUPTED) from None
    except Stopped as error:
        raise _unfinished(str(error), job, plan, 1) from None


def _unfinished(why: str, job: Job, plan: Plan, code: int) -> CasestError:
    from casest.tasks.folder import missing

    total = len(plan.partitions)
    done = total - len(missing(job, plan.partitions))
    error = CasestError(
        f"{why}; {done} of {total} partitions are done and stay in {job.folder}: the same command "
        "goes on from there"
    )
    error.exit_code = code
    return error


@contextmanager
def executor(options: FleetOptions, tasks: int) -> Iterator[Any]:
    """Who runs the tasks."""
    from casest.tasks.executors import Dask, Processes, dask, here

    if options.scheduler or options.workers:
        with dask(options.scheduler, options.workers) as client:
            echo(f"Dask dashboard: {client.dashboard_link}", err=True)
            yield Dask(client)
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    count = min(options.processes or cores or 1, tasks)
    yield here if count == 1 else Processes(count)


def _watched(done: Iterator[int], left: Sequence[Partition], total: int) -> Iterator[int]:
    """The same, with how far it is, how fast, and how long it will take."""
    began, before = time.monotonic(), total - len(left)
    progress(f"partition {before + 1} of {total}")
    for k, number in enumerate(done, 1):
        each = (time.monotonic() - began) / k
        rest = each * (len(left) - k)
        progress(f"{before + k} of {total} partitions, {1 / each:.2g} a second, {rest:.0f} s left")
        yield number
