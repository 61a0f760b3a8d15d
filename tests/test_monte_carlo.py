"""Monte Carlo beside first order: validated where it is right, and as others find it where not."""

from __future__ import annotations

import json

import numpy as np
import pytest

import casest as c
from casest.cli import run
from casest.estimate.trials import Refits
from casest.leastsquares.stated import stated_noise
from casest.results.uncertainty import entries_of
from casest.results.validation import validated

MODEL = '''
from casest import Residual, constant, model, param, quantity, signal


@model
def line(y=signal("1"), x=signal("1", std=0.05), *, b0=param("1"), b1=param("1", start=1.0),
         shift=constant(0.1, "1", std=0.02)):
    """x = b0 + b1 (y - shift)."""
    truth = quantity("truth", y - shift, "1")
    return Residual(measured=x, predicted=b0 + b1 * truth, corrected=truth)


@model
def inverse(x=signal("1", std=0.25), *, p=param("1", start=1.0)):
    """x = 1/p."""
    return Residual(measured=x, predicted=1 / p)
'''


@c.model
def inverse(x=c.signal("1", std=0.25), *, p=c.param("1", start=1.0)):
    """A mean, by its inverse."""
    return c.Residual(measured=x, predicted=1 / p)


@c.model
def straight(x=c.signal("1"), y=c.signal("1"), *, a=c.param("1"), b=c.param("1", start=1.0)):
    """A line."""
    return c.Residual(measured=y, predicted=a + b * x)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("validate")
    (folder / "m.py").write_text(MODEL)
    y = np.linspace(1, 5, 12)
    x = 3 + 2 * y + 0.05 * np.random.default_rng(3).standard_normal(12)
    table = np.column_stack([y, x])
    np.savetxt(folder / "line.csv", table, delimiter=",", header="y,x", comments="")
    (folder / "inverse.csv").write_text("x\n1.2\n0.8\n1.0\n")
    for name in ("line", "inverse"):
        given = ["calibrate", f"{folder}/m.py:{name}", f"{folder}/{name}.csv"]
        assert run([*given, "-o", f"{folder}/{name}"]) == 0
    return folder


def test_first_order_is_validated_where_the_model_is_linear(folder, capsys):
    assert run(["budget", f"{folder}/line", "--validate", "-o", f"{folder}/budget"]) == 0
    found = json.loads((folder / "budget" / "budget.json").read_text())["validation"]
    each = found["values"] + found["corrected"]
    assert [v["name"] for v in each] == ["b0", "b1", "truth"]
    assert all(v["validated"] for v in each)
    assert found["stable"]
    assert "first order is validated for 3 of 3 numbers" in " ".join(
        capsys.readouterr().out.split()
    )
    assert "not validated" not in (folder / "budget" / "budget.html").read_text()


