"""An effect of the user's own, asked for with `--effects`: is it found, and only where it is?

    make study-asked                     # some twenty minutes on two cores
    python studies/asked.py --worlds 50  # fewer worlds of each kind

Compasses on a turn table (few poses, hard iron) and a triad at rest (a hum of known frequency, and
an offset that follows the temperature). Each world is kept in `out/asked.jsonl`, so that an
interrupted study goes on where it stopped; the table is written to `studies/asked.md`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "studies"))

import resumed  # noqa: E402
from scipy.signal import lfilter  # noqa: E402
from scipy.stats import beta  # noqa: E402

from casest import Residual, Run, constant, cos, effect, model, param, quantity, signal, sin  # noqa: E402
from casest.diagnose.loop import close  # noqa: E402
from casest.effects import CATALOGUE  # noqa: E402

KEPT, TABLE = ROOT / "out" / "asked.jsonl", ROOT / "studies" / "asked.md"
WORLDS, PRESENT = 600, 100
#: Sizes of an effect: its squares over those of the noise, summed.
SIZES = (15.0, 30.0, 60.0)
DEGREE = np.pi / 180


@model
def compass(table=signal("deg"), heading=signal("deg"), *, declination=param("deg")):
    """A heading is that of the table and the declination."""
    return Residual(measured=heading, predicted=quantity("reading", table + declination, "deg"))


@effect(on="reading", formula="y + sine·sin(table) + cosine·cos(table)")
def deviation(y, table=signal("deg"), *, sine=param("deg"), cosine=param("deg")):
    """Hard iron: the deviation of a compass, once per turn."""
    return y + sine * sin(table * DEGREE) + cosine * cos(table * DEGREE)


@model
def steady(v=signal(3, "m/s^2"), *, bias=param(3, "m/s^2")):
    """A triad at rest reads a constant."""
    return Residual(measured=v, predicted=quantity("reading", bias, "m/s^2"))


@effect(on="reading", formula="y + sine·sin(3t) + cosine·cos(3t)")
def hum(
    y,
    t=signal("s"),
    *,
    sine=param(3, "m/s^2"),
    cosine=param(3, "m/s^2"),
    rate=constant(3.0, "rad/s"),
):
    """Something that turns with 3 rad/s."""
    return y + sine * sin(rate * t) + cosine * cos(rate * t)


@effect(on="reading", formula="y + slope·temp")
def warm(y, temp=signal("degC"), *, slope=param(3, "m/s^2/K")):
    """An offset that follows the temperature."""
    return y + slope * temp


def noise(kind: str, rng: np.random.Generator, shape: tuple[int, ...]) -> Any:
    """Noise of unit variance, or near it."""
    if kind == "Student's t (4)":
        return rng.standard_t(4, shape) / np.sqrt(2)
    white = rng.standard_normal(shape)
    if kind == "unequal":
        return white * np.where(rng.random(shape) < 0.3, 2.0, 0.5)
    return lfilter([0.8], [1, -0.6], white, axis=0) if kind == "AR(1), 0.6" else white


def compass_world(seed: int, poses: int, kind: str, size: float) -> dict[str, Any]:
    """Headings with hard iron of a size, at any place of the turn."""
    rng = np.random.default_rng([seed, poses, len(kind), int(size)])
    table = np.arange(poses) * 360 / (poses - 1)
    swing = np.sin(table * DEGREE + rng.uniform(0, 2 * np.pi))
    swing *= np.sqrt(size / np.sum((swing - swing.mean()) ** 2))
    heading = 20 + table + swing + noise(kind, rng, table.shape)
    signals = {"table": table[:, None], "heading": heading[:, None]}
    run = Run.raw("compass", signals, units={"table": "deg", "heading": "deg"})
    return _closed(compass, run, (deviation,), f"compass, {poses} poses", kind, size, seed)


def triad_world(seed: int, samples: int, kind: str, size: float) -> dict[str, Any]:
    """A triad with a hum on its first axis, beside a temperature that does nothing."""
    rng = np.random.default_rng([seed, samples, len(kind), int(size), 1])
    t = np.arange(samples) / 50
    swing = np.sin(3 * t + rng.uniform(0, 2 * np.pi))
    v = noise(kind, rng, (samples, 3))
    v[:, 0] += swing * np.sqrt(size / np.sum(swing**2))
    temp = 20 + 3 * np.cumsum(rng.standard_normal(samples)) / np.sqrt(samples)
    signals = {"v": 0.3 + 0.02 * v, "temp": temp[:, None]}
    run = Run.raw("triad", signals, units={"v": "m/s^2", "temp": "degC"}, time=t)
    return _closed(steady, run, (hum, warm), f"triad, {samples} samples", kind, size, seed)


def _closed(declared: Any, run: Run, own: Any, *key: Any) -> dict[str, Any]:
    """What is found of the own effects, the first being the one that is there."""
    found = [
        f.candidate.name for f in close(declared, (run,), catalogue=(*CATALOGUE, *own)).effects
    ]
    names = [e.name for e in own if e.name in found]
    where, kind, size, seed = key
    return {"where": where, "kind": kind, "size": size, "seed": seed, "own": names,
            "true": own[0].name}  # fmt: skip


def world(where: str, many: int, kind: str, size: float, seed: int) -> dict[str, Any]:
    """One world, closed."""
    made = compass_world if where == "compass" else triad_world
    return made(seed, many, kind, size)


def tasks(worlds: int) -> Iterator[tuple[str, int, str, float, int]]:
    """Place, readings, noise, size, seed."""
    for where, many, kinds in (
        ("compass", 9, ("white", "Student's t (4)", "unequal")),
        ("compass", 24, ("white", "Student's t (4)", "unequal")),
        ("triad", 1000, ("white", "Student's t (4)", "AR(1), 0.6")),
    ):
        for kind in kinds:
            for size in (0.0, *SIZES) if kind == "white" else (0.0,):
                for seed in range(worlds if not size else min(PRESENT, worlds)):
                    yield where, many, kind, size, seed


def table(records: list[dict[str, Any]]) -> str:
    """Markdown: how often an own effect is reported, and how often it is the right one."""
    lines = [
        "# Effects that the user asks for",
        "",
        "Made by `make study-asked`: `casest close … --effects FILE`, one effect of the user's own",
        "(compass) or two (triad). Size: the squares of what the effect does over the noise's",
        "variance, summed over all readings; with a size of 0 whatever is reported is wrong.",
        "",
        "| record | noise | size | worlds | right one reported | a wrong one, and 95 % bound |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    kinds: dict[tuple[str, str, float], list[dict[str, Any]]] = {}
    for r in sorted(records, key=lambda r: (r["size"], r["where"], r["kind"])):
        kinds.setdefault((r["where"], r["kind"], r["size"]), []).append(r)
    total = wrong = 0
    for (where, kind, size), own in kinds.items():
        right = sum(bool(size) and r["true"] in r["own"] for r in own)
        false = sum(bool(set(r["own"]) - ({r["true"]} if size else set())) for r in own)
        said = f"{100 * right / len(own):.0f} %" if size else "-"
        lines.append(
            f"| {where} | {kind} | {size:g} | {len(own)} | {said} | {_share(false, len(own))} |"
        )
        if not size:
            total, wrong = total + len(own), wrong + false
    return "\n".join([*lines, f"| all without | | 0 | {total} | - | {_share(wrong, total)} |", ""])


def _share(count: int, of: int) -> str:
    bound = beta.ppf(0.95, count + 1, of - count) if count < of else 1.0
    return f"{count}: {100 * count / of:.1f} %, below {100 * bound:.2f} %"


def main() -> None:
    """Run what is left, write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=WORLDS, help="of each kind, without effect")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    chosen = parser.parse_args()
    wanted = list(tasks(chosen.worlds))
    before = resumed.kept(KEPT)
    known = {(r["where"], r["kind"], r["size"], r["seed"]) for r in before}
    words = {"compass": "poses", "triad": "samples"}
    left = [w for w in wanted if (f"{w[0]}, {w[1]} {words[w[0]]}", *w[2:]) not in known]
    found = before + resumed.done(world, left, KEPT, chosen.workers)
    TABLE.write_text(table(found), encoding="utf-8")
    print(TABLE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
