"""Structural rank beside published answers of StructuralIdentifiability.jl and others.

    make study-structural       # python studies/structural.py: under a minute on one core

Of each model in `structural_models.txt` functions of states and parameters are published that are
determined, and from which all others follow. Their gradients, by CasADi in floating point, say the
rank and which unknowns are determined on their own; casest gets the equations alone. The table is
written to `studies/structural.md`.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.symbols import Signal
from casest.dynamics import Motion, Structure, measured, structure
from casest.dynamics.declare import Dynamics, State

ROOT = Path(__file__).resolve().parent.parent
MODELS = ROOT / "studies" / "structural_models.txt"
TABLE = ROOT / "studies" / "structural.md"


# -- models from the text --------------------------------------------------------------------------


@dataclass(frozen=True)
class Published:
    """A model of the text: equations by name, and functions that are determined."""

    name: str
    rates: Mapping[str, str]
    outputs: Mapping[str, str]
    inputs: Sequence[str]
    determined: Sequence[str]

    @property
    def unknowns(self) -> list[str]:
        """States, then parameters."""
        used = {w for e in (*self.rates.values(), *self.outputs.values()) for w in words(e)}
        return [*self.rates, *sorted(used - set(self.rates) - set(self.inputs))]

    def declared(self) -> Dynamics:
        """As casest takes it."""
        seen = [f"measured_{name}" for name in self.outputs]

        def motion(**symbols: Any) -> Motion:
            outputs = [
                measured(symbols[s], ca.SX(value(e, symbols)), intensity=1.0)
                for s, e in zip(seen, self.outputs.values(), strict=True)
            ]
            rates = {name: ca.SX(value(e, symbols)) for name, e in self.rates.items()}
            return Motion(rates=rates, outputs=tuple(outputs))

        signals = tuple(Signal(name, 1, "1") for name in (*self.inputs, *seen))
        states = tuple(State(name, 1, "1", 0.0, (0.0,), 1.0) for name in self.unknowns)
        return Dynamics(self.name, motion, signals, states, ())


def words(expression: str) -> list[str]:
    """Names in an expression."""
    return re.findall(r"[A-Za-z_]\w*", expression)


def value(expression: str, symbols: Mapping[str, Any]) -> Any:
    """An expression of the text on symbols."""
    return eval(expression.replace("^", "**"), {"__builtins__": {}}, dict(symbols))


def published(text: str) -> Iterator[Published]:
    """Models of the text, a block each."""
    blocks = re.split(r"\n\s*\n", re.sub(r"(?m)^#.*\n?", "", text).strip())
    for block in blocks:
        name, *lines = re.sub(r"\n {8}", " ", block).split("\n")
        equations = [line.strip().partition(" = ") for line in lines if " = " in line]
        told = dict(line.strip().split(": ", 1) for line in lines if ": " in line)
        yield Published(
            name,
            {left[:-1]: right for left, _, right in equations if left.endswith("'")},
            {left: right for left, _, right in equations if not left.endswith("'")},
            told.get("inputs", "").split(", ") if "inputs" in told else [],
            told["determined"].split(", "),
        )


# -- what the published functions say --------------------------------------------------------------


def gradients(functions: Sequence[str], names: Sequence[str]) -> np.ndarray:
    """Gradients (functions, names) at a random point, each brought to length one."""
    x = ca.SX.sym("x", len(names))
    symbols = dict(zip(names, ca.vertsplit(x), strict=True))
    slopes = ca.jacobian(ca.vertcat(*[ca.SX(value(f, symbols)) for f in functions]), x)
    point = np.random.default_rng(0).uniform(0.5, 1.5, len(names))
    rows = np.asarray(ca.Function("slopes", [x], [slopes])(point), float)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def answer(functions: Sequence[str], names: Sequence[str]) -> tuple[int, list[str], float]:
    """Rank of functions, the names that do not follow from them, and how clear-cut both are."""
    rows = gradients(functions, names)
    _, found, right = np.linalg.svd(rows)
    rank = int(np.sum(found > 1e-9 * found[0]))
    gap = found[rank - 1] / max(found[rank] if rank < len(found) else 0.0, 1e-17)
    left = np.linalg.norm(right[rank:], axis=0)
    return rank, [n for n, r in zip(names, left, strict=True) if r > 1e-6], float(gap)


# -- the comparison --------------------------------------------------------------------------------


def calls(model: Published, found: Structure) -> int:
    """How many of the published functions casest calls determined."""
    count = 0
    for function in model.determined:
        names = sorted(set(words(function)))
        code = f"lambda {', '.join(names)}: {function.replace('^', '**')}"
        count += found.determines(eval(code, {"__builtins__": {}}))
    return count


def compared(model: Published) -> tuple[list[str], bool, float]:
    """A row of the table, whether all of it agrees, and the time."""
    rank, hidden, gap = answer(model.determined, model.unknowns)
    assert gap > 1e3, f"{model.name}: the published functions have no clear rank"
    declared = model.declared()
    began = time.process_time()
    found = structure(declared)
    took = time.process_time() - began
    right = calls(model, found)
    agrees = (rank, hidden, len(model.determined)) == (found.rank, list(found.undetermined), right)
    row = [
        model.name,
        str(len(model.unknowns)),
        f"{found.rank} ({rank})",
        f"{len(found.undetermined)} ({len(hidden)})",
        f"{right} of {len(model.determined)}",
        f"{len(found.combinations)} of {len(found.combinations) + found.more}"
        if found.undetermined
        else "",
        f"{took:.2f}",
        "yes" if agrees else "**no**",
    ]
    return row, agrees, took


# -- other questions -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A question with a published answer: the unknowns that are not determined."""

    words: str
    source: str
    model: Published
    asked: Mapping[str, Any]
    hidden: set[str]


