"""Stated noise of signals: standard deviations of readings, from words, numbers or columns."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from casest import units
from casest.declaration.symbols import Signal
from casest.errors import CasestError, UsageError
from casest.interface.sensor_covariance import Option, correlation, joint, matrix_in

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model
    from casest.declaration.shapes import Array

#: How the column with the standard uncertainty of another is called.
NAMED = ("u_{}", "{}_std")


#: What Python takes for each signal: 0.02, "4.5 mg", "2%", a column, one by axis, a covariance.
SensorNoise = Mapping[str, "float | str | Sequence[float] | Array"]


@dataclass(frozen=True)
class Said:
    """`sensor_noise={"v": 0.02}`, as the prompt says it."""

    name: str
    value: str
    flag: str = "sensor_noise"

    @property
    def text(self) -> str:
        """As it is said in errors."""
        return f"{self.name}={self.value}"

    def pair(self) -> tuple[str, str]:
        """Signals and their noise."""
        return self.name, self.value


def said(given: SensorNoise | None, model: Model) -> list[Option]:
    """What Python was given, in the prompt's words."""
    sizes = {signal.name: signal.size for signal in model.signals}
    options = list[Option]()
    for name, value in (given or {}).items():
        size = sum(sizes.get(one.strip(), 0) for one in str(name).split(","))
        options.append(Said(str(name), _words(str(name), value, size)))
    return options


def _words(name: str, value: object, size: int) -> str:
    """Words as they are; numbers of so many axes as a list, or as rows of a covariance."""
    if isinstance(value, str):
        return value
    rows = np.asarray(value, float)
    if size and rows.shape not in ((), (size,), (size, size)):
        raise UsageError(
            f"sensor_noise {name}: an array of shape {rows.shape} is no noise of one reading: give "
            f"one number, {size} by axis or a covariance {size} by {size}; what differs from "
            f"reading to reading is a column of the data: sensor_noise={{{name!r}: 'u_{name}'}}"
        )
    words = [",".join(repr(float(x)) for x in row) for row in np.atleast_2d(rows)]
    return ";".join(words)


def with_sensor_noise(
    model: Model, runs: Sequence[Run], given: Sequence[Option]
) -> tuple[Model, tuple[Run, ...]]:
    """The model and its runs with the noise that was stated, declared, or stands in columns."""
    from casest.leastsquares.stated import stated_noise

    noise, used, said = noise_of(model, runs, given)
    model, runs = stated_noise(model, runs, noise)
    return model, tuple(_without(run, used, said) for run in runs)


def noise_of(
    model: Model, runs: Sequence[Run], given: Sequence[Option], look: bool = True
) -> tuple[dict[str, list[Array]], set[str], list[str]]:
    """What options and columns say of the noise of signals, for each run: standard deviations or
    covariances; the columns that say it, and what is noted of those that nobody named, where they
    are to be `look`ed for."""
    known = {s.name: s for s in model.signals}
    noise: dict[str, list[Array]] = {}
    used: set[str] = set()
    correlated = list[Option]()
    for option in given:
        key, text = option.pair()
        names = [name.strip() for name in key.split(",")]
        for name in names:
            if name not in known:
                raise UsageError(
                    f"{option.flag} {option.text}: {model.name} has no signal {name!r}; it has "
                    f"{', '.join(known)}"
                )
        if ",".join(names) in noise:
            raise UsageError(f"{option.flag} {option.text}: the noise of {key} is stated twice")
        if len(names) == 1:
            noise[key] = [_of_run(option, text, known[key], run, used) for run in runs]
        elif text.startswith("@") or "," in text or ";" in text:
            own = [known[name] for name in names]
            noise[",".join(names)] = [joint(option, text, own, run, used) for run in runs]
        else:
            correlated.append(option)
    stated = [name for key in noise for name in key.split(",")]
    found = _found(model, runs, stated) if look else {}
    noise |= {name: arrays for name, (arrays, _) in found.items()}
    for option in correlated:
        _correlate(option, model, runs, noise, used)
    used |= {column for _, columns in found.values() for column in columns}
    said = [f"noise of {name} is {' '.join(columns)}" for name, (_, columns) in found.items()]
    return noise, used, said


def _correlate(
    option: Option,
    model: Model,
    runs: Sequence[Run],
    noise: dict[str, list[Array]],
    used: set[str],
) -> None:
    """Two signals of one number each, with a correlation in place of a covariance."""
    key, text = option.pair()
    names = [name.strip() for name in key.split(",")]
    stds = []
    for name in names:
        signal = model[name]
        declared = None if signal.std is None else [np.array([signal.std])] * len(runs)
        own = noise.pop(name, declared)
        if own is None or signal.size > 1 or len(names) != 2:
            raise UsageError(
                f"{option.flag} {option.text}: a correlation is that of two signals of one number "
                f"each whose standard deviations are stated too; else give a covariance: rows a,b;"
                "c,d, @FILE, or columns of its lower triangle"
            )
        stds.append(own)
    noise[",".join(names)] = [
        correlation(option, text, first, second, run, used)
        for first, second, run in zip(*stds, runs, strict=True)
    ]


def _without(run: Run, used: set[str], said: Sequence[str]) -> Run:
    """The run without the columns that tell its noise: they are the cause of nothing."""
    if not used:
        return run
    columns = {name: values for name, values in run.columns.items() if name not in used}
    return replace(run, columns=columns, notes=(*run.notes, *said))


