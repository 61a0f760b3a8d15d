"""Short tables: what is said of 12 to 60 rows, an instrument against a reference?

    make study-tables                      # python studies/tables.py
    python studies/tables.py --only jump   # tables whose kind contains this

`linear`, closed on rows without a time: an instrument of a laboratory, its noise white, growing or
rounded, and what may be wrong with it by closed forms that the catalogue does not have (a divider
under load, a thermometer's exponential, two ranges, a full scale). Each table is kept in
`out/tables.jsonl`, so that an interrupted study goes on where it stopped.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "studies"))

import resumed  # noqa: E402
from loop_worlds import said  # noqa: E402

from casest import NotTrusted, Run, close  # noqa: E402
from casest_problems.one_channel import linear  # noqa: E402

KEPT, TABLE = ROOT / "out" / "tables.jsonl", ROOT / "studies" / "tables.md"
COUNT, FIRST, ROWS = 60, 720_000, (12, 60)
BENDS = {
    "quadratic",
    "cubic",
    "quartic",
    "signed_quadratic",
    "signed_cubic",
    "saturation",
    "dead_zone",
}
Table = tuple[np.ndarray, np.ndarray]


def straight(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return 0.3 + 1.02 * x


def bent(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """A divider under load: 25 to 62 times the noise beside a line, at most."""
    size = rng.uniform(0.15, 0.4)
    return straight(rng, x) / (1 + size * x / 10) * (1 + size)


def warmed(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return 10 * np.expm1(x / 10 * 0.5) / np.expm1(0.5)


def jumped(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """Two ranges that differ by six to twelve times the noise."""
    return straight(rng, x) + 0.01 * rng.uniform(6, 12) * (x > rng.uniform(3, 7))


def odd(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """One row, anywhere, off by eight to fifteen times the noise."""
    y = straight(rng, x)
    y[rng.integers(len(x))] += 0.01 * rng.uniform(8, 15) * rng.choice([-1, 1])
    return y


def white(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return 0.01 * rng.standard_normal(len(x))


def growing(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """From a tenth at one end to one and a half at the other."""
    return white(rng, x) * (0.1 + 1.4 * x / 10)


def heavy(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return 0.01 * rng.standard_t(3, len(x)) / np.sqrt(3)


def shown(rng: np.random.Generator, y: np.ndarray) -> np.ndarray:
    return y


def rounded(rng: np.random.Generator, y: np.ndarray) -> np.ndarray:
    return np.round(y / 0.02) * 0.02


def cut(rng: np.random.Generator, y: np.ndarray) -> np.ndarray:
    """A full scale that a tenth to four tenths of the rows reach."""
    return np.minimum(y, np.quantile(y, 1 - rng.uniform(0.1, 0.4)))


#: Kind -> response, noise, what the reading shows of both, causes and verdicts that are right.
NOTHING, ANY = ("adequate", "unexplained"), ("extended", "unexplained")
Kind = tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any], set[str], tuple[str, ...]]
KINDS: dict[str, Kind] = {
    "nothing, white noise": (straight, white, shown, set(), ("adequate",)),
    "nothing, noise that grows": (straight, growing, shown, set(), ("adequate",)),
    "nothing, Student's t noise (3)": (straight, heavy, shown, set(), ("adequate",)),
    "nothing, steps of two sigma": (straight, white, rounded, set(), ("adequate",)),
    "one odd row": (odd, white, shown, set(), NOTHING),
    "a divider under load": (bent, white, shown, BENDS, ANY),
    "a divider under load, noise that grows": (bent, growing, shown, BENDS, ANY),
    "an exponential": (warmed, white, shown, BENDS, ANY),
    "two ranges, a jump between them": (jumped, white, shown, set(), ("unexplained",)),
    "a full scale": (straight, white, cut, {"saturation"}, ANY),
}  # fmt: skip


def table_of(kind: str, seed: int) -> Table:
    """Reference and reading (N,); references in even steps or anywhere, from low to high."""
    response, noise, reading, *_ = KINDS[kind]
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    rows = int(rng.integers(ROWS[0], ROWS[1] + 1))
    x = np.linspace(0, 10, rows) if rng.random() < 0.7 else np.sort(rng.uniform(0, 10, rows))
    y = response(rng, x)
    return x, reading(rng, y + noise(rng, x))


def one_table(kind: str, seed: int) -> dict[str, Any]:
    """Close the loop on one table."""
    x, y = table_of(kind, seed)
    run = Run.raw("table", {"reference": x[:, None], "reading": y[:, None]}, units={})
    record: dict[str, Any] = {"name": f"{kind}/{seed}", "kind": kind, "rows": len(x)}
    began = time.process_time()
    try:
        closing = close(linear, [run])
    except NotTrusted as error:
        return record | {"refused": str(error)}
    return record | {"seconds": time.process_time() - began} | said(closing)


def line_of(kind: str, own: Sequence[dict[str, Any]]) -> str:
    """One row of the table."""
    *_, right, verdicts = KINDS[kind]
    told = [r for r in own if "verdict" in r]
    claimed = [[f["name"] for f in r["found"] if not f["describes"]] for r in told]
    wrong = [n for names in claimed for n in names if n not in right]
    said_right = sum(r["verdict"] in verdicts for r in told)
    named = sum(bool(set(names) & right) for names in claimed)
    counts = [sum(r["verdict"] == v for r in told) for v in ("adequate", "extended", "unexplained")]
    others = ", ".join(f"{n} {wrong.count(n)}" for n in sorted(set(wrong)))
    cells = [
        kind,
        len(own),
        named if right else "",
        *counts,
        len(own) - len(told),
        said_right,
        others,
    ]
    return "| " + " | ".join(map(str, cells)) + " |\n"


HEAD = """# Short tables

Made by `make study-tables` (`python studies/tables.py`): `linear`, closed on tables of {} to {}
rows without a time, seeds from {} on. Named: a cause that is right is claimed (of a bend any
polynomial, a saturation, a dead zone: which shape a short table cannot say). Right: the verdict is
one that the table supports; `adequate` or noise beside a jump is wrong. A row that is far out in
Student's t noise is one that the others speak against (`unexplained`), as one that is odd is: no
table tells the two apart, and here the one counts as wrong and the other as right.

| table | tables | named | adequate | extended | unexplained | no answer | right | wrong causes |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is left, write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="", help="regular expression that a kind contains")
    parser.add_argument("--tables", type=int, default=COUNT, help="of each kind")
    parser.add_argument("--first", type=int, default=FIRST, help="first seed")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kept", type=Path, default=KEPT)
    parser.add_argument("--out", type=Path, default=TABLE)
    options = parser.parse_args(arguments)
    seeds = range(options.first, options.first + options.tables)
    every = [(kind, s) for s in seeds for kind in KINDS if re.search(options.only, kind)]
    done = {r["name"]: r for r in resumed.kept(options.kept)}
    left = [(kind, s) for kind, s in every if f"{kind}/{s}" not in done]
    print(f"{len(every)} tables, {len(left)} to do")
    made = resumed.done(one_table, left, options.kept, options.workers)
    done |= {r["name"]: r for r in made}
    text = HEAD.format(*ROWS, options.first)
    for kind in KINDS:
        own = [r for s in seeds if (r := done.get(f"{kind}/{s}"))]
        text += line_of(kind, own)
    options.out.write_text(text, encoding="utf-8")
    print(f"written: {options.out}")


if __name__ == "__main__":
    main()
