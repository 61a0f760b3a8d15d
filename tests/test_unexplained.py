"""What `close` says of a misfit that it adds no cause for: through the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from casest import Residual, Run, model, param, quantity, signal
from casest.cli import run
from casest.diagnose.found import Undecided
from casest.diagnose.misfit.left import left_over
from casest.leastsquares.problem import Problem

REST = """
import casest as c


@c.model
def rest(v=c.signal(3, "m/s^2"), *, bias=c.param(3, "m/s^2")):
    return c.Residual(measured=v, predicted=c.quantity("reading", bias, "m/s^2"))
"""
COMPASS = """
import casest as c


@c.model
def compass(b=c.signal(3, "uT"), m=c.signal(3, "uT"), *, hard=c.param(3, "uT")):
    field = c.quantity("field", b, "uT")
    reading = c.quantity("reading", field + hard, "uT")
    return c.Residual(measured=m, predicted=reading, corrected=field)
"""


@model
def resting(v=signal(3, "m/s^2"), *, bias=param(3, "m/s^2")):
    """A sensor at rest."""
    return Residual(measured=v, predicted=quantity("reading", bias, "m/s^2"))


def still(course=0.0):
    """300 readings of white noise, and a course on the first axis."""
    v = 0.02 * np.random.default_rng(3).standard_normal((300, 3))
    v[:, 0] += course
    return Run.raw("still", {"v": v - v.mean(axis=0)}, units={}, time=0.1 * np.arange(300.0))


def closed(folder, model, columns, *values):
    """result.json of the model on these columns."""
    (folder / "model.py").write_text(model)
    table = np.column_stack(values)
    np.savetxt(folder / "record.csv", table, delimiter=",", header=columns, comments="")
    files = str(folder / "model.py"), str(folder / "record.csv")
    assert run(["close", *files, "-o", str(folder / "out")]) == 0
    return json.loads((folder / "out" / "result.json").read_text())


@pytest.mark.long
def test_of_causes_of_which_none_is_added_it_is_said_how_far_each_moves_the_parameters(
    tmp_path, capsys
):
    """A drift: the offset that it begins from is that of NumPy's straight line."""
    rng = np.random.default_rng(2)
    t = np.arange(6000) / 10
    v = 0.3 + 0.02 * rng.standard_normal((6000, 3))
    v[:, 0] += 0.007 * (t / t[-1] - 0.5)
    names = "t [s],v_x [m/s^2],v_y [m/s^2],v_z [m/s^2]"
    left = closed(tmp_path, REST, names, t, v)["unexplained"]
    assert sorted(left["one_of"]) == ["bias_drift", "warm_up"]
    assert set(left["would_move"]) == {"bias_drift", "warm_up"}
    line = np.polyfit(t, v[:, 0], 1)
    squares = np.sum((v - v.mean(axis=0)) ** 2)
    taken = np.sum((np.polyval(line, t) - v[:, 0].mean()) ** 2)
    assert left["fraction"] == pytest.approx(taken / squares, rel=0.1)  # a likelihood says 0.0015
    begins = line[1] - v[:, 0].mean()
    np.testing.assert_allclose(left["would_move"]["bias_drift"]["bias"], -begins, rtol=1e-3)
    printed = " ".join(capsys.readouterr().out.split())
    assert "bias_drift would move the parameters: bias by 0.0029 m/s^2" in printed
    assert "who knows which of them is there says so, as --effects warm_up" in printed


SWAYS = "the known reference sways: its size follows a smooth course"
WANDERS = "the offset of each axis follows a smooth course of its own"


