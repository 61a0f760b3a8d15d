"""How often does `check` call a valid calibration invalid, and how soon does it see a change?

    make study-check                     # some ten minutes on one core, goes on where it was
    python studies/check.py --share 0.1  # fewer of each kind

An accelerometer turned into random poses (rotations of gravity, seen by an ellipsoid), a line
through noise with a colour, and a load cell of few readings. Every world has its own calibration
and its own new record. The table is written to `studies/check.md`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "studies")]

from resumed import done, kept  # noqa: E402
from scipy.signal import lfilter  # noqa: E402

from casest import Estimate, Model, Run, attempt, constant  # noqa: E402
from casest.validity.check import Check, check  # noqa: E402
from casest.validity.colour import colour_of  # noqa: E402
from casest.validity.old import Old  # noqa: E402
from casest_problems.norm import norm_triangular  # noqa: E402
from casest_problems.one_channel import linear, load_cell  # noqa: E402

TABLE = ROOT / "studies" / "check.md"
KEPT = ROOT / "out" / "studies" / "check.jsonl"
GRAVITY, LEVEL = 9.81, 1e-3
#: Worlds without a change, worlds of each change, and courses over dates.
STILL, CHANGED, COURSES = 1000, 100, 60
#: Dates of a course, without and with a shift.
DATES, SHIFTED = 30, 40
Records = Callable[..., tuple[Run, ...]]


# -- worlds ----------------------------------------------------------------------------------------


def sensor(rng: np.random.Generator) -> dict[str, Any]:
    """An accelerometer: scales within 5 %, axes within 3 %, offsets within 0.5 m/s²."""
    scale = np.diag(1 + rng.uniform(-0.05, 0.05, 3)) + np.tril(rng.uniform(-0.03, 0.03, (3, 3)), -1)
    return {"scale": scale, "offset": rng.uniform(-0.5, 0.5, 3), "sigma": 0.01}


def poses(
    rng: np.random.Generator, scale: Any, offset: Any, sigma: float, n: int, warm: float = 20.0
) -> tuple[Run, ...]:
    """Readings in n random attitudes, beside a temperature."""
    up = rng.normal(size=(n, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    v = np.linalg.solve(scale, GRAVITY * up.T).T + offset + rng.normal(0, sigma, (n, 3))
    return (Run.raw("poses", {"v": v}, units={"v": "m/s^2"}),)


def red(rng: np.random.Generator, n: int, phi: float) -> Any:
    """First-order noise of unit variance."""
    start = lfilter([np.sqrt(1 - phi**2)], [1, -phi], rng.normal(size=n + 400))
    return start[400:]


def line(rng: np.random.Generator, n: int, phi: float) -> tuple[Run, ...]:
    """A gauge against a reference that wanders, sampled every second, in coloured noise."""
    x = 5 + 3 * red(rng, n, 0.995)
    y = 2 + 3 * x + 0.1 * red(rng, n, phi)
    signals = {"reference": x[:, None], "reading": y[:, None]}
    units = {"reference": None, "reading": None}
    return (Run.raw("line", signals, units=units, time=np.arange(float(n))),)


def weights(rng: np.random.Generator, n: int) -> tuple[Run, ...]:
    """A load cell under n weights."""
    x = rng.uniform(0, 40, n)
    y = 5800 + 1000 * x + rng.normal(0, 15, n)
    return (
        Run.raw("cell", {"load": x[:, None], "reading": y[:, None]},
                units={"load": None, "reading": None}),
    )  # fmt: skip


def old_of(found: Estimate) -> Old:
    """As a saved result has it."""
    freedom = found.noise.degrees_of_freedom / found.correlated_over
    return Old(found.model, found.values, found.names, found.covariance, found.noise.sigma,
               freedom, colour_of(found))  # fmt: skip


def calibrated(model: Model, runs: Sequence[Run]) -> Old | None:
    """The old calibration; None where it was refused."""
    found = attempt(model, runs, solver="trust-region")
    return old_of(found) if found.certificate.trusted else None


def accelerometer(runs: Sequence[Run]) -> Old | None:
    """Of poses with the known gravity."""
    return calibrated(norm_triangular.having(norm=constant(GRAVITY, "m/s^2")), runs)


def world(kind: str, rng: np.random.Generator) -> tuple[Old | None, tuple[Run, ...]]:
    """A calibration and a new record with nothing changed."""
    if kind == "accelerometer, 24 poses, then 12":
        own = sensor(rng)
        return accelerometer(poses(rng, n=24, **own)), poses(rng, n=12, **own)
    if kind == "accelerometer, 24 poses, then 6":
        own = sensor(rng)
        return accelerometer(poses(rng, n=24, **own)), poses(rng, n=6, **own)
    if kind == "load cell, 8 weights, then 5":
        return calibrated(load_cell, weights(rng, 8)), weights(rng, 5)
    phi = float(kind.split()[-1])
    return calibrated(linear, line(rng, 4000, phi)), line(rng, 1000, phi)


KINDS = (
    "accelerometer, 24 poses, then 12",
    "accelerometer, 24 poses, then 6",
    "load cell, 8 weights, then 5",
    "line, noise that follows itself by 0.0",
    "line, noise that follows itself by 0.7",
    "line, noise that follows itself by 0.95",
)


def still(kind: str, seed: int) -> dict[str, Any]:
    """One world without a change."""
    rng = np.random.default_rng([1, KINDS.index(kind), seed])
    old, record = world(kind, rng)
    key = {"what": "still", "kind": kind, "seed": seed}
    if old is None:
        return key | {"p": None}
    date = check(old, [record], LEVEL).dates[0]
    return key | {"p": date.test.p_value, "noise": date.subject.noise.p_value}


# -- changes ---------------------------------------------------------------------------------------


def knocked(own: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """The offsets jump by 0.03 to 0.1 m/s² on each axis."""
    jump = rng.uniform(0.03, 0.1, 3) * rng.choice([-1, 1], 3)
    return own | {"offset": own["offset"] + jump}


def aged(own: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """All scales by a factor of 0.5 to 1.5 %."""
    return own | {"scale": own["scale"] * (1 + rng.uniform(0.005, 0.015) * rng.choice([-1, 1]))}


def one_scale(own: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """The scale of the last axis by 0.5 to 1.5 %."""
    scale = own["scale"].copy()
    scale[2, 2] *= 1 + rng.uniform(0.005, 0.015) * rng.choice([-1, 1])
    return own | {"scale": scale}


def bent(own: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """The axes turn against each other by 0.005 to 0.02 rad."""
    turn = rng.uniform(0.005, 0.02, (3, 3)) * rng.choice([-1, 1], (3, 3))
    return own | {"scale": own["scale"] + np.tril(turn, -1)}


def warmer(own: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """30 K more: offsets by 1 to 3 mm/s² and scales by 0.1 to 0.4 permille for each kelvin."""
    offset = own["offset"] + 30 * rng.uniform(1e-3, 3e-3, 3) * rng.choice([-1, 1], 3)
    return own | {"offset": offset, "scale": own["scale"] * (1 + 30 * rng.uniform(1e-4, 4e-4))}


def louder(own: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Noise three times as large."""
    return own | {"sigma": 3 * own["sigma"]}


