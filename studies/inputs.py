"""Noise of a gyro is no rotation: rank, bound and honesty at rest, on one axis, on all of them.

    make study-inputs                     # python studies/inputs.py: about twenty minutes
    python studies/inputs.py --quick      # few runs; inputs.md left as it is

Gravity and bias of a body that stays where it is and turns as `tests/flights.py` says, its attitude
by small rotations that share no code with the filter. The noise of its gyro grows; the filter and
the smoother begin from a start drawn from what they are told of it. Written to `studies/inputs.md`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from time import perf_counter

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import flights  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from resumed import kept  # noqa: E402
from scipy.stats import chi2  # noqa: E402

from casest import Run  # noqa: E402
from casest.dynamics import Dynamics  # noqa: E402
from casest.dynamics.filter import Filtered, filtered  # noqa: E402
from casest.results.observability import observe_motion  # noqa: E402
from casest_problems.bias_gravity import bias_gravity  # noqa: E402

Array = NDArray[np.float64]

TABLE = ROOT / "studies" / "inputs.md"
#: Each line of the table as it is made: an interrupted study goes on where it stopped.
KEPT = ROOT / "out" / "inputs.jsonl"
DT, SECONDS = 0.02, 60.0
NOISES = (0.0, 0.05, 0.2, 1.0)
SIGMA = {"a": 0.02, "v": 0.01}
#: What is known at the beginning.
PRIOR = {"velocity": 0.01, "gravity": 10.0, "bias": 1.0}
#: Records of which `observe` is asked.
FEW = 20


def estimator(degrees: float) -> Dynamics:
    """With the sensors' noises as they are; a gyro without noise is an exact input."""
    sigma = SIGMA | ({"omega": float(np.radians(degrees))} if degrees else {})
    quiet = bias_gravity.driven(velocity=0.0, gravity=0.0, bias=0.0)
    return quiet.known_to(**PRIOR).sensing(**{name: s**2 * DT for name, s in sigma.items()})


def record(t: Array, omega: Array, gravity: Array, degrees: float, seed: int) -> Run:
    """What the sensors of a body at one place read."""
    rng = np.random.default_rng(seed)
    exact = {"a": flights.BIAS - gravity, "omega": omega, "v": np.zeros_like(omega)}
    sigma = {**SIGMA, "omega": np.radians(degrees)}
    signals = {n: x + sigma[n] * rng.standard_normal(x.shape) for n, x in exact.items()}
    return Run.raw("spun", signals, units=flights.UNITS, time=t)


def normalised(found: Filtered, truth: Array) -> Array:
    """Squared errors over what is claimed: the filter at half time and at the end, the smoother at
    the beginning and at half time."""
    half, pairs = len(truth) // 2, []
    pairs += [(found.x[k] - truth[k], found.P[k]) for k in (half, -1)]
    pairs += [(found.smoothed[k] - truth[k], found.smoothed_P[k]) for k in (0, half)]
    return np.array([e @ np.linalg.solve(P, e) for e, P in pairs])


