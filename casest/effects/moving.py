"""What a moving estimator may lack: the sensors' catalogue, and what only motion shows.

An effect acts on a signal: on an input it says what the sensor should have read, on an output what
the sensor reads instead of what the model predicts. All are null at zero. They apply to any
estimator that has the signal, a user's own included.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Any, Literal

import casadi as ca
import numpy as np

from casest.declaration.effect import Attached, Effect
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.symbols import Parameter, Signal
from casest.dynamics.declare import Dynamics, Measured, Motion, state
from casest.effects import CATALOGUE as SENSORS

Place = Literal["input", "output"]


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
    on: Place
    formula: str
    size: Callable[[int], int]
    unit: Callable[[str], str]
    typical: Callable[[float], float]
    changed: Callable[[SX, SX, Body], SX]
    shown_by: str
    vector: bool = False
    turning: bool = False
    in_time: bool = False
    reads_time: bool = False


@dataclass(frozen=True)
class Body:
    """What an effect may read beside its signal: its rate of change, the rate of turn, by how much
    the reading was moved in time (s) before the model saw it; and, by name, time, columns and other
    signals."""

    rate: SX | None = None
    turn: SX | None = None
    moved: SX | float = 0.0
    read: Mapping[str, SX] = field(default_factory=dict)


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

CLOCK_DRIFT = MotionEffect(
    "clock_drift", "output", "prediction, k·t earlier", lambda _: 1, lambda _: "1",
    lambda _: 1e-4, lambda y, k, body: y - k * body.read["t"] * body.rate,
    "the first and the last of several events that all sensors see", reads_time=True,
)  # fmt: skip

#: Where two explain the data alike, the one that comes first is the one that is met more often.
CATALOGUE = (
    BIAS, GAIN, LEVER_ARM, TIME_DELAY, MISALIGNMENT, OUTPUT_GAIN, OUTPUT_MISALIGNMENT, OUTPUT_BIAS,
    CLOCK_DRIFT,
)  # fmt: skip

#: Name of what belongs to the noise of a signal rather than to its mean.
COLOURED = "coloured_noise"
#: What is added to the name of an input for what it most likely was, without its noise.
CALM = " (calm)"
#: What an effect of a sensor may be searched over here.
SEARCHED: tuple[set[str], ...] = (set(), {"time"}, {"frequency"})
#: Rounds that find the true input from its reading: each leaves the square of what was wrong.
ROUNDS = 3
#: Samples at which it is looked at what an effect leaves of its signal.
SAMPLES = 500


def of_sensors() -> list[Effect]:
    """Effects of the sensors' catalogue that tell what a sensor reads instead of a quantity.

    Not those without a size of their own, which gain and misalignment are already; nor those that
    describe a course; nor those on a model's own quantities or on the sequence of samples.
    """
    # A threshold is tried from nothing on, and one of the input is no other: what is read is met.
    sensors = [replace(e, profile=()) if _threshold(e) else e for e in SENSORS]
    return [
        e
        for e in sensors
        if e.kind == "quantity"
        and e.on in ("input", "output")
        and (e.typical or e.columns)
        and not e.describes
        and {kind for _, kind in e.profile} in SEARCHED
        and len(e.profile) < 2
        and {s.name for s in e.extras} <= {"t", *(name for name, _ in e.columns)}
    ]


def _threshold(effect: Effect) -> bool:
    return {kind for _, kind in effect.profile} == {"threshold"}


def listed() -> list[tuple[str, str, str]]:
    """Name, what it is on and formula of everything that may be missing in motion."""
    found = [(e.name, f"an {e.on}", e.formula) for e in CATALOGUE]
    found += [(e.name, "any signal", e.formula) for e in of_sensors()]
    return [*found, (COLOURED, "any signal", "noise that is correlated in time, as a state")]


@dataclass(frozen=True)
class Numbers:
    """Numbers of an effect that come together: `typical` in practice, NaN where nobody knows."""

    name: str
    size: int
    unit: str
    typical: float


@dataclass(frozen=True)
class Candidate:
    """An effect on one signal of one estimator: its numbers and what it reads beside the signal.

    `attached`: an effect of the sensors' catalogue on that signal, which is an `input` or an
    `output`; `held`: what it is searched over, at a value; `trials`: among so many.
    """

    effect: MotionEffect | Effect
    on: str
    place: Place
    numbers: tuple[Numbers, ...]
    turn: str = ""
    reads: tuple[Signal, ...] = ()
    attached: Attached | None = field(default=None, compare=False)
    held: tuple[tuple[str, float], ...] = ()
    trials: float = 1.0

    @property
    def column(self) -> str | None:
        """The column or signal that it reads beside the time."""
        pairs = self.attached.columns if self.attached is not None else ()
        return pairs[0][1] if pairs else None

    @property
    def name(self) -> str:
        """With its column: `temperature_bias(temp)`."""
        return self.effect.name + (f"({self.column})" if self.column else "")

    @property
    def label(self) -> str:
        """`bias of omega`."""
        return f"{self.name} of {self.on}"

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return sum(n.size for n in self.numbers)

    @property
    def typical(self) -> Array:
        """Typical sizes (size,), NaN where nobody knows one."""
        return np.concatenate([np.full(n.size, n.typical) for n in self.numbers])

    @property
    def state(self) -> str:
        """Name of its numbers as a state: `omega_bias`."""
        return f"{self.on}_{self.name}"

    @property
    def moved(self) -> str:
        """Name of the column that says by how much readings were moved in time: `v_moved`."""
        return f"{self.on}_moved"

    @property
    def calm(self) -> str:
        """Name of the signal without its noise, as it most likely was: `a (calm)`."""
        return f"{self.on}{CALM}"

    @property
    def in_time(self) -> bool:
        """Is its one number how late the reading is?"""
        return isinstance(self.effect, MotionEffect) and self.effect.in_time

    def named(self, k: Any) -> dict[str, Any]:
        """Numbers k (size, …) by their names."""
        found, place = {}, 0
        for n in self.numbers:
            found[n.name] = k[place : place + n.size]
            place += n.size
        return found

    def changed(self, value: SX, k: SX, body: Body) -> SX:
        """On an output the reading for a prediction; on an input the true one for a reading."""
        if isinstance(self.effect, MotionEffect):
            return self.effect.changed(value, k, body)
        if self.place == "output":
            return self.sensed(value, k, body)
        # Newton's steps, axis by axis: without the slope they would lead astray where an effect is
        # as large as the signal, and a factor of two be taken for one of zero.
        quantity = ca.SX.sym("quantity", value.numel())
        read = self.sensed(quantity, k, body)
        step = (read - value) / ca.diag(ca.jacobian(read, quantity))
        true = value
        for _ in range(ROUNDS):
            true -= ca.substitute(step, quantity, true)
        return true

    def left_of(self, k: Array, signals: Mapping[str, Array]) -> float:
        """What share of its signal the effect leaves, of the axis that it takes most of.

        Of an input the slope of the true one in its reading, of an output that of the reading in
        its prediction; no more than that at nine tenths of the samples of `signals` (N, …).
        """
        values = {s.name: ca.SX.sym(s.name, s.size) for s in self.reads}
        value = values.setdefault(self.on, ca.SX.sym("value", signals[self.on].shape[1]))
        none, own = ca.SX.zeros(value.numel()), ca.SX(k)
        body = Body(rate=none, turn=none, read=values)
        changed = self.changed(value, own, body)
        slope = ca.diag(ca.jacobian(changed, value))
        if self.attached is not None and self.place == "input":
            # Far from the reading its steps do not find it: where they end, the sensor's own slope.
            read = ca.diag(ca.jacobian(self.sensed(value, own, body), value))
            slope = 1 / ca.substitute(read, value, changed)
        found = ca.Function("slope", [*values.values()], [ca.densify(slope)])
        every = slice(None, None, max(1, len(signals[self.on]) // SAMPLES))
        rows = found.map(len(signals[self.on][every]))(*(signals[n][every].T for n in values))
        return float(np.nanmin(np.nanquantile(np.abs(np.asarray(rows)), 0.9, axis=1)))

    def sensed(self, value: SX, k: SX, body: Body) -> SX:
        """What a sensor with an effect of the sensors' catalogue reads."""
        assert self.attached is not None
        own = {
            f"{self.attached.label}.{n}": v for n, v in {**self.named(k), **dict(self.held)}.items()
        }
        symbols = {**body.read, **{n: ca.SX(v) for n, v in own.items()}}
        return self.attached.apply(value, symbols)

    def free(self, names: Sequence[str]) -> tuple[Candidate, Array]:
        """With what it is held at unknown again, as far as it is named; and where those begin."""
        freed = [(n, v) for n, v in self.held if n in names]
        units = {p.name.rpartition(".")[2]: p.unit for p in self.parameters}
        more = tuple(Numbers(n, 1, units[n], np.nan) for n, _ in freed)
        left = tuple((n, v) for n, v in self.held if n not in names)
        found = replace(self, held=left, numbers=(*self.numbers, *more))
        return found, np.array([v for _, v in freed])

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Of an effect of the sensors' catalogue."""
        return self.attached.parameters if self.attached is not None else ()


