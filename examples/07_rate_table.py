"""A rate table on a floor that nobody levelled, and the correction in closed form."""

import numpy as np
from scipy.spatial.transform import Rotation

from casest import Correction, Run, calibrate
from casest_problems.rate_table import rate_table

rng = np.random.default_rng(2)
attitudes = Rotation.random(40, random_state=3).as_matrix().repeat(200, axis=0)
down = np.array([0.01, -0.02, 1.0]) / np.linalg.norm([0.01, -0.02, 1.0])
force = -9.80665 * np.einsum("nji,j->ni", attitudes, down)
scale = np.array([[0.990, 0.001, -0.002], [0.020, 1.005, 0.003], [-0.010, -0.004, 1.010]])
bent = force + 1e-4 * np.array([2.5, 1.5, -0.75]) * force**2 + np.array([0.05, -0.01, 0.04])
a = np.linalg.solve(scale, bent.T).T + 0.0013 * rng.standard_normal(force.shape)

signals = {"a": a, "attitude": attitudes.reshape(-1, 9)}
run = Run.raw("table", signals, units={"a": "m/s^2", "attitude": None})
found = calibrate(rate_table, [run])
print("down in the table's frame:", found.values["gravity_direction"], "true:", down)
print("quadratic:", found.values["quadratic"], "±", found.std["quadratic"], "1/(m/s^2)")

corrected = Correction(found.model)(run, found.values)
error = np.abs(corrected.reshape(40, 200, 3).mean(axis=1) - force[::200]).max()
print(f"largest error of the corrected force, averaged in each attitude: {error:.1e} m/s^2")
assert error < 1e-3
