"""Rows of results: one for each sensor, as Arrow columns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.dataset.readings import Block
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.estimate.reasons import Code
from casest.fleet.calibrate_many import Batch
from casest.tasks.job import Job


class Rows:
    """Room for the rows of S sensors, filled group by group; unknown numbers are null."""

    def __init__(self, model: Model, size: int, covariance: bool) -> None:
        n = sum(p.shape.size for p in model.parameters)
        self.x, self.std = np.full((2, n, size), np.nan)
        self.covariance = np.full((n * (n + 1) // 2, size), np.nan) if covariance else None
        self.rms, self.misfit, self.variance = np.full((3, size), np.nan)
        self.trusted = np.zeros(size, bool)
        self.reasons: dict[int, str] = {}
        self.codes: dict[int, str] = {}
        self._entries = [(p.name, k) for p in model.parameters for k in p.shape.entries]
        self._lower = np.tril_indices(n)

    def put(self, places: NDArray[np.int_], batch: Batch) -> None:
        """Take over what was found of the sensors at these places."""
        own = adjacent(places)
        for k, (name, index) in enumerate(self._entries):
            entry: Any = (slice(None), *index)
            self.x[k, own] = batch.values[name][entry]
            self.std[k, own] = batch.std[name][entry]
        if self.covariance is not None:
            self.covariance[:, own] = batch.covariance[:, self._lower[0], self._lower[1]].T
        self.rms[own], self.variance[own] = batch.rmse, batch.sigma**2
        self.misfit[own] = np.nan if batch.misfit is None else batch.misfit
        self.trusted[own] = batch.trusted
        for i in np.flatnonzero(~batch.trusted):
            self.reasons[int(places[i])] = batch.reasons[int(i)][0]
            self.codes[int(places[i])] = _first(batch.reasons, int(i))


def adjacent(places: NDArray[np.int_]) -> slice | NDArray[np.int_]:
    """The same places in their order, as a slice where they follow each other: no copies then."""
    if not len(places) or places[-1] - places[0] != len(places) - 1:
        return places
    return slice(int(places[0]), int(places[-1]) + 1)


def _first(reasons: Any, i: int) -> str:
    """The first thing that speaks against a sensor, in one word."""
    code = reasons.code(i)
    return next((c.name.lower() for c in Code if c in code and c.name), "refused")


def schema(job: Job) -> Any:
    """The Arrow schema of results: names, units, and whose they are."""
    import pyarrow

    def number(name: str, unit: str | None) -> Any:
        said = {"unit": unit} if unit and "[" not in unit else None
        return pyarrow.field(name, pyarrow.float64(), metadata=said)

    fields = [pyarrow.field("sensor", job.layout.types[0])]
    for p in job.model.parameters:
        for name in p.entry_names:
            unit = job.units.get(name)
            fields += [number(name, unit), number(f"{name}_std", unit)]
    if job.covariance:
        n = sum(p.shape.size for p in job.model.parameters)
        fields.append(
            pyarrow.field("covariance", pyarrow.list_(pyarrow.float64(), n * (n + 1) // 2))
        )
    fields += [
        pyarrow.field("trusted", pyarrow.bool_()),
        pyarrow.field("reason", pyarrow.dictionary(pyarrow.int32(), pyarrow.string())),
        number("rms", None),
        number("misfit", None),
    ]
    kept = zip(job.layout.kept, job.layout.types[1:], strict=True)
    fields += [pyarrow.field(name, kind) for name, kind in kept]
    about = {"casest": job.identity["casest"], "model": job.identity["model"]}
    return pyarrow.schema(fields, metadata=about)


def record_batch(job: Job, block: Block, rows: Rows, chosen: Any, form: Any) -> Any:
    """The chosen rows of a block as an Arrow record batch."""
    import pyarrow

    place = adjacent(chosen)
    trusted = rows.trusted[place]

    def numbers(values: Array) -> Any:
        own = values[place]
        return pyarrow.array(own, mask=~(np.isfinite(own) & trusted))

    def taken(column: Any) -> Any:
        if isinstance(place, slice):
            return column.slice(place.start, len(chosen))
        return column.take(pyarrow.array(chosen))

    columns: list[Any] = [taken(block.names)]
    for x, std in zip(rows.x, rows.std, strict=True):
        columns += [numbers(x), numbers(std)]
    if rows.covariance is not None:
        flat = pyarrow.array(np.ascontiguousarray(rows.covariance[:, chosen].T).ravel())
        gone, size = pyarrow.array(~trusted), len(rows.covariance)
        columns.append(pyarrow.FixedSizeListArray.from_arrays(flat, size, mask=gone))
    columns += [
        pyarrow.array(trusted),
        _reasons(rows, chosen),
        numbers(rows.rms),
        numbers(rows.misfit),
    ]
    columns += [taken(block.kept[name]) for name in job.layout.kept]
    return pyarrow.RecordBatch.from_arrays(columns, schema=form)


def _reasons(rows: Rows, chosen: Any) -> Any:
    """Why sensors are refused, dictionary-encoded; null of the trusted."""
    import pyarrow

    said = sorted({*rows.reasons.values()})
    place = {reason: k for k, reason in enumerate(said)}
    indices = np.full(len(rows.trusted), -1, np.int32)
    for k, reason in rows.reasons.items():
        indices[k] = place[reason]
    own = indices[chosen]
    return pyarrow.DictionaryArray.from_arrays(
        pyarrow.array(own, mask=own < 0), pyarrow.array(said, pyarrow.string())
    )
