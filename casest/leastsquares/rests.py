"""What a model says of rests that follow each other: the one before, and the turn between."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.clipping import at_full_scale
from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import reached_signals
from casest.errors import DataError
from casest.leastsquares.on_the_way import means_on_the_way
from casest.leastsquares.turns import rotations, skew


@dataclass(frozen=True)
class Rests:
    """The rests of a run, and the raw record between them.

    `linked` (N,): is there a rest before, with no gap in between? `lost` (N,): did the turn go
    beyond the range of a sensor, so that it is left out? `spans` (K, 2) are the first and
    the last of the raw samples of each turn, as places in `samples` (M, k) and `time` (M,), which
    hold what lies between rests and nothing else.
    """

    linked: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    spans: NDArray[np.int_]
    samples: Array
    time: Array

    @classmethod
    def of(cls, model: Model, run: Run) -> Rests:
        """The rests of a run of means. Raises DataError where it is none."""
        if run.averaged is None:
            raise DataError(
                f"{run.file or run.name}: {model.name} looks at what lies between rests: give the "
                "raw record with --at-rest (load_runs(…, at_rest=True))"
            )
        raw, first, last = run.averaged.run, run.averaged.first, run.averaged.last
        linked = np.zeros(len(first), dtype=np.bool_)
        linked[1:] = (raw.block[last[:-1]] == raw.block[first[1:]]) & (first[1:] > last[:-1])
        lost = linked & _too_fast(model, raw, last, first)
        linked &= ~lost
        begin, end = last[np.flatnonzero(linked) - 1], first[linked]
        lengths = end - begin + 1
        starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int_)
        places = np.concatenate(
            [np.zeros(0, np.int_), *(np.arange(a, b + 1) for a, b in zip(begin, end, strict=True))]
        )
        values = [_values(raw, s.name)[places] for s in model.signals]
        spans = np.column_stack([starts[: len(lengths)], starts[: len(lengths)] + lengths - 1])
        return cls(linked, lost, spans, np.hstack(values), np.asarray(raw.time, float)[places])


class LastTurns:
    """What was integrated last. Most unknowns turn nothing: where only these have changed since,
    there is nothing to integrate anew."""

    def __init__(self) -> None:
        self.asked: tuple[object, ...] = ()

    def keep(self, asked: tuple[object, ...], found: tuple[Array, Array]) -> None:
        """Rotations and their slopes, and what they were asked with."""
        self.asked, self.found = asked, found


def _too_fast(
    model: Model, raw: Run, last: NDArray[np.int_], first: NDArray[np.int_]
) -> NDArray[np.bool_]:
    """Where (N,) what is turned by reached the end of its range since the rest before."""
    turning = ca.vertcat(*(s.taken for s in model.staged.stages if s.word == "turned"))
    names = reached_signals(model, model.staged, turning) & set(raw.signals) - {"t"}
    found = np.zeros(len(first), dtype=np.bool_)
    for name in names:
        total = np.concatenate([[0], np.cumsum(at_full_scale(raw.signals[name]))])
        found[1:] |= total[first[1:]] > total[last[:-1]]
    return found


def _values(raw: Run, name: str) -> Array:
    """A signal of the raw record, or a column that an effect reads."""
    if name in raw.signals:
        return np.asarray(raw.signals[name], float)
    if name == "t":
        return np.asarray(raw.time, float)[:, None]
    if name not in raw.columns:
        raise DataError(f"{raw.file or raw.name}: no data for {name!r} between rests")
    return np.asarray(raw.columns[name], float)[:, None]


@lru_cache(maxsize=64)
def needing(model: Model) -> NDArray[np.bool_]:
    """Which axes of a residual (m,) compare a rest with the one before."""
    staged = model.staged
    given = ca.vertcat(*(stage.given for stage in staged.stages if stage.word))
    rows = ca.jacobian(staged.expression, given).sparsity().get_triplet()[0]
    found = np.zeros(staged.expression.numel(), dtype=np.bool_)
    found[list(rows)] = True
    return found


def before(value: Array, slopes: Array) -> tuple[Array, Array]:
    """Values (N, m) and slopes (N, m, n) of the sample before; the first's are its own."""
    order = np.maximum(np.arange(len(value)) - 1, 0)
    return value[order], slopes[order]


def followed(values: Array, slopes: Array, rests: Rests) -> tuple[Array, Array]:
    """What a word gives at every rest, and its slopes: `turned` of a rate (M, 3), `carried` of a
    rate and a vector (M, 6)."""
    if values.shape[1] == 3:
        return turns(values, slopes, rests)
    n = slopes.shape[2]
    found, moved = np.zeros((len(rests.linked), 3)), np.zeros((len(rests.linked), 3, n))
    if rests.linked.any():
        means = means_on_the_way(values, slopes, rests.time, rests.spans)
        found[rests.linked], moved[rests.linked] = means
    return found, moved


def turns(rate: Array, slopes: Array, rests: Rests) -> tuple[Array, Array]:
    """Rotation (N, 9) since the rest before, column by column, and slopes (N, 9, n).

    rate (M, 3) and its slopes (M, 3, n) at the samples between rests. None where nothing is linked.
    """
    n = slopes.shape[2]
    found = np.broadcast_to(np.eye(3), (len(rests.linked), 3, 3)).copy()
    moved = np.zeros((len(found), 3, 3, n))
    if rests.linked.any():
        R, S = rotations(rate, slopes, rests.time, rests.spans)
        found[rests.linked] = R
        # dR = R·[S dθ]×, for each unknown.
        for j in range(n):
            moved[rests.linked, :, :, j] = R @ skew(S[:, :, j])
    # CasADi holds a matrix column by column.
    flat = moved.transpose(0, 2, 1, 3).reshape(len(found), 9, n)
    return found.transpose(0, 2, 1).reshape(-1, 9), flat
