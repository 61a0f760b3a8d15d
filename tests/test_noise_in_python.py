"""Noise that is stated in Python is what the prompt takes, word for word."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

import casest
from casest.cli import run
from casest.results.find import find_model


@pytest.fixture(scope="module")
def poses(tmp_path_factory):
    """Poses of an accelerometer with gains and offsets, in g, and a column of their noise."""
    rng = np.random.default_rng(8)
    direction = rng.standard_normal((40, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    v = direction * [1.02, 0.97, 1.01] + [0.02, -0.03, 0.01] + 0.004 * rng.standard_normal((40, 3))
    frame = pd.DataFrame(v, columns=["ax", "ay", "az"]).assign(spread=0.004)
    path = tmp_path_factory.mktemp("poses") / "poses.csv"
    frame.to_csv(path, index=False)
    return path, frame


@pytest.mark.parametrize(
    ("words", "noise"),
    [
        ("v=4 mg", {"v": "4 mg"}),
        ("v=0.004,0.004,0.008", {"v": [0.004, 0.004, 0.008]}),
        ("v=spread,spread,spread", {"v": "spread,spread,spread"}),
        ("v=16e-6,4e-6,0;4e-6,16e-6,0;0,0,16e-6", {"v": 1e-6 * np.array(
            [[16, 4, 0], [4, 16, 0], [0, 0, 16.0]])}),
    ],
)  # fmt: skip
def test_python_takes_what_the_prompt_takes(poses, tmp_path, words, noise):
    path, frame = poses
    said = ["calibrate", "norm-diagonal", str(path), "--columns", "v=ax,ay,az", "--unit", "v=g"]
    assert run([*said, "--set", "norm=1 g", "--sensor-noise", words, "-o", str(tmp_path)]) == 0
    prompt = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    found = casest.calibrate(
        find_model("norm-diagonal").having(norm="1 g"),
        frame,
        columns={"v": ["ax", "ay", "az"]},
        units={"v": "g"},
        sensor_noise=noise,
    )
    for name, told in prompt["estimate"]["parameters"].items():
        assert np.ravel(found.values[name]) == pytest.approx(np.ravel(told["value"]), rel=1e-9)
        assert np.ravel(found.std[name]) == pytest.approx(np.ravel(told["std"]), rel=1e-7)


@pytest.mark.parametrize(
    ("noise", "match"),
    [
        ({"u": 0.1}, "norm-diagonal has no signal 'u'; it has v"),
        ({"v": -0.1}, "sensor_noise v=-0.1: a standard deviation is above zero"),
        ({"v": "much"}, "no column of"),
        ({"v": "0.004 K"}, "sensor_noise v=0.004 K"),
        (
            {"v": np.full((40, 3), 0.004)},
            r"v: an array of shape \(40, 3\) is no noise of one reading",
        ),
    ],
)
def test_what_is_no_noise_is_refused_in_pythons_words(poses, noise, match):
    model = find_model("norm-diagonal").having(norm="1 g")
    with pytest.raises(casest.CasestError, match=match):
        casest.calibrate(
            model, poses[1], columns={"v": "ax,ay,az"}, units={"v": "g"}, sensor_noise=noise
        )


def test_columns_of_a_frame_are_found_by_their_names(poses):
    """As of a file: else what was written down of the noise would be left out unsaid."""
    model = find_model("norm-diagonal").having(norm="1 g")
    said = {"columns": {"v": "ax,ay,az"}, "units": {"v": "g"}}
    frame = poses[1].rename(columns={"spread": "u_v"})
    found = casest.calibrate(model, frame, **said)
    named = casest.calibrate(model, poses[1], sensor_noise={"v": "spread"}, **said)
    assert found.noise.chi_square == named.noise.chi_square
    assert found.covariance == pytest.approx(named.covariance, rel=1e-9)


def test_noise_that_is_stated_twice_is_refused(poses, capsys):
    said = ["calibrate", "norm-diagonal", str(poses[0]), "--columns", "v=ax,ay,az", "--unit", "v=g"]
    assert run([*said, "--sensor-noise", "v=0.02", "--sensor-noise", "v=0.03"]) == 1
    assert (
        "--sensor-noise v=0.02 and --sensor-noise v=0.03: v has one value"
        in capsys.readouterr().err
    )
