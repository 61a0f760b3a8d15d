"""Whole runs: a motion with settings of its own, whose own unknowns are fitted along with it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any, Protocol

import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Parameter
from casest.errors import UsageError
from casest.leastsquares.problem import Problem
from casest.plan.candidates.attitudes import about
from casest.plan.candidates.candidates import (
    Candidates,
    Noise,
    factors_of,
    predicted,
    whitened,
)
from casest.plan.candidates.varied import combined

#: Values of an angle that are tried between its bounds; quarter turns of a mounting.
BETWEEN = 5
#: Cosine of the middle Euler angle below which the three are no coordinates.
STEEP = 0.1
#: Samples of a run that are looked at: its information grows as the rest does.
THINNED = 2000
#: Settings of a run that are no symbol of the model.
DURATION = "duration"


class Rivalled(Protocol):
    """A model and its values."""

    @property
    def model(self) -> Model:
        """The model."""

    @property
    def values(self) -> Mapping[str, Array]:
        """Values of its unknowns."""


def runs(
    model: Model,
    values: Mapping[str, Any],
    noise: Noise,
    varied: Mapping[str, Array],
    *,
    duration: float,
    rate: float,
) -> Candidates:
    """Runs with other values of the unknowns that each run has for itself, and of the duration."""
    own = {p.name: p for p in model.parameters if p.scope == "run"}
    wrong = [n for n in varied if n not in own and n != DURATION]
    if wrong:
        raise UsageError(
            f"--vary {wrong[0]}=…: a run of {model.name} can vary {', '.join([*own, DURATION])}"
        )
    choices = {name: rows for name, rows in varied.items()}
    said: dict[str, list[str]] = {}
    for name, p in own.items():
        if name not in choices and not varied:
            usual = _usual(p, np.asarray(values.get(name, p.shape.unpack(p.start_value()))))
            if usual is not None:
                choices[name], said[name] = usual
    every = combined({n: np.arange(float(len(rows)))[:, None] for n, rows in choices.items()})
    count = len(next(iter(every.values()))) if every else 1
    factors, words, cost, taken = [], [], [], []
    for i in range(count):
        here = {n: choices[n][int(every[n][i, 0])] for n in choices}
        told = [
            said[n][int(every[n][i, 0])] if n in said else _told(model, n, here[n]) for n in choices
        ]
        long = float(here.pop(DURATION, np.array([duration]))[0])
        at = {**values, **{n: own[n].shape.unpack(row) for n, row in here.items()}}
        factors.append(_shared(model, at, noise, long, rate))
        words.append("; ".join(told) or f"{long:g} s")
        cost.append(long if DURATION in choices else 1.0)
        taken.append({**here, DURATION: np.array([long])})
    shared = [n for n in Problem(model, (_run(model, values, 1.0, 2.0),)).names]
    size = factors[0].shape[1]
    rows = {n: np.array([t[n] for t in taken]) for n in taken[0]}
    return Candidates(
        "run", np.array(factors), tuple(shared[:size]), tuple(words), np.array(cost), {}, rows
    )


def _usual(p: Parameter, value: Array) -> tuple[Array, list[str]] | None:
    """What a person can change: an angle between its bounds, a mounting by quarter turns."""
    if p.shape.dims == () and np.isfinite([*p.lower, *p.upper]).all():
        at = np.linspace(p.lower[0], p.upper[0], BETWEEN + 2)[1:-1]
        return at[:, None], [f"{p.name} {_angle(x, p.unit)}" for x in at]
    if p.shape.dims == (3,) and p.unit == "rad":
        return _mountings(p.name, value)
    return None


def _angle(x: float, unit: str) -> str:
    return f"{np.degrees(x):.0f}°" if unit == "rad" else f"{x:.3g} {unit}"


def _mountings(name: str, angles: Array) -> tuple[Array, list[str]]:
    """The mounting that there is, turned about the sensor's own axes by quarter turns."""
    R, found, said = _rotation(angles), [], []
    for turn, words in _turns():
        a = _angles(turn @ R)
        if np.cos(a[1]) > STEEP:
            found.append(a)
            said.append(words)
    return np.array(found), said


