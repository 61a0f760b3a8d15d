"""Causes that a record left open: does the planned measurement tell them apart?

    make study-told-apart       # python studies/told_apart.py [WORLDS]

Accelerometers with a quadratic response, a gain that differs by sign, or a signed quadratic one,
in few poses. Where `close` names what explains the record as well, `plan --separate` plans; the
true sensor is measured there, and as often in random poses; each cause is fitted to old and new
together. Named is the one that leads by the limit of `close`. The table is written to
`studies/told_apart.md`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
TABLE = Path(__file__).resolve().parent / "told_apart.md"
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


def one(seed: int) -> tuple[str, int, str, str, str] | None:
    """True cause, poses planned, who leads before, after the plan, after random poses."""
    kind, readings = world(seed)
    up = directions(10)
    rng = np.random.default_rng(seed + 10_000)
    v = readings(up[rng.choice(len(up), POSES, replace=False)])
    try:
        closing = close(MODEL, [recorded(v)])
    except CasestError:
        return None
    found = next((f for f in closing.effects if f.indistinguishable_from), None)
    if found is None:
        return None
    labels = [found.candidate.label, *found.indistinguishable_from]
    if kind not in labels[:3]:
        return None
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
    told = [r.label for r in rivals]
    planned = readings(plan.candidates.up[chosen])
    random = readings(up[rng.choice(len(up), len(chosen))])
    results = [leader(told, MODEL, np.vstack([v, more])) for more in (planned, random)]
    return kind, len(chosen), leader(told, MODEL, v), *results


def main() -> None:
    """So many worlds that ended with several causes."""
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    rows, seed = [], 0
    while len(rows) < wanted:
        found = one(seed)
        seed += 1
        if found is not None:
            rows.append(found)
            print(seed, *found, flush=True)
    n = len(rows)
    within = [r for r in rows if r[1] < MOST]
    lines = [
        "# Causes that a record left open, after the planned measurement",
        "",
        f"Made by `make study-told-apart`: {n} sensors of {seed} ended with several",
        "causes, the true one among the first three.",
        "",
        "| | the true cause is named | a wrong one | none |",
        "| --- | --- | --- | --- |",
    ]
    for title, group in (("all", rows), (f"plans of fewer than {MOST} poses", within)):
        for column, what in ((2, "before"), (3, "after the plan"), (4, "after random poses")):
            right = sum(r[column] == r[0] for r in group)
            wrong = sum(r[column] not in ("", r[0]) for r in group)
            lines.append(
                f"| {title}: {what} | {right} of {len(group)} | {wrong} | "
                f"{len(group) - right - wrong} |"
            )
    lines += ["", f"Poses planned: median {np.median([r[1] for r in rows]):g}."]
    TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
