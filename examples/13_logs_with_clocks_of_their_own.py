"""An accelerometer at 400 Hz and a position at 5 Hz, in two logs: filtered as they are."""

import numpy as np

import casest as c
from casest import signal
from casest.dynamics import Motion, dynamics, filtered, measured, state


@dynamics
def sledge(
    a=signal("m/s^2"),
    x=signal("m"),
    *,
    position=state("m", std=10.0),
    velocity=state("m/s", std=2.0, intensity=1e-6),
    bias=state("m/s^2", std=0.5),
):
    """On rails: an accelerometer with a bias, a position now and then."""
    rates = {"position": velocity, "velocity": a - bias}
    return Motion(rates=rates, outputs=(measured(x, position, std=0.3),))


rng = np.random.default_rng(0)
fast, slow = np.arange(0, 60, 0.0025), np.sort(rng.uniform(0, 60, 300))
a = 0.8 * np.sin(0.7 * fast) + 0.1 + 0.02 * rng.standard_normal(len(fast))
x = 0.8 / 0.7 * slow - 0.8 / 0.49 * np.sin(0.7 * slow) + 0.3 * rng.standard_normal(len(slow))
for name, columns, head in (
    ("imu", (fast, a), "t [s],a [m/s^2]"),
    ("gps", (slow, x), "t [s],x [m]"),
):
    np.savetxt(f"{name}.csv", np.transpose(columns), delimiter=",", header=head, comments="")

(run,) = c.load_runs(["imu.csv+gps.csv"], sledge.signals, gaps=["x"], between=["a"])
found = filtered(sledge, run)
bias, std = found.smoothed[-1, 2], found.smoothed_std[-1, 2]
print(f"{len(run)} samples; bias {bias:.4f} ± {std:.4f} m/s^2 (true 0.1)")
assert abs(bias - 0.1) < 3 * std
