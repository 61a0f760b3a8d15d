"""Is the gyroscope read when the accelerometer is? What a turn from rest to rest says of it.

The body has no velocity at either rest: the force less gravity, turned into one frame by the
gyroscope and summed, is nothing, however the hand has moved. Of a rate that is δ late the force of
gravity is turned by what is turned in δ too little: the sum is then δ·g·u × ∫ω in that frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import Run

Array = NDArray[np.float64]

#: Turns below which nothing is said, and the chance below which something is.
FEWEST, CHANCE = 6, 1e-3


def late(runs: Sequence[Run], known: Mapping[str, Array]) -> Iterator[str]:
    """Says by how much the gyroscope is read late, where that is no chance."""
    from scipy.special import stdtr

    parts = [velocities(run, known) for run in runs]
    gained, per_second = (np.concatenate(part) for part in zip(*parts, strict=True))
    if len(gained) < FEWEST:
        return
    along, square = np.sum(gained * per_second, axis=1), np.sum(per_second**2, axis=1)
    delay = along.sum() / square.sum()
    count = len(gained)
    # Every turn has an error of its own, of whatever size.
    std = np.linalg.norm(along - delay * square) / square.sum() * np.sqrt(count / (count - 1))
    if 2 * stdtr(count - 1, -abs(delay) / std) < CHANCE:
        old, other = ("gyroscope", "accelerometer")[:: 1 if delay > 0 else -1]
        yield (
            f"the {old}'s readings are {1e3 * abs(delay):.3g} ± {1e3 * std:.2g} ms older than the "
            f"{other}'s beside them ({count} turns, at whose ends the velocity is zero): the "
            "calibration looks from rest to rest and is not moved by it; in motion, shift one "
            "(--free gyroscope_delay: with everything else)"
        )


def velocities(run: Run, known: Mapping[str, Array]) -> tuple[Array, Array]:
    """Velocity gained by each turn (K, 3), in the frame of the rest before, and what a second of
    delay of the gyroscope would make of it."""
    assert run.averaged is not None
    raw, gravity = run.averaged.run, float(known["gravity"])
    whole = raw.block[run.averaged.last[:-1]] == raw.block[run.averaged.first[1:]]
    begin, end = run.averaged.last[:-1][whole], run.averaged.first[1:][whole]
    force, rate = _corrected(raw.signals, known)
    time = np.asarray(raw.time, float)
    up = (run.signals["a"][:-1][whole] - known["accelerometer_offset"]) @ known[
        "accelerometer_scale"
    ].T
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    attitude = np.broadcast_to(np.eye(3), (len(begin), 3, 3))
    gained, turned = -gravity * (time[end] - time[begin])[:, None] * up, np.zeros_like(up)
    for k in range(int(np.max(end - begin, initial=0))):
        i, j = np.minimum(begin + k, end), np.minimum(begin + k + 1, end)
        h = (time[j] - time[i])[:, None]
        angle = 0.5 * h * (rate[i] + rate[j])
        after = attitude @ _rotation(angle)
        ends = [(at @ of[n][:, :, None])[:, :, 0] for at, n in ((attitude, i), (after, j))
                for of in (force, rate)]  # fmt: skip
        gained = gained + 0.5 * h * (ends[0] + ends[2])
        turned += 0.5 * h * (ends[1] + ends[3])
        attitude = after
    return gained, gravity * np.cross(up, turned)


def _corrected(signals: Mapping[str, Array], known: Mapping[str, Any]) -> tuple[Array, Array]:
    """Force and rate (N, 3) of every reading."""
    force = (signals["a"] - known["accelerometer_offset"]) @ known["accelerometer_scale"].T
    bias = known["gyroscope_offset"] + force @ known["g_sensitivity"].T
    return force, (signals["w"] - bias) @ known["gyroscope_scale"].T


def _rotation(angle: Array) -> Array:
    """exp([φ]×), (K, 3, 3), of rotation vectors (K, 3)."""
    size = np.linalg.norm(angle, axis=1)[:, None, None]
    x, y, z = angle.T
    zero = np.zeros_like(x)
    skew = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    half = np.sinc(size / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(size / np.pi) * skew + 0.5 * half**2 * skew @ skew)
