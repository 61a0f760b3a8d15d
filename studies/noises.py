"""Does the loop claim a cause where there is only noise of an unusual kind?

    make study-noises                       # python studies/noises.py
    python studies/noises.py --quick        # ten records of each noise
    python studies/noises.py --only pink    # noises whose name contains this

Ten kinds of noise on records of five models, nothing missing from any; a temperature and a supply
voltage are recorded beside, and are no causes. Each record is kept in `out/noises.jsonl`, so that
an interrupted study goes on where it stopped; the table is written to `studies/noises.md`.
`--table` writes it from what is there.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "studies"), str(ROOT / "tests")]

import resumed  # noqa: E402
import worlds  # noqa: E402
from loop_worlds import model_of, run_of, said  # noqa: E402
from motions import Array, Rng, between, columns, staircase, turning, waves  # noqa: E402
from scipy.signal import butter, lfilter  # noqa: E402
from scipy.stats import beta  # noqa: E402
from sensors import FIELD, GRAVITY, World  # noqa: E402

from casest import NotTrusted, close  # noqa: E402

KEPT, TABLE = ROOT / "out" / "noises.jsonl", ROOT / "studies" / "noises.md"
#: Share of the records in which a cause may be claimed: 6 of 300.
GOAL = 0.02
#: One record of each model in turn, of a noise.
RECORDS = 300


# -- records without noise: what is read is the clean reading --------------------------------------


def _bare(model: str, read: str, signals: Any, units: Any, sigma: float, t: Array, rng: Rng,
          **more: Any) -> World:  # fmt: skip
    clean = signals[read]
    every = more.pop("columns", None) or columns(rng, t)
    known = {"temperature": "degC", "supply": "V"}
    column_units = {name: known.get(name, "") for name in every}
    return World(
        model, read, signals, units, clean, (clean,), {}, (), sigma, t, every, column_units, **more
    )


def waved(rng: Rng) -> World:
    """norm-diagonal: a magnetometer turned about all axes."""
    n = int(rng.integers(800, 2500))
    t = np.arange(n) / 30.0
    dip = np.radians(rng.uniform(50, 70))
    earth = FIELD * np.array([np.cos(dip), 0, np.sin(dip)])
    x = np.einsum("nji,j->ni", turning(rng)(t), earth)
    v = x * (1 + rng.uniform(-0.08, 0.08, 3)) + rng.uniform(-20, 20, 3)
    more = {"constants": {"norm": FIELD}}
    return _bare("norm-diagonal", "v", {"v": v}, {"v": "uT"}, 0.3, t, rng, **more)


def posed(rng: Rng) -> World:
    """norm-diagonal: an accelerometer in 30 poses or so, ten readings in each."""
    poses = int(rng.integers(24, 48))
    directions = rng.standard_normal((poses, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x = GRAVITY * np.repeat(directions, 10, axis=0)
    v = x * (1 + rng.uniform(-0.03, 0.03, 3)) + rng.uniform(-0.5, 0.5, 3)
    t = np.repeat(6.0 * np.arange(poses), 10) + np.tile(0.1 * np.arange(10), poses)
    more = {"constants": {"norm": GRAVITY}, "block": np.repeat(np.arange(poses), 10)}
    return _bare("norm-diagonal", "v", {"v": v}, {"v": "m/s^2"}, 0.02, t, rng, **more)


def _of_tests(place: str, rng: Rng, **options: Any) -> World:
    """A wheel or a rate table of the tests, before its noise."""
    made = worlds.made(place, [int(rng.integers(1 << 31))], {}, **options)
    signals = {**made.signals, made.read: made.clean}
    more = {"columns": dict(made.columns), "block": made.block}
    assert made.time is not None
    return _bare(
        made.model, made.read, signals, dict(made.units), made.sigma, made.time, rng, **more
    )


def wheel(rng: Rng) -> World:
    """wheel: 20 s at 100 Hz."""
    return _of_tests("wheel", rng, seconds=20.0)


def table(rng: Rng) -> World:
    """rate-table: 40 attitudes, ten readings in each."""
    return _of_tests("table", rng)


def loaded(rng: Rng) -> World:
    """A load cell of a user's own beside a recorded load that moves, or is held in steps."""
    n = int(rng.integers(500, 2500))
    t = 0.5 * np.arange(n)
    moving = 0.5 + 0.25 * waves(rng, 5, 60)(t)
    share = moving if rng.random() < 0.5 else staircase(rng, t, 40.0, 1.0)
    force = 500 * share[:, None]
    signals = {"force": force, "reading": 0.02 + 0.004 * force}
    return _bare("load_cell", "reading", signals, {"force": "N", "reading": "mV"}, 1e-3, t, rng)


