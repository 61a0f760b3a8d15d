"""What a model's functions of a scale of their own are asked of, and what is added to samples.

Read from the expression graph of the residual: the structure says which values of an unknown can
matter, where its declared start says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca

from casest.declaration.model import Model
from casest.declaration.tracing import function_of, sample_symbol
from casest.engine import Replay
from casest.engine.graph import Graph, Value

_PERIODIC = {ca.OP_SIN, ca.OP_COS, ca.OP_TAN}
_SCALED = _PERIODIC | {
    ca.OP_EXP,
    ca.OP_EXPM1,
    ca.OP_TANH,
    ca.OP_SINH,
    ca.OP_COSH,
    ca.OP_ERF,
    ca.OP_ATAN,
    ca.OP_ATAN2,
}
_POWERS = {ca.OP_POW, ca.OP_CONSTPOW}
_SUMS = {ca.OP_ADD, ca.OP_SUB}


class Node(NamedTuple):
    """An argument of a scaled function (`place` None), or an unknown term added to `argument`."""

    argument: int
    place: int | None
    periodic: bool
    unknowns: frozenset[int]


@dataclass(frozen=True)
class Arguments:
    """What the nodes need, as a function of (parameters, sample) with one output `u`."""

    nodes: tuple[Node, ...]
    replay: Replay


@lru_cache(maxsize=64)
def arguments_of(model: Model) -> Arguments:
    """The nodes of the residual's expression graph."""
    graph = Graph(function_of(model, {"r": model.traced.expression}))
    count = model.traced.coordinates.numel()
    reached = _reached(graph, count)
    outputs: list[Any] = []
    expressions = _expressions(graph, model)
    nodes: list[Node] = []

    def asked(expression: Any) -> int:
        outputs.append(expression)
        return len(outputs) - 1

    sines = {j for v in graph.values if v.code in _PERIODIC and v.operands for j in v.operands}
    for i, value in enumerate(graph.values):
        if value.kind != "operation" or not value.per_sample:
            continue
        for a in value.operands if value.code in _SCALED else ():
            if graph.values[a].per_sample and reached[a]:
                periodic = value.code in _PERIODIC
                nodes.append(Node(asked(expressions[a]), None, periodic, reached[a]))
        if value.code in _POWERS and reached[value.operands[1]]:
            a, b = value.operands
            exponent = expressions[b] * ca.log(ca.fabs(expressions[a]))
            nodes.append(Node(asked(exponent), None, False, reached[b]))
        if value.code in _SUMS:
            nodes += _of_sum(graph, value, expressions, reached, i in sines, asked)
    u = ca.densify(ca.vertcat(*outputs)) if outputs else ca.SX.zeros(1)
    return Arguments(tuple(nodes), Replay(function_of(model, {"u": u})))


def _of_sum(
    graph: Graph, value: Value, expressions: Any, reached: Any, periodic: bool, asked: Any
) -> list[Node]:
    """An unknown added to a term of the samples, or such a term beside a number."""
    nodes = []
    a, b = value.operands
    for own, term in ((a, b), (b, a)):
        if graph.values[own].per_sample or not graph.values[term].per_sample:
            continue
        if reached[own]:
            met = expressions[term] if value.code == ca.OP_SUB else -expressions[term]
            place = Node(asked(met), asked(expressions[own]), periodic, reached[own])
            nodes.append(place)
        elif reached[term] and graph.values[term].code not in _SCALED:
            ratio = expressions[term] / expressions[own]
            nodes.append(Node(asked(ratio), None, False, reached[term]))
    return nodes


def _reached(graph: Graph, count: int) -> list[frozenset[int]]:
    """Unknowns that every value of the graph depends on."""
    reached: list[frozenset[int]] = []
    for value in graph.values:
        if value.kind == "parameter" and value.code < count:
            reached.append(frozenset([value.code]))
        else:
            reached.append(frozenset().union(*(reached[j] for j in value.operands)))
    return reached


def _expressions(graph: Graph, model: Model) -> list[Any]:
    """Every value of the graph in symbols again."""
    t, sample = model.traced, sample_symbol(model)
    parameters = ca.vertcat(t.coordinates, t.references)
    found: list[Any] = []
    for value in graph.values:
        operands = [found[j] for j in value.operands]
        if value.kind == "constant":
            found.append(ca.SX(value.constant))
        elif value.kind == "operation":
            make = ca.SX.unary if len(operands) == 1 else ca.SX.binary
            found.append(make(value.code, *operands))
        else:
            found.append((parameters if value.kind == "parameter" else sample)[value.code])
    return found
