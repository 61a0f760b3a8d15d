"""A model at an instant, or with constant coefficients, as python-control knows it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.errors import UsageError

if TYPE_CHECKING:
    from control import StateSpace


def matrices(
    model: Dynamics, *, state: Any = None, run: Run | None = None, time: float = 0.0, **signals: Any
) -> tuple[Array, Array, Array, Array, tuple[str, ...]]:
    """A (n, n), B (n, k), C (m, n), D (m, k) at an instant, and the names of the k inputs.

    Signals that the coefficients depend on are given by name, in the model's units, or taken from
    a record at `time` (a straight line between samples); `state` (n,) matters for a nonlinear
    model only, and is its start unless given. Inputs are the signals that drive the rates or enter
    the outputs; in a linear model those in A or C are coefficients instead. For a nonlinear model
    the matrices hold for small deviations. Raises UsageError where a value is missing.
    """
    t = model.traced
    names = tuple(s.name for s in model.signals)
    unknown = sorted(set(signals) - set(names))
    if unknown:
        raise UsageError(f"{model.name} has no signal {unknown[0]!r}; it has {', '.join(names)}")
    slopes, used = ca.vertcat(ca.vec(t.A), ca.vec(t.C)), ca.vertcat(t.f, t.h)
    inputs = [
        n
        for n in names
        if ca.depends_on(used, flat(t.symbols[n]))
        and not (model.linear and ca.depends_on(slopes, flat(t.symbols[n])))
    ]
    u = ca.vertcat(*[flat(t.symbols[n]) for n in inputs]) if inputs else ca.SX(0, 1)
    outputs = [t.A, ca.jacobian(t.f, u), t.C, ca.jacobian(t.h, u)]
    every = ca.vertcat(*[ca.vec(e) for e in outputs])
    values = {n: _value(model, n, signals, run, time) for n in names}
    for name, value in values.items():
        needed = ca.depends_on(every, flat(t.symbols[name]))
        if needed and not np.all(np.isfinite(value)):
            raise UsageError(
                f"{model.name}: the coefficients depend on {name}: give its value, {name}=…, or a "
                "record that holds it at that time"
            )
    x = model.start if state is None else np.asarray(state, float).ravel()
    if x.shape != (model.size,):
        raise UsageError(f"{model.name}: state has {x.size} numbers, the model {model.size}")
    arguments = [t.x, *[flat(t.symbols[n]) for n in names]]
    function = ca.Function("at", arguments, [ca.densify(e) for e in outputs])
    found = function(x, *[np.nan_to_num(v) for v in values.values()])
    A, B, C, D = (
        np.asarray(M, float).reshape(e.shape) for M, e in zip(found, outputs, strict=True)
    )
    labels = [_labels(n, t.symbols[n].numel()) for n in inputs]
    return A, B, C, D, tuple(label for own in labels for label in own)


def to_statespace(
    model: Dynamics, *, state: Any = None, run: Run | None = None, time: float = 0.0, **signals: Any
) -> StateSpace:
    """The same as a `control.StateSpace`, states, inputs and outputs under their names.

    Raises UsageError where python-control is not installed, or a value is missing.
    """
    try:
        import control
    except ImportError:
        raise UsageError(
            "to_statespace needs python-control: pip install 'casest[control]'"
        ) from None
    A, B, C, D, inputs = matrices(model, state=state, run=run, time=time, **signals)
    outputs = [
        label for name in model.measured_signals for label in _labels(name, _size(model, name))
    ]
    if not inputs:  # python-control knows no system without one
        B, D, inputs = np.zeros((model.size, 1)), np.zeros((len(C), 1)), ("none",)
    names = {"states": list(model.names), "inputs": list(inputs), "outputs": outputs}
    return control.ss(A, B, C, D, **names)


def _value(
    model: Dynamics, name: str, given: Mapping[str, Any], run: Run | None, time: float
) -> Array:
    size = _size(model, name)
    if name in given:
        value = np.asarray(given[name], float).ravel()
        if value.size != size:
            raise UsageError(f"{model.name}: {name} has {size} numbers, not {value.size}")
        return value
    if run is None or run.time is None or name not in run.signals:
        return np.full(size, np.nan)
    if not run.time[0] <= time <= run.time[-1]:
        raise UsageError(
            f"{run.file or run.name} lasts from {run.time[0]:g} to {run.time[-1]:g} s; there is no "
            f"instant {time:g} s"
        )
    return np.array([np.interp(time, run.time, column) for column in run.signals[name].T])


def _size(model: Dynamics, name: str) -> int:
    return int(model.traced.symbols[name].numel())


def _labels(name: str, size: int) -> tuple[str, ...]:
    return (name,) if size == 1 else tuple(f"{name}[{k}]" for k in range(size))
