"""Whole IMUs turned by hand: does every 95 % interval hold the truth, and how long does it take?

Run `python studies/imu.py` (`make study-imu`). Every record is made by the tests' simulator
(quaternions, tests/imus.py), with sensors, poses, turns and noise of its own; calibrated by `imu`
or `gyro-rests`, it is compared with the truth. Then measured records: the five MPU-9150 of
shared/data, each turn foretold by a fit that has not seen it. What was done is kept in
`out/imu.jsonl`, so that an interrupted study goes on where it stopped; the table is written to
`studies/imu.md`.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import imus  # noqa: E402
import resumed  # noqa: E402

from casest import Run, attempt, load_runs  # noqa: E402
from casest.data import at_rest  # noqa: E402
from casest.results.find import find_model  # noqa: E402

KEPT, TABLE = ROOT / "out" / "imu.jsonl", ROOT / "studies" / "imu.md"
SHARED = Path(os.environ.get("CASEST_DATA", ROOT.parent / "shared" / "data"))
DATA = SHARED / "mpu9150-mikoff"
UNITS = {"a": "m/s^2", "w": "rad/s", "m": "uT"}
FIELD, DIP = 48.0, 1.1
#: World -> model, what its sensors have besides, how its motion is, and how many records.
WORLDS: dict[str, tuple[str, dict[str, Any], dict[str, Any], int]] = {
    "gyro-rests": ("gyro-rests", {"walk": 2e-4, "late": 0.004}, {}, 1000),
    "imu": ("imu", {"walk": 2e-4, "late": 0.004}, {}, 1000),
    "gyro-rests, no drift, one clock": ("gyro-rests", {}, {}, 200),
    "imu, 48 rests": ("imu", {"walk": 2e-4, "late": 0.004}, {"rests": 48}, 50),
}
SIMULATED = """\
# Whole IMUs turned by hand

Made by `make study-imu`. 24 rests (48 where it says so) of two seconds, turns of 70 to 150
degrees in a second and a half about axes that wobble, readings at 100 Hz with noises of 0.02
m/s², 0.003 rad/s and 0.3 µT; scales off by 2 % (10 % of the magnetometer), axes by some
degrees. But where it says so, the gyroscope's offset walks by 0.0002 rad/s in a second (0.002
in the whole record, ten times what a rest's mean is uncertain by), and its readings are 4 ms
older than their time. Coverage of the 95 % intervals over all numbers, with the error of that share
over records; and of the parameters that are covered least and most, over all their entries (the
one number of 34 that is covered least in 58 records is at 88 % by chance alone, and at 83 % once
in a hundred times); errors over standard deviations, root mean square (of Student's t with 15
degrees of freedom 1.07); processor time for one record."""
MEASURED = """\
## Five MPU-9150 (mikoff/imu-calib)

