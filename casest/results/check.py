"""What `check` leaves: `check.json`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from msgspec import Struct

from casest.results.file import plain
from casest.results.result import Number, Reproduced, Result, reproduced
from casest.results.units import unit_table
from casest.validity.changes import Change
from casest.validity.chart import WEIGHT, Line
from casest.validity.check import Check, Date

#: The file in the folder of -o.
CHECK = "check.json"
#: What a change of the noise is called.
NOISE = "noise"


class Tested(Struct, frozen=True):
    """F test of the old parameters: T over `rank` has (rank, freedom) degrees of freedom.

    `level` is its chance of a false alarm.
    """

    statistic: Number
    rank: int
    freedom: Number
    p_value: Number
    level: float


class NoiseTested(Struct, frozen=True):
    """The noise before (or as it was `stated` of the record) and now, and the chance of as much
    where it is at most a tenth larger."""

    before: Number
    now: Number
    ratio: Number
    unit: str
    p_value: Number
    level: float
    another_colour: bool
    stated: bool = False


class Changed(Struct, frozen=True):
    """One number before and now; `std` after the repair, `std_before` as it was calibrated."""

    name: str
    before: Number
    now: Number
    std: Number
    std_before: Number
    unit: str


class Explained(Struct, frozen=True):
    """The smallest cause: in words, its parameters, the chance of what it leaves, and others that
    explain the record nearly as well."""

    what: str
    parameters: list[str]
    p_value: Number
    or_else: list[str]


class Recalibration(Struct, frozen=True):
    """The smallest one that repairs it: what to fit, what to hold, how many samples like these make
    it as sharp as it was, and the command."""

    fit: list[str]
    hold: list[str]
    samples: int
    kind: str
    command: str


class Condition(Struct, frozen=True):
    """A column that lies outside what the calibration saw: least and greatest then and now."""

    column: str
    before: list[float]
    now: list[float]


class Dated(Struct, frozen=True, kw_only=True):
    """One date's record under the old calibration."""

    data: str
    valid: bool
    p_value: Number
    test: Tested
    noise: NoiseTested
    changed: list[Changed]
    explained_by: Explained | None
    recalibrate: Recalibration | None
    conditions: list[Condition]


class Charted(Struct, frozen=True):
    """One unknown's control chart: the old value's standard deviation; shifts from that value, the
    standard deviation of each from its own noise, weighted mean, limit on either side, and the
    dates (from 0) beyond it."""

    name: str
    unit: str
    std_before: Number
    shift: list[Number]
    std: list[Number]
    mean: list[Number]
    limit: list[Number]
    out: list[int]


class Charts(Struct, frozen=True):
    """Exponentially weighted means, `weight` of the latest date: of each unknown, and the chance
    that all together are as far off while nothing changed, of each date; an alarm below `level`."""

    weight: float
    p_values: list[Number]
    level: float
    lines: list[Charted]


class Checked(Result, frozen=True, kw_only=True):
    """The content of `check.json`: of the last date, then all dates and the chart over them."""

    result: str
    data: list[str]
    valid: bool
    false_alarm_rate: float
    p_value: Number
    test: Tested
    noise: NoiseTested
    changed: list[Changed]
    explained_by: Explained | None
    recalibrate: Recalibration | None
    conditions: list[Condition]
    drifting: bool
    dates: list[Dated]
    chart: Charts
    notes: list[str]
    reproduce: Reproduced

    @property
    def what(self) -> list[str]:
        """What changed, in words: of the last date, and what drifts."""
        named = [line.name for line in self.chart.lines if len(self.dates) - 1 in line.out]
        drifts = f"a drift of {' and '.join(named) or 'a combination'}"
        return changes_of(self.dates[-1]) + ([drifts] if self.drifting else [])


def changes_of(date: Dated) -> list[str]:
    """What changed at a date, in words."""
    words = [date.explained_by.what] if date.explained_by else []
    if date.noise.p_value is not None and date.noise.p_value < date.noise.level:
        words.append(NOISE)
    return words


