"""Accelerometers and gyroscopes: in poses, beside a recorded force, at rest in a chamber."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sensors.motions import DENSE, Rng, between, chamber, columns, waves
from sensors.vectors import FIELD, GRAVITY, of_known_length, of_pair, spread, unlike
from sensors.world import Record, World, by_axis, noisy, units_of


def unlike_axes(rng: Rng, size: float) -> Record:
    """Three axes of gains that differ by `size`, declared as one; poses, or beside a reference."""
    gains = rng.uniform(0.97, 1.03) * (
        1 + size * rng.permutation([1.0, rng.uniform(-0.5, 0.5), -1.0])
    )
    offset, poses = rng.uniform(-0.5, 0.5, 3), rng.random() < 0.5
    mean, sigma = float(gains.mean()), between(rng, 0.005, 0.05)

    def held(rng: Rng) -> World:
        n = int(rng.integers(24, 60))
        t, x = 5.0 * np.arange(n), FIELD * spread(rng, n)
        plain = (mean * x + 20 * offset,)
        truth = {"gain": 1 / mean, "offset": 20 * offset}
        clean = gains * x + 20 * offset
        world = of_known_length(
            rng, "one_gain", t, clean, plain, truth, ("offset",), 2 * sigma, count=50
        )
        return replace(world, shares=unlike(x, gains - mean))

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
            every, units_of(every), shares=unlike(force, gains - mean),
        )  # fmt: skip

    return lambda rng, _: held(rng) if poses else shaken(rng)


def few_poses(rng: Rng, size: float) -> Record:
    """An accelerometer held in 18 to 36 positions whose axes are off the right angle by `size`."""
    M = np.diag(1 + rng.uniform(-0.03, 0.03, 3))
    alone, offset = M.copy(), rng.uniform(-0.5, 0.5, 3)
    M[1, 0], M[2, 0], M[2, 1] = size * rng.permutation([1.0, -0.6, 0.4])
    truth, sigma = {"scale": 1 / np.diag(alone), "offset": offset}, between(rng, 1e-3, 1e-2)

    def record(rng: Rng, _: bool) -> World:
        n = int(rng.integers(18, 37))
        t, x = 5.0 * np.arange(n), GRAVITY * spread(rng, n)
        clean, plain = x @ M.T + offset, (x @ alone.T + offset,)
        world = of_known_length(
            rng, "norm-diagonal", t, clean, plain, truth, ("offset",), sigma, None, 100, GRAVITY
        )
        pairs = [(1, 0), (2, 0), (2, 1)]
        return replace(world, shares=tuple(of_pair(x, M - alone, i, j) for i, j in pairs))

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
