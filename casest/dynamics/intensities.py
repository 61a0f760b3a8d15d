"""Noise intensities of an estimator in motion: declared, from stated noise, or from the data.

The noise of an input drives the states that it reaches; that is then all that drives them. Other
states keep an intensity of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.tracing import flat
from casest.dynamics import Dynamics, filtered
from casest.dynamics.allan import Allan, allan
from casest.dynamics.likelihood import STEP, applied, matched, prepared, reached, whitened
from casest.dynamics.transition import usual
from casest.errors import DataError, UsageError

#: Rounds of maximum likelihood: the states along which noise acts move a little with it.
ROUNDS = 2


@dataclass(frozen=True)
class Tuned:
    """A model with intensities that match its sensors.

    `how` in words; `spread` one standard deviation of an intensity, as a share of it, where the
    data themselves gave it.
    """

    model: Dynamics
    how: str
    spread: Mapping[str, float] = field(default_factory=dict)


def from_stated(model: Dynamics, run: Run, stds: Mapping[str, float]) -> Tuned:
    """From standard deviations of single readings, in the signals' units: σ²/rate.

    The rate is the record's, also of a signal that is read less often: the filter takes a reading's
    variance to be intensity × rate. Signals with clocks of their own have rates of their own.
    Raises UsageError for a name that is no signal.
    """
    known = {s.name for s in model.signals}
    for name, std in stds.items():
        if name not in known:
            raise UsageError(
                f"{model.name} has no signal {name!r}; it has {', '.join(sorted(known))}"
            )
        if not 0 < std < np.inf:
            raise UsageError(f"{name}: the noise {std:g} must be positive: one standard deviation")
    said = {name: std**2 * period(run, name) for name, std in stds.items()}
    return Tuned(_driven_by(model, said), "from the sensors' stated noise")


def with_stated(model: Dynamics, run: Run, stds: Mapping[str, float]) -> Dynamics:
    """The model with those noises of its sensors, or as it is where none is stated."""
    return from_stated(model, run, stds).model if stds else model


def period(run: Run, name: str | None = None) -> float:
    """Time between two samples, of a signal where it has a clock of its own, s: the mean of the
    steps that are no gaps."""
    if run.time is None or len(run) < 2:
        raise DataError(f"{run.file or run.name}: no rate: it needs a time column, or --rate")
    own = run.time if name is None else run.clock(name)
    return usual(np.diff(own)) if len(own) > 1 else float(np.ptp(run.time))


def from_rest(model: Dynamics, rest: Run) -> tuple[Tuned, dict[str, Allan]]:
    """From a record at rest by its Allan deviation: N² for signals, K² for a bias in their unit."""
    found: dict[str, Allan] = {}
    for s in model.signals:
        if s.name in rest.signals and s.kind != "rotation" and s.name != "t":
            found[s.name] = allan(rest.signals[s.name], 1 / period(rest))
    white = {name: float(np.mean(a.white**2)) for name, a in found.items()}
    tuned = _driven_by(model, {name: value for name, value in white.items() if value > 0})
    drifts = {}
    for state in model.states:
        same = [
            n for n in found if _unit(model, n) == state.unit and n not in model.measured_signals
        ]
        if same and state.name in reached(model)[1]:
            drifts[state.name] = float(np.mean(found[same[0]].walk ** 2))
    return Tuned(tuned.driven(**drifts), "from a record at rest (Allan deviation)"), found


def most_likely(model: Dynamics, run: Run) -> Tuned:
    """By maximum likelihood of the innovations of this record."""
    start = None
    for _ in range(ROUNDS):
        ready = prepared(model, run, filtered(model, run).smoothed)
        start, _ = matched(ready, run, start, exactly=True)
        model = applied(model, start)
    assert start is not None
    names, logs = ready.names, np.log([start[n] for n in ready.names])
    counted = ready.present
    e, s = (part[counted] for part in whitened(ready, start))
    slopes = []
    for unit in np.eye(len(names)):
        moved = dict(zip(names, np.exp(logs + STEP * unit).tolist(), strict=True))
        e1, s1 = (part[counted] for part in whitened(ready, moved))
        slopes.append(np.concatenate([(e1 - e) / np.sqrt(s), (s1 - s) / s / np.sqrt(2)]) / STEP)
    information = np.array(slopes) @ np.array(slopes).T
    spread = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
    # Of what this record does not tell, no spread is known.
    spread = np.where(np.diag(information) < 0.1, np.inf, spread)
    shares = dict(zip(names, spread.tolist(), strict=True))
    return Tuned(model, "most likely for this record's innovations", shares)


def told(found: Mapping[str, Allan]) -> dict[str, Any]:
    """What a record at rest said, for `filter.json`: per signal, each noise of every axis."""
    return {
        name: {
            "white": a.white.tolist(),
            "instability": a.instability.tolist(),
            "walk": a.walk.tolist(),
            "tau_s": a.taus.tolist(),
            "deviation": a.deviations.tolist(),
        }
        for name, a in found.items()
    }


def intensities(model: Dynamics, run: Run | None = None) -> dict[str, float]:
    """Of every state (unit²/s) and signal (unit²·s) that has one, read as in a record."""
    found = {s.name: s.intensity for s in model.states if s.intensity}
    for name in model.measured_signals:
        found[name] = model.intensity_of(name, None if run is None else period(run, name))
    return found | dict(model.sensors)


def units(model: Dynamics) -> dict[str, str]:
    """Unit of each intensity, as a person reads it."""
    found = {s.name: f"({s.unit})^2/s" for s in model.states}
    return found | {s.name: f"({s.unit or 1})^2 s" for s in model.signals}


def _driven_by(model: Dynamics, said: Mapping[str, float]) -> Dynamics:
    """With these intensities of signals; states that they reach are driven by them alone."""
    slices, quiet = model.slices(), {}
    for name in said:
        slope = ca.jacobian(model.traced.f, flat(model.traced.symbols[name]))
        rows = set(slope.sparsity().get_triplet()[0])
        for state, where in slices.items():
            if rows & set(range(where.start, where.stop)):
                quiet[state] = 0.0
    return model.driven(**quiet).sensing(**said)


def _unit(model: Dynamics, name: str) -> str:
    return next(s.unit or "1" for s in model.signals if s.name == name)
