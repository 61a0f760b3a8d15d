"""What states of a PEtab problem do: from SBML, as far as it is plain, or from written lines."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from casest.errors import DataError
from casest.petab.formula import name_of, names_in, number_of, of_mathml, python_of, replaced

#: What a model of SBML may hold that is not read, by the element's name.
UNREAD = {
    "event": "an event",
    "algebraicRule": "an algebraic rule",
    "delay": "a delay",
    "constraint": "a constraint",
}
_LINE = re.compile(r"\s*(\w+)\s*('|\(0\))?\s*=\s*(.+)$")


@dataclass
class Equations:
    """`rates` and `begins` of every state, what is `assigned`, and plain `values`; all formulas."""

    name: str
    rates: dict[str, str] = field(default_factory=dict)
    begins: dict[str, str] = field(default_factory=dict)
    assigned: dict[str, str] = field(default_factory=dict)
    values: dict[str, str] = field(default_factory=dict)


def written_equations(path: Path) -> Equations:
    """Lines `A' = -k1*A`, `A(0) = a0`, `name = formula`; # begins a remark."""
    found = Equations(name_of(path.stem, str(path)))
    for k, line in enumerate(_text(path).splitlines(), 1):
        line, where = line.partition("#")[0].strip(), f"{path} line {k}"
        if not line:
            continue
        match = _LINE.match(line)
        if match is None:
            raise DataError(f"{where}: {line!r} is none of NAME' = …, NAME(0) = … and NAME = …")
        name, mark, formula = name_of(match[1], where), match[2], match[3]
        place = {"'": found.rates, "(0)": found.begins, None: found.assigned}[mark]
        place[name] = python_of(formula, where)
    for name in found.rates:
        if name not in found.begins:
            raise DataError(f"{path}: says nothing of {name}(0), where {name} begins")
    if not found.rates:
        raise DataError(f"{path}: holds no rate: a line NAME' = formula for each state")
    return found


def sbml(path: Path) -> Equations:
    """The equations of an SBML file (level 2 or 3), whatever is plain; else DataError says what."""
    try:
        root = ElementTree.fromstring(_text(path).encode())
    except ElementTree.ParseError as error:
        raise DataError(f"{path}: is no SBML ({error})") from None
    for node in root.iter():
        node.tag = node.tag.rpartition("}")[2]
    for node in root.iter():
        if node.tag in UNREAD:
            raise DataError(f"{path}: has {UNREAD[node.tag]}, which is not read")
    model = root.find("model")
    if model is None:
        raise DataError(f"{path}: holds no model")
    return _Reader(model, str(path)).equations()


class _Reader:
    """One model on the way to equations."""

    def __init__(self, model: Element, where: str) -> None:
        self.model, self.where = model, where
        self.functions = {
            str(f.get("id")): ([str(b[0].text).strip() for b in body[:-1]], body[-1])
            for f in model.iter("functionDefinition")
            for body in f.iter("lambda")
        }

    def equations(self) -> Equations:
        """All of it."""
        name = re.sub(r"\W", "_", self.model.get("id") or "model")
        found = Equations(name_of(name if not name[:1].isdigit() else f"_{name}", self.where))
        for kind, value in (("compartment", "size"), ("parameter", "value")):
            for node in self._all(f"listOf{kind.capitalize()}s", kind):
                found.values[self._id(node)] = _number(node.get(value), "1.0")
        species = {self._id(node): node for node in self._all("listOfSpecies", "species")}
        for own, node in species.items():
            found.values[own] = self._first(node)
        begins = {str(n.get("symbol")): self._math(n)
                  for n in self._all("listOfInitialAssignments", "initialAssignment")}  # fmt: skip
        found.assigned.update(self._rules("assignmentRule"))
        found.rates.update(self._rules("rateRule"))
        found.rates.update(self._by_reactions(species, {*found.rates, *found.assigned}))
        for own in found.rates:
            found.begins[own] = begins.pop(own, found.values.pop(own, "0.0"))
        for own, formula in begins.items():
            found.values.pop(own, None)
            found.assigned.setdefault(own, formula)
        for own in found.assigned:
            found.values.pop(own, None)
        moving = {n.get("id") for n in self.model.iter("compartment")} & {*found.rates}
        if moving:
            raise DataError(f"{self.where}: the size of {moving.pop()} changes; it is not read")
        return found

    def _by_reactions(self, species: Mapping[str, Element], known: set[str]) -> dict[str, str]:
        terms: dict[str, list[str]] = {}
        for reaction in self._all("listOfReactions", "reaction"):
            law = self._law(reaction)
            for place, sign in (("listOfReactants", "-"), ("listOfProducts", "+")):
                for ref in reaction.iterfind(f"{place}/speciesReference"):
                    if ref.find("stoichiometryMath") is not None:
                        raise DataError(f"{self.where}: stoichiometryMath is not read")
                    own, count = str(ref.get("species")), _number(ref.get("stoichiometry"), "1.0")
                    node = species.get(own)
                    if node is None:
                        raise DataError(f"{self.where}: a reaction has no species {own}")
                    if own in known or "true" in (
                        node.get("boundaryCondition"),
                        node.get("constant"),
                    ):
                        continue
                    size = "" if _amount(node) else f" / {node.get('compartment')}"
                    terms.setdefault(own, []).append(f"{sign} {count} * {law}{size}")
        return {own: " ".join(parts).removeprefix("+ ") for own, parts in terms.items()}

    def _law(self, reaction: Element) -> str:
        law = reaction.find("kineticLaw")
        if law is None or law.find("math") is None:
            raise DataError(f"{self.where}: reaction {reaction.get('id')} has no kinetic law")
        local = {
            self._id(node): _number(node.get("value"), "0.0")
            for kind in ("parameter", "localParameter")
            for node in law.iter(kind)
        }
        formula = self._math(law)
        return f"({replaced(formula, local) if local else formula})"

    def _rules(self, kind: str) -> dict[str, str]:
        return {name_of(str(n.get("variable")), self.where): self._math(n)
                for n in self._all("listOfRules", kind)}  # fmt: skip

    def _first(self, node: Element) -> str:
        concentration, amount = node.get("initialConcentration"), node.get("initialAmount")
        size = str(node.get("compartment"))
        if concentration is not None:
            value = _number(concentration, "0.0")
            return f"{value} * {size}" if _amount(node) else value
        value = _number(amount, "0.0")
        return value if _amount(node) else f"{value} / {size}"

    def _math(self, node: Element) -> str:
        math = node.find("math")
        if math is None:
            raise DataError(f"{self.where}: {node.tag} has no formula")
        return of_mathml(math, self.where, self.functions)

    def _all(self, place: str, kind: str) -> Iterator[Element]:
        return self.model.iterfind(f"{place}/{kind}")

    def _id(self, node: Element) -> str:
        return name_of(str(node.get("id")), self.where)


def ordered(formulas: Mapping[str, str], where: str) -> dict[str, str]:
    """Each after what it reads."""
    found: dict[str, str] = {}

    def place(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise DataError(f"{where}: {' -> '.join((*above, name))} goes in a circle")
        for other in sorted(names_in(formulas[name]) & set(formulas)):
            if other not in found:
                place(other, (*above, name))
        found.setdefault(name, formulas[name])

    for name in formulas:
        place(name, ())
    return found


def _amount(node: Element) -> bool:
    return node.get("hasOnlySubstanceUnits") == "true"


def _number(text: str | None, otherwise: str) -> str:
    value = None if text is None else number_of(text)
    return otherwise if value is None else repr(value)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise DataError(f"{path}: is no text") from None
