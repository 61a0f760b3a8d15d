"""Sensors per second of calibrate_many: a production line of triads, 24 poses and 9 unknowns each.

Run `python benchmarks/many.py`. Against it one call of IPOPT for each sensor: a plain nlpsol over
the sum of squares, built once, that is given the readings as parameters; started from declared
values and from the closed form, as calibrate_many is, with IPOPT's defaults and with its output
off. And casest's own IPOPT on one Problem per sensor, and the whole of `attempt` (polish, second
opinions, certificate). All run in turns in one process; medians of each, and their ratios. Seconds
are of the processor (one core), so that other work on the machine counts less.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casest import Run
from casest.estimate.calibrate import attempt
from casest.fleet.calibrate_many import calibrate_many
from casest.leastsquares.problem import Problem
from casest.solve.ipopt import ipopt
from casest_problems.norm import closed_form, norm_triangular

SENSORS, POSES, GRAVITY, SIGMA = 100_000, 24, 9.80665, 0.01
ONE_BY_ONE, SLOW, TURNS = 200, 20, 5
MODEL = norm_triangular.having(norm=GRAVITY)


def readings(count: int, seed: int = 0) -> Any:
    """Readings (S, N, 3) of sensors with offsets of ±0.5, gains ±3 %, skew ±1°."""
    rng = np.random.default_rng(seed)
    poses = rng.standard_normal((count, POSES, 3))
    poses *= GRAVITY / np.linalg.norm(poses, axis=2, keepdims=True)
    M = np.eye(3) + rng.uniform(-0.03, 0.03, (count, 3, 1)) * np.eye(3)
    M += np.tril(rng.uniform(-0.017, 0.017, (count, 3, 3)), -1)
    v = np.einsum("sij,snj->sni", M, poses) + rng.uniform(-0.5, 0.5, (count, 1, 3))
    return v + SIGMA * rng.standard_normal(v.shape)


def plain_ipopt() -> Callable[[Any, Any], Any]:
    """IPOPT built once for one sensor: x (9,) from readings (N, 3) and a start."""
    t = MODEL.traced
    r = ca.Function("r", [t.coordinates, t.symbols["v"]], [t.expression])
    v = ca.SX.sym("v", 3, POSES)
    cost = sum(r(t.coordinates, v[:, k]) ** 2 for k in range(POSES)) / 2
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
    problem = {"x": t.coordinates, "p": ca.vec(v), "f": cost}
    solver = ca.nlpsol("one", "ipopt", problem, options)
    rows, columns = np.tril_indices(3)
    lower = np.where(rows == columns, 0.0, -np.inf)

    def solve(own: Any, start: Any) -> Any:
        x0 = np.concatenate([start["scale"][rows, columns], start["offset"]])
        ball = np.max(np.linalg.norm(own, axis=1)) * np.ones(3)
        bounds = {
            "lbx": np.concatenate([lower, -ball]),
            "ubx": np.concatenate([0 * rows + np.inf, ball]),
        }
        return np.array(solver(x0=x0, p=own.ravel(), **bounds)["x"]).ravel()

    return solve


def recorded(own: Any) -> Any:
    """One sensor's record."""
    return (Run.raw("one", {"v": own}, units={"v": "m/s^2"}),)


def ways(v: Any) -> dict[str, tuple[int, Callable[[], Any]]]:
    """Number of sensors and what calibrates them."""
    plain = plain_ipopt()
    neutral = {"scale": np.eye(3), "offset": np.zeros(3)}

    def casest_ipopt(own: Any) -> Any:
        problem = Problem(MODEL, recorded(own))
        return ipopt(problem, problem.start(), options={})

    many, few = v[:ONE_BY_ONE], v[:SLOW]
    line = {"v": v}
    return {
        "calibrate_many, closed form": (
            len(v), lambda: calibrate_many(MODEL, line)
        ),
        "nlpsol, declared start": (len(many), lambda: [plain(own, neutral) for own in many]),
        "nlpsol, closed form": (
            len(many), lambda: [plain(own, closed_form(MODEL, recorded(own))) for own in many]
        ),
        "casest's IPOPT": (len(many), lambda: [casest_ipopt(own) for own in many]),
        "casest attempt": (len(few), lambda: [attempt(MODEL, recorded(own)) for own in few]),
    }  # fmt: skip


def main() -> None:
    """Medians of alternating runs; then what came out."""
    v = readings(int(sys.argv[1]) if len(sys.argv) > 1 else SENSORS)
    every = ways(v)
    rates: dict[str, list[float]] = {name: [] for name in every}
    for turn in range(TURNS + 1):
        for name, (count, run) in every.items():
            began = process_time()
            run()
            if turn:  # the first builds and warms up
                rates[name].append(count / (process_time() - began))
    medians = {name: float(np.median(rate)) for name, rate in rates.items()}
    first = next(iter(medians.values()))
    print(f"{len(v)} sensors, {POSES} poses, 9 unknowns; per second and core, ratio")
    for name, median in medians.items():
        print(f"  {name:32}{median:10.0f}{first / median:8.1f}")
    print(calibrate_many(MODEL, {"v": v}))


if __name__ == "__main__":
    main()
