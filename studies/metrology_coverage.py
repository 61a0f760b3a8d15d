"""Do 95 % intervals hold the truth where references and inputs are uncertain?

    make study-metrology-coverage       # python studies/metrology_coverage.py [TRIALS]

Each trial draws the reference's error once, and the noise of each reading. Trials are kept in
`out/metrology_coverage.jsonl`: interrupted, the study goes on where it stopped. The table is
written to `studies/metrology_coverage.md`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import resumed

import casest as c
from casest.engine.threads import one_thread
from casest.leastsquares.stated import stated_noise
from casest_problems.norm import norm_triangular

ROOT = Path(__file__).resolve().parent.parent
KEPT, TABLE = ROOT / "out" / "metrology_coverage.jsonl", ROOT / "studies" / "metrology_coverage.md"
Fit = tuple[c.Estimate, dict[str, np.ndarray]]


@c.model
def turning(
    t=c.signal("s"),
    v=c.signal(2, "m/s^2"),
    *,
    rate=c.param("rad/s", start=5.0),
    phase=c.param("rad"),
    offset=c.param(2, "m/s^2"),
    radius=c.constant(0.28, "m", std=0.005),
):
    """An accelerometer on a wheel that turns evenly, upright, at a radius that was measured."""
    angle = phase + rate * t
    a = c.vertcat(radius * rate**2 + 9.81 * c.cos(angle), 9.81 * c.sin(angle))
    return c.Residual(measured=v, predicted=offset + a)


@c.model
def cell(
    mass=c.signal("kg"),
    reading=c.signal("mV"),
    *,
    zero=c.param("mV"),
    gain=c.param("mV/N", start=1.0),
    gravity=c.constant(9.81, "m/s^2", std=0.01),
):
    """A load cell; each mass has an error of its own, and gravity one for all."""
    return c.Residual(measured=reading, predicted=zero + gain * mass * gravity)


def norm(rng: np.random.Generator) -> Fit:
    """Thirty poses, unequal axes, a length known to 0.1 %."""
    scale = np.array([[1, 0, 0], [0.02, 1.03, 0], [-0.01, 0.015, 0.98]])
    offset, std = np.array([0.3, -0.2, 0.1]), np.array([0.02, 0.05, 0.1])
    u = rng.standard_normal((30, 3))
    force = 9.81 * u / np.linalg.norm(u, axis=1)[:, None]
    v = force @ np.linalg.inv(scale).T + offset + std * rng.standard_normal(u.shape)
    known = c.constant(9.81 + 0.01 * rng.standard_normal(), std=0.01)
    run = c.Run.raw("r", {"v": v}, units={"v": "1"})
    model, runs = stated_noise(norm_triangular.having(norm=known), [run], {"v": [std]})
    return c.attempt(model, runs), {"scale": scale, "offset": offset}


def wheel(rng: np.random.Generator) -> Fit:
    """Ten seconds at 20 Hz; the offset along the radius rests on the radius."""
    t, std = np.arange(200) / 20, np.array([0.05, 0.1])
    angle = 0.4 + 5 * t
    force = np.stack([0.28 * 25 + 9.81 * np.cos(angle), 9.81 * np.sin(angle)], axis=1)
    v = force + [0.2, -0.1] + std * rng.standard_normal(force.shape)
    known = c.constant(0.28 + 0.005 * rng.standard_normal(), "m", std=0.005)
    run = c.Run.raw("r", {"t": t[:, None], "v": v}, units={}, time=t)
    model, runs = stated_noise(turning.having(radius=known), [run], {"v": [std]})
    truth = {"rate": 5.0, "phase": 0.4, "offset": np.array([0.2, -0.1])}
    return c.attempt(model, runs), truth


def load_cell(rng: np.random.Generator) -> Fit:
    """Eight masses, each known to 5 g, and readings to 0.05 mV."""
    mass = np.linspace(0, 5, 8)
    reading = 0.3 + 2 * mass * 9.81 + 0.05 * rng.standard_normal(8)
    told = mass + 0.005 * rng.standard_normal(8)
    known = c.constant(9.81 + 0.01 * rng.standard_normal(), "m/s^2", std=0.01)
    run = c.Run.raw("r", {"mass": told[:, None], "reading": reading[:, None]}, units={})
    noise = {"mass": [np.full(1, 0.005)], "reading": [np.full(1, 0.05)]}
    model, runs = stated_noise(cell.having(gravity=known), [run], noise)
    return c.attempt(model, runs), {"zero": 0.3, "gain": 2.0}


SCENES: dict[str, Callable[[np.random.Generator], Fit]] = {
    "norm": norm,
    "wheel": wheel,
    "load cell": load_cell,
}


def trial(scene: str, seed: int) -> dict[str, Any]:
    """Which intervals held the truth."""
    with one_thread():
        found, truth = SCENES[scene](np.random.default_rng([seed, len(scene)]))
        low, high = found.interval_reach
    held = []
    for name, true in truth.items():
        away = np.asarray(true) - found.values[name]
        free = found.std[name] > 0
        held += ((away > -low[name]) & (away < high[name]))[free].tolist() if away.ndim else [
            bool(-low[name] < away < high[name])
        ]  # fmt: skip
    trusted = found.certificate.trusted
    return {"scene": scene, "seed": seed, "trusted": trusted, "held": sum(held), "of": len(held)}


def main(trials: int = 2000, workers: int = 1) -> None:
    """All trials that are not kept yet, then the table."""
    known = {(r["scene"], r["seed"]) for r in resumed.kept(KEPT)}
    left = [(s, k) for k in range(trials) for s in SCENES if (s, k) not in known]
    if left:
        resumed.done(trial, left, KEPT, workers)
    rows = []
    for scene in SCENES:
        own = [r for r in resumed.kept(KEPT) if r["scene"] == scene]
        good = [r for r in own if r["trusted"]]
        share = 100 * sum(r["held"] for r in good) / max(sum(r["of"] for r in good), 1)
        rows.append(f"| {scene} | {len(own)} | {len(good)} | {share:.1f} % |")
    TABLE.write_text(
        "# Coverage with uncertain references and inputs\n\n"
        "Made by `make study-metrology-coverage`; every trial draws the reference's error anew.\n\n"
        "| what | trials | trusted | 95 % intervals that held the truth |\n"
        "| --- | --- | --- | --- |\n" + "\n".join(rows) + "\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
