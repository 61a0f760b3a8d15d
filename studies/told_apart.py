"""Causes that a record left open: does the planned measurement tell them apart?

    make study-told-apart       # python studies/told_apart.py [WORLDS]

Three sensors: an accelerometer with a response that is bent in one of three ways, in few poses; a
load cell and a magnetometer in which temperature and current rise together, and one of the two
acts. Where `close` names what explains the record as well, `plan --separate` plans with at most 200
measurements (the command's default); the true sensor is measured so, and as often at random among
the same candidates; the readings are appended to the record, and `close` has the last word. What
was done is kept in `out/told_apart.jsonl`, so that the study goes on where it stopped; the table
is written to `studies/told_apart.md`.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from resumed import kept

from casest import Run
from casest.diagnose.loop import close
from casest.errors import CasestError
from casest.plan.candidates.attitudes import directions
from casest.plan.candidates.candidates import Noise
from casest.plan.candidates.finding import Possible, candidates
from casest.plan.rivals.rivals import refitted
from casest.plan.rivals.separating import separated, separation
from casest_problems.norm import norm_diagonal, norm_triangular
from casest_problems.one_channel import load_cell

Array = NDArray[np.float64]
Readings = dict[str, Array]
ROOT = Path(__file__).resolve().parent.parent
KEPT, TABLE = ROOT / "out" / "told_apart.jsonl", ROOT / "studies" / "told_apart.md"
MOST = 200
UNITS = {"temperature": "degC", "current": "A"}
#: Causes with which another one is as true, since it contains them.
WIDER = {
    f"{what}_{how}({column})": f"{what}_{wider}({column})"
    for what, column in (("temperature", "temperature"), ("channel", "current"))
    for how, wider in (("bias", "curve"), ("gain", "gain_curve"))
}


@dataclass(frozen=True)
class Sensor:
    """A true sensor: its model as declared, the cause, what it was read at and can be read at."""

    model: Any
    cause: str
    noise: float
    units: Mapping[str, str]
    first: Readings
    possible: Possible
    truth: Any

    def read(self, at: Readings, rng: np.random.Generator) -> Readings:
        """The columns of a record at these settings."""
        return {**at, **self.truth(at, rng)}


def bent(seed: int) -> Sensor:
    """An accelerometer whose response is quadratic, signed quadratic, or of another gain by sign.

    24 random poses.
    """
    rng = np.random.default_rng(seed)
    cause = ("quadratic", "signed_quadratic", "gain_by_sign")[seed // 3 % 3]
    scale = np.linalg.inv(np.eye(3) + 0.02 * np.tril(rng.standard_normal((3, 3))))
    offset, k, noise = 0.3 * rng.standard_normal(3), 4e-4 * rng.standard_normal(3), 0.002

    def truth(at: Readings, noises: np.random.Generator) -> Readings:
        force = 9.81 * at["up"]
        more = {
            "quadratic": k * force**2,
            "signed_quadratic": k * force * np.abs(force),
            "gain_by_sign": np.where(force > 0, 10 * k * force, 0.0),
        }[cause]
        seen = (force + more) @ scale.T + offset
        return {"v": seen + noise * noises.standard_normal(seen.shape)}

    up = directions(10)
    first = {"up": up[rng.choice(len(up), 24, replace=False)]}
    model = norm_triangular.having(norm=9.81)
    return Sensor(model, cause, noise, {"v": "m/s^2"}, first, Possible(), truth)


def drifting(rng: np.random.Generator, count: int) -> Readings:
    """Temperature and current that rise together."""
    u = np.linspace(0, 1, count)
    return {
        "temperature": 20 + 10 * u + 0.3 * rng.standard_normal(count),
        "current": 1 + 0.5 * u + 0.03 * rng.standard_normal(count),
    }


def acting(cause: str, at: Readings) -> Array:
    """What acts, one on either side of its middle."""
    if "temperature" in cause:
        return (at["temperature"].ravel() - 25) / 5
    return (at["current"].ravel() - 1.25) / 0.25


def loaded(seed: int) -> Sensor:
    """A load cell whose zero or sensitivity follows temperature or current; 40 loads."""
    rng = np.random.default_rng(seed)
    cause = list(WIDER)[seed // 3 % 4]
    size, noise = rng.choice([-1, 1]) * rng.uniform(0.6, 1.6), 0.05

    def truth(at: Readings, noises: np.random.Generator) -> Readings:
        load, u = at["load"].ravel(), acting(cause, at)
        y = 3 + 0.5 * load + size * u * (0.12 if "bias" in cause else 0.002 * load)
        return {"reading": (y + noise * noises.standard_normal(len(y)))[:, None]}

    load = rng.permutation(np.repeat(np.linspace(0, 100, 8), 5))
    first = {"load": load[:, None], **drifting(rng, len(load))}
    possible = Possible({"load": "0:100:10"})
    return Sensor(load_cell, cause, noise, {"load": "kg", "reading": "mV"}, first, possible, truth)


def magnetic(seed: int) -> Sensor:
    """A magnetometer whose offset or scale follows temperature or current; 48 poses."""
    rng = np.random.default_rng(seed)
    cause = list(WIDER)[seed // 3 % 4]
    scale, offset = 1 + 0.03 * rng.standard_normal(3), 5 * rng.standard_normal(3)
    k, noise = rng.standard_normal(3) * rng.uniform(0.5, 1.5), 0.1

    def truth(at: Readings, noises: np.random.Generator) -> Readings:
        u = acting(cause, at)[:, None]
        seen = 48.0 * at["up"] * scale + offset
        seen = seen + 0.4 * k * u if "bias" in cause else seen * (1 + 0.012 * k * u)
        return {"v": seen + noise * noises.standard_normal(seen.shape)}

    up = rng.standard_normal((48, 3))
    first = {"up": up / np.linalg.norm(up, axis=1, keepdims=True), **drifting(rng, 48)}
    model = norm_diagonal.having(norm=48.0)
    return Sensor(model, cause, noise, {"v": "uT"}, first, Possible(step=30.0), truth)


KINDS = {"accelerometer": bent, "load cell": loaded, "magnetometer": magnetic}


def recorded(sensor: Sensor, readings: Readings) -> Run:
    """A record: the model's signals, and columns of what else was logged."""
    own = {s.name for s in sensor.model.signals}
    signals = {name: v for name, v in readings.items() if name in own}
    run = Run.raw("record", signals, units=dict(sensor.units))
    columns = {name: v.ravel() for name, v in readings.items() if name in UNITS}
    return replace(run, columns=columns, column_units={n: UNITS[n] for n in columns})


