"""Differential equations with published optima: right or refused, and none trusted and wrong?

    make study-equations       # python studies/equations.py [STARTS]

From starts drawn over two decades each, and `casest compare` on every problem: where each solver
and each transcription ends, and what it claims. Three collections: COPS and casiopeia
(`../shared/data/certified`), two of Esposito & Floudas 2000, and NIST's nonlinear regressions
written as the equations that their curves follow, whose values NIST certifies to eleven digits. The
readings and optima of Esposito & Floudas were typed without a copy of the paper at hand: what
vouches for them is that SciPy's optimum of these readings has every digit given here.
What was computed is kept in `out/equations.jsonl`: a second call goes on where the first was ended,
or with more starts. The tables are written to `studies/equations.md`.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from casest import Run, attempt, load_runs, param, signal, sum1, vertcat
from casest.comparison.judge import compare
from casest.declaration.model import Model
from casest.dynamics import Dynamics, Motion, dynamics, measured, state

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests"))
from nist import read  # noqa: E402

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
def chain(
    a=signal(), b=signal(), *, y=state(2, start=[1, 0], known=True), k=param(2, start=[4.0, 2.0])
):
    """A becomes B becomes C (Tjoa & Biegler 1991)."""
    used = k[0] * y[0]
    rates = {"y": vertcat(-used, used - k[1] * y[1])}
    return Motion(rates=rates, outputs=(measured(a, y[0]), measured(b, y[1])))


@dynamics
def predator(
    a=signal(),
    b=signal(),
    *,
    y=state(2, start=[1.2, 1.1], known=True),
    k=param(2, start=[3.0, 1.0]),
):
    """Prey and predator (Luus 1998)."""
    rates = vertcat(k[0] * y[0] * (1 - y[1]), k[1] * y[1] * (y[0] - 1))
    return Motion(rates={"y": rates}, outputs=(measured(a, y[0]), measured(b, y[1])))


@dynamics
def saturating(y=signal(), *, z=state(start=0, known=True), k=param(2, start=[1.0, 1.0])):
    """y = k₀·(1 − exp(−k₁·x)): Misra1a and BoxBOD."""
    return Motion(rates={"z": k[1] * (k[0] - z)}, outputs=(measured(y, z),))


@dynamics
def stretched(y=signal(), *, z=state(start=0, known=True), k=param(2, start=[1.0, 1.0])):
    """y = k₀·(1 − (1 + 2k₁x)^(−1/2)): Misra1c."""
    return Motion(rates={"z": k[1] * (k[0] - z) ** 3 / k[0] ** 2}, outputs=(measured(y, z),))


@dynamics
def logistic(y=signal(), *, z=state(start=8.0), k=param(2, start=[1.0, 1.0], bounds=(0, None))):
    """y = k₀/(1 + exp(b₂ − k₁x)): Rat42."""
    return Motion(rates={"z": k[1] * z * (1 - z / k[0])}, outputs=(measured(y, z),))


@dynamics
def decays(
    y=signal(), *, z=state(3, start=[0.5, 0.7, 1.0]), k=param(3, start=1.0, bounds=(0, None))
):
    """A sum of three exponentials: Lanczos3."""
    return Motion(rates={"z": -k * z}, outputs=(measured(y, sum1(z)),))


@dataclass(frozen=True)
class Case:
    """A problem: its declaration, what reads its record, and the constants where its optimum is.

    `alike`: constants that may change places. `starts` at most, where fits are dear.
    """

    name: str
    declared: Dynamics
    read: Callable[[Model], tuple[Run, ...]]
    right: tuple[float, ...]
    start: tuple[float, ...] = ()
    alike: bool = False
    starts: int = 1000

    @property
    def model(self) -> Model:
        """Begun where the collection says."""
        model = self.declared.calibration
        return model.having(k=replace(model["k"], start=self.start)) if self.start else model


def of_file(name: str, **options: Any) -> Callable[[Model], tuple[Run, ...]]:
    """What reads a record of the folder of certified problems."""
    return lambda model: load_runs(
        DATA / "certified" / name, model.signals, **model.reading, **options
    )


def of_table(
    time: Any, names: tuple[str, ...], *columns: Any
) -> Callable[[Model], tuple[Run, ...]]:
    """What makes a record of printed numbers."""
    values = {n: np.array(c, float)[:, None] for n, c in zip(names, columns, strict=True)}
    run = Run.raw("table", values, units={}, time=np.array(time, float))
    return lambda _: (run,)


def of_nist(name: str, declared: Dynamics, *constants: str, **more: Any) -> Case:
    """A problem of NIST's, begun at the second of its starts."""
    found = read(DATA, name)
    time, y = found.run.signals["x"][:, 0], found.run.signals["y"][:, 0]
    right, start = (
        tuple(float(values[n]) for n in constants) for values in (found.values, found.starts[1])
    )
    return Case(f"NIST {name}", declared, of_table(time, ("y",), y), right, start, **more)


