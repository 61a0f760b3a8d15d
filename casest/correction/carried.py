"""The correction that a result carries: applied and exported without the model's source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casest.correction.inverse import Correction, correction_of, invertible, of_their_time
from casest.correction.program import Program, program
from casest.data.run import Run, extent
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.errors import CasestError, UsageError, last_line

#: Readings of the fit that are kept for the self-test of an export: in all, or of each run.
TESTED, TESTED_EACH = 16, 4


@dataclass(frozen=True)
class Carried:
    """A program and what belongs to it.

    `model` is the declared name; `signals` are all of the model's, as declared, to bind data to.
    `own` numbers of each run, where the correction differs between runs, else none. `readings`
    (n, width) of the fit, one array, or one for each run. `timed` are effects that follow the time
    of the fitted record. `seen` (low, high) of each number of a sample in the fit, empty where an
    older result does not say.
    """

    model: str
    program: Program
    signals: tuple[Signal, ...]
    own: tuple[tuple[float, ...], ...]
    readings: tuple[Array, ...]
    timed: tuple[str, ...]
    seen: tuple[tuple[float, float], ...] = ()
    #: Standard deviations of what it gives (`correction.spread`); None where nothing says them.
    spread: Program | None = None
    #: That of other records, without what happened `once`, in the fitted one; None: it is the same.
    elsewhere: Carried | None = None
    once: tuple[str, ...] = ()

    @property
    def needed(self) -> tuple[Signal, ...]:
        """The signals that the correction reads."""
        names = [i.name for i in self.program.inputs]
        return tuple(s for s in self.signals if s.name in names)

    @property
    def lasting(self) -> Carried:
        """What is done to other records than the fitted one."""
        return self.elsewhere or self

    def was_fitted(self, runs: Sequence[Run]) -> bool:
        """Are these the samples that it was fitted to?"""
        names, (own, *more) = [i.name for i in self.program.inputs], self.readings
        if more or any(name not in run.signals for run in runs for name in names):
            return False
        there = _readings(runs, names, each=False)[0]
        return bool(np.array_equal(there, own))

    def of_run(self, which: int) -> tuple[Program, Array]:
        """The program of one run, and readings of it; of all where they share one."""
        if not self.own:
            return self.program, self.readings[0]
        return self.program.of_run(self.own[which]), self.readings[which]


def carried(
    fitted: Model,
    values: Mapping[str, Any],
    runs: Sequence[Run],
    units: Mapping[str, str],
    around: tuple[float, float] | None,
) -> Carried | str:
    """The correction of a fitted model, or why there is none.

    `values` have a leading axis of runs where a parameter differs between several; `around` is
    the range that the corrected quantity had in the fit.
    """
    try:
        return _carried(fitted, values, runs, units, around)
    except CasestError as error:
        return str(error)
    except Exception as error:  # an inverse of the user's own: the fit is not lost for it
        return f"model {fitted.name}: its correction fails: {last_line(error)}"


def _carried(
    fitted: Model,
    values: Mapping[str, Any],
    runs: Sequence[Run],
    units: Mapping[str, str],
    around: tuple[float, float] | None,
) -> Carried:
    model, left = invertible(fitted)
    correction = correction_of(model)
    points, differing = _points(model, correction, values, len(runs))
    if not np.isfinite(points).all():
        raise UsageError(f"model {fitted.name} was fitted without a value for every parameter")
    known = _of_run(model, values, 0, len(runs))
    names = [s.name for s in correction.signals]
    built = program(correction, known, units, around, _largest(correction, runs), differing)
    return Carried(
        fitted.name,
        replace(built, left=left),
        fitted.signals,
        tuple(tuple(map(float, p[differing])) for p in points) if differing else (),
        tuple(_readings(runs, names, each=bool(differing))),
        of_their_time(model),
        _seen(runs, names),
    )


def _of_run(model: Model, values: Mapping[str, Any], which: int, runs: int) -> dict[str, Any]:
    """Values of one run."""
    found = {}
    for p in model.parameters:
        value = np.asarray(values[p.name])
        found[p.name] = value[which] if p.scope == "run" and runs > 1 else value
    return found


def _points(
    model: Model, correction: Correction, values: Mapping[str, Any], runs: int
) -> tuple[list[Array], list[int]]:
    """The model's point in each run, and which of its entries differ in what is needed."""
    own = {p.name for p in model.parameters if p.scope == "run"} & correction.parameters
    first = _of_run(model, values, 0, runs)
    if runs < 2 or not own:
        return [np.concatenate(model.point(first))], []
    points = []
    for k in range(runs):
        one = _of_run(model, values, k, runs)
        points.append(np.concatenate(model.point(first | {n: one[n] for n in own})))
    return points, np.flatnonzero(np.ptp(points, axis=0) != 0).tolist()


def _largest(correction: Correction, runs: Sequence[Run]) -> float:
    """The largest reading of the fit; 1 where nothing is compared with it."""
    name = correction.measured
    parts = [run.signals[name] for run in runs if name in run.signals]
    sizes = [max(v.max(initial=0.0), -v.min(initial=0.0)) for v in parts]
    finite = [float(s) for s in sizes if np.isfinite(s) and s > 0]
    return max(finite, default=1.0)


def _seen(runs: Sequence[Run], names: Sequence[str]) -> tuple[tuple[float, float], ...]:
    """Range of each number of a sample in the fit."""
    every = [[extent(run.signals[name]) for name in names] for run in runs]
    whole = [[pair for pair in ends if pair is not None] for ends in every]
    whole = [ends for ends in whole if len(ends) == len(names)]
    if not whole:
        return ()
    low = np.min([np.concatenate([a for a, _ in ends]) for ends in whole], axis=0).tolist()
    high = np.max([np.concatenate([b for _, b in ends]) for ends in whole], axis=0).tolist()
    return tuple(zip(low, high, strict=True))


def _readings(runs: Sequence[Run], names: Sequence[str], *, each: bool) -> list[Array]:
    """Samples of what is needed, evenly over each run or over all of them."""
    count = TESTED_EACH if each else TESTED
    groups = [[run] for run in runs] if each else [list(runs)]
    return [_evenly(group, names, count) for group in groups]


def _evenly(runs: Sequence[Run], names: Sequence[str], count: int) -> Array:
    """So many complete samples (count, k), evenly over several runs."""
    first = np.cumsum([0, *map(len, runs)])
    places = np.unique(np.linspace(0, first[-1], count, endpoint=False).astype(int))
    parts = []
    for run, start, stop in zip(runs, first, first[1:], strict=False):
        own = places[(places >= start) & (places < stop)] - start
        parts.append(np.hstack([np.asarray(run.signals[n][own], float) for n in names]))
    found = np.vstack(parts)
    return np.asarray(found[np.isfinite(found).all(axis=1)])
