"""True motions of a declared estimator: inputs along a trajectory, states that follow them.

The states follow fine Runge-Kutta steps of their own, with the driving noise added to each, so that
a simulated record owes nothing to the transitions of the filter that is tried on it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casest import units
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.dynamics.samples import over_samples, replay
from casest.engine import Recursion
from casest.errors import CasestError, UsageError

#: Steps of the integration in one of the record.
FINE = 4
#: Typical rate of a turn that nothing else fixes, rad/s.
TURN = 0.5
#: Periods of the sines of a random curve in one record: the fewest and the most.
PERIODS = (2.0, 10.0)
SINES = 3

Curve = Callable[[Array], Array]


@dataclass(frozen=True)
class Course:
    """True states x (M, n) with their rates, and inputs u (2M − 1, k), at and between fine times.

    `time` (M,) holds the record's samples and lies finer between them.
    """

    model: Dynamics
    time: Array
    x: Array
    rate: Array
    u: Array

    def states(self, t: Array) -> Array:
        """At any times within, (N, n), by cubics through states and rates."""
        from scipy.interpolate import CubicHermiteSpline

        return np.asarray(CubicHermiteSpline(self.time, self.x, self.rate)(t))

    def inputs(self, t: Array) -> dict[str, Array]:
        """Every input at any times within, (N, size)."""
        both = _halved(self.time)
        columns = np.array([np.interp(t, both, own) for own in self.u.T]).T.reshape(len(t), -1)
        return _split(self.model, columns)


def input_names(model: Dynamics) -> list[str]:
    """Signals that are not compared with an output."""
    return [s.name for s in model.signals if s.name not in model.measured_signals]


def steered(model: Dynamics) -> dict[str, str]:
    """Which input can lead which state wherever it should go: {input: state}.

    The state's rate is linear in the input, with a slope that is square and regular.
    """
    t, found = model.traced, dict[str, str]()
    sample = ca.vertcat(t.x, *[flat(s) for s in t.symbols.values()])
    point = np.random.default_rng(0).standard_normal(sample.numel())
    for name in input_names(model):
        u = flat(t.symbols[name])
        for s, where in model.slices().items():
            slope = ca.jacobian(t.f[where], u)
            if s in found.values() or model[s].size != u.numel() or ca.depends_on(slope, u):
                continue
            value = np.array(ca.Function("slope", [sample], [ca.densify(slope)])(point))
            if np.linalg.matrix_rank(value) == len(value):
                found[name] = s
                break
    return found


def random_curve(rng: np.random.Generator, size: int, duration: float) -> Curve:
    """A smooth random curve of `size` components, about 1 large: `curve(t)` (N, size)."""
    low, high = (2 * np.pi * p / duration for p in PERIODS)
    frequency = np.exp(rng.uniform(np.log(low), np.log(high), (size, SINES)))
    amplitude = rng.uniform(0.5, 1.0, (size, SINES)) * np.sqrt(2 / SINES)
    phase = rng.uniform(0, 2 * np.pi, (size, SINES))

    def curve(t: Array) -> Array:
        angle = t[:, None, None] * frequency + phase
        return np.asarray(np.sum(amplitude * np.sin(angle), axis=2))

    return curve


def random_course(
    model: Dynamics, t: Array, rng: np.random.Generator, *, early: float = 0.0
) -> Course:
    """A motion of its own over sample times t (N,): smooth random inputs.

    Where an input can lead a state, the state follows a random curve as large as its `std` and the
    input does what that takes; other inputs are random curves of 0.5 rad/s, or of 1 in their unit.
    `early`: so many seconds before the first sample are known too. Raises UsageError where a
    signal cannot be made up, or the states do not stay finite.
    """
    duration, leads = float(t[-1] - t[0]), steered(model)
    curves: list[Curve] = []
    for name in input_names(model):
        s = next(s for s in model.signals if s.name == name)
        if s.kind == "rotation":
            raise UsageError(f"{model.name}: attitudes {name} must be given: --input FILE")
        if name in leads:
            own = model[leads[name]]
            curves.append(_slope(random_curve(rng, own.size, duration), own.std, duration))
        elif s.unit == "s" and s.size == 1:
            curves.append(lambda at: at[:, None])
        else:
            curves.append(_scaled(random_curve(rng, s.size, duration), _typical(s.unit)))

    def given(at: Array) -> Array:
        return np.concatenate([np.zeros((len(at), 0)), *(c(at) for c in curves)], axis=1)

    fine, first = _fine(t, early)
    halves = _halved(fine)
    if leads:
        nominal = _followed(_step(model, leads), given, model.start, halves, 2 * first)
        u = _applied(model, leads, nominal, given(halves))
    else:
        u = given(halves)
    return _course(model, fine, u, first, rng)


def course_along(
    model: Dynamics,
    t: Array,
    inputs: Mapping[str, Array],
    rng: np.random.Generator,
    *,
    early: float = 0.0,
) -> Course:
    """The motion along given inputs (N, size) at t (N,): straight lines between them."""
    every = np.concatenate([np.zeros((len(t), 0)), *(inputs[n] for n in input_names(model))], 1)
    fine, first = _fine(t, early)
    halves = _halved(fine)
    u = np.array([np.interp(halves, t, own) for own in every.T]).T.reshape(len(halves), -1)
    return _course(model, fine, u, first, rng)


def _course(model: Dynamics, fine: Array, u: Array, first: int, rng: np.random.Generator) -> Course:
    """States along inputs (2M − 1, k); the start holds at fine[first], earlier without noise."""

    def given(at: Array) -> Array:
        return np.array([np.interp(at, _halved(fine), own) for own in u.T]).T.reshape(len(at), -1)

    steps = np.diff(fine)[:, None]
    noise = np.sqrt(np.diag(model.process) * steps) * rng.standard_normal((len(steps), model.size))
    noise[:first] = 0.0
    x = _followed(_step(model, {}), given, model.start, fine, first, noise)
    if not np.all(np.isfinite(x)):
        raise UsageError(
            f"{model.name}: the states do not stay finite along this trajectory: give another "
            "start (--value STATE=…), a shorter --duration, or inputs of your own (--input FILE)"
        )
    rate = _over(_rate(model, {})[0], x, u[::2])[0]
    return Course(model, fine, x, rate, u)


def _followed(
    step: Recursion,
    given: Curve,
    start: Array,
    time: Array,
    first: int,
    noise: Array | None = None,
) -> Array:
    """States (M, n) at `time`, from `start` at time[first], forwards and backwards."""
    n = len(start)
    noise = np.zeros((len(time) - 1, n)) if noise is None else noise
    parts = [
        _way(step, given, start, way, own)
        for way, own in ((time[first::-1], noise[:first][::-1]), (time[first:], noise[first:]))
    ]
    return np.concatenate([parts[0][:0:-1], parts[1]])


def _way(step: Recursion, given: Curve, start: Array, time: Array, noise: Array) -> Array:
    if len(time) < 2:
        return start[None]
    h = np.diff(time)
    numbers = [given(time[:-1]), given(time[:-1] + 0.5 * h), given(time[1:]), h[:, None], noise]
    (after,) = step(start, numbers)
    return np.concatenate([start[None], after])


def _step(model: Dynamics, leads: Mapping[str, str]) -> Recursion:
    """(x; inputs at the beginning, middle and end, h, noise) -> x after it."""
    rate, wide = _rate(model, leads)
    x, h = ca.SX.sym("x", model.size), ca.SX.sym("h")
    u, middle, v = (ca.SX.sym(name, wide) for name in "umv")
    noise = ca.SX.sym("noise", model.size)
    a = rate(x, u)[0]
    b = rate(x + 0.5 * h * a, middle)[0]
    c = rate(x + 0.5 * h * b, middle)[0]
    d = rate(x + h * c, v)[0]
    after = x + h / 6 * (a + 2 * b + 2 * c + d) + noise
    numbers = [u, middle, v, h, noise]
    return Recursion(ca.Function("step", [x, *numbers], [after], {"cse": True}))


def _rate(model: Dynamics, leads: Mapping[str, str]) -> tuple[Any, int]:
    """(x, inputs) -> (ẋ, inputs), where an input that leads a state is given by its rate."""
    t, where = model.traced, model.slices()
    names = input_names(model)
    own = {name: flat(t.symbols[name]) for name in names}
    given = {name: ca.SX.sym(name, own[name].numel()) for name in names}
    used: dict[str, SX] = {name: given[name] for name in names if name not in leads}

    def put(expression: SX) -> SX:
        return ca.substitute([expression], [own[n] for n in used], list(used.values()))[0]

    for name, state in leads.items():
        rate = t.f[where[state]]
        slope = ca.jacobian(rate, own[name])
        rest = ca.substitute(rate, own[name], ca.SX.zeros(own[name].numel()))
        used = {**used, name: ca.solve(put(slope), given[name] - put(rest))}
    rates = put(t.f) if used else t.f
    measured = [s for s in model.measured_signals if ca.depends_on(rates, flat(t.symbols[s]))]
    if measured:
        raise UsageError(
            f"{model.name}: {measured[0]} both drives the states and is compared with an output; "
            "such a record cannot be simulated"
        )
    both = ca.vertcat(*given.values())
    applied = ca.vertcat(*[used[name] for name in names])
    outputs = [ca.densify(rates), ca.densify(applied)]
    return ca.Function("rate", [t.x, both], outputs), int(both.numel())


def _applied(model: Dynamics, leads: Mapping[str, str], x: Array, given: Array) -> Array:
    """All inputs (M, k) where those that lead a state are given by its rate."""
    return _over(_rate(model, leads)[0], x, given)[1]


def _over(function: Any, x: Array, u: Array) -> list[Array]:
    """Both outputs of a rate at many states and inputs."""
    own = [ca.SX.sym(name, part.shape[1]) for name, part in (("x", x), ("u", u))]
    found = over_samples(replay(ca.vertcat(*own), function(*own)), [x, u])
    return [part[:, :, 0] for part in found]


def _slope(curve: Curve, size: float, duration: float) -> Curve:
    """The curve's derivative, times `size`."""
    h = 1e-4 * duration / PERIODS[1]
    return lambda t: size * (curve(t + h) - curve(t - h)) / (2 * h)