KNOWN = "StructuralIdentifiability.jl, test/bodies/known_ic.jl"
SEVERAL = "StructuralIdentifiability.jl, test/bodies/local_identifiability_me.jl"


def system(name: str, text: str, inputs: Sequence[str] = ()) -> Published:
    """Equations in one line: `x' = a*x; y = x`."""
    equations = [part.strip().partition(" = ") for part in text.split(";")]
    rates = {left[:-1]: right for left, _, right in equations if left.endswith("'")}
    outputs = {left: right for left, _, right in equations if not left.endswith("'")}
    return Published(name, rates, outputs, inputs, ())


def cases() -> Iterator[Case]:
    """Known initial states, unmeasured inputs, inputs held constant, several experiments."""
    prey = system("predation", "x1' = a*x1 - b*x1*x2; x2' = -c*x2 + d*x1*x2; y = x1")
    yield Case("predation, x2 known at the beginning", KNOWN, prey, {"known": ["x2"]}, set())
    chain = system("chain", "x1' = a + x2 + x3; x2' = b^2 + c; x3' = -c; y = x1")
    asked = {"known": ["x2", "x3"]}
    yield Case("chain, x2 and x3 known at the beginning", KNOWN, chain, asked, {"c"})
    growth = system("growth", "x1' = a*x1; x2' = x1 + 1/x1; y = x2")
    yield Case("growth, x1 known at the beginning", KNOWN, growth, {"known": ["x1"]}, set())
    goodwin = system(
        "Goodwin",
        "x1' = -b*x1 + 1/(c + x4); x2' = alpha*x1 - beta*x2; x3' = gama*x2 - delta*x3; "
        "x4' = sigma*x4*(gama*x2 - delta*x3)/x3; y = x1",
    )
    yield Case("Goodwin, x2 and x3 known at the beginning", KNOWN, goodwin, asked, set())
    hiv = system(
        "HIV",
        "Tu' = lam - rho*Tu - eta*Tu*V; Ti' = eta*Tu*V - delta*Ti; V' = N*delta*Ti - c*V; "
        "y1 = V; y2 = Tu + Ti",
        ["eta"],
    )
    yield Case(
        "HIV, infection rate eta(t) unknown", "Martinelli, arXiv:2304.14288", hiv,
        {"unmeasured": ["eta"]}, {"Tu", "Ti", "N", "delta", "eta"},
    )  # fmt: skip
    yield from glucose()
    two = system(
        "two compartments",
        "x1' = -(k1e + k12)*x1 + k21*x2 + b*u; x2' = k12*x1 - k21*x2; y = x1",
        ["u"],
    )
    letters = "Villaverde et al., IEEE Control Systems Letters 3 (2019) 272"
    yield Case("two compartments, input varies", letters, two, {}, set())
    yield Case(
        "two compartments, input constant", letters, two, {"varying": False},
        {"x2", "k1e", "k12", "k21", "b"},
    )  # fmt: skip


def glucose() -> Iterator[Case]:
    """The βIG model of glucose G, insulin I and beta cells B, whose powers are no whole numbers;
    p and si unknown, the rest known (values of Karin et al. 2016)."""
    equations = (
        "G' = 1/30 + u - (0.001 + si*I)*G; "
        "B' = B*(0.021/1440/(1 + (8.4/G)^1.7) - 0.025/1440/(1 + (G/4.8)^8.5)); "
        "I' = p*B*G^2/(7.85^2 + G^2) - 0.3*I; "
    )
    source = "Villaverde & Banga, PLoS Comput. Biol. 13 (2017) e1005878 (STRIKE-GOLDD)"
    seen = system("glucose", equations + "y = G", ["u"])
    yield Case("βIG, glucose measured", source, seen, {}, {"B", "I", "p", "si"})
    yield Case("βIG, glucose measured, p known", source, seen, {"known": ["p"]}, {"B", "I", "si"})
    every = system("all", equations + "y1 = G; y2 = I; y3 = B", ["u"])
    yield Case("βIG, glucose, insulin and cells measured", source, every, {}, set())


