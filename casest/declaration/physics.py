"""The vocabulary of a model's body: CasADi's functions, and the few that physics needs besides."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from casest.errors import DeclarationError

#: What a model's body handles; CasADi ships no type annotations.
SX = Any

acos, asin, atan, atan2, cos, cosh = ca.acos, ca.asin, ca.atan, ca.atan2, ca.cos, ca.cosh
exp, log, sin, sinh, sqrt, tan, tanh = ca.exp, ca.log, ca.sin, ca.sinh, ca.sqrt, ca.tan, ca.tanh
fabs, fmax, fmin, sign, if_else = ca.fabs, ca.fmax, ca.fmin, ca.sign, ca.if_else
cross, dot, norm_2, vertcat, horzcat = ca.cross, ca.dot, ca.norm_2, ca.vertcat, ca.horzcat
diag, skew, sum1, inverse = ca.diag, ca.skew, ca.sum1, ca.inv
pi, inf = ca.pi, float("inf")


@dataclass(frozen=True)
class Quantity:
    """A named inner value of a model: `declared` before, `value` after the effects on it.

    `implied`: the body did not name it; it is the prediction.
    """

    name: str
    unit: str
    declared: SX
    value: SX
    implied: bool = False

    @property
    def dims(self) -> tuple[int, ...]:
        """() for a scalar, (n,) for a vector."""
        return () if self.declared.is_scalar() else (self.declared.numel(),)


@dataclass
class Trace:
    """One run of a model's body; collects the quantities and lets effects and cuts in.

    `straight`: what an effect does is added as a free symbol, so that slopes pass it as they are;
    `steps` holds each symbol and what it stands for, which may contain those before it.
    """

    effects: dict[str, list[Any]] = field(default_factory=dict)
    cut: str | None = None
    naming: bool = False
    straight: bool = False
    reserved: frozenset[str] = frozenset()
    quantities: dict[str, Quantity] = field(default_factory=dict)
    handed: dict[str, SX] = field(default_factory=dict)
    steps: list[tuple[SX, SX]] = field(default_factory=list)
    #: What looks at other samples (tracing.Stage, flow.Flow), in the order of the body; only
    #: where these are kept apart.
    stages: list[Any] = field(default_factory=list)
    staged: bool = False
    #: How a word of the body that does so is handed on (tracing.reached).
    reach: Any = None
    #: Does the body integrate rates?
    integrates: bool = False

    def enter(self, name: str, expression: Any, unit: str, *, implied: bool = False) -> SX:
        """Record a quantity and hand back what the rest of the body shall see."""
        if name in self.quantities or name in self.reserved:
            raise DeclarationError(
                f"name {name!r} is used twice: a quantity needs a name of its own"
            )
        declared = ca.SX(expression)
        if self.cut == name:
            declared = ca.SX.sym(name, *declared.shape)
        value = declared
        for apply in self.effects.get(name, ()):
            value = self.passed(value, apply(value))
        self.quantities[name] = Quantity(name, unit, declared, value, implied)
        self.handed[name] = ca.SX.sym(name, *declared.shape) if self.naming else value
        return self.handed[name]

    def passed(self, before: SX, after: SX) -> SX:
        """What an effect hands on."""
        if not self.straight:
            return after
        step = ca.SX.sym("step", *before.shape)
        self.steps.append((step, after - before))
        return before + step


current_trace: ContextVar[Trace | None] = ContextVar("current_trace", default=None)


def quantity(name: str, expression: Any, unit: str = "") -> SX:
    """Name an inner value of the model, so that effects can enter there and reports can show it."""
    trace = current_trace.get()
    if trace is None:
        raise DeclarationError(f"quantity({name!r}, …) belongs in the body of a @model function")
    return trace.enter(name, expression, unit)


def before(expression: Any) -> SX:
    """What an expression was at the rest before; of a record's first rest there is none."""
    return _over_samples("before", expression)


def turned(rate: Any) -> SX:
    """How far the body has turned since the rest before: R (3, 3) of its angular rate in rad/s.

    The rate, in the body's own frame, is integrated over the raw record between the two rests. A
    direction that stands still, seen as x there, is now seen as R.T @ x.
    """
    return _over_samples("turned", rate)


