"""A million samples of a turning body, 9 states: filter, smoother and Gramian, time and memory.
A nonlinear model of 3 states too.

Run `python benchmarks/motion_long.py` (`--samples 100000` for fewer). Each job runs in a process of
its own: processor time, and the most memory that was held at any moment beyond the record; of the
filter the result itself is 28 numbers a sample, with the smoother 46.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import process_time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from motion import RATE, record

from casest import Run, cross, norm_2, signal
from casest.dynamics import Motion, dynamics, measured, state
from casest.dynamics.course import followed
from casest.dynamics.gramian import Products, over_windows
from casest_problems.bias_gravity import bias_gravity

#: Gyro and accelerometer noise as it may be stated: it reaches the states along their estimates.
NOISY = bias_gravity.sensing(omega=7.6e-9, a=1.7e-8)


@dynamics
def leveller(
    omega=signal(3, "rad/s"), v=signal(3, "m/s"), *, g=state(3, "m/s^2", start=(0, 0, 9.8))
):
    """Its direction alone is read, so that it is nonlinear; what is read is of no matter here."""
    outputs = (measured(v, g / norm_2(g), intensity=0.1),)
    return Motion(rates={"g": -cross(omega, g)}, outputs=outputs)


def level(run: Run) -> Run:
    """Rocking about one axis by closed form, with readings of it."""
    t = np.asarray(run.time)
    angle, none = 0.6 * np.sin(0.5 * t), 0 * t
    omega = np.column_stack([0.3 * np.cos(0.5 * t), none, none])
    v = np.column_stack([none, np.sin(angle), np.cos(angle)])
    v += 0.1 * np.random.default_rng(0).standard_normal(v.shape)
    return Run.raw("rocking", {"omega": omega, "v": v}, units={}, time=t)


def gramian(run: Run) -> object:
    """Of the whole record and of 60 windows of a tenth of it."""
    products = Products.of(bias_gravity, run)
    products.gramian()
    return over_windows(products, 0.1 * len(run) / RATE)


JOBS: dict[str, Callable[[Run], object]] = {
    "filter": lambda run: followed(bias_gravity, run, smooth=False),
    "filter and smoother": lambda run: followed(bias_gravity, run),
    "filter, noisy inputs": lambda run: followed(NOISY, run, smooth=False),
    "nonlinear filter": lambda run: followed(leveller, level(run), smooth=False),
    "and its smoother": lambda run: followed(leveller, level(run)),
    "Gramian, whole": lambda run: Products.of(bias_gravity, run).gramian(),
    "Gramian and windows": gramian,
}


def held() -> float:
    """Most memory held so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> None:
    """Print a row a job; with --job do that one here."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--job", choices=JOBS)
    asked = parser.parse_args()
    if not asked.job:
        print(f"{asked.samples} samples, {bias_gravity.size} states", flush=True)
        for job in JOBS:
            words = ["--samples", str(asked.samples), "--job", job]
            subprocess.run([sys.executable, __file__, *words], check=True)
        return
    JOBS[asked.job](record(1000 / RATE))  # what is compiled is compiled
    run = record(asked.samples / RATE)
    before, begin = held(), process_time()
    result = JOBS[asked.job](run)
    spent = process_time() - begin
    assert result is not None
    print(f"{asked.job:<22}{spent:8.2f} s{held() - before:8.0f} MB", flush=True)


if __name__ == "__main__":
    main()