def compartments(graph: Callable[[int], list[list[int]]], n: int) -> Published:
    """A compartment model whose rates a + b·x0 depend on a constant known input x0, seen in the
    first compartment, which has a sink."""
    rates = {f"x{i}": "0" for i in range(1, n + 1)}
    for i, targets in enumerate(graph(n), 1):
        for j in targets:
            flow = f"x{i}*(a_{i}_{j} + b_{i}_{j}*x0)"
            rates[f"x{j}"] += f" + {flow}"
            rates[f"x{i}"] += f" - {flow}"
    rates["x1"] += " - x1*(a_1_0 + b_1_0*x0)"
    return Published(f"{graph.__name__} {n}", rates, {"y": "x1"}, ["x0"], ())


def cycle(n: int) -> list[list[int]]:
    """One directed circle."""
    return [[i % n + 1] for i in range(1, n + 1)]


def catenary(n: int) -> list[list[int]]:
    """A chain, both ways."""
    return [[j for j in (i - 1, i + 1) if 1 <= j <= n] for i in range(1, n + 1)]


def mammillary(n: int) -> list[list[int]]:
    """A star, both ways."""
    return [list(range(2, n + 1)), *[[1] for _ in range(2, n + 1)]]


def enough(model: Published, most: int, per_run: Sequence[str] = ()) -> tuple[int, float]:
    """Experiments after which one more determines no more of the parameters, and the time."""
    names = [n for n in model.unknowns if n not in model.rates]
    began, before = time.process_time(), len(names)
    for count in range(1, most + 1):
        found = structure(model.declared(), varying=False, experiments=count, per_run=per_run)
        hidden = lost(found, names)
        if hidden == before:
            return count - 1, time.process_time() - began
        before = hidden
    return most, time.process_time() - began


def lost(found: Structure, names: Sequence[str]) -> int:
    """How many directions of the parameters are hidden: their number less the rank they add to
    what the initial states alone have."""
    alone = [n for n in found.model.names if n not in names]
    fixed = structure(found.model, varying=False, known=names)
    hidden_states = len(alone) - (fixed.rank - len(names))
    return found.unknowns - found.rank - hidden_states


# -- the page --------------------------------------------------------------------------------------


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A table in Markdown."""
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    return [*lines, *(f"| {' | '.join(row)} |" for row in rows), ""]


def main() -> None:
    """Compare everything, write the page."""
    rows, agreed, functions, times = [], 0, 0, []
    for model in published(MODELS.read_text(encoding="utf-8")):
        row, agrees, took = compared(model)
        functions += len(model.determined)
        rows.append(row)
        agreed += agrees
        times.append(took)
        print(*row, flush=True)
    lines = [
        "# Structural rank beside published answers",
        "",
        "Made by `make study-structural`. Models and functions that are determined: from the",
        "benchmarks of StructuralIdentifiability.jl (`structural_models.txt`). The rank of the",
        "published functions, and the unknowns that do not follow from them, are in brackets.",
        "Formulas: functions of what is not determined that casest finds, of all that there are",
        "independent of each other.",
        "",
        f"**{agreed} of {len(rows)} models agree in everything**, {functions} published functions "
        f"among it; the slowest takes {max(times):.2f} s, all {sum(times):.1f} s, on one core.",
        "",
        *table(
            [
                "model",
                "unknowns",
                "rank",
                "not determined",
                "published functions determined",
                "formulas",
                "s",
                "agrees",
            ],
            rows,
        ),
        *other_questions(),
    ]
    TABLE.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def other_questions() -> list[str]:
    """The second and the third table."""
    rows = []
    for case in cases():
        found = structure(case.model.declared(), **case.asked)
        agrees = set(found.undetermined) == case.hidden
        shown = ", ".join(found.undetermined) or "none"
        words = case.words + (" (in floating point)" if found.rounded else "")
        rows.append([words, shown, "yes" if agrees else "**no**", case.source])
        print(*rows[-1], flush=True)
    head = ["question", "not determined", "as published", "published in"]
    lines = ["## Known, unmeasured, constant", "", *table(head, rows)]
    return [*lines, *experiments()]


def experiments() -> list[str]:
    """How many experiments are enough."""
    wanted = {cycle: [3], catenary: [4, 5], mammillary: [4, 5]}
    rows = []
    for graph, counts in wanted.items():
        for n in range(3, 9):
            published_count = counts[min(n - 3, len(counts) - 1)]
            count, took = enough(compartments(graph, n), 7)
            agrees = "yes" if count == published_count else "**no**"
            rows.append(
                [graph.__name__, str(n), f"{count} ({published_count})", f"{took:.1f}", agrees]
            )
            print(*rows[-1], flush=True)
    text = [
        "## Experiments that are enough",
        "",
        "Compartments with rates a + b·x0, x0 constant in each experiment: the number after which",
        f"one more determines no more of the parameters; published ones in brackets ({SEVERAL}).",
        "",
    ]
    return [*text, *table(["graph", "compartments", "experiments", "s", "as published"], rows)]


if __name__ == "__main__":
    main()