@dataclass(frozen=True)
class Colour:
    """Noise of a signal that is correlated over `tau` seconds, as states of their own."""

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
    model: Dynamics,
    added: Sequence[tuple[Candidate, Array | SX | None]],
    colour: Colour | None = None,
) -> Dynamics:
    """The model with effects at given numbers, or symbols; with None, as constant states to
    estimate."""
    # Inputs are corrected before anything, outputs among them, reads them.
    for candidate, value in sorted(added, key=lambda pair: pair[0].place, reverse=True):
        model = _with(model, candidate, value)
    return model if colour is None else _coloured(model, colour)


def _with(model: Dynamics, candidate: Candidate, value: Array | SX | None) -> Dynamics:
    inner, name, there = model.function, candidate.state, {s.name for s in model.signals}
    more = [s for s in candidate.reads if s.name not in there]
    more += [Signal(candidate.moved, 1, "s")] if candidate.in_time else []
    if candidate.place == "input" and candidate.calm not in there:
        on = next(s for s in model.signals if s.name == candidate.on)
        more += [replace(on, name=candidate.calm)]
    own = {s.name for s in more}

    @wraps(inner)
    def function(**given: Any) -> Motion:
        k = given.pop(name) if value is None else ca.SX(value)
        moved = given[candidate.moved] if candidate.in_time else 0.0
        left = {n: v for n, v in given.items() if n not in own and n != candidate.calm}
        body = Body(turn=given.get(candidate.turn), moved=moved, read=given)
        if candidate.place == "input":
            # Of what the sensor met, not of its noise: with that the noise would be scaled too, and
            # what takes most of it away would foretell readings best.
            calm = given[candidate.calm]
            true = candidate.changed(calm, k, replace(body, read={**given, candidate.on: calm}))
            left[candidate.on] = given[candidate.on] + true - calm
            return inner(**left, **({} if candidate.calm in own else {candidate.calm: true}))
        return _reading(inner(**left), given, candidate, k, body)

    grown = replace(model, function=function, signals=(*model.signals, *more))
    grown = replace(grown, exact=model.exact | own)
    if value is not None:
        return grown
    # A constant is not driven: what is known of it at the beginning matters to no slope.
    constant = state(candidate.size, candidate.numbers[0].unit)
    return replace(grown, states=(*model.states, replace(constant, name=name)))


