"""What could be missing in motion: every effect on every signal that it can act on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import casadi as ca
import numpy as np

from casest import units
from casest.data.run import Run
from casest.declaration.effect import Effect, attach
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.diagnose.candidates.candidates import WARM, channels
from casest.diagnose.candidates.repeated import signals_of
from casest.dynamics.declare import Dynamics
from casest.dynamics.inputs import estimated
from casest.effects.moving import (
    CALM,
    CATALOGUE,
    Body,
    Candidate,
    MotionEffect,
    Numbers,
    Place,
    of_sensors,
)
from casest.effects.placing import with_columns, with_numbers
from casest.errors import CasestError


def prepared(model: Dynamics, run: Run) -> Run:
    """The run with its time, from its first sample on, usable columns as signals, and inputs
    without their noise.

    Not a column that is called as a state is.
    """
    (found,) = with_columns([run])
    own = {s.name for s in model.signals}
    taken = {s.name for s in model.states}
    signals = {n: v for n, v in found.signals.items() if n in own or n not in taken}
    if "t" not in own and run.time is not None:
        signals["t"] = (np.asarray(run.time, float) - float(run.time[0]))[:, None]
    signals |= {f"{n}{CALM}": estimated(model, run, n) for n in _inputs(model)}
    return replace(found, signals=signals)


def _inputs(model: Dynamics) -> list[str]:
    return [s.name for s in model.signals if _place(model, s) == "input" and s.name != "t"]


def candidates(model: Dynamics, run: Run) -> list[Candidate]:
    """All that can be tried on a run that is `prepared`, what is met more often first."""
    found = list[Candidate]()
    for own in CATALOGUE:
        for s in model.signals:
            found += _of_motion(model, run, own, s)
    used = {s.name for s in model.signals} | {s.name for s in model.states} | {"t"}
    used |= {f"{n}{CALM}" for n in _inputs(model)}
    warm, _ = channels(used, [run], signals_of({s.name for s in model.signals}, (), [run]))
    for effect in of_sensors():
        for s in model.signals:
            found += _of_sensor(model, run, effect, s, warm)
    return found


def _place(model: Dynamics, s: Signal) -> Place | None:
    """Is a signal compared with an output, or does it drive a state?"""
    t = model.traced
    if s.kind == "rotation":
        return None
    if s.name in t.measured:
        return "output"
    return "input" if ca.depends_on(t.f, t.symbols[s.name]) else None


def _of_motion(model: Dynamics, run: Run, effect: MotionEffect, s: Signal) -> Iterator[Candidate]:
    """The effect on a signal, if it acts on such a one."""
    turn = next((o.name for o in model.signals if o.unit == "rad/s" and o.size == 3), "")
    if _place(model, s) != effect.on or (effect.vector and s.size != 3):
        return
    if effect.turning and not (turn and s.unit == "m/s"):
        return
    typical = effect.typical(_rms(run.signals[s.name]))
    own = Numbers("k", effect.size(s.size), effect.unit(s.unit or "1"), typical)
    reads = (_TIME,) if effect.reads_time else ()
    found = Candidate(effect, s.name, effect.on, (own,), turn if effect.turning else "", reads)
    if reads and "t" not in run.signals:
        return
    if effect.on == "output" or not _estimated(model, found):
        yield found


_TIME = Signal("t", 1, "s")


def _of_sensor(
    model: Dynamics, run: Run, effect: Effect, s: Signal, warm: Mapping[str, bool]
) -> Iterator[Candidate]:
    """An effect of the sensors' catalogue on a signal, for each column that it may read."""
    place = _place(model, s)
    if place is None or s.unit == "s":
        return
    for columns in _columns(model, effect, s, warm):
        try:
            found = _attached(model, run, with_numbers(effect, columns, [run]), s, place, columns)
        except CasestError:  # not on a signal of this size
            continue
        if all(r.name in run.signals for r in found.reads) and _does_something(model, found):
            yield found


