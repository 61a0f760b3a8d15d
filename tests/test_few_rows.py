"""Rows of a table that the others speak against: found though they hide each other."""

from __future__ import annotations

import warnings
from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from casest import close
from casest.cli import run
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.few_rows import at_the_ends, few_rows
from casest.diagnose.misfit.variables import Variable


def table(rng, rows, axes, unknowns, off=()):
    """Normal noise of size one beside so many unknowns; `off`: rows and by how much."""
    X = rng.standard_normal((rows, axes, unknowns))
    y = rng.standard_normal((rows, axes))
    for row, size in off:
        y[row] += size
    flat = X.reshape(-1, unknowns)
    r = y.ravel() - flat @ np.linalg.lstsq(flat, y.ravel())[0]
    return r.reshape(rows, axes), X


@pytest.mark.long
@pytest.mark.parametrize(("rows", "axes", "unknowns"), [(9, 1, 2), (20, 3, 4), (40, 1, 3)])
def test_of_normal_noise_no_row_is_spoken_against(rows, axes, unknowns):
    rng, alarms = np.random.default_rng(rows), 0
    for _ in range(150):
        alarms += few_rows(*table(rng, rows, axes, unknowns)) is not None
    assert alarms <= stats.binom.ppf(1 - 5e-4, 150, LEVELS.chance)


def test_both_ends_of_a_line_are_off_and_neither_stands_out():
    """Nine rows on a line, the first and the last off by 30 standard deviations of the others."""
    rng, x = np.random.default_rng(3), np.arange(9.0)
    y = 0.01 * rng.standard_normal(9)
    y[0] += 0.36
    y[8] -= 0.40
    X = np.column_stack([np.ones(9), x])
    r = y - X @ np.linalg.lstsq(X, y)[0]
    assert np.abs(r).max() < 2.5 * r.std()
    found = few_rows(r[:, None], X[:, None, :])
    assert list(found.rows) == [0, 8]
    assert found.p_value < 1e-3
    assert found.share > 0.95


@pytest.mark.parametrize("seed", range(5))
def test_the_rows_are_those_of_all_that_could_be_chosen(seed):
    """Every choice of two rows of fourteen, by NumPy's least squares."""
    rng = np.random.default_rng(seed)
    r, X = table(rng, 14, 1, 3, off=[(4, 9.0), (11, 12.0)])

    def left(gone):
        kept = np.setdiff1d(np.arange(14), gone)
        return np.linalg.lstsq(X[kept, 0], r[kept, 0])[1][0]

    best = min(combinations(range(14), 2), key=left)
    found = few_rows(r, X)
    assert tuple(found.rows) == best == (4, 11)
    F = (np.sum(r**2) - left(best)) / 2 / (left(best) / 9)
    assert found.p_value == pytest.approx(stats.f.sf(F, 2, 9) * 91 * 3)
    assert found.share == pytest.approx(1 - left(best) / left([]))


def variable(name, *values, **flags):
    return Variable(name, tuple(np.asarray(v, float) for v in values), **flags)


def test_rows_at_the_ends_of_an_input_are_called_that():
    """A hyperbola by a line: the nearest rows are no faults, whatever order they were taken in."""
    rng = np.random.default_rng(0)
    x = rng.permutation(np.linspace(3, 40, 38))
    near = np.flatnonzero(x < np.sort(x)[5])
    other = variable("other", rng.standard_normal(38))
    assert at_the_ends(near, [other, variable("gap", x)]) == "one end of gap"
    assert at_the_ends(np.r_[near, np.argmax(x)], [variable("gap", x)]) == "both ends of gap"
    assert at_the_ends(near[near != np.argmin(x)], [variable("gap", x)]) == ""
    assert at_the_ends(np.arange(5), [variable("place", np.arange(38), clock=True)]) == (
        "one end of the record"
    )


@pytest.mark.parametrize("far", [1.0, 1e9])
def test_a_column_that_tells_the_odd_row_alone_says_nothing_of_the_others(far):
    """A mark in that row: how noise grows with it nobody knows, and no warning is printed."""
    rng = np.random.default_rng(5)
    r, X = table(rng, 20, 1, 2, off=[(7, 15.0)])
    for others in (np.zeros(20), 1e-6 * rng.standard_normal(20)):
        mark = np.where(np.arange(20) == 7, far, others)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = few_rows(r, X, variables=[variable("mark", mark)])
        if not others.any():
            assert list(found.rows) == [7]


