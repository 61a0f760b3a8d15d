"""Do the printed intervals hold the truth as often as they say? Standard deviations by simulation.

    make study-coverage       # python studies/coverage.py: minutes
    python studies/coverage.py --fits 200 --only wheel

Each row is a model and a noise of its own, made by plain NumPy (`tests/simulators.py`); every
unknown of every fit counts once. The z-score is (estimate - truth) / printed standard deviation.
Fits are kept in `out/coverage.jsonl`, so that an interrupted study goes on where it stopped; the
table is written to `studies/coverage.md`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import resumed  # noqa: E402
import simulators as sim  # noqa: E402
import worlds  # noqa: E402
from scipy.signal import lfilter  # noqa: E402

from casest import (  # noqa: E402
    Model,
    Residual,
    Run,
    attempt,
    exp,
    model,
    param,
    quantity,
    signal,
)
from casest.effects.noise import outliers  # noqa: E402
from casest.results.find import find_model  # noqa: E402

KEPT, TABLE = ROOT / "out" / "coverage.jsonl", ROOT / "studies" / "coverage.md"
#: Fits of each row in the table; those of the study begin at this seed.
FITS, FIRST = 2000, 40_000

Drawn = tuple[Model, Run, dict[str, Any]]


@model
def line(x=signal(), y=signal(), *, a=param(start=0.0), b=param(start=0.0)):
    return Residual(measured=y, predicted=quantity("reading", a + b * x))


@model
def decay(x=signal(), y=signal(), *, a=param(start=1.0), rate=param(start=1.0), c=param()):
    return Residual(measured=y, predicted=quantity("reading", c + a * exp(-rate * x)))


@model
def rest(v=signal(3), *, level=param(3)):
    return Residual(measured=v, predicted=level)


Size = Callable[[Any], Any]
#: Standard deviation of the noise over the input, 0 to 1.
SAME: Size = lambda x: np.ones_like(x)  # noqa: E731
GROWING: Size = lambda x: 0.3 + x  # noqa: E731
ENDS: Size = lambda x: 0.4 + np.abs(2 * x - 1) ** 2  # noqa: E731


def lines(n: int, size: Size) -> Callable[[np.random.Generator], Drawn]:
    """Rows of a table at random places."""

    def drawn(rng: np.random.Generator) -> Drawn:
        x = rng.uniform(0, 1, n)
        y = 1 + 2 * x + 0.1 * size(x) * rng.standard_normal(n)
        return (
            line,
            Run.raw("line", {"x": x[:, None], "y": y[:, None]}, units={}),
            {"a": 1.0, "b": 2.0},
        )

    return drawn


def slow(
    n: int, memory: float, *, spikes: float = 0.0, timed: bool = True, smooth: bool = False
) -> Callable[[np.random.Generator], Drawn]:
    """A slow input; of the noise 0.6 is forgotten as exp(−k/memory), or is `smooth`: that averaged
    once more alike; the rest is white, and a share of the readings is thirty times as far off."""

    def drawn(rng: np.random.Generator) -> Drawn:
        t = np.arange(n)
        x = np.sin(2 * np.pi * 2.5 * t / n + 0.3) + 0.3 * np.sin(2 * np.pi * t / 23)
        kept = np.exp(-1 / memory)
        kicks = rng.standard_normal(n) * np.sqrt(1 - kept**2)
        kicks[0] = rng.standard_normal()
        course = lfilter([1], [1, -kept], kicks)
        if smooth:
            long = lfilter([1], [1, -kept], rng.standard_normal(n + 40 * int(memory)))
            course = lfilter([1], [1, -kept], long)[-n:] * np.sqrt(
                (1 - kept**2) ** 3 / (1 + kept**2)
            )
        noise = np.sqrt(0.6) * course
        noise += np.sqrt(0.4) * rng.standard_normal(n) + 30 * (rng.random(n) < spikes)
        signals = {"x": x[:, None], "y": (1 + 2 * x + 0.1 * noise)[:, None]}
        run = Run.raw("slow", signals, units={}, time=0.01 * t if timed else None)
        declared = line.with_effect(outliers) if spikes else line
        return declared, run, {"a": 1.0, "b": 2.0}

    return drawn


def rests(n: int, memory: float) -> Callable[[np.random.Generator], Drawn]:
    """Three axes at rest, of which the second is three times as noisy."""

    def drawn(rng: np.random.Generator) -> Drawn:
        kept, level = np.exp(-1 / memory), np.array([5.0, -1.0, 0.2])
        noise = lfilter([1], [1, -kept], rng.standard_normal((n, 3)), axis=0)
        v = level + 0.01 * noise * [1.0, 3.0, 1.0]
        run = Run.raw("rest", {"v": v}, units={}, time=0.02 * np.arange(n))
        return rest, run, {"level": level}

    return drawn


def decays(n: int, size: Size) -> Callable[[np.random.Generator], Drawn]:
    """A curve with a rate."""

    def drawn(rng: np.random.Generator) -> Drawn:
        x = np.linspace(0, 3, n)
        y = 0.5 + 2 * np.exp(-1.5 * x) + 0.02 * size(x / 3) * rng.standard_normal(n)
        run = Run.raw("decay", {"x": x[:, None], "y": y[:, None]}, units={})
        return decay, run, {"a": 2.0, "rate": 1.5, "c": 0.5}

    return drawn


def wheels(kind: str, seconds: float, rate: float) -> Callable[[np.random.Generator], Drawn]:
    """A hand-spun wheel."""

    def drawn(rng: np.random.Generator) -> Drawn:
        world = worlds.made("wheel", [int(rng.integers(2**31))], {}, seconds=seconds, rate=rate,
                            kind=kind)  # fmt: skip
        return _declared(world)

    return drawn


def norms(kind: str, poses: int) -> Callable[[np.random.Generator], Drawn]:
    """Poses held by hand, each the mean of a rest."""

    def drawn(rng: np.random.Generator) -> Drawn:
        world = worlds.made("norm", [int(rng.integers(2**31))], {}, poses=poses, kind=kind)
        return _declared(world)

    return drawn


def _declared(world: worlds.World) -> Drawn:
    found = find_model(world.model)
    if world.model.startswith("norm"):
        found = found.having(norm=sim.GRAVITY)
    run = Run.raw("record", dict(world.signals), units=dict(world.units), time=world.time)
    return found, run, dict(world.truth)


ROWS: dict[str, Callable[[np.random.Generator], Drawn]] = {
    "line, 24 rows, equal noise": lines(24, SAME),
    "line, 24 rows, noise grows": lines(24, GROWING),
    "line, 24 rows, noise at the ends": lines(24, ENDS),
    "line, 200 rows, equal noise": lines(200, SAME),
    "line, 200 rows, noise grows": lines(200, GROWING),
    "line, 200 rows, noise at the ends": lines(200, ENDS),
    "decay, 40 rows, equal noise": decays(40, SAME),
    "decay, 40 rows, noise grows": decays(40, GROWING),
    "norm, 24 poses, equal noise": norms("white", 24),
    "norm, 72 poses, equal noise": norms("white", 72),
    "norm, 72 poses, unequal noise": norms("unequal", 72),
    "line, 200 samples, memory of 50": slow(200, 50),
    "line, 1000 samples, memory of 50": slow(1000, 50),
    "line, 16 000 samples, memory of 50": slow(16_000, 50),
    "line, 1000 samples, smooth, memory of 30": slow(1000, 30, smooth=True),
    "line, 4000 samples, smooth, memory of 100": slow(4000, 100, smooth=True),
    "line, 300 rows without a time, memory of 8": slow(300, 8, timed=False),
    "line, 90 rows without a time, memory of 8": slow(90, 8, timed=False),
    "line, 90 samples, memory of 8": slow(90, 8),
    "line, 40 rows without a time, memory of 8": slow(40, 8, timed=False),
    "line, 200 samples, memory of 50, outliers": slow(200, 50, spikes=0.01),
    "line, 4000 samples, memory of 50, outliers": slow(4000, 50, spikes=0.01),
    "three axes at rest, 6000 samples, memory of 25": rests(6000, 25),
    "wheel, 12 s, white noise": wheels("white", 12.0, 50.0),
    "wheel, 12 s, AR(1) of 0.6": wheels("ar1", 12.0, 50.0),
    "wheel, 24 s, AR(1) of 0.6": wheels("ar1", 24.0, 100.0),
}


def one(name: str, seed: int) -> dict[str, Any]:
    """z-scores of every unknown, and how many intervals hold the truth."""
    chosen, run, truth = ROWS[name](np.random.default_rng([seed, *name.encode()]))
    found = attempt(chosen, [run])
    record: dict[str, Any] = {"row": name, "seed": seed, "trusted": found.certificate.trusted}
    if not found.certificate.trusted:
        return record | {"why": found.certificate.reasons[0]}
    below, above = found.interval_reach
    z, held = [], []
    for key, true in truth.items():
        std, off = np.ravel(found.std[key]), np.ravel(found.values[key] - true)
        free = (std > 0) | (off != 0)  # the zeros of a triangular scale are no unknowns
        z += list(off[free] / std[free])
        inside = (off <= np.ravel(below[key])) & (-off <= np.ravel(above[key]))
        held += list(inside[free])
    return record | {"z": [float(v) for v in z], "held": int(np.sum(held))}


HEAD = """# Coverage of the printed intervals

