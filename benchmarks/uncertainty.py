"""Lines, curves and corrected readings with uncertainty: ODRPACK and GTC beside casest.

    pip install odrpack gtc
    python benchmarks/uncertainty.py [POINTS]

All get the same numbers; each x and each y has a standard uncertainty of its own. Times are of the
processor, medians of alternating runs in one process, each of a new table, after a first one that
is not counted; casest's have the reading of the table, the second opinions and the certificate in
them. GTC is given fewer points, of which it takes seconds. What is not installed is left out.
"""

from __future__ import annotations

import statistics
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

import casest as c
from casest.correction import runtime
from casest.correction.numpy_module import as_data
from casest.correction.spread import slopes, spread_program

warnings.simplefilter("ignore", DeprecationWarning)  # scipy.odr is on its way out
REPEATS, FEW = 9, 200


@dataclass(frozen=True)
class Table:
    """Points (N,) with the standard uncertainty of each."""

    x: Any
    y: Any
    ux: Any
    uy: Any


@dataclass(frozen=True)
class Answer:
    """Values, and their standard deviations to first order."""

    values: Any
    std: Any


@c.model
def line(x=c.signal("1"), y=c.signal("1"), *, a=c.param("1"), b=c.param("1", start=1.0)):
    """A straight line."""
    truth = c.quantity("truth", x, "1")
    return c.Residual(measured=y, predicted=a + b * truth, corrected=truth)


@c.model
def growth(x=c.signal("1"), y=c.signal("1"), *, a=c.param("1", start=1.0), b=c.param("1")):
    """An exponential."""
    return c.Residual(measured=y, predicted=a * c.exp(b * x))


def made(curve: Callable[..., Any], truth: list[float], n: int, seed: int) -> Table:
    """Points of a curve between 0 and 3."""
    rng = np.random.default_rng(seed)
    x = np.linspace(0, 3, n)
    ux, uy = 0.05 + 0.05 * rng.random(n), 0.1 + 0.1 * rng.random(n)
    y = curve(x, truth) + uy * rng.standard_normal(n)
    return Table(x + ux * rng.standard_normal(n), y, ux, uy)


def by_casest(model: c.Model, table: Table) -> Answer:
    """Without what curvature adds to a standard deviation: the others do not know it."""
    data = {"x": table.x, "y": table.y, "u_x": table.ux, "u_y": table.uy}
    found = c.calibrate(model, data)
    return Answer(found.point.x, np.sqrt(np.diag(found.covariance - found.shift)))


def by_scipy(curve: Callable[..., Any], start: list[float], table: Table) -> Answer:
    """ODRPACK 2.01 by `scipy.odr`."""
    from scipy import odr

    data = odr.RealData(table.x, table.y, sx=table.ux, sy=table.uy)
    found = odr.ODR(data, odr.Model(lambda b, x: curve(x, b)), beta0=start).run()
    return Answer(found.beta, np.sqrt(np.diag(found.cov_beta)))


def by_odrpack(curve: Callable[..., Any], start: list[float], table: Table) -> Answer:
    """ODRPACK95 by `odrpack`."""
    from odrpack import odr_fit

    weights = {"weight_x": table.ux**-2, "weight_y": table.uy**-2}
    found = odr_fit(curve, table.x, table.y, np.array(start), **weights)
    return Answer(found.beta, np.sqrt(np.diag(found.cov_beta)))


def by_gtc(table: Table) -> Answer:
    """A line by weighted total least squares (Krystek & Anton 2011)."""
    from GTC import type_b, ureal

    x = [ureal(*both) for both in zip(table.x, table.ux, strict=True)]
    y = [ureal(*both) for both in zip(table.y, table.uy, strict=True)]
    both = type_b.line_fit_wtls(x, y).a_b
    return Answer(np.array([p.x for p in both]), np.array([p.u for p in both]))


def corrected_by_casest(found: c.Estimate, table: Table) -> Answer:
    """x of new readings of y, by the calibration's values."""
    reading, (a, b) = table.y[:, None], found.point.x
    program = spread_program(found, slopes(found, {}), {}, "truth")
    got = (reading - a) / b
    spread = runtime.attempted(as_data(program), np.hstack([reading, got]))
    return Answer(got[:, 0], spread[:, -1])  # the last: of all causes together


def corrected_by_gtc(found: c.Estimate, table: Table) -> Answer:
    """The same, with a and b as they were found."""
    from GTC import multiple_ureal, set_correlation, ureal

    a, b = multiple_ureal(found.point.x, np.sqrt(np.diag(found.covariance)), np.inf)
    set_correlation(found.covariance[0, 1] / np.sqrt(np.prod(np.diag(found.covariance))), a, b)
    got = [(ureal(*both) - a) / b for both in zip(table.y, table.uy, strict=True)]
    return Answer(np.array([g.x for g in got]), np.array([g.u for g in got]))


def compared(
    what: str, ways: dict[str, Callable[[Table], Answer]], tables: Sequence[Table]
) -> None:
    """A line for each way: its time, and how far it is from the first one's answers at most."""
    took: dict[str, list[float]] = {name: [] for name in ways}
    apart, std = dict.fromkeys(ways, 0.0), dict.fromkeys(ways, 0.0)
    for table in tables:
        found = {}
        for name, way in ways.items():
            began = time.process_time()
            found[name] = way(table)
            took[name].append(time.process_time() - began)
        first = next(iter(found.values()))
        for name, answer in found.items():
            away = np.max(np.abs(answer.values - first.values) / first.std)
            apart[name] = max(apart[name], float(away))
            std[name] = max(std[name], float(np.max(np.abs(answer.std / first.std - 1))))
    for name in ways:
        milliseconds = 1e3 * statistics.median(took[name][1:])
        print(f"| {what} | {name} | {milliseconds:.3g} | {apart[name]:.1e} | {std[name]:.1e} |")


def main(n: int = 10_000) -> None:
    """All of it."""
    curves = {
        "line": (line, lambda x, b: b[0] + b[1] * x, [1.0, 2.0], [0.0, 1.0]),
        "exponential": (growth, lambda x, b: b[0] * np.exp(b[1] * x), [2.0, 0.7], [1.0, 0.5]),
    }
    print("| what | by | ms of the processor | values apart, std | std apart, relative |")
    print("| --- | --- | --- | --- | --- |")
    seeds = range(1, REPEATS + 2)
    for name, (model, curve, truth, start) in curves.items():
        ways = {"casest": partial(by_casest, model)}
        if find_spec("scipy.odr"):
            ways["scipy.odr"] = partial(by_scipy, curve, start)
        if find_spec("odrpack"):
            ways["odrpack"] = partial(by_odrpack, curve, start)
        compared(f"{name}, {n} points", ways, [made(curve, truth, n, seed) for seed in seeds])
    if find_spec("GTC"):
        few, all_ = ([made(*curves["line"][1:3], k, seed) for seed in seeds] for k in (FEW, n))
        compared(f"line, {FEW} points", {"casest": partial(by_casest, line), "GTC": by_gtc}, few)
        data = {"x": all_[0].x, "y": all_[0].y}
        found = c.calibrate(line, data, sensor_noise={"x": 0.08, "y": 0.15})
        same = [Table(own.x, own.y, own.ux, np.full(n, 0.15)) for own in all_]
        ways = {
            "casest": partial(corrected_by_casest, found),
            "GTC": partial(corrected_by_gtc, found),
        }
        compared(f"{n} readings corrected", ways, same)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
