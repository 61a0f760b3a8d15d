"""What a moving estimator may lack, each a few lines of physics: the catalogue of motion.

An effect acts on a signal: on an input it says what the sensor should have read, on an output what
the sensor reads instead of what the model predicts. All are null at zero. They apply to any
estimator that has the signal, a user's own included.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, Literal

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.dynamics.declare import Dynamics, Measured, Motion, state


@dataclass(frozen=True)
class MotionEffect:
    """One effect: what it does to a signal.

    `changed(value, k, body)`: on an input the reading and on an output the prediction, with the
    effect's numbers k; `body` gives the derivative of a prediction and the turn rate. `size` and
    `unit` depend on the signal's; `typical` is of the size found in practice. `vector`: for three
    components; `turning`: for a speed of a body whose rate of turn is measured; `in_time`: its one
    number is how late the reading is (s), so that readings can be moved by whole samples first.
    """

    name: str
    on: Literal["input", "output"]
    formula: str
    size: Callable[[int], int]
    unit: Callable[[str], str]
    typical: Callable[[float], float]
    changed: Callable[[SX, SX, Body], SX]
    shown_by: str
    vector: bool = False
    turning: bool = False
    in_time: bool = False

    def state_of(self, signal: str) -> str:
        """Name of its numbers on that signal, as a state: `omega_bias`."""
        return f"{signal}_{self.name}"


@dataclass(frozen=True)
class Body:
    """What an effect may read beside its signal: its rate of change, the rate of turn, and by how
    much the reading was moved in time (s) before the model saw it."""

    rate: SX | None = None
    turn: SX | None = None
    moved: SX | float = 0.0


def _same(n: int) -> int:
    return n


def _cross(a: SX, b: SX) -> SX:
    return ca.cross(a, b)


BIAS = MotionEffect(
    "bias", "input", "reading − k", _same, lambda u: u, lambda rms: 0.02 * rms,
    lambda y, k, _: y - k, "the sensor at rest, turned to several sides",
)  # fmt: skip
GAIN = MotionEffect(
    "gain", "input", "reading / (1 + k)", _same, lambda u: "1", lambda _: 0.01,
    lambda y, k, _: y / (1 + k), "a known input of another size",
)  # fmt: skip
MISALIGNMENT = MotionEffect(
    "misalignment", "input", "reading − k × reading", _same, lambda u: "rad", lambda _: 0.01,
    lambda y, k, _: y - _cross(k, y), "the angles between the sensors' axes", vector=True,
)  # fmt: skip
OUTPUT_BIAS = MotionEffect(
    "bias", "output", "prediction + k", _same, lambda u: u, lambda rms: 0.02 * rms,
    lambda y, k, _: y + k, "the sensor at rest",
)  # fmt: skip
OUTPUT_GAIN = MotionEffect(
    "gain", "output", "(1 + k)·prediction", _same, lambda u: "1", lambda _: 0.01,
    lambda y, k, _: (1 + k) * y, "a known length or speed",
)  # fmt: skip
OUTPUT_MISALIGNMENT = MotionEffect(
    "misalignment", "output", "prediction + k × prediction", _same, lambda u: "rad",
    lambda _: 0.01, lambda y, k, _: y + _cross(k, y), "the angles between the sensors' axes",
    vector=True,
)  # fmt: skip
TIME_DELAY = MotionEffect(
    "time_delay", "output", "prediction, k earlier", lambda _: 1, lambda u: "s",
    # Whole samples are moved (delays.py); over the rest of less than one the rate is constant.
    lambda _: 0.01, lambda y, k, body: y - (k - body.moved) * body.rate,
    "an event that all sensors see", in_time=True,
)  # fmt: skip
LEVER_ARM = MotionEffect(
    "lever_arm", "output", "prediction + omega × k", _same, lambda _: "m",
    lambda _: 0.05, lambda y, k, body: y + _cross(body.turn, k),
    "the place of the sensor in the body, by a ruler", vector=True, turning=True,
)  # fmt: skip

#: Where two explain the data alike, the one that comes first is the one that is met more often.
CATALOGUE = (
    BIAS, GAIN, LEVER_ARM, TIME_DELAY, MISALIGNMENT, OUTPUT_GAIN, OUTPUT_MISALIGNMENT, OUTPUT_BIAS,
)  # fmt: skip

#: Name of what belongs to the noise of an output rather than to its mean.
COLOURED = "coloured_noise"


def listed() -> list[tuple[str, str, str]]:
    """Name, what it is on and formula of everything that may be missing in motion."""
    found = [(e.name, f"an {e.on}", e.formula) for e in CATALOGUE]
    return [*found, (COLOURED, "an output", "noise that is correlated in time, as a state")]


@dataclass(frozen=True)
class Candidate:
    """An effect on one signal of one estimator: its numbers' count, unit and typical size."""

    effect: MotionEffect
    on: str
    size: int
    unit: str
    typical: float
    turn: str = ""

    @property
    def label(self) -> str:
        """`bias of omega`."""
        return f"{self.effect.name} of {self.on}"

    @property
    def state(self) -> str:
        """Name of its numbers as a state: `omega_bias`."""
        return self.effect.state_of(self.on)

    @property
    def moved(self) -> str:
        """Name of the column that says by how much readings were moved in time: `v_moved`."""
        return f"{self.on}_moved"


