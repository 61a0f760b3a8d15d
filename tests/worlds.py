"""Worlds with something missing from the model: records whose every cause is known.

Plain NumPy and SciPy on the simulators: nothing here knows casest or its catalogue. What bends a
reading is written as what happens to a sensor (a time looked at later, a filter run over a fine
grid, a reading cut off), not as a term that a fit could add.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import simulators as sim
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

Array = sim.Array
#: How much of an effect each axis has: never alike, one of them almost nothing.
SHARES = np.array([1.0, -0.7, 0.15])
#: What hides between the turn of a wheel and its accelerometer's axes, in degrees.
MOUNTING = (30.0, 20.0, 25.0)


@dataclass(frozen=True)
class World:
    """A record and its truth.

    signals and columns as they are recorded; `clean` the readings without noise (what the signal
    named `read` would be), `truth` the declared parameters. `count` and `spread` where each row is
    the mean of a rest; `block` the position of each row.
    """

    model: str
    read: str
    signals: Mapping[str, Array]
    clean: Array
    truth: Mapping[str, Array]
    sigma: float
    time: Array | None
    block: Array
    columns: Mapping[str, Array] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    count: int = 1


@dataclass(frozen=True)
class Scene:
    """What an effect may look at: time, columns, and the wheel's angle where there is one."""

    t: Array
    columns: Mapping[str, Array]
    angle: Array | None = None


# -- noise -----------------------------------------------------------------------------------------

NOISES = ("white", "ar1", "student", "outliers", "quantised", "unequal", "columns")


def noise(kind: str, sigma: float, block: Array, rng: np.random.Generator) -> Array:
    """Noise of standard deviation sigma, (n, 3); `unequal` and `outliers` have more in places.

    `ar1` begins anew at every position; `quantised` and `columns` are white (see `quantised`).
    """
    n = len(block)
    white = rng.standard_normal((n, 3))
    if kind == "ar1":
        white = np.vstack([_ar1(white[block == b], 0.6) for b in np.unique(block)])
    elif kind == "student":
        white = rng.standard_t(4, (n, 3)) / np.sqrt(2)
    elif kind == "outliers":
        hit = rng.random((n, 3)) < 0.005
        far = rng.uniform(10, 20, (n, 3)) * rng.choice([-1, 1], (n, 3))
        white = np.where(hit, far, white)
    elif kind == "unequal":
        white = white * _unequal(block, rng)[:, None]
    return np.asarray(sigma * white)


def _ar1(white: Array, rho: float) -> Array:
    """Stationary, of unit variance."""
    driven = white * np.sqrt(1 - rho**2)
    driven[0] = white[0]
    return np.asarray(lfilter([1], [1, -rho], driven, axis=0))


def _unequal(block: Array, rng: np.random.Generator) -> Array:
    """A table that shakes at a third of its positions; a record of one block, in a third of it."""
    place = block - block.min()
    if place.max() < 3:
        place = np.arange(len(block)) * 30 // len(block)
    shaken = rng.random(int(place.max()) + 1) < 1 / 3
    return np.where(shaken, rng.uniform(2, 5, len(shaken)), 1.0)[place]


def temperature(t: Array, rng: np.random.Generator) -> Array:
    """Degrees: warming up, with the air conditioning going on and off, and a random walk."""
    end = max(float(t[-1]), 1.0)
    cycle = 1.5 * np.sin(2 * np.pi * (t / end * rng.uniform(2, 4) + rng.random()))
    return np.asarray(24 + 4 * (1 - np.exp(-3 * t / end)) + cycle + random_walk(t, 0.5, rng))


def random_walk(t: Array, size: float, rng: np.random.Generator) -> Array:
    """Reaching `size` or so at the end."""
    steps = rng.standard_normal(len(t)) * np.sqrt(np.diff(t, prepend=t[0]) / max(np.ptp(t), 1e-9))
    return np.asarray(size * np.cumsum(steps))


def columns_of(t: Array, kind: str, rng: np.random.Generator) -> dict[str, Array]:
    """Temperature and supply voltage; with `columns` also two that are nothing but numbers."""
    found = {"temperature": temperature(t, rng), "supply": 3.3 + random_walk(t, 0.02, rng)}
    if kind == "columns":
        found["pressure"] = 1013 + random_walk(t, 0.3, rng)
        found["hall"] = rng.standard_normal(len(t))
    return found


# -- what may be missing, on the force that the sensor feels and on its reading --------------------

Bend = Callable[[Array, float, Scene], Array]


def _limited(y: Array, size: float, _: Scene) -> Array:
    """Cut off at a level that the largest `size` of the range reaches."""
    level = np.abs(y).max() * (1 - size)
    return np.clip(y, -level, level)


