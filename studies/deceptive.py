"""Models with many valleys, from a start far away: is what is trusted right?

    make study-deceptive       # python studies/deceptive.py: about a quarter of an hour on one core

Each fit is of a declared model with its one declared start, on rows of known truth: few or many,
evenly spaced or not, in or out of order, much noise or little. What is right is decided without
casest: SciPy's `least_squares` begins at the truth, on formulas of its own. Each fit is kept in
`out/deceptive-SEED.jsonl`, so that an interrupted study goes on where it stopped. The table is
written to `studies/deceptive.md`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import resumed  # noqa: E402
from scipy.optimize import least_squares  # noqa: E402
from valleys import (  # noqa: E402
    chirp,
    damped,
    encoder,
    peak,
    saturation,
    sine,
    sine_and_level,
    step,
    two_decays,
    wrapped,
)

from casest import Model, Run, attempt  # noqa: E402

TABLE = ROOT / "studies" / "deceptive.md"
#: Fits of each family, and where their random numbers begin.
FITS, SEED = 100, 90_000
#: Rows, and standard deviation of the noise beside a signal of about one.
ROWS, NOISES = (25, 80, 400), (0.02, 0.1, 0.3)
#: Inputs go from 0 to this.
SPAN = 10.0
#: Two fits are the same function when they differ by less than this share of the noise anywhere.
SAME = 0.1

# -- the families: what casest is given, and the same once more in NumPy ---------------------------


def _sine_and_level(x, size, w, p, level):
    return level + size * np.sin(w * x + p)


def _peak(x, level, height, place, width):
    return level + height * np.exp(-0.5 * ((x - place) / width) ** 2)


def _step(x, level, height, place, width):
    with np.errstate(over="ignore"):
        return level + height / (1 + np.exp(-(x - place) / width))


@dataclass(frozen=True)
class Family:
    """A model, its formula in NumPy, and how true values are drawn, given the fastest angle."""

    model: Model
    formula: Callable[..., np.ndarray]
    draw: Callable[[np.random.Generator, float], dict[str, float]]


def _chirped(rng: np.random.Generator, fastest: float) -> dict[str, float]:
    """Begins and ends with angular rates that the rows can follow."""
    first, last = rng.uniform(1, min(12, fastest), 2)
    return {"w": first, "a": (last - first) / (2 * SPAN), "p": rng.uniform(-3, 3)}


FAMILIES: dict[str, Family] = {
    "sin(wx + p)": Family(
        sine,
        lambda x, w, p: np.sin(w * x + p),
        lambda rng, top: {"w": rng.uniform(4, min(15, top)), "p": rng.uniform(-3, 3)},
    ),
    "sine, size and level": Family(
        sine_and_level,
        _sine_and_level,
        lambda rng, top: {
            "size": rng.uniform(0.7, 1.4),
            "w": rng.uniform(2, min(15, top)),
            "p": rng.uniform(-3, 3),
            "level": rng.uniform(-5, 5),
        },
    ),
    "chirp": Family(chirp, lambda x, w, a, p: np.sin(w * x + a * x**2 + p), _chirped),
    "peak": Family(
        peak,
        _peak,
        lambda rng, top: {
            "level": rng.uniform(-1, 1),
            "height": rng.choice([-1, 1]) * rng.uniform(1, 3),
            "place": rng.uniform(3, 9),
            "width": rng.uniform(2 / top, 1.5),
        },
    ),
    "damped oscillation": Family(
        damped,
        lambda x, size, decay, w, p: size * np.exp(-decay * x) * np.sin(w * x + p),
        lambda rng, top: {
            "size": rng.uniform(1, 2),
            "decay": rng.uniform(0.02, 0.4),
            "w": rng.uniform(2, min(15, top)),
            "p": rng.uniform(-3, 3),
        },
    ),
    "two decays": Family(
        two_decays,
        lambda x, a, k, b, m: a * np.exp(-k * x) + b * np.exp(-m * x),
        lambda rng, top: {
            "a": rng.uniform(1, 3),
            "k": rng.uniform(0.1, 0.3),
            "b": rng.uniform(1, 3),
            "m": rng.uniform(1, 3),
        },
    ),
    "step": Family(
        step,
        _step,
        lambda rng, top: {
            "level": rng.uniform(-1, 1),
            "height": rng.choice([-1, 1]) * rng.uniform(1, 3),
            "place": rng.uniform(2, 8),
            "width": rng.uniform(0.1, 1),
        },
    ),
    "saturation": Family(
        saturation,
        lambda x, most, half: most * x / (half + x),
        lambda rng, top: {"most": rng.uniform(1, 3), "half": 10 ** rng.uniform(-1, 0.7)},
    ),
    "sine and cosine of an angle": Family(
        encoder,
        lambda x, size, rate, zero: (
            size * np.column_stack([np.cos(rate * x + zero), np.sin(rate * x + zero)])
        ),
        lambda rng, top: {
            "size": rng.uniform(0.7, 1.4),
            "rate": rng.uniform(2, min(15, top)),
            "zero": rng.uniform(-3, 3),
        },
    ),
    "wrapped angle": Family(
        wrapped,
        lambda x, rate, zero: np.angle(np.exp(1j * (rate * x + zero))),
        lambda rng, top: {"rate": rng.uniform(1, min(6, top)), "zero": rng.uniform(-3, 3)},
    ),
}


# -- one fit ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class World:
    """Rows of known truth."""

    family: Family
    truth: dict[str, float]
    x: np.ndarray
    y: np.ndarray
    noise: float


def world(name: str, number: int, seed: int) -> World:
    """The rows of one fit: all their properties are drawn."""
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed + number])
    family, rows = FAMILIES[name], int(rng.choice(ROWS))
    noise = float(rng.choice(NOISES))
    x = np.linspace(0, SPAN, rows) if rng.random() < 0.5 else np.sort(rng.uniform(0, SPAN, rows))
    truth = {k: float(v) for k, v in family.draw(rng, 0.8 * np.pi * rows / SPAN).items()}
    y = family.formula(x, **truth)
    y = y + noise * rng.standard_normal(y.shape)
    if name == "wrapped angle":
        y = np.angle(np.exp(1j * y))
    if rng.random() < 0.5:
        order = rng.permutation(rows)
        x, y = x[order], y[order]
    return World(family, truth, x, y, noise)


def from_the_truth(w: World) -> tuple[dict[str, float], float]:
    """The optimum next to the truth, and its sum of squares: SciPy's alone."""
    names = list(w.truth)

    def residual(values: np.ndarray) -> np.ndarray:
        return (w.family.formula(w.x, *values) - w.y).ravel()

    tight = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15}
    first = np.array([w.truth[n] for n in names])
    found = least_squares(residual, first, x_scale=np.maximum(np.abs(first), 0.1), **tight)
    return dict(zip(names, map(float, found.x), strict=True)), float(2 * found.cost)


