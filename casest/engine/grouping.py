"""Outputs rewritten as short sums of what depends on the sample, with factors that do not.

A Jacobian that CasADi derives multiplies and adds the same few functions of the sample with ever
new parameters: `s6·(s7·x − s8·y) + s9·(s8·x + s7·y)`. Such a value is s·x + t·y, with s and t
computed once per call. Every value is followed as a sum of at most a few terms, factor times atom;
an atom is what no sum of atoms is: an input, a product of two atoms, a sine. Where a sum would
grow, what it adds up becomes an atom itself, so that nothing is computed twice.

Values change by rounding only: by a few units in the last place of their largest term.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import casadi as ca

from casest.engine.graph import Graph, Value

#: The atom of what does not depend on the sample.
ONE = -1
#: Terms up to which a sum is spread out in another.
MOST = 3


class _Factor(NamedTuple):
    """A number times a value that does not depend on the sample (None: times one)."""

    by: float
    of: int | None = None


_Sum = dict[int, _Factor]


class _Form(NamedTuple):
    """A value as one factor times one atom, and as a sum that may be spread out further.

    alone: whether the atom is a sum that nothing else needs, so that using it is no gain.
    """

    atom: int
    factor: _Factor
    spread: _Sum
    alone: bool = False

    @property
    def single(self) -> _Sum:
        return {self.atom: self.factor}


def group(graph: Graph, outputs: Collection[int]) -> None:
    """Rewrite some outputs of the graph, where that takes fewer operations on every sample.

    The values that the others need stay as they are.
    """
    wanted = [i for o in outputs for i in graph.outputs[o]]
    needed = graph.needed(wanted)
    readers = Counter(j for i in needed for j in graph.values[i].operands)
    grouping = _Grouping(graph, readers)
    for i in needed:
        grouping.follow(i)
    grouped = {o: [grouping.value(i) for i in graph.outputs[o]] for o in outputs}
    if _work(graph, [i for own in grouped.values() for i in own]) < _work(graph, wanted):
        for o, own in grouped.items():
            graph.outputs[o] = own


def _work(graph: Graph, wanted: Sequence[int]) -> int:
    """Operations on every sample."""
    values = [graph.values[i] for i in graph.needed(wanted)]
    return sum(value.per_sample and value.kind == "operation" for value in values)


class _Grouping:
    """Every value of a graph as a sum of atoms. `readers` says how many values need each."""

    def __init__(self, graph: Graph, readers: Mapping[int, int]) -> None:
        self.graph, self.readers = graph, readers
        self.forms: dict[int, _Form] = {}

    def follow(self, i: int) -> None:
        """Find the form of value i, whose operands have theirs."""
        value = self.graph.values[i]
        if not value.per_sample:
            found = {ONE: self._constant(i, value)}
        elif value.kind != "operation":
            found = {i: _Factor(1.0)}
        else:
            own = self._form(value)
            if isinstance(own, _Form):
                self.forms[i] = own
                return
            found = own
        if len(found) == 1:
            ((atom, factor),) = found.items()
            self.forms[i] = _Form(atom, factor, found)
        else:
            alone = self.readers[i] < 2
            self.forms[i] = _Form(self._added_up(found), _Factor(1.0), found, alone)

    def value(self, i: int) -> int:
        """The number of a value that is computed from the form of value i."""
        form = self.forms[i]
        return self._added_up(form.spread if form.alone else form.single)

    # -- forms ---------------------------------------------------------------------------------

    def _form(self, value: Value) -> _Form | _Sum:
        code, a, b = value.code, value.operands[0], value.operands[-1]
        if code in (ca.OP_NEG, ca.OP_TWICE):
            return self._scaled(a, _Factor(-1.0 if code == ca.OP_NEG else 2.0))
        if code in (ca.OP_ADD, ca.OP_SUB):
            return self._shortest(a, b, _Factor(1.0 if code == ca.OP_ADD else -1.0))
        if code in (ca.OP_MUL, ca.OP_SQ):
            return self._product(a, b)
        if code == ca.OP_DIV and not self.graph.values[b].per_sample:
            return self._scaled(a, _Factor(1.0, self._operation(ca.OP_INV, b)))
        if code == ca.OP_DIV:
            return self._quotient(a, b)
        return {self._operation(code, *(self.value(k) for k in value.operands)): _Factor(1.0)}

    def _shortest(self, a: int, b: int, sign: _Factor) -> _Sum:
        """a ± b in as few operations as there can be, each of the two spread out or as one atom."""
        ways = []
        for left, lone in self._ways(a):
            for right, lonely in self._ways(b):
                found = self._merged(left, self._times_all(right, sign))
                ways.append((len(found) - (ONE in found) + lone + lonely, found))
        return min(ways, key=lambda way: way[0])[1]

    def _ways(self, i: int) -> list[tuple[_Sum, int]]:
        """The value spread out and as one atom, and what computing that atom costs more."""
        form = self.forms[i]
        ways = [(form.single, len(form.spread) if form.alone else 0)]
        return [*ways, (form.spread, 0)] if len(form.spread) <= MOST else ways

    def _product(self, a: int, b: int) -> _Form | _Sum:
        for fixed, moving in ((a, b), (b, a)):
            if not self.graph.values[fixed].per_sample:
                return self._scaled(moving, self.forms[fixed].factor)
        one, other = self.forms[a], self.forms[b]
        atoms = one.atom, other.atom
        code = (ca.OP_SQ, one.atom) if atoms[0] == atoms[1] else (ca.OP_MUL, *atoms)
        return {self._operation(*code): self._times(one.factor, other.factor)}

    def _quotient(self, a: int, b: int) -> _Sum:
        """What is divided by a value of the sample: its own factor stays outside."""
        divisor, form = self.value(b), self.forms[a]
        if form.atom == ONE:
            return {self._operation(ca.OP_INV, divisor): form.factor}
        return {self._operation(ca.OP_DIV, form.atom, divisor): form.factor}

    def _scaled(self, i: int, factor: _Factor) -> _Form:
        form = self.forms[i]
        spread = self._times_all(form.spread, factor)
        return _Form(form.atom, self._times(form.factor, factor), spread, form.alone)

    def _times_all(self, found: _Sum, factor: _Factor) -> _Sum:
        return {atom: self._times(own, factor) for atom, own in found.items()}

    def _merged(self, left: _Sum, right: _Sum) -> _Sum:
        found = dict(left)
        for atom, factor in right.items():
            if atom not in found:
                found[atom] = factor
                continue
            found[atom] = self._plus(found[atom], factor)
            if found[atom].by == 0 and len(found) > 1:
                del found[atom]
        return found

    # -- factors -------------------------------------------------------------------------------

    def _constant(self, i: int, value: Value) -> _Factor:
        plain = value.kind == "constant" and value.constant in (-2.0, -1.0, 0.5, 1.0, 2.0)
        return _Factor(value.constant) if plain else _Factor(1.0, i)

    def _times(self, s: _Factor, t: _Factor) -> _Factor:
        if s.of is None or t.of is None:
            return _Factor(s.by * t.by, t.of if s.of is None else s.of)
        return _Factor(s.by * t.by, self._operation(ca.OP_MUL, s.of, t.of))

    def _plus(self, s: _Factor, t: _Factor) -> _Factor:
        if s.of == t.of:
            return _Factor(s.by + t.by, s.of if s.by + t.by else None)
        return _Factor(1.0, self._operation(ca.OP_ADD, self._fixed(s), self._fixed(t)))

    def _fixed(self, factor: _Factor) -> int:
        """The factor as a value."""
        if factor.of is None:
            return self.graph.add(Value("constant", constant=factor.by))
        if factor.by == 1.0:
            return factor.of
        if factor.by == -1.0:
            return self._operation(ca.OP_NEG, factor.of)
        by = self.graph.add(Value("constant", constant=factor.by))
        return self._operation(ca.OP_MUL, by, factor.of)

    # -- values --------------------------------------------------------------------------------

    def _added_up(self, found: _Sum) -> int:
        """The number of the value: its terms one after the other, those that need no sign first."""
        total: int | None = None
        for atom, factor in sorted(found.items(), key=lambda pair: pair[1] == _Factor(-1.0)):
            less = factor == _Factor(-1.0) and atom != ONE and total is not None
            term = atom if less else self._term(atom, factor)
            if total is None:
                total = term
            else:
                total = self._operation(ca.OP_SUB if less else ca.OP_ADD, total, term)
        assert total is not None
        return total

    def _term(self, atom: int, factor: _Factor) -> int:
        if atom == ONE:
            return self._fixed(factor)
        if factor == _Factor(1.0):
            return atom
        if factor == _Factor(-1.0):
            return self._operation(ca.OP_NEG, atom)
        if factor == _Factor(2.0):
            return self._operation(ca.OP_TWICE, atom)
        return self._operation(ca.OP_MUL, self._fixed(factor), atom)

    def _operation(self, code: int, *operands: int) -> int:
        return self.graph.operation(code, operands)
