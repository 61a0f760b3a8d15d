"""An IMU and a magnetometer in continuous motion, on the simulation of Huang, Hendeby & Skog.

    python studies/mag_imu.py         # make study-mag-imu
    python studies/mag_imu.py --table

Their simulation (arXiv 2505.16662, and the code that its authors publish, by which everything here
is set): six turns of a full circle at 0.1 rad/s, jerked by 0.05 rad/s from sample to sample, of a
body that stays where it is; what each sensor is wrong by is drawn anew for every record. The
gyroscope reads the mean rate until its next reading. Records are ours, by SciPy's rotations; their
figures are those of their `results_freq.mat`, of ten records. The estimator is declared below in
a few lines. Each record is kept in `out/mag_imu.jsonl`; the table is `studies/mag_imu.md`.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from resumed import done, kept
from scipy.spatial.transform import Rotation

from casest import Run, cross, signal, vertcat
from casest.dynamics import Motion, dynamics, measured, state
from casest.dynamics.filter import filtered

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
KEPT, TABLE = ROOT / "out" / "mag_imu.jsonl", ROOT / "studies" / "mag_imu.md"
#: Noise densities of accelerometer, gyroscope and magnetometer, a reading's times √(1/Hz).
DENSITY = {"a": 0.02, "w": 8.7e-4, "m": 0.003}
GRAVITY, FIELD = 9.8, 27.0
#: Their figures: rate in Hz -> root mean square errors of joint MAP, ML and EKF.
PUBLISHED = {
    10: {
        "a": (0.00245, 0.0152, 0.00272),
        "w": (9.89e-5, 2.28e-4, 1.04e-4),
        "offset": (5.47e-4, 1.22e-3, 0.0474),
        "D": (0.0138, 0.138, 0.141),
    },
    80: {
        "a": (0.00225, 0.0222, 0.00282),
        "w": (8.23e-5, 2.41e-4, 1.09e-4),
        "offset": (5.38e-4, 2.08e-3, 0.075),
        "D": (0.0131, 0.219, 0.185),
    },
}
COUNTS, FIRST = {10: 40, 80: 10}, 95_000


@dynamics
def mag_imu(
    a=signal(3, "m/s^2"),
    m=signal(3, "uT"),
    w=signal(3, "rad/s", held=True),
    *,
    gravity=state(3, "m/s^2", start=(0.0, 0.0, 9.8), std=5.0),
    field=state(3, "uT", start=(0.0, 10.0, -25.0), std=15.0),
    iron=state(8, "1", start=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), std=0.3),
    offset=state(3, "uT", std=2.0),
    drift=state(3, "rad/s", start=(0.01, 0.01, 0.01), std=0.002),
    bias=state(3, "m/s^2", std=0.5),
):
    """`mag-gyro` with an accelerometer: gravity keeps still as the field does."""
    rows = (vertcat(1, iron[0:2]), iron[2:5], iron[5:8])
    seen = vertcat(*[row.T @ field for row in rows])
    return Motion(
        rates={"field": -cross(w - drift, field), "gravity": -cross(w - drift, gravity)},
        outputs=(measured(m, seen + offset), measured(a, gravity + bias)),
    )


def moved(rate: int, rng: np.random.Generator) -> tuple[Rotation, Array]:
    """Attitudes (N,), and the rates (N, 3) at which the body turns from each to the next."""
    turns = []
    for axis in [*np.eye(3).tolist(), [1, 1, 0], [1, 0, 1], [0, 1, 1]]:
        steady = 0.1 * np.array(axis, float)
        count = int(np.ceil(2 * np.pi / np.linalg.norm(steady) * rate))
        turns.append(steady + 0.05 * rng.standard_normal((count, 3)))
    rates = np.concatenate(turns)
    there, found = Rotation.identity(), [Rotation.identity()]
    for step in Rotation.from_rotvec(rates / rate):
        there = there * step
        found.append(there)
    return Rotation.concatenate(found[:-1]), rates


def sensor(rng: np.random.Generator) -> dict[str, Array]:
    """What a sensor is wrong by: D (3, 3) µT, offset µT, bias m/s², drift rad/s, and the dip."""
    skew = np.radians(10) * rng.uniform(-1, 1, 3)
    bent = np.array(
        [
            [1, 0, 0],
            [np.sin(skew[0]), np.cos(skew[0]), 0],
            [
                -np.sin(skew[1]),
                np.cos(skew[1]) * np.sin(skew[2]),
                np.cos(skew[1]) * np.cos(skew[2]),
            ],
        ]
    )
    turned = Rotation.from_euler("XYZ", 5 * rng.uniform(-1, 1, 3), degrees=True).as_matrix()
    return {
        "D": FIELD * np.diag(1 + 0.1 * rng.uniform(-1, 1, 3)) @ bent @ turned,
        "offset": 2 * rng.uniform(-1, 1, 3),
        "a": 0.5 * rng.uniform(-1, 1, 3),
        "w": 0.01 + np.radians(0.1) * rng.uniform(-1, 1, 3),
        "dip": np.radians(72 + 5 * rng.uniform(-1, 1)),
    }


def one(rate: int, seed: int) -> dict[str, Any]:
    """A record, calibrated: errors, and what lies outside by how many standard deviations."""
    rng = np.random.default_rng(seed)
    truth, (attitude, rates) = sensor(rng), moved(rate, rng)
    into, noise = attitude.inv(), rng.standard_normal((3, len(rates), 3)) * np.sqrt(rate)
    north = np.array([0.0, np.cos(truth["dip"]), -np.sin(truth["dip"])])
    read = {
        "a": into.apply([0.0, 0.0, GRAVITY]) + truth["a"] + DENSITY["a"] * noise[0],
        "m": into.apply(north) @ truth["D"].T + truth["offset"] + DENSITY["m"] * noise[1],
        "w": rates + truth["w"] + DENSITY["w"] * noise[2],
    }
    units = {"a": "m/s^2", "m": "uT", "w": "rad/s"}
    run = Run.raw("turned", read, units=units, time=np.arange(len(rates)) / rate)
    began = time.process_time()
    found = filtered(mag_imu.sensing(**{n: d**2 for n, d in DENSITY.items()}), run)
    seconds = time.process_time() - began
    x, P = found.end  # the smoother's, where it has settled
    std = np.sqrt(np.diag(P))
    iron = np.array([1.0, *x[6:14]]).reshape(3, 3)
    D = iron * np.linalg.norm(x[3:6])
    constants = [
        *(truth["D"] / truth["D"][0, 0]).ravel()[1:],
        *truth["offset"],
        *truth["w"],
        *truth["a"],
    ]
    own = {"D": D, "offset": x[14:17], "w": x[17:20], "a": x[20:23]}
    return {
        "rate": rate,
        "seed": seed,
        "squares": {n: float(np.sum((v - truth[n]) ** 2)) for n, v in own.items()},
        "off": ((x[6:] - constants) / std[6:]).tolist(),
        "settled": bool(found.settled),
        "seconds": seconds,
    }


def line(rate: int, rows: list[dict[str, Any]]) -> str:
    """Root mean square errors, beside theirs, and coverage."""
    off = np.abs([r["off"] for r in rows])
    told = []
    for name in ("offset", "D", "w", "a"):
        error = np.sqrt(np.mean([r["squares"][name] for r in rows]))
        told.append(" / ".join([f"**{error:.3g}**", *map("{:.3g}".format, PUBLISHED[rate][name])]))
    seconds = np.median([r["seconds"] for r in rows])
    coverage, settled = np.mean(off < 1.959964), sum(r["settled"] for r in rows)
    return (
        f"| {rate} | {len(rows)} | {' | '.join(told)} | {coverage:.1%} of {off.size} "
        f"| {settled} | {seconds:.2g} |"
    )


PAGE = """# An IMU and a magnetometer, turned without rests

