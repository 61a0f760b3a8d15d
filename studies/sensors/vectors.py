"""Three axes and a vector of known length: records, directions, parts of an answer."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sensors.motions import Array, Rng, columns
from sensors.world import World, noisy, units_of

GRAVITY, FIELD = 9.80665, 48.0


def of_known_length(
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


def of_pair(x: Array, change: Array, i: int, j: int) -> Array:
    """What two entries of a change (3, 3) of the answer to x do, mirrored at the diagonal."""
    only = np.zeros((3, 3))
    only[i, j], only[j, i] = change[i, j], change[j, i]
    return x @ only.T


def unlike(x: Array, change: Array) -> tuple[Array, Array]:
    """What gains that change (3,) do, in two parts: what is common to all is a gain's."""
    mean = change.mean()
    first, last = change[0] - mean, change[2] - mean
    return x * (np.array([first, -first, 0.0]) + mean), x * np.array([0.0, -last, last])


def spread(rng: Rng, n: int) -> Array:
    """Directions (n, 3) as even as a hand holds them: each the farthest of some at random."""
    found = [rng.standard_normal(3)]
    for _ in range(n - 1):
        tried = rng.standard_normal((12, 3))
        tried /= np.linalg.norm(tried, axis=1, keepdims=True)
        near = np.max(tried @ np.transpose([f / np.linalg.norm(f) for f in found]), axis=1)
        found.append(tried[np.argmin(near)])
    return np.array([f / np.linalg.norm(f) for f in found])
