"""An independent simulator of a whole IMU that is turned by hand from rest to rest.

Quaternions and closed forms, plain NumPy; nothing here knows casest. A turn is two rotations one
after the other, about axes that stay, each with an angle that is a smooth function of time: so the
axis of the angular rate wanders as a hand's does, and the rate is known exactly at every instant. A
sensor reads z = M·x + b + noise of the true vector x; the truth is scale = M⁻¹, offset = b.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]
GRAVITY = 9.80665


# -- quaternions (N, 4), scalar first: v in the world is q ⊗ v ⊗ q* of v in the body ---------------


def product(p: Array, q: Array) -> Array:
    a, u, b, v = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    scalar = a * b - np.sum(u * v, axis=-1, keepdims=True)
    return np.concatenate([scalar, a * v + b * u + np.cross(u, v)], axis=-1)


def about(axis: Array, angle: Array) -> Array:
    half = np.asarray(angle)[..., None] / 2
    return np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)


def into_body(q: Array, v: Array) -> Array:
    """Vectors of the world as the body sees them."""
    back = q * np.array([1.0, -1, -1, -1])
    pure = np.concatenate([np.zeros((*v.shape[:-1], 1)), v], axis=-1)
    return product(product(back, pure), q)[..., 1:]


# -- the motion ------------------------------------------------------------------------------------


@dataclass
class Motion:
    """Attitude (N, 4), rate in the body (N, 3) rad/s, the hand's acceleration in the world (N, 3)
    m/s², at rest?"""

    t: Array
    attitude: Array
    rate: Array
    shaking: Array
    still: NDArray[np.bool_]


def _smooth(x: Array) -> tuple[Array, Array]:
    """From 0 to 1 with no rate and no acceleration at the ends, and its derivative."""
    return 10 * x**3 - 15 * x**4 + 6 * x**5, 30 * x**2 - 60 * x**3 + 30 * x**4


def _there_and_back(x: Array) -> tuple[Array, Array]:
    """From 0 to 1 and back, smooth at both ends, and its derivative."""
    return 64 * (x * (1 - x)) ** 3, 192 * (x * (1 - x)) ** 2 * (1 - 2 * x)


def waved(
    rng: np.random.Generator,
    rests: int = 24,
    rate: float = 100.0,
    rest: float = 2.0,
    turn: float = 1.5,
    angle: tuple[float, float] = (1.2, 2.6),
    wobble: float = 0.4,
    shake: float = 1.5,
    axes: Array | None = None,
) -> Motion:
    """Rests of `rest` s, turns of `turn` s by `angle` rad about random axes (or those given).

    On the way the axis wobbles by `wobble` rad and the hand accelerates by up to `shake` m/s²,
    first along some direction of the world and then against it: at its end it is at rest.
    """
    here, attitudes, rates, shaking, still = (
        about(_unit(rng), np.array(rng.uniform(0, 6))),
        [],
        [],
        [],
        [],
    )
    for k in range(rests):
        lying = round(rate * rest * rng.uniform(0.9, 1.2))
        attitudes.append(np.repeat(here[None], lying, axis=0))
        rates.append(np.zeros((lying, 3)))
        shaking.append(np.zeros((lying, 3)))
        still.append(np.ones(lying, bool))
        if k == rests - 1:
            break
        count = round(rate * turn * rng.uniform(0.8, 1.3))
        x, seconds = (np.arange(count) + 1) / (count + 1), (count + 1) / rate
        first = _unit(rng) if axes is None else axes[k % len(axes)]
        second, size = _unit(rng), rng.uniform(*angle) * rng.choice([-1, 1])
        (s, ds), (b, db) = _smooth(x), _there_and_back(x)
        swung = about(second, wobble * b)
        way = product(about(first, size * s), swung)
        attitudes.append(product(here[None], way))
        turned = np.repeat(first[None], count, axis=0)
        rates.append(
            into_body(swung, turned) * (size * ds / seconds)[:, None]
            + second * (wobble * db / seconds)[:, None]
        )
        push = _unit(rng) * shake * np.sin(2 * np.pi * x)[:, None] * b[:, None]
        shaking.append(push)
        still.append(np.zeros(count, bool))
        here = product(here[None], about(first, np.array([size])))[0]
    q = np.concatenate(attitudes)
    t = np.arange(len(q)) / rate
    return Motion(t, q, np.concatenate(rates), np.concatenate(shaking), np.concatenate(still))


def _unit(rng: np.random.Generator) -> Array:
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


# -- the sensors -----------------------------------------------------------------------------------


@dataclass
class Imu:
    """What each sensor makes of the truth, and the noise of one reading."""

    accelerometer: Array
    accelerometer_bias: Array
    gyroscope: Array
    gyroscope_bias: Array
    magnetometer: Array
    magnetometer_bias: Array
    g_sensitivity: Array = field(default_factory=lambda: np.zeros((3, 3)))
    noises: tuple[float, float, float] = (0.02, 0.003, 0.3)
    #: Random walk of the gyroscope's bias, rad/s after one second.
    walk: float = 0.0
    #: Seconds by which the gyroscope's readings are older than their time says.
    late: float = 0.0

    @property
    def truth(self) -> dict[str, Array]:
        return {
            "accelerometer_scale": np.linalg.inv(self.accelerometer),
            "accelerometer_offset": self.accelerometer_bias,
            "gyroscope_scale": np.linalg.inv(self.gyroscope),
            "gyroscope_offset": self.gyroscope_bias,
            "magnetometer_scale": np.linalg.inv(self.magnetometer),
            "magnetometer_offset": self.magnetometer_bias,
        }


def an_imu(rng: np.random.Generator, **more: object) -> Imu:
    """Scales off by some percent, axes by some degrees; gyro and compass are turned a little."""

    def matrix(scale: float, mounted: float) -> Array:
        return np.eye(3) * (
            1 + scale * rng.standard_normal((3, 1))
        ) + mounted * rng.standard_normal((3, 3))

    lower = np.tril(matrix(0.02, 0.01))
    iron = matrix(0.1, 0.06)
    return Imu(
        lower, 0.3 * rng.standard_normal(3),
        matrix(0.02, 0.03), 0.02 * rng.standard_normal(3),
        iron, 20 * rng.standard_normal(3),
        **more,  # type: ignore[arg-type]
    )  # fmt: skip


def recorded(
    motion: Motion, imu: Imu, rng: np.random.Generator, *, field_: float = 48.0, dip: float = 1.1
) -> dict[str, Array]:
    """t (N,), a, w, m (N, 3): m/s² (+g on an axis that points up), rad/s, µT; and what the
    gyroscope's bias has drifted by at each time, (N, 3)."""
    up = np.broadcast_to(np.array([0, 0, GRAVITY]), (len(motion.t), 3))
    force = into_body(motion.attitude, up + motion.shaking)
    north = field_ * np.array([np.cos(dip), 0.0, -np.sin(dip)])
    flux = into_body(motion.attitude, np.zeros_like(up) + north)
    a, w, m = imu.noises
    step = np.diff(motion.t, prepend=motion.t[0] - motion.t[1])[:, None]
    drift = np.cumsum(imu.walk * np.sqrt(np.abs(step)) * rng.standard_normal(up.shape), axis=0)
    bias = imu.gyroscope_bias + drift + force @ imu.g_sensitivity.T
    noise = rng.standard_normal((3, *up.shape))
    return {
        "t": motion.t,
        "a": force @ imu.accelerometer.T + imu.accelerometer_bias + a * noise[0],
        "w": _earlier(motion, imu.late) @ imu.gyroscope.T + bias + w * noise[1],
        "m": flux @ imu.magnetometer.T + imu.magnetometer_bias + m * noise[2],
        "drift": drift,
    }


def _earlier(motion: Motion, by: float) -> Array:
    """The rate as it was some seconds before each time."""
    if not by:
        return motion.rate
    return np.asarray(CubicSpline(motion.t, motion.rate)(np.clip(motion.t - by, 0, motion.t[-1])))


def written(path: object, record: dict[str, Array], names: str = "awm") -> str:
    """A CSV file with a header that says the units; its name."""
    units = {"a": "m/s^2", "w": "rad/s", "m": "uT"}
    head = ["t [s]", *(f"{n}{x} [{units[n]}]" for n in names for x in "xyz")]
    table = np.column_stack([record["t"], *(record[n] for n in names)])
    np.savetxt(str(path), table, delimiter=",", header=",".join(head), comments="", fmt="%.9g")
    return str(path)
