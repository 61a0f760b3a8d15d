"""What a calibration leaves: `result.json` and `residuals.csv` in their fixed form."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from functools import cached_property

from msgspec import UNSET, UnsetType

from casest.declaration.shapes import Array
from casest.diagnose.cross_validation import rms
from casest.diagnose.misfit.findings import Finding
from casest.effects.placing import prepared
from casest.estimate.estimate import Estimate
from casest.estimate.held_out import times_worse
from casest.results.file import plain
from casest.results.fitted import (
    Attachment,
    Doubt,
    Fitted,
    Section,
    attachment,
    correlation_of,
    fitted_content,
    noise_of,
)
from casest.results.residuals import Residuals, residuals_of, side_of
from casest.results.result import Certificate
from casest.results.uncertainty import covariance_of, freedom_of, inputs_of
from casest.results.units import unit_table
from casest.results.values import parameter_table


class Calibration(Fitted, frozen=True, kw_only=True, dict=True):
    """The content of `result.json` of `calibrate`; `holdout` as that of `close`."""

    estimate: Section
    effects: list[Attachment]
    holdout: list[str] | UnsetType = UNSET
    holdout_over_fit: float | UnsetType = UNSET

    @property
    def doubtful(self) -> bool:
        """Does the residual speak against the model?"""
        return bool(self.misfit)

    @property
    def over_repeats(self) -> float | None:
        """Residual over the scatter within rest intervals, where that does not explain it."""
        repeats, residual = self.noise.from_repeats, self.noise.from_residual
        if repeats and residual and residual > 2 * repeats:
            return residual / repeats
        return None

    @cached_property
    def residuals(self) -> Residuals:
        """What is drawn of the residuals: of one fit."""
        found = self.found
        side = side_of("residual", "after", found, found.problem)
        runs = prepared(found.model, found.problem.runs)
        return residuals_of([side], found, runs, noise_of(self.noise))


def calibration_result(
    estimate: Estimate,
    *,
    model_name: str,
    data: Sequence[str],
    command: str = "",
    holdout: Sequence[Array] | None = None,
    apart: Sequence[str] = (),
    misfit: Sequence[Finding] | None = None,
) -> Calibration:
    """What `calibrate` leaves. `verdict` is null: no effect was looked for.

    `holdout`: residuals (N, m) on records in the files `apart`, which the fit did not see. `misfit`
    is what speaks against the model, null where nobody asked.
    """
    problem, certificate = estimate.problem, estimate.certificate
    table = unit_table(problem.model, problem.runs)
    fit = Section(
        rmse_fit=float(estimate.rmse),
        rmse_holdout=None if holdout is None else plain(rms(holdout)),
        certificate=Certificate(
            certificate.trusted,
            list(certificate.reasons),
            plain(certificate.step),
            plain(certificate.curvature),
            [certificate.agreeing, certificate.starts],
            [b.name for b in certificate.at_bound],
        ),
        parameters=parameter_table(estimate, table),
        correlation=correlation_of(estimate),
        covariance=covariance_of(estimate),
        inputs=inputs_of(estimate),
        degrees_of_freedom=freedom_of(estimate),
    )
    shared = fitted_content(estimate, model_name, data, command)
    worse = times_worse(estimate, holdout) if holdout else None
    doubts = None if misfit is None else [Doubt(f.where, plain(f.p_value)) for f in misfit]
    return Calibration(**shared, verdict=None, estimate=fit, invisible=None, unexplained=None,
                       misfit=doubts, holdout=list(apart) or UNSET,
                       holdout_over_fit=UNSET if worse is None else worse,
                       effects=[attachment(a) for a in problem.model.effects])  # fmt: skip


def doubt_sentence(result: Calibration) -> str:
    """What a reader must know before using the values of a result with a misfit."""
    where = "; ".join(f"{f.where} (p = {f.p_value:.1g})" for f in result.misfit or [])
    return (
        f"the residual is not noise: {where}. The model lacks something, which may have moved the "
        "values by many of their standard deviations, however small the residual: "
        "`casest close` looks for it"
    )


def residual_rows(estimate: Estimate) -> str:
    """`residuals.csv` of a calibration: the column `after` is empty, nothing was added."""
    problem = estimate.problem
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["file", "run", "row", "t", "axis", "split", "before", "after"])
    for run, residual in zip(problem.runs, problem.told_residuals(estimate.point), strict=True):
        for k, row in enumerate(residual):
            t = "" if run.time is None else repr(float(run.time[k]))
            for axis, value in zip(problem.model.axes, row, strict=True):
                writer.writerow(
                    [run.file, run.name, int(run.rows[k]), t, axis, "fit", repr(float(value)), ""]
                )
    return text.getvalue()
