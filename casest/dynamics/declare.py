"""Moving estimators, declared like sensors: states, rates, what is measured, noise intensities."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casest import units
from casest.declaration.changing import check_units_known
from casest.declaration.model import Model
from casest.declaration.physics import SX
from casest.declaration.physics import Constraint as Constraint
from casest.declaration.physics import constraint as constraint
from casest.declaration.shapes import Array, array_shape
from casest.declaration.symbols import Constant, Parameter, Signal, constant, make_parameter
from casest.declaration.tracing import flat
from casest.dynamics.equations import calibration
from casest.errors import CasestError, DeclarationError, UsageError, last_line


@dataclass(frozen=True)
class State:
    """A state: `size` numbers in `unit`; `intensity` of the white noise that drives it, unit²/s.

    `start` and `std` describe what is known of it at the beginning. `of_data`: the intensity was
    taken from the record at hand, so that a search for the most likely one begins there. `known`:
    it begins exactly at `start`; `stated`: the declaration says its std. `of`: it is an unknown
    constant of the equations, declared with `param(…)`, that a filter follows as a state. `lower`
    and `upper`: what each number never leaves.
    """

    name: str
    size: int
    unit: str
    intensity: float
    start: tuple[float, ...]
    std: float
    of_data: bool = False
    known: bool = False
    stated: bool = False
    of: Parameter | None = None
    lower: tuple[float, ...] = ()
    upper: tuple[float, ...] = ()

    @property
    def beginning(self) -> str:
        """Name of the unknown or constant that it begins with, in a calibration."""
        return f"{self.name}_start"


#: Standard deviation at the beginning of a state of which nothing is said, in its own unit; of one
#: that is known exactly, for its size.
UNSTATED, EXACT = 1.0, 1e-9


def state(
    shape: int | str = 1,
    unit: str = "1",
    *,
    intensity: float = 0.0,
    start: Any = 0.0,
    std: float | None = None,
    known: bool = False,
    bounds: tuple[Any, Any] | None = None,
) -> Any:
    """Declare a state: `state(3, "m/s", intensity=1e-3)`, `state("rad")`.

    `intensity` is that of its white driving noise in unit²/s (0: driven by nothing), `start` and
    `std` what is known of it at the beginning, in its own unit: in a filter 1 where nothing is
    said, in a calibration nothing, so that it is an unknown of each run whose search begins at
    `start`; with `std` that much is known of it there too, and weighed against the readings.
    `known`: it begins exactly there, at t = 0 where the record begins later. `bounds`: (lower,
    upper), numbers or one for each, None for no end, within which it stays at every time; a filter
    keeps them over a horizon (`moving_horizon`).
    """
    if isinstance(shape, str):
        size, unit = 1, shape
    else:
        size = shape
    try:
        values = np.broadcast_to(np.asarray(start, float), (size,))
    except ValueError:
        count = np.size(start)
        raise DeclarationError(
            f"state: start={start!r} has {count} numbers, the state {size}: give one for each"
        ) from None
    if not np.all(np.isfinite(values)):
        raise DeclarationError(f"state: start={start!r} is not finite")
    if known and std is not None:
        raise DeclarationError(
            f"state: known=True says that it begins exactly at its start, and std={std:g} that it "
            "does not: give one of them"
        )
    exact = EXACT * max(1.0, float(np.max(np.abs(values), initial=0.0)))
    spread = std if std is not None else exact if known else UNSTATED
    for what, number in (("intensity", intensity), ("std", spread)):
        wrong = _wrong(what, number)
        if wrong:
            raise DeclarationError(f"state: {wrong}")
    kept = make_parameter(array_shape(size), unit, values, bounds, "run")
    return State(
        "",
        size,
        unit,
        float(intensity),
        tuple(values.tolist()),
        float(spread),
        known=known,
        stated=std is not None,
        lower=kept.lower,
        upper=kept.upper,
    )


def _wrong(field: str, number: Any) -> str | None:
    """What makes a number no intensity or no standard deviation, if anything does."""
    if field == "intensity" and not 0 <= number < np.inf:
        return f"the intensity {number:g} must be finite and not negative (unit²/s)"
    if field == "std" and not 0 < number < np.inf:
        return (
            f"the std {number:g} at the beginning must be positive and finite, or the covariance "
            "is not positive definite"
        )
    return None


@dataclass(frozen=True)
class Measured:
    """An output: the signal that measures it, what it should be, and its noise intensity.

    `intensity` in unit²·s: variance of one reading times the time between two; or `std`, the
    standard deviation of one reading, in its unit, a number or an expression of signals; or
    neither: a calibration tells it from the residual. `wraps`: both are angles, which are alike a
    full turn apart.
    """

    signal: SX
    predicted: SX
    intensity: float | None
    std: float | SX | None = None
    wraps: bool = False


@dataclass(frozen=True)
class Angle:
    """What an output should be, up to full turns."""

    expression: SX


def angle(expression: SX) -> Angle:
    """An angle as an output: `measured(bearing, angle(atan2(y, x)), intensity=1e-4)`.

    Reading and prediction may differ by full turns, 2π or 360 by the unit of the signal (rad where
    it has none): 179° and −179° are 2° apart.
    """
    return Angle(expression)


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What a @dynamics function returns: rates of the states, outputs, and what is known exactly.

    A state without a rate is constant but for its driving noise.
    """

    rates: Mapping[str, SX]
    outputs: tuple[Measured, ...]
    constraints: tuple[Constraint, ...] = ()

    def __post_init__(self) -> None:
        """One alone, its comma forgotten, is a tuple of one."""
        for name, kind in (("outputs", Measured), ("constraints", Constraint)):
            given = getattr(self, name)
            several = (given,) if isinstance(given, kind) else given
            if not isinstance(several, tuple | list) or not all(
                isinstance(one, kind) for one in several
            ):
                raise DeclarationError(
                    f"Motion: {name}= takes {kind.__name__.lower()}(…), …, not {several!r}"
                )
            object.__setattr__(self, name, tuple(several))


