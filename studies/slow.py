"""Does `calibrate` see a slow course in its residual, and only where there is one?

    make study-slow                     # some six minutes on one core
    python studies/slow.py --worlds 30  # fewer records of each kind

Two sensors from the independent simulators of the tests: a thermistor that lags behind its
reference, and a magnetometer beside a motor whose current was not recorded. Beside them the same
without lag or current, and a line through noise of ten kinds. The table is written to
`studies/slow.md`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "models")]

import simulators as sim  # noqa: E402
from scipy.signal import butter, lfilter  # noqa: E402
from scipy.stats import beta  # noqa: E402
from thermistor import thermistor  # noqa: E402

from casest import Model, Residual, Run, attempt, model, param, quantity, signal  # noqa: E402
from casest.diagnose.misfit.left import doubts  # noqa: E402
from casest_problems.norm import norm_triangular  # noqa: E402

TABLE = ROOT / "studies" / "slow.md"
#: Records of each kind, with and without something slow; samples of a line through noise.
PRESENT, ABSENT, LENGTHS = 100, 300, (400, 2000)
World = tuple[Model, Run]


@model
def line(x=signal("V"), y=signal("V"), *, zero=param("V"), gain=param()):
    """A line."""
    return Residual(measured=y, predicted=quantity("level", zero + gain * x, "V"))


def lagging(rng: np.random.Generator, n: int, lag: float, noise: float) -> World:
    """A thermistor read every second beside its reference; noise in K."""
    reference = sim.chamber(n, 1.0, rng)
    resistance = sim.thermistor(reference, 1.0, lag, rng, noise)
    signals = {"resistance": resistance[:, None], "reference": reference[:, None]}
    units = {"resistance": "ohm", "reference": "K"}
    return thermistor, Run.raw("thermistor", signals, units=units, time=np.arange(n) * 1.0)


def flying(rng: np.random.Generator, n: int, per_ampere: float) -> World:
    """A magnetometer in µT on a drone; the motors' current moves its offset."""
    M = np.diag(1 + rng.uniform(-0.05, 0.05, 3)) + np.tril(rng.uniform(-0.03, 0.03, (3, 3)), -1)
    sensor = sim.Sensor(M, rng.uniform(-10, 10, 3), 48.0)
    t, v, _ = sim.drone(sensor, per_ampere * sim.sphere(1, rng)[0], 0.3, rng, n)
    return norm_triangular.having(norm=48.0), Run.raw("drone", {"v": v}, units={"v": "uT"}, time=t)


def through(noise: Callable[[np.random.Generator, int], np.ndarray]) -> Callable[..., World]:
    """A line through noise, over an input that goes slowly up and down."""

    def world(rng: np.random.Generator, n: int) -> World:
        x = np.sin(2 * np.pi * (np.arange(n) / n * rng.uniform(1, 9) + rng.random()))
        y = 0.5 + 2 * x + noise(rng, n)
        signals = {"x": x[:, None], "y": y[:, None]}
        return line, Run.raw("line", signals, units={"x": "V", "y": "V"}, time=0.01 * np.arange(n))

    return world


def _filtered(b: object, a: object) -> Callable[[np.random.Generator, int], np.ndarray]:
    """White noise through a digital filter, without its beginning."""
    return lambda rng, n: np.asarray(lfilter(b, a, rng.standard_normal(n + 500)))[500:]