Made by `make study-mag-imu` (`python studies/mag_imu.py`), on the simulation of Huang, Hendeby &
Skog (arXiv 2505.16662), made anew by the code that they publish. Root mean square errors:
**casest** / their joint MAP / ML / extended Kalman filter, each as they publish it, of ten records
of theirs. `D` is what the magnetometer makes of a field of length one, `offset` its hard iron;
coverage is of casest's 95 % intervals of the 17 constants.

| Hz | records | offset, µT | D, µT | gyroscope's bias, rad/s | accelerometer's bias, m/s² | \
coverage | settled | processor s |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
{rows}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--records", type=int, help="of each rate")
    parser.add_argument("--table", action="store_true", help="of what is there so far")
    options = parser.parse_args()
    there = kept(KEPT)
    made = {(r["rate"], r["seed"]) for r in there}
    every = [(f, FIRST + k) for f, n in COUNTS.items() for k in range(options.records or n)]
    if not options.table:
        there += done(one, [case for case in every if case not in made], KEPT, options.workers)
    rows = [line(f, own) for f in COUNTS if (own := [r for r in there if r["rate"] == f])]
    page = PAGE.format(rows="\n".join(rows))
    TABLE.write_text(page, encoding="utf-8")
    print(page)


if __name__ == "__main__":
    main()