def measured(
    signal: SX,
    predicted: SX | Angle,
    *,
    intensity: float | None = None,
    std: float | SX | str | None = None,
) -> Measured:
    """An output: `measured(v, velocity, std=0.01)`, the standard deviation of one reading; or its
    noise's intensity in unit²·s, the variance of one reading times the time between two; see
    `angle` too.

    In a calibration `std` may also be a signal (a column with that of every reading), an expression
    of signals, or "5%" of the reading; and nothing need be said where all readings are alike.
    """
    if intensity is not None and std is not None:
        raise DeclarationError(
            "measured: both of std= and intensity= given: say how large the noise of one "
            "reading is (std=), or its variance times the time between two (intensity=)"
        )
    if isinstance(std, str):
        std = _share(std) * ca.fabs(signal)
    elif isinstance(std, int | float) and not 0 < std < np.inf:
        raise DeclarationError(
            f"measured: std={std:g} must be positive and finite: the standard deviation of one "
            "reading"
        )
    if intensity is not None and not intensity > 0:
        raise DeclarationError(
            f"measured: the noise intensity must be positive, not {intensity}: a reading without "
            "noise makes the Riccati equation singular; give the sensor's variance times its period"
        )
    intensity = None if intensity is None else float(intensity)
    std = float(std) if isinstance(std, int | float) else std
    if isinstance(predicted, Angle):
        return Measured(signal, predicted.expression, intensity, std, wraps=True)
    return Measured(signal, predicted, intensity, std)


def _share(text: str) -> float:
    """The share of the reading that "5%" is."""
    number = text.strip().removesuffix("%").strip()
    try:
        share = float(number) / 100 if text.strip().endswith("%") else np.nan
    except ValueError:
        share = np.nan
    if not 0 < share < np.inf:
        raise DeclarationError(
            f'measured: std={text!r}: give a number, a signal, or a share of the reading as "5%"'
        )
    return share


