"""Independent simulators of triaxial sensors of a vector of constant length: plain NumPy.

Nothing here knows casest. A sensor reads z = M x + b + noise (Burkhard et al., eq. 1) of a true
vector x with ‖x‖ = norm, M lower triangular; the truth is scale = M⁻¹, offset = b.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
GRAVITY = 9.80665
#: The wheel of Pedersini, Table I: m/s², rad and s.
TABLE_1 = {
    "offset": np.array([1.0, -1.0, 1.0]),
    "gain": np.array([0.9, 1.0, 1.1]),
    "misalignment": np.radians([30.0, 20.0, 25.0]),
    "tilt": np.radians(45.0),
    "phase": np.radians(30.0),
    "speed": np.array([9.0, -0.09, 5e-4, 2e-6]),
}


# -- directions of the true vector in the sensor's frame, (n, 3) unit vectors ----------------------


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def random_rotation(rng: np.random.Generator) -> Array:
    """A rotation matrix, uniform over SO(3)."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def sphere(n: int, rng: np.random.Generator) -> Array:
    """Independent directions, uniform over the sphere."""
    return _unit(rng.standard_normal((n, 3)))


def spread_poses(n: int, rng: np.random.Generator, jitter: float = 0.1) -> Array:
    """Directions spread evenly over the sphere, as a careful hand does it.

    A Fibonacci lattice, randomly rotated, each direction moved by about `jitter` rad.
    """
    k = np.arange(n) + 0.5
    height, turn = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    side = np.sqrt(1 - height**2)
    lattice = np.column_stack([side * np.cos(turn), side * np.sin(turn), height])
    return _unit(lattice @ random_rotation(rng).T + jitter * rng.standard_normal((n, 3)))


def six_faces(rng: np.random.Generator, tilt: float = 0.0) -> Array:
    """Each axis up and down, off by about `tilt` rad."""
    faces = np.vstack([np.eye(3), -np.eye(3)])
    return _unit(faces + tilt * rng.standard_normal((6, 3)))


def ring(n: int, rng: np.random.Generator) -> Array:
    """A great circle: the sensor turned about one horizontal axis only."""
    angle = rng.uniform(0, 2 * np.pi, n)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    return circle @ random_rotation(rng).T


def cap(n: int, rng: np.random.Generator, tilt: float = np.radians(10)) -> Array:
    """Uniform over the cap of directions within `tilt` of one axis (π/2: a half sphere)."""
    height = rng.uniform(np.cos(tilt), 1, n)
    turn, side = rng.uniform(0, 2 * np.pi, n), np.sqrt(1 - height**2)
    return np.column_stack([side * np.cos(turn), side * np.sin(turn), height]) @ (
        random_rotation(rng).T
    )


# -- sensors ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sensor:
    """z = M x + b + noise, with ‖x‖ = norm; M (3, 3) lower triangular, b (3,) in the unit of z."""

    M: Array
    b: Array
    norm: float

    @property
    def scale(self) -> Array:
        """(3, 3): x = scale (z − b)."""
        return np.linalg.inv(self.M)

    def read(self, directions: Array, sigma: float | Array, rng: np.random.Generator) -> Array:
        """Readings (n, 3); sigma is one number, or (n,) one per pose."""
        noise = rng.standard_normal(directions.shape) * np.reshape(sigma, (-1, 1))
        return self.norm * directions @ self.M.T + self.b + noise


def accelerometer(rng: np.random.Generator, *, skew: bool = True) -> Sensor:
    """A MEMS accelerometer in m/s²: offsets of ±0.5 m/s², scale ±3 %, skew ±1° (or none)."""
    M = np.diag(1 + rng.uniform(-0.03, 0.03, 3))
    if skew:
        M += np.tril(rng.uniform(-0.017, 0.017, (3, 3)), -1)
    return Sensor(M, rng.uniform(-0.5, 0.5, 3), GRAVITY)


def adis16475(rng: np.random.Generator) -> Sensor:
    """Burkhard's simulated sensor: bias 0.9-1.3 mg, scale 300-600 ppm, skew 0.02-0.04°."""
    M = np.diag(1 + rng.uniform(300e-6, 600e-6, 3))
    M += np.tril(np.radians(rng.uniform(0.02, 0.04, (3, 3))), -1)
    return Sensor(M, rng.uniform(0.9e-3, 1.3e-3, 3) * 9.8055, 9.8055)


def magnetometer(rng: np.random.Generator, *, counts_per_gauss: float = 3000.0) -> Sensor:
    """A magnetometer in counts in a field of 0.48 gauss.

    Hard iron moves the centre by up to half the field on each axis; soft iron is symmetric, 15 %.
    The rotation in it is invisible to a norm: M = L Q with Q a rotation, and L is kept.
    """
    iron = rng.uniform(-0.15, 0.15, (3, 3))
    soft = np.eye(3) + 0.5 * (iron + iron.T)
    gains = np.diag(counts_per_gauss * (1 + rng.uniform(-0.05, 0.05, 3)))
    _, upper = np.linalg.qr((gains @ soft).T)
    L = upper.T * np.sign(np.diag(upper))
    return Sensor(L, counts_per_gauss * rng.uniform(-0.24, 0.24, 3), 0.48)


