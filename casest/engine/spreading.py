"""Values spread out as sums of factor × atom: what depends on parameters × what does not.

An atom is a product of values of the sample that are not spread further: inputs, functions like a
sine, sums that no parameter enters. Factors are only written down here, as multiplications and
additions of the graph's values that do not depend on the sample; `Factors` computes them.
"""

from __future__ import annotations

import operator
from collections.abc import Collection, Sequence

import casadi as ca
import numpy as np

from casest.engine.graph import Graph, Value
from casest.engine.operations import Floats
from casest.engine.scalars import Scalars, Step, follow

#: The values whose product the atom is, in rising order; none for the atom 1.
Atom = tuple[int, ...]
#: For each atom the number of its factor.
Spread = dict[Atom, int]

#: Terms that two sums may have together for their product to be spread out.
_PRODUCT = 6
#: Operations that make sums.
SUMS = (ca.OP_ADD, ca.OP_SUB)


class Factors:
    """Numbers that depend on parameters only, written down one by one and computed together."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._known: dict[object, int] = {}
        #: Two earlier numbers and what is done with them; or a value of the graph.
        self._steps: list[Step | int] = []
        self.one = self.of(graph.add(Value("constant", constant=1.0)))

    def of(self, value: int) -> int:
        """The number of a value of the graph."""
        return self._add(value)

    def times(self, a: int, b: int) -> int:
        """The number of a product."""
        if a == self.one:
            return b
        return a if b == self.one else self._add((operator.mul, a, b))

    def plus(self, a: int, b: int) -> int:
        """The number of a sum."""
        return self._add((operator.add, a, b))

    def _add(self, step: Step | int) -> int:
        if step not in self._known:
            self._known[step] = len(self._steps)
            self._steps.append(step)
        return self._known[step]

    def keep(self, wanted: Collection[int]) -> dict[int, int]:
        """Forget all but what these take; where each of them is in the result."""
        needed, stack = set[int](), list(wanted)
        while stack:
            i = stack.pop()
            if i not in needed:
                needed.add(i)
                step = self._steps[i]
                stack += [] if isinstance(step, int) else step[1:]
        steps = {i: self._steps[i] for i in sorted(needed)}
        self._scalars = Scalars(self.graph, [s for s in steps.values() if isinstance(s, int)])
        place: dict[int, int] = {}
        self._rest: list[Step] = []
        for i, step in steps.items():
            if isinstance(step, int):
                place[i] = self._scalars.place[step]
            else:
                place[i] = len(self._scalars) + len(self._rest)
                self._rest.append((step[0], place[step[1]], place[step[2]]))
        self._steps.clear()
        self._known.clear()
        return {i: place[i] for i in wanted}

    def values(self, parameters: Floats) -> tuple[Floats, Floats]:
        """All that was kept, at some parameters (n,), and the same with all signs positive.

        Where the second is much larger, digits have been lost.
        """
        first = self._scalars(parameters)
        size = follow(self._rest, [abs(x) for x in first])
        return np.array(follow(self._rest, first)), np.array(size)


class Spreading:
    """Wanted values of a graph as `sums` of factor × atom.

    Values that are `closed`, and those that would have more than `most` terms, stay atoms. It ends
    before it is `done` where there are more than `limit` atoms.
    """

    def __init__(
        self,
        graph: Graph,
        wanted: Sequence[int],
        most: int,
        closed: Collection[int],
        limit: float,
    ) -> None:
        self.graph, self.factors = graph, Factors(graph)
        self._most, self._closed = most, closed
        self._minus, self._two = (
            self.factors.of(graph.add(Value("constant", constant=c))) for c in (-1.0, 2.0)
        )
        self._fixed: set[int] = set()  # values that no parameter enters
        self._spreads: dict[int, Spread] = {}
        self.atoms: set[Atom] = set()
        self.done, ends = False, set(wanted)
        for i in graph.needed(wanted):
            self._spreads[i] = self._spread(i, graph.values[i])
            if i in ends:
                self.atoms.update(self._spreads[i])
            if len(self.atoms) > limit:
                return
        self.sums = [self._spreads[i] for i in wanted]
        self.done = True

    def value(self, atom: Atom) -> int:
        """The number of the graph's value that is this atom."""
        graph = self.graph
        if not atom:
            return graph.add(Value("constant", constant=1.0))
        if len(atom) == 1:
            return atom[0]
        if len(atom) == 2 and atom[0] == atom[1]:
            return graph.add(graph.operation(ca.OP_SQ, atom[:1]))
        return graph.add(graph.operation(ca.OP_MUL, (atom[0], self.value(atom[1:]))))

    def _spread(self, i: int, value: Value) -> Spread:
        if value.kind != "parameter" and all(j in self._fixed for j in value.operands):
            self._fixed.add(i)
        if not value.per_sample:
            return {(): self.factors.of(i)}
        whole: Spread = {(i,): self.factors.one}
        # A sum that no parameter enters has nothing to be taken out.
        plain = i in self._fixed and value.code in SUMS
        if value.kind != "operation" or i in self._closed or plain:
            return whole
        found = self._operation(value)
        return whole if found is None or len(found) > self._most else found

    def _operation(self, value: Value) -> Spread | None:
        code, j = value.code, value.operands[-1]
        a, b = self._spreads[value.operands[0]], self._spreads[j]
        if code == ca.OP_NEG:
            return self._scaled(a, self._minus)
        if code == ca.OP_TWICE:
            return self._scaled(a, self._two)
        if code in SUMS:
            return self._added(a, b if code == ca.OP_ADD else self._scaled(b, self._minus))
        if code in (ca.OP_MUL, ca.OP_SQ):
            return self._product(a, b)
        if code == ca.OP_DIV:
            inverse = self.graph.add(self.graph.operation(ca.OP_INV, (j,)))
            if self.graph.values[j].per_sample:
                return self._product(a, {(inverse,): self.factors.one})
            return self._scaled(a, self.factors.of(inverse))
        return None

    def _scaled(self, a: Spread, factor: int) -> Spread:
        return {atom: self.factors.times(own, factor) for atom, own in a.items()}

    def _added(self, a: Spread, b: Spread) -> Spread:
        found = dict(a)
        for atom, factor in b.items():
            found[atom] = self.factors.plus(found[atom], factor) if atom in found else factor
        return found

    def _product(self, a: Spread, b: Spread) -> Spread | None:
        if min(len(a), len(b)) > 1 and len(a) * len(b) > _PRODUCT:
            return None
        found: Spread = {}
        for atom, factor in a.items():
            own = {tuple(sorted(atom + k)): f for k, f in b.items()}
            found = self._added(found, self._scaled(own, factor))
        return found