CHANGES = {
    "a knock": (knocked, ("offset",)),
    "an ageing scale": (aged, ("scale by a common factor",)),
    "the scale of one axis": (one_scale, ("scale[2,2]",)),
    "axes that turned": (bent, ("scale between the axes",)),
    "a new temperature": (warmer, ("offset and scale", "scale and offset")),
    "louder noise": (louder, ("noise",)),
}


def changed(name: str, seed: int) -> dict[str, Any]:
    """One world with a change: was it seen, and what was it called?"""
    rng = np.random.default_rng([2, list(CHANGES).index(name), seed])
    own = sensor(rng)
    old = accelerometer(poses(rng, n=60, **own))
    key = {"what": "changed", "name": name, "seed": seed}
    if old is None:
        return key | {"seen": None}
    date = check(old, [poses(rng, n=40, **CHANGES[name][0](own, rng))], LEVEL).dates[0]
    called = [date.change.cause.label, *date.change.alike] if date.change else []
    called += ["noise"] if date.louder else []
    return key | {"seen": not date.valid, "called": called}


# -- many dates ------------------------------------------------------------------------------------


def course(size: float, seed: int) -> dict[str, Any]:
    """Dates of 24 poses each; from the first on one offset is off by `size` standard deviations of
    what a single date says of it. When is it seen, by the dates alone and with the chart?"""
    rng = np.random.default_rng([3, round(10 * size), seed])
    own = sensor(rng)
    old = accelerometer(poses(rng, n=400, **own))
    key = {"what": "course", "size": size, "seed": seed}
    if old is None:
        return key | {"dates": None}
    shift = size * own["sigma"] * ONE_DATE * np.eye(3)[2]
    moved = own | {"offset": own["offset"] + shift}
    dates = DATES if not size else SHIFTED
    records = [poses(rng, n=24, **moved) for _ in range(dates)]
    alone = check(old, records[:1], LEVEL)
    found: Check = check(old, records, LEVEL)
    by_date = [k for k, d in enumerate(found.dates) if not d.valid]
    by_chart = [k for k in range(1, dates) if found.chart.out(k)]
    return key | {"dates": dates, "first": not alone.valid, "by_date": by_date,
                  "by_chart": by_chart}  # fmt: skip


#: Standard deviation of an offset from 24 poses, in that of a reading: measured over 200 records.
ONE_DATE = 0.48
SIZES = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)


# -- the table -------------------------------------------------------------------------------------


def of_still(records: Sequence[dict[str, Any]]) -> list[str]:
    """False alarms at several levels."""
    lines = ["| | calibrations | alarms at 0.1 % | at 1 % | at 10 % |", "| --- " * 5 + "|"]
    for kind in KINDS:
        own = [r for r in records if r["what"] == "still" and r["kind"] == kind]
        p = np.array([2 * min(r["p"], r["noise"]) for r in own if r["p"] is not None])
        alarms = [int((p < level).sum()) for level in (1e-3, 1e-2, 0.1)]
        lines.append(f"| {kind} | {len(p)} | {' | '.join(map(str, alarms))} |")
    return lines


