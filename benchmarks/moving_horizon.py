"""Time of one step of a moving horizon of 40 on a pendulum, friction and squared rate unknown.

Run `python benchmarks/moving_horizon.py`: medians over a record, after its first 100 samples; where
no bound acts, and with a bound on the angle that always does at the turning points. do-mpc's
estimator (IPOPT, collocation) takes 64 ms a step on a pendulum with the same horizon.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casest import Run, param, signal, sin
from casest.dynamics import Dynamics, Motion, dynamics, measured, moving_horizon, state


def pendulum(highest: float) -> Dynamics:
    """A pendulum whose angle stays below `highest`, rad."""

    @dynamics
    def swing(
        y=signal("rad"),
        *,
        angle=state("rad", start=0.9, std=0.5, bounds=(None, highest)),
        rate=state("rad/s", intensity=0.01),
        w2=param("1/s^2", start=30, bounds=(0, None)),
        friction=param("1/s", start=0.1, bounds=(0, None)),
    ):
        rates = {"angle": rate, "rate": -w2 * sin(angle) - friction * rate}
        return Motion(rates=rates, outputs=(measured(y, angle, std=0.05),))

    return swing


def main() -> None:
    """Print medians."""
    t = np.arange(0, 10, 0.02)
    swung = solve_ivp(
        lambda s, x: [x[1], -25 * np.sin(x[0]) - 0.05 * x[1]],
        (0, 10), [1.0, 0], "DOP853", t, rtol=1e-10, atol=1e-10,
    )  # fmt: skip
    y = swung.y[0] + 0.05 * np.random.default_rng(0).standard_normal(len(t))
    run = Run.raw("swing", {"y": y[:, None]}, units={"y": "rad"}, time=t)
    for what, highest in (("no bound acts", np.inf), ("a bound acts", 0.9)):
        found = moving_horizon(pendulum(highest), run, 40)
        seconds, rounds = found.seconds[100:], found.rounds[100:]
        acting = np.mean(found.multipliers[:, 1, 0] > 0)
        print(
            f"{what:<14} median {1e3 * np.median(seconds):.1f} ms a step, 95 % below "
            f"{1e3 * np.quantile(seconds, 0.95):.1f} ms, {np.mean(rounds):.1f} rounds, bound "
            f"active at {100 * acting:.0f} % of samples"
        )


if __name__ == "__main__":
    main()
