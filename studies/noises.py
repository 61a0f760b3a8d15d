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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "studies"))

import resumed  # noqa: E402
from loop_worlds import model_of, run_of, said  # noqa: E402
from noise_records import NOISES, record_of  # noqa: E402
from scipy.stats import beta  # noqa: E402

from casest import NotTrusted, close  # noqa: E402

KEPT, TABLE = ROOT / "out" / "noises.jsonl", ROOT / "studies" / "noises.md"
#: Share of the records in which a cause may be claimed: 6 of 300.
GOAL = 0.02
#: One record of each model in turn, of a noise.
RECORDS = 300


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
