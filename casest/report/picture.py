"""The plot of `casest compare`: how near each solver came, against the time it took."""

from __future__ import annotations

from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from casest.data.write import write_atomically
from casest.errors import DataError, UsageError
from casest.results.comparison import RIGHT, Ended, SolversCompared

#: Okabe & Ito's colours, told apart by the colour-blind too; markers say the same again.
COLOURS = ("#0072B2", "#56B4E9", "#009E73", "#000000", "#D55E00", "#E69F00", "#CC79A7")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
GREY = "#555555"
#: Excesses below this many standard deviations are rounding, and drawn here.
FLOOR = 1e-6
#: Above this all are equally lost.
CEILING = 1e6


def draw(result: SolversCompared, folder: Path) -> list[Path]:
    """Write `compare.png` and `compare.svg`; returns their paths.

    Raises UsageError where matplotlib is missing, DataError where the folder cannot be written.
    """
    try:
        figure_of = import_module("matplotlib.figure").Figure
    except ImportError:
        raise UsageError(
            "no plot: matplotlib is not installed; pip install 'casest[plot]'"
        ) from None
    figure = figure_of(figsize=(8, 5), layout="constrained")
    axes = figure.add_subplot()
    _points(axes, result)
    _furniture(axes, result)
    paths = [folder / "compare.png", folder / "compare.svg"]
    try:
        for path in paths:
            drawn = BytesIO()
            figure.savefig(drawn, format=path.suffix[1:], dpi=150)
            write_atomically(path, drawn.getvalue())
    except DataError as error:
        raise DataError(f"no plot can be written: {error}") from None
    return paths


def _points(axes: Any, result: SolversCompared) -> None:
    """A large mark from the same start, small ones from the spread; open where it is not right."""
    own = [row for row in result.solvers if row.own_estimator]
    solvers = [row for row in result.solvers if not row.own_estimator]
    for k, row in enumerate(solvers):
        colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
        for trial in row.spread.trials:
            _mark(axes, result, trial, colour, marker, 22)
        if row.same_start is not None:
            _mark(axes, result, row.same_start, colour, marker, 90)
        axes.scatter([], [], s=60, color=colour, marker=marker, label=row.name)
    for k, row in enumerate(own, 1):
        if row.same_start is not None and np.isfinite(row.same_start.cost):
            _number(axes, k, row.same_start.seconds, _height(result, row.same_start))
            axes.scatter([], [], s=60, color=GREY, marker=f"${k}$", label=row.name)


def _number(axes: Any, k: int, x: float, y: float) -> None:
    """An estimator of the model's own: a dot with its number, even ones above it."""
    axes.scatter([x], [y], s=16, color=GREY)
    below = {"va": "top", "xytext": (3, -3)} if k % 2 else {"va": "bottom", "xytext": (3, 3)}
    axes.annotate(str(k), (x, y), textcoords="offset points", color=GREY, weight="bold", **below)


def _mark(
    axes: Any, result: SolversCompared, trial: Ended, colour: str, marker: str, size: float
) -> None:
    if not np.isfinite(trial.cost):
        return
    face = colour if trial.right else "none"
    height = _height(result, trial)
    axes.scatter(
        [trial.seconds], [height], s=size, marker=marker, facecolors=face, edgecolors=colour
    )


def _height(result: SolversCompared, trial: Ended) -> float:
    """√(2Δ)/σ: the cost's excess as a distance in standard deviations."""
    distance = float(np.sqrt(2 * max(trial.excess, 0.0))) / result.noise.sigma
    return float(np.clip(distance, FLOOR, CEILING))


def _furniture(axes: Any, result: SolversCompared) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(FLOOR / 3, CEILING * 3)
    axes.axhline(RIGHT, color=GREY, linestyle="--", linewidth=1)
    axes.annotate(
        "right below this line",
        (1, RIGHT),
        xycoords=("axes fraction", "data"),
        xytext=(-4, 4),
        textcoords="offset points",
        ha="right",
        fontsize="small",
        color=GREY,
    )
    axes.set_xlabel("time of one run [s]")
    axes.set_ylabel("cost excess √(2Δ)/σ [standard deviations]")
    start = "the automatic start" if result.same_start == "automatic" else "the start given"
    lost = sum(not np.isfinite(t.cost) for row in result.solvers for t in row.spread.trials)
    axes.set_title(
        f"{result.declared}: large from {start}, small from the spread;\n"
        f"filled: at the optimum, open: not{f'; {lost} gave no answer' if lost else ''}",
        fontsize="medium",
    )
    axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