def fit(name: str, number: int, seed: int) -> dict[str, Any]:
    """One fit, judged from outside."""
    w = world(name, number, seed)
    signals = {"x": w.x[:, None], "y": w.y.reshape(len(w.x), -1)}
    began = time.perf_counter()
    found = attempt(w.family.model, [Run.raw("rows", signals, units={})])
    seconds = time.perf_counter() - began
    values = {n: float(v) for n, v in found.values.items()}
    best, squares = from_the_truth(w)
    own = float(np.sum((w.family.formula(w.x, **values) - w.y) ** 2))
    dense = np.linspace(0, SPAN, 4001)
    away = w.family.formula(dense, **values) - w.family.formula(dense, **best)
    same = bool(np.sqrt(np.mean(away**2)) < SAME * w.noise)
    return {
        "family": name,
        "number": number,
        "rows": len(w.x),
        "noise": w.noise,
        "verdict": verdict(same, own, squares, w.noise),
        "lower": (squares - own) / w.noise**2,
        "trusted": found.certificate.trusted,
        "searched": found.evidence is not None and found.evidence.search is not None,
        "seconds": seconds,
        "reason": found.certificate.reasons[0],
        "notes": list(found.notes),
        "values": values,
        "truth": w.truth,
    }


def verdict(same: bool, own: float, squares: float, noise: float) -> str:
    """Right: the function that the truth leads to. Elsewhere: another one, that fits better.

    One that fits exactly alike and is another function (an alias) is wrong.
    """
    if same:
        return "right"
    return "elsewhere" if squares - own > 1e-6 * noise**2 else "wrong"


