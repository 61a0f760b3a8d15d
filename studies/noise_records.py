"""Records with nothing but noise, of ten kinds, on five models. Plain NumPy and SciPy."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import butter, lfilter

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "studies"), str(ROOT / "tests")]

import worlds  # noqa: E402
from sensors.motions import Array, Rng, between, columns, staircase, turning, waves  # noqa: E402
from sensors.vectors import FIELD, GRAVITY  # noqa: E402
from sensors.world import World  # noqa: E402

# -- records without noise: what is read is the clean reading --------------------------------------


def _bare(model: str, read: str, signals: Any, units: Any, sigma: float, t: Array, rng: Rng,
          **more: Any) -> World:  # fmt: skip
    clean = signals[read]
    every = more.pop("columns", None) or columns(rng, t)
    known = {"temperature": "degC", "supply": "V"}
    column_units = {name: known.get(name, "") for name in every}
    return World(
        model, read, signals, units, clean, (clean,), {}, (), sigma, t, every, column_units, **more
    )


def waved(rng: Rng) -> World:
    """norm-diagonal: a magnetometer turned about all axes."""
    n = int(rng.integers(800, 2500))
    t = np.arange(n) / 30.0
    dip = np.radians(rng.uniform(50, 70))
    earth = FIELD * np.array([np.cos(dip), 0, np.sin(dip)])
    x = np.einsum("nji,j->ni", turning(rng)(t), earth)
    v = x * (1 + rng.uniform(-0.08, 0.08, 3)) + rng.uniform(-20, 20, 3)
    more = {"constants": {"norm": FIELD}}
    return _bare("norm-diagonal", "v", {"v": v}, {"v": "uT"}, 0.3, t, rng, **more)


def posed(rng: Rng) -> World:
    """norm-diagonal: an accelerometer in 30 poses or so, ten readings in each."""
    poses = int(rng.integers(24, 48))
    directions = rng.standard_normal((poses, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x = GRAVITY * np.repeat(directions, 10, axis=0)
    v = x * (1 + rng.uniform(-0.03, 0.03, 3)) + rng.uniform(-0.5, 0.5, 3)
    t = np.repeat(6.0 * np.arange(poses), 10) + np.tile(0.1 * np.arange(10), poses)
    more = {"constants": {"norm": GRAVITY}, "block": np.repeat(np.arange(poses), 10)}
    return _bare("norm-diagonal", "v", {"v": v}, {"v": "m/s^2"}, 0.02, t, rng, **more)


def _of_tests(place: str, rng: Rng, **options: Any) -> World:
    """A wheel or a rate table of the tests, before its noise."""
    made = worlds.made(place, [int(rng.integers(1 << 31))], {}, **options)
    signals = {**made.signals, made.read: made.clean}
    more = {"columns": dict(made.columns), "block": made.block}
    assert made.time is not None
    return _bare(
        made.model, made.read, signals, dict(made.units), made.sigma, made.time, rng, **more
    )


def wheel(rng: Rng) -> World:
    """wheel: 20 s at 100 Hz."""
    return _of_tests("wheel", rng, seconds=20.0)


def table(rng: Rng) -> World:
    """rate-table: 40 attitudes, ten readings in each."""
    return _of_tests("table", rng)


def loaded(rng: Rng) -> World:
    """A load cell of a user's own beside a recorded load that moves, or is held in steps."""
    n = int(rng.integers(500, 2500))
    t = 0.5 * np.arange(n)
    moving = 0.5 + 0.25 * waves(rng, 5, 60)(t)
    share = moving if rng.random() < 0.5 else staircase(rng, t, 40.0, 1.0)
    force = 500 * share[:, None]
    signals = {"force": force, "reading": 0.02 + 0.004 * force}
    return _bare("load_cell", "reading", signals, {"force": "N", "reading": "mV"}, 1e-3, t, rng)


MODELS: dict[str, Callable[[Rng], World]] = {
    "norm-diagonal, waved": waved,
    "norm-diagonal, poses": posed,
    "wheel": wheel,
    "rate-table": table,
    "load cell": loaded,
}
POSES, MOVING = (
    ("norm-diagonal, poses", "rate-table"),
    ("norm-diagonal, waved", "wheel", "load cell"),
)


# -- noise of unit variance or so, (n, m) ----------------------------------------------------------