@dataclass(frozen=True)
class Dynamics:
    """ẋ = f(x, signals) + noise, y = h(x, signals) + noise, declared once; a value."""

    name: str
    function: Callable[..., Motion]
    signals: tuple[Signal, ...]
    states: tuple[State, ...]
    constants: tuple[Constant, ...]
    #: Intensity of the white noise of signals, unit²·s, where `sensing` has said it.
    sensors: Mapping[str, float] = field(default_factory=dict, hash=False)
    #: Signals that are taken as they are, without noise: what an effect reads.
    exact: frozenset[str] = frozenset()

    # -- new ones from this one ----------------------------------------------------------------

    def having(self, **values: Any) -> Dynamics:
        """The same with other constants."""
        names = {c.name for c in self.constants}
        for name in values:
            if name not in names:
                known = ", ".join(sorted(names)) or "none"
                raise UsageError(f"{self.name} has no constant {name!r}; it has {known}")
        changed = tuple(
            replace(c, value=_values(c, values[c.name])) if c.name in values else c
            for c in self.constants
        )
        return replace(self, constants=changed)

    def driven(self, **intensities: float) -> Dynamics:
        """The same with other noise intensities of its states, unit²/s."""
        return self._with_states("intensity", intensities)

    def sensing(self, **intensities: float) -> Dynamics:
        """The same with other noise intensities of its signals, unit²·s: variance of one reading
        times the time between two.

        Noise of an output is the measurement noise Θ. Noise of an input, none where nothing is
        said, drives the states: it adds G·q·Gᵀ to Ξ with G = ∂f/∂input, which may depend on them.
        """
        for name, value in intensities.items():
            if name not in {s.name for s in self.signals}:
                known = ", ".join(s.name for s in self.signals)
                raise UsageError(f"{self.name} has no signal {name!r}; it has {known}")
            wrong = _wrong("intensity", value) or (
                "a reading without noise makes the Riccati equation singular; give the sensor's "
                "variance times its period"
                if value == 0 and name in self.measured_signals
                else None
            )
            if wrong:
                raise UsageError(f"{self.name}: {name}: {wrong}")
        return self._alike(replace(self, sensors={**self.sensors, **intensities}))

    def without_intensities(self) -> Dynamics:
        """The same of which no noise is known but that of its outputs, if that is declared."""
        states = tuple(replace(s, intensity=0.0) for s in self.states)
        return self._alike(replace(self, states=states, sensors={}))

    def _alike(self, other: Dynamics) -> Dynamics:
        """Another one of the same equations, which are traced once."""
        for name in ("traced", "slopes_in_signals"):
            if name in self.__dict__:
                other.__dict__[name] = self.__dict__[name]
        return other

    def known_to(self, **stds: float) -> Dynamics:
        """The same with other standard deviations of the states at the beginning."""
        return self._with_states("std", stds)

    def beginning(self, **starts: Any) -> Dynamics:
        """The same with other states at the beginning."""
        found = {}
        for name, value in starts.items():
            own, size = np.asarray(value, float).ravel(), self[name].size
            if own.size not in (1, size) or not np.all(np.isfinite(own)):
                what = f"{own.size} numbers" if own.size not in (1, size) else "what is not finite"
                raise UsageError(f"{self.name}: {name} begins with {size} numbers, not {what}")
            found[name] = tuple(np.broadcast_to(own, (size,)).tolist())
        return self._with_states("start", found)

    def _with_states(self, field: str, values: Mapping[str, Any]) -> Dynamics:
        for name, value in values.items():
            _ = self[name]
            wrong = _wrong(field, value)
            if wrong:
                raise UsageError(f"{self.name}: {name}: {wrong}")
        changed = tuple(
            replace(s, **{field: values[s.name]}) if s.name in values else s for s in self.states
        )
        return self._alike(replace(self, states=changed))

    def __getitem__(self, name: str) -> State:
        """The state of that name."""
        for s in self.states:
            if s.name == name:
                return s
        known = ", ".join(s.name for s in self.states)
        raise UsageError(f"{self.name} has no state {name!r}; it has {known}")

    # -- layout --------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """Number n of states."""
        return sum(s.size for s in self.states)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of every number of the state: `gravity[2]`."""
        return tuple(
            s.name if s.size == 1 else f"{s.name}[{i}]" for s in self.states for i in range(s.size)
        )

    @cached_property
    def state_units(self) -> tuple[str, ...]:
        """Unit of every number of the state."""
        return tuple(s.unit for s in self.states for _ in range(s.size))

    def slices(self) -> dict[str, slice]:
        """Where each state lies in the state vector."""
        found, place = {}, 0
        for s in self.states:
            found[s.name] = slice(place, place + s.size)
            place += s.size
        return found

    @property
    def start(self) -> Array:
        """The state at the beginning, (n,)."""
        return np.concatenate([np.array(s.start) for s in self.states])

    @property
    def start_covariance(self) -> Array:
        """Its covariance, (n, n)."""
        return np.diag(np.concatenate([np.full(s.size, s.std**2) for s in self.states]))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """What the state never leaves: lower and upper (n,), infinite where nothing is said."""
        return (
            np.array([v for s in self.states for v in s.lower]),
            np.array([v for s in self.states for v in s.upper]),
        )

    @property
    def process(self) -> Array:
        """Intensity Ξ of the driving noise, (n, n)."""
        return np.diag(np.concatenate([np.full(s.size, s.intensity) for s in self.states]))

    @property
    def noise(self) -> Array:
        """Intensity Θ of the measurement noise, (m, m), if intensities are what is declared."""
        return self.noise_at(None)

    def noise_at(self, period: float | None, own: Mapping[str, float] | None = None) -> Array:
        """Intensity Θ of the measurement noise, (m, m), of readings every `period` s.

        `own`: the time between two readings of signals with clocks of their own; of these Θ is that
        which makes the variance of one reading right if it is divided by `period`.
        """
        t, own = self.traced, own or {}

        def intensity(name: str) -> float:
            if period is None or name not in own:
                return self.intensity_of(name, period)
            return self.intensity_of(name, own[name]) * (period / own[name])

        parts = [
            np.full(o.predicted.numel(), intensity(name))
            for name, o in zip(t.measured, t.outputs, strict=True)
        ]
        return np.diag(np.concatenate(parts))

    def intensity_of(self, name: str, period: float | None = None) -> float:
        """Noise intensity of an output signal, unit²·s, read every `period` s.

        Raises UsageError where a standard deviation is declared and the period is not known.
        """
        if name in self.sensors:
            return self.sensors[name]
        t = self.traced
        own = next(o for n, o in zip(t.measured, t.outputs, strict=True) if n == name)
        if own.intensity is not None:
            return own.intensity
        if not isinstance(own.std, float):
            what = "no noise" if own.std is None else "a noise that differs between readings"
            raise UsageError(
                f"{self.name}: {name} has {what}, and a filter needs one number: "
                f"measured({name}, …, std=NUMBER), or --sensor-noise {name}=NUMBER"
            )
        if period is None:
            raise UsageError(
                f"{self.name}: {name} has the noise of one reading (std={own.std:g}): its "
                f"intensity needs the time between two; sensing({name}=…) says it"
            )
        return own.std**2 * period

    @cached_property
    def input_noise(self) -> SX | None:
        """What the noise of the inputs adds to Ξ, ΣG·q·Gᵀ, as an expression; None: nothing."""
        found = [q * (G @ G.T) for G, q in ((self.slopes_in_signals[name], self.sensors[name])
                 for name in self.noisy_inputs)]  # fmt: skip
        return sum(found[1:], found[0]) if found else None

    @property
    def noisy_inputs(self) -> tuple[str, ...]:
        """Names of the signals whose noise drives the states."""
        slopes = self.slopes_in_signals
        return tuple(name for name, q in self.sensors.items() if q and slopes[name].nnz())

    @cached_property
    def slopes_in_signals(self) -> Mapping[str, SX]:
        """∂f/∂signal of every signal."""
        t = self.traced
        return {s.name: ca.jacobian(t.f, flat(t.symbols[s.name])) for s in self.signals}

    # -- symbols -------------------------------------------------------------------------------

    @cached_property
    def traced(self) -> Traced:
        """The body on CasADi symbols."""
        return traced_with(self, {c.name: number_of(c) for c in self.constants})

    @property
    def driven_by_noise(self) -> bool:
        """Does white noise drive a state, its own or that of an input?"""
        noisy = set(self.sensors) - {s.name for s in self.signals if s.name in self.input_signals}
        inputs = {name for name, q in self.sensors.items() if q} - noisy
        return any(s.intensity for s in self.states) or bool(inputs)

    @property
    def driving(self) -> frozenset[str]:
        """Names of the signals that drive the states."""
        return frozenset(name for name, G in self.slopes_in_signals.items() if G.nnz())

    @property
    def says_noise(self) -> bool:
        """Has every output a noise that a filter can take?"""
        t = self.traced
        return all(
            name in self.sensors or o.intensity is not None or isinstance(o.std, float)
            for name, o in zip(t.measured, t.outputs, strict=True)
        )

    @property
    def without_noise(self) -> bool:
        """Is nothing said of any noise, so that it can be nothing but a calibration?"""
        silent = all(o.std is None and o.intensity is None for o in self.traced.outputs)
        return silent and not self.driven_by_noise and not self.sensors

    @property
    def calibration(self) -> Model:
        """The model that it is without driving noise: see `equations`."""
        return calibration(self)

    @property
    def unknown_constants(self) -> tuple[Parameter, ...]:
        """Unknown constants of the equations."""
        return tuple(s.of for s in self.states if s.of is not None)

    def moved(self, symbols: Mapping[str, Any]) -> Motion:
        """What the body returns, of signals, states and constants by name."""
        try:
            motion = self.function(**symbols)
        except CasestError:
            raise
        except (Exception, SystemExit) as error:
            raise DeclarationError(f"dynamics {self.name}: {last_line(error)}") from None
        if not isinstance(motion, Motion):
            raise DeclarationError(f"dynamics {self.name} must return Motion(rates=…, outputs=…)")
        return motion

    def rates_of(self, motion: Motion) -> dict[str, SX]:
        """The rate of every state and unknown constant, a column each."""
        rates = {}
        for own in self.states:
            if own.of is not None and own.name in motion.rates:
                raise DeclarationError(
                    f"dynamics {self.name}: rate of {own.name!r}, which is a constant: declare "
                    "state(…) in place of param(…)"
                )
            rate = ca.SX(motion.rates.get(own.name, ca.SX.zeros(own.size)))
            if rate.numel() != own.size:
                raise DeclarationError(
                    f"dynamics {self.name}: the rate of {own.name} has {rate.numel()} numbers, "
                    f"the state {own.size}"
                )
            rates[own.name] = ca.densify(rate)
        for name in motion.rates:
            if name not in rates:
                raise DeclarationError(f"dynamics {self.name}: rate of {name!r}, which is no state")
        return rates

    def measured_in(self, motion: Motion, symbols: Mapping[str, SX]) -> list[str]:
        """Names of the signals that outputs are compared with."""
        names = []
        for o in motion.outputs:
            found = [s.name for s in self.signals if symbols[s.name] is o.signal]
            if not found:
                raise DeclarationError(f"dynamics {self.name}: measured(…) needs a signal first")
            names.append(found[0])
        return names

    @property
    def input_signals(self) -> tuple[str, ...]:
        """Names of the signals that drive the motion or tell the outputs, but for the time."""
        return tuple(s.name for s in self.signals if s.name not in (*self.measured_signals, "t"))

    @property
    def measured_signals(self) -> tuple[str, ...]:
        """Names of the signals that outputs are compared with."""
        return self.traced.measured

    @cached_property
    def may_be_missing(self) -> tuple[str, ...]:
        """Signals whose readings may be missing: those that nothing is computed from."""
        t = self.traced
        used = ca.vertcat(t.f, t.h, t.g)
        return tuple(n for n in t.measured if not ca.depends_on(used, flat(t.symbols[n])))

    @cached_property
    def linear(self) -> bool:
        """Are rates and outputs linear in the state? An angle that wraps is not."""
        t = self.traced
        if any(o.wraps for o in t.outputs):
            return False
        slopes = ca.vertcat(ca.vec(t.A), ca.vec(t.C))
        return not ca.depends_on(slopes, t.x)


@dataclass(frozen=True)
class Traced:
    """Symbols and expressions: x, signals, f(x, u), h(x, u), A = ∂f/∂x, C = ∂h/∂x, readings;
    constraints g(x, u) = 0 and G = ∂g/∂x; `turn` (m,): a full turn of readings that are angles;
    `limited`: something is never passed that is no bound of a state."""

    x: SX
    symbols: Mapping[str, SX]
    f: SX
    h: SX
    A: SX
    C: SX
    reading: SX
    g: SX
    G: SX
    outputs: tuple[Measured, ...]
    measured: tuple[str, ...]
    turn: Array
    limited: bool = False

    def wrapped(self, difference: Any) -> Any:
        """Readings less predictions (m) or (N, m), angles within half a turn of zero."""
        if not self.turn.any():
            return difference
        full = np.where(self.turn > 0, self.turn, 1.0)
        if isinstance(difference, np.ndarray):
            return difference - self.turn * np.floor(difference / full + 0.5)
        return difference - ca.DM(self.turn) * ca.floor(difference / full + 0.5)

    def nearest(self, y: Array, C: Array, d: Array, x: Array) -> Array:
        """Readings (N, m), angles by full turns as near to C·x + d as they come."""
        if not self.turn.any():
            return y
        said = (C @ x[:, :, None])[:, :, 0] + d
        return np.asarray(said + self.wrapped(y - said))


def _values(fixed: Constant, value: Any) -> tuple[float, ...]:
    """A constant's numbers, of its shape."""
    array = np.asarray(value, float)
    if array.shape != fixed.array.shape:
        raise UsageError(f"{fixed.name} has shape {fixed.array.shape}, not {array.shape}")
    return tuple(array.ravel().tolist())


