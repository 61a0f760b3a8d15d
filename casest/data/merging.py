"""Signals with clocks of their own, as one run: every reading at the time when it was made.

The samples are those of all files, or of all rows of one. What drives a motion is a straight line
between two of its own samples, or held; a reading that was not made is none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from casest.data.curves import quaternions, turned
from casest.data.joining import stems, times_of
from casest.data.logs import file_name
from casest.data.options import Options
from casest.data.run import Array, Run
from casest.data.timing import ASSUMED
from casest.declaration.symbols import Signal
from casest.errors import DataError
from casest.units import conversion

Mask = NDArray[np.bool_]

#: Time stamps this share of the fastest clock's step apart are one instant.
ALIKE = 1e-3
#: Units of a clock by how many times too long a record lasts in s.
_UNITS = {3: "ms", 6: "us", 9: "ns"}
#: How near, in powers of ten, a record's length is to so many times another's.
_NEAR = 0.5


def one_clock_each(run: Run, signals: Sequence[Signal], options: Options) -> Run:
    """The run as it is, or, where inputs are missing in rows, with each signal's own samples."""
    names = [n for n in options.between or () if n in run.signals]
    if run.time is None or all(np.isfinite(run.signals[n]).all() for n in names):
        return run
    return merged([run], signals, options)


def merged(runs: Sequence[Run], signals: Sequence[Signal], options: Options) -> Run:
    """One run at the samples of all: every reading when it was made, inputs in between.

    Raises DataError where a file has no time, the clocks have none in common or seem to count in
    different units, or an input has fewer than two samples.
    """
    times = times_of(runs)
    _refuse_units(runs, times)
    time, places, notes = _instants(runs, times)
    found = {s.name: _on(runs, places, s, len(time)) for s in signals if _holder(runs, s)}
    read: dict[str, Mask] = {n: _there(values, some=True) for n, values in found.items()}
    inputs = [s for s in signals if s.name in (options.between or ()) and s.name in found]
    read |= {s.name: _there(found[s.name]) for s in inputs}
    kept = _covered(runs, time, [read[s.name] for s in inputs], notes)
    for s in inputs:
        found[s.name] = _between(s, time, read[s.name], found[s.name])
    zero = float(time[kept][0]) if options.time_zero == "first" else 0.0
    whole = _run(runs, time, places, found, notes)
    whole = replace(whole, read=read).take(kept)
    _refuse_holes(whole, signals, options)
    return _at_zero(whole, zero, signals, runs)


def _there(values: Array, some: bool = False) -> Mask:
    """Which samples (N,) have all their numbers, or some."""
    finite = np.isfinite(values)
    return np.asarray(finite.any(axis=1) if some else finite.all(axis=1))


def _holder(runs: Sequence[Run], signal: Signal) -> bool:
    return signal.name != "t" and any(signal.name in run.signals for run in runs)


def _refuse_units(runs: Sequence[Run], times: Sequence[Array]) -> None:
    """Where one record lasts a thousand, a million … times as long as another, and says no unit."""
    lasting = [float(np.ptp(t)) for t in times]
    k, shortest = int(np.argmax(lasting)), int(np.argmin(lasting))
    if not (lasting[shortest] > 0 and any(ASSUMED in note for note in runs[k].notes)):
        return
    power = np.log10(lasting[k] / lasting[shortest])
    for thousands, unit in _UNITS.items():
        if abs(power - thousands) < _NEAR:
            stem = stems(runs)[k]
            raise DataError(
                f"{runs[k].file} lasts {lasting[k]:.6g} s and {runs[shortest].file} "
                f"{lasting[shortest]:.6g} s: its clock, which states no unit, seems to count "
                f"{unit}: say --unit {stem}.t={unit}, or --unit {stem}.t=s if it does not"
            )


@dataclass(frozen=True)
class _Span:
    """What one file recorded, and when."""

    file: str
    first: float
    last: float

    def __str__(self) -> str:
        return f"{self.file} {self.first:.9g} to {self.last:.9g} s"


def _instants(
    runs: Sequence[Run], times: Sequence[Array]
) -> tuple[Array, list[NDArray[np.int_]], list[str]]:
    """All time stamps (N,), those alike as one; which of them each file's are; and what to say."""
    steps = [np.diff(t) for t in times if len(t) > 1]
    fastest = min((float(np.median(s)) for s in steps), default=0.0)
    alike = min([ALIKE * fastest, *(0.4 * float(s.min()) for s in steps)])
    every, owner = np.concatenate(times), np.repeat(np.arange(len(times)), [*map(len, times)])
    order = np.lexsort((owner, every))
    new = np.concatenate([[True], np.diff(every[order]) > alike])
    place = np.empty(len(every), np.int_)
    place[order] = np.cumsum(new) - 1
    time = np.empty(place.max() + 1)
    time[place[::-1]] = every[::-1]  # of those alike, the first file's
    ends = np.cumsum([0, *map(len, times)])
    places = [place[a:b] for a, b in pairwise(ends)]
    if len(runs) == 1:
        return time, places, []
    notes = [_rates(runs, times)]
    moved = np.abs(every - time[place])
    if moved.any():
        notes.append(
            f"{int(np.count_nonzero(moved))} time stamps less than {alike:.2g} s from another "
            f"file's are taken as the same instant (at most {moved.max():.2g} s off)"
        )
    return time, places, notes


