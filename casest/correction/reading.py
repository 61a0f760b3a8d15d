"""Programs and corrections from files that anybody may have written: checked before they are run.

Types and sizes are those of the Structs; what a type cannot say (an operation that exists,
registers that are set before they are read) is checked behind it. Everything wrong is a DataError
that names the key.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct

from casest.correction.carried import Carried
from casest.correction.numpy_module import as_data
from casest.correction.numpy_table import ARITIES
from casest.correction.program import Input, Program
from casest.declaration.symbols import Signal
from casest.errors import DataError

T = TypeVar("T")
#: More of anything is no correction: it would take memory or hours.
_WIDEST, _LONGEST, _STARTS = 4096, 100_000, 100
_Size = Annotated[int, Meta(ge=1, le=_WIDEST)]
_Step = Annotated[list[Any], Meta(min_length=3, max_length=4)]


class _Values(Struct):
    name: str
    size: _Size
    unit: str
    kind: Literal["plain", "rotation"] = "plain"


class _Signal(Struct):
    name: str
    size: _Size
    unit: str | None
    kind: Literal["plain", "rotation"]


class _Newton(Struct):
    starts: Annotated[list[float], Meta(max_length=_STARTS)]
    middle: float
    measured: tuple[int, int]
    largest: Annotated[float, Meta(gt=0)]


class _Program(Struct):
    kind: Literal["direct", "newton"]
    inputs: Annotated[list[_Values], Meta(min_length=1, max_length=_WIDEST)]
    output: _Values
    registers: Annotated[int, Meta(ge=0, le=_LONGEST)]
    steps: Annotated[list[_Step], Meta(max_length=_LONGEST)]
    newton: _Newton | None = None


class _Carried(Struct):
    model: str
    program: _Program
    signals: list[_Signal]
    own: list[list[float]]
    readings: Annotated[list[list[list[float]]], Meta(min_length=1)]
    not_undone: list[str]
    follows_time: list[str]
    range: list[tuple[float, float]] = []
    uncertainty: _Program | None = None
    elsewhere: dict[str, Any] | None = None
    happened_once: list[str] = []


def carried_data(found: Carried) -> dict[str, Any]:
    """As it is written in a result."""
    return {
        "model": found.model,
        "program": as_data(found.program),
        "signals": [
            {"name": s.name, "size": s.size, "unit": s.unit, "kind": s.kind} for s in found.signals
        ],
        "own": [list(numbers) for numbers in found.own],
        "readings": [part.tolist() for part in found.readings],
        "not_undone": list(found.program.left),
        "follows_time": list(found.timed),
        "range": [list(pair) for pair in found.seen],
        **({} if found.spread is None else {"uncertainty": as_data(found.spread)}),
        **({} if found.elsewhere is None else {"elsewhere": carried_data(found.elsewhere),
                                               "happened_once": list(found.once)}),
    }  # fmt: skip


def typed(content: Any, kind: type[T], where: str) -> T:
    """The content as a value of that type; DataError names the key that is otherwise."""
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        said, _, key = str(error).partition(" - at ")
        key = key.strip("`").removeprefix("$").lstrip(".")
        raise DataError(f"{where}{f': {key}' if key else ''}: {said}; {_AGAIN}") from None


_AGAIN = "the file was edited or is damaged: calibrate or export again"


def program_read(content: Any, where: str, *, left: Sequence[str] = (), own: int = 0) -> Program:
    """A program as `as_data` wrote it; with `own` numbers of each run behind its inputs."""
    found = typed(content, _Program, where)
    inputs = tuple(Input(i.name, i.size, i.unit, i.kind) for i in found.inputs)
    output = Input(found.output.name, found.output.size, found.output.unit)
    steps = tuple(map(tuple, found.steps))
    built = Program(
        "", found.kind, inputs, output, found.registers, steps, left=tuple(left), own=own
    )
    names = [i.name for i in inputs]
    _refuse(len(set(names)) < len(names), f"{where}.inputs: two have one name")
    _refuse(built.width > _WIDEST, f"{where}.inputs: {built.width} numbers in a sample")
    _refuse(found.registers > len(steps), f"{where}.registers: {found.registers}, but fewer steps")
    _check_steps(built, where)
    return _with_newton(built, found.newton, where)


def _with_newton(built: Program, newton: _Newton | None, where: str) -> Program:
    """What Newton's method needs, where the program is one for it."""
    _refuse((built.kind == "newton") != (newton is not None), f"{where}.newton: of {built.kind}")
    if newton is None:
        return built
    at, size = newton.measured
    outside = at < 0 or size < 1 or at + size > built.width
    _refuse(outside, f"{where}.newton.measured: [{at}, {size}] lies outside the inputs")
    return replace(
        built,
        starts=tuple(newton.starts),
        middle=newton.middle,
        measured=(at, size),
        largest=newton.largest,
    )