def _lagging(y: Array, size: float, _: Scene) -> Array:
    """Half the gap of a hysteresis: behind the last movement, whichever way it went."""
    moved = np.sign(np.gradient(y, axis=0))
    return y - size * SHARES * moved


def _crossed(f: Array, size: float, _: Scene) -> Array:
    x, y, z = f.T
    return np.column_stack([x, y + size * x, z - 0.6 * size * x + 0.4 * size * y])


def _products(f: Array, size: float, _: Scene) -> Array:
    x, y, z = f.T
    return f + size * SHARES * np.column_stack([y * z, x * z, x * y])


#: Effects on the force along the sensor's axes.
ON_FORCE: dict[str, Bend] = {
    "quadratic": lambda f, s, _: f + s * SHARES * f * f,
    "signed_quadratic": lambda f, s, _: f + s * SHARES * np.copysign(f * f, f),
    "cubic": lambda f, s, _: f + s * SHARES * f * f * f,
    "signed_cubic": lambda f, s, _: f + s * SHARES * np.abs(f * f * f),
    "cross_quadratic": _products,
    "cross_axis": _crossed,
    "temperature_gain": lambda f, s, w: (
        f + s * SHARES * f * _off(w.columns["temperature"])[:, None]
    ),
    "channel_gain": lambda f, s, w: f + s * SHARES * f * _off(w.columns["supply"])[:, None],
    "reference_drift": lambda f, s, w: f * (1 + s * w.t[:, None]),
}
#: Effects on the reading.
ON_READING: dict[str, Bend] = {
    "bias_drift": lambda y, s, w: y + s * SHARES * w.t[:, None],
    "bias_step": lambda y, s, w: y + s * SHARES * (w.t > 0.37 * w.t[-1])[:, None],
    "temperature_bias": lambda y, s, w: y + s * SHARES * _off(w.columns["temperature"])[:, None],
    "channel_bias": lambda y, s, w: y + s * SHARES * _off(w.columns["supply"])[:, None],
    "vibration": lambda y, s, w: y + s * SHARES * np.sin(2 * np.pi * 17.3 * w.t + 0.7)[:, None],
    "saturation": _limited,
    "hysteresis": _lagging,
    "dead_zone": lambda y, s, _: y - np.clip(y, -s * np.abs(SHARES), s * np.abs(SHARES)),
}
#: Effects that no catalogue has: (what happens, the column or quantity that a formula must name).
ELSEWHERE: dict[str, tuple[Bend, tuple[str, ...]]] = {
    "warm_exp": (
        lambda y, s, w: y + s * SHARES * np.exp(_off(w.columns["temperature"]) / 1.5)[:, None],
        ("temperature",),
    ),
    "warm_tanh": (
        lambda y, s, w: y + s * SHARES * np.tanh(_off(w.columns["temperature"]) / 0.7)[:, None],
        ("temperature",),
    ),
    "product": (
        lambda y, s, w: (
            y
            + s
            * SHARES
            * (_off(w.columns["temperature"]) * _off(w.columns["supply"]) / 0.01)[:, None]
        ),
        ("temperature", "supply"),
    ),
    "sixth": (lambda y, s, w: y + s * SHARES * np.cos(6 * w.angle + 0.4)[:, None], ("angle",)),
    "warm_sine": (
        lambda y, s, w: (
            y + s * SHARES * np.sin(2 * np.pi * w.columns["temperature"] / 2.5)[:, None]
        ),
        ("temperature",),
    ),
    "rectified": (
        lambda y, s, _: y + s * SHARES * np.abs(y),
        ("reading", "specific_force", "corrected"),
    ),
    "warm_force": (  # an axis takes in some of its neighbour, the more the warmer it is
        lambda y, s, w: (
            y + s * SHARES * np.roll(y, 1, axis=1) * _off(w.columns["temperature"])[:, None]
        ),
        ("temperature",),
    ),
}


def _off(x: Array) -> Array:
    return x - x.mean()


def bent_force(force: Array, effects: Mapping[str, float], scene: Scene) -> Array:
    """The force with all that happens to it."""
    for name, size in effects.items():
        if name in ON_FORCE:
            force = ON_FORCE[name](force, size, scene)
    return force


def bent_reading(reading: Array, effects: Mapping[str, float], scene: Scene) -> Array:
    """The reading with all that happens to it."""
    for name, size in effects.items():
        if name in ON_READING:
            reading = ON_READING[name](reading, size, scene)
        elif name in ELSEWHERE:
            reading = ELSEWHERE[name][0](reading, size, scene)
    return reading


