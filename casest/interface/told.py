"""What an estimate and a closed loop are both asked for: text, page, files, tables, correction."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from casest.correction.carried import Carried
from casest.correction.reading import typed
from casest.data.write import make_folder, write_atomically, written_together
from casest.interface.correcting import Corrects
from casest.interface.plots import plot
from casest.interface.tables import Library, as_frame, headers
from casest.interface.words import as_python_says, in_python
from casest.report.html import REPORT
from casest.report.html.excerpt import excerpt
from casest.results.file import save
from casest.results.fitted import Fitted
from casest.results.saved import SavedResult, correction_of
from casest.results.values import Entry


def table_columns(entries: tuple[Entry, ...]) -> dict[str, Any]:
    """One row for each number: value, standard deviation, 95 % interval, unit."""
    value = np.array([e.value for e in entries])
    return {
        "parameter": [e.name for e in entries],
        "value": value,
        "std": np.array([e.std for e in entries]),
        "low95": value - [e.below for e in entries],
        "high95": value + [e.above for e in entries],
        "unit": [e.unit or "1" for e in entries],
    }


class Told(Corrects):
    """A fit, as Python's prompt, a notebook and a file show it."""

    @property
    def result(self) -> Fitted:
        """The content of `result.json`."""
        raise NotImplementedError

    def text(self) -> str:
        """What `casest` prints."""
        raise NotImplementedError

    def page(self) -> str:
        """HTML of the report."""
        raise NotImplementedError

    def rows(self) -> str:
        """The content of `residuals.csv`."""
        raise NotImplementedError

    def residual_columns(self) -> Mapping[str, Any]:
        """Residuals by sample."""
        raise NotImplementedError

    def __str__(self) -> str:
        """As the command line prints it."""
        return in_python(self.text())

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        """Verdict and values, for a notebook."""
        return excerpt(self.result, self.text().partition("\n\n")[0])

    def report(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file (a folder gets `report.html`) and return where it is."""
        target = Path(path)
        target = target if target.suffix in (".html", ".htm") else target / REPORT
        make_folder(target.parent)
        write_atomically(target, self.page())
        return target

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write `result.json`, `residuals.csv` and `report.html`; `casest.load` reads them."""
        target = Path(folder)
        with written_together():
            save(target, self.result.content(), self.rows())
            write_atomically(target / REPORT, self.page())
        return target

    def table(self, to: Library | None = None) -> Any:
        """A data frame with a row for each number: value, std, 95 % interval, unit.

        Of pandas or else polars, where one is installed; else a dict of columns.
        """
        return as_frame(table_columns(self.result.entries), to)

    def residuals(self, to: Library | None = None) -> Any:
        """A data frame with a row for each sample: run, row, t in s, the residual on each axis."""
        return as_frame(self.residual_columns(), to)

    def plot(self, what: str = "residuals", over: str | None = None) -> Any:
        """A Matplotlib figure of one of these.

        "residuals"; "parameters": 95 % intervals; "correlation"; "sphere": where the poses lie, of
        a vector of known length; "profiles": the cost with each unknown held and all else fitted.

        `over` names a column or quantity for the residuals' axis; else it is the time.
        """
        with as_python_says():
            return plot(self.result, what, over)

    def _correction(self, force: bool) -> tuple[SavedResult, Carried]:
        return correction_of(self._as_saved, "the estimate", force=force, what="uses")

    @cached_property
    def _as_saved(self) -> SavedResult:
        return typed(self.result.content(), SavedResult, "the estimate")


def sample_columns(runs: Any) -> dict[str, Any]:
    """Run, row in the data and time of every sample."""
    found: dict[str, Any] = {
        "run": np.concatenate([np.full(len(run), run.name) for run in runs]),
        "row": np.concatenate([np.asarray(run.rows) for run in runs]),
    }
    if all(run.time is not None for run in runs):
        found["t"] = np.concatenate([run.time for run in runs])
    return found


def by_axis(name: str, axes: tuple[str, ...], parts: Any) -> dict[str, Any]:
    """Columns of values (N, m) of each run, one for each axis."""
    whole = np.vstack(parts)
    names = headers(name, 1) if len(axes) == 1 else [f"{name}_{axis}" for axis in axes]
    return dict(zip(names, whole.T, strict=True))
