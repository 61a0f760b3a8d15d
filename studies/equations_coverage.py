"""Simulated experiments of a differential equation: do 95 % intervals hold the truth?

`make study-equations-coverage`, or `python studies/equations_coverage.py [experiments]`:
studies/equations_coverage.md; what was computed is kept in out/equations_coverage.jsonl, so that a
second call goes on where the first was ended. Simulated by SciPy's DOP853 at 1e-12; gas oil as in
COPS, rates and where the first concentration begins unknown, noise not stated.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from resumed import done, kept
from scipy.integrate import solve_ivp
from scipy.stats import beta, t

from casest import Run, attempt, param, signal
from casest.dynamics import Motion, dynamics, measured, state

HERE = Path(__file__).parent
KEPT = HERE.parent / "out" / "equations_coverage.jsonl"
TRUTH = {"k1": 11.8, "k2": 8.3, "k3": 1.0, "a_start": 1.0}
TIMES, NOISE = np.linspace(0, 0.95, 25), 0.01


@dynamics
def gasoil(
    y1=signal(),
    y2=signal(),
    *,
    a=state(start=0.9),
    b=state(start=0.0, known=True),
    k1=param("1/s", start=8, bounds=(0, None)),
    k2=param("1/s", start=5, bounds=(0, None)),
    k3=param("1/s", start=2, bounds=(0, None)),
):
    """Catalytic cracking of gas oil."""
    rates = {"a": -(k1 + k3) * a**2, "b": k1 * a**2 - k2 * b}
    return Motion(rates=rates, outputs=(measured(y1, a), measured(y2, b)))


def experiment(number: int) -> dict[str, Any]:
    """One record, fitted: which intervals hold the truth."""
    k1, k2, k3, start = TRUTH.values()
    found = solve_ivp(
        lambda s, y: [-(k1 + k3) * y[0] ** 2, k1 * y[0] ** 2 - k2 * y[1]],
        (0, TIMES[-1]), [start, 0.0], "DOP853", TIMES, rtol=1e-12, atol=1e-14,
    ).y  # fmt: skip
    noisy = found + NOISE * np.random.default_rng(number).standard_normal(found.shape)
    signals = {name: y[:, None] for name, y in zip(("y1", "y2"), noisy, strict=True)}
    estimate = attempt(gasoil.calibration, [Run.raw("gasoil", signals, units={}, time=TIMES)])
    reach = t.ppf(0.975, estimate.noise.degrees_of_freedom)
    off = {name: float(estimate.values[name] - truth) for name, truth in TRUTH.items()}
    held = {name: bool(abs(off[name]) <= reach * estimate.std[name]) for name in TRUTH}
    return {"number": number, "trusted": bool(estimate.certificate.trusted), "held": held}


def results(count: int) -> list[dict[str, Any]]:
    """Those that are kept, and the others computed."""
    before = kept(KEPT)
    left = [(n,) for n in range(count) if n not in {row["number"] for row in before}]
    rows = [*before, *(done(experiment, left, KEPT, workers=1) if left else [])]
    return [row for row in rows if row["number"] < count]


def table(rows: list[dict[str, Any]]) -> str:
    """How many intervals hold the truth, with what chance leaves open (Clopper & Pearson)."""
    trusted = [row for row in rows if row["trusted"]]
    n = len(trusted)
    lines = [
        "# Do intervals of differential equations hold the truth?",
        "",
        f"`python studies/equations_coverage.py {len(rows)}`: {len(rows)} simulated experiments, "
        f"{n} trusted; gas oil, 25 times two readings, noise of 0.01 that is not stated. 95 % "
        "intervals; beside each count the interval of its probability (95 %).",
        "",
        "| unknown | held | share |",
        "| --- | --- | --- |",
    ]
    every = [(name, [row["held"][name] for row in trusted]) for name in TRUTH]
    for name, held in every:
        k = sum(held)
        low = beta.ppf(0.025, k, n - k + 1) if k else 0.0
        high = beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
        share = f"{100 * k / n:.1f} % ({100 * low:.0f} to {100 * high:.0f})"
        lines.append(f"| {name} | {k} of {n} | {share} |")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> None:
    """Experiments, and the table of all that are kept."""
    words = sys.argv[1:] if arguments is None else arguments
    text = table(results(int(words[0]) if words else 1000))
    (HERE / "equations_coverage.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