@pytest.mark.parametrize(
    ("of_field", "of_offset", "times", "name", "words"),
    [
        pytest.param(0.006, 0.0, 1, "reference_wander", SWAYS, marks=pytest.mark.long),
        (0.006, 0.0, 10, "reference_wander", SWAYS),
        (0.0, 0.2, 1, "bias_course", WANDERS),
    ],
)
def test_a_slow_course_is_said_to_be_of_the_reference_or_of_the_offset(
    tmp_path, of_field, of_offset, times, name, words
):
    """Also one that sways many times, which six polynomials do not follow."""
    rng = np.random.default_rng(3)
    t = 0.1 * np.arange(600)
    x = times * (2 * t / t[-1] - 1)
    course = np.sin(2.5 * x) + 0.4 * np.cos(5 * x)
    b = rng.standard_normal((600, 3))
    b *= 48 / np.linalg.norm(b, axis=1)[:, None]
    m = b * (1 + of_field * course)[:, None] + np.outer(
        course, of_offset * np.array([1, -0.5, 0.8])
    )
    m += [5, -8, 2] + 0.02 * rng.standard_normal((600, 3))
    names = "t [s]," + ",".join(f"{n}_{a} [uT]" for n in "bm" for a in "xyz")
    result = closed(tmp_path, COMPASS, names, t, b, m)
    assert result["verdict"] == "unexplained"
    assert result["unexplained"]["described_by"] == [name]
    assert f"its slow course is best described by {name} ({words}" in result["unexplained"]["where"]


LENGTH = """
import casest as c


@c.model
def length(m=c.signal(3, "uT"), *, hard=c.param(3, "uT"), size=c.constant(48.0, "uT")):
    field = c.quantity("field", m - hard, "uT")
    return c.Residual(implicit=c.norm_2(field) - size, unit="uT", corrected=field, axes=("length",))
"""


@pytest.mark.parametrize(
    ("of_field", "of_offset", "turning", "names"),
    [
        (0.006, 0.0, 5, {"reference_wander"}),
        pytest.param(0.006, 0.0, 40, {"reference_wander"}, marks=pytest.mark.long),
        (0.0, 0.25, 5, {"bias_course"}),  # which is slow in no residual
        pytest.param(0.0, 0.25, 15, {"bias_course"}, marks=pytest.mark.long),
    ],
)
def test_a_length_alone_tells_a_course_of_the_reference_from_one_of_the_offset(
    tmp_path, of_field, of_offset, turning, names
):
    """By how it goes with the direction, where that turns."""
    rng = np.random.default_rng(5)
    t = 0.1 * np.arange(1500)
    x = 2 * t / t[-1] - 1
    course = np.sin(25 * x) + 0.4 * np.cos(50 * x)
    b = gaussian_filter1d(rng.standard_normal((1500, 3)), turning, axis=0)
    b *= 48 / np.linalg.norm(b, axis=1)[:, None]
    m = b * (1 + of_field * course)[:, None] + np.outer(
        course, of_offset * np.array([1, -0.5, 0.8])
    )
    m += [5, -8, 2] + 0.05 * rng.standard_normal((1500, 3))
    result = closed(tmp_path, LENGTH, "t [s],m_x [uT],m_y [uT],m_z [uT]", t, m)
    assert result["verdict"] == "unexplained"
    assert set(result["unexplained"]["described_by"]) == names


def test_causes_that_explain_nothing_are_not_said_to_explain_alike():
    """A likelihood may ask for what takes nothing away: that is said, and no more."""
    names = ("vibration", "hysteresis")
    assert not Undecided(names, 0.001).explains
    assert Undecided(names, 0.02).explains
    assert Undecided(names, 0.001, {"vibration": {"bias": np.ones(3)}}).explains

    def left(record):
        problem = Problem(resting, (record,))
        residuals = problem.residuals(problem.start())
        batches = [np.arange(0, 300, 30)]
        undecided = Undecided(names, 0.001)
        return left_over(problem, problem.start(), batches, residuals, undecided=undecided)

    assert not left(still()).significant  # no misfit by itself
    slow = left(still(0.02 * np.sin(np.arange(300) / 40)))
    assert slow.significant
    said = "vibration or hysteresis may be there besides, and would take none of it away"
    assert said in slow.where
    assert "alike" not in slow.where