def _turns() -> Iterator[tuple[Array, str]]:
    """The 24 rotations of a cube: one face after the other, and turned on it."""
    seen: list[Array] = []
    axes = [(None, 0), *((k, q) for k in range(3) for q in (1, -1, 2))]
    for (a, p), (b, q) in product(axes, axes):
        turn = np.eye(3)
        said = []
        for k, quarters in ((a, p), (b, q)):
            if k is not None:
                turn = about(k, quarters * np.pi / 2).T @ turn
                said.append(f"{90 * quarters}° about {'xyz'[k]}".replace("-", "−"))
        if (a is None and b is not None) or any(np.allclose(turn, other) for other in seen):
            continue
        seen.append(turn)
        yield turn, "mounting turned " + ", then ".join(said) if said else "mounting as it is"


def _rotation(angles: Array) -> Array:
    """Rx·Ry·Rz, as `casest.rotation`."""
    x, y, z = (about(k, float(a)) for k, a in enumerate(angles))
    return np.asarray(x @ y @ z)


def _angles(R: Array) -> Array:
    """The angles of Rx·Ry·Rz."""
    return np.array(
        [
            np.arctan2(-R[1, 2], R[2, 2]),
            np.arcsin(np.clip(R[0, 2], -1, 1)),
            np.arctan2(-R[0, 1], R[0, 0]),
        ]
    )


def _told(model: Model, name: str, row: Array) -> str:
    unit = "s" if name == DURATION else model[name].units[0]
    number = ", ".join(f"{x:.4g}" for x in row)
    return f"{name} {number} {unit}".removesuffix(" 1")


def _run(model: Model, values: Mapping[str, Any], duration: float, rate: float) -> Run:
    t = np.arange(0.0, duration, 1 / rate)
    signals = {s.name: np.zeros((len(t), s.size)) for s in model.signals} | {"t": t[:, None]}
    units = {s.name: s.unit for s in model.signals}
    return predicted(model, values, Run.raw("planned", signals, units=units, time=t))


def _shared(
    model: Model, values: Mapping[str, Any], noise: Noise, duration: float, rate: float
) -> Array:
    """Factor (n, n) of what a run says of the unknowns that all runs share.

    Its own unknowns are fitted along: the triangular factor of [own, shared], lower right.
    """
    count = duration * rate
    every = max(1.0, count / THINNED)
    run = _run(model, values, duration, rate / every)
    slopes = factors_of(model, values, run, noise) * np.sqrt(every)
    rows = slopes.reshape(-1, slopes.shape[2])
    shared = sum(p.shape.coordinates for p in model.parameters if p.scope == "all")
    turned = np.hstack([rows[:, shared:], rows[:, :shared]])
    return np.asarray(_lower(turned, rows.shape[1] - shared))


def off_by(
    truth: Rivalled, other: Rivalled, noise: Noise, settings: Mapping[str, Array], rate: float
) -> Array:
    """Factor (n + 1, n + 1) of a run as the truth has it, seen by another model.

    Its columns: the unknowns that all runs share of the other model, and by how much that is off.
    """
    own = {n: row for n, row in settings.items() if n != DURATION}
    duration = float(settings[DURATION][0])
    every = max(1.0, duration * rate / THINNED)
    shaped = {n: truth.model[n].shape.unpack(row) for n, row in own.items()}
    run = _run(truth.model, {**truth.values, **shaped}, duration, rate / every)
    mine = {p.name for p in truth.model.parameters if p.scope == "run"}
    same = {n: v for n, v in {**truth.values, **shaped}.items() if n in mine}
    off, slopes = whitened(other.model, {**other.values, **same}, run, noise)
    both = np.concatenate([slopes, off[:, :, None]], axis=2) * np.sqrt(every)
    rows = both.reshape(-1, both.shape[2])
    shared = sum(p.shape.coordinates for p in other.model.parameters if p.scope == "all")
    last = rows.shape[1] - 1
    turned = np.hstack([rows[:, shared:last], rows[:, :shared], rows[:, last:]])
    return _lower(turned, last - shared)


def _lower(columns: Array, first: int) -> Array:
    """What the columns after the `first` say beside those: triangular."""
    norms = np.linalg.norm(columns, axis=0)
    R = np.linalg.qr(columns / np.where(norms > 0, norms, 1.0), mode="r") * norms
    return np.asarray(R[first:, first:])
