"""`casest plan`: poses in words that lead there, what they bring, and what is refused."""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from casest import calibrate_many
from casest.cli import run
from casest.demo import RECORD
from casest.plan.candidates.attitudes import Frame, attitude_words, attitudes, directions, words
from casest.plan.candidates.candidates import Noise
from casest.plan.candidates.poses import poses
from casest_problems.norm import norm_diagonal, norm_triangular
from casest_problems.pair import norm_pair

AXES = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}


def followed(text):
    """Where up is, in the sensor, for who does what the words say: turns about its own axes."""
    first = re.match(r"(−?)(\w) (up|down)", text)
    up = np.array(AXES[first[2]], float) * (1 if first[3] == "up" else -1)
    turn = Rotation.identity()
    for angle, axis in re.findall(r"(−?\d+)° about (\w)", text):
        turn = turn * Rotation.from_rotvec(
            np.radians(float(angle.replace("−", "-"))) * np.array(AXES[axis])
        )
    return turn.inv().apply(up)


def test_who_follows_the_words_ends_in_the_pose():
    for up in directions():
        assert np.degrees(np.arccos(np.clip(followed(words(up)) @ up, -1, 1))) < 0.6


def test_who_follows_the_words_of_an_attitude_has_the_right_side_to_the_north():
    for R in attitudes()[::37]:
        text = attitude_words(R, Frame(ahead="north"))
        first = re.match(r"(\w) (up|down), (−?)(\w) north", text)
        lying = np.zeros((3, 3))
        lying[2] = np.array(AXES[first[1]]) * (1 if first[2] == "up" else -1)
        lying[0] = np.array(AXES[first[4]]) * (-1 if first[3] else 1)
        lying[1] = np.cross(lying[2], lying[0])
        for angle, axis in re.findall(r"(−?\d+)° about (\w)", text):
            turn = np.radians(float(angle.replace("−", "-"))) * np.array(AXES[axis])
            lying = lying @ Rotation.from_rotvec(turn).as_matrix()
        assert np.abs(lying - R).max() < 0.012


def test_within_reach_no_pose_is_further_from_upright():
    up = directions(10, 30)
    assert len(up) > 10
    assert np.degrees(np.arccos(up[:, 2])).max() <= 30 + 1e-6


def test_planned_readings_have_the_known_length_and_the_pair_its_dip():
    scale, offset = np.array([[1.1, 0, 0], [0.1, 0.9, 0], [0, 0.2, 1.2]]), np.array([0.3, -0.2, 1])
    found = poses(
        norm_triangular.having(norm=9.81),
        {"scale": scale, "offset": offset},
        Noise(np.ones(1), {}),
        step=15,
        reach=None,
        others={},
    )
    corrected = (found.signals["v"] - offset) @ scale.T
    assert np.allclose(corrected, 9.81 * found.up)
    values = {"dip": np.array(1.1), "magnetometer_offset": np.array([3.0, 2, 1])}
    pair = poses(norm_pair, values, Noise(np.ones(3), {}), step=45, reach=None, others={})
    a, m = pair.signals["a"], pair.signals["m"] - [3, 2, 1]
    assert np.linalg.norm(a, axis=1) == pytest.approx(9.80665)
    assert np.linalg.norm(m, axis=1) == pytest.approx(50.0)
    assert np.sum(a * m, axis=1) / 9.80665 / 50 == pytest.approx(-np.sin(1.1))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fitted") / "out"
    words = ["calibrate", "norm-triangular", str(RECORD), "--columns", "v=ax,ay,az"]
    words += ["--rate", "50", "--at-rest", "--set", "norm=9.80665 m/s^2", "-o", str(folder)]
    assert run(words) == 0
    return folder


def planned(capsys, *words):
    capsys.readouterr()
    code = run(["plan", *map(str, words), "--json"])
    said = capsys.readouterr()
    assert code == 0, said.err
    return json.loads(said.out)


