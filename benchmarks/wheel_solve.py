"""Time a whole calibration of a wheel, 18 000 samples of 3 axes, against other ways to fit it.

Run `python benchmarks/wheel_solve.py`. casest's time contains its certificate; the others stop at
their solver's own word. All ways run in turns in one process, so that what else the machine does
hits all alike; the ratios of medians are what counts.

The start is 5 % off in everything but the speed: there the phase at the end is off by 0.4 rad.
Half a turn off, sines and data are uncorrelated and no local solver finds its way.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import by_hand
from casest import Run, attempt
from casest_problems.wheel import wheel

N_SAMPLES, SECONDS = 18_000, 90.0
TURNS = 15


def casest(run: Run, start: Any, solver: str) -> Any:
    """The whole of it, with certificate and covariance."""
    found = attempt(wheel, [run], start=by_hand.named(start), solver=solver)
    if not found.certificate.trusted:
        raise SystemExit(f"not trusted: {found.certificate.reasons}")
    return np.concatenate([np.ravel(found.values[name]) for name in by_hand.NAMES])


def scipy(t: Any, v: Any, start: Any, method: str) -> Any:
    """SciPy with analytic Jacobian."""
    w = by_hand.Wheel(t, v)
    return least_squares(w.residual, start, jac=w.jacobian, method=method, x_scale="jac").x


def ceres(t: Any, v: Any, start: Any) -> Any:
    """Ceres with one block of 3N residuals and analytic Jacobian."""
    import pyceres

    w, x = by_hand.Wheel(t, v), start.copy()

    class Block(pyceres.CostFunction):
        def __init__(self) -> None:
            pyceres.CostFunction.__init__(self)
            self.set_num_residuals(3 * len(t))
            self.set_parameter_block_sizes([15])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
            residuals[:] = w.residual(parameters[0])
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = w.jacobian(parameters[0]).ravel()
            return True

    problem, options, summary = pyceres.Problem(), pyceres.SolverOptions(), pyceres.SolverSummary()
    problem.add_residual_block(Block(), None, [x])
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_QR
    options.num_threads = 1
    pyceres.solve(options, problem, summary)
    return x


def ways(t: Any, v: Any) -> dict[str, Callable[[], Any]]:
    """Every way to solve it, by name."""
    start, run = by_hand.start(SECONDS), Run.raw("wheel", {"t": t[:, None], "v": v}, units={})
    built = by_hand.vectorised(t, v)
    found: dict[str, Callable[[], Any]] = {
        "casest, IPOPT": lambda: casest(run, start, "ipopt"),
        "casest, trust region": lambda: casest(run, start, "trust-region"),
        "MX + IPOPT, built and solved": lambda: _solved(by_hand.vectorised(t, v), start),
        "MX + IPOPT, solved": lambda: _solved(built, start),
        "SciPy lm": lambda: scipy(t, v, start, "lm"),
        "SciPy trf": lambda: scipy(t, v, start, "trf"),
    }
    if importlib.util.find_spec("pyceres"):
        found["Ceres"] = lambda: ceres(t, v, start)
    return found


def _solved(solver: Any, start: Any) -> Any:
    return np.array(solver(x0=start)["x"]).ravel()


def main() -> None:
    """Print medians, their ratios to casest's, and how far apart the solutions are."""
    t, v = by_hand.record(N_SAMPLES, SECONDS)
    every = ways(t, v)
    solutions = {name: solve() for name, solve in every.items()}  # and warm up
    times: dict[str, list[float]] = {name: [] for name in every}
    for _ in range(TURNS):
        for name, solve in every.items():
            began = perf_counter()
            solve()
            times[name].append(perf_counter() - began)
    medians = {name: float(np.median(spent)) for name, spent in times.items()}
    w, best = (
        by_hand.Wheel(t, v),
        min(float(np.sum(by_hand.Wheel(t, v).residual(x) ** 2)) for x in solutions.values()),
    )
    print(f"{'':30}      ms   over IPOPT  over trust region   excess cost")
    for name, median in medians.items():
        excess = float(np.sum(w.residual(solutions[name]) ** 2)) / best - 1
        first, second = (median / medians[f"casest, {s}"] for s in ("IPOPT", "trust region"))
        print(f"{name:30}{1e3 * median:8.1f}{first:10.1f}{second:18.1f}{excess:17.1e}")


if __name__ == "__main__":
    main()
