"""Corrected readings: invert what lies between the corrected quantity and the reading."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.effect import Attached
from casest.declaration.model import Model
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.declaration.tracing import (
    Traced,
    flat,
    function_of,
    reached_parameters,
    reached_signals,
    sample_symbol,
    trace,
)
from casest.engine import Replay
from casest.errors import DataError, UsageError

#: What is said of effects that a correction leaves in the readings.
LEFT = (
    "not undone, since that would amplify the noise without bound or carry the course of one "
    "record to another: "
)

#: What is said of effects that follow the time of the record they were found in.
TIMED = "found at the times of the fitted record, and a guess for any other: "

#: What is said of those that happened in it alone.
ONCE = (
    "happened in the record of the fit; any other is corrected without what passed, and with the "
    "mean over that of what stayed: "
)

#: Newton steps, each halved up to HALVINGS times until it gains.
STEPS, HALVINGS = 60, 30


def invertible(model: Model) -> tuple[Model, tuple[str, ...]]:
    """The model without the effects that a correction of single samples cannot undo; their labels.

    Those are effects on the sequence of samples, those that act on rates of the reading, lags of a
    signal that the correction reads, and what describes the course of the fitted record, which says
    nothing of another one.
    """
    if model.traced.corrected is None:
        return model, ()
    left = [
        a
        for a in model.effects
        if _looks_elsewhere(model, a)
        or (a.effect.describes and a.kind != "noise")
        or _acts_on_a_rate(model, a)
    ]
    if not left:
        return model, ()
    kept = tuple(a for a in model.effects if a not in left)
    return replace(model, effects=kept), tuple(a.label for a in left)


def _looks_elsewhere(model: Model, attached: Attached) -> bool:
    """Does the correction of one sample need others, for this effect?

    Of a signal that is answered late also where it is what the correction gives: that is late.
    """
    name = model.traced.corrected
    if attached.kind != "time" or name is None:
        return attached.kind == "sequence"
    cut = trace(model, cut=name)
    if attached.on in reached_signals(model, cut, cut.expression):
        return True
    given = ca.vec(ca.SX(model.traced.quantities[name].declared))
    recorded = not reached_parameters(model, model.traced, given)
    return recorded and set(reached_signals(model, model.traced, given)) == {attached.on}


def of_their_time(model: Model) -> tuple[str, ...]:
    """Effects of an invertible model that follow the time of the record they were found in.

    A drift, a step, a line in the spectrum: they say nothing of another record.
    """
    if model.traced.corrected is None or "t" not in {s.name for s in correction_of(model).signals}:
        return ()
    return tuple(a.label for a in model.effects if "t" in {s.name for s in a.effect.extras})


def _acts_on_a_rate(model: Model, attached: Attached) -> bool:
    """Does the effect vanish where the corrected quantity is one free number, without a rate?"""
    name = model.traced.corrected
    if attached.kind != "quantity" or model.implicit or not attached.parameters or name is None:
        return False
    cut = trace(model, cut=name)
    wanted = cut.quantities[name].declared
    declared = cut.quantities[attached.on].declared
    if attached.on != name and not ca.depends_on(ca.vec(declared), ca.vec(wanted)):
        return False  # it lies before the correction
    own = {p.name for p in attached.parameters}
    return not own & reached_parameters(model, cut, cut.expression)


@dataclass(frozen=True)
class Correction:
    """From reading to corrected quantity, for a model that names one.

    Explicit models are solved for it: by a closed form of their own, in one step where it enters
    linearly, else by damped Newton steps from several starts. Implicit models compute it directly.
    """

    model: Model

    def __post_init__(self) -> None:
        """Refuse what has no inverse, sample by sample."""
        if self.model.traced.corrected is None:
            name = self.model.name
            if self.model.traced.integrates:
                raise UsageError(
                    f"{name} tells how states go on, not what a reading should have been: there is "
                    "nothing to correct; casest apply RESULT RECORD follows its states along a "
                    "record, and casest simulate makes one (--value NAME=… of the result)"
                )
            raise UsageError(f"model {name} names no corrected quantity: Residual(…)")
        left = invertible(self.model)[1]
        if left:
            raise UsageError(
                f"model {self.model.name} has an effect on the sequence of samples, on rates, or "
                f"one that describes a record ({', '.join(left)}): {LEFT.rpartition(':')[0]}; "
                "`invertible` gives the model without it"
            )
        if not self.model.implicit and not ca.depends_on(
            ca.vec(self._cut.expression), ca.vec(self._wanted)
        ):
            raise UsageError(
                f"model {self.model.name}: what is predicted does not depend on {self.name}, which "
                "corrected= names, so that no reading says anything of it: compute the prediction "
                "from what quantity(…) returned"
            )
        if not self.signals or self._changes_nothing():
            what = f"is {self.signals[0].name} as it is given" if self.signals else "is no signal's"
            raise UsageError(
                f"model {self.model.name}: {self.name}, which corrected= names, {what}: there is "
                "nothing to correct; name the quantity that is computed from the reading, or of "
                "which the reading is predicted"
            )

    def _changes_nothing(self) -> bool:
        """Is the corrected quantity one of the signals, whatever the parameters are?"""
        if self.model.implicit:
            symbols, wanted = self.model.traced.symbols, ca.vec(self._wanted)
            given = [flat(symbols[s.name]) for s in self.signals]
            return any(g.shape == wanted.shape and (wanted - g).is_zero() for g in given)
        reading = flat(self._cut.symbols[str(self._cut.measured)])
        wanted = ca.vec(self._wanted)
        same = self.model.inverter is None and wanted.shape == reading.shape
        rest = self._cut.expression
        return same and ca.simplify(ca.substitute(rest, self._wanted, reading)).is_zero()

    @property
    def name(self) -> str:
        """Name of the corrected quantity."""
        return str(self.model.traced.corrected)

    @cached_property
    def _cut(self) -> Traced:
        return trace(self.model, cut=self.name)

    @cached_property
    def _wanted(self) -> SX:
        """The corrected quantity: a free symbol (explicit), or its expression (implicit).

        Of an explicit model it is what goes into the effects on it, of an implicit one what comes
        out of them: that is what the residual compares.
        """
        if self.model.implicit:
            return ca.SX(self.model.traced.quantities[self.name].value)
        return self._cut.quantities[self.name].declared

    @property
    def size(self) -> int:
        """Number of components of the corrected quantity."""
        return int(self._wanted.numel())

    @cached_property
    def signals(self) -> tuple[Signal, ...]:
        """The signals that the correction needs: not all that a fit needs."""
        if self.model.implicit:
            needed = reached_signals(self.model, self.model.traced, self._wanted)
        else:
            needed = reached_signals(self.model, self._cut, self._cut.expression)
        return tuple(s for s in self.model.signals if s.name in needed)

    @cached_property
    def parameters(self) -> set[str]:
        """Names of the parameters that the correction needs."""
        if self.model.implicit:
            return reached_parameters(self.model, self.model.traced, self._wanted)
        return reached_parameters(self.model, self._cut, self._cut.expression)

    def __call__(
        self, run: Run, values: Mapping[str, Any], around: tuple[float, float] | None = None
    ) -> Array:
        """The corrected quantity of every sample, (N, size).

        `around` is the range it had in the fit: where several values give the same reading, the
        one nearest to its middle is taken. Raises DataError naming the row without any.
        """
        with np.errstate(all="ignore"):  # a trial step may leave the domain; results are checked
            return self._corrected(run, values, around)

    def _corrected(
        self, run: Run, values: Mapping[str, Any], around: tuple[float, float] | None
    ) -> Array:
        parameters = np.concatenate(self.model.point(values))
        blank = {s.name: np.zeros((len(run), s.size)) for s in self.model.signals}
        samples = np.hstack([run.signals.get(s.name, blank[s.name]) for s in self.model.signals])
        if self.model.implicit:
            replay = Replay(function_of(self.model, {"c": ca.densify(ca.vec(self._wanted))}))
            return replay(parameters, samples)[0][:, :, 0]
        if self.model.inverter is not None and not self.model.effects:
            return self._in_closed_form(run, parameters, samples)
        return self._solved(run, parameters, samples, around)

    def _in_closed_form(self, run: Run, parameters: Array, samples: Array) -> Array:
        """The model's own inverse; NaN outside its domain becomes an error that names the row."""
        traced = self.model.traced
        assert self.model.inverter is not None
        value = ca.vec(self.model.inverter(dict(traced.symbols), traced.reading))
        found = Replay(function_of(self.model, {"c": ca.densify(value)}))(parameters, samples)[0]
        self._refuse_unsolved(run, run.signals[str(traced.measured)], found[:, :, 0])
        return found[:, :, 0]

    def _solved(
        self, run: Run, parameters: Array, samples: Array, around: tuple[float, float] | None
    ) -> Array:
        rest, wanted = self._cut.expression, self._wanted
        if rest.numel() != wanted.numel():
            raise UsageError(
                f"model {self.model.name}: {rest.numel()} readings do not determine the "
                f"{wanted.numel()} components of {self.name}"
            )
        newton = self._newton()
        affine = self.affine
        reading = run.signals[str(self._cut.measured)]
        best = np.full((len(run), self.size), np.nan)
        middle = 0.0 if around is None else 0.5 * sum(around)
        for start in [np.zeros_like(best)] if affine else _starts(reading, best, around):
            found = _damped_newton(newton, parameters, samples, start, 1 if affine else STEPS)
            good = _solves(newton, parameters, samples, found, reading)
            closer = np.abs(found - middle).max(axis=1) < np.abs(best - middle).max(axis=1)
            better = good & (closer | np.isnan(best).any(axis=1))
            best[better] = found[better]
        self._refuse_unsolved(run, reading, best)
        return best

    def _newton(self) -> Replay:
        """(parameters, [sample, value]) -> step to the solution, and what is left."""
        step, rest = self._step(), self._cut.expression
        sample = ca.vertcat(sample_symbol(self.model, self._cut), self._wanted)
        outputs = [ca.densify(step), ca.densify(rest)]
        names = ["parameters", "sample"], ["step", "left"]
        return Replay(ca.Function("inverse", [self._point(), sample], outputs, *names))

    def _step(self) -> SX:
        rest, wanted = self._cut.expression, self._wanted
        return -ca.solve(ca.jacobian(rest, wanted), rest)

    def _point(self) -> SX:
        return ca.vertcat(self._cut.coordinates, self._cut.references)

    @property
    def affine(self) -> bool:
        """Does the reading depend linearly on the corrected quantity?"""
        rest, wanted = self._cut.expression, self._wanted
        return not ca.jacobian(ca.vec(ca.jacobian(rest, wanted)), wanted).nnz()

    def as_function(self) -> tuple[Literal["direct", "newton"], Any]:
        """How it is computed, for export, as a CasADi function.

        direct: (parameters, sample) -> corrected. newton: (parameters, [sample, trial value]) ->
        [step to the solution, what is left].
        """
        if self.model.implicit:
            return "direct", function_of(self.model, {"c": ca.densify(ca.vec(self._wanted))})
        if self.model.inverter is not None and not self.model.effects:
            traced = self.model.traced
            value = ca.vec(self.model.inverter(dict(traced.symbols), traced.reading))
            return "direct", function_of(self.model, {"c": ca.densify(value)})
        rest, wanted = self._cut.expression, self._wanted
        if rest.numel() != wanted.numel():
            raise UsageError(
                f"model {self.model.name}: {rest.numel()} readings do not determine the "
                f"{wanted.numel()} components of {self.name}"
            )
        sample, step = sample_symbol(self.model, self._cut), self._step()
        if self.affine:
            value = ca.densify(ca.substitute(step, wanted, ca.SX.zeros(wanted.numel())))
            return "direct", ca.Function("inverse", [self._point(), sample], [value])
        outputs = [ca.densify(ca.vertcat(step, rest))]
        trial = ca.vertcat(sample, wanted)
        return "newton", ca.Function("inverse", [self._point(), trial], outputs)

    def readings(self, values: Mapping[str, Any], wanted: Array) -> Array:
        """Readings (N, m) that an explicit model predicts for corrected values (N, size).

        Signals other than the reading are zero.
        """
        model, rest = self.model, ca.densify(self._cut.expression)
        sample = sample_symbol(model, self._cut)
        f = ca.Function("rest", [self._point(), sample, self._wanted], [rest])
        place = 0
        for s in model.signals:
            if s.name == self.measured:
                break
            place += s.size
        zero = np.zeros(sum(s.size for s in model.signals))
        one = zero.copy()
        one[place : place + rest.numel()] = 1.0
        point = np.concatenate(model.point(values))
        rows = []
        for value in wanted:
            # What is left is ± (reading − prediction): two readings tell which.
            a, b = (np.array(f(point, x, value)).ravel() for x in (zero, one))
            rows.append(-a / (b - a))
        return np.array(rows)

    @property
    def measured(self) -> str:
        """The signal that is compared with the prediction; empty for an implicit model."""
        return self.model.traced.measured or ""

    def _refuse_unsolved(self, run: Run, reading: Array, best: Array) -> None:
        bad = np.asarray(np.isnan(best).any(axis=1))
        if bad.any():
            row = int(np.argmax(bad))
            value = np.array2string(reading[row], precision=6)
            raise DataError(
                f"{run.file}: row {int(run.rows[row])}: reading {value} has no {self.name} in the "
                f"model ({int(bad.sum())} of {len(bad)} rows): it lies outside what the model can "
                "produce; remove the rows, or calibrate over a wider range"
            )