def refused(capsys, *words):
    capsys.readouterr()
    assert run(["plan", *map(str, words)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("casest: ")
    assert said.count("\n") == 1
    return said


def test_before_any_data_six_positions_are_best_for_a_diagonal_model(capsys):
    found = planned(capsys, "norm-diagonal", "--set", "norm=9.81", "--count", "6")
    up = np.array([m["up"] for m in found["measurements"]])
    faces = np.vstack([np.eye(3), -np.eye(3)])
    assert np.max(up @ faces.T, axis=0) == pytest.approx(np.ones(6))
    assert found["best_possible"]["share_of_std"] > 0.999


def test_the_standard_deviations_of_a_plan_are_those_of_the_fit_afterwards(capsys, tmp_path):
    found = planned(
        capsys, "norm-triangular", "--set", "norm=9.81", "--sensor-noise", "v=0.01", "--count", 30
    )
    v = np.array([m["signals"]["v"] for m in found["measurements"]])
    rng = np.random.default_rng(1)
    noisy = v + 0.01 * rng.standard_normal((2000, *v.shape))
    fits = calibrate_many(norm_triangular.having(norm=9.81), {"v": noisy})
    after = [found["unknowns"][f"offset[{k}]"]["after"] for k in range(3)]
    assert np.std(fits.values["offset"], axis=0) == pytest.approx(after, rel=0.06)


def test_after_a_result_every_standard_deviation_falls(capsys, fitted, tmp_path):
    found = planned(capsys, fitted, "--count", 8)
    result = json.loads((fitted / "result.json").read_text())
    before = result["estimate"]["parameters"]["offset"]["std"]
    assert [found["unknowns"][f"offset[{k}]"]["before"] for k in range(3)] == pytest.approx(before)
    assert all(u["after"] < u["before"] for u in found["unknowns"].values())
    assert run(["plan", str(fitted), "--count", "8", "-o", str(tmp_path / "p")]) == 0
    rows = list(csv.DictReader((tmp_path / "p" / "plan.csv").read_text().splitlines()))
    assert len(rows) == 8
    assert float(rows[0]["vx [m/s^2]"]) == pytest.approx(
        found["measurements"][0]["signals"]["v"][0]
    )
    page = (tmp_path / "p" / "plan.html").read_text()
    assert found["measurements"][0]["words"] in page
    assert page.count("<circle") >= 8 + 24  # planned ones, and those of the record


def test_the_table_of_a_plan_can_be_planned_from_again(capsys, fitted, tmp_path):
    assert run(["plan", str(fitted), "--count", "12", "-o", str(tmp_path)]) == 0
    found = planned(capsys, fitted, "--count", 3, "--candidates", tmp_path / "plan.csv")
    assert found["candidates"] == 12
    assert all(m["words"].startswith("row ") for m in found["measurements"])


def test_as_many_poses_as_a_goal_takes_and_fewer_cannot(capsys, fitted):
    found = planned(capsys, fitted, "--until", "offset<1.2 mm/s^2")
    goal = found["goals"][0]
    assert goal["after"] <= 0.0012 < goal["before"]
    assert found["count"] - found["best_possible"]["at_least"] <= 1
    done = planned(capsys, fitted, "--until", "offset<1 m/s^2")
    assert (done["count"], done["measurements"]) == (0, [])


def test_one_unknown_or_the_corrected_reading_can_be_what_counts(capsys, fitted):
    one = planned(capsys, fitted, "--count", 3, "--criterion", "offset[0]")["unknowns"]
    every = planned(capsys, fitted, "--count", 3)["unknowns"]
    assert one["offset[0]"]["after"] < every["offset[0]"]["after"]
    goal = planned(capsys, fitted, "--until", "corrected<0.0035 m/s^2")["goals"][0]
    assert goal["after"] <= 0.0035 < goal["before"]


def test_what_cannot_be_planned_is_said_in_one_sentence(capsys, fitted, tmp_path):
    assert "determine every unknown" in refused(capsys, "norm-full", "--set", "norm=9.81")
    held = ["--fix", "scale=1,1,1", "--fix", "offset=0,0,0"]
    assert "nothing to plan" in refused(capsys, "norm-diagonal", "--set", "norm=9.81", *held)
    said = refused(capsys, fitted, "--until", "offset<1e-5 m/s^2")
    assert "cannot be reached with 200 measurements: the best possible are offset" in said
    assert "did you mean offset" in refused(capsys, fitted, "--until", "ofset<1e-5 m/s^2")
    assert "write NAME<NUMBER UNIT" in refused(capsys, fitted, "--until", "offset=3")
    assert "K" in refused(capsys, fitted, "--until", "offset<1 K")
    assert "--sensor-noise v=STD" in refused(
        capsys, "norm-diagonal", "--set", "norm=9.81", "--until", "offset<1"
    )
    assert "plan more" in refused(capsys, "norm-triangular", "--set", "norm=9.81", "--count", 8)
    (tmp_path / "c.csv").write_text("a,b\n1,2\n")
    assert "v" in refused(capsys, fitted, "--candidates", tmp_path / "c.csv")
    assert "0 to 180 degrees" in refused(capsys, fitted, "--reach", 270)
    assert "--vary temp=…" in refused(capsys, fitted, "--vary", "temp=1,2")
    assert "leave --set out" in refused(capsys, fitted, "--set", "norm=1")


def test_a_result_of_an_older_casest_says_so(capsys, fitted, tmp_path):
    old = json.loads((fitted / "result.json").read_text())
    del old["estimate"]["correlation"]["information"]
    (tmp_path / "result.json").write_text(json.dumps(old))
    assert "calibrate again" in refused(capsys, tmp_path)


def test_a_scale_from_the_laboratory_leaves_the_offset_to_plan(capsys):
    found = planned(
        capsys, "norm-diagonal", "--set", "norm=9.81", "--fix", "scale=1,1,1", "--count", 6
    )
    assert list(found["unknowns"]) == ["offset[0]", "offset[1]", "offset[2]"]
    assert norm_diagonal.name == found["model"]
