"""Student's t as the law of the noise: Fisher's information, coverage, degrees of freedom."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

import casest as c
from casest.cli import run
from casest.diagnose.noise.student import estimated, with_student

MODEL = '''
from casest import Residual, model, param, signal


@model
def line(x=signal("1"), y=signal("1"), *, a=param("1"), b=param("1", start=1.0)):
    """A line."""
    return Residual(measured=y, predicted=a + b * x)
'''


@c.model
def line(x=c.signal("1"), y=c.signal("1"), *, a=c.param("1"), b=c.param("1", start=1.0)):
    """A line."""
    return c.Residual(measured=y, predicted=a + b * x)


def record(count, freedom, seed, name="r"):
    x = np.linspace(0, 1, count)
    rng = np.random.default_rng(seed)
    noise = rng.standard_t(freedom, count) if np.isfinite(freedom) else rng.standard_normal(count)
    y = 1 + 2 * x + 0.1 * noise
    return c.Run.raw(name, {"x": x[:, None], "y": y[:, None]}, units={})


@pytest.mark.parametrize("freedom", [3, 5])
def test_standard_deviations_are_those_of_fishers_information(freedom):
    """Of a location by Student's t with scale s it is (ν + 1)/((ν + 3) s²) for each reading."""
    one = record(4000, freedom, 1)
    found = c.attempt(with_student(line, freedom), [one], intervals=False)
    usual = c.attempt(line, [one], intervals=False)
    std = 0.1 * np.sqrt((freedom + 3) / (freedom + 1) / 4000) / np.std(one.signals["x"])
    assert float(found.std["b"]) == pytest.approx(std, rel=0.04)
    assert float(usual.std["b"]) > 1.08 * std
    assert estimated(line, [one])[1] == pytest.approx(freedom, rel=0.15)


@pytest.mark.long
def test_intervals_hold_the_truth_as_often_as_they_say():
    """Of six hundred unknowns of three hundred lines, each with its own twenty readings; their
    standard deviations are what lines fitted by NumPy alone scatter by (Huber's are 0.97 of it)."""
    each, held, stds = line.scoped("a", "run").scoped("b", "run"), [], []
    for first in (100, 200, 300):
        records = [record(20, 3, first + k, f"r{k}") for k in range(100)]
        found = c.attempt(with_student(each, 3), records, intervals=False)
        low, high = found.interval_reach
        held += [
            (t - found.values[n] > -low[n]) & (t - found.values[n] < high[n])
            for n, t in (("a", 1.0), ("b", 2.0))
        ]
        stds.append(np.mean(found.std["b"]))
    assert 0.925 <= np.mean(held) <= 0.975
    assert 0.99 < np.mean(stds) / scatter_of_slopes(20, 3, 60) < 1.07


def scatter_of_slopes(n, freedom, groups):
    """Of weighted lines whose scale is that of a hundred together, reweighted until they rest."""
    x, rng = np.linspace(0, 1, n), np.random.default_rng(5)
    y = 0.1 * rng.standard_t(freedom, (100 * groups, n))
    r = y - y.mean(axis=1, keepdims=True)
    for _ in range(60):
        size = np.median(np.abs(r.reshape(groups, -1)), axis=1) / stats.t.ppf(0.75, freedom)
        w = 1 / (1 + (r / np.repeat(size, 100)[:, None]) ** 2 / freedom)
        total, mean_x, mean_y = w.sum(1), (w @ x) / w.sum(1), (w * y).sum(1) / w.sum(1)
        slope = ((w * y) @ x / total - mean_x * mean_y) / (w @ x**2 / total - mean_x**2)
        r = y - mean_y[:, None] - slope[:, None] * (x - mean_x[:, None])
    return float(np.std(slope))


def test_normal_noise_is_not_taken_for_one_with_heavy_tails():
    model, freedom = estimated(line, [record(1000, np.inf, 3)])
    assert freedom == np.inf
    assert not model.effects


@pytest.fixture
def cli(tmp_path, capsys):
    (tmp_path / "m.py").write_text(MODEL)
    signals = record(300, 3, 7).signals
    table = np.column_stack([signals["x"], signals["y"]])
    np.savetxt(tmp_path / "d.csv", table, delimiter=",", header="x,y", comments="")
    np.savetxt(tmp_path / "few.csv", table[:20], delimiter=",", header="x,y", comments="")

    def command(*words, verb="calibrate", data="d"):
        given = [verb, f"{tmp_path}/m.py", f"{tmp_path}/{data}.csv", *words]
        code = run([*given, "-o", f"{tmp_path}/out"])
        return code, capsys.readouterr().err, tmp_path / "out" / "result.json"

    return command


def test_the_command_line_takes_degrees_of_freedom_or_finds_them(cli):
    code, err, file = cli("--noise-law", "t")
    (effect,) = json.loads(file.read_text())["effects"]
    assert code == 0
    assert effect["name"] == "student_t"
    assert 1.5 < effect["numbers"]["nu"] < 8
    assert f"Student's t with {effect['numbers']['nu']:g} degrees of freedom" in err
    assert cli("--noise-law", "t:3")[0] == 0
    assert json.loads(file.read_text())["effects"][0]["numbers"]["nu"] == 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--noise-law", "cauchy"], "there is normal, t, and t:NU"),
        (["--noise-law", "t:"], "there is normal, t, and t:NU"),
        (["--noise-law", "t:-1"], "degrees of freedom are a number above zero"),
        (["--noise-law", "t", "--sensor-noise", "y=0.1"], "noise that was stated is normal"),
    ],
)
def test_a_law_that_is_none_is_refused(cli, words, said):
    code, err, _ = cli(*words)
    assert code == 1
    assert said in err


def test_where_tails_cannot_be_judged_that_is_said(cli):
    assert "20 residuals do not show how heavy" in cli("--noise-law", "t", data="few")[1]
    assert "--noise-law is for calibrate" in cli("--noise-law", "t", verb="close")[1]
