"""An estimate at the Python prompt: printed, saved, drawn, and called to correct readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

from casest.diagnose.closing import Closing as Closed
from casest.diagnose.misfit.left import doubts
from casest.estimate.estimate import Estimate as Fit
from casest.interface.naming import data_names, name_of
from casest.interface.reading import Reading
from casest.interface.told import Told, by_axis, sample_columns
from casest.report.html.calibration import calibration_page
from casest.report.html.closed import closing_page
from casest.report.text.calibration import calibration_text
from casest.report.text.closing import closing_text
from casest.results import calibration, closing


@dataclass(frozen=True, repr=False, eq=False)
class Estimate(Told, Fit):
    """Parameters by name with covariance, certificate, residuals.

    `print(estimate)` shows what the command line does; `values`, `std` and `covariance` hold
    numbers, `table()` and `residuals()` data frames; `estimate(readings)` corrects new readings.

    `values` and `std` have the parameters' shapes (a leading run axis for per-run ones if there
    are several runs); where the data do not determine a value its std is NaN. `std` is `robust`,
    the sandwich form, where residuals are correlated over more than one sample or are many for
    each unknown, else `plain`. `covariance` (n, n) is of the unknowns `names`.
    """

    reading: Reading = field(default_factory=Reading)

    @classmethod
    def of(cls, found: Fit, reading: Reading) -> Estimate:
        """The same estimate; `reading` is how its data were read."""
        return cls(**_fields(found), reading=reading)

    @cached_property
    def result(self) -> calibration.Calibration:
        """The content of `result.json`, and what was written from it."""
        runs = self.problem.runs
        return calibration.calibration_result(
            self, model_name=name_of(self.model), data=data_names(runs), misfit=doubts(self)
        )

    @property
    def trusted(self) -> bool:
        """Whether the certificate vouches for the values."""
        return self.certificate.trusted

    def text(self) -> str:
        """What `casest calibrate` prints."""
        return calibration_text(self.result, None)

    def page(self) -> str:
        """HTML of the report."""
        return calibration_page(self.result)

    def rows(self) -> str:
        """The content of `residuals.csv`."""
        return calibration.residual_rows(self)

    def residual_columns(self) -> Mapping[str, Any]:
        """Residuals of the fit by sample."""
        parts = self.problem.residuals(self.point)
        return {
            **sample_columns(self.problem.runs),
            **by_axis("residual", self.model.axes, parts),
        }


@dataclass(frozen=True, repr=False, eq=False)
class Closing(Told, Closed):
    """What the loop leaves: the estimate `before` and `after`, what was added, what was refused.

    `print(closing)` shows what the command line does; `verdict` is adequate, extended, unexplained
    or None; `closing(readings)` corrects by the estimate after. `visible`: what these data could
    show of each effect that was tried; `undecided`: causes that are there, of which none was added.
    """

    reading: Reading = field(default_factory=Reading)

    @classmethod
    def of(cls, found: Closed, reading: Reading) -> Closing:
        """The same loop; `reading` is how its data were read."""
        before = Estimate.of(found.before, reading)
        same = found.after is found.before
        after = before if same else Estimate.of(found.after, reading)
        return cls(**{**_fields(found), "before": before, "after": after}, reading=reading)

    @cached_property
    def result(self) -> closing.Closed:
        """The content of `result.json`, and what was written from it."""
        names = data_names(self.runs)
        return closing.closing_result(self, model_name=name_of(self.before.model), data=names)

    def text(self) -> str:
        """What `casest close` prints."""
        return closing_text(self.result, None)

    def page(self) -> str:
        """HTML of the report."""
        return closing_page(self.result)

    def rows(self) -> str:
        """The content of `residuals.csv`."""
        return closing.residual_rows(self)

    def residual_columns(self) -> Mapping[str, Any]:
        """Residuals of the fits before and after by sample, and the held-out ones of both."""
        axes, found = self.before.model.axes, sample_columns(self.runs)
        for name, fit in (("before", self.before), ("after", self.after)):
            problem = type(fit.problem)(fit.model, self.runs)
            found |= by_axis(name, axes, problem.residuals(fit.point))
        found |= by_axis("held_out_before", axes, self.before_held_out)
        return found | by_axis("held_out_after", axes, self.after_held_out)


def _fields(found: Any) -> dict[str, Any]:
    return {f.name: getattr(found, f.name) for f in fields(found) if f.init and f.name != "reading"}