CASES = (
    Case("COPS gasoil", gasoil, of_file("cops_gasoil.csv"), (11.84673838, 8.3445195, 1.00143997)),
    Case(
        "COPS pinene",
        pinene,
        of_file("cops_pinene.csv", time_zero="column"),
        (5.92584877e-5, 2.96340211e-5, 2.04728401e-5, 27.4467931e-5, 3.99794995e-5),
    ),
    Case(
        "casiopeia Lotka-Volterra",
        lotka_volterra,
        of_file("casiopeia_lotka_volterra.csv"),
        (0.693971, 0.340921),
    ),
    Case(
        "E & F chain of reactions",
        chain,
        of_table(
            np.arange(1, 11) / 10,
            ("a", "b"),
            [0.606, 0.368, 0.223, 0.135, 0.082, 0.050, 0.030, 0.018, 0.011, 0.007],
            [0.373, 0.564, 0.647, 0.669, 0.656, 0.624, 0.583, 0.539, 0.494, 0.451],
        ),
        (5.0035, 1.0000),
    ),
    Case(
        "E & F Lotka-Volterra",
        predator,
        of_table(
            np.arange(1, 11),
            ("a", "b"),
            [0.7990, 0.8731, 1.2487, 1.0362, 0.7483, 1.0024, 1.2816, 0.8944, 0.7852, 1.1527],
            [1.0758, 0.8711, 0.9393, 1.1468, 1.0027, 0.8577, 1.0274, 1.1369, 0.9325, 0.9074],
        ),
        (3.2434, 0.9209),
    ),
    of_nist("Misra1a", saturating, "b1", "b2"),
    of_nist("BoxBOD", saturating, "b1", "b2"),
    of_nist("Misra1c", stretched, "b1", "b2"),
    of_nist("Rat42", logistic, "b1", "b3"),
    of_nist("Lanczos3", decays, "b2", "b4", "b6", alike=True),
)


def fitted(case: Case, start: int) -> dict[str, Any]:
    """A fit from constants multiplied by powers of ten: is it right, is it trusted?"""
    model, right = case.model, np.array(case.right)
    factors = 10 ** np.random.default_rng(start).uniform(-1, 1, len(right))
    k = model["k"]
    begun = model.having(k=replace(k, start=tuple(np.array(k.start) * factors)))
    began = time.process_time()
    found = attempt(begun, case.read(model))
    seconds = time.process_time() - began
    value, std = found.values["k"], found.std["k"]
    if case.alike:
        order = np.argsort(value)
        value, std, right = value[order], std[order], np.sort(right)
    away = np.max(np.abs(value - right) / std)
    return {
        "right": bool(away < RIGHT),
        "trusted": found.certificate.trusted,
        "seconds": seconds,
        "reason": found.certificate.reasons[0],
    }