def _rates(runs: Sequence[Run], times: Sequence[Array]) -> str:
    def said(run: Run, t: Array) -> str:
        step = f" every {np.median(np.diff(t)):.4g} s" if len(t) > 1 else ""
        return f"{file_name(run.file)} {len(t)}{step}"

    each = ", ".join(said(run, t) for run, t in zip(runs, times, strict=True))
    return f"every reading at its own time, inputs in between; samples: {each}"


def _on(runs: Sequence[Run], places: Sequence[NDArray[np.int_]], signal: Signal, N: int) -> Array:
    """A signal's samples where they are among all, (N, size), and NaN elsewhere."""
    k = next(k for k, run in enumerate(runs) if signal.name in run.signals)
    values = runs[k].signals[signal.name]
    found = np.full((N, values.shape[1]), np.nan)
    found[places[k]] = values
    return found


def _covered(runs: Sequence[Run], time: Array, inputs: Sequence[Mask], notes: list[str]) -> slice:
    """The samples within what all inputs recorded; whatever is dropped is said."""
    begin, end = 0, len(time)
    for read in inputs:
        own = np.flatnonzero(read)
        if len(own) < 2:
            raise DataError(
                f"{'+'.join(r.file for r in runs)}: an input has {len(own)} samples: a motion "
                "needs two at least"
            )
        begin, end = max(begin, int(own[0])), min(end, int(own[-1]) + 1)
    if len(runs) > 1:
        _refuse_apart(runs, time[begin] if begin < len(time) else np.inf, time[end - 1])
    if end - begin < len(time):
        notes.append(
            f"{len(time) - max(end - begin, 0)} of {len(time)} samples dropped: before the first "
            "or after the last sample of an input"
        )
    return slice(begin, end)


def _refuse_apart(runs: Sequence[Run], begin: float, end: float) -> None:
    """Raise DataError where a file recorded nothing while the inputs did."""
    spans = [
        _Span(r.file, float(t[0]), float(t[-1])) for r, t in zip(runs, times_of(runs), strict=True)
    ]
    apart = max(s.first for s in spans) > min(s.last for s in spans)
    if begin < end and not apart:
        return
    stem = stems(runs)[-1]
    raise DataError(
        f"no time that all files recorded: {', '.join(map(str, spans))}: a filter needs them on "
        f"one clock; move one with --scale {stem}.t=+SECONDS, or say its unit with --unit "
        f"{stem}.t=ms"
    )


def _between(signal: Signal, time: Array, read: Mask, values: Array) -> Array:
    """An input (N, size) at all samples, from those in which it was read."""
    own, known = time[read], values[read]
    before = np.clip(np.searchsorted(own, time, side="right") - 1, 0, len(own) - 1)
    if signal.held:
        return np.asarray(known[before])
    if signal.kind == "rotation":
        q = quaternions(known)
        lines = np.column_stack([np.interp(time, own, part) for part in q.T])
        between = turned(lines, np.zeros_like(lines))[0]
        return np.asarray(np.where(read[:, None], values, between))
    return np.column_stack([np.interp(time, own, part) for part in known.T])


def _run(
    runs: Sequence[Run],
    time: Array,
    places: Sequence[NDArray[np.int_]],
    signals: Mapping[str, Array],
    notes: Sequence[str],
) -> Run:
    first, N = runs[0], len(time)
    units = {name: unit for run in reversed(runs) for name, unit in run.units.items()}
    alone = len(runs) == 1
    said = [n if alone else f"{file_name(r.file)}: {n}" for r in runs for n in r.notes]
    return replace(
        Run.raw(first.name, signals, units=units, time=time),
        file="+".join(run.file for run in runs),
        rows=first.rows if alone else np.arange(N),
        notes=(*said, *notes),
    )


def _refuse_holes(run: Run, signals: Sequence[Signal], options: Options) -> None:
    """A signal that is both measured and computed from may be neither left out nor made up."""
    for s in signals:
        if s.name in run.signals and s.name not in options.gaps and not run.read[s.name].all():
            missing = int(np.count_nonzero(~run.read[s.name]))
            raise DataError(
                f"{run.file}: {s.name} is a reading from which the model computes something too, "
                f"and has no sample at {missing} of {len(run)} times: give it the clock of all "
                "others, or declare what is computed from it as a signal of its own"
            )


def _at_zero(run: Run, zero: float, signals: Sequence[Signal], runs: Sequence[Run]) -> Run:
    """Time from `zero` on, also where it is a signal; the run is a whole record."""
    assert run.time is not None
    time, found = run.time - zero, dict(run.signals)
    units = dict(run.units)
    for s in signals:
        if s.name == "t":
            factor, _ = conversion("s", s.unit or "s")
            found["t"], units["t"] = (time * factor)[:, None], s.unit or "s"
    notes = run.notes
    if zero and len(runs) > 1:
        notes = (*notes, f"time starts at {zero:.9g} s; that sample is t = 0")
    return replace(run, signals=found, units=units, time=time, notes=notes, whole=None, places=None)
