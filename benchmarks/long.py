"""Time and memory of a whole calibration of a wheel as its record grows: 18 000 to 18 million.

Run `python benchmarks/long.py` (`--largest 1800000` for a shorter one). The records lie in files of
their own and are mapped, not read; every size is calibrated in a process of its own, by `attempt`,
certificate included. Memory is the most that the process ever held (VmHWM) beyond what it held
after its imports; the pages of the mapped file count as held.

The ninety seconds of the wheel stay: the step of time gets shorter. The model's own search for a
start is left out (see `started`): it looks at all readings at once, in memory.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import by_hand
from casest import Run, attempt
from casest_problems.wheel import wheel

SIZES = (18_000, 1_800_000, 18_000_000)
SECONDS = 90.0
PIECE = 100_000


def written(path: Path, count: int) -> None:
    """A file of rows (t, vx, vy, vz), made piece by piece."""
    rng = np.random.default_rng(0)
    with path.open("wb") as file:
        for first in range(0, count, PIECE):
            t = np.arange(first, min(first + PIECE, count)) * (SECONDS / count)
            v = by_hand.Wheel(t, np.zeros((len(t), 3))).residual(by_hand.TRUTH).reshape(3, -1).T
            noise = by_hand.SIGMA * rng.standard_normal(v.shape)
            np.column_stack([t, v + noise]).tofile(file)


def started(model: Any) -> Any:
    """The model with the 5 % start as its own."""
    start = by_hand.named(by_hand.start(SECONDS))
    return replace(model, starter=lambda _model, _runs: start)


def held() -> int:
    """Most bytes that this process has held in memory so far."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return 1024 * int(line.split()[1])
    return 0


def one(path: Path, solver: str) -> None:
    """Calibrate one file and print what it took."""
    before, model = held(), started(wheel)
    rows = np.memmap(path, dtype=float, mode="r").reshape(-1, 4)
    few = np.array(rows[:: max(1, len(rows) // SIZES[0])])
    attempt(model, [as_run(few)], solver=solver)  # compiles, and loads what is loaded once
    began = perf_counter()
    found = attempt(model, [as_run(rows)], solver=solver)
    seconds = perf_counter() - began
    figures = {"seconds": seconds, "bytes": held() - before, "data": rows.nbytes}
    away = {name: by_hand.named(by_hand.TRUTH)[name] - found.values[name] for name in found.values}
    worst = max(float(np.max(np.abs(away[n] / found.std[n]))) for n in away)
    print(json.dumps({**figures, "trusted": found.certificate.trusted, "worst": worst}))


def as_run(rows: Any) -> Run:
    """Views of the columns, nothing copied."""
    return Run.raw("wheel", {"t": rows[:, :1], "v": rows[:, 1:]}, units={}, time=rows[:, 0])


def main() -> None:
    """A line for every size and solver."""
    words = argparse.ArgumentParser()
    words.add_argument("--largest", type=int, default=SIZES[-1])
    words.add_argument("--one", type=Path)
    words.add_argument("--solver", default="trust-region")
    chosen = words.parse_args()
    if chosen.one:
        one(chosen.one, chosen.solver)
        return
    print("   samples  solver            s  ns/sample  memory beyond data, MB  worst error, std")
    with tempfile.TemporaryDirectory() as folder:
        for count in (size for size in SIZES if size <= chosen.largest):
            path = Path(folder) / "record"
            written(path, count)
            for solver in ("trust-region", "ipopt"):
                line = [sys.executable, __file__, "--one", str(path), "--solver", solver]
                done = subprocess.run(line, check=True, capture_output=True, text=True)
                f = json.loads(done.stdout)
                beyond = (f["bytes"] - f["data"]) / 1e6
                print(
                    f"{count:10}  {solver:12}{f['seconds']:7.2f}"
                    f"{1e9 * f['seconds'] / count:11.0f}{beyond:24.0f}{f['worst']:18.1f}"
                    f"{'' if f['trusted'] else '  not trusted'}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
