"""`calibrate --partitions`, `close --partitions`: one record that need not fit in memory."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casest.cli.loading import asked_effects, declared_model, with_prior
from casest.cli.options import (
    CalibrateOptions,
    CloseOptions,
    FitOptions,
    ReadingOptions,
    RecordOptions,
)
from casest.cli.shared import echo, progress, reported, write
from casest.errors import NotTrusted, UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model
    from casest.diagnose.long_record import LongClosing
    from casest.estimate.estimate import Estimate


#: What is not written of a record that may not fit in memory.
LEFT_OUT = (
    "residuals.csv, report.html and the question whether the residual is noise are left out: they "
    "need every residual at once; close or calibrate a stretch of it"
)


def in_partitions(options: RecordOptions) -> bool:
    """Is the record one that need not fit in memory?"""
    if options.workers and not options.partitions:
        raise UsageError("--workers is for a record in --partitions; others need none")
    return options.partitions


def long_record(
    model_name: str, data: Sequence[str], options: CalibrateOptions, command: str
) -> int:
    """Read into mapped files, fit, save, print; the exit code says whether it is trusted."""
    from casest.effects.placing import told
    from casest.engine import by_workers
    from casest.estimate.calibrate import attempt

    model = declared_model(model_name, options.model)
    _refuse(model, data, options)
    if options.profile:
        raise UsageError("--partitions: --profile needs all samples in memory; leave one out")
    names = {s.name for a in model.effects for s in a.signals} - _known(model)
    with (
        mapped_records(model, data, options.reading, sorted(names)) as runs,
        by_workers(options.record.workers),
    ):
        model = told(with_prior(model, runs, options.model.prior), runs)
        progress(f"fitting {model_name}")
        start = dict(given.start(model) for given in options.starts) or None
        found = attempt(model, runs, start=start, solver=options.solver, seed=options.seed)
        text = _calibration(found, model_name, data, options, command)
    echo(text, nl=not options.as_json, verdict=not options.as_json)
    echo(f"casest: {LEFT_OUT}", err=True)
    if not found.certificate.trusted:
        reason = found.certificate.reasons[0]
        echo(f"casest: no trustworthy estimate: {reason}", err=True)
        return NotTrusted.exit_code
    return 0


def _known(model: Model) -> set[str]:
    """Names that are no column's."""
    return {"t", *(s.name for s in model.signals)}


def _calibration(
    found: Estimate, model_name: str, data: Sequence[str], options: FitOptions, command: str
) -> str:
    """`result.json`, and what is printed."""
    from casest.report.text.calibration import calibration_text
    from casest.results.calibration import calibration_result
    from casest.results.file import as_json, save

    result = calibration_result(found, model_name=model_name, data=data, command=command)
    content = result.content()
    if options.output:
        save(options.output, content, None)
    return as_json(content) if options.as_json else calibration_text(result, options.output)


def long_closing(model_name: str, data: Sequence[str], options: CloseOptions, command: str) -> int:
    """Read into mapped files, close the loop, save, print."""
    from casest.diagnose.long_record import close_long
    from casest.effects import CATALOGUE
    from casest.engine import by_workers

    known, own, _ = asked_effects(options.model.effects)
    model = declared_model(model_name, replace(options.model, effects=()))
    _refuse(model, data, options)
    with (
        mapped_records(model, data, options.reading, None) as runs,
        by_workers(options.record.workers),
    ):
        model = with_prior(model, runs, options.model.prior)
        start = dict(given.start(model) for given in options.starts) or None
        progress(f"fitting {model_name}, looking for effects")
        try:
            found = close_long(
                model, runs[0], catalogue=(*CATALOGUE, *own), start=start, known=known,
                seed=options.seed, say=progress,
            )  # fmt: skip
        except NotTrusted as error:
            if error.estimate is not None:
                text = _calibration(error.estimate, model_name, data, options, command)
                echo(text if options.as_json else "", nl=False)
            echo(f"casest: {error}", err=True)
            return NotTrusted.exit_code
        text = _closing(found, model_name, data, options, command)
    echo(text, nl=not options.as_json, verdict=not options.as_json)
    return 0


def _closing(
    found: LongClosing, model_name: str, data: Sequence[str], options: FitOptions, command: str
) -> str:
    """`result.json`, and of the samples that were looked at `residuals.csv` and the page."""
    from casest.report.html.closed import closing_page
    from casest.report.text.closing import closing_text
    from casest.results.closing import formula_source, residual_rows, with_formula_in
    from casest.results.file import as_json, save
    from casest.results.long_closing import long_closing_result

    result = long_closing_result(found, model_name=model_name, data=data, command=command)
    if options.output:
        progress(f"writing {options.output}")
        formula = formula_source(found.closing)
        if formula:
            write(options.output / "formula.py", formula)
            result = with_formula_in(result, options.output / "formula.py", formula)
        save(options.output, result.content(), residual_rows(found.closing))
        reported(options.output, closing_page(result, str(options.output)))
    return as_json(result.content()) if options.as_json else closing_text(result, options.output)


@contextmanager
def mapped_records(
    model: Model, data: Sequence[str], options: ReadingOptions, kept: Sequence[str] | None
) -> Iterator[tuple[Run, ...]]:
    """The one run of a data set, its numbers in files that are gone afterwards.

    `kept`: further columns; None for all that are numbers.
    """
    from casest.dataset.record import mapped_record

    reading = {**model.reading, **options.keywords()}
    with tempfile.TemporaryDirectory(prefix="casest-record-") as folder:
        progress(f"reading {data[0]}")
        parts = tables_of(data[0])
        run = mapped_record(data[0], model.signals, Path(folder), kept=kept, parts=parts, **reading)
        yield (run,)


def tables_of(name: str) -> Callable[[], Iterable[Any]] | None:
    """The function `file.py:name` that makes the tables of a record; None of files."""
    from casest.results.find import load_file

    path, colon, wanted = name.partition(":")
    if not path.endswith(".py") or not colon:
        return None
    found = getattr(load_file(Path(path)), wanted, None)
    if not callable(found):
        raise UsageError(
            f"{path}: no function {wanted!r}; name the one that yields the tables of the record"
        )
    made: Callable[[], Iterable[Any]] = found
    return made


def _refuse(model: Model, data: Sequence[str], options: FitOptions) -> None:
    """What needs all samples in memory, and what is asked of several records."""
    if len(data) > 1:
        raise UsageError(
            f"--partitions: {len(data)} data sets; give one: a Parquet file, a folder of them, a "
            "pattern in quotes, or file.py:function, whose rows are one record"
        )
    others = {
        "--at-rest": options.reading.at_rest or model.resting,
        "--holdout": bool(options.holdout),
        "--noise-law": options.law != "normal",
        "--sensor-noise": bool(options.sensors.stated),
    }
    for name, given in others.items():
        if given:
            raise UsageError(f"--partitions: {name} needs all samples in memory; leave one out")
    if model.sequential:
        raise UsageError(
            f"--partitions: in {model.name} a sample depends on those before it (a memory, an "
            "equation of motion), so that its partitions do not stand alone; calibrate a shorter "
            "stretch of it"
        )
