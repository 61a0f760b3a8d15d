"""States by a moving horizon: the Kalman filter's where nothing is bounded; bounds kept.

Truth: the filter (itself checked against augmented least squares), SciPy's bounded least squares,
and a published reaction whose extended filter ends at a negative pressure (Haseltine & Rawlings
2005, example 1).
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from casest import Run, param, signal, vertcat
from casest.cli import run as casest_run
from casest.dynamics import Motion, dynamics, filtered, measured, moving_horizon, state
from casest.errors import DataError


@dynamics
def cart(
    u=signal("m/s^2"),
    p=signal("m"),
    *,
    x=state("m", std=2.0),
    v=state("m/s", intensity=0.02),
    b=param("m/s^2", start=0.1),
):
    return Motion(rates={"x": v, "v": u - b}, outputs=(measured(p, x, std=0.1),))


@pytest.mark.parametrize("horizon", [1, 5, 40])
def test_without_bounds_it_is_the_kalman_filter_at_every_horizon(horizon):
    """Uneven steps, a gap, missing readings, an unknown constant, states driven by nothing."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.15, 90))
    t[60:] += 3
    p = np.cumsum(rng.normal(0, 0.1, 90))
    p[50:55] = np.nan
    signals = {"u": np.sin(t)[:, None], "p": p[:, None]}
    run = Run.raw("cart", signals, units={"u": "m/s^2", "p": "m"}, time=t)
    whole, found = filtered(cart, run), moving_horizon(cart, run, horizon)
    assert found.x == pytest.approx(whole.x, abs=1e-9)
    assert found.std == pytest.approx(whole.std, rel=1e-9)
    assert found.innovations == pytest.approx(whole.innovations, abs=1e-9, nan_ok=True)
    last = slice(-horizon - 1, None)  # what one window holds has all later readings
    assert found.smoothed[last] == pytest.approx(whole.smoothed[last], abs=1e-9)


def test_a_window_over_the_whole_record_is_the_bounded_least_squares_problem():
    """A level that is never negative; SciPy's lsq_linear, and its dual by differences."""

    @dynamics
    def level(y=signal(), *, x=state(start=0.3, std=0.5, intensity=0.4, bounds=(0, 2))):
        return Motion(rates={}, outputs=(measured(y, x, std=0.3),))

    rng = np.random.default_rng(3)
    N, h = 30, 0.5
    y = 1.5 * np.sin(np.arange(N) / 3) + 0.3 * rng.standard_normal(N)
    run = Run.raw("level", {"y": y[:, None]}, units={}, time=h * np.arange(N))
    found = moving_horizon(level, run, N)

    def best(lowest: float) -> tuple[np.ndarray, float]:
        differences = (np.eye(N, k=1) - np.eye(N))[:-1] / np.sqrt(0.4 * h)
        A = np.vstack([np.eye(1, N) / 0.5, differences, np.eye(N) / 0.3])
        b = np.concatenate([[0.3 / 0.5], np.zeros(N - 1), y / 0.3])
        below = np.zeros(N)
        below[12] = lowest
        known = lsq_linear(A, b, (below, np.full(N, 2.0)), method="bvls", tol=1e-14)
        return known.x, known.cost

    x, _ = best(0.0)
    assert x[12] == 0
    assert found.smoothed[:, 0] == pytest.approx(x, abs=1e-8)
    slope = (best(1e-4)[1] - best(-1e-4)[1]) / 2e-4
    assert found.multipliers[12, 0, 0] == pytest.approx(slope, rel=1e-5)
    assert np.all(found.smoothed[found.multipliers[:, 0, 0] > 0, 0] == 0)


REACTOR = """
from casest import signal, vertcat
from casest.dynamics import Motion, dynamics, measured, state


@dynamics
def reactor(
    p=signal(), *, x=state(2, start=[0.1, 4.5], std=6, intensity=1e-5, bounds=(0, None))
):
    rate = 0.16 * x[0] ** 2
    return Motion(
        rates={"x": vertcat(-2 * rate, rate)}, outputs=(measured(p, x[0] + x[1], std=0.1),)
    )
"""


def test_a_pressure_that_the_filter_makes_negative_is_found_within_its_bounds(tmp_path, capsys):
    """2A → B, the sum of both read: closed form."""
    t = np.arange(0, 6.01, 0.1)
    a = 3 / (1 + 2 * 0.16 * 3 * t)
    b = 1 + (3 - a) / 2
    y = a + b + 0.1 * np.random.default_rng(0).standard_normal(len(t))
    record = tmp_path / "reactor.csv"
    rows = [f"{s:.1f},{v!r}" for s, v in zip(t, y.tolist(), strict=True)]
    record.write_text("\n".join(["t [s],p", *rows]) + "\n")
    (tmp_path / "reactor.py").write_text(REACTOR)
    words = ["filter", str(tmp_path / "reactor.py"), str(record), "--json"]
    assert casest_run(words) == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["states"]["x"]["value"][0] < -1
    assert any("x[0] leaves its bounds at 61 of 61 samples" in n for n in plain["notes"])
    assert casest_run([*words, "--horizon", "20", "-o", str(tmp_path / "out")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["horizon"]["steps"] == 20
    assert found["horizon"]["unsettled"] == 0
    end = found["states"]["x"]
    off = np.abs(np.array(end["value"]) - [a[-1], b[-1]])
    assert np.all(off < 4 * np.array(end["std"]))
    table = np.genfromtxt(tmp_path / "out/states.csv", delimiter=",", names=True, deletechars="")
    assert min(table["x[0]_[1]"].min(), table["smoothed_x[1]_[1]"].min()) >= 0


def test_bounds_that_nothing_can_keep_are_named():
    @dynamics
    def filling(y=signal(), *, x=state(2, start=[0, 1], known=True, bounds=(None, 1.5))):
        return Motion(rates={"x": vertcat(x[1], 0)}, outputs=(measured(y, x[0], std=1.0),))

    run = Run.raw("filling", {"y": np.zeros((5, 1))}, units={}, time=np.arange(5.0))
    with pytest.raises(DataError, match=r"x\[0\] leaves its bounds at row 2 whatever"):
        moving_horizon(filling, run, 3)


def test_a_horizon_of_no_step_is_refused(tmp_path, capsys):
    (tmp_path / "reactor.py").write_text(REACTOR)
    words = ["filter", str(tmp_path / "reactor.py"), "none.csv", "--horizon", "0"]
    assert casest_run(words) == 1
    assert "--horizon" in capsys.readouterr().err
