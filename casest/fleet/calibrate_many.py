"""Many small calibrations of one model at once: a production line, every sensor on its own.

The sensors are independent problems that share instructions, so each instruction is evaluated for
many of them in one NumPy call (`batch_sums`), and small matrices are factored side by side
(`batch_linear`). Every sensor has its own damping, its own certificate (`batch_judge`) and its own
verdict; no value of one depends on any other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Parameter
from casest.engine.threads import one_thread
from casest.errors import DataError, UsageError
from casest.estimate.calibrate import attempt
from casest.estimate.estimate import Estimate
from casest.estimate.reasons import Code
from casest.estimate.valley import searchable
from casest.fleet.fit import Bounds, Places, minimise, padded
from casest.fleet.judge import Judge
from casest.fleet.records import Records
from casest.fleet.sums import NARROWEST, Sensors, Squares, widest
from casest.fleet.valley import Doubt, Ended
from casest.fleet.verdicts import Verdicts
from casest.leastsquares.per_sample import residual_and_jacobian
from casest.leastsquares.weights import has_noise_effects

Values = Mapping[str, Array]
#: Names of the bounds of a parameter.
SIDES = ("lower", "upper")
#: `function(model, signals) -> {name: value (S, …) or (value, lower, upper)}`.
Start = Mapping[str, Any] | Callable[[Model, Values], Mapping[str, Any]]


@dataclass(frozen=True)
class Batch:
    """Calibrations of S sensors; every array has the sensor axis first.

    `values` and `std` by parameter, (S, …); `covariance` (S, n, n) of the unknowns `names`;
    `sigma` (S,) the standard deviation of one residual and `rmse` (S,), in the residual's unit;
    `trusted` (S,). Of a refused sensor every number is NaN, and `reasons[i]` says why; of a trusted
    one it says why it is believed. `misfit` (S,), if asked for: how probable a largest residual of
    that size is where nothing is wrong with the sensor.
    """

    model: Model
    names: tuple[str, ...]
    values: Values
    std: Values
    covariance: Array
    sigma: Array
    rmse: Array
    trusted: NDArray[np.bool_]
    reasons: Sequence[tuple[str, ...]]
    misfit: Array | None = None

    def __len__(self) -> int:
        """Return the number of sensors."""
        return len(self.trusted)

    def __str__(self) -> str:
        """Counts, and the first refused sensors with their reasons."""
        refused = np.flatnonzero(~self.trusted)
        lines = [f"{self.model.name}: {len(self) - len(refused)} of {len(self)} sensors trusted"]
        lines += [f"  sensor {i}: {self.reasons[i][0]}" for i in refused[:10]]
        return "\n".join(lines + (["  …"] if len(refused) > 10 else []))


def calibrate_many(
    model: Model,
    signals: Mapping[str, Any],
    *,
    start: Start | None = None,
    counts: Any = None,
    noise: float | None = None,
    retry: int = 0,
    misfit: bool = False,
) -> Batch:
    """Fit the model to each of S sensors, N samples each; every sensor has its own certificate.

    `signals` has for each signal an array (S, N, size), or (S, N) for one number, in the model's
    units. Where sensors have unequal numbers of samples, `counts` (S,) says how many of the N
    count; what follows them is not looked at.

    `start` gives start values by parameter, one for all or (S, …); or it is a function
    `(model, signals) -> {name: value}` that is called for some of the sensors at a time, such
    as `casest_problems.norm.closed_form_many`. In place of a value it may give a triple (value,
    lower, upper) where bounds depend on the data. Without it sensors start where the model says
    that many do (`model.starting(…, many=…)`: the shipped norm models), else from the declared
    values; bounds that the model computes from data are then asked for sensor by sensor, in Python.

    Of a model of differential equations each sensor is calibrated alone: `signals` has their times
    too, as `t` (S, N), in s where the model has no such signal; readings may be missing (NaN); and
    `start` gives plain values.

    Standard deviations and covariances are of JᵀJ at the solution or at most a tenth of a standard
    deviation from it: a fit that is as near takes its last step without summing JᵀJ again.

    Where a model's declared start may lie in a wrong valley, a sensor whose rows do not vouch for
    its fit is calibrated alone, as by `calibrate`: some tenths of a second each. A model with a
    start from the data, or linear in its unknowns, has none of these.

    `noise` is the standard deviation of one residual that a sound sensor has: one with
    significantly more is refused. Up to `retry` refused sensors are calibrated once more one by
    one, with IPOPT and second opinions. `misfit` asks of each whether its largest residual is
    larger than noise makes it (`fleet.outlying`), which costs a tenth of the time.

    The samples of a sensor are taken as independent of each other (poses, not a time series); from
    a hundred of them on a sensor whose neighbouring residuals are alike is refused.
    Raises UsageError for models with parameters per run, effects on the noise or on the sequence of
    samples, and directions or rotations among the unknowns; DataError for arrays of wrong shape.
    """
    check_model(model)
    readings, lengths = checked(model, signals, counts)
    size, samples = readings[0].shape[:2]
    result = _Result.empty(model, size, misfit)
    if model.traced.integrates:
        _each_alone(Records(model, readings, lengths, start, noise), result)
        return result.batch(model)
    job = _Job(model, readings, lengths, start or model.starter_of_many, noise, misfit)
    width = widest(samples)
    with np.errstate(all="ignore"), one_thread():
        for first in range(0, size, width):
            job.run(slice(first, min(first + width, size)), result)
        for i in np.flatnonzero(~result.verdicts.trusted)[:retry]:
            job.retry(int(i), result)
    return result.batch(model)


def _each_alone(records: Records, result: _Result) -> None:
    """Calibrate each record by itself; one that cannot be has its reason."""
    records.check_start()
    for i in range(len(records)):
        try:
            found = attempt(records.model, [records.run(i)], start=records.begin(i))
        except DataError as error:
            result.x[i] = result.std[i] = result.covariance[i] = np.nan
            result.verdicts.replace(i, Code.READING, (str(error),))
            continue
        result.take(i, found)
        if found.certificate.trusted:
            result.verdicts.ask(i, records.asked_of_many(found), found.noise.sigma)
    if result.misfit is not None:
        result.misfit[:] = np.nan  # it is asked of rows that stand for themselves


# -- what is asked for ---------------------------------------------------------------------------


def check_model(model: Model) -> None:
    """UsageError where many sensors of this model cannot be calibrated together."""
    curved = [p.name for p in model.parameters if p.shape.curved]
    if not model.parameters:
        raise UsageError(f"model {model.name} has nothing left to estimate; free something")
    if curved:
        raise UsageError(
            f"model {model.name} has the direction or rotation {curved[0]} among its unknowns, "
            "which calibrate_many cannot move; fix it, or call calibrate for each sensor"
        )
    if model.traced.integrates:  # each alone, as by calibrate
        return
    per_run = [p.name for p in model.parameters if p.scope == "run"]
    if per_run:
        raise UsageError(
            f"model {model.name} has a {per_run[0]} per run: calibrate_many takes one record of "
            f"each sensor; declare it shared with .scoped({per_run[0]!r}, 'all'), or call calibrate"
        )
    if model.traced.residual.constraints:
        raise UsageError(
            f"model {model.name} keeps to constraints, which calibrate_many does not; call "
            "calibrate for each sensor"
        )
    if model.sequential:
        raise UsageError(
            f"model {model.name} has an effect on the sequence of samples, which calibrate_many "
            "does not follow; call calibrate for each sensor"
        )
    if has_noise_effects(model):
        raise UsageError(
            f"model {model.name} has an effect on the noise, for which calibrate_many does not "
            "weigh samples; call calibrate for each sensor"
        )
    if any(s.std is not None for s in model.signals):
        raise UsageError(
            f"model {model.name} declares the std of a signal, by which calibrate_many does not "
            "weigh samples; leave it out, or call calibrate for each sensor"
        )
    if model.canonicaliser is not None:
        raise UsageError(
            f"model {model.name} chooses among equivalent values by a convention of its own, which "
            "calibrate_many does not apply; call calibrate for each sensor"
        )


def refuse_equations(model: Model, what: str) -> None:
    """UsageError for a model of differential equations: `what` is not for them."""
    if model.traced.integrates:
        raise UsageError(
            f"{what} differential equations ({model.name}): give the records to one fit, casest "
            "calibrate A.csv B.csv --per-run NAME"
        )


def checked(
    model: Model, signals: Mapping[str, Any], counts: Any
) -> tuple[list[Array], Array | None]:
    """Readings (S, N, size) in the model's order, and how many of each sensor count, (S,)."""
    unknown = set(signals) - {s.name for s in model.in_records}
    if unknown:
        raise UsageError(f"model {model.name} has no signal {sorted(unknown)[0]!r}")
    found: list[Array] = []
    for s in model.in_records:
        if s.name not in signals:
            raise UsageError(f"model {model.name} needs the signal {s.name!r}, (S, N, {s.size})")
        array = _array(s.name, signals[s.name])
        if array.ndim == 2 and s.size == 1:
            array = array[:, :, None]
        if array.ndim != 3 or array.shape[2] != s.size:
            raise DataError(
                f"signal {s.name} has shape {array.shape}: give (sensors, samples, {s.size})"
            )
        if found and array.shape[:2] != found[0].shape[:2]:
            raise DataError(
                f"signal {s.name} has {array.shape[0]} sensors of {array.shape[1]} samples, "
                f"{model.in_records[0].name} {found[0].shape[0]} of {found[0].shape[1]}"
            )
        found.append(array)
    if not found or 0 in found[0].shape:
        raise DataError("there are no sensors to calibrate: give arrays (sensors, samples, size)")
    return found, None if counts is None else _counted(counts, *found[0].shape[:2])


