"""Sensors of three axes: by a known length, beside a recorded attitude or force, at rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from sensors.motions import (
    DENSE,
    Array,
    Rng,
    between,
    chamber,
    columns,
    throttle,
    turning,
    wander,
    waves,
)
from sensors.world import Record, World, by_axis, noisy, units_of

GRAVITY, FIELD = 9.80665, 48.0


def _norm(
    rng: Rng,
    model: str,
    t: Array,
    clean: Array,
    plain: tuple[Array, ...],
    truth: Mapping[str, Array | float],
    compared: tuple[str, ...],
    sigma: float,
    more: Mapping[str, Array] | None = None,
    count: int = 1,
    norm: float = FIELD,
) -> World:
    """A sensor of a vector of known length; `sigma` is that of the row, a mean of `count`."""
    every = {**columns(rng, t), **(more or {})}
    unit = "uT" if norm == FIELD else "m/s^2"
    known = {"field" if model == "one_gain" else "norm": norm}
    return World(
        model, "v", {"v": noisy(rng, clean, sigma)}, {"v": unit}, clean, plain, truth, compared,
        sigma, t, every, units_of(every), known, count,
    )  # fmt: skip


def _compass(
    rng: Rng,
    t: Array,
    R: Array,
    clean: Array,
    plain: tuple[Array, ...],
    truth: Mapping[str, Array],
    sigma: float,
    more: Mapping[str, Array] | None = None,
) -> World:
    """A magnetometer beside the attitude R (n, 3, 3) that was recorded."""
    every = {**columns(rng, t), **(more or {})}
    signals = {"attitude": R.reshape(-1, 9), "m": noisy(rng, clean, sigma)}
    return World(
        "compass", "m", signals, {"m": "uT"}, clean, plain, truth, ("earth", "hard"), sigma, t,
        every, units_of(every),
    )  # fmt: skip


def _iron(rng: Rng, *, skew: bool = True) -> tuple[Array, Array]:
    """Answer (3, 3), lower triangular, and offset in µT of a magnetometer."""
    M = np.diag(1 + rng.uniform(-0.08, 0.08, 3))
    if skew:
        M += np.tril(rng.uniform(-0.05, 0.05, (3, 3)), -1)
    return M, rng.uniform(-20, 20, 3)


def _earth(rng: Rng) -> Array:
    """The field in the reference frame, µT: it dips by 50 to 70 degrees."""
    dip, declination = np.radians(rng.uniform(50, 70)), rng.uniform(0, 2 * np.pi)
    level = np.cos(dip) * np.array([np.cos(declination), np.sin(declination), 0.0])
    return FIELD * (level + np.array([0, 0, np.sin(dip)]))


def _waved(rng: Rng, earth: Array) -> tuple[Array, Array, Array]:
    """Times, attitudes, and the field along the body's axes (n, 3), for half a minute or two."""
    n, rate = int(rng.integers(600, 2500)), float(rng.choice([20.0, 50.0]))
    t = np.arange(n) / rate
    R = turning(rng, 1.0 if n / rate > 40 else 1.6)(t)
    return t, R, np.einsum("nji,j->ni", R, earth)


def soft_iron(rng: Rng, size: float, *, one: bool) -> Record:
    """A magnetometer waved about beside iron: a symmetric answer, its axes unlike by `size`.

    Declared with one gain, or with one for each axis.
    """
    earth, sigma, offset = _earth(rng), between(rng, 0.1, 0.8), rng.uniform(-20, 20, 3)
    axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    long = np.array([1.0, rng.uniform(-0.5, 0.5), -1.0]) * size
    iron = np.eye(3) + axes @ np.diag(long) @ axes.T
    gains = np.full(3, rng.uniform(0.9, 1.1)) if one else 1 + rng.uniform(-0.08, 0.08, 3)
    M = iron * gains[:, None]
    alone = np.diag(gains if one else np.diag(M))
    truth = {"offset": offset} | ({"gain": 1 / gains[0]} if one else {"scale": 1 / np.diag(alone)})

    def record(rng: Rng, _: bool) -> World:
        t, _R, x = _waved(rng, earth)
        plain = (x @ alone.T + offset,)
        model = "one_gain" if one else "norm-diagonal"
        world = _norm(rng, model, t, x @ M.T + offset, plain, truth, ("offset",), sigma)
        change = M - alone
        pairs = [(1, 0), (2, 0), (2, 1)]  # a norm does not tell an entry from its mirror image
        shares = [_of_pair(x, change, i, j) for i, j in pairs]
        return replace(world, shares=(*shares, *(_unlike(x, np.diag(change)) if one else ())))

    return record


