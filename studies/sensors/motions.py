"""What a sensor is put through: loads, temperatures, attitudes, currents; drawn at random.

Plain NumPy and SciPy: nothing here knows casest.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Rng = np.random.Generator
Course = Callable[[Array], Array]
#: Points of a dense simulation for each sample.
DENSE = 20


def between(rng: Rng, low: float, high: float) -> float:
    """A size of unknown order: uniform in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def waves(rng: Rng, shortest: float, longest: float, count: int = 5) -> Course:
    """A smooth course of unit variance, which may be asked for at any time: sines of any phase.

    Periods in s.
    """
    periods = np.exp(rng.uniform(np.log(shortest), np.log(longest), count))
    phases, sizes = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.5, 1, count)
    sizes *= np.sqrt(2 / np.sum(sizes**2))
    return lambda t: np.sin(2 * np.pi * np.multiply.outer(t, 1 / periods) + phases) @ sizes


def turning(rng: Rng, pace: float = 1.0) -> Callable[[Array], Array]:
    """Rotations (n, 3, 3) of a body waved about all axes, body to reference, at any times.

    With a pace of 1 it turns by 1 rad/s or so.
    """
    start, rate = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1]) * rng.uniform(0.2, 0.5)
    yaw, pitch, roll = (waves(rng, 4 / pace, 15 / pace) for _ in range(3))

    def at(t: Array) -> Array:
        angles = [start + pace * rate * t + 0.6 * yaw(t), 0.7 * pitch(t), 1.5 * roll(t)]
        return np.asarray(Rotation.from_euler("ZYX", np.transpose(angles)).as_matrix())

    return at


def staircase(rng: Rng, t: Array, dwell: float, rise: float) -> Array:
    """Loads from 0 to 1 put on and taken off, each for `dwell` s or so; the first is none."""
    held = rng.uniform(0.4, 1.8, int(np.ptp(t) / dwell / 0.4) + 3) * dwell
    begin = np.cumsum(held)
    levels = rng.uniform(0, 1, len(begin) + 1)
    levels[0], levels[2::3] = 0.0, 0.0
    times = np.sort(np.concatenate([begin, begin + rise]))
    return np.interp(t, times, np.repeat(levels, 2)[1:-1])


def cycles(rng: Rng, t: Array, count: int) -> Array:
    """A load from 0 to 1 cycled up and down between ends that change, some near each other."""
    ends = rng.uniform(0, 0.35, 2 * count + 1)
    ends[1::2] = rng.uniform(0.5, 1, count)
    ends[0], ends[1] = 0.0, 1.0
    place = (t - t[0]) / np.ptp(t) * 2 * count
    k = np.minimum(place.astype(int), 2 * count - 1)
    return np.asarray(ends[k] + (ends[k + 1] - ends[k]) * (place - k))


def chamber(rng: Rng, n: int, step: float) -> Array:
    """Air of a climate chamber in K, DENSE points for each of n samples, `step` s apart.

    Settings are held for 40 to 150 samples; the air follows with ten samples, and breathes.
    """
    many = n * DENSE
    until = np.cumsum(rng.uniform(40, 150, n // 40 + 2)) * DENSE
    settings = rng.uniform(283, 323, len(until) + 1)[np.searchsorted(until, np.arange(many))]
    keep = np.exp(-1 / (10 * DENSE))
    air = lfilter([1 - keep], [1, -keep], settings, zi=[keep * settings[0]])[0]
    return np.asarray(air + 0.5 * waves(rng, 15 * step, 60 * step)(np.arange(many) * step / DENSE))


def throttle(rng: Rng, t: Array) -> Array:
    """Current of a drone's motors in A: idle, then commands that change at random, then idle.

    Current grows with the square of a command that the motors follow with 0.3 s.
    """
    n, step = len(t), float(t[1] - t[0])
    wanted = 0.6 + 0.12 * wander(rng, n, 1.5 / step)
    wanted += 0.1 * np.repeat(rng.standard_normal(n // 100 + 1), 100)[:n]
    wanted = np.clip(wanted, 0.25, 1.0)
    idle = (np.arange(n) < rng.uniform(0.05, 0.15) * n) | (np.arange(n) > 0.93 * n)
    wanted[idle] = 0.1
    keep = np.exp(-step / 0.3)
    turned = lfilter([1 - keep], [1, -keep], wanted, zi=[keep * wanted[0]])[0]
    return np.asarray(0.5 + 30 * turned**2 + 0.1 * rng.standard_normal(n))


def wander(rng: Rng, n: int, over: float) -> Array:
    """A slow random process of n samples, of no mean and unit variance; `over` samples long."""
    found = gaussian_filter1d(rng.standard_normal(n + int(8 * over)), over)[int(4 * over) :][:n]
    found -= found.mean()
    return np.asarray(found / found.std())


def columns(rng: Rng, t: Array) -> dict[str, Array]:
    """What else was recorded, and is no cause: a temperature that rises, a supply voltage."""
    place = (t - t[0]) / max(float(np.ptp(t)), 1e-9)
    warm = 22 + rng.uniform(2, 6) * (1 - np.exp(-place * rng.uniform(1, 4)))
    warm += 0.3 * waves(rng, np.ptp(t) / 6, np.ptp(t))(t)
    return {"temperature": warm, "supply": 3.3 + 0.01 * rng.standard_normal(len(t))}
