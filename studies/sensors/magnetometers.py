"""Magnetometers, by the field's known strength or beside a recorded attitude."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from sensors.motions import DENSE, Array, Rng, between, columns, throttle, turning, wander
from sensors.vectors import FIELD, of_known_length, of_pair, spread, unlike
from sensors.world import Record, World, by_axis, noisy, units_of


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


def _iron(rng: Rng) -> tuple[Array, Array]:
    """Answer (3, 3), lower triangular, and offset in µT of a magnetometer."""
    M = np.diag(1 + rng.uniform(-0.08, 0.08, 3))
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
        world = of_known_length(rng, model, t, x @ M.T + offset, plain, truth, ("offset",), sigma)
        change = M - alone
        pairs = [(1, 0), (2, 0), (2, 1)]  # a norm does not tell an entry from its mirror image
        shares = [of_pair(x, change, i, j) for i, j in pairs]
        return replace(world, shares=(*shares, *(unlike(x, np.diag(change)) if one else ())))

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
            return of_known_length(
                rng, "norm-triangular", t, clean, every, truth, both, sigma, more
            )

        return t, world

    return moved


def motor(rng: Rng, size: float) -> Record:
    """A drone's magnetometer, moved by `size` of the field at full current."""
    moved, way = _magnetometer(rng), spread(rng, 1)[0]

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
    moved, way = _magnetometer(rng), spread(rng, 1)[0]

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