def outcome(sensor: Sensor, closing: Any) -> tuple[str, str]:
    """What `close` says (right, wider, open, wrong, none), and its words."""
    said = [(f.candidate.label, list(f.indistinguishable_from)) for f in closing.effects]
    if not said:
        labels = list(closing.undecided.names) if closing.undecided else []
        what = "open" if sensor.cause in labels else "none"
        if what == "open" and not set(labels) - {sensor.cause, WIDER.get(sensor.cause)}:
            what = "wider"
        return what, f"one of {labels}" if labels else ""
    label, others = said[0]
    words = "; ".join(" or ".join([one, *rest]) for one, rest in said)
    if len(said) > 1:
        return "wrong", words
    if label == sensor.cause and not set(others) - {WIDER.get(sensor.cause)}:
        return ("wider" if others else "right"), words
    return ("open" if sensor.cause in [label, *others] else "wrong"), words


def one(seed: int) -> dict[str, Any]:
    """A sensor; what `close` says before and after, planned and at random."""
    kind = list(KINDS)[seed % 3]
    sensor = KINDS[kind](seed)
    rng = np.random.default_rng(seed + 10_000)
    before = sensor.read(sensor.first, rng)
    run = recorded(sensor, before)
    row: dict[str, Any] = {"seed": seed, "sensor": kind, "true": sensor.cause, "open": False}
    try:
        closing = close(sensor.model, [run])
    except CasestError as error:
        return row | {"refused": str(error)}
    found = next((f for f in closing.effects if f.indistinguishable_from), None)
    if found is not None:
        labels = [found.candidate.label, *found.indistinguishable_from]
    elif closing.undecided is not None:
        labels = list(closing.undecided.names)
    else:
        return row
    if not set(labels) - {sensor.cause, WIDER.get(sensor.cause)}:
        return row | {"labels": labels}  # named already, up to a wider form
    row |= {"open": True, "labels": labels, "before": outcome(sensor, closing)[0]}
    return row | planned(sensor, closing, labels, before, rng)