def candidates(model: Dynamics, run: Run) -> list[Candidate]:
    """Every effect of the catalogue on every signal that it can act on."""
    t = model.traced
    turn = next((s.name for s in model.signals if s.unit == "rad/s" and s.size == 3), "")
    found = []
    for effect in CATALOGUE:
        for s in model.signals:
            outputs = s.name in t.measured
            used = ca.depends_on(t.f, t.symbols[s.name])
            if (effect.on == "output") != outputs or (effect.on == "input" and not used):
                continue
            if (effect.vector and s.size != 3) or s.kind == "rotation":
                continue
            if effect.turning and not (turn and s.unit == "m/s"):
                continue
            if effect.on == "input" and _estimated(model, effect, s):
                continue
            unit, size = effect.unit(s.unit or "1"), effect.size(s.size)
            typical = effect.typical(_rms(run.signals[s.name]))
            found.append(
                Candidate(effect, s.name, size, unit, typical, turn if effect.turning else "")
            )
    return found


def _estimated(model: Dynamics, effect: MotionEffect, signal: Signal) -> bool:
    """Are the effect's numbers on that input a state already: a constant that acts as they do?"""
    t, where = model.traced, model.slices()
    reading, k = t.symbols[signal.name], ca.SX.sym("k", effect.size(signal.size))
    moved = ca.substitute(ca.jacobian(effect.changed(reading, k, Body()), k), k, 0)
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


@dataclass(frozen=True)
class Colour:
    """Noise of an output that is correlated over `tau` seconds, as states of their own."""

    on: str
    size: int
    unit: str
    tau: float
    std: float

    @property
    def label(self) -> str:
        """`coloured_noise of v`."""
        return f"{COLOURED} of {self.on}"

    @property
    def state(self) -> str:
        """Name of its states."""
        return f"{self.on}_colour"


def extended(
    model: Dynamics, added: Sequence[tuple[Candidate, Array | None]], colour: Colour | None = None
) -> Dynamics:
    """The model with effects at given numbers; with None, as constant states to estimate."""
    # Inputs are corrected before anything, outputs among them, reads them.
    for candidate, value in sorted(added, key=lambda pair: pair[0].effect.on, reverse=True):
        model = _with(model, candidate, value)
    return model if colour is None else _coloured(model, colour)


def _with(model: Dynamics, candidate: Candidate, value: Array | None) -> Dynamics:
    inner, effect, name = model.function, candidate.effect, candidate.state

    @wraps(inner)
    def function(**given: Any) -> Motion:
        k = given.pop(name) if value is None else ca.SX(ca.DM(value))
        moved = given.pop(candidate.moved) if effect.in_time else 0.0
        if effect.on == "input":
            corrected = effect.changed(given[candidate.on], k, Body())
            return inner(**{**given, candidate.on: corrected})
        motion = inner(**given)
        return _reading(motion, given, candidate, k, moved)

    grown = replace(model, function=function)
    if effect.in_time:
        grown = replace(grown, signals=(*model.signals, Signal(candidate.moved, 1, "s")))
    if value is not None:
        return grown
    own = state(candidate.size, candidate.unit, std=candidate.typical)
    return replace(grown, states=(*model.states, replace(own, name=name)))


def _reading(
    motion: Motion, given: Mapping[str, SX], candidate: Candidate, k: SX, moved: SX | float
) -> Motion:
    """The motion with another prediction of one output."""
    turn = given.get(candidate.turn)
    outputs = tuple(
        replace(o, predicted=candidate.effect.changed(
            o.predicted, k, Body(_rate(o, motion, given), turn, moved)))
        if o.signal is given[candidate.on] else o
        for o in motion.outputs
    )  # fmt: skip
    return replace(motion, outputs=outputs)


def _rate(output: Measured, motion: Motion, given: Mapping[str, SX]) -> SX:
    """How fast a prediction changes, as far as the states' rates say."""
    moving = {name: rate for name, rate in motion.rates.items() if name in given}
    x = ca.vertcat(*[given[name] for name in moving])
    return ca.jacobian(output.predicted, x) @ ca.vertcat(*moving.values())


def _coloured(model: Dynamics, colour: Colour) -> Dynamics:
    inner, name = model.function, colour.state

    @wraps(inner)
    def function(**given: Any) -> Motion:
        own = given.pop(name)
        motion = inner(**given)
        outputs = tuple(
            replace(o, predicted=o.predicted + own) if o.signal is given[colour.on] else o
            for o in motion.outputs
        )
        return replace(motion, rates={**motion.rates, name: -own / colour.tau}, outputs=outputs)

    own = state(colour.size, colour.unit, std=colour.std,
                intensity=2 * colour.std**2 / colour.tau)  # fmt: skip
    states = (*model.states, replace(own, name=name, of_data=True))
    return replace(model, function=function, states=states)