Made by `make study-coverage` (`python studies/coverage.py`): how many of the 95 % intervals hold
the truth, pooled over all unknowns, and the rms of the z-scores (1, and a little more where few
rows say how large the noise is). Refused fits print no intervals.

| what | fits | refused | intervals | held, % | ± | rms z |
| --- | --- | --- | --- | --- | --- | --- |"""


def table(records: Sequence[dict[str, Any]]) -> str:
    """One line a row."""
    lines = [HEAD]
    for name in ROWS:
        own = [r for r in records if r["row"] == name]
        told = [r for r in own if r["trusted"]]
        if not told:
            continue
        z = np.concatenate([r["z"] for r in told])
        held = 100 * np.array([r["held"] / len(r["z"]) for r in told])
        error = held.std() / np.sqrt(len(held))
        lines.append(
            f"| {name} | {len(own)} | {len(own) - len(told)} | {len(z)} | {held.mean():.1f} "
            f"| {error:.1f} | {np.sqrt(np.mean(z**2)):.2f} |"
        )
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fits", type=int, default=FITS)
    parser.add_argument("--first", type=int, default=FIRST)
    parser.add_argument("--only", default="")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kept", type=Path, default=KEPT)
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args(arguments)
    seeds = range(options.first, options.first + options.fits)
    every = [(name, seed) for name in ROWS if options.only in name for seed in seeds]
    done = {(r["row"], r["seed"]): r for r in resumed.kept(options.kept)}
    left = [task for task in every if task not in done]
    made = resumed.done(one, left, options.kept, options.workers)
    done |= {(r["row"], r["seed"]): r for r in made}
    options.table.write_text(table([done[task] for task in every]), encoding="utf-8")
    print(f"written: {options.table}")


if __name__ == "__main__":
    main()