def planned(
    sensor: Sensor, closing: Any, labels: list[str], before: Readings, rng: np.random.Generator
) -> dict[str, Any]:
    """The plan, and what `close` says after it and after as many random measurements."""
    run, sigma = recorded(sensor, before), np.array([sensor.noise])
    noise = Noise(sigma, {})
    try:
        rivals = refitted(sensor.model, closing.before.values, [run], labels, sigma)
        possible = _with_columns(sensor, rivals, before)
        plan = separation(
            rivals, noise, lambda r: candidates(r.model, r.values, noise, possible), "world"
        )
        chosen = list(separated(plan, None, MOST, "world").chosen)
    except CasestError as error:
        return {"count": 0, "refused": str(error)}
    random = [int(k) for k in rng.choice(len(plan.candidates), len(chosen))]
    row: dict[str, Any] = {"count": len(chosen), "among": sensor.cause in plan.labels}
    for name, places in (("planned", chosen), ("random", random)):
        at = {n: plan.candidates.signals[n][places] for n in plan.candidates.signals}
        if plan.candidates.up is not None:
            at["up"] = plan.candidates.up[places]
        middle = {n: np.full((len(places), 1), np.median(before[n])) for n in UNITS if n in before}
        more = sensor.read({**middle, **at}, rng)
        both = {n: np.concatenate([v.reshape(len(v), -1), more[n].reshape(len(places), -1)])
                for n, v in before.items()}  # fmt: skip
        row[name], row[f"{name} said"] = outcome(
            sensor, close(sensor.model, [recorded(sensor, both)])
        )
        own = [c for p, c in zip(plan.pairs, plan.powers(places), strict=True)
               if p.true == sensor.cause]  # fmt: skip
        row[f"power {name}"] = float(min(own)) if own else None
    return row


def _with_columns(sensor: Sensor, rivals: Any, before: Readings) -> Possible:
    """Columns that a rival reads: three values of those that the record has, as the command."""
    own = {s.name for s in sensor.model.signals}
    extras = {s.name for r in rivals for s in r.model.signals} - own
    also = {n: np.unique(np.quantile(before[n], [0.0, 0.5, 1.0]))[:, None] for n in sorted(extras)}
    return replace(sensor.possible, also=also)


def drawn(wanted: int) -> list[dict[str, Any]]:
    """Sensors one after the other, until so many of them ended with several causes."""
    rows = kept(KEPT)
    KEPT.parent.mkdir(exist_ok=True)
    with KEPT.open("a", encoding="utf-8") as file:
        while sum(row["open"] for row in rows) < wanted:
            done = {row["seed"] for row in rows}
            rows.append(one(next(seed for seed in range(len(rows) + 1) if seed not in done)))
            print(json.dumps(rows[-1]), file=file, flush=True)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """What was named, and what the plans promised."""
    own = [row for row in rows if row["open"]]
    done = [row for row in own if row["count"]]
    lines = [
        "# Causes that a record left open, after the planned measurement",
        "",
        f"Made by `make study-told-apart`: {len(own)} sensors of {len(rows)} ended with several",
        f"causes. {len(done)} were planned for, with at most {MOST} measurements (median "
        f"{np.median([r['count'] for r in done]):g}); of {len(own) - len(done)} the",
        "plan said that so many tell nothing apart. Named: `close` on all readings names the true",
        "cause and leaves nothing beside it but what contains it (a curve contains a line); told",
        "apart: the chance that the plan states, were the true cause the true one, mean.",
        "",
        "| | measured | named | alone | still open | wrong | none | told apart |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    groups = {"all": done} | {k: [r for r in done if r["sensor"] == k] for k in KINDS}
    groups["the true cause is among those planned for"] = [r for r in done if r["among"]]
    for title, group in groups.items():
        if not group:
            continue
        for how in ("before", "planned", "random"):
            count = {w: sum(r[how] == w for r in group)
                     for w in ("right", "wider", "open", "wrong", "none")}  # fmt: skip
            named = count["right"] + count["wider"]
            promise = ""
            stated = [r[f"power {how}"] for r in group if r.get(f"power {how}") is not None]
            if stated:
                promise = f"{100 * np.mean(stated):.0f} %"
            lines.append(
                f"| {title} | {how} | {named} of {len(group)} "
                f"({100 * named / len(group):.0f} %) | {count['right']} | {count['open']} | "
                f"{count['wrong']} | {count['none']} | {promise} |"
            )
    return "\n".join(lines) + "\n"


def main() -> None:
    """So many worlds that ended with several causes."""
    rows = drawn(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
    TABLE.write_text(table(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
