"""When does a flight tell gravity from the accelerometer's bias? When its axis of turn moves."""

import numpy as np

import casest as c
from casest.results.observability import observe_motion
from casest_problems.bias_gravity import bias_gravity

t = np.arange(0, 60, 0.02)
zero = np.zeros_like(t)
turns = {
    "straight": np.column_stack([zero, zero, zero]),
    "about one axis": np.column_stack([0.1 * np.sin(t), 0.2 * np.sin(t), 0.2 * np.sin(t)]),
    "about all axes": np.column_stack([0.3 * np.sin(0.2 * t), 0.3 * np.cos(0.3 * t), zero + 0.2]),
}
units = {"a": "m/s^2", "omega": "rad/s", "v": "m/s"}
ranks = {}
for name, omega in turns.items():
    signals = {"a": np.tile([0.0, 0.0, -9.81], (len(t), 1)), "omega": omega, "v": 0 * omega}
    seen = observe_motion(bias_gravity, c.Run.raw(name, signals, units=units, time=t))
    ranks[name] = seen.rank
    print(f"{name}: rank {seen.rank} of {seen.unknowns}", *seen.unobservable, sep="\n  ")

# Batista et al., theorems 1 and 2.
assert ranks == {"straight": 6, "about one axis": 8, "about all axes": 9}
