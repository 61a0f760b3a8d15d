"""Causes that a record left open: does the planned measurement tell them apart?

    make study-told-apart       # python studies/told_apart.py [WORLDS]

Accelerometers with a quadratic response, a gain that differs by sign, or a signed quadratic one,
in few poses. Where `close` names what explains the record as well, `plan --separate` plans; the
true sensor is measured there, and as often in random poses; each cause is fitted to old and new
together. Named is the one that leads by the limit of `close`. What was done is kept in
`out/told_apart.jsonl`, so that the study goes on where it stopped; the table is written to
`studies/told_apart.md`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from resumed import kept

from casest import Run, attempt
from casest.diagnose.levels import LEVELS
from casest.diagnose.loop import close
from casest.diagnose.sensor import Sensor
from casest.effects import CATALOGUE
from casest.effects.placing import prepared
from casest.errors import CasestError
from casest.plan.candidates.attitudes import directions
from casest.plan.candidates.candidates import Noise
from casest.plan.candidates.finding import Possible, candidates
from casest.plan.rivals.rivals import refitted
from casest.plan.rivals.separating import separated, separation
from casest_problems.norm import norm_triangular

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
KEPT, TABLE = ROOT / "out" / "told_apart.jsonl", ROOT / "studies" / "told_apart.md"
NOISE, POSES, MOST = 0.002, 24, 60
MODEL = norm_triangular.having(norm=9.81)


def response(kind: str, force: Array, k: Array) -> Array:
    """What the sensor gives in place of the force."""
    if kind == "quadratic":
        return force + k * force**2
    if kind == "signed_quadratic":
        return force + k * force * np.abs(force)
    return force + np.where(force > 0, 10 * k * force, 0.0)


def world(seed: int) -> tuple[str, Any]:
    """A kind of sensor, and its readings of directions of up."""
    rng = np.random.default_rng(seed)
    kind = ("quadratic", "signed_quadratic", "gain_by_sign")[seed % 3]
    scale = np.linalg.inv(np.eye(3) + 0.02 * np.tril(rng.standard_normal((3, 3))))
    offset, k = 0.3 * rng.standard_normal(3), 4e-4 * rng.standard_normal(3)

    def readings(up: Array) -> Array:
        seen = response(kind, 9.81 * up, k) @ scale.T + offset
        return np.asarray(seen + NOISE * rng.standard_normal(seen.shape))

    return kind, readings


def recorded(v: Array) -> Run:
    """A record of poses."""
    return Run.raw("poses", {"v": v}, units={"v": "m/s^2"})


def leader(labels: list[str], base: Any, v: Array) -> str:
    """The cause that leads all others by the limit, fitted to these readings; else empty."""
    sensor = Sensor(base, prepared(base, (recorded(v),)), CATALOGUE)
    fit = sensor.fitted(base, dict(attempt(base, [recorded(v)], intervals=False).values))
    assert fit is not None
    costs = {}
    for label in labels:
        fits = [sensor.refit(fit, [t]) for t in sensor.trials(fit) if t.family == label]
        good = [f for f in fits if not isinstance(f, str)]
        if good:
            costs[label] = min(sum(float(np.sum(r**2)) for r in f.residuals) for f in good)
    order = sorted(costs, key=lambda name: costs[name])
    if len(order) < 2:
        return ""
    lead = (costs[order[1]] - costs[order[0]]) / NOISE**2
    return order[0] if lead > LEVELS.clear else ""


def one(seed: int) -> dict[str, Any]:
    """A sensor; where its record leaves several causes open, who leads before and after."""
    kind, readings = world(seed)
    up = directions(10)
    rng = np.random.default_rng(seed + 10_000)
    v = readings(up[rng.choice(len(up), POSES, replace=False)])
    row: dict[str, Any] = {"seed": seed, "true": kind, "open": False}
    try:
        closing = close(MODEL, [recorded(v)])
    except CasestError:
        return row
    found = next((f for f in closing.effects if f.indistinguishable_from), None)
    if found is None:
        return row
    labels = [found.candidate.label, *found.indistinguishable_from]
    if kind not in labels[:3]:
        return row
    sigma = np.array([NOISE])
    rivals = refitted(MODEL, closing.before.values, [recorded(v)], labels, sigma)
    noise = Noise(sigma, {})
    plan = separation(
        rivals, noise, lambda r: candidates(r.model, r.values, noise, Possible()), "world"
    )
    try:
        chosen = list(separated(plan, None, MOST, "world").chosen)
    except CasestError:
        chosen = list(separated(plan, MOST, MOST, "world").chosen)
    assert plan.candidates.up is not None
    random = [int(k) for k in rng.choice(len(plan.candidates.up), len(chosen))]
    told = [r.label for r in rivals]
    own = [k for k, pair in enumerate(plan.pairs) if pair.true == kind]
    row |= {"open": True, "poses": len(chosen), "before": leader(told, MODEL, v)}
    for name, places in (("planned", chosen), ("random", random)):
        more = readings(plan.candidates.up[places])
        row[name] = leader(told, MODEL, np.vstack([v, more]))
        row[f"growth {name}"] = float(np.min(plan.growths(places)[own], initial=np.inf))
        row[f"power {name}"] = float(np.min(np.array(plan.powers(places))[own], initial=1.0))
    return row


def drawn(wanted: int) -> list[dict[str, Any]]:
    """Sensors one after the other, until so many of them ended with several causes."""
    rows = kept(KEPT)
    KEPT.parent.mkdir(exist_ok=True)
    with KEPT.open("a", encoding="utf-8") as file:
        while sum(row["open"] for row in rows) < wanted:
            rows.append(one(len(rows)))
            print(json.dumps(rows[-1]), file=file, flush=True)
            if rows[-1]["open"]:
                print(rows[-1], flush=True)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """What was named, and what the plans promised."""
    own = [row for row in rows if row["open"]]
    groups = {
        "all": own,
        f"plans of fewer than {MOST} poses": [r for r in own if r["poses"] < MOST],
    }
    lines = [
        "# Causes that a record left open, after the planned measurement",
        "",
        f"Made by `make study-told-apart`: {len(own)} sensors of {len(rows)} ended with several",
        "causes, the true one among the first three. Told apart: the chance that the plan states",
        "for the rival that is hardest to refute; growth: of 2 log of the likelihood ratio against",
        "it, to be expected.",
        "",
        "| | the true cause is named | a wrong one | none | told apart | growth, median |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for title, group in groups.items():
        for column in ("before", "planned", "random"):
            right = sum(r[column] == r["true"] for r in group)
            wrong = sum(r[column] not in ("", r["true"]) for r in group)
            promise = " | |"
            if column != "before" and group:
                power = 100 * np.mean([r[f"power {column}"] for r in group])
                promise = (
                    f" {power:.0f} % | {np.median([r[f'growth {column}'] for r in group]):.0f} |"
                )
            after = "" if column == "before" else "after "
            lines.append(
                f"| {title}: {after}{column} | {right} of {len(group)} | {wrong} | "
                f"{len(group) - right - wrong} |{promise}"
            )
    lines += ["", f"Poses planned: median {np.median([r['poses'] for r in own]):g}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """So many worlds that ended with several causes."""
    rows = drawn(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
    TABLE.write_text(table(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