def pink(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """Power falls as one over the frequency."""
    n = shape[0]
    frequency = np.maximum(np.fft.rfftfreq(n), 1 / n)[:, None]
    found = np.fft.irfft(np.fft.rfft(rng.standard_normal(shape), axis=0) / np.sqrt(frequency), n, 0)
    return np.asarray(found / found.std())


def telegraph(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """Each axis jumps between two levels at random times; white noise beside."""
    often = 1 / between(rng, 15, shape[0] / 10)
    flips = np.cumsum(rng.random(shape) < often, axis=0) + rng.integers(0, 2, shape[1])
    return 0.8 * (-1.0) ** flips + 0.6 * rng.standard_normal(shape)


def filtered(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """Through a second-order low pass at a tenth to a third of half the rate."""
    b, a = butter(2, rng.uniform(0.1, 0.33))
    found = lfilter(b, a, rng.standard_normal((shape[0] + 200, shape[1])), axis=0)[200:]
    return np.asarray(found / found.std())


def white(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """White."""
    return rng.standard_normal(shape)


def bursts(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """White, five times larger in a few short stretches."""
    found = rng.standard_normal(shape)
    for first in rng.integers(0, shape[0], int(rng.integers(2, 7))):
        found[first : first + shape[0] // 30] *= 5
    return found


def heavy(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """Student's t of three degrees of freedom."""
    return rng.standard_t(3, shape) / np.sqrt(3)


def with_speed(rng: Rng, shape: tuple[int, int], world: World) -> Array:
    """White, larger the faster the reading changes: up to some four times."""
    speed = np.linalg.norm(np.gradient(world.clean, world.time, axis=0), axis=1, keepdims=True)
    return rng.standard_normal(shape) * (0.3 + speed / np.sqrt(np.mean(speed**2)))


def seating(rng: Rng, shape: tuple[int, int], world: World) -> Array:
    """Each pose is off by one draw, larger than the scatter within it."""
    assert world.block is not None
    each = rng.standard_normal((int(world.block.max()) + 1, shape[1]))
    return each[world.block] + 0.3 * rng.standard_normal(shape)


def repeated(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """A slow sensor logged faster: its noise is held, or is a line from one sample to the next."""
    every, n = int(rng.integers(2, 6)), shape[0]
    few = rng.standard_normal((n // every + 2, shape[1]))
    if rng.random() < 0.5:
        return np.repeat(few, every, axis=0)[:n]
    place = np.arange(n) / every
    return np.column_stack([np.interp(place, np.arange(len(few)), f) for f in few.T])


Noise = Callable[[Rng, tuple[int, int], World], Array]
#: What the noise is, and on which models it can be.
NOISES: dict[str, tuple[Noise, tuple[str, ...]]] = {
    "pink": (pink, tuple(MODELS)),
    "random telegraph": (telegraph, tuple(MODELS)),
    "low-pass filtered": (filtered, tuple(MODELS)),
    "quantised to three levels": (white, tuple(MODELS)),
    "bursts": (bursts, tuple(MODELS)),
    "heavy tails (t3)": (heavy, tuple(MODELS)),
    "variance grows with speed": (with_speed, MOVING),
    "seating errors per pose": (seating, POSES),
    "held and interpolated samples": (repeated, MOVING),
    "missing blocks": (white, tuple(MODELS)),
}


def record_of(kind: str, seed: int) -> tuple[str, World]:
    """A record of one noise, and the name of what it is a record of; each model in its turn."""
    noise, places = NOISES[kind]
    place = places[seed % len(places)]
    rng = np.random.default_rng([seed, *kind.encode()])
    world = MODELS[place](rng)
    v = world.clean + world.sigma * noise(rng, world.clean.shape, world)
    if kind.startswith("quantised"):  # at rest three steps are seen, or four
        step = 2.5 * world.sigma
        v = step * np.round((world.clean + 0.35 * step * (v - world.clean) / world.sigma) / step)
    world = replace(world, signals={**world.signals, world.read: v})
    return place, _with_gaps(rng, world) if kind == "missing blocks" else world


def _with_gaps(rng: Rng, world: World) -> World:
    """A quarter of the record is gone, in a few pieces; each begins a new stretch."""
    n = len(world.time)
    kept = np.ones(n, bool)
    for first in rng.integers(0, n, 5):
        kept[first : first + n // 20] = False
    before = np.zeros(n, np.int_) if world.block is None else world.block
    gaps = np.cumsum(np.diff(kept.astype(int), prepend=int(kept[0])) > 0)
    _, block = np.unique(before[kept] * (n + 1) + gaps[kept], return_inverse=True)
    return replace(
        world,
        signals={name: values[kept] for name, values in world.signals.items()},
        columns={name: values[kept] for name, values in world.columns.items()},
        time=world.time[kept],
        clean=world.clean[kept],
        block=block.astype(np.int_),
    )
