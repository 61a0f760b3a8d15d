"""Figures of residuals: over time, over each column and quantity, spectrum, autocorrelation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from casest.data.run import Index
from casest.declaration.shapes import Array
from casest.report.html.figures import BAND, Figures, axis, panel
from casest.report.html.frequency import over_frequency
from casest.report.html.page import details, paragraph, tag
from casest.results.residuals import Residuals, Variable

#: Samples that are drawn one by one; from this many on least and greatest of groups are kept.
WHOLE = 120_000
#: Up to this many samples are drawn as points; bins of a dependence, and samples in one at least.
POINTS, BINS, IN_BIN = 300, 30, 15
#: Variables that are shown at once; the others are folded away.
AT_ONCE = 1


def residual_figures(residuals: Residuals, figures: Figures) -> str:
    """All figures of the residual, or why one is missing: what tells something comes first."""
    whole = over_time(residuals, figures)
    return "".join(
        [
            over_variables(residuals, figures),
            *over_frequency(residuals, figures),
            details("Every residual over time", whole) if _binned(residuals) else whole,
        ]
    )


def convincing(residuals: Residuals, figures: Figures) -> str:
    """The residual over what it depends on most, on the axis where it does; empty without any."""
    found = [
        (_dependence_of(residuals, v, a), -k, a, v)
        for k, v in enumerate(residuals.variables)
        for a in range(len(residuals.axes))
    ]
    if not found:
        return ""
    _, _, worst, variable = max(found, key=lambda f: f[:2])
    what = "mean of each bin" if _binned(residuals) else "every residual"
    name = f"Residual {residuals.axes[worst]}" if len(residuals.axes) > 1 else "Residual"
    caption = (
        f"{name} over {_shown(variable)}, on which it depends most:",
        f"{what}; shaded is what noise alone would do, 95 %.",
    )
    panels = _panels_over(residuals, variable, figures, [worst], height=240)
    return figures.add("convincing", caption, panels, two=len(residuals.sides) > 1)


def _label(residuals: Residuals, a: int) -> str:
    return residuals.of_axis("residual", a)


def _band(half: float) -> list[dict[str, float]]:
    return [{"low": -half, "high": half}] if np.isfinite(half) and half > 0 else []


# -- over time -------------------------------------------------------------------------------------


def over_time(residuals: Residuals, figures: Figures) -> str:
    """Every residual over time, the runs end to end."""
    x, label, unit, marks = _places(residuals)
    whole = [np.concatenate(side.residuals) for side in residuals.sides]
    breaks = _breaks(residuals)
    panels, outside = [], 0
    for a, side, title in residuals.panels():
        limit = _limit([w[:, a] for w in whole], residuals.sigma[a])
        y = np.concatenate(side.residuals)[:, a]
        outside += int(np.sum(np.abs(y) > limit))
        y = np.clip(y, -limit, limit)
        few = len(y) <= POINTS
        at, y = (x, y) if few else _with_breaks(x, y, breaks)
        at, y = _thinned(at, y)
        panels.append(
            panel(
                title,
                axis(label, unit, float(x.min()), float(x.max()), room=0.02 if few else 0.0),
                axis(_label(residuals, a), residuals.unit, -limit, limit, room=0.06),
                [figures.series("points" if few else "line", side.look, at, y=y)],
                bands=_band(BAND * residuals.sigma[a]),
                marks=marks,
            )
        )
    note = " Least and greatest value of each pixel are drawn." if len(x) > POINTS else ""
    if len(x) > WHOLE:
        note += f" Of {len(x)} samples, least and greatest of small groups are kept in this page."
    if outside:
        note += f" {outside} values further out are drawn at the edge."
    caption = (
        "Residual over time." if unit == "s" else f"Residual of every {residuals.kind}.",
        f"Shaded, between the dashes: the 95 % band of the noise.{note}",
    )
    return figures.add(
        "over-time", caption, panels, two=len(residuals.sides) > 1, zoom=len(x) > POINTS
    )


def _places(residuals: Residuals) -> tuple[Array, str, str, list[dict[str, Any]]]:
    """Where each sample stands, the axis's label and unit, and where runs begin."""
    several = len(residuals.runs) > 1
    timed = all(run.time is not None for run in residuals.runs)
    found, marks, begin = [], [], 0.0
    for run in residuals.runs:
        if timed and run.time is not None:
            place = run.time - run.time[0] if several else np.asarray(run.time, float)
        else:
            place = np.arange(len(run), dtype=float)
        found.append(place + begin)
        marks.append({"x": float(found[-1][0]), "name": run.name})
        begin = float(found[-1][-1]) + (float(np.median(np.diff(place))) if len(run) > 1 else 1.0)
    label = "time" if timed else f"{residuals.kind} number"
    if several:
        label += ", runs end to end"
    return np.concatenate(found), label, "s" if timed else "1", marks if several else []