def number_of(fixed: Constant) -> Any:
    """The value of a constant as the body sees it."""
    return ca.SX(ca.DM(fixed.array)) if fixed.dims else float(fixed.array)


def dynamics(function: Callable[..., Motion]) -> Dynamics:
    """Declare a moving estimator: positional arguments are signals, keyword-only ones states
    (`state(…)`), unknown constants of the equations (`param(…)`) or known ones."""
    name = function.__name__.replace("_", "-")
    signals, states, constants = [], [], []
    for argument in inspect.signature(function).parameters.values():
        default: Any = argument.default
        where = f"dynamics {name}: {argument.name}"
        if argument.kind is argument.POSITIONAL_OR_KEYWORD:
            if not isinstance(default, Signal):
                raise DeclarationError(f"{where} comes before the * and must be signal(…)")
            if default.std is not None:
                raise DeclarationError(
                    f"{where}: std is of a calibration's signals; filter, observe and close take "
                    f"that of an estimator in motion as --sensor-noise {argument.name}=STD"
                )
            signals.append(replace(default, name=argument.name))
        elif isinstance(default, State):
            states.append(replace(default, name=argument.name))
        elif isinstance(default, Constant):
            constants.append(replace(default, name=argument.name))
        elif isinstance(default, Parameter):
            states.append(_followed(replace(default, name=argument.name)))
        elif isinstance(default, int | float) and not isinstance(default, bool):
            plain: Constant = constant(default)
            constants.append(replace(plain, name=argument.name))
        else:
            raise DeclarationError(
                f"{where} must be state(…), param(…), constant(…) or a number, not {default!r}"
            )
    check_units_known(name, (*(own.of for own in states if own.of is not None), *constants))
    for own in states:
        if own.of is None and not units.known(own.unit):
            raise DeclarationError(f"dynamics {name}: {own.name} has unknown unit {own.unit!r}")
    return Dynamics(name, function, tuple(signals), tuple(states), tuple(constants))


