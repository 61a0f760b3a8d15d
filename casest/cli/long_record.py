"""`calibrate --partitions`: one record that need not fit in memory."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from casest.cli.loading import declared_model, with_prior
from casest.cli.options import CalibrateOptions
from casest.cli.shared import echo, progress
from casest.errors import NotTrusted, UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model


#: What is not written of a record that may not fit in memory.
LEFT_OUT = (
    "residuals.csv, report.html and the question whether the residual is noise are left out: they "
    "need every residual at once; close or calibrate a stretch of it"
)


def long_record(
    model_name: str, data: Sequence[str], options: CalibrateOptions, command: str
) -> int:
    """Read into mapped files, fit, save, print; the exit code says whether it is trusted."""
    from casest.effects.placing import told
    from casest.engine import by_workers
    from casest.estimate.calibrate import attempt
    from casest.report.text.calibration import calibration_text
    from casest.results.calibration import calibration_result
    from casest.results.file import as_json, save

    model = declared_model(model_name, options.model)
    start = dict(given.start(model) for given in options.starts) or None
    with mapped_records(model, data, options) as runs, by_workers(options.workers):
        model = told(with_prior(model, runs, options.model.prior), runs)
        progress(f"fitting {model_name}")
        found = attempt(model, runs, start=start, solver=options.solver, seed=options.seed)
        result = calibration_result(found, model_name=model_name, data=data, command=command)
        content = result.content()
        if options.output:
            save(options.output, content, None)
        text = as_json(content) if options.as_json else calibration_text(result, options.output)
    echo(text, nl=not options.as_json, verdict=not options.as_json)
    echo(f"casest: {LEFT_OUT}", err=True)
    if not found.certificate.trusted:
        reason = found.certificate.reasons[0]
        echo(f"casest: no trustworthy estimate: {reason}", err=True)
        return NotTrusted.exit_code
    return 0


@contextmanager
def mapped_records(
    model: Model, data: Sequence[str], options: CalibrateOptions
) -> Iterator[tuple[Run, ...]]:
    """The one run of a data set, its numbers in files that are gone afterwards.

    Raises UsageError about what needs all samples in memory, and what is asked of several records.
    """
    from casest.dataset.record import mapped_record

    _refuse(model, data, options)
    reading = {**model.reading, **options.reading.keywords()}
    known = {"t", *(s.name for s in model.signals)}
    columns = sorted({s.name for a in model.effects for s in a.signals} - known)
    with tempfile.TemporaryDirectory(prefix="casest-record-") as folder:
        progress(f"reading {data[0]}")
        run = mapped_record(data[0], model.signals, Path(folder), kept=columns, **reading)
        yield (run,)


def _refuse(model: Model, data: Sequence[str], options: CalibrateOptions) -> None:
    if len(data) > 1:
        raise UsageError(
            f"--partitions: {len(data)} data sets; give one: a Parquet file, a folder of them, or "
            "a pattern in quotes, whose rows are one record"
        )
    others = {
        "--at-rest": options.reading.at_rest or model.resting,
        "--holdout": bool(options.holdout),
        "--profile": options.profile,
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