def _reading(
    motion: Motion, given: Mapping[str, SX], candidate: Candidate, k: SX, body: Body
) -> Motion:
    """The motion with another prediction of one output."""

    def changed(o: Measured) -> Measured:
        predicted = ca.SX(o.predicted)
        beside = replace(body, rate=_rate(o, motion, given))
        return replace(o, predicted=candidate.changed(predicted, k, beside))

    outputs = tuple(changed(o) if o.signal is given[candidate.on] else o for o in motion.outputs)
    return replace(motion, outputs=outputs)


def _rate(output: Measured, motion: Motion, given: Mapping[str, SX]) -> SX:
    """How fast a prediction changes, as far as the states' rates say."""
    moving = {name: rate for name, rate in motion.rates.items() if name in given}
    x = ca.vertcat(*[given[name] for name in moving])
    return ca.jacobian(output.predicted, x) @ ca.vertcat(*moving.values())


def _coloured(model: Dynamics, colour: Colour) -> Dynamics:
    inner, name = model.function, colour.state
    measured = colour.on in model.measured_signals

    @wraps(inner)
    def function(**given: Any) -> Motion:
        own = given.pop(name)
        if measured:
            motion = inner(**given)
            outputs = tuple(
                replace(o, predicted=o.predicted + own) if o.signal is given[colour.on] else o
                for o in motion.outputs
            )
            motion = replace(motion, outputs=outputs)
        else:
            motion = inner(**{**given, colour.on: given[colour.on] - own})
        return replace(motion, rates={**motion.rates, name: -own / colour.tau})

    own = state(colour.size, colour.unit, std=colour.std,
                intensity=2 * colour.std**2 / colour.tau)  # fmt: skip
    states = (*model.states, replace(own, name=name, of_data=True))
    return replace(model, function=function, states=states)