# -- a raw record ----------------------------------------------------------------------------------


def handheld(
    sensor: Sensor,
    poses: Array,
    sigma: float,
    rng: np.random.Generator,
    *,
    rate: float = 100.0,
    rest: float = 3.0,
    move: float = 1.5,
) -> tuple[Array, list[tuple[int, int]]]:
    """A hand-held raw record (N, 3): rests in each pose, turning and shaking between them.

    Also returns the samples (first, last) of each true rest.
    """
    parts: list[Array] = []
    rests: list[tuple[int, int]] = []
    count = 0
    for k, pose in enumerate(poses):
        n = round(rate * rest * rng.uniform(0.8, 1.2))
        parts.append(np.tile(sensor.norm * pose, (n, 1)))
        rests.append((count, count + n - 1))
        count += n
        if k + 1 < len(poses):
            m = round(rate * move)
            s = (np.arange(m) + 0.5) / m
            blend = np.outer(1 - s, pose) + np.outer(s, poses[k + 1])
            blend += np.outer(np.sin(np.pi * s), 0.3 * rng.standard_normal(3))
            shake = np.sin(np.pi * s)[:, None] * rng.normal(0, 0.2 * sensor.norm, (m, 3))
            parts.append(sensor.norm * _unit(blend) + shake)
            count += m
    x = np.vstack(parts)
    return x @ sensor.M.T + sensor.b + sigma * rng.standard_normal(x.shape), rests


# -- a hand-spun wheel --------------------------------------------------------------------------


@dataclass(frozen=True)
class Spin:
    """An accelerometer on a tilted wheel: what Pedersini's bench does, written from the geometry.

    Angles in rad, lengths in m; `turn` (3, 3) takes bench axes to sensor axes.
    """

    offset: Array
    gain: Array
    turn: Array
    tilt: float
    radius: float = 0.28
    gravity: float = GRAVITY

    def read(self, angle: Array, rate: Array, change: Array) -> Array:
        """Noise-free readings (N, 3) for given angle, angular rate and acceleration."""
        down = np.array([np.sin(self.tilt), 0.0, np.cos(self.tilt)])  # in the bench's plane at 0
        x = self.gravity * down[0] * np.cos(angle) + self.radius * rate**2
        y = self.gravity * down[0] * np.sin(angle) + self.radius * change
        z = np.full_like(angle, self.gravity * down[2])
        return self.offset + self.gain * np.einsum("ij,jn->ni", self.turn, np.array([x, y, z]))


def cubic_motion(t: Array, start: float, speed: Array) -> tuple[Array, Array, Array]:
    """Angle, rate and acceleration of a wheel whose rate is exactly a cubic in t."""
    rate = sum(c * t**k for k, c in enumerate(speed))
    angle = start + sum(c * t ** (k + 1) / (k + 1) for k, c in enumerate(speed))
    change = sum(k * c * t ** (k - 1) for k, c in enumerate(speed) if k)
    return angle, rate, change


def physical_motion(
    t: Array,
    start: float,
    rate: float,
    *,
    drag: float = 4e-4,
    friction: float = 0.004,
    eccentric: float = 0.0,
) -> tuple[Array, Array, Array]:
    """Angle, rate, acceleration of a wheel slowed by air and bearing, by integration.

    Per unit of inertia: `drag` (1/rad) times rate², `friction` (rad/s²), and `eccentric` (rad/s²)
    the pull of an unbalanced mass, which speeds the wheel up and slows it down once per turn.
    """
    from scipy.integrate import solve_ivp

    def motion(_: float, state: Array) -> Array:
        angle, omega = state
        sign = np.sign(omega)
        torque = -drag * omega * abs(omega) - friction * sign - eccentric * np.sin(angle)
        return np.array([omega, torque])

    found = solve_ivp(motion, (t[0], t[-1]), [start, rate], "DOP853", t, rtol=1e-11, atol=1e-11)
    angle, omega = found.y
    return angle, omega, np.array([motion(0.0, s)[1] for s in found.y.T])


# -- a rate table ----------------------------------------------------------------------------------


def table_steps(
    n: int,
    rng: np.random.Generator,
    *,
    step: float = 22.0,
    transition: float = 2.0,
    sampled: float = 4.0,
    rate: float = 100.0,
) -> tuple[Array, Array]:
    """Batista's trajectory: (t, R), the table stepping through n attitudes, sampled at rest.

    Each step lasts `step` seconds, `transition` of them moving; `sampled` seconds at rest are kept.
    R (N, 3, 3) takes body to table axes.
    """
    from scipy.spatial.transform import Rotation

    attitudes = Rotation.random(n, random_state=int(rng.integers(1 << 31))).as_matrix()
    inside = transition + (step - transition - sampled) / 2 + np.arange(0, sampled, 1 / rate)
    t = (np.arange(n) * step)[:, None] + inside
    return t.ravel(), np.repeat(attitudes, len(inside), axis=0)


