"""A PEtab problem as files of one's own: a declaration, and a record for each condition."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from casest.errors import DataError
from casest.petab.equations import ordered
from casest.petab.formula import FUNCTIONS, names_in, replaced, value_of
from casest.petab.problem import Measured, Tables, filled


@dataclass(frozen=True)
class Written:
    """Text of the declaration, of the record of each condition, and what is said of it."""

    name: str
    model: str
    records: Mapping[str, str]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Channel:
    """Readings of one observable with one formula, one at a time: a column of the records."""

    name: str
    predicted: str
    #: By condition and time: what was read, and its standard deviation.
    values: Mapping[tuple[str, float], tuple[float, float]]

    @property
    def std(self) -> float | None:
        """Of all readings; None where they differ."""
        every = {std for _, std in self.values.values()}
        return every.pop() if len(every) == 1 else None


def written(tables: Tables) -> Written:
    """The problem as a declaration and its records. Raises DataError for what has no such form."""
    channels = _channels(tables)
    conditions = list(dict.fromkeys(m.condition for m in tables.measurements))
    differing = _differing(tables, conditions)
    formulas = _formulas(tables, conditions, differing)
    needed = _needed(formulas, [c.predicted for c in channels], tables)
    columns = [name for name in _columns(tables, conditions, differing) if name in needed]
    notes = [*tables.notes, *_held(tables, needed, channels)]
    records = {file_of(c): _record(tables, c, channels, columns) for c in conditions}
    if len(records) < len(conditions):
        raise DataError(f"{tables.name}: two conditions have one name but for special characters")
    model = _model(tables, formulas, needed, channels, columns)
    return Written(tables.name, model, records, tuple(notes))


def file_of(condition: str) -> str:
    """The name of a condition's record, without what file systems or commands read otherwise."""
    return re.sub(r"[^\w.-]", "_", condition, flags=re.ASCII).lstrip(".-") or "condition"


# -- readings --------------------------------------------------------------------------------------


def _channels(tables: Tables) -> list[_Channel]:
    found: dict[tuple[str, tuple[str, ...], int], dict[tuple[str, float], Measured]] = {}
    for m in tables.measurements:
        k = 0  # replicates are columns of their own: a record has one row for each time
        while (m.condition, m.time) in found.setdefault((m.observable, m.given, k), {}):
            k += 1
        found[m.observable, m.given, k][m.condition, m.time] = m
    count, made = Counter(name for name, *_ in found), Counter[str]()
    channels = []
    for (name, given, _), rows in found.items():
        made[name] += 1
        own = name if count[name] == 1 else f"{name}_{made[name]}"
        predicted = filled(tables.observables[name].formula, "observable", name, given)
        scale = tables.observables[name].scale
        if scale in ("log", "log10"):
            predicted = FUNCTIONS[scale](predicted)
        values = {place: _reading(tables, m, scale) for place, m in rows.items()}
        channels.append(_Channel(own, predicted, values))
    return channels


def _reading(tables: Tables, m: Measured, scale: str) -> tuple[float, float]:
    """A reading and its standard deviation, with what is held at its nominal value put in."""
    where = f"measurement {m.row} of {m.observable}"
    formula = filled(tables.observables[m.observable].noise, "noise", m.observable, m.noise)
    given = {name: u.value for name, u in tables.unknowns.items()}
    given |= {n: value_of(v, {}, where) for n, v in tables.equations.values.items()
              if not names_in(v)}  # fmt: skip
    std = value_of(formula, given, where)
    if not std > 0:
        raise DataError(f"{where}: its noise comes to {std:g}; it is above zero")
    if scale in ("", "lin"):
        return m.value, std
    if not m.value > 0:
        raise DataError(f"{where}: {m.value:g} has no logarithm, which its observable takes")
    return (math.log if scale == "log" else math.log10)(m.value), std


def _record(tables: Tables, condition: str, channels: list[_Channel], columns: list[str]) -> str:
    """CSV: a row for each time, from t = 0 on; an empty cell where nothing was read."""
    times = {0.0} | {m.time for m in tables.measurements if m.condition == condition}
    if min(times) < 0:
        raise DataError(f"condition {condition}: a measurement before t = 0")
    spread = [c for c in channels if c.std is None]
    header = ["t [s]", *(c.name for c in channels), *(f"std_{c.name}" for c in spread), *columns]
    rows = [",".join(header)]
    constant = [_column(tables, condition, name) for name in columns]
    for time in sorted(times):
        read = [c.values.get((condition, time)) for c in channels]
        cells = [repr(time), *("" if r is None else repr(r[0]) for r in read)]
        for c in spread:
            there = c.values.get((condition, time)) or next(iter(c.values.values()))
            cells.append(repr(there[1]))
        rows.append(",".join([*cells, *constant]))
    return "\n".join(rows) + "\n"


# -- conditions ------------------------------------------------------------------------------------


def _differing(tables: Tables, conditions: list[str]) -> dict[str, list[str | None]]:
    """What each condition says of every name that any of them says something of."""
    names = dict.fromkeys(name for c in conditions for name in tables.conditions[c])
    return {name: [tables.conditions[c].get(name) for c in conditions] for name in names}


def _is(condition: str) -> str:
    """The column that says: is it this condition?"""
    return "is_" + re.sub(r"\W", "_", condition, flags=re.ASCII)


