"""A calibration that is proved may still be wrong: what its residual says against the model."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import simulators as sim
from scipy.stats import binom

from casest import Residual, attempt, close, load_runs, model, param, quantity, signal
from casest.cli import run
from casest.data.run import Run
from casest.demo import WHEEL
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit import left
from casest.diagnose.misfit.left import doubts
from casest.results.closing import closing_result
from casest_problems.norm import norm_full, norm_triangular
from casest_problems.wheel import wheel


@model
def cell(p=signal("bar"), u=signal("V"), *, zero=param("V"), gain=param("V/bar", start=0.4)):
    """A pressure transmitter against a dead-weight tester; the prediction has no name."""
    pressure = quantity("pressure", p, "bar")
    return Residual(measured=u, predicted=zero + gain * pressure, corrected=pressure)


def transmitter(shuffled=None):
    """Eleven pressures at each of eight temperatures, one after the other, or shuffled."""
    rng = np.random.default_rng(4)
    p, temp = np.tile(np.linspace(0, 10, 11), 8), np.repeat(np.linspace(5, 45, 8), 11)
    u = 0.5 + 0.4 * p + (1.5e-3 + 4e-4 * p) * (temp - 25) + 1e-3 * rng.standard_normal(88)
    if shuffled is not None:
        order = shuffled.permutation(88)
        p, temp, u = p[order], temp[order], u[order]
    run = Run.raw("bench", {"p": p[:, None], "u": u[:, None]}, units={"p": "bar", "u": "V"})
    return replace(run, columns={"temp": temp}, column_units={"temp": "degC"})


def poses(count=60, noise=5e-3, seed=0):
    rng = np.random.default_rng(seed)
    v = sim.accelerometer(rng).read(sim.spread_poses(count, rng), noise, rng)
    return [Run.raw("poses", {"v": v}, units={"v": "m/s^2"})]


def test_an_undeclared_effect_is_seen_and_where():
    found = doubts(attempt(wheel, load_runs([WHEEL], wheel.signals)))
    assert found is not None
    assert found[0].where == "9 % of it follows angle"
    assert found[0].p_value < 0.0025


@pytest.mark.parametrize("order", [None, 5])
def test_a_temperature_that_moves_a_sensor_by_a_hundred_deviations_is_a_doubt(order):
    """As `close` says of it, which finds both effects."""
    run = transmitter(None if order is None else np.random.default_rng(order))
    found = doubts(attempt(cell, [run]))
    assert any("temp" in f.where for f in found)


@pytest.mark.long
def test_two_effects_of_one_column_on_a_prediction_without_a_name_are_both_found():
    """Zero and gain of a pressure transmitter depend on its temperature: 1.5 mV/K, 1e-3/K."""
    closing = close(cell, [transmitter(np.random.default_rng(5))])
    assert sorted(e.candidate.effect.name for e in closing.effects) == [
        "temperature_bias", "temperature_gain",
    ]  # fmt: skip
    for name, truth in (("temperature_bias(temp).k", 1.5e-3), ("temperature_gain(temp).k", 1e-3)):
        away = closing.after.values[name] - truth
        assert abs(away) < 4 * closing.after.std[name]
    assert closing.after.rmse == pytest.approx(1e-3, rel=0.15)
    # What is added as well is no rival.
    for e in closing_result(closing, model_name="cell.py", data=()).effects:
        assert not {"temperature_bias(temp)", "temperature_gain(temp)"} & {
            *e.indistinguishable_from, *e.less_likely,
        }  # fmt: skip


@pytest.mark.long
def test_noise_alone_is_a_doubt_no_more_often_than_the_chance():
    model = norm_triangular.having(norm=sim.GRAVITY)
    said = [doubts(attempt(model, poses(seed=k))) for k in range(40)]
    assert None not in said
    assert sum(map(bool, said)) <= binom.ppf(1 - 5e-4, 40, LEVELS.chance)


def test_a_refused_estimate_is_not_asked():
    assert doubts(attempt(norm_full.having(norm=sim.GRAVITY), poses())) is None


def test_a_long_record_is_not_asked(monkeypatch):
    """All residuals at once would cost the memory that a fit does not need."""
    found = attempt(norm_triangular.having(norm=sim.GRAVITY), poses())
    monkeypatch.setattr(left, "LONGEST", 59)
    assert doubts(found) is None


def test_the_prompt_says_so_first_and_offers_close_alone(tmp_path, capsys):
    assert run(["calibrate", "wheel", str(WHEEL), "-o", str(tmp_path)]) == 0
    head, note = " ".join(capsys.readouterr().out.split()).partition("parameter value")[0::2]
    assert "trusted, but the residual is not noise" in head
    assert "9 % of it follows angle" in head
    assert "Next: does the model lack an effect? casest close" in note
    assert "casest apply" not in note
    content = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert content["trusted"] is True
    assert content["misfit"][0]["where"] == "9 % of it follows angle"
    assert content["misfit"][0]["p_value"] < 1e-9