def _array(name: str, given: Any) -> Array:
    try:
        return np.asarray(given, dtype=np.float64)
    except ValueError:
        raise DataError(
            f"signal {name} is no array of numbers with one length for all sensors: fill the short "
            "ones up to (sensors, samples, size), and say counts= how many samples each has"
        ) from None


def _counted(counts: Any, size: int, samples: int) -> Array:
    found = np.asarray(counts, dtype=np.float64)
    if found.shape != (size,):
        raise DataError(f"counts has shape {found.shape}: give ({size},), one number per sensor")
    bad = np.flatnonzero(~((found >= 1) & (found <= samples) & (found == np.floor(found))))
    if bad.size:
        raise DataError(
            f"counts[{bad[0]}] is {found[bad[0]]:g}: give a whole number from 1 to {samples}"
        )
    return found


# -- a block of sensors ----------------------------------------------------------------------------


@dataclass
class _Result:
    """Arrays over all sensors, filled block by block."""

    x: Array
    std: Array
    covariance: Array
    sigma: Array
    rmse: Array
    verdicts: Verdicts
    misfit: Array | None

    @classmethod
    def empty(cls, model: Model, size: int, misfit: bool) -> _Result:
        n = sum(p.shape.size for p in model.parameters)
        verdicts = Verdicts.empty(entry_names(model), size)
        # In memory the sensors lie side by side, as in the blocks that come in.
        x, std = np.empty((2, n, size)).transpose(0, 2, 1)
        covariance = np.empty((n, n, size)).transpose(2, 0, 1)
        asked = np.empty(size) if misfit else None
        return cls(x, std, covariance, np.empty(size), np.empty(size), verdicts, asked)

    def take(self, i: int, found: Estimate) -> None:
        """What was found of sensor i alone."""
        self.x[i], self.covariance[i] = found.point.x, found.covariance
        self.std[i] = np.sqrt(np.diag(found.covariance))
        self.sigma[i], self.rmse[i] = found.noise.sigma, found.rmse
        self.verdicts.replace(i, found.certificate.code, found.certificate.reasons)

    def batch(self, model: Model) -> Batch:
        trusted = self.verdicts.trusted
        for array in (self.covariance, self.sigma, self.rmse, self.misfit):
            if array is not None:
                array[~trusted] = np.nan
        values, std = unpacked(model, self.x), unpacked(model, self.std)
        for array in (*values.values(), *std.values()):  # zeros of triangular matrices too
            array[~trusted] = np.nan
        return Batch(
            model,
            entry_names(model),
            values,
            std,
            self.covariance,
            self.sigma,
            self.rmse,
            trusted,
            self.verdicts,
            self.misfit,
        )


