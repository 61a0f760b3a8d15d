"""Accelerometer bias and gravity, estimated in motion.

P. Batista, C. Silvestre, P. Oliveira, B. Cardeira, "Accelerometer Calibration and Dynamic Bias and
Gravity Estimation: Analysis, Design, and Experimental Evaluation", eq. (7), with the known input
B·a_m that the printed filter omits. Everything in body axes; a = v̇ + ω×v − g + b.
"""

from __future__ import annotations

from casest import cross, signal
from casest.dynamics import Motion, dynamics, measured, state


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
    rates = {
        "velocity": a - cross(omega, velocity) + gravity - bias,
        "gravity": -cross(omega, gravity),
    }
    return Motion(rates=rates, outputs=(measured(v, velocity, intensity=0.1),))


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
        "velocity": a - cross(omega, velocity) + gravity - bias,
        "gravity": -cross(omega, gravity),
    }
    return Motion(rates=rates, outputs=(measured(p, position, intensity=0.1),))
