"""The wheel written out with NumPy and CasADi MX, as somebody without casest would do it.

Unknowns x (15,): offset, gain, misalignment, tilt, phase, speed, as in `casest_problems.wheel`.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

RADIUS, GRAVITY = 0.28, 9.80665
TRUTH = np.array(
    [1, -1, 1, 0.9, 1, 1.1, *np.radians([30, 20, 25, 45, 30]), 9, -0.09, 5e-4, 2e-6]
)  # Pedersini's Table I
SIGMA = 0.08
NAMES = {
    "offset": slice(0, 3),
    "gain": slice(3, 6),
    "misalignment": slice(6, 9),
    "tilt": 9,
    "phase": 10,
    "speed": slice(11, 15),
}


def named(x: Any) -> dict[str, Any]:
    """Unknowns by their names in the model."""
    return {name: x[place] for name, place in NAMES.items()}


def start(seconds: float) -> Any:
    """Everything 5 % off, but the speed only so far that the phase at the end is off by 0.4 rad.

    Half a turn off, the sines are uncorrelated with the data and no local solver finds its way.
    """
    x = 1.05 * TRUTH
    powers = np.arange(1, 5)
    x[11:] = TRUTH[11:] + 0.1 * powers / seconds**powers
    return x


class Wheel:
    """Residual (3N,) and Jacobian (3N, 15) of a record, axis after axis."""

    def __init__(self, t: Any, v: Any) -> None:
        self.v = v
        one, zero = np.ones_like(t), np.zeros_like(t)
        self.basis = np.array([one, t, t**2 / 2, t**3 / 3, t**4 / 4])
        self.slope = np.array([zero, one, t, t**2, t**3])
        self.bend = np.array([zero, zero, one, 2 * t, 3 * t**2])

    def residual(self, x: Any) -> Any:
        """Predicted minus measured."""
        force = rotation(x[6:9])[0] @ self._bench(x)[0]
        return (x[:3, None] + x[3:6, None] * force - self.v.T).ravel()

    def jacobian(self, x: Any) -> Any:
        """Slope of the residual."""
        a, angle, rate = self._bench(x)
        R, slopes = rotation(x[6:9])
        pull, level = GRAVITY * np.sin(x[9]), GRAVITY * np.cos(x[9])
        c, s = np.cos(angle), np.sin(angle)
        J = np.zeros((3, a.shape[1], 15))
        for i in range(3):
            J[i, :, i] = 1
            J[i, :, 3 + i] = R[i] @ a
            for k in range(3):
                J[i, :, 6 + k] = x[3 + i] * (slopes[k][i] @ a)
            tilted = R[i, 0] * level * c + R[i, 1] * level * s - R[i, 2] * pull
            J[i, :, 9] = x[3 + i] * tilted
            for k in range(5):
                along = 2 * RADIUS * rate * self.slope[k] - pull * s * self.basis[k]
                across = RADIUS * self.bend[k] + pull * c * self.basis[k]
                J[i, :, 10 + k] = x[3 + i] * (R[i, 0] * along + R[i, 1] * across)
        return J.reshape(-1, 15)

    def _bench(self, x: Any) -> tuple[Any, Any, Any]:
        angle, rate = x[10:] @ self.basis, x[10:] @ self.slope
        pull = GRAVITY * np.sin(x[9])
        along = RADIUS * rate**2 + pull * np.cos(angle)
        across = RADIUS * (x[10:] @ self.bend) + pull * np.sin(angle)
        level = np.full_like(along, GRAVITY * np.cos(x[9]))
        return np.array([along, across, level]), angle, rate


def rotation(angles: Any) -> tuple[Any, list[Any]]:
    """R = Rx·Ry·Rz and its slope in each angle."""
    turns, slopes = [], []
    for axis, angle in enumerate(angles):
        K = np.cross(np.eye(3)[axis], np.eye(3)).T
        turn = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
        turns.append(turn)
        slopes.append(K @ turn)
    x, y, z = turns
    return x @ y @ z, [slopes[0] @ y @ z, x @ slopes[1] @ z, x @ y @ slopes[2]]


def record(count: int, seconds: float = 90.0, seed: int = 0) -> tuple[Any, Any]:
    """Times (N,) and noisy readings (N, 3) of the true wheel."""
    t = np.arange(count) * (seconds / count)
    empty = Wheel(t, np.zeros((count, 3)))
    v = empty.residual(TRUTH).reshape(3, -1).T
    return t, v + SIGMA * np.random.default_rng(seed).standard_normal(v.shape)


def vectorised(t: Any, v: Any) -> Any:
    """An nlpsol over CasADi's vector MX: ½‖r‖², exact Hessian, IPOPT's defaults."""
    x = ca.MX.sym("x", 15)
    wheel = Wheel(t, v)
    basis, slope, bend = (ca.DM(b.T) for b in (wheel.basis, wheel.slope, wheel.bend))
    angle, rate = ca.mtimes(basis, x[10:]), ca.mtimes(slope, x[10:])
    pull, level = GRAVITY * ca.sin(x[9]), GRAVITY * ca.cos(x[9])
    along = RADIUS * rate**2 + pull * ca.cos(angle)
    across = RADIUS * ca.mtimes(bend, x[10:]) + pull * ca.sin(angle)
    c, s = ca.cos(x[6:9]), ca.sin(x[6:9])
    rx = ca.blockcat([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    ry = ca.blockcat([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    rz = ca.blockcat([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    R = rx @ ry @ rz
    cost = 0
    for i in range(3):
        force = R[i, 0] * along + R[i, 1] * across + R[i, 2] * level
        cost += ca.sumsqr(x[i] + x[3 + i] * force - ca.DM(v[:, i])) / 2
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
    return ca.nlpsol("wheel", "ipopt", {"x": x, "f": cost}, options)