MODELS: dict[str, Callable[[Rng], World]] = {
    "norm-diagonal, waved": waved,
    "norm-diagonal, poses": posed,
    "wheel": wheel,
    "rate-table": table,
    "load cell": loaded,
}
POSES, MOVING = (
    ("norm-diagonal, poses", "rate-table"),
    ("norm-diagonal, waved", "wheel", "load cell"),
)


# -- noise of unit variance or so, (n, m) ----------------------------------------------------------


def pink(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """Power falls as one over the frequency."""
    n = shape[0]
    frequency = np.maximum(np.fft.rfftfreq(n), 1 / n)[:, None]
    found = np.fft.irfft(np.fft.rfft(rng.standard_normal(shape), axis=0) / np.sqrt(frequency), n, 0)
    return np.asarray(found / found.std())


def telegraph(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """Each axis jumps between two levels at random times; white noise beside."""
    often = 1 / between(rng, 15, shape[0] / 10)
    flips = np.cumsum(rng.random(shape) < often, axis=0) + rng.integers(0, 2, shape[1])
    return 0.8 * (-1.0) ** flips + 0.6 * rng.standard_normal(shape)


def filtered(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """Through a second-order low pass at a tenth to a third of half the rate."""
    b, a = butter(2, rng.uniform(0.1, 0.33))
    found = lfilter(b, a, rng.standard_normal((shape[0] + 200, shape[1])), axis=0)[200:]
    return np.asarray(found / found.std())


def white(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """White."""
    return rng.standard_normal(shape)


def bursts(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """White, five times larger in a few short stretches."""
    found = rng.standard_normal(shape)
    for first in rng.integers(0, shape[0], int(rng.integers(2, 7))):
        found[first : first + shape[0] // 30] *= 5
    return found


def heavy(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """Student's t of three degrees of freedom."""
    return rng.standard_t(3, shape) / np.sqrt(3)


def with_speed(rng: Rng, shape: tuple[int, int], world: World) -> Array:
    """White, larger the faster the reading changes: up to some four times."""
    speed = np.linalg.norm(np.gradient(world.clean, world.time, axis=0), axis=1, keepdims=True)
    return rng.standard_normal(shape) * (0.3 + speed / np.sqrt(np.mean(speed**2)))


def seating(rng: Rng, shape: tuple[int, int], world: World) -> Array:
    """Each pose is off by one draw, larger than the scatter within it."""
    assert world.block is not None
    each = rng.standard_normal((int(world.block.max()) + 1, shape[1]))
    return each[world.block] + 0.3 * rng.standard_normal(shape)


def repeated(rng: Rng, shape: tuple[int, int], _: World) -> Array:
    """A slow sensor logged faster: its noise is held, or is a line from one sample to the next."""
    every, n = int(rng.integers(2, 6)), shape[0]
    few = rng.standard_normal((n // every + 2, shape[1]))
    if rng.random() < 0.5:
        return np.repeat(few, every, axis=0)[:n]
    place = np.arange(n) / every
    return np.column_stack([np.interp(place, np.arange(len(few)), f) for f in few.T])


Noise = Callable[[Rng, tuple[int, int], World], Array]
#: What the noise is, and on which models it can be.
NOISES: dict[str, tuple[Noise, tuple[str, ...]]] = {
    "pink": (pink, tuple(MODELS)),
    "random telegraph": (telegraph, tuple(MODELS)),
    "low-pass filtered": (filtered, tuple(MODELS)),
    "quantised to three levels": (white, tuple(MODELS)),
    "bursts": (bursts, tuple(MODELS)),
    "heavy tails (t3)": (heavy, tuple(MODELS)),
    "variance grows with speed": (with_speed, MOVING),
    "seating errors per pose": (seating, POSES),
    "held and interpolated samples": (repeated, MOVING),
    "missing blocks": (white, tuple(MODELS)),
}


def record_of(kind: str, seed: int) -> tuple[str, World]:
    """A record of one noise, and the name of what it is a record of; each model in its turn."""
    noise, places = NOISES[kind]
    place = places[seed % len(places)]
    rng = np.random.default_rng([seed, *kind.encode()])
    world = MODELS[place](rng)
    v = world.clean + world.sigma * noise(rng, world.clean.shape, world)
    if kind.startswith("quantised"):  # at rest three steps are seen, or four
        step = 2.5 * world.sigma
        v = step * np.round((world.clean + 0.35 * step * (v - world.clean) / world.sigma) / step)
    world = replace(world, signals={**world.signals, world.read: v})
    return place, _with_gaps(rng, world) if kind == "missing blocks" else world


def _with_gaps(rng: Rng, world: World) -> World:
    """A quarter of the record is gone, in a few pieces; each begins a new stretch."""
    n = len(world.time)
    kept = np.ones(n, bool)
    for first in rng.integers(0, n, 5):
        kept[first : first + n // 20] = False
    before = np.zeros(n, np.int_) if world.block is None else world.block
    gaps = np.cumsum(np.diff(kept.astype(int), prepend=int(kept[0])) > 0)
    _, block = np.unique(before[kept] * (n + 1) + gaps[kept], return_inverse=True)
    return replace(
        world,
        signals={name: values[kept] for name, values in world.signals.items()},
        columns={name: values[kept] for name, values in world.columns.items()},
        time=world.time[kept],
        clean=world.clean[kept],
        block=block.astype(np.int_),
    )


# -- all of them -----------------------------------------------------------------------------------


def one_record(kind: str, seed: int) -> dict[str, Any]:
    """Close the loop on one record."""
    place, world = record_of(kind, seed)
    record: dict[str, Any] = {"name": f"{kind}/{seed}", "kind": kind, "place": place, "seed": seed}
    began = time.perf_counter()
    try:
        closing = close(model_of(world), [run_of(world)])
    except NotTrusted as error:
        return record | {"refused": str(error)}
    except Exception as error:  # a study goes on; the table names these
        return record | {"failed": f"{type(error).__name__}: {error}"}
    return record | {"seconds": time.perf_counter() - began} | said(closing)


def claims(record: dict[str, Any]) -> list[str]:
    """Causes and formulas that are claimed."""
    return [f["label"] for f in record["found"] if not f["describes"]]


def table_of(records: Sequence[dict[str, Any]]) -> str:
    """Markdown: what is claimed of each noise, and of each model."""
    lines = [
        "# Noise of other kinds",
        "",
        "Made by `make study-noises` (`python studies/noises.py`). Nothing is missing from any of",
        "these records, and what is recorded beside them (a temperature, a supply voltage) does",
        "nothing. Claimed: a cause of the catalogue or a formula was added; a property of the",
        "noise or a description of a course (`outliers`, `bias_wander`, `reference_wander`,",
        f"`bias_course`) is none. Goal: in at most {GOAL:.0%} of each. Pink noise and a telegraph",
        "are slow: the right verdict is `unexplained`, with the share of the variance.",
        "",
    ]
    for title, key in (("noise", "kind"), ("record", "place")):
        lines += [
            f"| {title} | records | claimed, and 95 % bound | causes | formulas | adequate "
            "| extended | unexplained | its share, median | no answer | seconds, median | claims |",
            "| --- " * 12 + "|",
        ]
        for name in dict.fromkeys(r[key] for r in records):
            lines.append(f"| {name} | {_row([r for r in records if r[key] == name])} |")
        lines.append("")
    stopped = [r for r in records if "failed" in r]
    lines += [f"* `{r['name']}`: {r['failed']}" for r in stopped]
    return "\n".join(lines) + "\n"


def _row(own: Sequence[dict[str, Any]]) -> str:
    good = [r for r in own if "verdict" in r]
    n, false = len(good), [r for r in good if claims(r)]
    bound = beta.ppf(0.95, len(false) + 1, n - len(false)) if n > len(false) else 1.0
    every = [c for r in false for c in claims(r)]
    verdicts = [r["verdict"] for r in good]
    shares = [r["share"] for r in good if r["verdict"] == "unexplained"]
    cells = [
        len(own),
        f"{len(false)}: {100 * len(false) / max(n, 1):.1f} %, below {100 * bound:.1f} %",
        sum(any(c != "formula" for c in claims(r)) for r in false),
        sum("formula" in claims(r) for r in false),
        *(verdicts.count(v) for v in ("adequate", "extended", "unexplained")),
        f"{100 * np.median(shares):.1f} %" if shares else "",
        len(own) - n,
        f"{np.median([r['seconds'] for r in good]):.1f}" if good else "",
        ", ".join(f"{c} {every.count(c)}" for c in sorted(set(every), key=every.count)[::-1]),
    ]
    return " | ".join(map(str, cells))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is left, write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="ten records of each noise")
    parser.add_argument("--only", default="", help="regular expression that a name contains")
    parser.add_argument("--records", type=int, default=RECORDS, help="of each noise")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kept", type=Path, default=KEPT)
    parser.add_argument("--out", type=Path, default=TABLE)
    parser.add_argument("--table", action="store_true", help="write the table of what is there")
    options = parser.parse_args(arguments)
    count = 10 if options.quick else options.records
    seeds = range(options.first, options.first + count)
    every = [(kind, s) for s in seeds for kind in NOISES if re.search(options.only, f"{kind}/{s}")]
    done = {r["name"]: r for r in resumed.kept(options.kept)}
    left = [task for task in every if f"{task[0]}/{task[1]}" not in done]
    if not options.table:
        print(f"{len(every)} records, {len(left)} to do")
        made = resumed.done(one_record, left, options.kept, options.workers)
        done |= {r["name"]: r for r in made}
    names = [f"{kind}/{s}" for kind in NOISES for s in seeds]
    options.out.write_text(table_of([done[n] for n in names if n in done]), encoding="utf-8")
    print(f"written: {options.out}")


if __name__ == "__main__":
    main()