def carried(rate: Any, vector: Any) -> SX:
    """Mean (3,) of a vector over the way since the rest before, as that rest's frame sees it.

    Both are of the body's own frame; `rate`, in rad/s, says how that has turned on the way.
    """
    return _over_samples("carried", ca.vertcat(ca.SX(rate), ca.SX(vector)))


def _over_samples(word: str, expression: Any) -> SX:
    trace = current_trace.get()
    if trace is None or trace.reach is None:
        raise DeclarationError(f"{word}(…) belongs in the body of a @model function")
    return trace.reach(trace, word, ca.SX(expression))


def polynomial(coefficients: Any, variable: SX) -> SX:
    """c[0] + c[1]·x + c[2]·x² + …, by Horner's rule."""
    coefficients = ca.SX(coefficients)
    value = ca.SX(0)
    for i in reversed(range(coefficients.numel())):
        value = value * variable + coefficients[i]
    return value


def integral(expression: SX, variable: SX) -> SX:
    """∫₀ˣ of an expression that is a polynomial in the variable (exact, symbolic)."""
    try:
        coefficients = ca.poly_coeff(ca.SX(expression), variable)
    except RuntimeError:
        raise DeclarationError(
            f"integral of {expression} over {variable}: only polynomials are integrated; "
            "declare the integral itself and use der() for what it integrates"
        ) from None
    degree = coefficients.numel() - 1
    value = ca.SX(0)
    for i in range(degree + 1):
        power = degree - i
        value = value * variable + coefficients[i] / (power + 1)
    return value * variable


def der(expression: SX, variable: SX) -> SX:
    """Derivative with respect to a scalar signal, usually time."""
    trace = current_trace.get()
    if trace is not None and trace.naming and expression.is_symbolic():
        return ca.SX.sym(f"der({expression})")
    for stage in [] if trace is None else trace.stages:
        if ca.depends_on(ca.vec(ca.SX(expression)), stage.given):
            if stage.word:
                continue
            if stage.attached is None:
                raise DeclarationError("der of what is integrated: write its rate instead")
            on, label = stage.attached.on, stage.attached.label
            raise DeclarationError(f"how fast {on} changes is unknown once {label} acts on it")
    return ca.jtimes(ca.SX(expression), variable, ca.SX.ones(*variable.shape))


def rotation(angles: SX) -> SX:
    """R = Rx(θ)·Ry(φ)·Rz(ψ): the rotation matrix of Euler angles (θ, φ, ψ), radians.

    Pedersini leaves the order of `rotmat[θ,φ,ψ]` open; this is casest's convention.
    """
    c, s = [cos(angles[i]) for i in range(3)], [sin(angles[i]) for i in range(3)]
    rx = vertcat(horzcat(1, 0, 0), horzcat(0, c[0], -s[0]), horzcat(0, s[0], c[0]))
    ry = vertcat(horzcat(c[1], 0, s[1]), horzcat(0, 1, 0), horzcat(-s[1], 0, c[1]))
    rz = vertcat(horzcat(c[2], -s[2], 0), horzcat(s[2], c[2], 0), horzcat(0, 0, 1))
    return rx @ ry @ rz


@dataclass(frozen=True)
class Constraint:
    """What is known without noise: `expression` is zero at every instant, or as a `limit` never
    negative."""

    expression: SX
    limit: bool = False


def constraint(
    expression: SX, value: Any = None, *, at_least: Any = None, at_most: Any = None
) -> Constraint:
    """Known without noise: `constraint(norm_2(gravity), 9.80665)`, `constraint(x, at_least=0)`;
    every estimate keeps to it."""
    given = [v is not None for v in (value, at_least, at_most)]
    if sum(given) != 1:
        raise DeclarationError(
            "constraint(expression, value) says what it is, at_least= or at_most= what it never "
            "passes: give one of the three"
        )
    of = ca.SX(expression)
    if at_most is not None:
        return Constraint(ca.densify(at_most - of), limit=True)
    return Constraint(ca.densify(of - (at_least if value is None else value)), value is None)