def table_readings(
    R: Array,
    down: Array,
    inverse_scale: Array,
    quadratic: Array,
    bias: Array,
    sigma: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """(readings, true forces), each (N, 3): F⁻¹·a_m = a + F2·a² + b′ with a = −g (Batista, 2)."""
    force = -GRAVITY * np.einsum("nji,j->ni", R, down / np.linalg.norm(down))
    bent = force + quadratic * force**2 + bias
    noise = sigma * rng.standard_normal(force.shape)
    return np.linalg.solve(inverse_scale, bent.T).T + noise, force


# -- a magnetometer beside a motor -----------------------------------------------------------------


def soft_turning(n: int, rate: float, rng: np.random.Generator) -> Array:
    """Rotations (n, 3, 3) of a body that is turned softly about all axes, by integration.

    Each component of its angular rate is a sum of four slow waves, up to 2 rad/s together.
    """
    from scipy.spatial.transform import Rotation

    t = np.arange(n) / rate
    rates = np.zeros((n, 3))
    for axis in range(3):
        for _ in range(4):
            frequency, phase = rng.uniform(0.02, 0.2), rng.uniform(0, 2 * np.pi)
            rates[:, axis] += rng.uniform(0.2, 0.5) * np.sin(2 * np.pi * frequency * t + phase)
    turned = np.empty((n, 3, 3))
    turned[0] = random_rotation(rng)
    for k, step in enumerate(Rotation.from_rotvec(rates[:-1] / rate).as_matrix()):
        turned[k + 1] = turned[k] @ step
    return turned


def motor_current(n: int, rate: float, rng: np.random.Generator) -> Array:
    """Current (n,) of a drone's motors in A: idle, take-off, hover, bursts, landing, with ripple.

    The battery and the rotors answer with a time constant of 0.3 s.
    """
    edges = np.sort(rng.uniform(0.1, 0.9, 6))
    levels = [1.0, rng.uniform(22, 28), *rng.uniform(12, 20, 4), 1.5]
    demand = np.asarray(levels)[np.searchsorted(edges, np.arange(n) / n)]
    found, state, share = np.empty(n), demand[0], 1 - np.exp(-1 / (0.3 * rate))
    for k in range(n):
        state += share * (demand[k] * (1 + 0.06 * rng.standard_normal()) - state)
        found[k] = state
    wave = np.sin(2 * np.pi * rng.uniform(0.5, 3) * np.arange(n) / rate)
    return found * (1 + 0.03 * wave) + 0.05 * rng.standard_normal(n)


def drone(
    sensor: Sensor,
    per_ampere: Array,
    sigma: float,
    rng: np.random.Generator,
    n: int = 4000,
    rate: float = 50.0,
) -> tuple[Array, Array, Array]:
    """(t, readings (n, 3), current): the motor's current moves the offset by per_ampere each A."""
    current = motor_current(n, rate, rng)
    down = np.array([0.4, 0.1, np.sqrt(1 - 0.17)])
    directions = np.einsum("nji,j->ni", soft_turning(n, rate, rng), down)
    v = sensor.read(directions, sigma, rng) + np.outer(current, per_ampere)
    return np.arange(n) / rate, v, current


# -- a thermistor that lags behind its reference ---------------------------------------------------


def chamber(n: int, step: float, rng: np.random.Generator) -> Array:
    """Temperature (n,) of a climate chamber in K, one reading every `step` s.

    Its controller holds settings of a few minutes each; the air follows with 40 s, and breathes.
    """
    t = np.arange(n) * step
    changes = np.cumsum(rng.uniform(120, 400, int(n * step / 120) + 2))
    settings = rng.uniform(278, 333, len(changes) + 1)
    air, found = settings[0], np.empty(n)
    for k in range(n):
        air += (1 - np.exp(-step / 40)) * (settings[np.searchsorted(changes, t[k])] - air)
        found[k] = air
    return found + 0.3 * np.sin(2 * np.pi * t / rng.uniform(60, 200) + rng.uniform(0, 2 * np.pi))


def thermistor(
    reference: Array, step: float, lag: float, rng: np.random.Generator, noise: float = 0.05
) -> Array:
    """Resistance (n,) of a thermistor whose own temperature follows with `lag` s, by integration.

    Beta equation with 10 kΩ at 25 °C and B = 3435 K; `noise` in K.
    """
    own, body = np.empty(len(reference)), reference[0]
    for k, now in enumerate(reference):
        for part in np.linspace(reference[max(k - 1, 0)], now, 20):  # explicit Euler
            body += (part - body) * step / 20 / lag if lag else 0.0
        own[k] = body if lag else now
    seen = own + noise * rng.standard_normal(len(own))
    return 10_000 * np.exp(3435 * (1 / seen - 1 / 298.15))