def unlike_axes(rng: Rng, size: float) -> Record:
    """Three axes of gains that differ by `size`, declared as one; poses, or beside a reference."""
    gains = rng.uniform(0.97, 1.03) * (
        1 + size * rng.permutation([1.0, rng.uniform(-0.5, 0.5), -1.0])
    )
    offset, poses = rng.uniform(-0.5, 0.5, 3), rng.random() < 0.5
    mean, sigma = float(gains.mean()), between(rng, 0.005, 0.05)

    def held(rng: Rng) -> World:
        n = int(rng.integers(24, 60))
        t, x = 5.0 * np.arange(n), FIELD * _spread(rng, n)
        plain = (mean * x + 20 * offset,)
        truth = {"gain": 1 / mean, "offset": 20 * offset}
        clean = gains * x + 20 * offset
        world = _norm(rng, "one_gain", t, clean, plain, truth, ("offset",), 2 * sigma, count=50)
        return replace(world, shares=_unlike(x, gains - mean))

    def shaken(rng: Rng) -> World:
        n = int(rng.integers(300, 2000))
        t = 0.02 * np.arange(n)
        force = 6 * np.column_stack([waves(rng, 0.7, 10)(t) for _ in range(3)]) + [0, 0, GRAVITY]
        every = columns(rng, t)
        clean = gains * force + offset
        signals = {"force": force, "v": noisy(rng, clean, sigma)}
        return World(
            "triad", "v", signals, dict.fromkeys(signals, "m/s^2"), clean,
            (mean * force + offset,), {"gain": mean, "offset": offset}, ("offset",), sigma, t,
            every, units_of(every), shares=_unlike(force, gains - mean),
        )  # fmt: skip

    return lambda rng, _: held(rng) if poses else shaken(rng)


def _of_pair(x: Array, change: Array, i: int, j: int) -> Array:
    """What two entries of a change (3, 3) of the answer to x do, mirrored at the diagonal."""
    only = np.zeros((3, 3))
    only[i, j], only[j, i] = change[i, j], change[j, i]
    return x @ only.T


def _unlike(x: Array, change: Array) -> tuple[Array, Array]:
    """What gains that change (3,) do, in two parts: what is common to all is a gain's."""
    mean = change.mean()
    first, last = change[0] - mean, change[2] - mean
    return x * (np.array([first, -first, 0.0]) + mean), x * np.array([0.0, -last, last])


def _spread(rng: Rng, n: int) -> Array:
    """Directions (n, 3) as even as a hand holds them: each the farthest of some at random."""
    found = [rng.standard_normal(3)]
    for _ in range(n - 1):
        tried = rng.standard_normal((12, 3))
        tried /= np.linalg.norm(tried, axis=1, keepdims=True)
        near = np.max(tried @ np.transpose([f / np.linalg.norm(f) for f in found]), axis=1)
        found.append(tried[np.argmin(near)])
    return np.array([f / np.linalg.norm(f) for f in found])


def few_poses(rng: Rng, size: float) -> Record:
    """An accelerometer held in 18 to 36 positions whose axes are off the right angle by `size`."""
    M = np.diag(1 + rng.uniform(-0.03, 0.03, 3))
    alone, offset = M.copy(), rng.uniform(-0.5, 0.5, 3)
    M[1, 0], M[2, 0], M[2, 1] = size * rng.permutation([1.0, -0.6, 0.4])
    truth, sigma = {"scale": 1 / np.diag(alone), "offset": offset}, between(rng, 1e-3, 1e-2)

    def record(rng: Rng, _: bool) -> World:
        n = int(rng.integers(18, 37))
        t, x = 5.0 * np.arange(n), GRAVITY * _spread(rng, n)
        clean, plain = x @ M.T + offset, (x @ alone.T + offset,)
        world = _norm(
            rng, "norm-diagonal", t, clean, plain, truth, ("offset",), sigma, None, 100, GRAVITY
        )
        pairs = [(1, 0), (2, 0), (2, 1)]
        return replace(world, shares=tuple(_of_pair(x, M - alone, i, j) for i, j in pairs))

    return record