def _columns(
    model: Dynamics, effect: Effect, on: Signal, warm: Mapping[str, bool]
) -> list[tuple[tuple[str, str], ...]]:
    if not effect.columns:
        return [()]
    ((argument, kind),) = effect.columns
    if kind != "acceleration":
        return [((argument, n),) for n, is_warm in warm.items() if is_warm in WARM.get(kind, ())]
    if on.name in model.measured_signals:  # of a speed or a place it would make no sense
        return []
    own = [s for s in model.signals if s.size == 3 and s.name not in model.measured_signals]
    return [((argument, s.name),) for s in own if s is not on and _accelerates(s.unit)]


def _accelerates(unit: str | None) -> bool:
    known = unit is not None and units.known(unit)
    return known and units.size(str(unit))[1] == units.size("m/s^2")[1]


def _attached(
    model: Dynamics,
    run: Run,
    effect: Effect,
    s: Signal,
    place: Place,
    columns: tuple[tuple[str, str], ...],
) -> Candidate:
    """Raises CasestError where the effect does not fit the signal."""
    of = {o.name: o.unit or f"[{o.name}]" for o in model.signals}
    of |= {name: run.units.get(name) or f"[{name}]" for _, name in columns}
    dims = (s.size,) if s.size > 1 else ()
    label = effect.name
    there = attach(effect, s.name, "quantity", dims, of, dict(columns), label)
    typical, searched = dict(effect.typical), dict(effect.profile)
    own = {p.name.rpartition(".")[2]: p for p in there.parameters}
    numbers = tuple(
        Numbers(n, p.shape.size, units_of(p.unit, of), typical.get(n, np.nan))
        for n, p in own.items()
        if n not in searched
    )
    held = tuple((n, 0.0) for n in searched)
    sizes = {o.name: o.size for o in model.signals}
    reads = tuple(replace(r, size=sizes.get(r.name, r.size)) for r in there.reads)
    return Candidate(effect, s.name, place, numbers, reads=reads, attached=there, held=held)


def units_of(unit: str, of: Mapping[str, str]) -> str:
    """With the units of what stands in brackets, where they are known: [force] is m/s^2."""
    for name, own in of.items():
        if "[" not in own:
            unit = unit.replace(f"[{name}]", f"({own})" if set("/*") & set(own) else own)
    return unit


def _does_something(model: Dynamics, candidate: Candidate) -> bool:
    """Does it need more than the value itself, which has no course over time of its own here?"""
    k = ca.SX.sym("k", candidate.size)
    symbols = {r.name: ca.SX.sym(r.name, r.size) for r in candidate.reads}
    value = ca.SX.sym("value", next(s.size for s in model.signals if s.name == candidate.on))
    try:
        changed = candidate.sensed(value, k, Body(read={**symbols, candidate.on: value}))
    except CasestError:
        return False
    slope = ca.jacobian(changed, k)
    return changed.shape == value.shape and bool(slope.nnz()) and not slope.is_zero()


def _estimated(model: Dynamics, candidate: Candidate) -> bool:
    """Are the effect's numbers on that input a state already: a constant that acts as they do?"""
    t, where = model.traced, model.slices()
    reading, k = t.symbols[candidate.on], ca.SX.sym("k", candidate.size)
    corrected = candidate.changed(reading, k, Body())
    moved = ca.substitute(ca.jacobian(corrected, k), k, 0)
    slope = ca.jacobian(t.f, reading) @ moved
    for s in model.states:
        own = where[s.name]
        if s.size != slope.size2() or not t.f[own].is_zero():
            continue
        pair = ca.horzcat(ca.vec(slope), ca.vec(t.A[:, own]))
        sample = ca.vertcat(t.x, *[ca.vec(symbol) for symbol in t.symbols.values()])
        point = np.random.default_rng(0).standard_normal(sample.numel())
        found = ca.Function("pair", [sample], [ca.densify(pair)])(point).full().T
        if np.allclose(found[0], found[1]):
            return True
    return False


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2))) or 1.0