def test_rows_that_are_chosen_at_random_are_at_no_end():
    """Three of 14 rows, of four variables: four of 364 choices each."""
    rng, found = np.random.default_rng(1), 0
    for _ in range(2000):
        read = [variable(f"x{k}", rng.standard_normal(14)) for k in range(4)]
        found += at_the_ends(rng.permutation(14)[:3], read[:1]) != ""
        assert at_the_ends(np.array([0, 5]), read) == ""  # of two rows: 4 · 3 / 91
    assert found == 0
    chances = [
        at_the_ends(rng.permutation(30)[:3], [variable("x", rng.standard_normal(30))]) != ""
        for _ in range(5000)
    ]
    assert stats.binom.ppf(5e-4, 5000, 4 / 4060) <= sum(chances)
    assert sum(chances) <= stats.binom.ppf(1 - 5e-4, 5000, 4 / 4060)


@pytest.mark.long
def test_a_hyperbola_that_is_fitted_by_a_line_has_no_faulty_rows(tmp_path, capsys):
    """A distance by infrared light, of which it was said that the others speak against five."""
    d = np.arange(3.0, 41.0)
    rows = np.column_stack([d, np.round(12.2 / (d + 0.9) + 0.03, 2)])
    np.savetxt(tmp_path / "ir.csv", rows, delimiter=",", header="gap [cm],u [V]", comments="")
    named = ["--columns", "reference=gap", "--columns", "reading=u"]
    assert run(["close", "linear", str(tmp_path / "ir.csv"), *named]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "unexplained: a misfit remains in rows 0, 1, 2 and 3 of ir, at one end of ref" in said
    assert "speak against" not in said
    assert "of it follows reference" in said


def test_where_nothing_is_determined_no_row_is_looked_for():
    """As of an estimate that is refused, with numbers of any size."""
    r = np.arange(12.0)[:, None]
    assert few_rows(r, np.zeros((12, 1, 2))) is None
    assert few_rows(r, np.full((12, 1, 2), np.inf)) is None


def test_a_reading_that_is_rounded_speaks_against_no_row():
    """Integers on a line of slope one, three of twelve a step off: that is rounding."""
    x = np.arange(12.0)
    y = np.round(x + 0.2)
    y[[3, 7, 8]] += 1
    X = np.column_stack([np.ones(12), x])
    r = y - X @ np.linalg.lstsq(X, y)[0]
    assert few_rows(r[:, None], X[:, None, :]) is not None
    assert few_rows(r[:, None], X[:, None, :], rounding=1 / np.sqrt(12)) is None


def test_a_table_whose_readings_are_rounded_is_adequate():
    x = np.arange(12.0)
    y = x + np.isin(x, [3, 7])
    assert close("linear", {"reference": x, "reading": y}).verdict == "adequate"


def stopped(rng, path):
    """A gyroscope on a turntable in 30 directions; in two of them the table stands still."""
    n = rng.standard_normal((30, 3))
    omega = 4.712 * n / np.linalg.norm(n, axis=1)[:, None]
    omega[[2, 27]] = 0.0
    read = omega * [1.02, 0.97, 1.01] + [0.02, -0.03, 0.01] + 0.005 * rng.standard_normal((30, 3))
    np.savetxt(path, read, delimiter=",", header="wx [rad/s],wy [rad/s],wz [rad/s]", comments="")
    return str(path)


@pytest.mark.parametrize("verb", ["calibrate", "close"])
@pytest.mark.parametrize("model", ["norm-diagonal", "norm-triangular"])
def test_rows_that_led_an_estimate_astray_are_named_where_it_is_refused(
    tmp_path, capsys, verb, model
):
    """Of a public record (studies/strangers.md) it was said that the readings cover too little."""
    path = stopped(np.random.default_rng(0), tmp_path / "table.csv")
    code = run([verb, model, path, "--columns", "v=wx,wy,wz", "--set", "norm=4.712 rad/s"])
    assert code == 2
    said = capsys.readouterr().err
    assert "of the residual is in rows 2" in said
    assert "27 of table, which the others speak against: look at these first; " in said


def test_so_are_the_rows_of_a_series_that_are_far_out(tmp_path, capsys):
    """A magnetometer turned by hand, with a magnet nearby in one row of forty."""
    rng = np.random.default_rng(3)
    n = rng.standard_normal((2000, 3))
    field = 45 * n / np.linalg.norm(n, axis=1)[:, None] * [1.05, 0.95, 1.0] + [3, -2, 1]
    field += 0.5 * rng.standard_normal(field.shape)
    field[::40] += 40 * rng.standard_normal((50, 3))
    path = tmp_path / "hand.csv"
    rows = np.column_stack([0.02 * np.arange(2000), field])
    np.savetxt(path, rows, delimiter=",", header="t [s],mx [uT],my [uT],mz [uT]", comments="")
    said = ["calibrate", "norm-triangular", str(path), "--columns", "v=mx,my,mz"]
    assert run([*said, "--set", "norm=45 uT"]) == 2
    told = capsys.readouterr().err
    assert "98 % of the residual is in 45 of 2000 rows, which are far out, most of all row " in told
