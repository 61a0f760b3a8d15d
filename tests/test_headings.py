"""Ren & Liu, Table IV: headings of a magnetometer on a turn table, before and after calibration.

Nine headings, the first and the last of one pose: their difference is the record's own
repeatability, 0.57 degrees after calibration.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.stats import f

from casest import Run
from casest.cli import run
from casest.diagnose.loop import close
from casest.effects import CATALOGUE
from casest.results.find import find_effects, find_model

TABLE = np.arange(0, 361, 45)
HEADINGS = {
    "before": [20.63, 60.6, 106.69, 158.86, 204.94, 251.07, 293.6, 333.1, 376.28],
    "after": [23.11, 67.7, 113.32, 158.43, 202.46, 247.53, 292.97, 337.67, 382.54],
}
COMPASS = '''
from casest import Residual, cos, effect, model, param, quantity, signal, sin


@model
def compass(table=signal("deg"), heading=signal("deg"), *, declination=param("deg")):
    """A heading is that of the table and the declination."""
    return Residual(
        measured=heading, predicted=quantity("reading", table + declination, "deg")
    )


@effect(on="reading", formula="y + sine·sin(table) + cosine·cos(table)")
def deviation(y, table=signal("deg"), *, sine=param("deg"), cosine=param("deg")):
    """Hard iron: the deviation of a compass, once per turn."""
    angle = table * 3.141592653589793 / 180
    return y + sine * sin(angle) + cosine * cos(angle)
'''


def table_of(which):
    """One of the two columns as a file."""
    rows = [f"{k},{a},{h}" for k, (a, h) in enumerate(zip(TABLE, HEADINGS[which], strict=True))]
    return "\n".join(["pose,table [deg],heading [deg]", *rows, ""])


@pytest.fixture
def headings(tmp_path, monkeypatch):
    """Run a command on one of the two columns; its result."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "compass.py").write_text(COMPASS, encoding="utf-8")

    def call(command, which, *more):
        (tmp_path / "headings.csv").write_text(table_of(which), encoding="utf-8")
        assert run([command, "compass.py", "headings.csv", *more, "-o", "out"]) == 0
        return json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))

    return call


def amplitude(result):
    """Size of the first harmonic over its standard deviation."""
    p = result["estimate"]["parameters"]
    size = np.array([p[f"deviation.{n}"]["value"] for n in ("sine", "cosine")])
    std = np.array([p[f"deviation.{n}"]["std"] for n in ("sine", "cosine")])
    return float(np.hypot(*(size / std)))


def test_before_calibration_a_first_harmonic_explains_half_of_the_headings_error(headings):
    """4.09 degrees, and 2.01 with it: standard deviations over 8 and 6 degrees of freedom."""
    plain = headings("calibrate", "before")
    swung = headings("calibrate", "before", "--effects", "compass.py")
    assert plain["noise"]["sigma"][0] == pytest.approx(4.09, abs=0.01)
    assert swung["noise"]["sigma"][0] == pytest.approx(2.01, abs=0.02)
    assert amplitude(swung) > 4.3


def test_before_calibration_closing_the_loop_traces_the_first_harmonic(headings):
    """Asked for, among nothing else: the F test of ordinary least squares, by hand, but for what
    noise of the table's angle may feign: a twentieth of the chance at most."""
    result = headings("close", "before", "--effects", "compass.py")
    off, angle = np.array(HEADINGS["before"]) - TABLE, np.radians(TABLE)
    swings = np.stack([np.ones(9), np.sin(angle), np.cos(angle)], axis=1)
    left = off - swings @ np.linalg.lstsq(swings, off, rcond=None)[0]
    F = ((off - off.mean()) @ (off - off.mean()) - left @ left) / 2 / (left @ left / 6)
    (found,) = result["effects"]
    assert found["name"] == "deviation"
    assert 0.99 * f.sf(F, 2, 6) < found["p_value"] < 1.05 * f.sf(F, 2, 6)
    assert result["verdict"] == "extended"
    assert result["after"]["rmse_holdout"] < 0.6 * result["before"]["rmse_holdout"]
    assert result["before"]["rmse_holdout"] == pytest.approx(4.62, abs=0.01)


def test_after_calibration_no_first_harmonic_is_left(headings):
    swung = headings("calibrate", "after", "--effects", "compass.py")
    assert amplitude(swung) < 2.4  # F(2, 6) = 3: a tenth
    assert swung["noise"]["sigma"][0] < 0.57


@pytest.mark.parametrize("effects", [(), ("--effects", "compass.py")])
def test_after_calibration_closing_the_loop_finds_nothing(headings, effects):
    result = headings("close", "after", *effects)
    assert result["verdict"] == "adequate"
    assert result["effects"] == []
    assert [r["name"] for r in result["refused"]] == ["deviation"] * bool(effects)


@pytest.mark.parametrize(("records", "few"), [(3, 1), pytest.param(50, 4, marks=pytest.mark.long)])
def test_noise_alone_is_hardly_ever_the_effect_that_is_asked_for(tmp_path, records, few):
    """At most one in a hundred: four and more of fifty have a chance of 1 in 600, two and more of
    six one of 1 in 680."""
    path = tmp_path / "compass.py"
    path.write_text(COMPASS, encoding="utf-8")
    compass, own = find_model(str(path)), find_effects(str(path))
    rng, found = np.random.default_rng(0), 0
    for _ in range(records):
        heading = 20 + TABLE + rng.standard_normal(9)
        signals = {"table": TABLE[:, None], "heading": heading[:, None]}
        run = Run.raw("nine", signals, units={"table": "deg", "heading": "deg"})
        found += bool(close(compass, [run], catalogue=(*CATALOGUE, *own)).effects)
    assert found < few


ASKEW = """
from casest import effect, param, signal, sin


@effect(on="reading")
def in_degrees(y, table=signal("deg"), *, k=param("deg")):
    return y + k * sin(table)


@effect(on="reading")
def in_metres(y, table=signal("m"), *, k=param("deg")):
    return y + k * table


@effect(on="reading")
def unfinished(y, *, k=param("deg")):
    y + k
"""


def test_what_is_asked_for_and_cannot_be_tried_is_in_the_headline(tmp_path, headings, capsys):
    (tmp_path / "askew.py").write_text(ASKEW, encoding="utf-8")
    result = headings("close", "before", "--effects", "askew.py")
    said = " ".join(capsys.readouterr().out.split())
    assert "in_degrees, in_metres, unfinished could not be tried" in said
    reasons = {n["name"]: n["reason"] for n in result["not_tried"]}
    assert "or multiply degrees by pi / 180" in reasons["in_degrees"]
    assert reasons["in_metres"].endswith("declare table=signal('deg')")
    assert "it returns nothing" in reasons["unfinished"]
