"""The same sensor in poses that cover too little: what the data cannot see, in words."""

import numpy as np

from casest import NotTrusted, Run, calibrate
from casest_problems.norm import norm_full, norm_triangular

rng = np.random.default_rng(1)


def turned(directions: np.ndarray) -> Run:
    """Readings in m/s^2 of an ideal sensor with a little noise, one per direction."""
    directions = directions / np.linalg.norm(directions, axis=1)[:, None]
    v = 9.80665 * directions + 0.002 * rng.standard_normal(directions.shape)
    return Run.raw("poses", {"v": v}, units={"v": "m/s^2"})


everywhere = turned(rng.standard_normal((24, 3)))
one_axis = turned(np.c_[rng.standard_normal((24, 2)), np.zeros(24)])
refused = 0
for model, run in ((norm_triangular, one_axis), (norm_full, everywhere)):
    try:
        calibrate(model.having(norm=9.80665), [run])
    except NotTrusted as error:
        refused += 1
        print(f"{model.name}:", *error.estimate.certificate.reasons, sep="\n  ")

assert refused == 2
assert calibrate(norm_triangular.having(norm=9.80665), [everywhere]).certificate.trusted