Angle by which a turn misses the next rest, root mean square over the turns, degrees: with the
factory's scale (only the offset found), after the fit, and each turn foretold by a fit that has not
seen it."""
UNITS_OF_A_LOG = {"a": "m/s^2", "w": "rad/s"}


def simulated(world: str, seed: int) -> dict[str, Any]:
    """One record made, calibrated and compared with its truth."""
    name, sensors, motion, _ = WORLDS[world]
    rng = np.random.default_rng([seed, list(WORLDS).index(world)])
    imu = imus.an_imu(rng, **sensors)
    record = imus.recorded(imus.waved(rng, **motion), imu, rng, field_=FIELD, dip=DIP)
    declared = find_model(name)
    signals = {s.name: record[s.name] for s in declared.signals}
    began = time.process_time()
    run = at_rest(Run.raw("imu", signals, units=UNITS, time=record["t"]), wanders=["w"])
    if "field" in declared.symbols:
        declared = declared.having(field=FIELD)
    found = attempt(declared, [run])
    seconds = time.process_time() - began
    assert run.averaged is not None
    noises = {c.name: float(c.array) for c in found.model.constants if "_noise" in c.name}
    rests = zip(run.averaged.first, run.averaged.last, strict=True)
    drifted = np.mean([record["drift"][i : j + 1].mean(axis=0) for i, j in rests], axis=0)
    imu.gyroscope_bias = imu.gyroscope_bias + drifted  # the offset of the whole record
    truth, (below, above) = {**imu.truth, "dip": np.array(DIP)}, found.interval_reach
    parts = {}
    for n, value in found.values.items():
        free = (found.std[n] > 0) | (value != truth[n])
        away = (value - truth[n])[free]
        parts[n] = {
            "z": (away / found.std[n][free]).tolist(),
            "held": ((away <= below[n][free]) & (-away <= above[n][free])).tolist(),
        }
    return {
        "world": world,
        "seed": seed,
        "trusted": found.certificate.trusted,
        "seconds": seconds,
        "rests": len(run),
        "noises": noises,
        "parameters": parts,
    }


# -- measured records ------------------------------------------------------------------------------


def turn_errors(values: dict[str, Any], run: Run) -> np.ndarray:
    """Angle in degrees by which each turn misses the next rest, by quaternions."""
    raw, first, last = run.averaged.run, run.averaged.first, run.averaged.last
    force = (run.signals["a"] - values["accelerometer_offset"]) @ values["accelerometer_scale"].T
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    rate = (raw.signals["w"] - values["gyroscope_offset"]) @ values["gyroscope_scale"].T
    found = []
    for k in range(1, len(run)):
        q = np.array([1.0, 0, 0, 0])
        for i in range(last[k - 1], first[k]):
            turn = 0.5 * (rate[i] + rate[i + 1]) * (raw.time[i + 1] - raw.time[i])
            angle = max(float(np.linalg.norm(turn)), 1e-12)
            q = imus.product(q, imus.about(turn / angle, np.array(angle)))
        cosine = imus.into_body(q, up[k - 1]) @ up[k]
        found.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return np.array(found)


def without(run: Run, turn: int) -> Run:
    """The run with a gap in the middle of one turn, so that it says nothing."""
    raw = run.averaged.run
    middle = (run.averaged.last[turn] + run.averaged.first[turn + 1]) // 2
    block = (np.arange(len(raw)) > middle).astype(int)
    return replace(run, averaged=replace(run.averaged, run=replace(raw, block=block)))


def measured(unit: str) -> dict[str, Any]:
    """One MPU-9150: how far turns are missed as the gyroscope is, and foretold by the others."""
    declared = find_model("gyro-rests")
    (run,) = load_runs(
        [DATA / f"{unit}.log"],
        declared.signals,
        columns={"a": ("0", "1", "2"), "w": ("3", "4", "5")},
        units=UNITS_OF_A_LOG,
        rate=100,
        at_rest=True,
    )
    began = time.process_time()
    found = attempt(declared, [run])
    seconds = time.process_time() - began
    as_it_is = {**found.values, "gyroscope_scale": np.eye(3)}
    left_out = []
    for k in range(len(run) - 1):
        apart = attempt(declared, [without(run, k)], intervals=False)
        left_out.append(float(turn_errors(apart.values, run)[k]))
    return {
        "world": "measured",
        "seed": unit,
        "trusted": found.certificate.trusted,
        "seconds": seconds,
        "rests": len(run),
        "before": turn_errors(as_it_is, run).tolist(),
        "fit": turn_errors(found.values, run).tolist(),
        "left_out": left_out,
    }


# -- the table -------------------------------------------------------------------------------------


def rms(x: Any) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def table(records: list[dict[str, Any]]) -> str:
    lines = [
        *SIMULATED.splitlines(),
        "",
        "| world | records | trusted | coverage | least | most | error/std | seconds |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for world in WORLDS:
        own = [r for r in records if r["world"] == world]
        good = [r for r in own if r["trusted"]]
        if good:
            lines.append(_row(world, own, good))
    lines += [
        "",
        *MEASURED.splitlines(),
        "",
        "| unit | rests | trusted | factory | fit | left out | seconds |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for r in sorted((r for r in records if r["world"] == "measured"), key=lambda r: r["seed"]):
        lines.append(
            f"| {r['seed']} | {r['rests']} | {'yes' if r['trusted'] else 'no'} "
            f"| {rms(r['before']):.2f} | {rms(r['fit']):.3f} | {rms(r['left_out']):.3f} "
            f"| {r['seconds']:.1f} |"
        )
    return "\n".join([*lines, ""])


def _row(world: str, own: list[dict[str, Any]], good: list[dict[str, Any]]) -> str:
    each = {n: np.array([r["parameters"][n]["held"] for r in good]) for n in good[0]["parameters"]}
    every = np.hstack([held.reshape(len(good), -1) for held in each.values()])
    share, own_error = every.mean(), every.mean(axis=1).std() / np.sqrt(len(good))
    shares = {n: held.mean() for n, held in each.items()}
    least, most = min(shares, key=shares.__getitem__), max(shares, key=shares.__getitem__)
    z = np.concatenate([p["z"] for r in good for p in r["parameters"].values()])
    seconds = np.median([r["seconds"] for r in own])
    ends = " | ".join(f"{100 * shares[n]:.1f} % ({n})" for n in (least, most))
    return (
        f"| {world} | {len(own)} | {len(good)} | {100 * share:.1f} ± {100 * own_error:.1f} % "
        f"| {ends} | {rms(z):.2f} | {seconds:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--share", type=float, default=1.0, help="of the records of each world")
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    records = resumed.kept(KEPT)
    there = {(r["world"], r["seed"]) for r in records}
    tasks = [
        (world, seed)
        for world, (*_, count) in WORLDS.items()
        for seed in range(max(int(count * chosen.share), 1))
    ]
    left = [task for task in tasks if task not in there]
    units = [(f"imu{k}",) for k in range(5) if ("measured", f"imu{k}") not in there]
    print(f"{len(tasks)} records, {len(left)} to do; {len(units)} measured units to do")
    left.sort(key=lambda task: task[1])  # all worlds alike, wherever it is interrupted
    records += resumed.done(simulated, left, KEPT, chosen.workers)
    records += resumed.done(measured, units, KEPT, chosen.workers)
    TABLE.write_text(table(records), encoding="utf-8")
    print(f"written: {TABLE}")


if __name__ == "__main__":
    main()