def _is_number(text: str | None) -> bool:
    return text is not None and not names_in(text)


def _columns(
    tables: Tables, conditions: list[str], differing: Mapping[str, list[str | None]]
) -> list[str]:
    """Columns of the records: numbers that differ, or which condition it is."""
    found = []
    for name, values in differing.items():
        if len(set(values)) > 1:
            numbers = all(map(_is_number, values))
            found += [f"in_{name}"] if numbers else [_is(c) for c in conditions]
    return list(dict.fromkeys(found))


def _column(tables: Tables, condition: str, name: str) -> str:
    if name.startswith("is_"):
        return "1" if name == _is(condition) else "0"
    return tables.conditions[condition][name.removeprefix("in_")]


def _overridden(
    name: str, values: list[str | None], conditions: list[str], otherwise: str | None
) -> str:
    """One formula for what differs between conditions."""
    if None in values and otherwise is None:
        raise DataError(f"not all conditions say what {name} is, and neither does the model")
    said = [str(otherwise) if v is None else v for v in values]
    if len(set(said)) == 1:
        return said[0]
    if all(map(_is_number, values)):
        return f"in_{name}"
    return " + ".join(f"{_is(c)} * ({v})" for c, v in zip(conditions, said, strict=True))


# -- the declaration -------------------------------------------------------------------------------


def _formulas(
    tables: Tables, conditions: list[str], differing: Mapping[str, list[str | None]]
) -> dict[str, str]:
    """Every name of the body, in an order in which each can be computed."""
    e = tables.equations
    found = {**e.values, **e.assigned}
    begins = dict(e.begins)
    for name, values in differing.items():
        place = begins if name in e.rates else found
        if name in tables.unknowns:
            raise DataError(f"{name} is in the table of parameters and differs between conditions")
        place[name] = _overridden(name, values, conditions, place.get(name))
    for name in tables.unknowns:
        found.pop(name, None)
        if name in begins:
            begins[name] = name
    first = {name: f"{name}_0" for name in e.rates}
    for k, name in enumerate(e.rates):
        if first[name] in {*found, *e.rates, *tables.unknowns}:
            raise DataError(f"{first[name]}: the name is needed for where {name} begins")
        found[first[name]] = replaced(begins[name], first)
        found[name] = f"{first[name]} + moved[{k}]"
    return ordered(found, tables.name)


def _needed(formulas: Mapping[str, str], read: list[str], tables: Tables) -> set[str]:
    """All names that rates and readings lead to."""
    open_ = [*tables.equations.rates.values(), *read]
    found = set(tables.equations.rates)
    open_ += [formulas[name] for name in found]
    while open_:
        for name in names_in(open_.pop()) - found:
            found.add(name)
            open_ += [formulas[name]] if name in formulas else []
    return found


def _held(tables: Tables, needed: set[str], channels: list[_Channel]) -> list[str]:
    """What is said of parameters that the declaration does not have."""
    noise = [n for n, u in tables.unknowns.items() if u.bounds is not None and n not in needed]
    if not noise:
        return []
    return [
        f"{', '.join(noise)}: how large the noise is, or nothing; held at the nominal value "
        "(readings are weighed by it)"
    ]


def _model(
    tables: Tables,
    formulas: Mapping[str, str],
    needed: set[str],
    channels: list[_Channel],
    columns: list[str],
) -> str:
    e, known = tables.equations, {*formulas, *tables.unknowns, *columns, "moved", "per_time", "t"}
    missing = needed - known
    if missing:
        raise DataError(f"{min(missing)}: neither the model nor a table says what it is")
    body = [(n, f) for n, f in formulas.items() if n in needed]
    spread = [c for c in channels if c.std is None]
    timed = "t" in needed
    arguments = [*(["t=casest.signal('s')"] if timed else [])]
    arguments += [f"{c.name}=casest.signal()" for c in channels]
    arguments += [f"std_{c.name}=casest.signal()" for c in spread]
    arguments += [f"{name}=casest.signal(held=True)" for name in columns]
    unknown = []
    for name, u in tables.unknowns.items():
        if name in needed and u.bounds is not None:
            unknown.append(f"{name}=casest.param(start={u.value!r}, bounds={u.bounds!r})")
        elif name in needed:
            unknown.append(f"{name}=casest.constant({u.value!r})")
    outputs = ", ".join(
        f"motion.measured({c.name}, {c.predicted}, std={c.std if c.std else f'std_{c.name}'})"
        for c in channels
    )
    lines = [
        f'"""{tables.name}, from its PEtab tables; `moved`: how far states are from t = 0."""',
        "",
        "import casest",
        "from casest import dynamics as motion",
        "",
        "",
        "@motion.dynamics",
        f"def {tables.name}(",
        *(f"    {a}," for a in arguments),
        "    *,",
        f"    moved=motion.state({len(e.rates)}, start={[0] * len(e.rates)}, known=True),",
        *(f"    {a}," for a in unknown),
        "    per_time=casest.constant(1.0, '1/s'),",
        "):",
        *(f"    {name} = {formula}" for name, formula in body),
        "    rates = casest.vertcat(",
        *(f"        {rate}," for rate in e.rates.values()),
        "    )",
        "    return motion.Motion(",
        "        rates={'moved': rates * per_time},",
        f"        outputs=({outputs},),",
        "    )",
    ]
    return "\n".join(lines) + "\n"
