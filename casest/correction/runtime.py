"""Runs an exported correction with NumPy alone: the text of this file is part of every module.

There the table of operations stands in place of its import.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from casest.correction.numpy_table import OPERATIONS


def run(program: dict[str, Any], x: Any, outputs: int) -> Any:
    """The program's outputs (N, outputs) for inputs (N, width)."""
    w: list[Any] = [0.0] * program["registers"]
    out = np.zeros((len(x), outputs))
    for operation, place, *rest in program["steps"]:
        if operation == "input":
            w[place] = x[:, rest[0]]
        elif operation == "constant":
            w[place] = rest[0]
        elif operation == "output":
            out[:, place] = w[rest[0]]
        else:
            w[place] = OPERATIONS[operation](*(w[r] for r in rest))
    return out


def solved(program: dict[str, Any], x: Any, start: Any) -> Any:
    """Newton's method from one start (N, n), steps halved until they gain; NaN where it fails."""
    n = program["output"]["size"]
    found = np.array(start, dtype=float)
    left = np.full(found.shape, np.nan)
    rows, value = np.arange(len(x)), found.copy()  # those that still move
    out = run(program, np.hstack([x, value]), 2 * n)
    for _ in range(60):
        trial, after = _gaining(program, x[rows], value, out)
        found[rows], left[rows] = trial, after[:, n:]
        moving = (np.abs(trial - value) > 1e-14 * (1 + np.abs(trial))).any(axis=1)
        rows, value, out = rows[moving], trial[moving], after[moving]
        if not rows.size:
            break
    close = np.abs(left) <= 1e-9 * program["newton"]["largest"]
    good = np.isfinite(found).all(axis=1) & close.all(axis=1)
    return np.where(good[:, None], found, np.nan)


def _gaining(program: dict[str, Any], x: Any, value: Any, out: Any) -> Any:
    """The next values and what the program says there; those that no share of a step mends stay."""
    n = value.shape[1]
    size = np.linalg.norm(out[:, n:], axis=1)
    trial, after = np.empty_like(value), np.empty_like(out)
    worse, share = np.arange(len(x)), 1.0
    for _ in range(30):
        trial[worse] = value[worse] + share * out[worse, :n]
        after[worse] = run(program, np.hstack([x[worse], trial[worse]]), 2 * n)
        worse = worse[~(np.linalg.norm(after[worse, n:], axis=1) <= size[worse])]
        share *= 0.5
        if not worse.size:
            break
    trial[worse], after[worse, :n], after[worse, n:] = value[worse], 0.0, out[worse, n:]
    return trial, after


def attempted(program: dict[str, Any], x: Any) -> Any:
    """Corrected values (N, n) of readings and what else is needed, (N, width); NaN for none."""
    x = np.asarray(x, dtype=float)
    width, n = sum(i["size"] for i in program["inputs"]), program["output"]["size"]
    if x.ndim != 2 or x.shape[1] != width:
        raise ValueError(f"x has shape {x.shape}, not (N, {width})")
    with np.errstate(all="ignore"):
        if program["kind"] == "direct":
            return run(program, x, n)
        best = np.full((len(x), n), np.nan)
        newton = program["newton"]
        at, size = newton["measured"]
        starts = [np.full((len(x), n), s) for s in newton["starts"]]
        starts += [x[:, at : at + size]] if size == n else []
        for start in starts:
            found = solved(program, x, start)
            away = [np.abs(v - newton["middle"]).max(axis=1) for v in (found, best)]
            better = np.isfinite(away[0]) & ~(away[0] >= away[1])
            best[better] = found[better]
    return best


def corrected(program: dict[str, Any], x: Any) -> Any:
    """Corrected values; ValueError names the first row that has none."""
    best = attempted(program, x)
    bad = np.flatnonzero(~np.isfinite(best).all(axis=1))
    if bad.size:
        raise ValueError(f"row {bad[0]}: outside what the model can produce ({bad.size} rows)")
    return best