def _followed(unknown: Parameter) -> State:
    """A filter's state for an unknown constant: its std is its size, or 1 of what begins at 0."""
    start = unknown.start_value()
    size = float(np.max(np.abs(start), initial=0.0))
    values = tuple(start.tolist())
    unit = unknown.units[0] if len(set(unknown.units)) == 1 else "1"
    bounds = unknown.lower, unknown.upper
    return State(
        unknown.name, unknown.shape.size, unit, 0.0, values, size or UNSTATED, False, False, False,
        unknown, *bounds,
    )  # fmt: skip


def traced_with(declared: Dynamics, constants: Mapping[str, SX | float]) -> Traced:
    """The body on CasADi symbols, its constants numbers or symbols too."""
    symbols: dict[str, SX] = {}
    for s in declared.signals:
        plain = ca.SX.sym(s.name, s.size)
        symbols[s.name] = ca.reshape(plain, 3, 3).T if s.kind == "rotation" else plain
    xs = {own.name: ca.SX.sym(own.name, own.size) for own in declared.states}
    for own in declared.states:
        if own.of is not None and (own.of.shape.curved or len(own.of.shape.dims) > 1):
            raise DeclarationError(
                f"dynamics {declared.name}: {own.name} is a matrix or a direction, which a filter "
                "does not follow; calibrate it, or declare its entries"
            )
    motion = declared.moved({**symbols, **xs, **constants})
    rates = list(declared.rates_of(motion).values())
    names = declared.measured_in(motion, symbols)
    x, f = ca.vertcat(*xs.values()), ca.vertcat(*rates)
    h = ca.vertcat(*[ca.densify(ca.vec(ca.SX(o.predicted))) for o in motion.outputs])
    reading = ca.vertcat(*[flat(o.signal) for o in motion.outputs])
    if reading.numel() != h.numel():
        raise DeclarationError(f"dynamics {declared.name}: outputs and signals differ in shape")
    g = ca.vertcat(*[ca.vec(c.expression) for c in motion.constraints if not c.limit])
    of = {s.name: s.unit for s in declared.signals}
    turn = [
        np.full(o.predicted.numel(), 2 * np.pi / units.size(of[n] or "rad")[0] if o.wraps else 0.0)
        for n, o in zip(names, motion.outputs, strict=True)
    ]
    A, C, G = ca.jacobian(f, x), ca.jacobian(h, x), ca.jacobian(g, x)
    return Traced(
        x,
        symbols,
        f,
        h,
        A,
        C,
        reading,
        g,
        G,
        motion.outputs,
        tuple(names),
        np.concatenate([np.zeros(0), *turn]),
        any(c.limit for c in motion.constraints),
    )
