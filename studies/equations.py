"""Starts drawn over two decades: are certified problems right or refused, and none trusted wrong?

`make study-equations`, or `python studies/equations.py [starts]`: studies/equations.md; what was
computed is kept in out/equations.jsonl, so that a second call goes on where the first was ended.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from casest import attempt, load_runs, param, signal, sin, vertcat
from casest.declaration.model import Model
from casest.dynamics import Dynamics, Motion, dynamics, measured, state

HERE = Path(__file__).parent
KEPT = HERE.parent / "out" / "equations.jsonl"
DATA = Path(os.environ.get("CASEST_DATA", HERE.parents[1] / "shared" / "data"))
#: Standard deviations of the published optimum within which an end is right.
RIGHT = 1e-2


@dynamics
def gasoil(
    y1=signal(),
    y2=signal(),
    *,
    y=state(2, start=[1, 0], known=True),
    k=param(3, start=[12.0, 8.0, 1.0], bounds=(0, None)),
):
    """Catalytic cracking of gas oil (COPS)."""
    used = (k[0] + k[2]) * y[0] ** 2
    return Motion(
        rates={"y": vertcat(-used, k[0] * y[0] ** 2 - k[1] * y[1])},
        outputs=(measured(y1, y[0]), measured(y2, y[1])),
    )


@dynamics
def pinene(
    y1=signal(),
    y2=signal(),
    y3=signal(),
    y4=signal(),
    y5=signal(),
    *,
    y=state(5, start=[100, 0, 0, 0, 0], known=True),
    k=param(5, start=[6e-5, 3e-5, 2e-5, 27e-5, 4e-5], bounds=(0, None)),
):
    """Thermal isomerisation of alpha-pinene (COPS)."""
    third = k[1] * y[0] - (k[2] + k[3]) * y[2] + k[4] * y[4]
    rates = -(k[0] + k[1]) * y[0], k[0] * y[0], third, k[2] * y[2], k[3] * y[2] - k[4] * y[4]
    outputs = tuple(measured(s, y[i]) for i, s in enumerate((y1, y2, y3, y4, y5)))
    return Motion(rates={"y": vertcat(*rates)}, outputs=outputs)


@dynamics
def lotka_volterra(
    x1=signal(),
    x2=signal(),
    std_x1=signal(),
    std_x2=signal(),
    *,
    x=state(2, start=[1, 1]),
    k=param(2, start=[0.7, 0.34]),
):
    """Prey and predator (casiopeia)."""
    met = x[0] * x[1]
    return Motion(
        rates={"x": vertcat(-x[0] + k[0] * met, x[1] - k[1] * met)},
        outputs=(measured(x1, x[0], std=std_x1), measured(x2, x[1], std=std_x2)),
    )


@dynamics
def pendulum(
    theta_rad=signal("rad"),
    *,
    theta=state("rad", start=1.5),
    rate=state("rad/s", start=2),
    k=param(2, ("1/s^2", "1/s"), start=[64.0, 0.05], bounds=(0, None)),
):
    """Free swing of one arm, from upright; the first eight seconds."""
    return Motion(
        rates={"theta": rate, "rate": k[0] * sin(theta) - k[1] * rate},
        outputs=(measured(theta_rad, theta),),
    )


@dataclass(frozen=True)
class Case:
    """A problem, how its file is read, and the constants where its optimum is."""

    name: str
    declared: Dynamics
    file: str
    right: tuple[float, ...]
    options: dict[str, Any]
    rows: int = 10_000


CASES = (
    Case("gasoil", gasoil, "certified/cops_gasoil.csv", (11.84673838, 8.3445195, 1.00143997), {}),
    Case(
        "pinene",
        pinene,
        "certified/cops_pinene.csv",
        (5.92584877e-5, 2.96340211e-5, 2.04728401e-5, 27.4467931e-5, 3.99794995e-5),
        {"time_zero": "column"},
    ),
    Case(
        "lotka-volterra",
        lotka_volterra,
        "certified/casiopeia_lotka_volterra.csv",
        (0.693971, 0.340921),
        {},
    ),
    Case(
        "pendulum, 8 s",
        pendulum,
        "multiarm-pendulum/pendulum_single.csv",
        (),
        {"columns": {"t": ("t_s",)}},
        1600,
    ),
)


def started(model: Model, factors: np.ndarray) -> Model:
    """The model whose declared start of the constants is multiplied."""
    k = model["k"]
    return model.having(k=replace(k, start=tuple(np.array(k.start) * factors)))


def rows(starts: int) -> Iterator[dict[str, Any]]:
    """Every start of every problem, those that are kept first."""
    kept = [json.loads(line) for line in KEPT.read_text().splitlines()] if KEPT.exists() else []
    done = {(row["case"], row["start"]) for row in kept}
    yield from (row for row in kept if row["start"] < starts)
    KEPT.parent.mkdir(exist_ok=True)
    for case in CASES:
        model = case.declared.calibration
        runs = load_runs(DATA / case.file, model.signals, **model.reading, **case.options)
        runs = tuple(replace(r.take(slice(0, case.rows)), whole=None, places=None) for r in runs)
        best = attempt(model, runs)
        right = np.array(case.right) if case.right else best.values["k"]
        for start in range(starts):
            if (case.name, start) in done:
                continue
            factors = 10 ** np.random.default_rng(start).uniform(-1, 1, len(right))
            began = time.perf_counter()
            found = attempt(started(model, factors), runs)
            away = np.max(np.abs(found.values["k"] - right) / best.std["k"])
            row = {
                "case": case.name,
                "start": start,
                "right": bool(away < RIGHT),
                "trusted": found.certificate.trusted,
                "seconds": time.perf_counter() - began,
                "reason": found.certificate.reasons[0],
            }
            with KEPT.open("a") as file:
                file.write(json.dumps(row) + "\n")
            yield row


def main() -> None:
    """The table."""
    starts = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    found = list(rows(starts))
    lines = [
        "# Starts over two decades",
        "",
        f"`make study-equations` (`python studies/equations.py {starts}`): every unknown constant "
        "begins at its declared start times a power of ten drawn from -1 to 1. Right: within "
        f"{RIGHT:g} standard deviations of the published optimum (of the pendulum: of that found "
        "from the declared start).",
        "",
        "| problem | starts | right and trusted | right, refused | wrong, refused | wrong, trusted "
        "| median s |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for case in CASES:
        own = [row for row in found if row["case"] == case.name]
        counts = [
            sum(row["right"] == right and row["trusted"] == trusted for row in own)
            for right, trusted in ((True, True), (True, False), (False, False), (False, True))
        ]
        seconds = float(np.median([row["seconds"] for row in own]))
        cells = [case.name, str(len(own)), *map(str, counts), f"{seconds:.2f}"]
        lines.append(f"| {' | '.join(cells)} |")
    (HERE / "equations.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
