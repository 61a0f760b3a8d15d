"""Flights by closed forms: attitude and position are sums of sines, everything else their
derivatives. Inertial frame, z down, ZYX Euler angles; no code of the model, nothing integrated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from casest import Run

GRAVITY = np.array([0.0, 0.0, 9.80665])
#: Batista's sensors (V-B): standard deviations at 100 Hz of a (m/s²), omega (rad/s), v (m/s).
SIGMA = {"a": 0.0013, "omega": np.radians(0.05), "v": 0.01}
BIAS = np.array([0.1, -0.05, 0.025])
UNITS = {"a": "m/s^2", "omega": "rad/s", "v": "m/s"}


@dataclass(frozen=True)
class Sines:
    """Three sums of K sines over time: amplitude, frequency (rad/s) and phase, (3, K)."""

    amplitude: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray

    def __call__(self, t, order=0):
        """The derivative of that order at t (N,), (N, 3)."""
        angle = t[:, None, None] * self.frequency + self.phase + order * np.pi / 2
        return np.sum(self.amplitude * self.frequency**order * np.sin(angle), axis=2)


def sines(rng, size, slow, fast, terms=3):
    """Random ones: about `size` large, between two frequencies (rad/s)."""
    amplitude = size * rng.uniform(0.5, 1.0, (3, terms)) / np.sqrt(terms)
    frequency = np.exp(rng.uniform(np.log(slow), np.log(fast), (3, terms)))
    return Sines(amplitude, frequency, rng.uniform(0, 2 * np.pi, (3, terms)))


@dataclass(frozen=True)
class Flight:
    """A rigid motion: Euler angles (roll, pitch, yaw; rad) and position (m) over time."""

    angles: Sines
    position: Sines

    def body(self, t):
        """Inertial to body axes at every time."""
        return Rotation.from_euler("ZYX", self.angles(t)[:, ::-1]).inv()

    def gravity(self, t):
        """In body axes, (N, 3)."""
        return self.body(t).apply(GRAVITY)

    def omega(self, t):
        """Angular velocity in body axes, from the Euler rates."""
        (roll, pitch, _), (p, q, r) = self.angles(t).T, self.angles(t, 1).T
        return np.c_[
            p - r * np.sin(pitch),
            q * np.cos(roll) + r * np.cos(pitch) * np.sin(roll),
            -q * np.sin(roll) + r * np.cos(pitch) * np.cos(roll),
        ]

    def velocity(self, t):
        """In body axes, (N, 3)."""
        return self.body(t).apply(self.position(t, 1))

    def force(self, t):
        """What an ideal accelerometer reads, in body axes."""
        return self.body(t).apply(self.position(t, 2) - GRAVITY)


@dataclass(frozen=True)
class Sensors:
    """Errors beyond white noise, each null by default."""

    bias: np.ndarray | tuple = tuple(BIAS)
    gyro_bias: tuple = (0.0, 0.0, 0.0)
    gain: float = 0.0  # accelerometer reads (1 + gain) times the force
    delay: float = 0.0  # velocity is read late, s
    lever: tuple = (0.0, 0.0, 0.0)  # place of the velocity sensor in the body, m
    colour: float = 0.0  # correlation time of a part of the velocity noise, s
    coloured: float = 0.0  # its standard deviation, m/s
    tails: bool = False  # noise by Student's t with four degrees of freedom
    quantised: bool = False  # readings in steps of their noise
    wander: float = 0.0  # intensity of a random walk of the accelerometer's bias, (m/s²)²/s

    def but(self, **changes):
        return replace(self, **changes)


def record(flight, t, rng=None, sensors=Sensors(), sigma=SIGMA):
    """A run with signals a, omega, v; without rng no noise."""
    late = t - sensors.delay
    v = flight.velocity(late) + np.cross(flight.omega(late), sensors.lever)
    a = (1 + sensors.gain) * flight.force(t) + np.asarray(sensors.bias)
    signals = {"a": a, "omega": flight.omega(t) + np.asarray(sensors.gyro_bias), "v": v}
    if rng is not None:
        signals["a"] = signals["a"] + walk(t, sensors.wander, rng)
        signals = {k: x + sigma[k] * noise(x.shape, sensors, rng) for k, x in signals.items()}
        if sensors.coloured:
            signals["v"] = signals["v"] + coloured(t, sensors.colour, sensors.coloured, rng)
        if sensors.quantised:
            signals = {k: sigma[k] * np.round(x / sigma[k]) for k, x in signals.items()}
    return Run.raw("flight", signals, units=UNITS, time=t)


def noise(shape, sensors, rng):
    """White, of unit variance."""
    if sensors.tails:
        return rng.standard_t(4, shape) / np.sqrt(2)
    return rng.standard_normal(shape)


def walk(t, intensity, rng):
    """A random walk (N, 3)."""
    if not intensity:
        return 0.0
    step = np.sqrt(intensity * np.diff(t, prepend=t[0]))
    return np.cumsum(step[:, None] * rng.standard_normal((len(t), 3)), axis=0)


def coloured(t, correlation, std, rng):
    """Exponentially correlated noise (N, 3)."""
    keep = np.exp(-np.diff(t, prepend=t[0]) / correlation)
    x = std * rng.standard_normal(3)
    found = np.empty((len(t), 3))
    for k in range(len(t)):
        x = keep[k] * x + std * np.sqrt(1 - keep[k] ** 2) * rng.standard_normal(3)
        found[k] = x
    return found


def on_the_table():
    """Of the kind of Batista's Fig. 3: a rate table swings about all axes, 0.3 m off its centre."""
    angles = Sines(
        np.array([[0.45, 0.25], [0.40, 0.20], [0.80, 0.30]]),
        2 * np.pi / np.array([[37.0, 11.0], [29.0, 13.0], [53.0, 17.0]]),
        np.array([[0.0, 1.0], [0.5, 2.0], [1.0, 0.0]]),
    )
    still = Sines(np.full((3, 1), 1e-12), np.ones((3, 1)), np.zeros((3, 1)))
    return Turning(angles, still, np.array([0.3, 0.0, 0.1]))


