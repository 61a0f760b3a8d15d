"""The picture on the front page: the shipped wheel's residual before and after the loop.

python docs/picture.py        # writes docs/pictures/closing.svg
"""

from __future__ import annotations

import itertools
from pathlib import Path

import matplotlib

matplotlib.use("svg")

import matplotlib.pyplot as plt
import numpy as np

from casest import close, load_runs
from casest.leastsquares.problem import Problem
from casest_problems.wheel import wheel

HERE = Path(__file__).resolve().parent
COLOURS = {"before": "#b5442e", "after": "#2a6f97"}
BINS = 40
#: Of the shipped record (casest/demo/wheel_truth.json), m/s².
TRUTH = (0.35, -0.20, 0.15)


def main() -> None:
    """Fit, close the loop, draw."""
    runs = load_runs([HERE.parent / "casest" / "demo" / "wheel.csv"], wheel.signals)
    closing = close(wheel, runs)
    style = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
    plt.rcParams.update({**style, "svg.hashsalt": "casest", "font.family": "sans-serif"})
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 2.5), width_ratios=(1.5, 1))
    turn = wheel_angle(closing)
    for k, (found, name) in enumerate(((closing.before, "before"), (closing.after, "after"))):
        problem = Problem(found.model, tuple(closing.runs))
        residual = problem.residuals(problem.point(found.values))[0][:, 0]
        drawn = {"fmt": "o", "color": COLOURS[name], "label": name}
        left.errorbar(*by_angle(turn, 1e3 * residual), ms=3, lw=0.8, **drawn)
        error = found.values["offset"] - TRUTH
        right.errorbar(np.arange(3) + 0.16 * (k - 0.5), error, 2 * found.std["offset"], **drawn)
    for axes in (left, right):
        axes.axhline(0, color="0.6", lw=0.6)
    left.set(xlabel="angle of the wheel (degrees)", ylabel="mean residual, x (mm/s²)")
    left.set_xticks(range(0, 361, 90))
    left.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 0.98), borderpad=0)
    right.set(xlabel="axis", ylabel="error of the offset (m/s²)", xlim=(-0.5, 2.5))
    right.set_xticks(range(3), ["x", "y", "z"])
    figure.tight_layout()
    (HERE / "pictures").mkdir(exist_ok=True)
    figure.savefig(HERE / "pictures" / "closing.svg", metadata={"Date": None})


def wheel_angle(closing):
    """Angle of the wheel at each sample, degrees in one turn, from the fit before."""
    t, values = closing.runs[0].signals["t"][:, 0], closing.before.values
    powers = sum(values["speed"][k] * t ** (k + 1) / (k + 1) for k in range(4))
    return np.degrees(np.mod(float(values["phase"]) + powers, 2 * np.pi))


def by_angle(turn, residual):
    """Middles of BINS bins, mean residual in each, and twice its standard error."""
    edges = np.linspace(0, 360, BINS + 1)
    groups = [residual[(turn >= a) & (turn < b)] for a, b in itertools.pairwise(edges)]
    error = [2 * g.std() / np.sqrt(len(g)) for g in groups]
    return 0.5 * (edges[1:] + edges[:-1]), [g.mean() for g in groups], error


if __name__ == "__main__":
    main()