def _breaks(residuals: Residuals) -> Index:
    """Samples before which a line is interrupted: a gap in time, or another run."""
    ends = np.cumsum([len(run) for run in residuals.runs])
    found = [
        np.flatnonzero(np.diff(run.block)) + 1 + end - len(run)
        for run, end in zip(residuals.runs, ends, strict=True)
        if not run.spread
    ]
    return np.unique(np.concatenate([*found, ends[:-1]])).astype(int)


def _with_breaks(x: Array, y: Array, breaks: Index) -> tuple[Array, Array]:
    if not len(breaks) or len(breaks) > len(x) / 10:
        return x, y
    middle = 0.5 * (x[breaks - 1] + x[breaks])
    return np.insert(x, breaks, middle), np.insert(y, breaks, np.nan)


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """Least and greatest of equal groups where there are too many samples for one page."""
    if len(x) <= WHOLE:
        return x, y
    group = -(-2 * len(x) // WHOLE)
    count = len(x) // group
    parts = np.where(np.isfinite(y), y, 0.0)[: count * group].reshape(count, group)
    at = x[: count * group].reshape(count, group)
    low, high = parts.min(axis=1), parts.max(axis=1)
    return at[:, [0, group // 2]].ravel(), np.column_stack([low, high]).ravel()


def _limit(residuals: Sequence[Array], sigma: float) -> float:
    """Half height of a panel: all values, but for a few far beyond the others."""
    size = np.abs(np.concatenate(residuals))
    size = size[np.isfinite(size)]
    if not size.size:
        return 1.0
    usual = 2.5 * float(np.quantile(size, 0.99))
    least = 1.2 * BAND * sigma if np.isfinite(sigma) else 0.0
    return max(min(float(size.max()), usual), least) or 1.0


# -- over columns and quantities -------------------------------------------------------------------


def over_variables(residuals: Residuals, figures: Figures) -> str:
    """The residual over each column, input and quantity, what it depends on most first."""
    ranked = sorted(residuals.variables, key=lambda v: -_dependence(residuals, v))
    if not ranked:
        return paragraph(
            "No column beside the signals and no quantity varies in these data: there is nothing "
            "to draw the residual over.",
            "soft",
        )
    if len(residuals.axes) == 1 and len(ranked) > 1:  # the first is the evidence already
        ranked = ranked[1:]
    drawn = [_over(residuals, v, k, figures) for k, v in enumerate(ranked)]
    more = drawn[AT_ONCE:]
    folded = details(f"More columns and quantities ({len(more)})", *more) if more else ""
    said = paragraph(
        "Each point is the mean residual of a bin of equally many samples; the shaded band holds "
        "95 % of such means if there is only noise. What the residual depends on most comes first."
        if _binned(residuals)
        else "Shaded: the 95 % band of the noise."
    )
    head = tag("h3", "Residual over each column and quantity")
    return head + said + "".join(drawn[:AT_ONCE]) + folded


def _binned(residuals: Residuals) -> bool:
    return sum(map(len, residuals.runs)) > POINTS


def _shown(variable: Variable) -> str:
    """A column's name; one that is a number is said to be one."""
    return f"column {variable.name}" if variable.name.isdigit() else variable.name


def _over(residuals: Residuals, variable: Variable, number: int, figures: Figures) -> str:
    panels = _panels_over(residuals, variable, figures, range(len(residuals.axes)))
    turn = " (one turn)" if variable.turns else ""
    nobody = "" if variable.unit else " Its unit is not stated."
    caption = (f"Over {_shown(variable)}{turn}.", nobody.strip())
    return figures.add(f"over-variable-{number}", caption, panels, two=len(residuals.sides) > 1)


def _panels_over(
    residuals: Residuals,
    variable: Variable,
    figures: Figures,
    axes: Sequence[int],
    height: int = 155,
) -> list[dict[str, Any]]:
    """Panels of some axes, before beside after."""
    name, unit, x = _shown(variable), variable.unit, variable.values
    panels = []
    for a, side, title in residuals.panels():
        if a not in axes:
            continue
        y = np.concatenate(side.residuals)[:, a]
        if _binned(residuals):
            at, mean, half = bins(x, y, residuals.sigma[a], residuals.correlated_over)
            top = _top(residuals, a, x)
            drawn = [
                figures.series("ribbon", "band", at, low=-half, high=half),
                figures.series("line", side.look, at, y=mean),
            ]
            bands = []
        else:
            top = _limit(
                [np.concatenate(s.residuals)[:, a] for s in residuals.sides], residuals.sigma[a]
            )
            drawn = [figures.series("points", side.look, x, y=np.clip(y, -top, top))]
            bands = _band(BAND * residuals.sigma[a])
        label = (
            _label(residuals, a).replace("residual", "mean")
            if _binned(residuals)
            else _label(residuals, a)
        )
        across = axis(name, unit, float(x.min()), float(x.max()), room=0.02)
        upright = axis(label, residuals.unit, -top, top, room=0.08)
        panels.append(panel(title, across, upright, drawn, bands=bands, height=height))
    return panels


def bins(
    x: Array, y: Array, sigma: float, correlated_over: float = 1.0
) -> tuple[Array, Array, Array]:
    """Centre, mean of y and half width of its 95 % band (B,) in bins of equally many samples."""
    count = int(np.clip(len(x) // IN_BIN, 1, BINS))
    edges = np.unique(np.quantile(x, np.linspace(0, 1, count + 1)))
    number = np.clip(np.searchsorted(edges, x, "right") - 1, 0, max(len(edges) - 2, 0))
    n = np.bincount(number)
    used = n > 0
    at = np.bincount(number, x)[used] / n[used]
    mean = np.bincount(number, np.nan_to_num(y))[used] / n[used]
    return at, mean, BAND * sigma * np.sqrt(correlated_over / n[used])


def _top(residuals: Residuals, a: int, x: Array) -> float:
    """Half height of the panels of an axis, the same before and after."""
    found = []
    for side in residuals.sides:
        _, mean, half = bins(
            x, np.concatenate(side.residuals)[:, a], residuals.sigma[a], residuals.correlated_over
        )
        found += [float(np.abs(mean).max()), float(np.nan_to_num(half).max())]
    return max(found) or 1.0


def _dependence(residuals: Residuals, variable: Variable) -> float:
    """That of the worst axis."""
    return max(_dependence_of(residuals, variable, a) for a in range(len(residuals.axes)))


def _dependence_of(residuals: Residuals, variable: Variable, a: int) -> float:
    """Mean square of the bins' means over that of noise, at first."""
    y = np.concatenate(residuals.sides[0].residuals)[:, a]
    _, mean, half = bins(variable.values, y, residuals.sigma[a], residuals.correlated_over)
    with np.errstate(all="ignore"):
        return float(np.nan_to_num(np.mean((mean / half) ** 2)))
