"""`estimate.plot()`: residuals, parameters, profiles, the sphere as a figure of Matplotlib."""

from __future__ import annotations

from typing import Any

import numpy as np

from casest.errors import UsageError, library
from casest.estimate.profile_likelihood import half_width
from casest.results.fitted import Fitted
from casest.results.poses import cap, flat

KINDS = ("residuals", "parameters", "correlation", "sphere", "profiles")


def plot(result: Fitted, what: str, over: str | None) -> Any:
    """The figure; see `Estimate.plot`."""
    if what not in KINDS:
        raise UsageError(f"plot({what!r}): there are {', '.join(map(repr, KINDS))}")
    if over is not None and what != "residuals":
        raise UsageError(f"over={over!r} is for plot('residuals'), not for {what!r}")
    figure = library("matplotlib.figure", "plot", "plot()").Figure(layout="constrained")
    if what == "residuals":
        _residuals(result, figure, over)
        return figure
    drawn = {"parameters": _parameters, "correlation": _correlation, "sphere": _sphere}
    drawn.get(what, _profiles)(result, figure)
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


def _sphere(result: Fitted, figure: Any) -> None:
    """Directions above and below, equal areas, before (grey) and after; colour: length's error."""
    poses = result.residuals.poses
    if poses is None:
        raise UsageError(f"plot('sphere'): {result.declared} corrects no vector of known length")
    axes = figure.subplots(1, 2)
    figure.set_size_inches(7.6, 3.6)
    off = 100 * (poses.corrected - 1)
    most = float(np.abs(off).max()) or 1.0
    rim, turn = cap(poses.empty, np.radians(poses.radius)), np.linspace(0, 2 * np.pi, 181)
    for axis, sign, title in zip(axes, (1, -1), ("z up", "z down"), strict=True):
        own = poses.directions[:, 2] * sign >= 0
        axis.plot(np.cos(turn), np.sin(turn), color="0.6", linewidth=0.8)
        raw = poses.before[poses.before[:, 2] * sign >= 0]
        axis.plot(*flat(raw), ".", color="0.7", markersize=3, label="reading")
        shown = axis.scatter(*flat(poses.directions[own]), c=off[own], s=16, cmap="RdBu_r",
                             vmin=-most, vmax=most, edgecolor="0.3", linewidth=0.4)  # fmt: skip
        axis.plot(*flat(np.where((rim[:, 2] * sign >= 0)[:, None], rim, np.nan)), "--", color="C1")
        axis.set(title=title, aspect="equal", xlabel="x", ylabel="y")
    figure.colorbar(shown, ax=axes, label="length off its median [%]", shrink=0.7)
    said = f"widest gap (dashed): {poses.radius:.0f}° around it; grey: readings before"
    figure.suptitle(said, fontsize="medium")


def _profiles(result: Fitted, figure: Any) -> None:
    """2·cost over σ² with each unknown held; dashed what its standard deviation assumes."""
    found = result.found
    if not result.trusted:
        raise UsageError("plot('profiles'): this estimate was refused, and has no noise to go by")
    columns = min(3, len(found.names))
    rows = -(-len(found.names) // columns)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    figure.set_size_inches(3 * columns, 2.2 * rows)
    for j, axis in enumerate(axes.flat):
        if j >= len(found.names):
            axis.set_visible(False)
            continue
        values, rise = found.profile(j)
        name, unit = found.names[j], result.unknown_units.get(found.names[j], "")
        shares = np.linspace(-1, 1, len(values))
        axis.plot(values, rise, ".-")
        axis.plot(values, 9 * shares**2, "--", color="0.5")
        axis.axhline(half_width(found.noise.degrees_of_freedom) ** 2, color="C1", linewidth=0.8)
        axis.set_xlabel(f"{name} [{unit or '1'}]")
        axis.locator_params(axis="x", nbins=4)
    figure.supylabel("rise of the cost over that of the noise (line: 95 %)", fontsize="medium")
