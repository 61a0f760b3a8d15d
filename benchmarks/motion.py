"""Gramian, Riccati equation and filter of a turning body: 9 states, 100 Hz, against other ways.

Run `python benchmarks/motion.py` (`--seconds 30` for a shorter record). Everything is timed in one
process, best of three; solve_ivp (DOP853, rtol 1e-10) integrates the same ODE along the same
straight lines between samples, once, over the first tenth of the record, and its time counts ten
times. The plain loop is the Kalman filter's textbook form, one sample after the other.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.integrate import solve_ivp

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casest import Run
from casest.declaration.shapes import Array
from casest.dynamics.filter import filtered
from casest.dynamics.gramian import gramian, gramian_by_ode
from casest.dynamics.record import least_squares
from casest.dynamics.riccati import riccati
from casest.dynamics.transition import Linearised, linearised, process_noise, transitions
from casest_problems.bias_gravity import bias_gravity

RATE = 100
SHARE = 10


def record(seconds: float) -> Run:
    """Readings of a body that turns about changing axes; their values do not change the time."""
    t = np.arange(0, seconds, 1 / RATE)
    omega = np.c_[0.5 * np.sin(0.3 * t), 0.4 * np.cos(0.21 * t), 0.3 * np.sin(0.11 * t + 1)]
    rng = np.random.default_rng(0)
    a, v = rng.standard_normal((2, len(t), 3))
    return Run.raw("turning", {"a": a, "omega": omega, "v": v}, units={}, time=t)


def timed(work: Callable[[], object], rounds: int = 3) -> float:
    """Seconds of the fastest round."""
    found = []
    for _ in range(rounds):
        begin = perf_counter()
        work()
        found.append(perf_counter() - begin)
    return min(found)


def by_ivp(
    system: Linearised, rate: Callable[[Array, Array], Array], P: Array, back: bool
) -> Array:
    """The matrix ODE Ṗ = rate(A, P) over the first samples, backwards on request."""
    n, last = len(P), (len(system.time) - 1) // SHARE

    def slope(t: float, p: Array) -> Array:
        k = min(int(t * RATE), last - 1)
        share = t * RATE - k
        A = system.A[k] + share * (system.A[k + 1] - system.A[k])
        return rate(A, p.reshape(n, n)).ravel()

    span = (last / RATE, 0.0) if back else (0.0, last / RATE)
    end = solve_ivp(slope, span, P.ravel(), method="DOP853", rtol=1e-10, atol=1e-14).y[:, -1]
    return np.asarray(end).reshape(n, n)


def by_loop(system: Linearised) -> Array:
    """The filter sample by sample in NumPy, the transitions given; returns the last state."""
    model, (Phi, u) = bias_gravity, transitions(system)
    Q, R = process_noise(system, model.process), model.noise * RATE
    x, P, eye = model.start, model.start_covariance, np.eye(model.size)
    for k in range(len(Phi)):
        x, P = Phi[k] @ x + u[k], Phi[k] @ P @ Phi[k].T + Q[k]
        C = system.C[k + 1]
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        x = x + K @ (system.y[k + 1] - C @ x)
        P = (eye - K @ C) @ P
    return x


def main() -> None:
    """Print times and ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=300.0)
    run = record(parser.parse_args().seconds)
    system = linearised(bias_gravity, run)
    weight = np.linalg.inv(bias_gravity.noise)
    info, noise = system.C[0].T @ weight @ system.C[0], bias_gravity.process
    jobs: dict[str, Callable[[], object]] = {
        "Gramian": lambda: gramian(bias_gravity, replace(system)),
        "Riccati": lambda: riccati(bias_gravity, system),
        "filter": lambda: filtered(bias_gravity, run, smooth=False),
        "filter and smoother": lambda: filtered(bias_gravity, run),
    }
    times = {name: timed(job) for name, job in jobs.items()}
    others: dict[tuple[str, str], Callable[[], object]] = {
        ("Gramian", "solve_ivp"): lambda: by_ivp(
            system, lambda A, W: -(A.T @ W + W @ A + info), 0 * noise, True
        ),
        ("Riccati", "solve_ivp"): lambda: by_ivp(
            system,
            lambda A, P: A @ P + P @ A.T + noise - P @ info @ P,
            bias_gravity.start_covariance,
            False,
        ),
    }
    half = run.take(slice(len(run) // 2))
    part = linearised(bias_gravity, half)
    halves = {
        "Gramian": timed(lambda: gramian(bias_gravity, replace(part))),
        "Riccati": timed(lambda: riccati(bias_gravity, part)),
        "filter": timed(lambda: filtered(bias_gravity, half, smooth=False)),
        "filter and smoother": timed(lambda: filtered(bias_gravity, half)),
    }
    print(f"{len(run)} samples, {bias_gravity.size} states; of half the record in brackets")
    for name, seconds in times.items():
        print(f"{name:<22}{seconds:8.3f} s ({halves[name]:.3f} s)")
    print(f"least squares         {timed(lambda: least_squares(bias_gravity, run), 1):8.3f} s")
    begin = perf_counter()
    ode, product = gramian_by_ode(bias_gravity, system, 1e-13), gramian(bias_gravity, system)
    spent, scale = perf_counter() - begin, np.sqrt(np.diag(product))
    apart = np.abs((ode - product) / np.outer(scale, scale)).max()
    print(f"Gramian by CVODES     {spent:8.3f} s; both forms differ by {apart:.1g} (relative)")
    for (name, way), job in others.items():
        print(f"{way}, {name:<11}{SHARE * timed(job, 1) / times[name]:8.1f} times as long")
    slow = timed(lambda: by_loop(system), 1)
    print(f"plain loop, filter    {slow / times['filter']:8.1f} times as long")


if __name__ == "__main__":
    main()
