"""Rest intervals of a raw record averaged into one sample each, with the error of each mean.

Used one mean each as in Tedaldi, Pretto, Menegatti (ICRA 2014, sec. IV); `stillness` finds them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casest.data.run import Array, Averaged, Labels, Run
from casest.data.stillness import WINDOW, Interval, Rests, find_rests, resolution
from casest.errors import UsageError

_WINDOW_SECONDS = 0.25
_FEWEST, _MOST = 15, 400  # samples in a window


def at_rest(
    run: Run,
    *,
    also: Sequence[str] = (),
    wanders: Sequence[str] = (),
    window: int | None = None,
    shortest: int | None = None,
) -> Run:
    """Average each rest interval of a raw run into one sample.

    also: names of further columns (a gyro's) that must be at rest too; they and the signals in
    `wanders` need not keep their mean.
    window: samples over which the variance is taken; shortest: samples an interval needs.

    Returns a run with one sample per interval: means, `count`, `spread` (standard error of the
    mean with the noise's autocorrelation), `rows` and `block` the interval's index, and in
    `columns` the first and last data row of each as "first_row" and "last_row".
    Raises DataError where nothing rests, or rest cannot be told from motion.
    """
    names, channels, n_averaged = _channels(run, also, wanders)
    found = find_rests(channels, run.block, _window(run, window), shortest, run.name, n_averaged)
    return _averaged(run, found, names, channels)


def _channels(
    run: Run, also: Sequence[str], wanders: Sequence[str]
) -> tuple[list[str], Array, int]:
    """Stack what must be still: the vector signals (a temperature may drift), then `also`.

    And how many must keep their mean: all, but for those that wander, which come last, and `also`.
    """
    if run.spread:
        raise UsageError(f"{run.name}: is averaged already; leave --at-rest out")
    names: list[str] = []
    parts: list[Array] = []
    plain = {k: v for k, v in run.signals.items() if k != "t" and v.shape[1] != 9}
    vectors = {k: v for k, v in plain.items() if v.shape[1] > 1} or plain
    kept = sum(v.shape[1] for k, v in vectors.items() if k not in wanders)
    for name, values in sorted(vectors.items(), key=lambda item: item[0] in wanders):
        names += _component_names(name, values.shape[1])
        parts.append(values)
    for name in also:
        column = run.columns.get(name)
        if column is None or column.dtype.kind == "U":
            raise UsageError(f"{run.name}: no column {name} of numbers to look for rest in")
        names.append(name)
        parts.append(np.asarray(column, dtype=np.float64)[:, None])
    if not parts:
        raise UsageError(f"{run.name}: no signal to look for rest in; leave --at-rest out")
    return names, np.concatenate(parts, axis=1), kept


def _component_names(name: str, size: int) -> list[str]:
    if size == 1:
        return [name]
    return [f"{name}{axis}" for axis in ("xyz" if size == 3 else map(str, range(size)))]


def _window(run: Run, window: int | None) -> int:
    """Return an odd number of samples: a quarter of a second where the rate is known."""
    if window is None and run.time is not None and len(run) > 1:
        window = round(_WINDOW_SECONDS / float(np.median(np.diff(run.time))))
        window = min(max(window, _FEWEST), _MOST)
    return (window or WINDOW) | 1


def _averaged(run: Run, found: Rests, names: list[str], channels: Array) -> Run:
    spans = found.intervals
    index = np.arange(len(spans))
    columns: dict[str, Array | Labels] = {
        name: np.array([_mean_or_label(values[s.samples]) for s in spans])
        for name, values in run.columns.items()
    }
    columns["first_row"] = np.array([float(run.rows[s.first]) for s in spans])
    columns["last_row"] = np.array([float(run.rows[s.last]) for s in spans])
    return replace(
        run,
        signals={k: _means(v, spans) for k, v in run.signals.items()},
        columns=columns,
        column_units={k: run.column_units.get(k) for k in columns},
        time=None if run.time is None else np.array([run.time[s.samples].mean() for s in spans]),
        rows=index,
        block=index,
        count=np.array([len(s) for s in spans]),
        spread={k: _spreads(v, spans) for k, v in run.signals.items() if k != "t"},
        notes=(*run.notes, *_notes(run, found, names, channels)),
        correlation={k: _correlations(v, spans) for k, v in run.signals.items() if k != "t"},
        averaged=Averaged(
            run, np.array([s.first for s in spans]), np.array([s.last for s in spans])
        ),
    )


def _mean_or_label(values: Array | Labels) -> float | str:
    """Return the mean of numbers; of labels the one they share, or nothing."""
    if values.dtype.kind == "U":
        return str(values[0]) if bool((values == values[0]).all()) else ""
    return float(np.asarray(values, dtype=np.float64).mean())


def _means(values: Array, spans: Sequence[Interval]) -> Array:
    means = np.array([values[s.samples].mean(axis=0) for s in spans])
    if values.shape[1] != 9:
        return means
    u, _, vt = np.linalg.svd(means.reshape(-1, 3, 3))  # the rotation nearest to the mean matrix
    return np.asarray((u @ vt).reshape(-1, 9), dtype=np.float64)


def _spreads(values: Array, spans: Sequence[Interval]) -> Array:
    steps = [resolution(values[:, k]) for k in range(values.shape[1])]
    return np.array(
        [
            [standard_error(values[s.samples, k], step) for k, step in enumerate(steps)]
            for s in spans
        ]
    )


def _correlations(values: Array, spans: Sequence[Interval], batches: int = 10) -> Array:
    """Correlation of a mean's components, (n, k, k), from the means of batches of the interval.

    A trembling hand moves the axes together, and along a direction that a norm does not see.
    """
    found = []
    for s in spans:
        inside = values[s.samples]
        parts = np.array(
            [p.mean(axis=0) for p in np.array_split(inside, min(batches, len(inside)))]
        )
        away = parts - parts.mean(axis=0)
        covariance = away.T @ away
        scale = np.sqrt(np.where(np.diag(covariance) > 0, np.diag(covariance), 1.0))
        correlation = covariance / np.outer(scale, scale)
        np.fill_diagonal(correlation, 1.0)
        found.append(correlation)
    return np.array(found).reshape(len(spans), values.shape[1], values.shape[1])


def standard_error(x: Array, step: float = 0.0) -> float:
    """Return the standard error of the mean of a stationary, autocorrelated (n,) record.

    var(mean) = s²/n (1 + 2 Σ ρ_k), summed while pairs of ρ stay positive (Geyer 1992, sec. 3.3).
    Where the noise is below half the resolution `step`, averaging does not beat quantisation and
    step/√12 is added.
    """
    n = len(x)
    y = x - x.mean()
    spectrum = np.fft.rfft(y, 2 * n)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2)[:n] / n
    rough = step / np.sqrt(12) if covariance[0] < (step / 2) ** 2 else 0.0
    if covariance[0] <= 0.0:
        return float(rough)
    rho = covariance / covariance[0]
    pairs = rho[0 : n - n % 2 : 2] + rho[1:n:2]
    positive = len(pairs) if (pairs > 0).all() else int(np.argmax(pairs <= 0))
    inflation = max(2.0 * float(pairs[:positive].sum()) - 1.0, 1.0)
    return float(np.hypot(np.sqrt(covariance[0] * inflation / (n - 1)), rough))


def _notes(run: Run, found: Rests, names: list[str], channels: Array) -> list[str]:
    covered = sum(len(s) for s in found.intervals)
    still = [channels[s.samples] for s in found.intervals]
    residual = np.concatenate([x - x.mean(axis=0) for x in still])
    sigma = np.sqrt((residual**2).sum(axis=0) / (covered - len(found.intervals)))
    notes = [
        f"{len(found.intervals)} rest intervals found, {covered} of {len(run)} samples "
        f"({100 * covered / len(run):.0f} %)",
        "noise at rest: " + ", ".join(f"{n} {s:.3g}" for n, s in zip(names, sigma, strict=True)),
    ]
    if run.time is None:
        notes.append(
            f"rate unknown, rest judged over {WINDOW} samples; say --rate HZ or --columns t=NAME"
        )
    if found.shortened:
        notes.append(f"{found.shortened} rest intervals shortened: they drift at one end")
    if found.split:
        notes.append(f"{found.split} quiet stretches split: the mean shifts inside them")
    if found.dropped:
        notes.append(f"{found.dropped} quiet stretches dropped: they drift all the time")
    return notes
