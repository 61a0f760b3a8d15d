"""`check`: the verdict over one date, or many with a control chart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from casest.data.run import Run
from casest.declaration.model import Model
from casest.validity.changes import Change, changed
from casest.validity.chart import Chart, chart
from casest.validity.judged import Subject, Test, judged, subject_of
from casest.validity.old import Old


@dataclass(frozen=True)
class Date:
    """One new record under the old calibration: did its parameters move, is it louder?"""

    runs: tuple[Run, ...]
    subject: Subject
    test: Test
    moved: bool
    louder: bool

    @cached_property
    def change(self) -> Change | None:
        """What changed, where the parameters moved; looked for when asked."""
        return changed(self.subject) if self.moved else None

    @property
    def valid(self) -> bool:
        """Does nothing speak against the old calibration?"""
        return not (self.moved or self.louder)

    @property
    def p_value(self) -> float:
        """Chance of as much while nothing changed, of both tests together (Bonferroni)."""
        return min(1.0, 2 * min(self.test.p_value, self.subject.noise.p_value))


@dataclass(frozen=True)
class Check:
    """All dates in their order, the chart over several, and whether the last is still in order."""

    old: Old
    level: float
    dates: tuple[Date, ...]
    chart: Chart

    @property
    def drifting(self) -> bool:
        """Is a weighted mean over several dates beyond its limit at the last one?"""
        last = len(self.dates) - 1
        return last > 0 and self.chart.out(last)

    @property
    def valid(self) -> bool:
        """Is the old calibration valid at the last date?"""
        return self.dates[-1].valid and not self.drifting


def check(
    old: Old,
    records: Sequence[tuple[Run, ...]],
    level: float = 1e-3,
    say: Callable[[str], None] = lambda text: None,
    models: Sequence[Model] = (),
) -> Check:
    """Judge the records of one or several dates, each by itself, and all of them by a chart.

    `level`: chance of a false alarm at a date. Half of it is the parameters' and half the noise's;
    with several dates the chart has a half of it all. `models`: that of each record, where what
    its noise is was stated (`stated_noise`).
    """
    own = level / 2 if len(records) > 1 else level
    dates = []
    for k, runs in enumerate(records):
        say(f"asking {runs[0].file or runs[0].name}")
        dates.append(_date(replace(old, model=models[k]) if models else old, runs, own))
    return Check(old, level, tuple(dates), chart([d.subject for d in dates], level / 2))


def _date(old: Old, runs: tuple[Run, ...], level: float) -> Date:
    subject = subject_of(old, runs)
    test = judged(subject)
    moved = test.p_value < level / 2
    louder = subject.noise.p_value < level / 2
    return Date(runs, subject, test, moved, louder)
