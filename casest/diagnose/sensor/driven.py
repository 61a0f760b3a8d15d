"""A line in the spectrum that belongs to the motion: the sensor's own response at that frequency.

What a declared response lacks (a little of a low pass, a bend) stands in the residual where what
the sensor met is lively, at a wave's own frequency and its multiples most of all. Near one
frequency any such response is a gain and a phase of that motion and its powers: a line must stand
out beside these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol.state import ANOTHER
from casest.diagnose.sensor.fits import Fit
from casest.diagnose.sensor.rows import Rows

#: Windows, half over each other, in which the response at a frequency is one gain and one phase:
#: at most, and at least; turns of a line in each.
WINDOWS, FEWEST, TURNS = 60, 12, 2
#: Powers of the motion, of one number and of several.
POWERS, OF_SEVERAL = 4, 2


def driven(before: Fit, after: Fit, added: Sequence[Candidate], rows: Rows) -> str:
    """Why a line is no vibration: the motion tells it, by chance as well as not; else empty."""
    for what in added:
        profile = what.effect.profile if what.effect is not None else ()
        for name in (n for n, kind in profile if kind == "frequency"):
            frequency = float(np.max(after.values.get(f"{what.label}.{name}", 0.0)))
            if frequency > 0 and _told(before, frequency, rows):
                return (
                    f"what the sensor met tells a line at {frequency / (2 * np.pi):.3g} Hz as "
                    f"well: {ANOTHER}"
                )
    return ""


def _told(fit: Fit, frequency: float, rows: Rows) -> bool:
    """Does no more than chance of the residual's line (rad/s) stand out beside the motion's?"""
    linear = rows.linear(fit)
    if not linear.spans:
        return False
    span = max(linear.spans, key=lambda s: s.stop - s.start)
    times = [np.zeros(len(run)) if run.time is None else run.time for run in rows.runs]
    time = rows.of(times)[span]
    turn = frequency * (time - time[0])
    windows = min(WINDOWS, int(turn[-1] / (np.pi * TURNS)) - 1)
    if windows < FEWEST:
        return False
    demodulated = _demodulated(turn, windows)
    line = demodulated(np.exp(1j * turn)[:, None])
    motion, r = demodulated(_powers(rows.met(fit)[span], turn)), demodulated(linear.residual[span])
    free = windows - motion.shape[1] - 1
    if free < windows // 2:
        return False
    basis = _basis(motion)
    beside = line - basis @ (basis.conj().T @ line)
    if np.linalg.norm(beside) < np.sqrt(LEVELS.survives) * np.linalg.norm(line):
        return True  # the motion is that line
    own, left = beside / np.linalg.norm(beside), r - basis @ (basis.conj().T @ r)
    taken, rest = np.sum(np.abs(own.conj().T @ left) ** 2), np.sum(np.abs(left) ** 2)
    from scipy.special import fdtrc

    axes = r.shape[1]
    p = fdtrc(2 * axes, 2 * axes * free, taken / max((rest - taken) / free, 1e-300))
    return bool(p * len(turn) / 2 > LEVELS.chance)


def _demodulated(turn: Array, windows: int) -> Callable[[NDArray[Any]], NDArray[np.complex128]]:
    """Complex amplitudes (windows, k) of columns (N, k) at a line, in windows half over each other:
    in Hann's, neighbours are hardly alike."""
    ends = np.linspace(turn[0], turn[-1], windows + 2)
    parts = [
        (slice(*np.searchsorted(turn, [a, b])), a, b) for a, b in zip(ends, ends[2:], strict=False)
    ]

    def amplitudes(x: NDArray[Any]) -> NDArray[np.complex128]:
        found = np.zeros((windows, x.shape[1]), complex)
        for k, (part, a, b) in enumerate(parts):
            weight = np.sin(np.pi * (turn[part] - a) / (b - a)) ** 2 * np.exp(-1j * turn[part])
            found[k] = weight @ x[part]
        return found

    return amplitudes


def _powers(met: Array, turn: Array) -> Array:
    """What was met (N, q), how fast it changes, and its powers; of several numbers their products.

    With the rates the response may be a straight line over frequency, and a parabola over time: a
    gain that changes a little leaves a line beside that of a wave.
    """
    x = (met - met.mean(axis=0)) / np.maximum(met.std(axis=0), 1e-300)
    most = POWERS if x.shape[1] == 1 else OF_SEVERAL
    powers = [
        np.prod(x[:, list(which)], axis=1)
        for degree in range(1, most + 1)
        for which in combinations_with_replacement(range(x.shape[1]), degree)
    ]
    time = np.linspace(-1, 1, len(x))[:, None]
    found = np.column_stack([np.gradient(x, turn, axis=0), time * x, time**2 * x, *powers])
    return np.asarray(np.nan_to_num(found - found.mean(axis=0)))


def _basis(columns: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Orthonormal, of what its columns span."""
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(U[:, s > 1e-6 * s.max(initial=0.0)])
