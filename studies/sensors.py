"""Sensors with something that their declared model lacks, and pairs of records of them.

Plain NumPy and SciPy: nothing here knows casest or its catalogue. Where physics has more to it than
a formula of one term, so have these: creep is a stretched exponential or two time constants,
hysteresis is Bouc and Wen's or three plays, a lag is looked up in a dense simulation.

`made(kind, seed)` gives two records of one sensor, moved differently; where the effect happens but
once (a magnet, a field that sways) the second is without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from motions import (
    DENSE,
    Array,
    Rng,
    between,
    chamber,
    columns,
    cycles,
    staircase,
    throttle,
    turning,
    wander,
    waves,
)
from numpy.typing import NDArray
from scipy.signal import lfilter

GRAVITY, FIELD = 9.80665, 48.0
#: Names that say the same of these records: two series against each other in time. A lag of which
#: time constant is short against the motion is a delay, and a fast creep.
LATE = ("signal_lag", "low_pass", "time_delay", "axis_delay", "creep")


@dataclass(frozen=True)
class World:
    """A record and its truth.

    `read` names the signal that is the sensor's reading; `clean` is that reading without noise, and
    `plain` what it were without the effect (several where the model's zero is a convention: with
    no current, or with the mean one). `truth` has the declared parameters, `compared` names those
    that mean the same with the effect and without. `shares` add up to what the effect does;
    `block` numbers the stretch or the position of each row.
    """

    model: str
    read: str
    signals: Mapping[str, Array]
    units: Mapping[str, str]
    clean: Array
    plain: tuple[Array, ...]
    truth: Mapping[str, Array | float]
    compared: tuple[str, ...]
    sigma: float
    time: Array
    columns: Mapping[str, Array]
    column_units: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    count: int = 1
    shares: tuple[Array, ...] = ()
    block: NDArray[np.int_] | None = None

    @property
    def hidden(self) -> Array:
        """What the effect does to the reading, (N, k)."""
        return self.clean - self.plain[0]

    @property
    def parts(self) -> tuple[Array, ...]:
        """The same in parts of sizes that nobody would know beforehand, each (N, k)."""
        return self.shares or (self.hidden,)


Record = Callable[[Rng, bool], World]
Sensor = Callable[[Rng, float], Record]


def _noisy(rng: Rng, clean: Array, sigma: float) -> Array:
    """White noise; every fourth record's has heavier tails."""
    if rng.random() < 0.25:
        return clean + sigma * rng.standard_t(5, clean.shape) * np.sqrt(3 / 5)
    return clean + sigma * rng.standard_normal(clean.shape)


def _by_axis(hidden: Array) -> tuple[Array, ...]:
    """What happens to each axis, as a part of its own."""
    return tuple(hidden * (np.arange(hidden.shape[1]) == k) for k in range(hidden.shape[1]))


def _units_of(columns: Mapping[str, Array]) -> dict[str, str]:
    known = {"temperature": "degC", "supply": "V", "current": "A", "theta": "rad"}
    return {name: known[name] for name in columns}


# -- one reading beside a recorded input -----------------------------------------------------------


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
        model, read, {given: x[:, None], read: _noisy(rng, clean, sigma)[:, None]},
        {given: units[0], read: units[1]}, clean[:, None], tuple(p[:, None] for p in plain), truth,
        tuple(truth), sigma, t, every, _units_of(every),
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
    """Hysteretic part in [-1, 1]: radius dz = dx - 0.7 |dx| z|z| - 0.3 dx z², step by step."""
    z, found = 0.0, np.empty(len(x))
    found[0] = z
    for k, dx in enumerate(np.diff(x)):
        for _ in range(DENSE):
            step = dx / DENSE
            z += (step - 0.7 * abs(step) * z * abs(z) - 0.3 * step * z * z) / radius
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


