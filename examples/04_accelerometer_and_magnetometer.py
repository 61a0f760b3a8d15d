"""An accelerometer and a magnetometer mounted askew, calibrated together: a heading to trust."""

import numpy as np

from casest import Correction, Run, calibrate
from casest_problems.pair import norm_pair

rng = np.random.default_rng(4)
turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
turn *= np.linalg.det(turn)  # how the magnetometer sits on the accelerometer
iron = turn + 0.1 * rng.standard_normal((3, 3))  # soft iron beside it


def poses(count: int, noisy: bool) -> tuple[Run, np.ndarray]:
    """Readings at rest, and the attitudes (x to magnetic north, z up); the field dips by 65°."""
    R = np.linalg.qr(rng.standard_normal((count, 3, 3)))[0]
    R *= np.linalg.det(R)[:, None, None]
    up, field = np.array([0, 0, 9.80665]), 48 * np.array([np.cos(1.13), 0, -np.sin(1.13)])
    noise = noisy * rng.standard_normal((2, count, 3))
    a = 1.01 * up @ R + [0.1, -0.2, 0.3] + 0.02 * noise[0]
    m = field @ R @ iron.T + [12, -30, 5] + 0.3 * noise[1]
    return Run.raw("poses", {"a": a, "m": m}, units={"a": "m/s^2", "m": "uT"}), R


estimate = calibrate(norm_pair.having(field=48.0), [poses(24, noisy=True)[0]])
print(estimate.certificate.reasons[0])
dip, spread = np.degrees([estimate.values["dip"], estimate.std["dip"]])
print(f"dip {dip:.2f} ± {spread:.2f}°, truth {np.degrees(1.13):.2f}°")

fresh, R = poses(200, noisy=False)
both = Correction(estimate.model)(fresh, estimate.values)
up, flux = both[:, :3] / 9.80665, both[:, 3:]
level = flux - np.sum(flux * up, axis=1, keepdims=True) * up
north = np.einsum("nij,nj->ni", R, level)
heading = np.degrees(np.arctan2(north[:, 1], north[:, 0]))
print(f"heading of 200 other poses: off by {heading.mean():.2f}°, scatter {heading.std():.2f}°")
assert abs(dip - np.degrees(1.13)) < 4 * spread
assert np.abs(heading).max() < 3
