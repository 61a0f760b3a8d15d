"""A column of the motion describes what goes with the motion, and is no cause."""

from __future__ import annotations

import json

import numpy as np
import pytest

from casest.cli import run
from casest.diagnose.candidates.motion_columns import columns_of_motion
from casest.effects.placing import prepared


def turning(seed, size=500):
    """Directions of a body that is turned about by hand (N, 3), and its rate about y in rad/s."""
    t = np.arange(size) / 50
    a = 1.3 * np.sin(0.7 * t) + 0.9 * np.sin(0.31 * t + seed)
    b = 2.1 * np.sin(0.43 * t + 1) + 0.5 * np.sin(1.1 * t)
    direction = np.stack([np.cos(a) * np.cos(b), np.sin(b), np.sin(a) * np.cos(b)], axis=1)
    return t, direction, np.gradient(a, t)


def record(path, by, column, unit, amount):
    """A magnetometer in a field of 48 uT, whose length follows `by` by 2 %."""
    rng = np.random.default_rng(3)
    t, direction, rate = turning(3)
    follows = {"motion": rate, "current": np.sin(2.9 * t) ** 3}[by]
    reading = 48 * direction * (1 + amount * follows[:, None]) + [3.0, -5.0, 8.0]
    reading += 0.05 * rng.standard_normal(reading.shape)
    head = f"t [s],v_x [uT],v_y [uT],v_z [uT],{column} [{unit}]"
    np.savetxt(path, np.c_[t, reading, follows], delimiter=",", header=head, comments="")


@pytest.fixture
def closed(tmp_path):
    def result(by, column, unit, *options):
        record(tmp_path / "r.csv", by, column, unit, 0.02)
        words = ["close", "norm-diagonal", str(tmp_path / "r.csv"), "--set", "norm=48 uT"]
        assert run([*words, *options, "-o", str(tmp_path)]) == 0
        return json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))

    return result


def test_what_follows_a_gyroscope_is_named_and_not_claimed(closed):
    found = closed("motion", "gyr_y", "rad/s")
    assert found["effects"] == []
    assert found["verdict"] == "unexplained"
    assert "channel_gain(gyr_y)" in found["unexplained"]["one_of"]


@pytest.mark.long
def test_who_asks_for_it_has_it(closed):
    found = closed("motion", "gyr_y", "rad/s", "--effects", "channel_gain(gyr_y)")
    assert [(e["name"], e["column"]) for e in found["effects"]] == [("channel_gain", "gyr_y")]
    assert np.abs(found["effects"][0]["parameters"]["k"]["value"]) == pytest.approx(0.02, abs=1e-3)


@pytest.mark.long
def test_a_current_is_a_cause(closed):
    found = closed("current", "amps", "A")
    assert [(e["name"], e["column"]) for e in found["effects"]] == [("channel_gain", "amps")]


@pytest.mark.parametrize(
    ("column", "motion"),
    [
        ("acc_z [m/s^2]", True), ("w [deg/s]", True), ("second [uT]", True), ("gy", True),
        ("mag_x", True), ("q0", True), ("pitch", True), ("amps [A]", False), ("temp", False),
        ("supply [V]", False), ("throttle", False), ("gain", False), ("max [degC]", False),
    ],
)  # fmt: skip
def test_columns_of_motion_are_known_by_unit_or_name(tmp_path, column, motion):
    from casest import load_runs
    from casest.results.find import find_model

    path, model = tmp_path / "r.csv", find_model("norm-diagonal")
    rows = np.c_[np.eye(3), [1, 2, 3]]
    np.savetxt(path, rows, delimiter=",", header=f"v_x,v_y,v_z,{column}", comments="")
    runs = load_runs([str(path)], model.signals)
    name = column.partition(" ")[0]
    assert columns_of_motion(model, runs) == ({name} if motion else set())


@pytest.mark.parametrize(
    ("names", "alike", "motion"),
    [
        ("beschl1 beschl2 beschl3", False, True), ("dreh.x dreh.y dreh.z", False, True),
        ("kanal0 kanal1 kanal2", False, True), ("temp1 temp2 temp3", True, False),
        ("motor1 motor2 motor3 motor4", False, False),
    ],
)  # fmt: skip
def test_axes_of_another_sensor_are_known_whatever_it_is_called(tmp_path, names, alike, motion):
    from casest import load_runs
    from casest.results.find import find_model

    rng, columns = np.random.default_rng(8), names.split()
    rows = rng.standard_normal((40, 3 + len(columns)))
    if alike:
        rows[:, 3:] = 20 + np.linspace(0, 5, 40)[:, None] + 0.1 * rows[:, 3:]
    path, model = tmp_path / "r.csv", find_model("norm-diagonal")
    head = ",".join(["v_x", "v_y", "v_z", *columns])
    np.savetxt(path, rows, delimiter=",", header=head, comments="")
    runs = prepared(model, load_runs([str(path)], model.signals))
    assert columns_of_motion(model, runs) == (set(columns) if motion else set())


def test_three_columns_of_words_are_no_vector(tmp_path):
    from casest import load_runs
    from casest.results.find import find_model

    path, model = tmp_path / "r.csv", find_model("norm-diagonal")
    path.write_text("v_x,v_y,v_z,note1,note2,note3\n1,0,0,a,b,c\n0,1,0,d,e,f\n0,0,1,a,b,g\n")
    runs = prepared(model, load_runs([str(path)], model.signals))
    assert columns_of_motion(model, runs) == set()