def of_changes(records: Sequence[dict[str, Any]]) -> list[str]:
    """What was seen and named."""
    lines = ["| | records | seen | named first | or nearly as good |", "| --- " * 5 + "|"]
    for name, (_, labels) in CHANGES.items():
        own = [r for r in records if r["what"] == "changed" and r["name"] == name]
        own = [r for r in own if r["seen"] is not None]
        seen = [r for r in own if r["seen"]]
        first = sum(r["called"][:1] != [] and r["called"][0] in labels for r in seen)
        among = sum(any(c in labels for c in r["called"]) for r in seen)
        lines.append(f"| {name} | {len(own)} | {len(seen)} | {first} | {among} |")
    return lines


def of_courses(records: Sequence[dict[str, Any]]) -> list[str]:
    """Run lengths over dates."""
    head = "| shift | courses | seen at the first date | dates until an alarm, by the dates alone "
    lines = [head + "| with the chart | never |", "| --- " * 6 + "|"]
    for size in SIZES[1:]:
        own = [r for r in records if r["what"] == "course" and r["size"] == size and r["dates"]]
        alone = [_first(r, chart=False) for r in own]
        both = [_first(r, chart=True) for r in own]
        lost = sum(b == own[0]["dates"] for b in both)
        first = sum(r["first"] for r in own)
        lines.append(
            f"| {size:g} σ | {len(own)} | {first} | {_average(alone, own)} | {_average(both, own)} "
            f"| {lost} |"
        )
    return lines


def _first(record: dict[str, Any], *, chart: bool) -> int:
    """Dates until the first alarm, all of them where there is none."""
    alarms = [*record["by_date"], *(record["by_chart"] if chart else [])]
    return min(alarms, default=record["dates"] - 1) + 1


def _average(lengths: Sequence[int], own: Sequence[dict[str, Any]]) -> str:
    cut = any(n == own[0]["dates"] for n in lengths)
    return f"{'> ' if cut else ''}{np.mean(lengths):.1f}"


def of_quiet(records: Sequence[dict[str, Any]]) -> str:
    """False alarms of courses without a shift."""
    own = [r for r in records if r["what"] == "course" and not r["size"] and r["dates"]]
    dates = sum(r["dates"] for r in own)
    by_date = sum(len(r["by_date"]) for r in own)
    courses = sum(bool(r["by_date"] or r["by_chart"]) for r in own)
    return (
        f"Without a shift: {by_date} of {dates} dates are called invalid by their own test, and "
        f"{sum(len(r['by_chart']) for r in own)} by the chart; {courses} of {len(own)} courses of "
        f"{DATES} dates have any alarm."
    )


TEXT = """# Is a calibration still valid?

How often `check` is wrong, and how soon it sees a change: `make study-check` (seeds fixed).

## False alarms

Every row: so many calibrations, each with a new record in which nothing changed. The chance that is
asked for is that of the parameters' and the noise's test together.

{still}

## What changed

An accelerometer of 60 poses, then 40 with a change, at 0.1 %: seen, and named by the label that the
cause has in `check` (`offset`, `scale by a common factor`, …). A new temperature moves offsets and
scales; that it is one shows in the column, which `check` names beside it.

{changes}

## Over dates

An accelerometer of 400 poses, then {dates} dates of 24 poses each. One offset is off from the
first date on, by so many standard deviations of what one date says of it. Half of the 0.1 % is that
of the dates, half that of the chart.

{courses}

{quiet}
"""


def tasks(share: float) -> list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]]:
    """Every record to make: function, arguments, and what it is known by."""
    found: list[Any] = []
    for kind in KINDS:
        for seed in range(max(1, round(share * STILL))):
            found.append((still, (kind, seed), {"what": "still", "kind": kind, "seed": seed}))
    for name in CHANGES:
        for seed in range(max(1, round(share * CHANGED))):
            found.append((changed, (name, seed), {"what": "changed", "name": name, "seed": seed}))
    for size in SIZES:
        for seed in range(max(1, round(share * COURSES))):
            found.append((course, (size, seed), {"what": "course", "size": size, "seed": seed}))
    return found


def one(function: str, *arguments: Any) -> dict[str, Any]:
    """Call one of the above by its name, in a process of its own."""
    return globals()[function](*arguments)


def main() -> None:
    """Make what is missing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the worlds of each kind")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    before = kept(KEPT)
    known = {tuple(r.get(k) for k in ("what", "kind", "name", "size", "seed")) for r in before}
    left = [
        (function.__name__, *arguments)
        for function, arguments, key in tasks(given.share)
        if tuple(key.get(k) for k in ("what", "kind", "name", "size", "seed")) not in known
    ]
    KEPT.parent.mkdir(parents=True, exist_ok=True)
    records = before + done(one, left, KEPT, given.workers)
    TABLE.write_text(
        TEXT.format(
            still="\n".join(of_still(records)),
            changes="\n".join(of_changes(records)),
            courses="\n".join(of_courses(records)),
            quiet=of_quiet(records),
            dates=SHIFTED,
        ),
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
