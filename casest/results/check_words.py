"""What `check` says of a date, in sentences that the prompt and the page share."""

from __future__ import annotations

from collections.abc import Iterator

from casest.data.logs import file_name
from casest.results.check import Checked, Dated


def reasons(date: Dated) -> Iterator[str]:
    """What was asked of a date, and the answers."""
    test, noise = date.test, date.noise
    yield (
        f"the parameters, as far as the record sees them ({test.rank} combinations): "
        f"p = {test.p_value:.2g}; an alarm below {test.level:.2g}"
    )
    unit = "" if noise.unit == "1" else f" {noise.unit}"
    if noise.ratio is None:
        yield f"the noise: {noise.now:.3g}{unit}; nothing is known of it before"
    else:
        that = "as stated" if noise.stated else "that of the calibration"
        yield (
            f"the noise: {noise.now:.3g}{unit}, {noise.ratio:.2f} times {that}: "
            f"p = {noise.p_value:.2g}; an alarm below {noise.level:.2g}"
        )
    if noise.another_colour:
        yield "the noise has another colour than in the calibration; the record's own is used"
    for place in date.conditions:
        yield (
            f"{place.column} is {place.now[0]:.4g} to {place.now[1]:.4g}; in the calibration it "
            f"was {place.before[0]:.4g} to {place.before[1]:.4g}"
        )


def repair(date: Dated) -> Iterator[str]:
    """What explains a record that the old parameters do not, and how it is repaired."""
    cause, again = date.explained_by, date.recalibrate
    if cause is None or again is None:
        return
    yield f"{cause.what} alone explains the record: with it p = {cause.p_value:.2g}"
    if cause.or_else:
        yield f"nearly as well: {', '.join(cause.or_else)}"
    hold = f", with {' and '.join(again.hold)} held" if again.hold else ""
    enough = f": {again.samples} {again.kind} like these make it as sharp as it was"
    yield f"{' and '.join(again.fit)} anew{hold}{enough if again.samples else ''}"


def drift(result: Checked) -> Iterator[str]:
    """What the chart over several dates says."""
    if len(result.dates) < 2:
        return
    p, level = result.chart.p_values[-1], result.chart.level
    yield f"the weighted means over the dates together: p = {p:.2g}; an alarm below {level:.2g}"
    last = len(result.dates) - 1
    for line in result.chart.lines:
        if last in line.out:
            since = result.dates[line.out[0]].data
            unit = "" if line.unit == "1" else f" {line.unit}"
            yield (
                f"{line.name}: the weighted mean of its shifts, {line.mean[-1]:.3g}{unit}, "
                f"is beyond ±{line.limit[-1]:.3g}, first on {file_name(since)}"
            )
