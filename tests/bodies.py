"""An accelerometer and a magnetometer in one body, carried through attitudes in a steady field.

Two sensors of `simulators`, one of them mounted askew; no code of the model.
"""

from __future__ import annotations

import numpy as np
import simulators as sim
from scipy.spatial.transform import Rotation

from casest import Run

NOISE = 0.02, 0.3  # m/s², µT
FIELD = 48.0  # µT


def attitudes(n, rng):
    """Body to reference (z up, x to magnetic north), (n, 3, 3)."""
    return Rotation.random(n, random_state=int(rng.integers(1 << 31))).as_matrix()


def seen(R, dip):
    """Up and the field's direction in body axes, each (n, 3)."""
    north = np.broadcast_to([np.cos(dip), 0, -np.sin(dip)], (len(R), 3))
    return R[:, 2], np.einsum("nji,nj->ni", R, north)


class Body:
    """Two sensors: an accelerometer along the body's axes, a magnetometer turned by `turn`."""

    def __init__(self, rng, angle=None):
        self.acceleration = sim.accelerometer(rng)
        self.flux = sim.magnetometer(rng, counts_per_gauss=100)  # reads µT
        angle = rng.uniform(0, np.pi / 2) if angle is None else angle
        self.turn = Rotation.from_rotvec(angle * sim.sphere(1, rng)[0]).as_matrix()
        self.dip = rng.uniform(-1.2, 1.2)

    def record(self, R, rng, noise=NOISE, dip=None):
        up, north = seen(R, self.dip if dip is None else dip)
        a = self.acceleration.read(up, noise[0], rng)
        m = self.flux.read(north @ self.turn, noise[1], rng)
        return Run.raw("body", {"a": a, "m": m}, units={"a": "m/s^2", "m": "uT"})

    @property
    def truth(self):
        return {
            "accelerometer_scale": self.acceleration.scale,
            "accelerometer_offset": self.acceleration.b,
            "magnetometer_scale": 100 * self.turn @ self.flux.scale,
            "magnetometer_offset": self.flux.b,
            "dip": np.array(self.dip),
        }