def _check_steps(built: Program, where: str) -> None:
    """Every operation exists, has its operands, and reads registers that are set before it."""
    trial = built.output.size if built.kind == "newton" else 0
    width, outputs = built.width + trial + built.own, built.output.size + trial
    known, given = set[int](), set[int]()
    for k, (operation, place, *operands) in enumerate(built.steps):
        here = f"{where}.steps[{k}]"
        arity = 1 if operation in ("input", "constant", "output") else _arity(operation, here)
        _refuse(len(operands) != arity, f"{here}: {operation} has {len(operands)} operands")
        _refuse(not _among(place, outputs if operation == "output" else built.registers),
                f"{here}: there is no place {place!r:.60}")  # fmt: skip
        if operation == "constant":
            _refuse(not _finite(operands[0]), f"{here}: {operands[0]!r:.60} is no number")
        elif operation == "input":
            _refuse(
                not _among(operands[0], width), f"{here}: there is no input {operands[0]!r:.60}"
            )
        else:
            unset = [r for r in operands if type(r) is not int or r not in known]
            _refuse(bool(unset), f"{here}: nothing is in register {unset[:1]!s:.60}")
        (given if operation == "output" else known).add(place)
    _refuse(len(given) < outputs, f"{where}.steps: {outputs - len(given)} outputs are not set")


def _arity(operation: Any, here: str) -> int:
    known = isinstance(operation, str) and operation in ARITIES
    _refuse(not known, f"{here}: no operation is called {operation!r:.60}")
    return ARITIES[operation]


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and abs(value) <= sys.float_info.max


def _among(place: Any, count: int) -> bool:
    return type(place) is int and 0 <= place < count


def _refuse(bad: bool, said: str) -> None:
    if bad:
        raise DataError(f"{said}; {_AGAIN}")


def carried_read(content: Any, where: str, runs: int) -> Carried:
    """A correction as `carried_data` wrote it, of a result of so many runs."""
    found = typed(content, _Carried, where)
    own, several = len(found.own[0]) if found.own else 0, runs if found.own else 1
    program = program_read(content["program"], f"{where}.program", left=found.not_undone, own=own)
    uneven = len(found.own) not in (0, several) or any(len(o) != own for o in found.own)
    _refuse(uneven, f"{where}.own: not {own} numbers for each of {runs} runs")
    _refuse(len(found.readings) != several, f"{where}.readings: not those of {several} runs")
    for row in (row for part in found.readings for row in part):
        _refuse(len(row) != program.width, f"{where}.readings: {len(row)} numbers in a row")
    wrong = len(found.range) not in (0, program.width) or any(a > b for a, b in found.range)
    _refuse(wrong, f"{where}.range: not low and high of {program.width} numbers")
    known = {s.name: s for s in found.signals}
    _refuse(len(known) < len(found.signals), f"{where}.signals: two have one name")
    for i in program.inputs:
        s = known.get(i.name)
        other = s is None or (s.size, s.kind) != (i.size, i.kind)
        _refuse(other, f"{where}.signals: none is the program's input {i.name!r}")
    return Carried(
        found.model,
        program,
        tuple(Signal(s.name, s.size, s.unit, s.kind) for s in found.signals),
        tuple(map(tuple, found.own)),
        tuple(np.array(part, float).reshape(-1, program.width) for part in found.readings),
        tuple(found.follows_time),
        tuple(found.range),
        spread_read(content.get("uncertainty"), program, where),
        carried_read(found.elsewhere, f"{where}.elsewhere", runs) if found.elsewhere else None,
        tuple(found.happened_once),
    )


def spread_read(content: Any, program: Program, where: str) -> Program | None:
    """Standard deviations of what a correction gives: of its inputs and of that."""
    if content is None:
        return None
    found = program_read(content, f"{where}.uncertainty")
    fits = found.width == program.width + program.output.size
    fits = fits and found.output.size == 4 * program.output.size and found.kind == "direct"
    _refuse(not fits, f"{where}.uncertainty: not of the program beside it")
    return found