@dataclass(frozen=True)
class Turning(Flight):
    """A body on a rate table: fixed to it at `arm` (m, body axes) from the point that rests."""

    arm: np.ndarray = (0.0, 0.0, 0.0)

    def velocity(self, t):
        return np.cross(self.omega(t), self.arm)

    def force(self, t):
        omega, h = self.omega(t), 1e-4
        change = (self.omega(t + h) - self.omega(t - h)) / (2 * h)
        turning = np.cross(change, self.arm) + np.cross(omega, np.cross(omega, self.arm))
        return turning - self.gravity(t)


def in_the_air():
    """A small vehicle that turns and accelerates by about 1 m/s²."""
    return somewhere(np.random.default_rng(3))


def somewhere(rng):
    """A small vehicle on a random way."""
    return Flight(sines(rng, 0.6, 0.2, 1.0), sines(rng, 4.0, 0.2, 0.9))


#: An axis that is none of the body's.
AXIS = np.array([0.27, 0.53, 0.80]) / np.linalg.norm([0.27, 0.53, 0.80])
#: Angular velocities of a body that stays where it is, rad/s (N, 3), and what a velocity sensor
#: can tell of the six numbers of gravity and bias (Batista, theorem 2).
SPINS = {
    "at rest": (lambda t: np.zeros((len(t), 3)), 3),
    "one axis, 1 °/s": (lambda t: np.tile(np.radians(1.0) * AXIS, (len(t), 1)), 5),
    "one axis, 17 °/s": (lambda t: (0.1 + 0.3 * np.sin(0.4 * t))[:, None] * AXIS, 5),
    "all axes, 1 °/s": (
        lambda t: np.radians(1.0) * np.c_[np.cos(0.1 * t), np.sin(0.1 * t), 0.5 + 0 * t], 6,
    ),
    "all axes, 30 °/s": (
        lambda t: np.c_[0.5 * np.sin(0.6 * t), 0.4 * np.cos(0.42 * t), 0.3 * np.sin(0.2 * t + 1)],
        6,
    ),
}  # fmt: skip