def _scaled(curve: Curve, size: float) -> Curve:
    return lambda t: size * curve(t)


def _typical(unit: str | None) -> float:
    try:
        factor, _ = units.conversion("rad/s", unit or "1")
    except CasestError:
        return 1.0
    return TURN * factor


def _fine(t: Array, early: float) -> tuple[Array, int]:
    """Times that hold t and go finer between, from `early` s before it; where t begins."""
    step = np.diff(t)
    h = step[0] / FINE
    first = int(np.ceil(early / h - 1e-9)) if early > 0 else 0
    between = (t[:-1, None] + step[:, None] * np.arange(FINE) / FINE).ravel()
    before = t[0] + h * np.arange(-first, 0)
    return np.concatenate([before, between, t[-1:]]), first


def _halved(time: Array) -> Array:
    """With the middle of every step."""
    found = np.empty(2 * len(time) - 1)
    found[::2], found[1::2] = time, 0.5 * (time[1:] + time[:-1])
    return found


def _split(model: Dynamics, columns: Array) -> dict[str, Array]:
    found, place = {}, 0
    sizes: Sequence[tuple[str, int]] = [
        (n, int(model.traced.symbols[n].numel())) for n in input_names(model)
    ]
    for name, size in sizes:
        found[name] = columns[:, place : place + size]
        place += size
    return found
