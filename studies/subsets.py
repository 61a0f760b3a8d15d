"""Skew of the axes on random subsets of rest positions: is it named?

    python studies/subsets.py [NUMBER]     # subsets of each size; 20 unless told

Of 38 positions of the Xsens record 18 to 36 are drawn, of imu4's 19 to 21; `norm-diagonal`, which
lacks the skew, is closed on each. That the skew is there in every one of these subsets says the F
test of nine unknowns against six with SciPy's least squares. The table: `studies/subsets.md`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from record_files import DATA, ROOT
from record_rows import RECORDS, SKEW, Record
from scipy.optimize import least_squares
from scipy.stats import f as f_distribution

from casest import NotTrusted, Run, close, load_runs
from casest_problems.norm import norm_diagonal

TABLE = ROOT / "studies" / "subsets.md"
GOAL = 0.95
SIZES = {"xsens-imutk/xsens_acc.mat": (18, 21, 24, 27, 30, 33, 36),
         "mpu9150-mikoff/imu4.log": (19, 20, 21)}  # fmt: skip
NORM = {"xsens-imutk/xsens_acc.mat": 9.81744, "mpu9150-mikoff/imu4.log": 9.80665}

HEAD = """# Skew on subsets of rest positions

Made by `python studies/subsets.py {number}`: {number} random subsets of each size, `norm-diagonal`
closed on each; a right answer names `cross_axis` or `gain_matrix`. Goal: {goal:.0%}. Largest
p-value: of the F test of nine unknowns against six, by SciPy, over the same subsets.

| record | positions | named | adequate | a formula | largest p-value of the F test |
| --- | --- | --- | --- | --- | --- |
"""


@dataclass
class Count:
    """Of the subsets of one size: how many were answered how."""

    named: int = 0
    adequate: int = 0
    formula: int = 0
    p_value: float = 0.0


def positions(record: Record) -> Run:
    """The rest positions of a record."""
    (run,) = load_runs([str(DATA / record.file)], norm_diagonal.signals, **record.reading)
    return run


def p_value(v: Any, norm: float) -> float:
    """Of the F test of nine unknowns (lower triangle, offset) against six (diagonal, offset)."""
    six, nine = (_sum_of_squares(v, norm, skewed) for skewed in (False, True))
    free = len(v) - 9
    return float(f_distribution.sf((six - nine) / 3 / (nine / free), 3, free))


def _sum_of_squares(v: Any, norm: float, skewed: bool) -> float:
    """Of the distances from the ellipsoid, to first order, in the unit of the reading."""
    middle, half = (v.max(axis=0) + v.min(axis=0)) / 2, (v.max(axis=0) - v.min(axis=0)) / 2

    def distance(p: Any) -> Any:
        S = np.diag(p[3:6])
        if skewed:
            S[np.tril_indices(3, -1)] = p[6:]
        c = (v - middle - half * p[:3]) / half @ S.T
        long = np.linalg.norm(c, axis=1)
        return (long - 1) / np.linalg.norm(c / long[:, None] @ S / half, axis=1)

    start = np.r_[np.zeros(3), np.ones(3), np.zeros(3 * skewed)]
    fitted = least_squares(distance, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return float(2 * fitted.cost)


def counted(record: Record, size: int, number: int) -> Count:
    """Close `number` random subsets of `size` positions."""
    whole, norm = positions(record), NORM[record.file]
    rng, count = np.random.default_rng(size), Count()
    for _ in range(number):
        some = whole.take(np.sort(rng.choice(len(whole), size, replace=False)))
        count.p_value = max(count.p_value, p_value(some.signals["v"], norm))
        try:
            found = close(norm_diagonal.having(norm=norm), [some])
        except NotTrusted:
            continue
        names = {e.candidate.label.partition("(")[0] for e in found.effects}
        count.named += bool(names & SKEW)
        count.adequate += found.verdict == "adequate"
        count.formula += "formula" in names
    return count


def main(number: int) -> None:
    """Count every size and write the table."""
    lines = HEAD.format(number=number, goal=GOAL)
    for file, sizes in SIZES.items():
        record = next(r for r in RECORDS if r.file == file)
        for size in sizes:
            c = counted(record, size, number)
            shares = [f"{k / number:.0%}" for k in (c.named, c.adequate, c.formula)]
            cells = [Path(file).stem, str(size), *shares, f"{c.p_value:.1g}"]
            lines += "| " + " | ".join(cells) + " |\n"
            print(*cells, flush=True)
    TABLE.write_text(lines, encoding="utf-8")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