# -- the study -------------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fits", type=int, default=FITS, help="of each family")
    parser.add_argument("--seed", type=int, default=SEED)
    asked = parser.parse_args()
    path = ROOT / "out" / f"deceptive-{asked.seed}.jsonl"
    records = resumed.kept(path)
    done = {(r["family"], r["number"]) for r in records}
    left = [(n, k) for k in range(asked.fits) for n in FAMILIES if (n, k) not in done]
    print(f"{asked.fits * len(FAMILIES)} fits, {len(left)} to do")
    path.parent.mkdir(exist_ok=True)
    began = time.time()
    with path.open("a", encoding="utf-8") as file:
        for k, (name, number) in enumerate(left, 1):
            records.append(fit(name, number, asked.seed))
            file.write(json.dumps(records[-1]) + "\n")
            file.flush()
            print(f"\r{k}/{len(left)}, {time.time() - began:.0f} s", end="", flush=True)
    print()
    text = page(records, asked.seed)
    print(text)
    if asked.seed == SEED and asked.fits == FITS:
        TABLE.write_text(text, encoding="utf-8")
        print(f"written: {TABLE}")


# -- the page --------------------------------------------------------------------------------------


def page(records: list[dict[str, Any]], seed: int) -> str:
    """Markdown: a row per family, and every fit that is trusted and not right."""
    lines = [
        "# Models with many valleys",
        "",
        "Made by `make study-deceptive` (`python studies/deceptive.py`). Each fit: a declared",
        f"model with one declared start far from the truth; {', '.join(map(str, ROWS))} rows,",
        "evenly spaced or at random, in order or out of it; noise of",
        f"{', '.join(map(str, NOISES))} beside a signal of about one; all drawn at random.",
        "*Right* is the function to which SciPy's `least_squares` comes from the truth (they",
        "differ by less than a tenth of the noise between the rows too, so an alias is wrong).",
        "*Elsewhere* is another function with a lower sum of squares than that one has: the",
        "optimum asked for, but not the truth's. The sum of squares of the wrapped angle has a",
        "jump wherever a reading wraps, so that no point is a smooth optimum there.",
        f"Random numbers begin at {seed}; no rule that decides any of these fits was changed after",
        "the first of them.",
        "",
        "| family | right, trusted | right, refused | elsewhere, trusted | elsewhere, refused | "
        "wrong, refused | **wrong, trusted** | searched | median s | longest s |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name in FAMILIES:
        lines.append(row(name, [r for r in records if r["family"] == name]))
    lines += [row("**all**", records), "", "By rows and noise:", ""]
    lines += [
        "| rows | noise | right, trusted | right, refused | elsewhere, trusted | "
        "elsewhere, refused | wrong, refused | **wrong, trusted** | searched | median s | "
        "longest s |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for n in ROWS:
        for noise in NOISES:
            own = [r for r in records if (r["rows"], r["noise"]) == (n, noise)]
            if own:
                lines.append(row(f"{n} | {noise}", own))
    lines += ["", "## Trusted, and not right", "", *exceptions(records), ""]
    return "\n".join(lines)


def row(name: str, own: list[dict[str, Any]]) -> str:
    counts = [
        sum(r["verdict"] == verdict and r["trusted"] == trusted for r in own)
        for verdict, trusted in (
            ("right", True),
            ("right", False),
            ("elsewhere", True),
            ("elsewhere", False),
            ("wrong", False),
            ("wrong", True),
        )
    ]
    seconds = [r["seconds"] for r in own] or [0.0]
    cells = [*map(str, counts), str(sum(r["searched"] for r in own))]
    cells += [f"{np.median(seconds):.2f}", f"{max(seconds):.1f}"]
    return f"| {name} | " + " | ".join(cells) + " |"


def exceptions(records: list[dict[str, Any]]) -> list[str]:
    found = [r for r in records if r["trusted"] and r["verdict"] != "right"]
    lines = ["| family | fit | rows | noise | verdict | values | truth |"]
    lines.append("| --- | --- | --- | --- | --- | --- | --- |")
    for r in found:
        values, truth = (
            ", ".join(f"{n} {v:.4g}" for n, v in r[which].items()) for which in ("values", "truth")
        )
        lines.append(
            f"| {r['family']} | {r['number']} | {r['rows']} | {r['noise']} | {r['verdict']} | "
            f"{values} | {truth} |"
        )
    return lines if found else ["None."]


if __name__ == "__main__":
    main()