def compared(case: Case) -> dict[str, Any]:
    """Where every solver ends from the declared start and eight around it, and what it claims."""
    found = compare(case.model, case.read(case.model))
    rows = {}
    for row in found.rows:
        trials = [*([row.first] if row.first else []), *row.spread]
        rows[row.solver] = {
            "right": sum(t.right for t in trials),
            "false": sum(t.claims is True and not t.right for t in trials),
            "of": len(trials),
            "seconds": row.seconds,
        }
    return {"certified": found.certified, "solvers": rows}


def rows(starts: int) -> Iterator[dict[str, Any]]:
    """Every start of every problem and every comparison, those that are kept first."""
    kept = [json.loads(line) for line in KEPT.read_text().splitlines()] if KEPT.exists() else []
    done = {(row["case"], row["start"]) for row in kept}
    yield from (row for row in kept if row["start"] is None or row["start"] < starts)
    KEPT.parent.mkdir(exist_ok=True)
    for case in CASES:
        for start in (None, *range(min(starts, case.starts))):
            if (case.name, start) in done:
                continue
            own = compared(case) if start is None else fitted(case, start)
            row = {"case": case.name, "start": start, **own}
            with KEPT.open("a") as file:
                file.write(json.dumps(row) + "\n")
            print(row, flush=True)
            yield row


def table_of_starts(found: list[dict[str, Any]]) -> Iterator[str]:
    """How many starts ended right, and what was said of them."""
    heads = "right and trusted", "right, refused", "wrong, refused", "wrong, trusted"
    yield f"| problem | starts | {' | '.join(heads)} | median s |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for case in CASES:
        own = [row for row in found if row["case"] == case.name and row["start"] is not None]
        counts = [
            sum(row["right"] == right and row["trusted"] == trusted for row in own)
            for right, trusted in ((True, True), (True, False), (False, False), (False, True))
        ]
        seconds = float(np.median([row["seconds"] for row in own]))
        yield f"| {' | '.join([case.name, str(len(own)), *map(str, counts), f'{seconds:.2f}'])} |"


def table_of_solvers(found: list[dict[str, Any]]) -> Iterator[str]:
    """Of nine starts each: how many ended right, and how many claims are false."""
    every = {row["case"]: row["solvers"] for row in found if row["start"] is None}
    names = list(dict.fromkeys(name for own in every.values() for name in own))
    yield f"| problem | {' | '.join(names)} |"
    yield "| --- |" + " --- |" * len(names)
    for case, own in every.items():
        cells = [f"{own[n]['right']}" + f" ({own[n]['false']} false)" * bool(own[n]["false"])
                 for n in names]  # fmt: skip
        yield f"| {case} | {' | '.join(cells)} |"
    claims = [str(sum(own[n]["false"] for own in every.values())) for n in names]
    yield f"| false claims in all | {' | '.join(claims)} |"


def main() -> None:
    """Both tables."""
    starts = int(sys.argv[1]) if len(sys.argv) > 1 else 6
    found = list(rows(starts))
    lines = [
        "# Differential equations with published optima",
        "",
        f"`make study-equations` (`python studies/equations.py {starts}`, whose first lines tell "
        "the sources). Readings and optima of the two problems of Esposito & Floudas (E & F) were "
        "typed without a copy of the paper at hand; SciPy's optimum of these readings has every "
        "digit.",
        "",
        "## Starts over two decades",
        "",
        "Every unknown constant begins at its declared start (NIST's second) times a power of "
        f"ten drawn from -1 to 1. Right: within {RIGHT:g} standard deviations of the published "
        "optimum. Seconds of processor time.",
        "",
        *table_of_starts(found),
        "",
        "## Solvers side by side",
        "",
        "`casest compare`: from the declared start and eight around it, moved by 0.1, 1, 10 and "
        "30 % of each unknown's size, each solver as it ends: how many of nine are right (within "
        "0.01 standard deviations, by the cost), and how many claims of success are false.",
        "",
        *table_of_solvers(found),
    ]
    (HERE / "equations.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
