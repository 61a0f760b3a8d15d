"""Plan a few, measure, calibrate, plan again: what that is worth beside one plan at once.

    make study-sequential       # python studies/sequential.py: some minutes on one core

The table is written to `studies/sequential.md`. Readings are simulated by the closed form here; the
first part calibrates with casest, as a user does, the second looks up what is likeliest on a grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import Residual, Run, attempt, exp, model, param, signal
from casest.plan.candidates.candidates import Noise
from casest.plan.candidates.rows import settings
from casest.plan.design.criteria import Volume
from casest.plan.design.several import Several, beside
from casest.plan.planning import Task, criterion_of, planned, task

Array = NDArray[np.float64]
TABLE = Path(__file__).resolve().parent / "sequential.md"
#: Simulated sensors of each part; times at which one can read, s.
SENSORS, TIMES = 200, np.arange(0.0, 20.05, 0.1)


# -- a decay of unknown size and rate --------------------------------------------------------------


@model
def decay(t=signal("s"), y=signal("V"), *, size=param("V", start=1.0), k=param("1/s", start=0.5)):
    """What a sensor gives back of a step that fades."""
    return Residual(measured=y, predicted=size * exp(-k * t))


#: Readings in all and in each stage, their noise in V; spread of ln k and ln size among sensors.
ALL, STAGE, READ, RATES, SIZES = 12, 4, 0.02, 0.7, 0.3


def next_times(values: Any, count: int, before: Sequence[float]) -> list[float]:
    """The times that casest plans, for values that are thought likely, after readings before."""
    noise = Noise(np.array([READ]), {})
    every = settings(decay, values, noise, {"t": TIMES[:, None]})
    there = np.zeros((2, 2))
    if before:
        own = settings(decay, values, noise, {"t": np.array(before)[:, None]}).factors[:, 0]
        there = own.T @ own
    given = task(every.factors, there, every.names, "decay")
    return [float(TIMES[i]) for i in planned(given, criterion_of(given, "D"), count).chosen]


def fitted(t: Array, y: Array) -> tuple[dict[str, Any], bool]:
    """What casest makes of the readings, and whether it trusts it."""
    run = Run.raw("r", {"t": t[:, None], "y": y[:, None]}, units={"t": "s", "y": "V"})
    found = attempt(decay, [run], intervals=False)
    return dict(found.values), bool(found.certificate.trusted)


def read(truth: Array, t: Sequence[float], rng: np.random.Generator) -> Array:
    """The closed form, with noise."""
    size, k = truth
    return np.asarray(size * np.exp(-k * np.array(t)) + READ * rng.standard_normal(len(t)))


def in_stages(truth: Array, rng: np.random.Generator) -> tuple[list[float], dict[str, Any], bool]:
    """Plan four for what is thought likely, measure, calibrate, and again: times, values, trust."""
    t, y, values, good = list[float](), np.zeros(0), dict(LIKELY), False
    while len(t) < ALL:
        more = next_times(values, STAGE, t)
        t, y = t + more, np.append(y, read(truth, more, rng))
        values, good = fitted(np.array(t), y)
    return t, values, good


#: What the model declares to begin with.
LIKELY = {"size": np.array(1.0), "k": np.array(0.5)}


def stages() -> Iterator[str]:
    """Twelve readings: evenly, at random, planned at once, planned four by four."""
    rng = np.random.default_rng(3)
    every = np.exp(rng.standard_normal((SENSORS, 2)) * [SIZES, RATES]) * [1.0, 0.5]
    once = next_times(LIKELY, ALL, [])
    even = [float(x) for x in np.linspace(TIMES[0], TIMES[-1], ALL)]
    found: dict[str, list[tuple[float, float, bool]]] = {}
    for i, truth in enumerate(every):
        draw = np.random.default_rng([i, 1])
        random = [float(x) for x in draw.choice(TIMES, ALL)]
        for way, t in {"evenly": even, "at random": random, "at once": once}.items():
            values, good = fitted(np.array(t), read(truth, t, np.random.default_rng(i)))
            found.setdefault(way, []).append((*judged(truth, t, values), good))
        t, values, good = in_stages(truth, np.random.default_rng(i))
        found.setdefault("four by four", []).append((*judged(truth, t, values), good))
    yield "| twelve readings | error of ln k, rms | 90 % below | std over that at once | trusted |"
    yield "| --- | --- | --- | --- | --- |"
    there = np.array([std for _, std, _ in found["at once"]])
    for way, rows in found.items():
        off, std, good = (np.array(column) for column in zip(*rows, strict=True))
        ratio = np.exp(np.mean(np.log(std / there)))
        size = np.abs(off)
        yield (
            f"| {way} | {np.sqrt(np.mean(size[good] ** 2)):.3f} | "
            f"{np.quantile(size[good], 0.9):.3f} | {ratio:.2f} | {int(good.sum())} of {SENSORS} |"
        )


def judged(truth: Array, t: Sequence[float], values: Any) -> tuple[float, float]:
    """Error of ln k, and the standard deviation that these times allow by the closed form."""
    size, k = truth
    at = np.array(t)
    J = np.exp(-k * at)[:, None] * np.column_stack([np.ones(len(at)), -size * k * at]) / READ
    off = np.log(max(float(values["k"]), 1e-6) / k)
    return float(off), float(np.sqrt(np.linalg.pinv(J.T @ J, rcond=1e-12)[1, 1]))


# -- planned for a spread of values, or one after the other ----------------------------------------

#: A decay exp(−kt) whose ln k is known to 0.7; noise of a reading.
SPREAD, NOISE = 0.7, 0.05


def robust() -> Iterator[str]:
    """Six readings of a decay: planned at once, averaged, for the worst, or two by two."""
    rng = np.random.default_rng(11)
    logs = np.log(0.5) + SPREAD * rng.standard_normal(SENSORS)
    even = np.linspace(0, len(TIMES) - 1, 7).round().astype(int)[1:]
    draws = np.log(0.5) + SPREAD * np.random.default_rng(5).standard_normal(16)
    at_once = {
        "evenly spread": even,
        "at once, for the likeliest value": best_times([np.log(0.5)], 6, False, []),
        "at once, averaged": best_times(draws, 6, False, []),
        "at once, for the worst": best_times(draws, 6, True, []),
    }
    yield "| plan | rms error of ln k | 90 % of the errors below |"
    yield "| --- | --- | --- |"
    for name, chosen in at_once.items():
        errors_ = [fit(x, chosen, np.random.default_rng(i)) - x for i, x in enumerate(logs)]
        yield told_as(name, errors_)
    for name, first in (("likeliest", [np.log(0.5)]), ("averaged", draws)):
        errors_ = []
        for i, x in enumerate(logs):
            chosen = list(best_times(first, 2, False, []))
            for _ in range(2):
                now = fit(x, chosen, np.random.default_rng(i))
                chosen += best_times([now], 2, False, chosen)
            errors_.append(fit(x, chosen, np.random.default_rng(i)) - x)
        yield told_as(f"two by two, the first {name}, each fitted before the next", errors_)


def told_as(name: str, errors_: list[float]) -> str:
    """A row of the table."""
    size = np.abs(errors_)
    return f"| {name} | {np.sqrt(np.mean(size**2)):.3f} | {np.quantile(size, 0.9):.3f} |"


def best_times(logs: Any, count: int, worst: bool, before: list[int]) -> list[int]:
    """Times for values of ln k, after readings that there are already."""
    factors = [(-np.exp(x) * TIMES * np.exp(-np.exp(x) * TIMES) / NOISE)[:, None, None]
               for x in logs]  # fmt: skip
    known = [1 / SPREAD**2 + np.sum(F[before] ** 2) for F in factors]
    names = tuple(f"ln k {i}" for i in range(len(known)))
    given = Task(beside(factors), np.diag(known), np.ones(len(known)), names)
    return list(planned(given, Several(Volume(), len(known), worst), count).chosen)


def fit(x: float, chosen: Any, rng: Any) -> float:
    """ln k of readings of a decay, with what is known of it beforehand."""
    t = TIMES[list(chosen)]
    y = np.exp(-np.exp(x) * t) + NOISE * rng.standard_normal(len(t))
    grid = np.linspace(np.log(0.5) - 4 * SPREAD, np.log(0.5) + 4 * SPREAD, 4001)
    off = (y - np.exp(-np.exp(grid)[:, None] * t)) / NOISE
    cost = np.sum(off**2, axis=1) + ((grid - np.log(0.5)) / SPREAD) ** 2
    return float(grid[int(np.argmin(cost))])


PARTS = {
    "A decay of unknown size and rate": stages,
    "A decay of size one whose ln k is known to 0.7": robust,
}


def main() -> None:
    """Both parts."""
    lines = ["# One plan, and plans one after the other", "", "Made by `make study-sequential`: "
             f"{SENSORS} simulated sensors."]  # fmt: skip
    for title, part in PARTS.items():
        lines += ["", f"## {title}", "", *part()]
        print("\n".join(lines[-12:]), flush=True)
    TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
