"""`casest.load`: a saved result again, with its values, and called to correct readings."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from casest.correction.carried import Carried
from casest.declaration.shapes import Array
from casest.interface.correcting import Corrects
from casest.interface.reading import Reading
from casest.interface.tables import Library, as_frame
from casest.interface.told import table_columns
from casest.interface.words import as_python_says
from casest.report.text.layout import value_table
from casest.results.saved import SavedResult, correction_of, floats, saved_result
from casest.results.values import Entry


def load(path: str | os.PathLike[str]) -> Saved:
    """A result that `save` or the command line has written: its folder, or its `result.json`.

    Nothing of the model's source is run. Raises DataError where there is no result.
    """
    with as_python_says():
        return Saved(saved_result(Path(path)), Path(path))


@dataclass(frozen=True, repr=False)
class Saved(Corrects):
    """A saved result: `values` and `std` by parameter, `units`; called, it corrects readings."""

    content: SavedResult
    path: Path
    reading: Reading = field(default_factory=Reading)

    @property
    def model(self) -> str:
        """Name of the model."""
        return self.content.model

    @property
    def trusted(self) -> bool:
        """Whether the certificate vouched for the values."""
        return self.content.trusted

    @property
    def verdict(self) -> str | None:
        """Of `close`: adequate, extended or unexplained."""
        return self.content.verdict

    @cached_property
    def values(self) -> Mapping[str, Array]:
        """Values by parameter, in its shape; of `close`, after the loop."""
        return {n: floats(p.value) for n, p in self.content.parameters.items()}

    @cached_property
    def std(self) -> Mapping[str, Array]:
        """Standard deviations by parameter; NaN where there is none."""
        return {n: floats(p.std) for n, p in self.content.parameters.items()}

    @property
    def units(self) -> Mapping[str, str | list[str]]:
        """Unit of every parameter, or of each of its entries."""
        return {n: p.unit for n, p in self.content.parameters.items()}

    def __str__(self) -> str:
        verdict = "trusted" if self.trusted else "NOT TRUSTED"
        verdict = f"{verdict}, {self.verdict}" if self.verdict else verdict
        head = f"{self.model}, saved in {self.path}: {verdict}"
        return "\n".join([head, "", *value_table(self._entries)])

    def __repr__(self) -> str:
        return str(self)

    def table(self, to: Library | None = None) -> Any:
        """A data frame with a row for each number: value, std, 95 % interval, unit."""
        return as_frame(table_columns(self._entries), to)

    @property
    def _entries(self) -> tuple[Entry, ...]:
        return self.content.entries

    def _correction(self, force: bool) -> tuple[SavedResult, Carried]:
        return correction_of(self.content, str(self.path), force=force, what="uses")
