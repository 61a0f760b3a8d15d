"""Do `calibrate` and `close` say the same of a record of rest positions?

    python studies/agreement.py

Of every record in ../shared/data with rest positions: whether `calibrate norm-diagonal` doubts that
its residual is noise, whether `close norm-diagonal` names the skew, and whether the F test of nine
unknowns against six (SciPy's least squares) has p < 0.01: one answer. And what is left beside the
skew: a doubt of `calibrate norm-triangular`, `unexplained` of `close norm-triangular` and of the
closed `norm-diagonal`, which is the same model: one answer, and the same error. The table:
`studies/agreement.md`.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from record_files import ROOT, found
from record_rows import RECORDS, SKEW, Record
from scipy.stats import f as f_distribution
from subsets import p_value, positions

from casest.cli import run

TABLE = ROOT / "studies" / "agreement.md"
#: Of the F test.
LEVEL = 0.01

TEN = Record(
    "MPU-6050, ten rest positions",
    "norm-diagonal",
    "mpu6050-tomisuarez/example_data_calibration.csv",
    "",
    RECORDS[0].right,
    {
        "columns": {"v": ("ax", "ay", "az")},
        "units": {"v": "count"},
        "rate": 100.0,
        "at_rest": True,
    },
    ("--set", "norm=9.80665"),
)

HEAD = """# Records of rest positions: one answer

Made by `python studies/agreement.py`. Left: is more missing than six unknowns of `norm-diagonal`:
by `calibrate`'s doubt, by `close` (the skew is named), by the F test (p). Right: is anything
missing beside the nine unknowns: by `calibrate norm-triangular`'s doubt, by `close
norm-triangular`, by `close norm-diagonal` once it has the skew; and the errors of the fits of both,
equal but for what terms that were left away explain by chance (F test again).

| record | doubt | named | p | doubt | unexplained | unexplained | errors | agreed |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
"""


def said(command: str, model: str, record: Record) -> dict[str, Any]:
    """The result.json of a command on a record."""
    with tempfile.TemporaryDirectory() as name:
        file = found(record.file, Path(name))
        run([command, model, file, *record.words[3:], "-o", name])
        result: dict[str, Any] = json.loads((Path(name) / "result.json").read_text())
    return result


def row(record: Record) -> str:
    """One line of the table."""
    results = {
        (command, model): said(command, model, record)
        for command in ("calibrate", "close")
        for model in ("norm-diagonal", "norm-triangular")
    }
    refused = next((r for r in results.values() if not r["trusted"]), None)
    if refused or results["close", "norm-diagonal"]["verdict"] is None:
        return f"| {record.name} | - | - | - | - | - | - | - | refused |\n"
    names = {e["name"] for e in results["close", "norm-diagonal"]["effects"]}
    norm = float(record.options[1].partition("=")[2].split()[0])
    v = positions(record).signals["v"]
    p = p_value(v, norm)
    more = (bool(results["calibrate", "norm-diagonal"]["misfit"]), bool(names & SKEW))
    left = (
        bool(results["calibrate", "norm-triangular"]["misfit"]),
        results["close", "norm-triangular"]["verdict"] == "unexplained",
        results["close", "norm-diagonal"]["verdict"] == "unexplained",
    )
    ends = [results["close", f"norm-{m}"]["after"] for m in ("triangular", "diagonal")]
    same = alike(ends, len(v))
    agreed = len({*more, p < LEVEL}) == 1 and len({*left}) == 1 and same
    words = ["yes" if word else "no" for word in (*more, *left)]
    errors = " and ".join(f"{e['rmse_fit']:.4g}" for e in ends)
    verdict = "yes" if agreed else "**no**"
    cells = [record.name, *words[:2], f"{p:.1g}", *words[2:], errors, verdict]
    return "| " + " | ".join(cells) + " |\n"


def alike(ends: list[dict[str, Any]], number: int) -> bool:
    """Whether nine unknowns fit `number` positions no better than the terms that close kept."""
    nine, kept = (number * end["rmse_fit"] ** 2 for end in ends)
    free = number - 9
    size = sum(np.size(p["value"]) for p in ends[1]["parameters"].values())
    fewer = max(9 - size, 1)
    return bool(f_distribution.sf((kept - nine) / fewer / (nine / free), fewer, free) > LEVEL)


def main() -> None:
    """Every record of rest positions, and the table."""
    lines = HEAD
    once = {r.file: r for r in (*reversed(RECORDS), TEN) if r.reading.get("at_rest")}
    for record in once.values():
        lines += (line := row(record))
        print(line, end="", flush=True)
    TABLE.write_text(lines, encoding="utf-8")


if __name__ == "__main__":
    main()