def test_first_order_is_not_validated_where_the_model_bends(folder, capsys):
    """The ends of the interval of 1/x are those of x, which is normal, turned round."""
    assert run(["budget", f"{folder}/inverse", "--validate", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["validation"]["values"]
    mean, half = 1.0, 1.959964 * 0.25 / np.sqrt(3)
    assert found["validated"] is False
    ends = [1 / (mean + half), 1 / (mean - half)]
    assert found["monte_carlo_interval"] == pytest.approx(ends, rel=0.02)
    assert found["interval"] == pytest.approx([mean - half, mean + half], rel=1e-4)


def test_where_time_runs_out_that_is_said(folder, capsys):
    assert run(["budget", f"{folder}/line", "--validate", "--limit", "0.001", "--digits", "2"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "the trials of 0.001 s do not tell: give them more time (--limit SECONDS)" in out


def test_trials_are_refused_of_records_that_changed(folder, capsys, tmp_path):
    (tmp_path / "d.csv").write_text("x\n1.2\n0.8\n")
    given = ["calibrate", f"{folder}/m.py:inverse", f"{tmp_path}/d.csv", "-o", f"{tmp_path}/out"]
    assert run(given) == 0
    (tmp_path / "d.csv").write_text("x\n1.2\n2.8\n")
    assert run(["budget", f"{tmp_path}/out", "--validate"]) == 1
    assert "the records or the model have changed since" in capsys.readouterr().err
    (tmp_path / "d.csv").unlink()
    assert run(["budget", f"{tmp_path}/out", "--validate"]) == 1
    assert "its fit cannot be made again" in capsys.readouterr().err


def test_trials_of_errors_in_variables_are_those_of_the_closed_form():
    """Equal noise of x and y: the line is the first axis of their scatter (Deming)."""
    rng = np.random.default_rng(5)
    x = np.linspace(0, 1, 8)
    data = {"x": x[:, None], "y": (1 + 2 * x)[:, None]}
    record = c.Run.raw("r", data, units=dict.fromkeys(data, "1"))
    noise = {name: [np.full(1, 0.15)] for name in data}
    found = c.attempt(*stated_noise(straight, [record], noise))
    trials = Refits.of(found).run(10_000, np.random.default_rng(1))
    p = np.stack([x, 1 + 2 * x]) + 0.15 * rng.standard_normal((10_000, 2, 8))
    p = p - p.mean(axis=2, keepdims=True)
    axis = np.linalg.eigh(p @ p.transpose(0, 2, 1))[1][:, :, 1]
    ends = (0.025, 0.5, 0.975)
    slopes = np.quantile(axis[:, 1] / axis[:, 0], ends)
    assert trials.settled.mean() > 0.999
    assert np.quantile(trials.unknowns[:, 1], ends) == pytest.approx(slopes, rel=0.03)


def test_noise_that_the_residual_shows_has_students_t():
    """Of three readings: two degrees of freedom, t = 4.30."""
    record = c.Run.raw("r", {"x": np.array([[1.0], [2.0], [3.5]])}, units={"x": "1"})

    @c.model
    def level(x=c.signal("1"), *, a=c.param("1")):
        """A constant."""
        return c.Residual(measured=x, predicted=a)

    found = validated(c.attempt(level, [record]), None, digits=1, limit=1, seed=0)
    half = 4.30265 * np.std([1, 2, 3.5], ddof=1) / np.sqrt(3)
    mean = np.mean([1, 2, 3.5])
    assert found.values[0].interval == pytest.approx([mean - half, mean + half], rel=1e-5)
    assert found.values[0].monte_carlo_interval == pytest.approx(
        [mean - half, mean + half], rel=0.1
    )


@pytest.mark.long
def test_trials_of_several_runs_with_a_direction_have_the_covariance_of_the_fit():
    """Small noise: what is bent is straight, and first order is right."""
    rng = np.random.default_rng(2)

    @c.model
    def pointed(v=c.signal(3, "1"), *, d=c.param(c.unit_vector), o=c.param("1", per="run")):
        """A direction, lengthened differently in each run."""
        return c.Residual(measured=v, predicted=(1 + o) * d)

    records = [
        c.Run.raw(f"r{k}", {"v": [0.6, 0, 0.8] + 0.001 * rng.standard_normal((9, 3))}, units={})
        for k in range(2)
    ]
    found = c.attempt(pointed, records)
    refits = Refits.of(found)
    covariance = np.cov(refits.run(10_000, np.random.default_rng(0)).unknowns.T)
    freedom = found.noise.degrees_of_freedom
    expected = refits.first_order * freedom / (freedom - 2)
    std = np.sqrt(np.diag(expected))
    assert covariance / np.outer(std, std) == pytest.approx(expected / np.outer(std, std), abs=0.04)
    assert len(entries_of(found)[0]) == 5
    assert all(v.validated for v in validated(found, None, digits=1, limit=2, seed=0).values)


def test_effects_that_weigh_the_noise_have_no_trials():
    from casest.effects.noise import outliers

    record = c.Run.raw(
        "r", {"x": np.random.default_rng(0).normal(1, 0.1, (60, 1))}, units={"x": "1"}
    )
    found = c.attempt(inverse.with_effect(outliers), [record])
    with pytest.raises(c.UsageError, match="follows no effect on the noise"):
        Refits.of(found)