def spun(omega, t, parts=8):
    """Gravity in body axes (N, 3) of a body that turns with omega(t), by small rotations."""
    step = (t[1] - t[0]) / parts
    middle = t[0] + step * (np.arange((len(t) - 1) * parts) + 0.5)
    turns = Rotation.from_rotvec(-step * omega(middle)).as_matrix().reshape(-1, parts, 3, 3)
    found = [Rotation.from_euler("ZYX", [0.2, 0.1, -0.3]).inv().apply(GRAVITY)]
    for turn in turns:
        seen = found[-1]
        for small in turn:
            seen = small @ seen
        found.append(seen)
    return np.array(found)


# -- what a sensor does beside noise: the same motion, other readings ------------------------------


def with_signals(run, columns=None, units=None, **changed):
    """The run with other signals, and with columns beside them."""
    made = Run.raw("flight", {**run.signals, **changed}, units=UNITS, time=run.time)
    return replace(made, columns=columns or {}, column_units=units or {})


def quadratic(run, motion, t, share=1.0):
    return with_signals(
        run, a=run.signals["a"] + share * np.array([1e-3, -7e-4, 5e-4]) * motion.force(t) ** 2
    )


def answers_to_force(run, motion, t, share=1.0):
    K = share * np.radians([[0.03, 0, 0.01], [0, -0.02, 0], [0.01, 0, 0.02]])
    return with_signals(run, omega=run.signals["omega"] + motion.force(t) @ K.T)


def knocked(run, motion, t, share=1.0):
    late = (t > 17.3)[:, None]
    return with_signals(run, a=run.signals["a"] + share * np.array([0.1, -0.05, 0.08]) * late)


def shaken(run, motion, t, share=1.0):
    line = np.sin(2 * np.pi * 3.7 * t + 0.3)[:, None]
    return with_signals(run, a=run.signals["a"] + share * np.array([0.1, -0.05, 0.08]) * line)


def warmed(run, motion, t, share=1.0):
    warm = 20 + 10 * (1 - np.exp(-t / 15)) + 2 * np.sin(0.3 * t)
    drift = share * np.array([0.01, -0.005, 0.008]) * (warm - 20)[:, None]
    return with_signals(run, {"temp": warm}, {"temp": "degC"}, a=run.signals["a"] + drift)


def beside_a_motor(run, motion, t, share=1.0):
    current = 5 + 2 * np.sign(np.sin(0.9 * t)) + 0.1 * np.cos(7 * t)
    pulled = share * np.array([0.03, -0.015, 0.02]) * current[:, None]
    return with_signals(run, {"motor": current}, {"motor": "A"}, a=run.signals["a"] + pulled)


def in_gusts(run, motion, t, share=1.0):
    gusts = coloured(t, 4.0, 0.3 * share, np.random.default_rng(9))
    return with_signals(run, v=run.signals["v"] - motion.body(t).apply(gusts))


def in_wind(run, motion, t, share=1.0):
    """A constant one: what a speed through air shows of gravity and bias is the same in it."""
    wind = np.tile(share * np.array([0.25, 0.15, 0.05]), (len(t), 1))
    return with_signals(run, v=run.signals["v"] - motion.body(t).apply(wind))


#: Kind -> how readings change, what should be found, the size in words.
CHANGES = {
    "g²": (quadratic, "quadratic of a", "1e-3 (m/s²)⁻¹"),
    "g-sensitivity": (answers_to_force, "g_sensitivity(a) of omega", "0.03 °/s per m/s²"),
    "knock": (knocked, "bias_step of a", "0.14 m/s² from 17.3 s on"),
    "vibration": (shaken, "vibration of a", "0.14 m/s² at 3.7 Hz"),
    "temperature": (warmed, "temperature_bias(temp) of a", "0.014 m/s² per K"),
    "motor": (beside_a_motor, "channel_bias(motor) of a", "0.04 m/s² per A"),
    "gusts": (in_gusts, "coloured_noise of v", "0.3 m/s over 4 s"),
    "constant wind": (in_wind, "", "0.3 m/s"),
}
