"""A compass on a body whose attitude is recorded by another instrument: which of them is late?"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import casest as c
from casest.effects import signal_lag
from casest.results.find import find_effects, find_model

declared = Path(__file__).with_name("compass.py")
compass, (soft_iron,) = find_model(str(declared)), find_effects(str(declared))
rng = np.random.default_rng(1)
earth, hard = np.array([21.0, 1.0, -43.0]), np.array([6.0, -2.0, 9.0])
iron = np.array([[1.02, 0.01, 0.0], [-0.02, 0.99, 0.03], [0.0, 0.01, 0.99]])


def attitude(t: np.ndarray) -> np.ndarray:
    """Waved about by hand, body to ground."""
    angles = [2 * np.sin(0.9 * t), 0.9 * np.sin(1.6 * t), 1.3 * np.cos(1.1 * t)]
    return Rotation.from_euler("ZYX", np.transpose(angles)).as_matrix()


# The compass answers 70 ms later than the cameras see it, at 25 samples a second.
t = np.arange(0, 60, 0.04)
m = np.einsum("nij,i->nj", attitude(t - 0.07), earth) @ iron.T + hard
signals = {"m": m + 0.3 * rng.standard_normal(m.shape), "attitude": attitude(t).reshape(-1, 9)}
run = c.Run.raw("waved", signals, units={"m": "uT"}, time=t)

for model in (compass, compass.with_effect(soft_iron)):
    for tried in (model, model.with_effect(signal_lag, on="attitude")):
        found = c.calibrate(tried, [run])
        error = np.sqrt(np.mean(found.problem.residuals(found.point)[0] ** 2))
        print([effect.label for effect in tried.effects], f"{error:.2f} uT")

delay, std = (part["signal_lag(attitude).delay"] for part in (found.values, found.std))
print(f"late by {1000 * delay:.1f} ± {1000 * std:.1f} ms, truth 70 ms")
assert abs(delay - 0.07) < 4 * std
assert np.abs(found.values["hard"] - hard).max() < 0.2
