"""Any sensor, any motion, any start: how often is the answer right, and never wrongly trusted?

    python studies/random_starts.py            # 1000 random records of each model
    python studies/random_starts.py --quick    # 60 of each
    python studies/random_starts.py --only wheel

Each record is fitted twice: from the automatic start, and from values drawn far away and given as
the user's. An answer is right if every parameter lies within six standard deviations of the truth:
the printed ones, or those of the known noise where there are fewer than FEW degrees of freedom, for
then Student's t is often beyond six. Each record is kept in `out/random_starts.jsonl`, so that an
interrupted study goes on where it stopped; the table is written to `studies/random_starts.md`. Data
come from the tests' simulators, which share no code with the models.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import bodies  # noqa: E402
import resumed  # noqa: E402
import simulators as sim  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from casest import CasestError, Run, attempt  # noqa: E402
from casest.results.find import find_model  # noqa: E402

KEPT, TABLE = ROOT / "out" / "random_starts.jsonl", ROOT / "studies" / "random_starts.md"
MODELS = ("wheel", "rate-table", "norm-diagonal", "norm-triangular", "norm-pair")
STARTS, VERDICTS = ("automatic", "given"), ("right", "wrong", "refused")
#: Standard deviations within which every parameter of a right answer lies.
FAR = 6.0
#: Degrees of freedom below which they are those of the known noise.
FEW = 100
COUNT, QUICK = 1000, 60


# -- random records, with the truth behind them ----------------------------------------------------


def general_mounting(rng: np.random.Generator) -> np.ndarray:
    """A rotation none of whose entries is small: every axis feels all that the wheel does."""
    while True:
        R = sim.random_rotation(rng)
        if np.abs(R).min() > 0.15:
            return R


def falling_speed(rng: np.random.Generator, seconds: float) -> np.ndarray:
    """Cubic speed law (4,) within 2 and 20 rad/s that keeps 12 to 85 % of the first speed."""
    while True:
        first = rng.uniform(3, 20)
        last = first * rng.uniform(0.12, 0.85)
        x = np.linspace(0, 1, 50)
        law = np.polynomial.polynomial.polyfit(x, first * (last / first) ** x, 3)
        rates = np.polynomial.polynomial.polyval(x, law)
        if rates.min() >= 2 and rates.max() <= 20:
            return rng.choice([-1, 1]) * law / seconds ** np.arange(4)


def smaller_offset(truth: dict, turn: np.ndarray) -> bool:
    """Of the two directions of spin that give the same readings, is this the conventional one?"""
    axle = truth["gain"] * turn[:, 2] * sim.GRAVITY * np.cos(truth["tilt"])
    return bool(np.linalg.norm(truth["offset"]) < np.linalg.norm(truth["offset"] + 2 * axle))


def random_wheel(rng: np.random.Generator) -> tuple[Run, dict, float]:
    seconds, rate = rng.uniform(30, 90), rng.uniform(50, 200)
    while True:
        turn = general_mounting(rng)
        truth = {
            "offset": rng.uniform(-2, 2, 3),
            "gain": rng.uniform(0.8, 1.2, 3),
            "misalignment": Rotation.from_matrix(turn).as_euler("XYZ"),
            "tilt": np.radians(rng.uniform(15, 75)),
            "phase": rng.uniform(-np.pi, np.pi),
            "speed": falling_speed(rng, seconds),
        }
        if smaller_offset(truth, turn):
            break
    t = np.arange(0, seconds, 1 / rate)
    bench = sim.Spin(truth["offset"], truth["gain"], turn, truth["tilt"])
    v = bench.read(*sim.cubic_motion(t, truth["phase"], truth["speed"]))
    sigma = np.exp(rng.uniform(np.log(0.01), np.log(0.5)))
    v = v + sigma * rng.standard_normal(v.shape)
    units = {"t": "s", "v": "m/s^2"}
    return Run.raw("wheel", {"t": t[:, None], "v": v}, units=units, time=t), truth, sigma


def random_table(rng: np.random.Generator) -> tuple[Run, dict, float]:
    truth = {
        "inverse_scale": np.diag(rng.uniform(0.9, 1.1, 3)) + rng.uniform(-0.03, 0.03, (3, 3)),
        "quadratic": rng.uniform(-3e-4, 3e-4, 3),
        "bias": rng.uniform(-0.2, 0.2, 3),
        "gravity_direction": sim.sphere(1, rng)[0],
    }
    if rng.random() < 0.5:  # on the floor or under the ceiling, nearly level
        level = np.array([0.0, 0.0, rng.choice([-1.0, 1.0])]) + 0.02 * rng.standard_normal(3)
        truth["gravity_direction"] = level / np.linalg.norm(level)
    t, R = sim.table_steps(int(rng.integers(20, 61)), rng, sampled=0.2)
    sigma = np.exp(rng.uniform(np.log(1e-3), np.log(2e-2)))
    a, _ = sim.table_readings(
        R,
        truth["gravity_direction"],
        truth["inverse_scale"],
        truth["quadratic"],
        truth["bias"],
        sigma,
        rng,
    )
    signals = {"a": a, "attitude": R.reshape(-1, 9)}
    return Run.raw("table", signals, units={"a": "m/s^2", "attitude": None}, time=t), truth, sigma


def random_poses(rng: np.random.Generator, skew: bool) -> tuple[Run, dict, float]:
    """Poses of a sensor of any unit: the size of its readings over several orders."""
    size = np.exp(rng.uniform(np.log(1e-2), np.log(1e4)))
    M = np.diag(rng.uniform(0.7, 1.4, 3))
    if skew:
        M += np.tril(rng.uniform(-0.1, 0.1, (3, 3)), -1)
    offset = 0.3 * rng.uniform() ** (1 / 3) * sim.sphere(1, rng)[0]
    sensor = sim.Sensor(size * M / sim.GRAVITY, size * offset, sim.GRAVITY)
    sigma = size * np.exp(rng.uniform(np.log(1e-4), np.log(1e-2)))
    v = sensor.read(sim.spread_poses(int(rng.integers(12, 31)), rng), sigma, rng)
    scale = sensor.scale if skew else np.diag(sensor.scale)
    truth = {"scale": scale, "offset": sensor.b}
    return Run.raw("poses", {"v": v}, units={"v": None}), truth, sigma


def random_body(rng: np.random.Generator) -> tuple[Run, dict, float]:
    """Accelerometer and magnetometer, turned by any angle against each other."""
    body = bodies.Body(rng, rng.uniform(0, np.pi))
    poses = bodies.attitudes(int(rng.integers(16, 31)), rng)
    louder = np.exp(rng.uniform(np.log(0.1), np.log(2)))
    noise = (louder * bodies.NOISE[0], louder * bodies.NOISE[1])
    return body.record(poses, rng, noise), body.truth, noise[0]


def simulated(name: str, rng: np.random.Generator) -> tuple[Run, dict, float]:
    """One record of a model, the truth behind it, and the noise of its residuals."""
    if name == "wheel":
        return random_wheel(rng)
    if name == "rate-table":
        return random_table(rng)
    if name == "norm-pair":
        return random_body(rng)
    return random_poses(rng, name == "norm-triangular")


# -- starts far away, as a user might give them ----------------------------------------------------


def far_start(name: str, truth: dict, rng: np.random.Generator) -> dict:
    """Values for every parameter, drawn without regard to where the truth is, but for the speed."""
    if name == "wheel":
        wrong = 1 + rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(0.01), np.log(0.3)))
        return {
            "offset": rng.uniform(-5, 5, 3),
            "gain": rng.uniform(0.5, 2, 3),
            "misalignment": Rotation.from_matrix(sim.random_rotation(rng)).as_euler("XYZ"),
            "tilt": np.radians(rng.uniform(5, 85)),
            "phase": rng.uniform(-np.pi, np.pi),
            "speed": rng.choice([-1, 1]) * wrong * truth["speed"],
        }
    if name == "rate-table":
        return {
            "inverse_scale": sim.random_rotation(rng) @ np.diag(rng.uniform(0.5, 2, 3)),
            "quadratic": rng.uniform(-1e-3, 1e-3, 3),
            "bias": rng.uniform(-5, 5, 3),
            "gravity_direction": sim.sphere(1, rng)[0],
        }
    if name == "norm-pair":
        accelerometer = far_norm(truth["accelerometer_scale"], rng)
        return {
            "accelerometer_scale": accelerometer["scale"],
            "accelerometer_offset": accelerometer["offset"],
            "magnetometer_scale": sim.random_rotation(rng) @ np.diag(rng.uniform(0.5, 2, 3)),
            "magnetometer_offset": rng.uniform(-0.6, 0.6, 3) * bodies.FIELD,
            "dip": rng.uniform(-1.3, 1.3),
        }
    return far_norm(truth["scale"], rng)


def far_norm(scale: np.ndarray, rng: np.random.Generator) -> dict:
    """A scale (3,) or (3, 3) wrong by a factor of two on each axis, an offset anywhere near."""
    diagonal = scale if scale.ndim == 1 else np.diag(scale)
    offset = sim.GRAVITY / np.mean(diagonal) * rng.uniform(-0.6, 0.6, 3)
    stretched = diagonal * rng.uniform(0.5, 2, 3)
    if scale.ndim == 1:
        return {"scale": stretched, "offset": offset}
    skew = np.tril(rng.uniform(-0.5, 0.5, (3, 3)), -1) * np.mean(diagonal)
    return {"scale": np.diag(stretched) + skew, "offset": offset}


# -- one record, fitted from both starts -----------------------------------------------------------


def distance(found, truth: dict, sigma: float) -> float:
    """The parameter furthest from the truth, in standard deviations."""
    worst, noise = 0.0, found.noise
    known = sigma / noise.sigma if noise.degrees_of_freedom < FEW else 1.0
    for key, true in truth.items():
        error, std = np.ravel(found.values[key] - true), known * np.ravel(found.std[key])
        if key in ("phase", "misalignment"):
            error = np.angle(np.exp(1j * error))
        if key == "gravity_direction":  # on the sphere: the angle, against the larger deviation
            error, std = np.array([np.linalg.norm(error)]), np.array([np.linalg.norm(std)])
        free = std != 0  # zeros above a triangular matrix's diagonal are no unknowns
        away = np.abs(error[free]) / std[free]
        worst = max(worst, float(np.max(np.where(np.isfinite(away), away, np.inf))))
    return worst


def verdict(model, run: Run, truth: dict, sigma: float, start: dict | None) -> dict:
    """What came of one fit."""
    began = time.perf_counter()
    try:
        found = attempt(model, [run], start=start)
    except CasestError as error:
        return {"verdict": "refused", "why": str(error), "seconds": time.perf_counter() - began}
    kept = {"seconds": time.perf_counter() - began, "distance": distance(found, truth, sigma)}
    if not found.certificate.trusted:
        return kept | {"verdict": "refused", "why": found.certificate.reasons[0]}
    return kept | {"verdict": "right" if kept["distance"] < FAR else "wrong"}


def one_record(name: str, seed: int) -> dict:
    """Both fits of one random record."""
    rng = np.random.default_rng([MODELS.index(name), seed])
    run, truth, sigma = simulated(name, rng)
    model = find_model(name)
    if name == "norm-pair":
        model = model.having(field=bodies.FIELD)
    elif name.startswith("norm"):
        model = model.having(norm=sim.GRAVITY)
    given = far_start(name, truth, rng)
    return {
        "model": name,
        "seed": seed,
        "automatic": verdict(model, run, truth, sigma, None),
        "given": verdict(model, run, truth, sigma, given),
    }


# -- all of them -----------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} records of each model")
    parser.add_argument("--only", choices=MODELS, metavar="MODEL", help="one model alone")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    records = resumed.kept(KEPT)
    done = {(r["model"], r["seed"]) for r in records}
    models = [options.only] if options.only else MODELS
    tasks = [(m, seed) for seed in range(QUICK if options.quick else COUNT) for m in models]
    left = [task for task in tasks if task not in done]
    print(f"{len(tasks)} records, {len(left)} to do")
    records += resumed.done(one_record, left, KEPT, options.workers)
    TABLE.write_text(table(records), encoding="utf-8")
    print(f"written: {TABLE}")


def table(records: list[dict]) -> str:
    """Markdown: a row per model and start; then why fits were refused, and what was wrong."""
    lines = [
        "# Any sensor, any motion, any start",
        "",
        "Made by `python studies/random_starts.py`. Random sensors and motions in general",
        "position, each fitted from the automatic start and from values drawn far away and given",
        f"as the user's. Right: trusted, and every parameter within {FAR:g} standard deviations of",
        f"the truth (the printed ones; those of the known noise below {FEW} degrees of freedom).",
        "",
        "| model | start | records | trusted and right | trusted and wrong | refused "
        "| median time |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for model in MODELS:
        own = [r for r in records if r["model"] == model]
        lines += [_row(model, start, own) for start in STARTS if own]
    return "\n".join([*lines, "", *_reasons(records), *_worst(records), ""])


def _row(model: str, start: str, own: list[dict]) -> str:
    counts = Counter(r[start]["verdict"] for r in own)
    seconds = 1e3 * np.median([r[start]["seconds"] for r in own])
    cells = " | ".join(str(counts[v]) for v in VERDICTS)
    return f"| {model} | {start} | {len(own)} | {cells} | {seconds:.0f} ms |"


def _reasons(records: list[dict]) -> list[str]:
    """How often each reason was given, with numbers and names left out."""
    lines = ["| model | start | refused because | times |", "| --- | --- | --- | --- |"]
    found = Counter(
        (r["model"], start, r[start]["why"].split(":")[0].split("(")[0].strip())
        for r in records
        for start in STARTS
        if r[start]["verdict"] == "refused"
    )
    lines += [f"| {m} | {s} | {why} | {n} |" for (m, s, why), n in sorted(found.items())]
    return [*lines, ""] if found else ["Nothing was refused.", ""]


def _worst(records: list[dict]) -> list[str]:
    """The records whose answers were trusted and wrong, by seed."""
    return [
        f"* {r['model']}, seed {r['seed']}, {start} start: trusted and "
        f"{r[start]['distance']:.3g} standard deviations off"
        for r in records
        for start in STARTS
        if r[start]["verdict"] == "wrong"
    ]


if __name__ == "__main__":
    main()
