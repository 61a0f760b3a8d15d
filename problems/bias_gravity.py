"""Accelerometer bias and gravity, estimated in motion.

P. Batista, C. Silvestre, P. Oliveira, B. Cardeira, "Accelerometer Calibration and Dynamic Bias and
Gravity Estimation: Analysis, Design, and Experimental Evaluation", eq. (7), with the known input
B·a_m that the printed filter omits. Everything in body axes; a = v̇ + ω×v − g + b.
"""

from __future__ import annotations

from typing import Any

from casest import constant, cross, norm_2, signal
from casest.dynamics import Motion, constraint, dynamics, measured, state


@dynamics
def bias_gravity(
    a=signal(3, "m/s^2"),
    omega=signal(3, "rad/s"),
    v=signal(3, "m/s"),
    *,
    velocity=state(3, "m/s", intensity=1e-3, std=1.0),
    gravity=state(3, "m/s^2", intensity=1e-4, start=(0.0, 0.0, 9.80665), std=10.0),
    bias=state(3, "m/s^2", intensity=1e-5, std=1.0),
):
    """Velocity, gravity and accelerometer bias from velocity readings (Batista, eq. 7).

    Published intensities: Ξ = diag(1e-3, 1e-4, 1e-5), Θ = 0.1.
    """
    rates = _rates(a, omega, velocity, gravity, bias)
    return Motion(rates=rates, outputs=(measured(v, velocity, intensity=0.1),))


@dynamics
def bias_gravity_magnitude(
    a=signal(3, "m/s^2"),
    omega=signal(3, "rad/s"),
    v=signal(3, "m/s"),
    *,
    velocity=state(3, "m/s", intensity=1e-3, std=1.0),
    gravity=state(3, "m/s^2", intensity=1e-4, start=(0.0, 0.0, 9.80665), std=10.0),
    bias=state(3, "m/s^2", intensity=1e-5, std=1.0),
    gravity_magnitude=constant(9.80665, "m/s^2"),
):
    """The same where the magnitude of gravity is known: ‖gravity‖ = gravity_magnitude."""
    rates = _rates(a, omega, velocity, gravity, bias)
    known = constraint(norm_2(gravity), gravity_magnitude)
    outputs = (measured(v, velocity, intensity=0.1),)
    return Motion(rates=rates, outputs=outputs, constraints=(known,))


@dynamics
def bias_gravity_position(
    a=signal(3, "m/s^2"),
    omega=signal(3, "rad/s"),
    p=signal(3, "m"),
    *,
    position=state(3, "m", std=10.0),
    velocity=state(3, "m/s", intensity=1e-3, std=1.0),
    gravity=state(3, "m/s^2", intensity=1e-4, start=(0.0, 0.0, 9.80665), std=10.0),
    bias=state(3, "m/s^2", intensity=1e-5, std=1.0),
):
    """The same with position readings, in body axes (Batista, remark before eq. 7)."""
    rates = {
        "position": velocity - cross(omega, position),
        **_rates(a, omega, velocity, gravity, bias),
    }
    return Motion(rates=rates, outputs=(measured(p, position, intensity=0.1),))


def _rates(a: Any, omega: Any, velocity: Any, gravity: Any, bias: Any) -> dict[str, Any]:
    return {
        "velocity": a - cross(omega, velocity) + gravity - bias,
        "gravity": -cross(omega, gravity),
    }
