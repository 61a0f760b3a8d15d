"""Fitting differential equations: casest beside SciPy with sensitivities, and with differences.

    python benchmarks/equations.py [TIMES]

The certified problems, from their declared starts, in one process, medians of 5 (or TIMES) taken in
turn, seconds of the processor. SciPy's `least_squares` (trf, scaled by the Jacobian) is given the
same equations three times: integrated by CVODES (CasADi) to 1e-10 with forward sensitivities; the
same with differences; and as most write it, by `solve_ivp` (LSODA, 1e-10) with differences. casest
three times: its solver alone; with second ways and certificate; and all that `calibrate` does, with
the intervals of the likelihood and, where readings do not vouch for the fit, starts elsewhere.
acados and do-mpc cannot be installed where this was made, and are not compared.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).parents[1] / "studies"))
from equations import CASES, Case

from casest import attempt
from casest.declaration.tracing import sample_symbol
from casest.leastsquares.problem import Problem
from casest.solve.collocation import parts_of
from casest.solve.trust_region import trust_region

#: Error that CVODES allows itself.
TOLERANCE = 1e-10


def cvodes(case: Case) -> tuple[Callable[..., Any], Callable[..., Any], Any]:
    """Residuals and their Jacobian in the unknowns, by CVODES, and where the search begins."""
    model = case.model
    (run,) = case.read(model)
    problem, parts, traced = Problem(model, (run,)), parts_of(model), model.staged
    assert parts is not None
    assert run.time is not None
    flow, p = parts.flow, traced.coordinates
    dae = {"x": flow.x, "p": p, "ode": flow.rates}
    first = 0.0 if flow.anchored else float(run.time[0])
    every = np.asarray(run.time, float)
    later = every[every > first]
    settings = {"abstol": TOLERANCE * 1e-2, "reltol": TOLERANCE, "max_num_steps": 100_000}
    follow = ca.integrator("follow", "cvodes", dae, first, later.tolist(), settings)
    unknowns = ca.MX.sym("p", p.numel())
    start = parts.start(unknowns)
    states = follow(x0=start, p=unknowns)["xf"]
    if len(later) < len(every):
        states = ca.horzcat(start, states)
    sample = ca.Function("r", [flow.given, sample_symbol(model, traced), p], [traced.expression])
    samples = problem.samples[0].dense.T
    rows = [sample(states[:, i], samples[:, i], unknowns) for i in range(samples.shape[1])]
    residual = ca.Function("residual", [unknowns], [ca.vertcat(*rows)])
    slope = ca.Function("slope", [unknowns], [ca.jacobian(residual(unknowns), unknowns)])
    return (
        lambda x: np.array(residual(x)).ravel(),
        lambda x: np.array(slope(x)),
        problem.start().x,
    )


def written(name: str, y: Any, k: Any) -> tuple[Any, ...]:
    """Rates as they are written in Python."""
    if name.endswith("gasoil"):
        return -(k[0] + k[2]) * y[0] ** 2, k[0] * y[0] ** 2 - k[1] * y[1]
    if name.endswith("pinene"):
        third = k[1] * y[0] - (k[2] + k[3]) * y[2] + k[4] * y[4]
        used = -(k[0] + k[1]) * y[0], k[0] * y[0]
        return *used, third, k[2] * y[2], k[3] * y[2] - k[4] * y[4]
    return -y[0] + k[0] * y[0] * y[1], y[1] - k[1] * y[0] * y[1]


def usual(case: Case) -> Callable[..., Any]:
    """Residuals by `solve_ivp`: of k, then where the states begin where that is unknown."""
    (run,) = case.read(case.model)
    time = np.asarray(run.time, float)
    names = [n for n in run.signals if not n.startswith("std")]
    read = np.hstack([run.signals[n] for n in names])
    std = np.hstack([run.signals.get(f"std_{n}", np.ones((len(run), 1))) for n in names])
    known = {2: [1.0, 0.0], 5: [100.0, 0, 0, 0, 0]}
    count = len(case.right)

    def residual(x: Any) -> Any:
        k = x[:count]
        first = x[count:] if len(x) > count else known[read.shape[1]]
        begun = time[0] if len(x) > count else 0.0
        found = solve_ivp(
            lambda _, y: written(case.name, y, k), (begun, time[-1]), first, "LSODA", time,
            rtol=TOLERANCE, atol=TOLERANCE * 1e-2,
        )  # fmt: skip
        return ((read - found.y.T) / std).ravel()

    return residual


def ways(case: Case) -> dict[str, Callable[[], Any]]:
    """Each way to the optimum; gives the unknowns where it ends."""
    model = case.model
    runs = case.read(model)
    residual, slope, begun = cvodes(case)
    by_hand = usual(case)
    fine: Any = {"x_scale": "jac", "xtol": 1e-10, "ftol": 1e-10, "gtol": 1e-10}

    def alone() -> Any:
        problem = Problem(model, runs)
        return trust_region(problem, problem.start()).point.x

    return {
        "casest, the solver": alone,
        "casest, second ways": lambda: attempt(model, runs, intervals=False).point.x,
        "casest, the whole fit": lambda: attempt(model, runs).point.x,
        "SciPy, sensitivities": lambda: least_squares(residual, begun, jac=slope, **fine).x,
        "SciPy, differences": lambda: least_squares(residual, begun, **fine).x,
        "SciPy, solve_ivp": lambda: least_squares(by_hand, begun, **fine).x,
    }


def main() -> None:
    """The table."""
    times = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    for case in CASES[:3]:
        every = ways(case)
        ends = {
            name: way() for name, way in every.items()
        }  # and what is kept of the first is there
        taken: dict[str, list[float]] = {name: [] for name in every}
        for _ in range(times):
            for name, way in every.items():
                began = time.process_time()
                way()
                taken[name].append(time.process_time() - began)
        best = ends["casest, the whole fit"]
        print(case.name)
        for name in every:
            away = np.max(np.abs(ends[name] / best - 1))
            print(f"  {name:<24} {1e3 * median(taken[name]):9.1f} ms   differs by {away:.0e}")


if __name__ == "__main__":
    main()