@dataclass
class _Job:
    """What all blocks have in common."""

    model: Model
    readings: list[Array]
    counts: Array | None
    start: Start | None
    noise: float | None
    misfit: bool
    squares: Squares = field(init=False)
    judge: Judge = field(init=False)
    doubt: Doubt | None = field(init=False)

    def __post_init__(self) -> None:
        self.squares = Squares(residual_and_jacobian(self.model))
        self.judge = Judge(self.model, self.squares, self.noise, self.misfit)
        stated = self.start is not None
        doubt = Doubt(self.model, self.squares, self.judge, stated)
        self.doubt = doubt if searchable(self.model) else None

    def run(self, span: slice, result: _Result) -> None:
        """Fit and judge the sensors of a block."""
        size = span.stop - span.start
        sensors = self._sensors(span)
        x, bounds = self._begin(span, sensors)
        fits = minimise(self.squares, sensors, x, bounds, near=self.start is not None)
        judged = self.judge(sensors, fits, bounds)
        result.x[span] = fits.x[:, :size].T
        result.std[span] = judged.std[:, :size].T
        result.covariance[span] = judged.covariance[:, :, :size].transpose(2, 0, 1)
        result.sigma[span] = judged.sigma[:size]
        result.rmse[span] = judged.rmse[:size]
        result.verdicts.put(span, judged)
        if result.misfit is not None and judged.misfit is not None:
            result.misfit[span] = judged.misfit[:size]
        if self.doubt is not None:
            ended = Ended(sensors, x, fits, bounds)
            doubtful = self.doubt(ended, judged, lambda k: self._as_run(span.start + k), size)
            self._one_by_one(span, ended, np.flatnonzero(doubtful), result)

    def _sensors(self, span: slice) -> Sensors:
        """Readings by column, the last sensor repeated up to a width that NumPy handles alike."""
        total, samples = span.stop - span.start, self.readings[0].shape[1]
        width = -(-total // NARROWEST) * NARROWEST
        found = np.empty((sum(r.shape[2] for r in self.readings), samples, width))
        first = 0
        for r in self.readings:
            found[first : first + r.shape[2], :, :total] = r[span].transpose(2, 1, 0)
            first += r.shape[2]
        mask = None
        if self.counts is not None:
            place = np.arange(samples)[:, None]
            mask = np.empty((samples, width))
            mask[:, :total] = place < self.counts[span]
            # The first sample takes the place of those that do not count: finite if it is.
            found = np.where(mask > 0, found, found[:, :1])
            mask[:, total:] = mask[:, total - 1 : total]
        found[:, :, total:] = found[:, :, total - 1 : total]
        return Sensors(found, mask)

    def _begin(self, span: slice, sensors: Sensors) -> tuple[Array, Bounds]:
        """Start values (n, W), inside bounds (n, W)."""
        given = self._given(span, sensors)
        width = sensors.samples.shape[2]
        x, lower, upper = [], [], []
        for p in self.model.parameters:
            value, low, high = _triple(given.get(p.name))
            value = p.shape.unpack(p.start_value()) if value is None else value
            if np.ndim(value) == 0 and p.shape.dims:  # a number for a matrix means its diagonal
                value = p.shape.unpack(p.shape.pack(value))
            x.append(_packed(p, value, width))
            lower.append(np.maximum(_packed(p, low, width), np.array(p.lower)[:, None]))
            upper.append(np.minimum(_packed(p, high, width), np.array(p.upper)[:, None]))
        bounds = Bounds(np.concatenate(lower), np.concatenate(upper))
        return bounds.inside(np.concatenate(x)), bounds

    def _given(self, span: slice, sensors: Sensors) -> dict[str, Any]:
        """Start values, and bounds from the data, as the user, his function or the model say."""
        given: dict[str, Any] = {}
        if callable(self.start):
            given = dict(self.start(self.model, self._views(sensors)))
        elif self.start is not None:
            given = dict(self.start)
        for name in set(given) - {p.name for p in self.model.parameters}:
            raise UsageError(f"model {self.model.name} has no parameter {name!r}")
        if not callable(self.start):
            given = {n: self._of_block(n, v, span) for n, v in given.items()}
        if self.model.limiter is None or any(isinstance(v, tuple) for v in given.values()):
            return given
        return self._limited(given, span)

    def _views(self, sensors: Sensors) -> dict[str, Array]:
        """Readings of a block by signal, (W, N, size)."""
        found, first = {}, 0
        for s in self.model.signals:
            found[s.name] = sensors.samples[first : first + s.size].transpose(2, 1, 0)
            first += s.size
        return found

    def _of_block(self, name: str, value: Any, span: slice) -> Any:
        """One value for all sensors as it is, else those of the block."""
        if isinstance(value, tuple):
            return tuple(self._of_block(name, v, span) for v in value)
        array, size = np.asarray(value, dtype=float), len(self.readings[0])
        dims = self.model[name].shape.dims
        if array.shape == (size, *dims):
            return array[span]
        if array.shape in ((), dims):
            return array
        raise UsageError(
            f"start[{name!r}] has shape {array.shape}: give {dims} for all sensors, or "
            f"{(size, *dims)}"
        )

    def _limited(self, given: dict[str, Any], span: slice) -> dict[str, Any]:
        """The same with the bounds that the model computes from data, sensor by sensor."""
        assert self.model.limiter is not None
        each = [self.model.limiter(self.model, (self._as_run(i),)) for i in _numbers(span)]
        found = dict(given)
        for name in each[0]:
            dims = self.model[name].shape.dims
            low, high = (
                np.array([np.broadcast_to(own[name][side], dims) for own in each])
                for side in (0, 1)
            )
            found[name] = (given.get(name), low, high)
        return found

    def _as_run(self, i: int) -> Run:
        """The record of one sensor."""
        stop = None if self.counts is None else int(self.counts[i])
        signals = {
            s.name: r[i, :stop] for s, r in zip(self.model.signals, self.readings, strict=True)
        }
        return Run.raw(f"sensor {i}", signals, units={s.name: s.unit for s in self.model.signals})

    def _one_by_one(self, span: slice, ended: Ended, places: Places, result: _Result) -> None:
        """Calibrate these of a block by themselves, from where they began."""
        for k in places:
            i, x = span.start + int(k), ended.begin[:, k]
            if self.start is None:
                self.retry(i, result)
                continue
            values = {n: v[0] for n, v in unpacked(self.model, x[None]).items()}
            self.retry(i, result, self._within(ended.bounds, int(k)), values)
        trusted = places[result.verdicts.trusted[span.start + places]]
        if not trusted.size:
            return
        trusted = padded(trusted)
        x = np.ascontiguousarray(result.x[span.start + trusted].T)
        judged = self.judge.asked_of_many(ended.sensors.some(trusted), x)
        for k, code, sigma in zip(trusted, judged.code, judged.sigma, strict=True):
            result.verdicts.ask(span.start + int(k), Code(int(code)), float(sigma))

    def _within(self, bounds: Bounds, k: int) -> Model:
        """The model with the bounds that a sensor's start brings."""
        lower, upper = (side[:, k] for side in bounds)
        declared = [np.concatenate([getattr(p, n) for p in self.model.parameters]) for n in SIDES]
        if np.array_equal(lower, declared[0]) and np.array_equal(upper, declared[1]):
            return self.model
        own = [unpacked(self.model, side[None]) for side in (lower, upper)]
        limits = {n: (own[0][n][0], own[1][n][0]) for n in own[0]}
        return self.model.bounded(lambda model, runs: limits)

    def retry(
        self,
        i: int,
        result: _Result,
        model: Model | None = None,
        start: Mapping[str, Array] | None = None,
    ) -> None:
        """Calibrate one sensor by itself; what that finds takes the place of what was found."""
        run = self._as_run(i)
        if not all(np.isfinite(values).all() for values in run.signals.values()):
            return
        try:
            found = attempt(model or self.model, [run], start=start)
        except DataError:  # too few samples, which the sensor's reasons say already
            return
        result.take(i, found)


def _numbers(span: slice) -> range:
    return range(span.start, span.stop)


def _triple(value: Any) -> tuple[Any, Any, Any]:
    """Value, lower and upper bound of what a start says of a parameter."""
    return value if isinstance(value, tuple) else (value, -np.inf, np.inf)


def _packed(parameter: Parameter, value: Any, width: int) -> Array:
    """Stored entries (size, W) of a value for all sensors or (k, …) for the first k of W."""
    dims = parameter.shape.dims
    array = np.asarray(value, dtype=float)
    if array.ndim == len(dims) + 1:
        if array.shape[1:] == (1,) * len(dims):
            array = np.broadcast_to(array, (len(array), *dims))
        if len(array) < width:
            array = np.concatenate([array, np.repeat(array[-1:], width - len(array), axis=0)])
    elif array.shape == () and dims:
        array = np.broadcast_to(array, dims)
    if array.shape[array.ndim - len(dims) :] != dims:
        raise UsageError(
            f"start of {parameter.name} has shape {array.shape}: give {dims} or (sensors, …)"
        )
    rows = np.stack([_entry(array, index) for index in parameter.shape.entries])
    return np.broadcast_to(rows.reshape(len(rows), -1), (len(rows), width))


def _entry(array: Array, index: tuple[int, ...]) -> Array:
    """One entry of every sensor's value, a view."""
    place: Any = (..., *index)
    return np.asarray(array[place])


def entry_names(model: Model) -> tuple[str, ...]:
    """Names of all unknowns, entry by entry."""
    return tuple(name for p in model.parameters for name in p.entry_names)


def unpacked(model: Model, x: Array) -> dict[str, Array]:
    """Values by parameter, (S, …), from the unknowns (S, n)."""
    found, first = {}, 0
    for p in model.parameters:
        value = np.zeros((len(x), *p.shape.dims))
        for k, index in enumerate(p.shape.entries):
            _entry(value, index)[:] = x[:, first + k]
        found[p.name], first = value, first + p.shape.size
    return found
