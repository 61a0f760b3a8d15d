"""Magnetometer and gyroscope in continuous motion, beside MAGYC on the simulation it describes.

    pip install magyc                 # 1.0.0 with GTSAM; without it its columns are left out
    python studies/mag_gyro.py        # make study-mag-gyro
    python studies/mag_gyro.py --table

Rodríguez-Martínez & Troni's simulation (arXiv 2410.13827; the library's `simulated_data.md`): 600
s at 10 Hz of a vehicle that sways in roll, pitch and heading, 10 mG and 10 mrad/s of white noise.
Their records are not at hand: these are ours by their description, by SciPy's rotations, which
share no code with the estimator. Each is kept in `out/mag_gyro.jsonl`; the table is
`studies/mag_gyro.md`. Also measured: BROAD's trials 01 and 26, against the attitude by cameras.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from resumed import done, kept
from scipy.linalg import eigvalsh, sqrtm
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from casest import Run
from casest.dynamics.filter import Filtered, filtered
from casest_problems.mag_gyro import mag_gyro

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
KEPT, TABLE = ROOT / "out" / "mag_gyro.jsonl", ROOT / "studies" / "mag_gyro.md"
DATA = Path(os.environ.get("CASEST_DATA", ROOT.parent / "shared" / "data")) / "broad"
RATE, SAMPLES, MG, RAD_S = 10.0, 6000, 10.0, 0.010
#: Amplitudes of roll, pitch and heading in degrees.
MOTIONS = {"wide": (5, 45, 360), "mid": (5, 5, 360), "low": (5, 45, 90), "tiny": (5, 5, 90)}
IRON = np.array([[1.10, 0.10, 0.04], [0.10, 0.88, 0.02], [0.04, 0.02, 1.22]])
OFFSET, DRIFT = np.array([20.0, 120.0, 90.0]), np.array([0.004, -0.005, 0.002])
EARTH = np.array([227.207, 51.796, 411.731])
COUNT, FIRST = 40, 90_000


def record(motion: str, seed: int) -> tuple[Array, Array, Array]:
    """Times (N,), readings of the magnetometer in mG and of the gyroscope in rad/s (N, 3)."""
    rng = np.random.default_rng(seed)
    swing, phase = np.radians(MOTIONS[motion]), rng.uniform(-np.pi, np.pi, 3)
    speed = rng.uniform([0.05, 0.1, 0.2], [0.08, 0.3, 0.4])

    def attitude(at: Array) -> Rotation:
        angles = swing * np.sin(speed / swing * at[:, None] + phase)
        return Rotation.from_euler("ZYX", angles[:, ::-1])

    t, h = np.arange(SAMPLES) / RATE, 1e-3
    rate = (attitude(t - h).inv() * attitude(t + h)).as_rotvec() / (2 * h)
    noise = rng.standard_normal((2, SAMPLES, 3))
    readings = attitude(t).inv().apply(EARTH) @ IRON.T + OFFSET + MG * noise[0]
    return t, readings, rate + DRIFT + RAD_S * noise[1]


def by_casest(t: Array, m: Array, w: Array, std: tuple[float, float]) -> Filtered:
    """The most probable course; readings in µT (1 mG is 0.1 µT)."""
    run = Run.raw("moved", {"m": m, "w": w}, units={"m": "uT", "w": "rad/s"}, time=t)
    step = float(np.median(np.diff(t)))
    still = mag_gyro.driven(drift=0.0)  # as the simulation has it
    return filtered(still.sensing(m=std[0] ** 2 * step, w=std[1] ** 2 * step), run)


def parts(x: Array) -> tuple[Array, Array, Array]:
    """Iron (3, 3), offset and drift of a state."""
    return np.array([1.0, *x[3:11]]).reshape(3, 3), x[11:14], x[14:]


def apart(iron: Array) -> float:
    """From the true soft iron, of volume one, along the geodesic of positive matrices, as MAGYC's
    authors measure it; of an iron that turns as well its positive part."""
    pair = [np.real(sqrtm(A @ A.T)) for A in (iron, IRON)]
    a, b = (A / np.linalg.det(A) ** (1 / 3) for A in pair)
    return float(np.sqrt(np.sum(np.log(eigvalsh(a, b)) ** 2)))


def errors(iron: Array, offset: Array, drift: Array, seconds: float) -> dict[str, float]:
    """Of one way: mG, mrad/s, s of the processor."""
    return {
        "offset": float(np.linalg.norm(offset - OFFSET)),
        "iron": apart(iron),
        "drift": 1e3 * float(np.linalg.norm(drift - DRIFT)),
        "seconds": seconds,
    }


def one(motion: str, seed: int) -> dict[str, Any]:
    """A record of each kind, calibrated both ways."""
    t, m, w = record(motion, seed)
    began = time.process_time()
    found = by_casest(t, 0.1 * m, w, (0.1 * MG, RAD_S))
    seconds = time.process_time() - began
    x = found.smoothed[-1]
    iron, offset, drift = parts(x)
    truth = [*(IRON / IRON[0, 0]).ravel()[1:], *(0.1 * OFFSET), *DRIFT]
    off = (x[3:] - truth) / np.sqrt(np.diag(found.smoothed_P[-1])[3:])
    kept = {
        "motion": motion,
        "seed": seed,
        "casest": errors(iron, 10 * offset, drift, seconds),
        "off": off.tolist(),
        "settled": bool(found.settled),
        "nis": float(np.nanmean(found.normalised_innovations[SAMPLES // 2 :]) / 3),
    }
    return kept | ({"magyc": by_magyc(t, m, w)} if find_spec("magyc") else {})


def by_magyc(t: Array, m: Array, w: Array) -> dict[str, float]:
    """Their batch factor graph, smoothed beforehand and in windows of a second as their notebook
    does."""
    from magyc import magyc_bfg

    smooth = [savgol_filter(x, 50, 2, axis=0) for x in (1e-3 * m, w)]
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        offset, iron, drift, *_ = magyc_bfg(*smooth, t[:, None], int(RATE))
    seconds = time.process_time() - began
    return errors(np.array(iron), 1e3 * np.ravel(offset), np.ravel(drift), seconds)


def measured(trial: str) -> str:
    """A line of the table: BROAD's trial by the gyroscope, and by the cameras' attitude."""
    rows = np.genfromtxt(DATA / f"mag{trial}.csv", delimiter=",", skip_header=1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    t, m, q, w = rows[:, 0], rows[:, 1:4], rows[:, 4:8], rows[:, 11:14]
    found = by_casest(t, m, w, (1.0, 0.1))
    iron, offset, _ = parts(found.smoothed[-1])
    seen, hard = by_attitude(m, Rotation.from_quat(q[:, [1, 2, 3, 0]]))
    std = np.sqrt(np.diag(found.smoothed_P[-1]))[11:14]
    return (
        f"| {trial} | {np.round(offset, 2).tolist()} ± {np.round(std, 2).tolist()} "
        f"| {np.round(hard, 2).tolist()} | {np.abs(iron - seen).max():.3f} |"
    )


def by_attitude(m: Array, attitude: Rotation) -> tuple[Array, Array]:
    """Iron (3, 3) with one in the corner and offset, where the attitude is known: iron and the
    field in turn by linear least squares."""
    turned, earth = attitude.inv().as_matrix(), np.array([1.0, 0.0, -1.0])
    for _ in range(300):
        rows = np.column_stack([turned @ earth, np.ones(len(m))])
        solved = np.linalg.lstsq(rows, m, rcond=None)[0]
        iron, offset = solved[:3].T, solved[3]
        earth = np.linalg.lstsq((iron @ turned).reshape(-1, 3), (m - offset).ravel(), rcond=None)[0]
    return iron / iron[0, 0], offset


def line(motion: str, rows: list[dict[str, Any]]) -> str:
    """Medians of the errors, how often an interval of 95 % holds the truth."""
    off = np.abs([r["off"] for r in rows])
    said = f"{np.mean(off < 1.959964):.1%} of {off.size}"

    def median(way: str, what: str) -> str:
        own = [r[way][what] for r in rows if way in r]
        return f"{np.median(own):.3g}" if own else "–"

    both = " | ".join(
        f"{median('casest', what)} / {median('magyc', what)}"
        for what in ("offset", "iron", "drift", "seconds")
    )
    settled = sum(r["settled"] for r in rows)
    nis = np.mean([r["nis"] for r in rows])
    return f"| {motion} {MOTIONS[motion]} | {len(rows)} | {both} | {said} | {settled} | {nis:.2f} |"


PAGE = """# A magnetometer and a gyroscope, moved without rests