def read_out(
    clean: Array, sigma: float, kind: str, block: Array, rng: np.random.Generator
) -> Array:
    """Readings with noise; `quantised` are rounded to steps of one sigma."""
    v = clean + noise(kind, sigma, block, rng)
    return np.asarray(np.round(v / sigma) * sigma if kind == "quantised" else v)


# -- the wheel -------------------------------------------------------------------------------------


def wheel(
    rng: np.random.Generator,
    effects: Mapping[str, float] | None = None,
    *,
    kind: str = "white",
    seconds: float = 30.0,
    rate: float = 100.0,
    sigma: float = 0.03,
) -> World:
    """A hand-spun wheel; its speed is exactly a cubic in time but for drag or an eccentric mass."""
    effects = effects or {}
    t = np.arange(0, seconds, 1 / rate)
    offset, gain = rng.uniform(-0.5, 0.5, 3), 1 + rng.uniform(-0.05, 0.05, 3)
    angles = np.radians(np.array(MOUNTING) + rng.uniform(-5, 5, 3))
    bench = sim.Spin(
        np.zeros(3),
        np.ones(3),
        Rotation.from_euler("XYZ", angles).as_matrix(),
        rng.uniform(0.7, 0.9),
        radius=0.28 * (1 + effects.get("radius", 0.0)),
    )
    motion = _motion(rng, effects, seconds)
    angle = motion(t)[0]
    scene = Scene(t, columns_of(t, kind, rng), angle)
    force = _felt(bench, motion, t, effects)
    reading = offset + gain * bent_force(force, effects, scene)
    clean = bent_reading(reading, effects, scene)
    block = np.zeros(len(t), dtype=int)
    v = read_out(clean, sigma, kind, block, rng)
    truth = {"offset": offset, "gain": gain, "misalignment": angles, "tilt": np.array(bench.tilt)}
    return World(
        "wheel", "v", {"t": t[:, None], "v": v}, clean, truth, sigma, t, block, scene.columns,
        {"t": "s", "v": "m/s^2"},
    )  # fmt: skip


