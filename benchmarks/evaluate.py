"""Time one evaluation of (½ Σ r², Jᵀr, JᵀJ) on a wheel-like model: replay against CasADi's map.

Run `python benchmarks/evaluate.py`. Both ways run in turns in one process, so that what else the
machine does hits both alike; the median of the ratios is what counts.
"""

from __future__ import annotations

import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casest.engine import Replay, normal_equations

N_SAMPLES = 18_000
TURNS = 15
REPLAYS_PER_TURN = 20
GRAVITY = 9.81


def rotation(angle: Any) -> Any:
    """Rotation matrix of the Euler angles x, y, z."""
    c, s = ca.cos(angle), ca.sin(angle)
    rx = ca.blockcat([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    ry = ca.blockcat([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    rz = ca.blockcat([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    return rz @ ry @ rx


def wheel() -> Any:
    """An accelerometer on a wheel: 15 parameters, 3 residuals; sample (t, vx, vy, vz)."""
    offset, gain, euler = ca.SX.sym("o", 3), ca.SX.sym("g", 3), ca.SX.sym("e", 3)
    radius, tilt, phase = ca.SX.sym("r"), ca.SX.sym("a"), ca.SX.sym("p")
    rate = ca.SX.sym("w", 3)
    parameters = ca.vertcat(offset, gain, euler, radius, tilt, phase, rate)
    t, reading = ca.SX.sym("t"), ca.SX.sym("v", 3)
    th = phase + t * (rate[0] + t * (rate[1] + t * rate[2]))
    w = rate[0] + t * (2 * rate[1] + t * 3 * rate[2])
    dw = 2 * rate[1] + 6 * rate[2] * t
    force = ca.vertcat(
        radius * w**2 + GRAVITY * ca.sin(tilt) * ca.cos(th),
        radius * dw + GRAVITY * ca.sin(tilt) * ca.sin(th),
        GRAVITY * ca.cos(tilt),
    )
    residual = offset + gain * (rotation(euler) @ force) - reading
    outputs = [residual, ca.jacobian(residual, parameters)]
    inputs = [parameters, ca.vertcat(t, reading)]
    return ca.Function("wheel", inputs, outputs, ["parameters", "sample"], ["r", "J"])


def summed(function: Any, count: int) -> Any:
    """CasADi's own way: cost, gradient and matrix per sample, mapped and summed."""
    p, s = ca.SX.sym("p", function.numel_in(0)), ca.SX.sym("s", function.numel_in(1))
    r, jacobian = function(p, s)
    terms = [0.5 * ca.sumsqr(r), jacobian.T @ r, jacobian.T @ jacobian]
    each = ca.Function("each", [p, s], terms)
    return each.map("sum", "serial", count, [0], [0, 1, 2])


def main() -> None:
    """Print both medians and the median of the ratios."""
    rng = np.random.default_rng(0)
    parameters = np.concatenate([rng.uniform(0.5, 1.5, 12), [6.0, 0.3, -0.01]])
    samples = np.column_stack([np.linspace(0, 10, N_SAMPLES), rng.normal(size=(N_SAMPLES, 3))])
    function = wheel()
    start = perf_counter()
    replay = Replay(function)
    normal = normal_equations(replay, parameters, samples)
    print(f"build and first call  {1e3 * (perf_counter() - start):8.2f} ms")
    mapped = summed(function, N_SAMPLES)
    matrix = np.array(mapped(parameters, samples.T)[2])
    error = np.abs(normal.matrix - matrix).max() / np.abs(matrix).max()
    print(f"largest difference    {error:8.1e} of the largest entry of JᵀJ")
    times = []
    for _ in range(TURNS):
        start = perf_counter()
        mapped(parameters, samples.T)
        middle = perf_counter()
        for _ in range(REPLAYS_PER_TURN):
            normal_equations(replay, parameters, samples)
        times.append((middle - start, (perf_counter() - middle) / REPLAYS_PER_TURN))
    by_map, by_replay = np.array(times).T
    print(f"map (serial, summed)  {1e3 * np.median(by_map):8.2f} ms")
    print(f"normal_equations      {1e3 * np.median(by_replay):8.2f} ms")
    print(f"ratio                 {np.median(by_map / by_replay):8.1f}")


if __name__ == "__main__":
    main()