Made by `make study-mag-gyro` (`python studies/mag_gyro.py`). `mag-gyro` beside MAGYC 1.0.0 (batch
factor graph, as its authors' notebook calls it) on the simulation that they describe: 600 s at 10
Hz, 10 mG and 10 mrad/s of noise. Their records and the figures in their paper were not at hand;
these records are ours, made by their description. Medians, casest / MAGYC (of fewer records, since
one may take it minutes); coverage is of casest's 95 % intervals of the {unknowns} constants; NIS of
the filter along its own states, one expected.

| roll, pitch, heading ± deg | records (with MAGYC) | hard iron, mG | soft iron, geodesic | \
gyroscope's bias, mrad/s | processor s | coverage | settled | NIS |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
{rows}

## Measured

BROAD's magnetometer and gyroscope (every tenth sample, 28.6 Hz), noises taken for 1 µT and 0.1
rad/s (what lies between samples of a quick hand), against a fit with the cameras' attitude, which
the estimator does not see.

| trial | offset by the gyroscope, µT | by the cameras' attitude | iron apart at most |
| --- | --- | --- | --- |
{measured}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=COUNT)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="of what is there so far")
    options = parser.parse_args()
    there = kept(KEPT)
    made = {(r["motion"], r["seed"]) for r in there}
    every = [(m, FIRST + k) for k in range(options.records) for m in MOTIONS]
    left = [case for case in every if case not in made]
    if not options.table:
        there += done(one, left, KEPT, options.workers)
    rows = [line(m, own) for m in MOTIONS if (own := [r for r in there if r["motion"] == m])]
    told = [measured(trial) for trial in ("01", "26")] if DATA.is_dir() else ["| – | – | – | – |"]
    page = PAGE.format(unknowns=14, rows="\n".join(rows), measured="\n".join(told))
    TABLE.write_text(page, encoding="utf-8")
    print(page)


if __name__ == "__main__":
    main()