def _unequal(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.standard_normal(n) * np.exp(1.5 * np.sin(np.arange(n) / n * 20))


def _bursts(rng: np.random.Generator, n: int) -> np.ndarray:
    found = rng.standard_normal(n)
    for first in rng.integers(0, n, 5):
        found[first : first + n // 30] *= 4
    return found


def _outliers(rng: np.random.Generator, n: int) -> np.ndarray:
    far = rng.choice([-1, 1], n) * rng.uniform(10, 20, n)
    return np.where(rng.random(n) < 0.005, far, rng.standard_normal(n))


def _pink(rng: np.random.Generator, n: int) -> np.ndarray:
    frequency = np.maximum(np.fft.rfftfreq(n), 1 / n)
    spectrum = np.fft.rfft(rng.standard_normal(n)) / np.sqrt(frequency)
    return np.asarray(np.fft.irfft(spectrum, n))


def _walk(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.cumsum(0.05 * rng.standard_normal(n)) + rng.standard_normal(n)


#: Colour, tails and inequality; τ is the memory in samples.
NOISE = {
    "white": lambda rng, n: rng.standard_normal(n),
    "AR(1), 0.6": _filtered([1.0], [1.0, -0.6]),
    "AR(1), −0.5": _filtered([1.0], [1.0, 0.5]),
    "low-pass, τ = 3": _filtered([1.0], [1.0, -np.exp(-1 / 3)]),
    "low-pass of second order, a twentieth of the rate": _filtered(*butter(2, 0.1)),
    "running mean of 10": _filtered(np.ones(10), [1.0]),
    "Student's t (3)": lambda rng, n: rng.standard_t(3, n),
    "unequal": _unequal,
    "bursts": _bursts,
    "outliers": _outliers,
}
SLOW_NOISE = {"pink": _pink, "random walk beside white noise": _walk}


def worlds() -> Iterator[tuple[str, str, int, Callable[[np.random.Generator], World]]]:
    """Group, words, records of it, and what makes one."""
    for lag, noise, n in ((8, 0.05, 4000), (8, 0.3, 4000), (2, 0.05, 1000), (8, 0.05, 300)):
        words = f"thermistor, lag {lag} s, noise {noise:g} K, {n} samples"
        yield "slow", words, PRESENT, lambda rng, n=n, a=lag, b=noise: lagging(rng, n, a, b)
    for size in (0.05, 0.3):
        words = f"magnetometer, {size:g} µT/A, 4000 samples"
        yield "slow", words, PRESENT, lambda rng, size=size: flying(rng, 4000, size)
    for name, noise in SLOW_NOISE.items():
        for n in LENGTHS:
            made = through(noise)
            words = f"line, {name}, {n} samples"
            yield "wanders", words, PRESENT, lambda rng, n=n, made=made: made(rng, n)
    yield (
        "noise",
        "thermistor without lag, 1000 samples",
        PRESENT,
        lambda r: lagging(r, 1000, 0, 0.05),
    )
    yield (
        "noise",
        "magnetometer without current, 4000 samples",
        PRESENT,
        lambda r: flying(r, 4000, 0.0),
    )
    for name, noise in NOISE.items():
        made = through(noise)
        words = f"line, {name}, {' and '.join(map(str, LENGTHS))} samples"
        yield "noise", words, ABSENT, lambda rng, made=made: made(rng, int(rng.choice(LENGTHS)))


def judged(make: Callable[[np.random.Generator], World], count: int, key: str) -> dict[str, float]:
    """How often there is an answer, a doubt, one by the slow course alone; neighbours' kinship."""
    asked = doubted = slow = 0
    kinship = []
    for seed in range(count):
        declared, run = make(np.random.default_rng([seed, *key.encode()]))
        estimate = attempt(declared, [run])
        found = doubts(estimate)
        if found is None:  # a refused estimate claims nothing
            continue
        asked, doubted = asked + 1, doubted + bool(found)
        slow += any("slow course" in f.where for f in found)
        (r,) = estimate.problem.residuals(estimate.point)
        kinship.append(float(np.corrcoef(r[1:, 0], r[:-1, 0])[0, 1]))
    return {"asked": asked, "doubted": doubted, "slow": slow, "kinship": float(np.median(kinship))}


def table(rows: list[tuple[str, str, dict[str, float]]]) -> str:
    """Markdown: of trusted estimates, how many residuals are said to be no noise."""
    lines = [
        "# Slow courses in the residual of a calibration",
        "",
        "Made by `make study-slow`: `casest calibrate` on records from independent simulators. Of",
        "the trusted estimates, how many are said to have a residual that is not noise, and how",
        "many of these by the test for a slow course alone. The correlation of neighbours in the",
        "residual is the median.",
        "",
    ]
    titles = {
        "slow": "Something slow is missing: it must be said",
        "wanders": "Noise that wanders: a slow course of unknown cause, rightly said",
        "noise": "Nothing is missing: at most 1 % may be said",
    }
    for group, title in titles.items():
        lines += [f"## {title}", ""]
        lines += ["| record | neighbours | trusted | not noise | by the slow course alone |"]
        lines += ["| --- | --- | --- | --- | --- |"]
        own = [(words, r) for g, words, r in rows if g == group]
        for words, r in own:
            lines.append(
                f"| {words} | {r['kinship']:.2f} | {r['asked']} | {r['doubted']} | {r['slow']} |"
            )
        if group == "noise":
            asked, said, slow = (
                int(sum(r[k] for _, r in own)) for k in ("asked", "doubted", "slow")
            )
            bound = beta.ppf(0.95, said + 1, asked - said)
            share = f"{said}: {100 * said / asked:.2f} %, below {100 * bound:.2f} % (95 %)"
            lines.append(f"| all | | {asked} | {share} | {slow} |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Make all records, write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=ABSENT, help="records of each kind, at most")
    most = parser.parse_args().worlds
    rows = []
    for group, words, count, make in worlds():
        rows.append((group, words, judged(make, min(count, most), words)))
        print(words, rows[-1][2], flush=True)
    TABLE.write_text(table(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
