"""Where an effect acts on these data: its quantity, columns as signals, numbers it is told."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.effect import Attached, Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Parameter, Signal
from casest.effects.lateness import likely_lag
from casest.errors import CasestError, UnitError
from casest.units import conversion, known, size

#: How a name says the unit of an angle: theta_rad.
_ENDING = re.compile(r"[_ ](rad|deg)$", re.IGNORECASE)

#: Why an effect on an input, or on the output, has no place, and the way out.
MISSING = {
    "input": "declares no corrected quantity: Residual(…, corrected=…) says on which it could act",
    "output": "names no prediction: predicted=quantity(…) gives it a name",
}

#: Why an effect that remembers is not looked at, and the way out.
UNTIMED = (
    "rows without a time are in no order: --rate 1 says that each was read after the one before"
)


def prepared(model: Model, runs: Sequence[Run]) -> tuple[Run, ...]:
    """Runs whose time and usable columns can be read like signals."""
    return with_columns(runs)


def with_columns(runs: Sequence[Run]) -> tuple[Run, ...]:
    """The same, whatever the model."""
    names = set.intersection(*[set(_usable(run)) for run in runs]) if runs else set()
    found = []
    for run in runs:
        more = {name: values for name, values in _usable(run).items() if name in names}
        units = {name: run.column_units.get(name, "s" if name == "t" else None) for name in more}
        found.append(replace(run, signals={**more, **run.signals}, units={**units, **run.units}))
    return tuple(found)


def _usable(run: Run) -> dict[str, Array]:
    """Numeric columns, and the time, as signals (N, 1)."""
    found = {} if run.time is None else {"t": np.asarray(run.time, float)[:, None]}
    for name, values in run.columns.items():
        if np.issubdtype(values.dtype, np.number):
            found[name] = np.asarray(values, float)[:, None]
    return found


def placed_in(effect: Effect, model: Model) -> Effect:
    """The effect on the model's own quantity instead of "input" or "output"."""
    corrected = model.traced.corrected
    predicted = next(
        (q.name for q in model.quantities.values() if model.traced.residual.predicted is q.value),
        None,
    )
    if effect.on == "input":
        place = corrected
    elif effect.on == "output":
        place = predicted or (corrected if model.implicit else None)
    else:
        place = effect.on
    if place is None:
        raise CasestError(f"model {model.name} {MISSING[effect.on]}")
    return replace(effect, on=place)


def told(model: Model, runs: Sequence[Run]) -> Model:
    """The model whose effects are told their numbers by these runs."""

    def numbered(attached: Attached) -> Attached:
        attached = _begun(attached, model, runs)
        own = with_numbers(attached.effect, attached.columns, runs, model)
        return attached if own is attached.effect else replace(attached, effect=own)

    return replace(model, effects=tuple(numbered(a) for a in model.effects))


def _begun(attached: Attached, model: Model, runs: Sequence[Run]) -> Attached:
    """Times of an effect begin where the records say: neither zero nor a guess is near."""
    if attached.kind == "time":
        start = _lag(model, runs, attached.on)
        own = {p.name.rpartition(".")[2] for p in attached.parameters if start}
        return _starting(attached, own, start)
    scales = {name for name, what in attached.effect.profile if what == "timescale"}
    times = [run.time for run in runs if run.time is not None and len(run) > 1]
    if not scales or not times:
        return attached
    step = min(float(np.median(np.diff(t))) for t in times)
    duration = max(float(np.ptp(t)) for t in times)
    # In the middle of what the record can tell apart, on a scale of ratios.
    return _starting(attached, scales, float(np.sqrt(step * duration)), (step, duration))


def _lag(model: Model, runs: Sequence[Run], name: str) -> float:
    """Of another file's signal, and a long one within a file; what is short a slope reaches."""
    rotation = any(s.name == name and s.kind == "rotation" for s in model.signals)
    measured = model.traced.measured or ""
    lag = likely_lag(runs, measured, name, within=True, rotation=rotation)
    steps = [float(np.median(np.diff(r.time))) for r in runs if r.time is not None and len(r) > 1]
    apart = any(name in run.elsewhere for run in runs)
    return lag if apart or abs(lag) > 2 * max(steps, default=np.inf) else 0.0


def _starting(
    attached: Attached,
    names: Collection[str],
    value: float,
    bounds: tuple[float, float] | None = None,
) -> Attached:
    """With scalar parameters that begin at a value, within bounds and their own."""

    def begun(p: Parameter) -> Parameter:
        if p.name.rpartition(".")[2] not in names:
            return p
        low, high = bounds or (-np.inf, np.inf)
        lower, upper = max(p.lower[0], low), min(p.upper[0], high)
        return replace(p, start=(float(f"{value:.6g}"),), lower=(lower,), upper=(upper,))

    return replace(attached, parameters=tuple(map(begun, attached.parameters)))


