"""Time one evaluation of (½ Σ r², Jᵀr, JᵀJ) of the shipped wheel, 18 000 samples of 3 axes.

Run `python benchmarks/evaluate.py`. NumPy's replay of the instructions and the compiled kernel on
one and two cores, against a C kernel written by hand for this one model (fused_wheel.c) and
CasADi's own `map`. All run in turns in one process, so that what else the machine does hits all
alike; the ratios of medians are what counts.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import by_hand, fused
from casest.declaration.tracing import function_of
from casest.engine import Replay, kernel, normal_equations
from casest_problems.wheel import wheel

N_SAMPLES, LONG = 18_000, 500_000
TURNS = 41


def function() -> Any:
    """Residual and Jacobian of one sample of the shipped model."""
    t = wheel.traced
    return function_of(wheel, {"r": t.expression, "J": ca.jacobian(t.expression, t.coordinates)})


def summed(count: int) -> Any:
    """CasADi's own way: cost, gradient and matrix per sample, mapped and summed."""
    per_sample = function()
    p, s = ca.SX.sym("p", 15), ca.SX.sym("s", 4)
    r, jacobian = per_sample(p, s)
    terms = [0.5 * ca.sumsqr(r), jacobian.T @ r, jacobian.T @ jacobian]
    return ca.Function("each", [p, s], terms).map("sum", "serial", count, [0], [0, 1, 2])


def by_replay(samples: Any, wish: str, cores: int = 1) -> Any:
    """An evaluation with or without the compiled kernel; the first call compiles."""
    replay = Replay(function(), grouped=(0, 1))  # as a model is evaluated

    def evaluate(x: Any) -> Any:
        os.environ["CASEST_KERNEL"] = wish
        kernel._cores = lambda: cores  # type: ignore[assignment]
        return normal_equations(replay, x, samples)

    evaluate(by_hand.TRUTH)
    return evaluate


def timed(ways: dict[str, Any], turns: int) -> dict[str, float]:
    """Median seconds of each."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(turns):
        for name, evaluate in ways.items():
            began = perf_counter()
            evaluate(by_hand.TRUTH)
            times[name].append(perf_counter() - began)
    return {name: float(np.median(spent)) for name, spent in times.items()}


def report(count: int, by_c: Any, turns: int) -> None:
    """Print medians and their ratios to the kernel written by hand."""
    t, v = by_hand.record(count)
    samples = np.asfortranarray(np.column_stack([t, v]))
    ways = {
        "NumPy replay": by_replay(samples, "off"),
        "compiled kernel": by_replay(samples, "always"),
        "compiled kernel, two cores": by_replay(samples, "always", cores=2),
    }
    matrix = ways["NumPy replay"](by_hand.TRUTH).matrix
    if by_c is not None:
        ways["C written by hand"] = fused.Fused(by_c, t, v)
        scale = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
        error = np.abs(ways["C written by hand"](by_hand.TRUTH)[0] - matrix) / scale
        assert error.max() < 1e-10, error.max()
    if count <= N_SAMPLES:
        mapped = summed(count)
        ways["CasADi map"] = lambda x: mapped(x, samples.T)
    medians = timed(ways, turns)
    least = medians.get("C written by hand", min(medians.values()))
    print(f"{count} samples{'':22}      ms   ns/sample   ratio")
    for name, median in medians.items():
        print(f"  {name:32}{1e3 * median:8.3f}{1e9 * median / count:12.1f}{median / least:8.2f}")


def main() -> None:
    """One short record and one long one."""
    with tempfile.TemporaryDirectory() as folder:
        by_c = fused.compiled(Path(folder))
        report(N_SAMPLES, by_c, TURNS)
        report(LONG, by_c, TURNS // 4)


if __name__ == "__main__":
    main()
