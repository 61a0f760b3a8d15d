"""A long record of the wheel, generated partition by partition: time, memory, and the same bits.

Run `python benchmarks/partitions.py [SAMPLES …]` (10⁶ unless told; of 10⁹ the command holds 32 GB
of numbers in TMPDIR). First a calibration in memory of 10⁶ samples, then for each size the command
with one worker and with two, in processes of their own: seconds of the processor for each sample,
start of the program counted, and the largest memory, in which pages of the mapped files count.

The record is that of `spin` below, which the command is given as `benchmarks/partitions.py:spin`.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from time import process_time
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import by_hand

SECONDS, PIECE, IN_MEMORY = 90.0, 250_000, 1_000_000
CODE = "import sys; from casest.cli import main; main(sys.argv[1:])"


def spin() -> Iterator[dict[str, Any]]:
    """SAMPLES of the wheel, some at a time; noise by the number of the partition."""
    count = int(os.environ.get("SAMPLES", IN_MEMORY))
    for first in range(0, count, PIECE):
        t = np.arange(first, min(first + PIECE, count)) * (SECONDS / count)
        v = by_hand.Wheel(t, np.zeros((len(t), 3))).residual(by_hand.TRUTH).reshape(3, -1).T
        noise = np.random.default_rng([0, first // PIECE]).standard_normal(v.shape)
        yield {"t [s]": t, "v [m/s^2]": v + by_hand.SIGMA * noise}


def command(count: int, workers: int) -> tuple[float, float, dict[str, Any]]:
    """µs of the processor for each sample, largest memory in MB, and what was estimated."""
    words = ["calibrate", "wheel", f"{__file__}:spin", "--partitions", "--json"]
    argv = [sys.executable, "-c", CODE, *words, "--workers", str(workers)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "SAMPLES": str(count)}
    done = subprocess.run(argv, env=environment, check=True, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    found = json.loads(done.stdout)
    return 1e6 * spent / count, after.ru_maxrss / 1024, found["estimate"]


def in_memory() -> float:
    """µs of the processor for each sample of a record that is there."""
    from casest import Run, attempt
    from casest.results.calibration import calibration_result
    from casest_problems.wheel import wheel

    parts = list(spin())
    t, v = (np.concatenate([p[name] for p in parts]) for name in ("t [s]", "v [m/s^2]"))
    run = Run.raw("wheel", {"t": t[:, None], "v": v}, units={}, time=t)
    attempt(wheel, [run.take(slice(None, None, 50))])  # compiles
    began = process_time()
    calibration_result(attempt(wheel, [run]), model_name="wheel", data=[]).content()
    return 1e6 * (process_time() - began) / len(run)


def main() -> None:
    """A line for each size."""
    whole = in_memory()
    print(f"in memory, {IN_MEMORY} samples: {whole:.2f} µs a sample", flush=True)
    for size in [int(float(word)) for word in sys.argv[1:]] or [IN_MEMORY]:
        one, memory, found = command(size, 1)
        two, _, other = command(size, 2)
        print(
            f"{size} samples: {one:.2f} µs with one worker ({one / whole:.2f} of that in memory), "
            f"{two:.2f} with two; {memory:.0f} MB; the same bits: {found == other}",
            flush=True,
        )


if __name__ == "__main__":
    main()