def row(spin: str, degrees: float, runs: int) -> str:
    """A line of the table."""
    t = np.arange(0, SECONDS, DT)
    rate, known = flights.SPINS[spin]
    omega, gravity = rate(t), flights.spun(rate, t)
    truth = np.hstack([0 * gravity, gravity, np.tile(flights.BIAS, (len(t), 1))])
    model, squares, claimed, least, told, ranks = estimator(degrees), [], [], [], [], []
    for seed in range(runs):
        run = record(t, omega, gravity, degrees, seed)
        rng = np.random.default_rng([seed, 1])
        start = truth[0] + np.repeat(list(PRIOR.values()), 3) * rng.standard_normal(9)
        begun = model.beginning(velocity=start[:3], gravity=start[3:6], bias=start[6:])
        found = filtered(begun, run)
        own = np.nanmean(found.normalised_innovations[len(t) // 10 :]) / 3
        squares.append([*normalised(found, truth), own])
        claimed.append(found.std[-1, 3:6].max())
        least.append(found.least)
        if seed < FEW:
            for told_of in (begun, unsaid(begun)):
                seen = observe_motion(told_of, run)
                ranks.append(seen.rank)
            told.append([np.nan if s is None else s for s in seen.std["gravity"]])
    mean = np.mean(squares, axis=0)
    low, high = chi2.ppf([0.005, 0.995], 9 * runs) / runs
    shown = [f"{m:.2f}{'' if low < m < high else ' (!)'}" for m in mean[:4]]
    right = f"{np.mean(np.array(ranks) == 3 + known):.0%}"
    return (
        f"| {spin} | {degrees:g} | {3 + known} | {right} | {bound(told)} | "
        f"{np.median(claimed):.3g} | {' | '.join(shown)} | {9 * np.median(least):.2f} | "
        f"{mean[4]:.3f} |"
    )


def unsaid(model: Dynamics) -> Dynamics:
    """The same where nobody said what noise the gyro has: `observe` finds it."""
    return replace(model, sensors={n: q for n, q in model.sensors.items() if n != "omega"})


def bound(stds: list[list[float]]) -> str:
    """The largest of the three that `observe` gives, or that there is none."""
    most = np.max(np.array(stds), axis=1)
    return "not determined" if np.isnan(most).mean() > 0.5 else f"{np.nanmedian(most):.3g}"


PAGE = """# Noise of a gyro is no rotation

Made by `make study-inputs` (`python studies/inputs.py`, {minutes:.0f} minutes on one core).

A body stays where it is and turns; 50 Hz, {seconds:.0f} s, noise 0.02 m/s² (accelerometer) and 0.01
m/s (velocity), gyro as listed (°/s, white, one reading). Estimated are velocity, gravity and bias
from a start drawn from what the filter is told: 0.01 m/s, 10 m/s² and 1 m/s² on each axis.

* **rank**: the true one of nine (Batista, theorem 2), and in how many of {few} records `observe`
  says so, half of the answers with the gyro's noise stated, half with it found from the record.
* **bound**: the largest standard deviation of gravity's three that `observe` gives (m/s²).
* **claimed**: the largest that the filter claims at the end, median. The prior is 10; where gravity
  and bias move together the prior of the bias, 1, is what remains.
* **NEES**: squared errors over what is claimed, mean of {runs} runs, nine expected; 99 % of such
  means lie within {low:.2f} to {high:.2f}, (!) marks those that do not. Filter at half time and
  at the end, smoother at the beginning and at half time.
* **at least**: what `filter` says that the NEES at the end may come down to, median; below 8.55 it
  says so at the prompt, too.
* **NIS**: squared innovations over what is expected, one expected.

| motion | gyro °/s | rank | said | bound | claimed | filter, half | filter, end | \
smoother, start | smoother, half | at least | NIS |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{rows}

{said}
"""

SAID = """Before inputs were estimated, the same filter counted the noise as motion: at rest with
0.05 °/s it claimed 0.78 m/s² for what nothing shows, and its NEES was 37 after a minute; with 1 °/s
0.13 m/s² and 48 000, with NIS at 1.0 in both, so that nothing warned (20 runs). Along the filter's
own states, not the smoothed ones, 1 °/s of noise beside 1 °/s of rate gave 10.8 at half time.

Not within the band is what shows a direction of gravity and bias to nobody, at rest and on one
axis: the filter claims up to a fifth more than its errors are (squared; NEES 7 to 8.2), never
less. What an estimate of the rate is wrong by lasts there as long as the record, acts on an error
as large as what was known beforehand, and is counted as if it were new at every sample. `filter`
says so, and how far the errors may fall below what it claims (at least)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--runs", type=int, default=200)
    options = parser.parse_args()
    runs = 4 if options.quick else options.runs
    lines = []
    KEPT.parent.mkdir(exist_ok=True)
    done = {tuple(r["key"]): r for r in kept(KEPT)}
    cases = [(spin, degrees, runs) for spin in flights.SPINS for degrees in NOISES]
    for number, case in enumerate(cases, 1):
        if case not in done:
            at = perf_counter()
            line = row(*case)
            done[case] = {"key": case, "line": line, "seconds": perf_counter() - at}
            with KEPT.open("a", encoding="utf-8") as file:
                file.write(json.dumps(done[case]) + "\n")
        print(f"{number}/{len(cases)} {done[case]['line']}", flush=True)
        lines.append(done[case]["line"])
    low, high = chi2.ppf([0.005, 0.995], 9 * runs) / runs
    page = PAGE.format(
        rows="\n".join(lines), said=SAID, runs=runs, few=FEW, seconds=SECONDS, low=low, high=high,
        minutes=sum(done[case]["seconds"] for case in cases) / 60,
    )  # fmt: skip
    if not options.quick:
        TABLE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
