"""Sensors of one reading beside a recorded input: load cells, thermometers, a torque meter."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.signal import lfilter

from sensors.motions import (
    DENSE,
    Array,
    Rng,
    between,
    chamber,
    columns,
    cycles,
    staircase,
    waves,
)
from sensors.world import Record, World, noisy, units_of


def _linear(
    rng: Rng,
    names: tuple[str, str, str],
    units: tuple[str, str],
    truth: Mapping[str, float],
    t: Array,
    x: Array,
    clean: Array,
    plain: tuple[Array, ...],
    sigma: float,
    more: Mapping[str, Array] | None = None,
) -> World:
    """Names of model, input and reading; units of both; the record."""
    model, given, read = names
    every = {**columns(rng, t), **(more or {})}
    return World(
        model, read, {given: x[:, None], read: noisy(rng, clean, sigma)[:, None]},
        {given: units[0], read: units[1]}, clean[:, None], tuple(p[:, None] for p in plain), truth,
        tuple(truth), sigma, t, every, units_of(every),
    )  # fmt: skip


def _cell(rng: Rng) -> tuple[float, dict[str, float], float]:
    """Full scale in N, truth, noise in mV: 2 mV at full scale, 0.01 to 0.1 % of it noise."""
    full = between(rng, 100, 2000)
    truth = {"zero": rng.uniform(-0.05, 0.05), "sensitivity": 2.0 / full * rng.uniform(0.95, 1.05)}
    return full, truth, 2.0 * between(rng, 1e-4, 1e-3)


LOAD = (("load_cell", "force", "reading"), ("N", "mV"))


def relaxed(increments: Array, t: Array, answer: Callable[[Array], Array]) -> Array:
    """What increments of a load have added up to, each by its `answer` to the time since then."""
    found, on = np.zeros(len(t)), np.flatnonzero(increments)
    for k in on:
        found[k:] += increments[k] * answer(t[k:] - t[k])
    return found


def creeping(rng: Rng, size: float) -> Record:
    """A load cell that goes on yielding: by `size` of the load, in minutes."""
    full, truth, sigma = _cell(rng)
    slow = between(rng, 20, 150)
    if rng.random() < 0.5:
        bent = rng.uniform(0.75, 0.95)
        answer = lambda s: 1 - np.exp(-((s / slow) ** bent))  # noqa: E731
    else:
        share = rng.uniform(0.3, 0.7)
        answer = lambda s: 1 - share * np.exp(-s / slow) - (1 - share) * np.exp(-3 * s / slow)  # noqa: E731

    def record(rng: Rng, _: bool) -> World:
        n = int(rng.integers(500, 2000))
        t = 1.0 * np.arange(n)
        force = full * staircase(rng, t, rng.uniform(40, 150), 2.0)
        late = relaxed(np.diff(force, prepend=0.0), t, answer)
        at_once = truth["zero"] + truth["sensitivity"] * force
        clean = at_once + truth["sensitivity"] * size * late
        settled = truth["zero"] + truth["sensitivity"] * (1 + size) * force
        return _linear(rng, *LOAD, truth, t, force, clean, (at_once, settled), sigma)

    return record


def bouc_wen(x: Array, radius: float) -> Array:
    """Hysteretic part in [-1, 1]: radius dz = dx - 0.7 |dx| z|z| - 0.3 dx z², in small steps."""
    z, found = 0.0, np.zeros(len(x))
    for k, dx in enumerate(np.diff(x) / radius):
        steps = int(np.ceil(DENSE * abs(dx))) or 1
        for step in np.full(steps, dx / steps):
            z += step - 0.7 * abs(step) * z * abs(z) - 0.3 * step * z * z
        found[k + 1] = z
    return found


def plays(x: Array, radius: float) -> Array:
    """Hysteretic part in [-1, 1]: the mean of three plays, each behind the input by its radius."""
    found = np.zeros(len(x))
    for r in radius * np.array([0.5, 1.0, 1.5]):
        y = x[0]
        for k, now in enumerate(x):
            y = min(max(y, now - r), now + r)
            found[k] += (now - y) / r / 3
    return found


def cycled(rng: Rng, size: float) -> Record:
    """A load cell whose readings up and down differ by twice `size` of full scale."""
    full, truth, sigma = _cell(rng)
    radius = full * between(rng, 0.001, 0.01)
    loop = bouc_wen if rng.random() < 0.5 else plays

    def record(rng: Rng, _: bool) -> World:
        n = int(rng.integers(400, 2000))
        t = 0.5 * np.arange(n)
        force = full * cycles(rng, t, int(rng.integers(3, 9)))
        plain = truth["zero"] + truth["sensitivity"] * force
        clean = plain - size * 2.0 * loop(force, radius)
        return _linear(rng, *LOAD, truth, t, force, clean, (plain,), sigma)

    return record


def one_sided(rng: Rng, size: float) -> Record:
    """A force link that answers more to a pull than to a push, by `size`."""
    full, truth, sigma = _cell(rng)
    truth["zero"] = 0.0 if rng.random() < 0.5 else truth["zero"]

    def record(rng: Rng, _: bool) -> World:
        n = int(rng.integers(150, 1500))
        t = 0.1 * np.arange(n)
        force = full * 0.5 * waves(rng, 5, n * 0.05)(t)
        even = truth["zero"] + truth["sensitivity"] * force
        clean = even + truth["sensitivity"] * size * np.where(force > 0, force, 0.0)
        push, pull = even, truth["zero"] + truth["sensitivity"] * (1 + size) * force
        middle = truth["zero"] + truth["sensitivity"] * (1 + size / 2) * force
        return _linear(rng, *LOAD, truth, t, force, clean, (push, pull, middle), sigma)

    return record


def warming(rng: Rng, size: float) -> Record:
    """A load cell whose zero settles by `size` of full scale after it is switched on."""
    full, truth, sigma = _cell(rng)
    slow, share = rng.uniform(60, 200), rng.uniform(0.6, 0.9)

    def record(rng: Rng, _: bool) -> World:
        n = int(rng.integers(600, 2000))
        t = 1.0 * np.arange(n)
        force = full * np.abs(waves(rng, 20, 150)(t)) * 0.4
        cold = truth["zero"] + truth["sensitivity"] * force
        rest = share * np.exp(-t / slow) + (1 - share) * np.exp(-4 * t / slow)
        clean = cold + 2.0 * size * (1 - rest)
        return _linear(rng, *LOAD, truth, t, force, clean, (cold, cold + 2.0 * size), sigma)

    return record


def late_thermometer(rng: Rng, size: float) -> Record:
    """A thermometer whose element follows the air by `size` samples, its sheath by a tenth."""
    step, warm = float(rng.choice([1.0, 2.0, 5.0])), between(rng, 0.05, 0.5)
    bead = rng.random() < 0.5
    if bead:
        truth = {"r25": 10_000 * rng.uniform(0.95, 1.05), "beta": rng.uniform(3300, 4000)}
        sigma = warm * 10_000 * 3600 / 300**2
    else:
        truth = {"zero": rng.uniform(111.0, 112.0), "slope": rng.uniform(0.38, 0.39)}
        sigma = warm * 0.385

    def read(kelvin: Array) -> Array:
        if bead:
            return truth["r25"] * np.exp(truth["beta"] * (1 / kelvin - 1 / 298.15))
        return truth["zero"] + truth["slope"] * (kelvin - 300)

    def record(rng: Rng, _: bool) -> World:
        n = int(rng.integers(400, 2500))
        air = chamber(rng, n, step)
        felt = lagged(lagged(air, size / 10), size)
        names = ("thermistor" if bead else "platinum", "reference", "resistance")
        given, clean = air[::DENSE], read(felt[::DENSE])
        t = step * np.arange(n)
        return _linear(rng, names, ("K", "ohm"), truth, t, given, clean, (read(given),), sigma)

    return record


def lagged(dense: Array, samples: float) -> Array:
    """A first-order answer with that time constant, DENSE points a sample, settled at first."""
    if not samples:
        return dense
    keep = np.exp(-1 / (samples * DENSE))
    return np.asarray(lfilter([1 - keep], [1, -keep], dense, zi=[keep * dense[0]])[0])


def turned_shaft(rng: Rng, size: float) -> Record:
    """A torque meter that feels gravity once per turn of its shaft, by `size` of full scale."""
    full = between(rng, 5, 200)
    truth = {"zero": rng.uniform(-0.05, 0.05), "gain": 2.0 / full * rng.uniform(0.95, 1.05)}
    sigma, place = 2.0 * between(rng, 3e-4, 3e-3), rng.uniform(0, 2 * np.pi)

    def record(rng: Rng, _: bool) -> World:
        n = int(rng.integers(400, 2500))
        t = 0.05 * np.arange(n)
        rate = rng.uniform(1, 6) * (1 + 0.3 * waves(rng, 10, 60)(t))
        theta = rng.uniform(0, 6) + np.cumsum(rate) * 0.05
        torque = full * (0.5 + 0.2 * waves(rng, 3, 30)(t))
        plain = truth["zero"] + truth["gain"] * torque
        clean = plain + 2.0 * size * np.cos(theta + place)
        names, units = ("torque_meter", "torque", "reading"), ("N*m", "mV")
        more = {"theta": theta}
        return _linear(rng, names, units, truth, t, torque, clean, (plain,), sigma, more)

    return record
