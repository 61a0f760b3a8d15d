"""A hand-spun wheel, once per mounting: what one record hides, two records show."""

import numpy as np
from scipy.spatial.transform import Rotation

from casest import NotTrusted, Run, calibrate
from casest_problems.wheel import wheel

rng = np.random.default_rng(1)


def spun(mounting: tuple[float, float, float], sigma: float = 0.05) -> Run:
    """Readings of a real sensor on a wheel of 0.29 m, tilted by 45°, slowing down for a minute."""
    t = np.arange(0, 60, 0.01)
    angle = 0.5 + 9 * t - 0.045 * t**2 + 1.5e-4 * t**3
    rate, change = 9 - 0.09 * t + 4.5e-4 * t**2, -0.09 + 9e-4 * t
    down = 9.80665 * np.sqrt(0.5)
    a = [0.29 * rate**2 + down * np.cos(angle), 0.29 * change + down * np.sin(angle), down + 0 * t]
    force = Rotation.from_euler("XYZ", mounting, degrees=True).apply(np.transpose(a))
    v = np.array([0.4, -0.3, 0.2]) + np.array([0.98, 1.01, 1.03]) * force
    v += sigma * rng.standard_normal(v.shape)
    return Run.raw(f"{mounting}", {"t": t[:, None], "v": v}, units={"v": "m/s^2"}, time=t)


one, other = spun((30, 20, 25)), spun((-20, 35, 140))
unknown_radius = wheel.freed("radius")
try:
    calibrate(unknown_radius, [one])
except NotTrusted as error:
    print("one mounting:", *error.estimate.certificate.reasons, sep="\n  ")

both = calibrate(unknown_radius, [one, other])
print("two mountings: radius", both.values["radius"], "±", both.std["radius"], "m")
assert abs(both.values["radius"] - 0.29) < 4 * both.std["radius"]