class Residual:
    """What a model's body returns: how readings and parameters are tied together.

    Explicit: `Residual(measured=v, predicted=reading)` with residual v − reading; of several
    signals `measured=(v, w), predicted=(first, second)`. `std`: of one reading, likewise; the
    residual is then in these, and they weigh the readings. Implicit:
    `Residual(implicit=expression, unit="m/s^2")`, an expression that is zero but for noise; its
    unit should be that of the reading. `corrected` is the quantity that `apply` gives back.
    `noise` names for each axis the constant that is its standard deviation: a residual of several
    kinds is then counted in standard deviations, and what is 0 is found from the data. `wander`
    names constants in `[s]/s^0.5`: how far the offset of signal s walks in a second.
    `constraints`: what holds without noise, of parameters or at every sample.
    """

    def __init__(
        self,
        *,
        measured: Any = None,
        predicted: Any = None,
        implicit: SX = None,
        corrected: SX = None,
        unit: str = "",
        axes: tuple[str, ...] = (),
        noise: tuple[str, ...] = (),
        wander: tuple[str, ...] = (),
        std: Any = None,
        constraints: tuple[Constraint, ...] | Constraint = (),
    ) -> None:
        explicit = measured is not None and predicted is not None
        if explicit == (implicit is not None):
            raise DeclarationError("Residual takes measured= and predicted=, or implicit= alone")
        several = isinstance(measured, tuple | list)
        self.signals: tuple[SX, ...] = tuple(measured) if several else (measured,)
        for given in self.signals if explicit else ():
            if not isinstance(given, ca.SX):
                raise DeclarationError(
                    f"measured={given!r} is no signal of the model; where a known number is what "
                    "readings should give, say implicit=quantity(…) − that number"
                )
        self.predicted = _side_by_side(predicted) if several else predicted
        self.measured = _side_by_side(measured) if several else measured
        self.std = None if std is None else _side_by_side(std) if several else ca.SX(std)
        self.implicit, self.corrected, self.unit, self.axes = implicit, corrected, unit, axes
        self.noise, self.wander = noise, wander
        self.constraints: tuple[Constraint, ...] = (
            (constraints,) if isinstance(constraints, Constraint) else tuple(constraints)
        )

    @property
    def expression(self) -> SX:
        """The residual, as a column."""
        if self.implicit is not None:
            return ca.vec(ca.SX(self.implicit))
        if self.measured.shape != ca.SX(self.predicted).shape:
            raise DeclarationError(
                f"measured has shape {self.measured.shape}, predicted {ca.SX(self.predicted).shape}"
            )
        return self.of(ca.vec(self.measured), ca.vec(ca.SX(self.predicted)))

    def of(self, reading: SX, predicted: SX) -> SX:
        """The residual of readings and predictions, columns."""
        away = reading - predicted
        return away if self.std is None else away / ca.vec(self.std)


def _side_by_side(parts: Any) -> SX:
    """Several expressions as one column."""
    return ca.vertcat(*(ca.densify(ca.vec(ca.SX(part))) for part in parts))


def chart(kind: str, coordinates: SX, reference: SX) -> SX:
    """Point of a curved set from chart coordinates around a reference (zero gives the reference).

    Sphere: stereographic projection from the antipode; rotations: Cayley map, R₀·C(δ). Both have
    unit derivative at zero, so a coordinate is an angle in radians there.
    """
    if kind == "unit":
        d2 = ca.sumsqr(coordinates)
        tangent = reference[3:6] * coordinates[0] + reference[6:9] * coordinates[1]
        return ((4 - d2) * reference[0:3] + 4 * tangent) / (4 + d2)
    half = coordinates / 2
    h2 = ca.sumsqr(half)
    cayley = ((1 - h2) * ca.SX.eye(3) + 2 * ca.skew(half) + 2 * (half @ half.T)) / (1 + h2)
    return ca.reshape(reference, 3, 3).T @ cayley
