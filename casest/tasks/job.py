"""What all partitions of a data set have in common, and the key of what becomes of each."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from casest import __version__
from casest.data.options import Options
from casest.dataset.layout import Layout
from casest.dataset.partitions import Partition
from casest.declaration.model import Model
from casest.declaration.travelling import fingerprint
from casest.fleet.population import Population

RESULTS, TASKS = "results", ".tasks"


@dataclass(frozen=True)
class Job:
    """One model, one layout, one folder; it pickles, and is sent to each worker once."""

    model: Model
    layout: Layout
    options: Options
    folder: Path
    noise: float | None = None
    covariance: bool = False
    #: What is known of a sensor before it is measured: the fleet that it is one of.
    prior: Population | None = None
    #: Unit of every entry of a parameter, by its name.
    units: Mapping[str, str] = field(default_factory=dict)
    #: Versions of what computes, by name.
    versions: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def identity(self) -> dict[str, str]:
        """What decides the numbers, by what it is called."""
        options = [sorted(self.options.columns.items()), sorted(self.options.units.items())]
        scales = sorted((name, repr(scale)) for name, scale in self.options.scales.items())
        own = [*options, scales, self.options.rate, self.options.time_zero, *self._known()]
        return {
            "model": f"{self.model.name} {fingerprint(self.model)[:16]}",
            "options": _digest(repr([own, self.noise, self.covariance, self.layout.kept]))[:16],
            "columns": _digest(repr(self.layout))[:16],
            "casest": __version__,
            **self.versions,
        }

    def _known(self) -> list[Any]:
        known = self.prior
        return [known.mean.tolist(), known.covariance.tolist(), known.sigma] if known else []

    def key(self, partition: Partition) -> str:
        """Hash of the model, the options and the input: what is alike has one result."""
        pieces = [
            (p.file.name, p.file.size, p.file.tag, p.first, p.stop, p.digest, p.name)
            for p in partition.pieces
        ]
        whole = repr([sorted(self.identity.items()), pieces, partition.twice])
        return _digest(whole)[:32]

    def results(self, partition: Partition) -> Path:
        """Where the sensors of a partition are written."""
        return self.folder / RESULTS / f"{self._stem(partition)}.parquet"

    def tally(self, partition: Partition) -> Path:
        """Where its counts are written, before its sensors are."""
        return self.folder / TASKS / f"{self._stem(partition)}.json"

    def done(self, partition: Partition) -> bool:
        """Is there a result of just this input, which has not been written since?"""
        try:
            written = self.results(partition).stat().st_mtime
            there = self.tally(partition).exists()
        except OSError:
            return False
        return there and all(p.file.modified <= written for p in partition.pieces)

    def _stem(self, partition: Partition) -> str:
        return f"part-{partition.number:06}-{self.key(partition)[:16]}"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