def _motion(
    rng: np.random.Generator, effects: Mapping[str, float], seconds: float
) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Angle, rate and acceleration at any times."""
    start, fast = rng.uniform(-np.pi, np.pi), rng.uniform(8.0, 10.0)
    drag, eccentric = effects.get("speed_polynomial", 0.0), effects.get("imbalance", 0.0)
    if not drag and not eccentric:
        speed = np.array([fast, -0.1, rng.uniform(3e-4, 7e-4), 2e-6])
        return lambda t: sim.cubic_motion(t, start, speed)
    from scipy.integrate import solve_ivp

    def change(angle: Array, rate: Array) -> Array:
        return -drag * rate * np.abs(rate) - 0.05 - eccentric * np.sin(angle + 0.5)

    found = solve_ivp(
        lambda _, state: np.array([state[1], change(*state)]),
        (-0.5, seconds + 0.5),
        [start, fast],
        "DOP853",
        rtol=1e-10,
        atol=1e-10,
        dense_output=True,
    )

    def at(t: Array) -> tuple[Array, Array, Array]:
        angle, rate = found.sol(t)
        return angle, rate, change(angle, rate)

    return at


def _felt(
    bench: sim.Spin,
    motion: Callable[[Array], tuple[Array, Array, Array]],
    t: Array,
    effects: Mapping[str, float],
) -> Array:
    """Force along each axis of the sensor, when and where and how quickly that axis feels it."""

    def force(times: Array) -> Array:
        angle, rate, change = motion(times)
        felt = bench.read(angle, rate, change)
        if "lever_arm" in effects:  # each axis has its mass at a place of its own, along itself
            felt = felt + effects["lever_arm"] * SHARES * rate[:, None] ** 2
        if "axis_wobble" in effects:
            size = effects["axis_wobble"]
            felt = felt + size * SHARES * np.cos(2 * angle + 0.3)[:, None]
        return felt

    if "low_pass" in effects:
        return _filtered(force, t, effects["low_pass"])
    if "axis_delay" in effects:
        late = effects["axis_delay"] * SHARES
        return np.column_stack([force(t - late[i])[:, i] for i in range(3)])
    return force(t - effects.get("time_delay", 0.0))


def _filtered(force: Callable[[Array], Array], t: Array, tau: float, fine: int = 20) -> Array:
    """A first-order filter, run over a grid `fine` times as dense and already settled."""
    step = (t[1] - t[0]) / fine
    before = int(min(0.4, 12 * tau) / step)
    grid = t[0] + step * np.arange(-before, (len(t) - 1) * fine + 1)
    x = force(grid)
    decay = np.exp(-step / tau)
    # Exact for an input that is linear between the points of the grid.
    slope = 1 - (1 - decay) * tau / step
    first = (1 - decay) * tau / step - decay
    y = lfilter([slope, first], [1, -decay], x, axis=0, zi=(1 - slope) * x[:1])[0]
    return np.asarray(y[before::fine])


# -- the rate table --------------------------------------------------------------------------------


def table(
    rng: np.random.Generator,
    effects: Mapping[str, float] | None = None,
    *,
    kind: str = "white",
    positions: int = 40,
    samples: int = 10,
    sigma: float = 0.02,
) -> World:
    """A rate table stepping through attitudes, `samples` readings at rest in each."""
    effects = effects or {}
    t, R = sim.table_steps(positions, rng, sampled=samples / 25, rate=25.0)
    block = np.repeat(np.arange(positions), len(t) // positions)
    scene = Scene(t, columns_of(t, kind, rng))
    # About a vertical axis nobody would see a wrong angle: that table stands on a wedge.
    wedge = 0.8 if "table_angle" in effects else 0.0
    down = np.array([*rng.uniform(-0.03, 0.03, 2), 1.0]) + wedge * np.array([1.0, 0.0, 0.0])
    truth = {
        "inverse_scale": np.eye(3) + rng.uniform(-0.02, 0.02, (3, 3)),
        "quadratic": rng.uniform(-3e-4, 3e-4, 3),
        "bias": rng.uniform(-0.2, 0.2, 3),
    }
    force = -sim.GRAVITY * np.einsum("nji,j->ni", _real(R, effects), down / np.linalg.norm(down))
    bent = bent_force(force, effects, scene)
    inner = bent + truth["quadratic"] * bent**2 + truth["bias"]
    reading = np.linalg.solve(truth["inverse_scale"], inner.T).T
    clean = bent_reading(reading, effects, scene)
    a = read_out(clean, sigma, kind, block, rng)
    return World(
        "rate-table", "a", {"a": a, "attitude": R.reshape(-1, 9)}, clean, truth, sigma, t, block,
        scene.columns, {"a": "m/s^2"},
    )  # fmt: skip


def _real(R: Array, effects: Mapping[str, float]) -> Array:
    """The attitudes that the table really had: its outer encoder is eccentric."""
    size = effects.get("table_angle", 0.0)
    if not size:
        return R
    nominal = Rotation.from_matrix(R)
    off = size * np.cos(nominal.as_euler("ZYX")[:, 0] + 0.4)
    return np.asarray((Rotation.from_euler("Z", off[:, None]) * nominal).as_matrix())


# -- a known norm ----------------------------------------------------------------------------------


def norm(
    rng: np.random.Generator,
    effects: Mapping[str, float] | None = None,
    *,
    kind: str = "white",
    poses: int = 48,
    count: int = 50,
    sigma: float = 0.01,
    model: str = "norm-triangular",
) -> World:
    """Poses held by hand: each row the mean of `count` samples, of standard deviation sigma.

    With `count` 1 each row is one reading, five of every pose.
    """
    effects = effects or {}
    sensor = sim.accelerometer(rng, skew=model == "norm-triangular" or "cross_axis" in effects)
    directions, t = rng.permutation(sim.spread_poses(poses, rng)), 5.0 * np.arange(poses)
    block = np.arange(poses)
    if count == 1:
        again = 5
        directions, block = np.repeat(directions, again, axis=0), np.repeat(block, again)
        t = np.repeat(t, again) + np.tile(0.02 * np.arange(again), poses)
    scene = Scene(t, columns_of(t, kind, rng))
    if "cross_axis" in effects:  # the declared model has no skew: that is what it lacks
        sensor = replace(sensor, M=np.diag(np.diag(sensor.M)))
    force = bent_force(sensor.norm * directions, effects, scene)
    reading = force @ sensor.M.T + sensor.b
    clean = bent_reading(reading, effects, scene)
    v = read_out(clean, sigma, kind, block, rng)
    scale = sensor.scale if model == "norm-triangular" else np.diag(sensor.scale)
    truth = {"scale": scale, "offset": sensor.b}
    return World(
        model, "v", {"v": v}, clean, truth, sigma, t, block, scene.columns, {"v": "m/s^2"}, count
    )


MAKERS: dict[str, Callable[..., World]] = {"wheel": wheel, "table": table, "norm": norm}


def made(place: str, seed: Sequence[int], effects: Mapping[str, float], **options: object) -> World:
    """The world of one seed."""
    return MAKERS[place](np.random.default_rng(list(seed)), effects, **options)
