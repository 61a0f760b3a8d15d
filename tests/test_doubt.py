"""A calibration that is proved may still be wrong: what its residual says against the model."""

from __future__ import annotations

import json

import numpy as np
import pytest
import simulators as sim

from casest import attempt, load_runs
from casest.cli import run
from casest.closing import doubt
from casest.closing.doubt import doubts
from casest.data.run import Run
from casest.demonstration import WHEEL
from casest_problems.norm import norm_full, norm_triangular
from casest_problems.wheel import wheel


def poses(count=60, noise=5e-3, seed=0):
    rng = np.random.default_rng(seed)
    v = sim.accelerometer(rng).read(sim.spread_poses(count, rng), noise, rng)
    return [Run.raw("poses", {"v": v}, units={"v": "m/s^2"})]


def test_an_undeclared_effect_is_seen_and_where():
    found = doubts(attempt(wheel, load_runs([WHEEL], wheel.signals)))
    assert found is not None
    assert "turn of angle" in found[0].where
    assert found[0].p_value < 0.0025


def test_noise_alone_is_no_doubt():
    model = norm_triangular.having(norm=sim.GRAVITY)
    assert [doubts(attempt(model, poses(seed=k))) for k in range(5)] == [[]] * 5


def test_a_refused_estimate_is_not_asked():
    assert doubts(attempt(norm_full.having(norm=sim.GRAVITY), poses())) is None


def test_a_long_record_is_not_asked(monkeypatch):
    """All residuals at once would cost the memory that a fit does not need."""
    found = attempt(norm_triangular.having(norm=sim.GRAVITY), poses())
    monkeypatch.setattr(doubt, "LONGEST", 59)
    assert doubts(found) is None


def test_the_prompt_says_so_first_and_offers_close_alone(tmp_path, capsys):
    assert run(["calibrate", "wheel", str(WHEEL), "-o", str(tmp_path)]) == 0
    head, note = " ".join(capsys.readouterr().out.split()).partition("parameter value")[0::2]
    assert "trusted, but the residual is not noise" in head
    assert "varies twice per turn of angle" in head
    assert "Next: does the model lack an effect? casest close" in note
    assert "casest apply" not in note
    content = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert content["trusted"] is True
    assert content["misfit"][0]["where"] == "varies twice per turn of angle"
    assert content["misfit"][0]["p_value"] == pytest.approx(5e-4, rel=0.5)