# -- three axes ------------------------------------------------------------------------------------


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
        model, "v", {"v": _noisy(rng, clean, sigma)}, {"v": unit}, clean, plain, truth, compared,
        sigma, t, every, _units_of(every), known, count,
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
    signals = {"attitude": R.reshape(-1, 9), "m": _noisy(rng, clean, sigma)}
    return World(
        "compass", "m", signals, {"m": "uT"}, clean, plain, truth, ("earth", "hard"), sigma, t,
        every, _units_of(every),
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
        signals = {"force": force, "v": _noisy(rng, clean, sigma)}
        return World(
            "triad", "v", signals, dict.fromkeys(signals, "m/s^2"), clean,
            (mean * force + offset,), {"gain": mean, "offset": offset}, ("offset",), sigma, t,
            every, _units_of(every), shares=_unlike(force, gains - mean),
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
        return replace(made, shares=_by_axis(added))

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
        return replace(world(added), shares=_by_axis(added))

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

    def record(rng: Rng, _: bool) -> World:
        n, rate = int(rng.integers(600, 2500)), float(rng.choice([10.0, 25.0, 50.0]))
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
            "gyro_at_rest", "v", {"v": _noisy(rng, clean, sigma)}, {"v": "rad/s"}, clean,
            tuple(np.tile(bias + z, (n, 1)) for z in zeros), {"bias": bias}, ("bias",), sigma, t,
            every, _units_of(every), shares=_by_axis(added),
        )  # fmt: skip

    return record


# -- all of them -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """What makes it, its sizes from the least to the largest, and the names that are right."""

    sensor: Sensor
    sizes: tuple[float, float]
    right: tuple[str, ...]


#: Largest sizes are such that the best single term (one time constant, a sign, a cubic) leaves
#: less than 0.45 of the noise, which is 10 % of the error, in 88 to 100 of 100 visible worlds.
KINDS: dict[str, Kind] = {
    "load cell that creeps": Kind(creeping, (3e-4, 6e-3), ("creep",)),
    "load cell with hysteresis": Kind(cycled, (3e-5, 6e-4), ("hysteresis",)),
    "load cell that warms up": Kind(warming, (1e-4, 1e-2), ("warm_up",)),
    "gain by sign": Kind(one_sided, (2e-4, 3e-2), ("gain_by_sign",)),
    "late thermometer": Kind(late_thermometer, (0.05, 3.0), LATE),
    "gravity once per turn": Kind(turned_shaft, (1e-4, 1e-2), ("harmonic",)),
    "soft iron, one gain": Kind(
        partial(soft_iron, one=True), (1e-3, 0.1), ("soft_iron", "axis_gain", "cross_axis")
    ),
    "soft iron, gain per axis": Kind(
        partial(soft_iron, one=False), (1e-3, 0.1), ("soft_iron", "cross_axis")
    ),
    "gains unlike": Kind(unlike_axes, (1e-4, 3e-2), ("axis_gain", "soft_iron")),
    "few poses, skew": Kind(few_poses, (4e-4, 3e-2), ("cross_axis", "soft_iron")),
    "motor current": Kind(motor, (2e-3, 0.2), ("channel_bias(current)",)),
    "magnet comes and goes": Kind(magnet, (2e-3, 0.2), ("pulse",)),
    "field that sways": Kind(sway, (5e-4, 2e-2), ("reference_wander",)),
    "late attitude": Kind(late_attitude, (0.05, 5.0), LATE[:-1]),
    "bias bent by warmth": Kind(
        bent_by_warmth, (3e-4, 1e-2), ("temperature_curve", "temperature_bias")
    ),
}


def made(kind: str, seed: int, *, there: bool = True) -> tuple[World, World]:
    """Two records of one sensor; without the effect where it is not to be there."""
    chosen = KINDS[kind]
    rng = np.random.default_rng([seed, there, *kind.encode()])
    own, first, second = rng.spawn(3)
    size = between(rng, *chosen.sizes) if there else 0.0
    record = chosen.sensor(own, size)
    return record(first, True), record(second, False)