def checked_result(
    found: Check,
    *,
    model_name: str,
    result: str,
    data: Sequence[str],
    notes: Sequence[str],
    conditions: Sequence[Mapping[str, tuple[list[float], list[float]]]],
    command: str = "",
    recalibrating: Callable[[str, Sequence[str]], str] = lambda name, hold: "",
) -> Checked:
    """What `check` leaves; `recalibrating` makes the command that fits a file with some held."""
    units = unit_table(found.old.model, found.dates[0].runs)
    dates = [
        _dated(found, date, name, where, units, recalibrating)
        for date, name, where in zip(found.dates, data, conditions, strict=True)
    ]
    last = dates[-1]
    return Checked(
        model=model_name,
        result=result,
        data=list(data),
        valid=found.valid,
        false_alarm_rate=found.level,
        p_value=last.p_value,
        test=last.test,
        noise=last.noise,
        changed=last.changed,
        explained_by=last.explained_by,
        recalibrate=last.recalibrate,
        conditions=last.conditions,
        drifting=found.drifting,
        dates=dates,
        chart=_chart(found, units),
        notes=list(notes),
        reproduce=reproduced(command, data),
    )


def _dated(
    found: Check,
    date: Date,
    name: str,
    where: Mapping[str, tuple[list[float], list[float]]],
    units: Mapping[str, str],
    recalibrating: Callable[[str, Sequence[str]], str],
) -> Dated:
    noise, level = date.subject.noise, found.level / (4 if len(found.dates) > 1 else 2)
    change = date.change
    return Dated(
        data=name,
        valid=date.valid,
        p_value=plain(date.p_value),
        test=Tested(
            plain(date.test.statistic),
            date.test.rank,
            plain(date.test.freedom),
            plain(date.test.p_value),
            level,
        ),
        noise=NoiseTested(
            plain(noise.expected),
            plain(noise.sigma if np.isnan(noise.ratio) else noise.expected * noise.ratio),
            plain(noise.ratio),
            units["residual"],
            plain(noise.p_value),
            level,
            bool(noise.coloured),
            date.subject.old.model.noise is not None,
        ),
        changed=[
            Changed(m.name, m.before, m.after, plain(m.std), plain(m.std_before),
                    units.get(m.name, ""))
            for m in change.moved
        ] if change else [],
        explained_by=_explained(change) if change else None,
        recalibrate=_recalibration(date, change, name, recalibrating) if change else None,
        conditions=[Condition(column, was, now) for column, (was, now) in where.items()],
    )  # fmt: skip


def _explained(change: Change) -> Explained:
    return Explained(
        change.cause.label,
        list(change.cause.parameters),
        plain(change.rest.p_value),
        list(change.alike),
    )


def _recalibration(
    date: Date, change: Change, name: str, recalibrating: Callable[[str, Sequence[str]], str]
) -> Recalibration:
    fit = list(change.cause.parameters)
    model = date.subject.problem.model
    hold = [p.name for p in model.parameters if p.scope == "all" and p.name not in fit]
    kind = "rest intervals" if date.runs[0].spread else "samples"
    return Recalibration(fit, hold, change.samples, kind, recalibrating(name, hold))


def _chart(found: Check, units: Mapping[str, str]) -> Charts:
    lines = [_charted(line, units) for line in found.chart.lines]
    return Charts(WEIGHT, plain(found.chart.p_values), found.chart.level, lines)


def _charted(line: Line, units: Mapping[str, str]) -> Charted:
    def numbers(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> list[Number]:
        found: list[Number] = plain(values)
        return found

    return Charted(
        line.name,
        units.get(line.name, ""),
        plain(line.old),
        numbers(line.shift),
        numbers(line.std),
        numbers(line.mean),
        numbers(line.limit),
        [int(k) for k in line.out],
    )
