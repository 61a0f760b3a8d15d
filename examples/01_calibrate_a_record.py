"""Calibrate a raw hand-held record: rest intervals, fit, certificate, corrected readings."""

from casest import Correction, calibrate, load_runs
from casest.demo import RECORD
from casest_problems.norm import norm_triangular

runs = load_runs(
    [RECORD],
    norm_triangular.signals,
    columns={"v": ("ax", "ay", "az")},
    rate=50,
    at_rest=True,
)
estimate = calibrate(norm_triangular.having(norm=9.80665), runs)

print(*estimate.certificate.reasons, sep="\n")
for name, value in estimate.values.items():
    print(name, value, "±", estimate.std[name], sep="\n")

corrected = Correction(estimate.model)(runs[0], estimate.values)
error = float(((corrected**2).sum(axis=1) ** 0.5 - 9.80665).std())
print(f"length of the corrected readings: 9.80665 m/s^2 within {error:.4f}")
assert error < 0.005
