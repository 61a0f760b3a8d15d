"""Intervals of the likelihood where the cost is no parabola: brute force, simulation."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import t as student

from casest import Residual, Run, attempt, exp, model, param, signal
from casest.cli import run

DAYS = np.array([1.0, 1.5, 2.0, 3.0, 4.0, 5.0])
SIGMA = 12.0


@model
def demand(
    day=signal("d"),
    y=signal("mg/L"),
    *,
    end=param("mg/L", start=200.0),
    rate=param("1/d", start=0.5),
):
    """Biochemical oxygen demand: approaches its end exponentially."""
    return Residual(measured=y, predicted=end * (1 - exp(-rate * day)))


def first_guess(_model, runs):
    """The largest reading is near the end, which is half reached where readings are half of it."""
    y, day = runs[0].signals["y"][:, 0], runs[0].signals["day"][:, 0]
    half = np.interp(0.5 * y.max(), np.maximum.accumulate(y), day)
    return {"end": y.max(), "rate": 0.7 / max(half, 0.1)}


def observed(sigma, seed):
    rng = np.random.default_rng(seed)
    y = 213.8 * (1 - np.exp(-0.547 * DAYS)) + sigma * rng.standard_normal(len(DAYS))
    signals = {"day": DAYS[:, None], "y": y[:, None]}
    return Run.raw("bottle", signals, units={"day": "d", "y": "mg/L"})


def squares_at(rate, y):
    """Least sum of squares with the rate held: the end is linear."""
    shape = 1 - np.exp(-rate * DAYS)
    return float(np.sum((y - shape * (shape @ y) / (shape @ shape)) ** 2))


def interval_by_brute_force(y, rate):
    best = squares_at(rate, y)
    rise = student.ppf(0.975, 4) ** 2 * best / 4
    lowest, highest = 1e-3, 30.0
    return tuple(
        brentq(lambda r: squares_at(r, y) - best - rise, *ends)
        for ends in ((lowest, rate), (rate, highest))
    )


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_the_ends_are_where_brute_force_finds_them(seed):
    run = observed(SIGMA, seed)
    found = attempt(demand.starting(first_guess), [run])
    assert found.certificate.trusted, found.certificate.reasons
    assert found.certificate.profile is not None
    low, high = interval_by_brute_force(run.signals["y"][:, 0], float(found.values["rate"]))
    below, above = (float(reach["rate"]) for reach in found.interval_reach)
    assert float(found.values["rate"]) - below == pytest.approx(low, rel=0.01)
    assert float(found.values["rate"]) + above == pytest.approx(high, rel=0.01)


@pytest.mark.parametrize("records", [40, pytest.param(130, marks=pytest.mark.long)])
def test_of_a_hundred_intervals_95_hold_the_truth(records):
    """Parabola or not. Refused fits print no interval."""
    fits = [
        attempt(demand.starting(first_guess), [observed(SIGMA, seed)]) for seed in range(records)
    ]
    trusted = [f for f in fits if f.certificate.trusted]
    assert len(trusted) > 115 / 130 * records
    profiled = [f for f in trusted if f.certificate.profile is not None]
    assert len(profiled) > 30 / 130 * records
    held = np.array([[_holds(f, "rate", 0.547), _holds(f, "end", 213.8)] for f in trusted])
    share = held.mean(axis=0)
    assert np.all(np.abs(share - 0.95) < 3 * np.sqrt(0.95 * 0.05 / len(trusted))), share


def _holds(found, name, truth):
    below, above = (float(reach[name]) for reach in found.interval_reach)
    return -below <= truth - float(found.values[name]) <= above


def test_the_reason_says_that_intervals_are_those_of_the_likelihood():
    found = attempt(demand.starting(first_guess), [observed(SIGMA, 2)])
    assert "each unknown profiled" in found.certificate.reasons[-1]


def test_of_a_straight_line_nothing_is_profiled():
    @model
    def line(x=signal(), y=signal(), *, slope=param()):
        """Linear: its cost is a parabola."""
        return Residual(measured=y, predicted=slope * x)

    x = np.arange(1.0, 9.0)[:, None]
    run = Run.raw("line", {"x": x, "y": 2 * x + 0.1 * np.cos(7 * x)}, units={})
    assert attempt(line, [run]).certificate.profile is None


#: Biochemical oxygen demand (Bates & Watts 1988, A1.4): the example of a cost that is no parabola.
DEMAND = ((1, 8.3), (2, 10.3), (3, 19.0), (4, 16.0), (5, 15.6), (7, 19.8))


def test_the_command_line_draws_what_is_no_parabola(tmp_path, capsys):
    """Every point is the cost that SciPy finds with the unknown held there."""
    (tmp_path / "demand.py").write_text(
        "from casest import Residual, exp, model, param, signal\n"
        "@model\n"
        'def demand(x=signal("s"), y=signal("1"), *, a=param(start=1.0), '
        'b=param("1/s", start=0.3)):\n'
        "    return Residual(measured=y, predicted=a * (1 - exp(-b * x)))\n"
    )
    x, y = np.array(DEMAND).T
    rows = "\n".join(f"{a},{b}" for a, b in DEMAND)
    (tmp_path / "demand.csv").write_text(f"x [s],y\n{rows}\n")
    words = ["calibrate", str(tmp_path / "demand.py"), str(tmp_path / "demand.csv"), "--profile"]
    assert run(words) == 1
    assert "say where with -o DIR" in capsys.readouterr().err
    assert run([*words, "-o", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert "no parabola: a, b" in said.err
    assert "demand.csv -o" in " ".join(said.out.replace("\\\n", "").split())
    assert 'id="profiles"' in (tmp_path / "out/report.html").read_text()
    with (tmp_path / "out/profiles.csv").open() as file:
        points = [row for row in csv.DictReader(file) if row["unknown"] == "b"]

    def cost(b):
        shape = 1 - np.exp(-b * x)
        return float(np.sum((y - shape * (shape @ y) / (shape @ shape)) ** 2))

    best = minimize_scalar(cost, (0.3, 0.6)).fun
    assert len(points) > 10
    for row in points:
        rise = (cost(float(row["value"])) - best) / (best / 4)
        assert float(row["rise"]) == pytest.approx(rise, abs=1e-3)


def test_a_drawn_profile_is_the_least_sum_of_squares_at_each_value():
    run = observed(SIGMA, 2)
    found = attempt(demand.starting(first_guess), [run])
    values, rise = found.profile(1, reach=2.0, count=5)
    y = run.signals["y"][:, 0]
    squares = np.array([squares_at(rate, y) for rate in values])
    expected = (squares - squares_at(float(found.values["rate"]), y)) / found.noise.sigma**2
    assert rise == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert rise[0] / rise[-1] > 1.3  # no parabola, and no mirror image