#: What is told of a column.
OF_COLUMN: dict[str, Callable[[Array], float]] = {
    "mean": lambda x: float(np.mean(x)),
    "least": lambda x: float(np.min(x)),
    "greatest": lambda x: float(np.max(x)),
}


def with_numbers(
    effect: Effect,
    columns: tuple[tuple[str, str], ...],
    runs: Sequence[Run],
    model: Model | None = None,
) -> Effect:
    """Numbers that come from the data: the channel's mean, range and unit, the record's duration,
    the middle of what it acts on.

    `model` tells the unit of a channel that is one of its quantities, and which are recorded.
    Raises UnitError where a channel should be an angle and is none.
    """
    values: dict[str, float] = {}
    for name, what in effect.numbers:
        if what in OF_COLUMN and columns:
            x = np.concatenate([run.signals[columns[0][1]][:, 0] for run in runs])
            values[name] = float(f"{OF_COLUMN[what](x):.6g}")
        if what == "radian" and columns:
            values[name] = _radian(columns[0][1], runs, model)
        if what == "middle":
            values[name] = _middle(effect.on, runs, model)
        if what == "duration":
            ends = [float(np.ptp(run.signals["t"])) for run in runs if "t" in run.signals]
            values[name] = float(f"{max(ends, default=1.0) or 1.0:.6g}")
    return effect.holding(**values) if values else effect


def _middle(name: str, runs: Sequence[Run], model: Model | None) -> float:
    """Mean of a scalar quantity that recorded signals alone make, where it is further from zero
    than it ranges; else zero."""
    quantity = None if model is None else model.quantities.get(name)
    if model is None or quantity is None or quantity.dims or model.traced.integrates:
        return 0.0
    scalars = [s.name for s in model.signals if s.size == 1 and s.name in runs[0].signals]
    symbols = [model.traced.symbols[n] for n in scalars]
    value = ca.Function("quantity", symbols, [quantity.declared], {"allow_free": True})
    if not scalars or value.has_free():
        return 0.0
    read = [[run.signals[n][:, 0] for n in scalars] for run in runs]
    x = np.concatenate([np.asarray(value(*(v[None] for v in values))).ravel() for values in read])
    x = x[np.isfinite(x)]
    mean = float(np.mean(x)) if len(x) else 0.0
    return float(f"{mean:.6g}") if len(x) and np.ptp(x) < abs(mean) else 0.0


def angles(model: Model, runs: Sequence[Run]) -> list[str]:
    """Recorded columns, scalar signals and quantities that are angles. `runs` are prepared.

    But for `angle`, which a model turns by: what goes with it is what the mounting declares, and
    axis_wobble.
    """
    recorded = [n for n in (runs[0].columns if runs else ()) if _angle(n, runs[0].units.get(n))]
    units = runs[0].units if runs else {}

    def turns(signal: Signal) -> bool:  # a body that takes any unit has that of the record
        both = (signal.unit, units.get(signal.name))
        return signal.size == 1 and any(_angle(signal.name, unit) for unit in both)

    own = [s.name for s in model.signals if turns(s)]
    inner = [n for n, q in model.quantities.items() if not q.dims and _angle(n, q.unit)]
    found = dict.fromkeys([*recorded, *own, *inner])
    return [n for n in found if n != "angle" or n not in model.quantities]


def _angle(name: str, unit: str | None) -> str:
    """The unit of an angle, which a name may end with (theta_rad); empty for what is none."""
    if not unit:
        ending = _ENDING.search(name)
        return ending[1].lower() if ending else ""
    return unit if known(unit) and size(unit)[1] == size("rad")[1] else ""


def _radian(column: str, runs: Sequence[Run], model: Model | None) -> float:
    """Radians for each unit of a column, signal or quantity."""
    inner = model.quantities if model is not None else {}
    given = {run.units.get(column) for run in runs if column in run.signals}
    given = given or {inner[column].unit if column in inner else None}
    units = {_angle(column, unit) for unit in given}
    if "" in units:
        other = next(unit for unit in given if not _angle(column, unit))
        has = f"is in {other}" if other else "has no unit"
        raise UnitError(f"{column} {has}, and an angle is in deg or rad: --unit {column}=deg")
    if len(units) > 1:
        both = " and in ".join(sorted(units))
        raise UnitError(f"{column} is in {both}: give all files in one of them")
    return conversion(units.pop(), "rad")[0]
