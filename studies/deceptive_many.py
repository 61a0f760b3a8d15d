"""Many sensors of one model with many valleys: is any trusted and wrong, and is it as if alone?

Run `python studies/deceptive_many.py` (`make study-deceptive-many`). The worlds are those of
`studies/deceptive.py`, with random numbers of their own: rows and noise differ from sensor to
sensor. Each family is calibrated by `calibrate_many`, some sensors at a time, and judged from
outside. Those that were not handed to `attempt` by `calibrate_many` itself are calibrated by it
here: verdict and values must be the same. What was done is kept in `out/deceptive-many-SEED.jsonl`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import resumed
from deceptive import FAMILIES, ROWS, SAME, SPAN, World, from_the_truth, verdict, world

from casest import Run, attempt, calibrate_many

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "studies" / "deceptive_many.md"
#: The families whose sum of squares is smooth.
NAMES = tuple(name for name in FAMILIES if name != "wrapped angle")
#: Sensors of each family, how many are calibrated in one call, and where random numbers begin.
SENSORS, TOGETHER, SEED = 400, 40, 60_000


def fits(name: str, first: int, count: int, seed: int) -> list[dict[str, Any]]:
    """Some sensors of a family in one call, each judged from outside."""
    worlds = [world(name, first + k, seed) for k in range(count)]
    model, most = FAMILIES[name].model, max(ROWS)
    signals = {"x": np.zeros((count, most, 1)), "y": np.zeros((count, most, worlds[0].y[0].size))}
    for k, w in enumerate(worlds):
        signals["x"][k, : len(w.x)] = w.x[:, None]
        signals["y"][k, : len(w.x)] = w.y.reshape(len(w.x), -1)
    began = time.perf_counter()
    found = calibrate_many(model, signals, counts=np.array([len(w.x) for w in worlds]))
    seconds = (time.perf_counter() - began) / count
    return [
        {"family": name, "number": first + k, "rows": len(w.x), "seconds": seconds}
        | one(w, found, k)
        for k, w in enumerate(worlds)
    ]


def one(w: World, found: Any, k: int) -> dict[str, Any]:
    """A sensor: trusted or not, right or not, and how far from what it is alone."""
    alone, trusted = k in found.reasons.replaced, bool(found.trusted[k])
    record = {"trusted": trusted, "alone": alone, "reason": found.reasons[k][0]}
    if not alone:
        signals = {"x": w.x[:, None], "y": w.y.reshape(len(w.x), -1)}
        own = attempt(w.family.model, [Run.raw("rows", signals, units={})])
        record["trusted alone"] = own.certificate.trusted
        if trusted and own.certificate.trusted:
            away = [abs(found.values[n][k] - own.values[n]) / own.std[n] for n in w.truth]
            record["away"] = float(np.nanmax(away))
    if trusted:
        values = {n: float(found.values[n][k]) for n in w.truth}
        best, squares = from_the_truth(w)
        left = float(np.sum((w.family.formula(w.x, **values) - w.y) ** 2))
        dense = np.linspace(0, SPAN, 4001)
        away = w.family.formula(dense, **values) - w.family.formula(dense, **best)
        same = bool(np.sqrt(np.mean(away**2)) < SAME * w.noise)
        record |= {"verdict": verdict(same, left, squares, w.noise), "values": values}
        record["truth"] = w.truth
    return record


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensors", type=int, default=SENSORS, help="of each family")
    parser.add_argument("--seed", type=int, default=SEED)
    asked = parser.parse_args()
    path = ROOT / "out" / f"deceptive-many-{asked.seed}.jsonl"
    records = resumed.kept(path)
    done = {(r["family"], r["number"]) for r in records}
    path.parent.mkdir(exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        for first in range(0, asked.sensors, TOGETHER):
            for name in NAMES:
                if (name, first) not in done:
                    own = fits(name, first, min(TOGETHER, asked.sensors - first), asked.seed)
                    records += own
                    file.writelines(json.dumps(r) + "\n" for r in own)
                    file.flush()
                    print(f"{name}: {first + len(own)} of {asked.sensors}", flush=True)
    text = page(records, asked.seed)
    print(text)
    if asked.seed == SEED and asked.sensors == SENSORS:
        TABLE.write_text(text, encoding="utf-8")


def page(records: list[dict[str, Any]], seed: int) -> str:
    """Markdown: a row per family."""
    lines = [
        "# Many sensors of models with many valleys",
        "",
        "Made by `make study-deceptive-many` (`python studies/deceptive_many.py`). The worlds of",
        "`studies/deceptive.md` whose sum of squares is smooth, as sensors of one model in",
        "`calibrate_many`; the words are the same. *Together*: those that stayed with the others;",
        "of these, *otherwise alone* have another verdict by `attempt`, and *away* is the largest",
        "difference of a value, in its standard deviations; *seconds* are those of a busy machine.",
        f"Random numbers begin at {seed}; of {SENSORS} sensors of each these are the first. Of two",
        "decays number 174 has its two terms exchanged alone: the same function, and far away.",
        "",
        "| family | sensors | right, trusted | elsewhere, trusted | **wrong, trusted** | refused | "
        "together | otherwise alone | away | seconds each |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name in NAMES:
        lines.append(row(name, [r for r in records if r["family"] == name]))
    return "\n".join([*lines, row("**all**", records), ""])


def row(name: str, own: list[dict[str, Any]]) -> str:
    said = [r.get("verdict", "refused") for r in own]
    together = [r for r in own if not r["alone"]]
    other = sum(r["trusted"] != r["trusted alone"] for r in together)
    away = max((r["away"] for r in together if "away" in r), default=0.0)
    cells = [len(own), *(said.count(v) for v in ("right", "elsewhere", "wrong", "refused"))]
    seconds = np.mean([r["seconds"] for r in own]) if own else 0.0
    return f"| {name} | " + " | ".join(
        [*map(str, cells), str(len(together)), str(other), f"{away:.1g}", f"{seconds:.2f}"]
    ) + " |"  # fmt: skip


if __name__ == "__main__":
    main()