def _magnetometer(rng: Rng) -> Callable[[Rng], tuple[Array, Callable[..., World]]]:
    """A magnetometer by its norm or beside its attitude: times, and what makes it a world.

    The second takes what is added to the plain reading, by which the field is larger (n,), and
    other zeros (n, 3) that are right as well.
    """
    earth, sigma, beside = _earth(rng), between(rng, 0.1, 0.8), rng.random() < 0.5
    M, offset = _iron(rng)

    def moved(rng: Rng) -> tuple[Array, Callable[..., World]]:
        t, R, x = _waved(rng, earth)
        answer = np.eye(3) if beside else M

        def world(
            added: Array | float = 0.0, larger: Array | float = 0.0, zeros: tuple[Array, ...] = (),
            more: Mapping[str, Array] | None = None,
        ) -> World:  # fmt: skip
            plain = x @ answer.T + offset
            clean = (x * (1 + np.reshape(larger, (-1, 1)))) @ answer.T + offset + added
            every = (plain, *(plain + z for z in zeros))
            if beside:
                truth = {"earth": earth, "hard": offset}
                return _compass(rng, t, R, clean, every, truth, sigma, more)
            truth = {"scale": np.linalg.inv(M), "offset": offset}
            both = ("scale", "offset")
            return _norm(rng, "norm-triangular", t, clean, every, truth, both, sigma, more)

        return t, world

    return moved


def motor(rng: Rng, size: float) -> Record:
    """A drone's magnetometer, moved by `size` of the field at full current."""
    moved, way = _magnetometer(rng), _spread(rng, 1)[0]

    def record(rng: Rng, _: bool) -> World:
        t, world = moved(rng)
        current = throttle(rng, t)
        pull = size * FIELD / 30 * way
        added = np.outer(current, pull)
        made = world(added, zeros=(current.mean() * pull,), more={"current": current})
        return replace(made, shares=by_axis(added))

    return record


def magnet(rng: Rng, size: float) -> Record:
    """A magnet fixed to the body for a while: it comes and goes, within half a second each."""
    moved, way = _magnetometer(rng), _spread(rng, 1)[0]

    def record(rng: Rng, first: bool) -> World:
        t, world = moved(rng)
        end, rise = float(t[-1]), rng.uniform(0.02, 0.5)
        begin, lasts = rng.uniform(0.15, 0.6) * end, rng.uniform(0.08, 0.25) * end
        there = np.clip((t - begin) / rise, 0, 1) - np.clip((t - begin - lasts) / rise, 0, 1)
        added = first * size * FIELD * np.outer(there, way)
        return replace(world(added), shares=by_axis(added))

    return record


def sway(rng: Rng, size: float) -> Record:
    """A field whose strength sways by `size`, slowly and at random."""
    moved = _magnetometer(rng)

    def record(rng: Rng, first: bool) -> World:
        t, world = moved(rng)
        slow = wander(rng, len(t), len(t) / rng.uniform(15, 50))
        return world(larger=first * size * slow)

    return record


def late_attitude(rng: Rng, size: float) -> Record:
    """A robot whose recorded attitude is `size` samples old."""
    earth, sigma, hard = _earth(rng), between(rng, 0.1, 0.8), rng.uniform(-20, 20, 3)
    rate = float(rng.choice([10.0, 25.0, 50.0]))

    def record(rng: Rng, _: bool) -> World:
        n = int(rng.integers(600, 2500))
        dense = turning(rng, rng.uniform(0.7, 1.5))(np.arange((n + 10) * DENSE) / rate / DENSE)
        now = 10 * DENSE + DENSE * np.arange(n)
        true, recorded = dense[now], dense[now - round(size * DENSE)]
        clean, plain = (np.einsum("nji,j->ni", R, earth) + hard for R in (true, recorded))
        truth = {"earth": earth, "hard": hard}
        return _compass(rng, np.arange(n) / rate, recorded, clean, (plain,), truth, sigma)

    return record


def bent_by_warmth(rng: Rng, size: float) -> Record:
    """A gyroscope at rest in a chamber; its bias follows the temperature, bent, by `size` rad/s."""
    bias, each = rng.uniform(-0.05, 0.05, 3), rng.permutation([1.0, -0.7, 0.2])
    best, sigma = rng.uniform(290, 310), between(rng, 5e-4, 3e-3)

    def record(rng: Rng, _: bool) -> World:
        n = int(rng.integers(400, 2000))
        t, warm = 1.0 * np.arange(n), chamber(rng, n, 1.0)[::DENSE]
        shape = 2 * np.cosh((warm - best) / 25) - 2
        added = np.outer(size * shape, each)
        clean = bias + added
        middle = 2 * np.cosh((warm.mean() - best) / 25) - 2
        zeros = (0.0, added.mean(axis=0), size * middle * each)
        every = {**columns(rng, t), "temperature": warm - 273.15}
        return World(
            "gyro_at_rest", "v", {"v": noisy(rng, clean, sigma)}, {"v": "rad/s"}, clean,
            tuple(np.tile(bias + z, (n, 1)) for z in zeros), {"bias": bias}, ("bias",), sigma, t,
            every, units_of(every), shares=by_axis(added),
        )  # fmt: skip

    return record