@lru_cache(maxsize=16)
def correction_of(model: Model) -> Correction:
    """The correction of a model, traced once: to correct, to export, to say how sure it is."""
    return Correction(model)


def _starts(reading: Array, like: Array, around: tuple[float, float] | None) -> list[Array]:
    """Where Newton's method begins: the range of the fit first, then the reading, then decades."""
    levels = [] if around is None else [0.5 * sum(around), around[0], around[1]]
    starts = [np.full_like(like, level) for level in levels]
    if reading.shape == like.shape:
        starts.append(reading.copy())
    return starts + [np.full_like(like, level) for level in (0.0, 1.0, -1.0, 100.0, -100.0)]


def _damped_newton(
    newton: Replay, parameters: Array, samples: Array, start: Array, steps: int
) -> Array:
    value = start
    step, left = _at(newton, parameters, samples, value)
    for _ in range(steps):
        share = np.ones((len(value), 1))
        for _ in range(HALVINGS if steps > 1 else 1):
            trial = value + share * step
            next_step, next_left = _at(newton, parameters, samples, trial)
            worse = ~(np.linalg.norm(next_left, axis=1) <= np.linalg.norm(left, axis=1))
            if steps == 1 or not worse.any():
                break
            share[worse] *= 0.5
        if steps > 1:
            trial[worse], next_step[worse] = value[worse], 0.0
            next_left[worse] = left[worse]
        moved = np.abs(trial - value)
        value, step, left = trial, next_step, next_left
        if np.all(moved <= 1e-14 * (1 + np.abs(value))):
            break
    return value


def _at(newton: Replay, parameters: Array, samples: Array, value: Array) -> tuple[Array, Array]:
    step, left = newton(parameters, np.hstack([samples, value]))
    return step[:, :, 0], left[:, :, 0]


def _solves(
    newton: Replay, parameters: Array, samples: Array, value: Array, reading: Array
) -> Array:
    """Which samples are solved to rounding of the reading."""
    left = _at(newton, parameters, samples, value)[1]
    close = np.abs(left) <= 1e-9 * (np.abs(reading).max() + 1e-300)
    return np.asarray(np.isfinite(value).all(axis=1) & close.all(axis=1))
