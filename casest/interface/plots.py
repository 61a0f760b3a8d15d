"""`estimate.plot()`: residuals, parameters or their correlation as a figure of Matplotlib."""

from __future__ import annotations

from typing import Any

import numpy as np

from casest.errors import UsageError, library
from casest.results.fitted import Fitted

KINDS = ("residuals", "parameters", "correlation")


def plot(result: Fitted, what: str, over: str | None) -> Any:
    """The figure; see `Estimate.plot`."""
    if what not in KINDS:
        raise UsageError(f"plot({what!r}): there are {', '.join(map(repr, KINDS))}")
    if over is not None and what != "residuals":
        raise UsageError(f"over={over!r} is for plot('residuals'), not for {what!r}")
    figure = library("matplotlib.figure", "plot", "plot()").Figure(layout="constrained")
    if what == "residuals":
        _residuals(result, figure, over)
    else:
        (_parameters if what == "parameters" else _correlation)(result, figure)
    return figure


def _residuals(result: Fitted, figure: Any, over: str | None) -> None:
    """One row for each axis: every fit over time, place in the record, or a column or quantity."""
    found = result.residuals
    known = {v.name: v for v in found.variables}
    if over is not None and over not in known:
        raise UsageError(f"plot(over={over!r}): the residual is known over {', '.join(known)}")
    timed = all(run.time is not None for run in found.runs)
    x, label = np.arange(sum(map(len, found.runs)), dtype=float), f"{found.kind} number"
    if over is not None:
        x, label = known[over].values, f"{over} [{known[over].unit or '1'}]"
    elif timed and len(found.runs) == 1:
        x, label = np.asarray(found.runs[0].time, float), "t [s]"
    axes = figure.subplots(len(found.axes), 1, sharex=True, squeeze=False)[:, 0]
    for a, (axis, name) in enumerate(zip(axes, found.axes, strict=True)):
        for side in found.sides:
            y = np.concatenate(side.residuals)[:, a]
            axis.plot(x, y, ".", markersize=3, label=side.name)
        axis.axhspan(-1.96 * found.sigma[a], 1.96 * found.sigma[a], color="0.5", alpha=0.2)
        axis.set_ylabel(f"{name} [{found.unit}]")
    axes[-1].set_xlabel(label)
    if len(found.sides) > 1:
        axes[0].legend()


def _parameters(result: Fitted, figure: Any) -> None:
    """Every number with its 95 % interval, one small axis each: their units differ."""
    entries = result.entries
    axes = figure.subplots(len(entries), 1, squeeze=False)[:, 0]
    figure.set_size_inches(6.4, 0.6 + 0.55 * len(entries))
    for axis, e in zip(axes, entries, strict=True):
        axis.errorbar([e.value], [0], xerr=[[e.below], [e.above]], fmt="o", capsize=3)
        axis.set_yticks([0], [f"{e.name} [{e.unit or '1'}]"])


def _correlation(result: Fitted, figure: Any) -> None:
    found = result.correlation
    axis = figure.subplots()
    matrix = np.array(found.matrix, dtype=float)
    shown = axis.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    axis.set_xticks(range(len(found.names)), found.names, rotation=90)
    axis.set_yticks(range(len(found.names)), found.names)
    figure.colorbar(shown, label="correlation")