def _of_run(option: Option, text: str, signal: Signal, run: Run, used: set[str]) -> Array:
    """Standard deviations (k,) or (N, k), or a covariance (1, k, k), in the signal's unit."""
    words = [word.strip() for word in text.split(",")]
    if all(word in run.columns for word in words):
        used.update(words)
        return np.stack([_column(word, signal, run) for word in words], axis=1)
    if text.startswith("@"):
        return _covariance(option, matrix_in(option, text[1:]), signal)
    try:
        if text[:1].isalpha() or text[:1] == "_":
            raise ValueError(text)
        if ";" in text:
            rows = [[float(cell) for cell in row.split(",")] for row in text.split(";")]
            return _covariance(option, np.array(rows), signal)
        numbers, unit = _numbers(words)
    except ValueError:
        there = ", ".join(run.columns) or "no more columns"
        raise UsageError(
            f"{option.flag} {option.text}: {text!r} is no number with a unit, no percentage, and "
            f"no column of {run.file or run.name}; it has {there}"
        ) from None
    except CasestError as error:
        raise type(error)(f"{option.flag} {option.text}: {error}") from None
    if not (numbers > 0).all() or not np.isfinite(numbers).all():
        raise UsageError(
            f"{option.flag} {option.text}: a standard deviation is above zero, and {text} is not"
        )
    if unit == "%" and run.units.get(signal.name) != "%":
        return _share(option, numbers / 100, signal, run)
    try:
        return numbers * _factor(unit, signal, run)
    except CasestError as error:
        raise type(error)(f"{option.flag} {option.text}: {error}") from None


def _covariance(option: Option, matrix: Array, signal: Signal) -> Array:
    """Rows of a covariance between a signal's axes, (1, k, k)."""
    if matrix.shape != (signal.size, signal.size):
        raise UsageError(
            f"{option.flag} {option.text}: {signal.name} has {signal.size} components, and the "
            f"covariance is {matrix.shape[0]} by {matrix.shape[1]}"
        )
    return matrix[None]


def _share(option: Option, share: Array, signal: Signal, run: Run) -> Array:
    """A share of each reading; a reading of zero has none."""
    found = np.abs(run.signals[signal.name]) * share
    bad = np.flatnonzero((found == 0).any(axis=1))
    if bad.size:
        row = int(np.asarray(run.rows)[bad[0]])
        raise UsageError(
            f"{option.flag} {option.text}: {signal.name} is zero in row {row} of "
            f"{run.file or run.name}, and a share of it no noise: give a number or a column"
        )
    return found


def one_number(option: Option, signals: Sequence[Signal]) -> tuple[str, float]:
    """A signal and its noise in motion: one number for all readings and axes, in its unit."""
    name, text = option.pair()
    own = next((s for s in signals if s.name == name), None)
    of = (own and own.unit) or ""
    try:
        value, unit = units.parse_quantity(text)
    except UsageError:
        value, unit = np.nan, None
    except CasestError as error:
        raise type(error)(f"{option.flag} {option.text}: {error}") from None
    if np.isnan(value) or (unit == "%" and of != "%"):
        raise UsageError(
            f"{option.flag} {option.text}: in motion a sensor's noise is one number for all its "
            f"readings and axes, and {text!r} is none: write {name}=0.02"
            + (f", or with a unit '{name}=0.02 {of}'" if of else "")
        )
    try:
        return name, value * (units.conversion(unit, of)[0] if unit and of else 1.0)
    except CasestError as error:
        raise type(error)(f"{option.flag} {option.text}: {error}") from None


def _numbers(words: Sequence[str]) -> tuple[Array, str | None]:
    """Numbers with one unit behind the last."""
    last, unit = units.parse_quantity(words[-1])
    return np.array([*(float(word) for word in words[:-1]), last]), unit


def _factor(unit: str | None, signal: Signal, run: Run) -> float:
    """From a stated unit to that of the signal, as a difference."""
    own = signal.unit or run.units.get(signal.name)
    if not unit or not own or unit == own:
        return 1.0
    return units.conversion(unit, own)[0]


def _column(name: str, signal: Signal, run: Run) -> Array:
    values = run.columns[name]
    if not np.issubdtype(values.dtype, np.number):
        raise UsageError(f"{run.file}: column {name} holds text, no standard deviations")
    return np.asarray(values, float) * _factor(run.column_units.get(name), signal, run)


def _found(
    model: Model, runs: Sequence[Run], stated: Collection[str]
) -> dict[str, tuple[list[Array], tuple[str, ...]]]:
    """Noise in columns named after a signal, `u_x` or `x_std`; of all that carry noise, or none.

    What a declaration says of a signal counts where there is no column.
    """
    found = {}
    for signal in model.readings:
        if signal.name in stated:
            continue
        for columns in _candidates(signal):
            if all(column in run.columns for run in runs for column in columns):
                arrays = [np.stack([_column(c, signal, r) for c in columns], axis=1) for r in runs]
                found[signal.name] = (arrays, columns)
                break
    measured = model.traced.measured
    every = {*found, *stated}
    complete = measured in every if measured else bool(every)
    return found if complete else {}


def _candidates(signal: Signal) -> Iterator[tuple[str, ...]]:
    ends = ("",) if signal.size == 1 else ("x", "y", "z")[: signal.size]
    for form in NAMED:
        yield tuple(form.format(signal.name + end) for end in ends)
    if signal.size > 1:
        yield from ((form.format(signal.name),) for form in NAMED)
