"""Which frictions slow the arm of the published pendulum? Fits to its first 20 s.

    make study-frictions      # python studies/frictions.py, with the record in ../shared/data

Every fourth row of the first 20 s is fitted with some of the frictions declared; two later segments
are foretold with these, where each begins fitted to the segment itself. The table is written to
`studies/frictions.md` (the record: see its SOURCE.md; another place: CASEST_DATA).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from record_files import DATA

from casest import Model, Run, attempt, constant, fabs, param, sign, signal, sin
from casest.dynamics import Motion, dynamics, measured, state
from casest.leastsquares.problem import Problem

TABLE = Path(__file__).parent / "frictions.md"
FITTED, LATER = (0.0, 20.0), ((25.0, 35.0), (40.0, 50.0))
UNITS = {"viscous": "1/s", "quadratic": "1/rad", "dry": "rad/s^2", "offset": "rad"}
DECLARED = (
    ("viscous",),
    ("viscous", "dry"),
    ("viscous", "quadratic"),
    ("quadratic", "dry"),
    ("viscous", "quadratic", "dry"),
    ("viscous", "quadratic", "dry", "offset"),
)


def pendulum_with(names: tuple[str, ...]) -> Model:
    """A free swing with these unknown, the others nothing."""
    every: Any = {n: param(u) if n in names else constant(0.0, u) for n, u in UNITS.items()}

    @dynamics
    def pendulum(
        angle=signal("rad"),
        *,
        theta=state("rad", start=1.5),
        rate=state("rad/s", start=2.0),
        w2=param("1/s^2", start=60.0, bounds=(0, None)),
        viscous=every["viscous"],
        quadratic=every["quadratic"],
        dry=every["dry"],
        offset=every["offset"],
    ):
        friction = viscous * rate + quadratic * rate * fabs(rate) + dry * sign(rate)
        rates = {"theta": rate, "rate": w2 * sin(theta) - friction}
        return Motion(rates=rates, outputs=(measured(angle, theta + offset),))

    return pendulum.calibration


def segment(record: Any, first: float, last: float, every: int = 1) -> Run:
    """The rows between two times."""
    own = record[(record[:, 0] >= first) & (record[:, 0] <= last)][::every]
    return Run.raw("pendulum", {"angle": own[:, 1:2]}, units={"angle": "rad"}, time=own[:, 0])


def rms(model: Model, run: Run, values: Any) -> float:
    """Of the residuals, rad."""
    problem = Problem(model, (run,))
    return float(np.sqrt(np.mean(problem.residuals(problem.point(values))[0] ** 2)))


def foretold(model: Model, values: Any, run: Run) -> float:
    """The error on a later segment, of which only the beginning is fitted, rad."""
    shared = {n: v for n, v in values.items() if not n.endswith("_start")}
    angle, time = run.signals["angle"][:, 0], run.time
    assert time is not None
    begun = {"theta_start": angle[0], "rate_start": (angle[1] - angle[0]) / (time[1] - time[0])}
    own = attempt(model.having(**shared), [run], start=begun, intervals=False)
    return rms(own.model, run, own.values)


def main(arguments: list[str] | None = None) -> None:
    """Every row, and the table."""
    record = np.loadtxt(
        DATA / "multiarm-pendulum/pendulum_single.csv", delimiter=",", skiprows=1, usecols=(0, 1)
    )
    first = segment(record, *FITTED, every=4)
    lines = [
        "# Which frictions slow the arm?",
        "",
        "`make study-frictions` (`python studies/frictions.py`): fits to 0 to 20 s, every fourth",
        "row; errors in rad on two later segments, of each only the beginning fitted.",
        "",
        "| declared | fit | 25 to 35 s | 40 to 50 s | w2 | viscous | quadratic | dry |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for names in DECLARED:
        model = pendulum_with(names)
        values = attempt(model, [first], intervals=False).values
        later = [foretold(model, values, segment(record, *span)) for span in LATER]
        errors = [f"{e:.4f}" for e in (rms(model, first, values), *later)]
        sizes = [f"{float(values[n]):.4g}" if n in values else "" for n in list(UNITS)[:3]]
        cells = [", ".join(names), *errors, f"{float(values['w2']):.3f}", *sizes]
        lines.append(f"| {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    TABLE.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
