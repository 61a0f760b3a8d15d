"""Magnetometer and gyroscope in continuous motion: simulated by SciPy's rotations, and measured."""

import json
from math import radians

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from casest import Run, signal
from casest.cli import run as cli
from casest.cli.assignments import Assignment
from casest.cli.loading import moving_model
from casest.cli.options import MotionOptions
from casest.dynamics import Motion, constraint, dynamics, measured, state
from casest.dynamics.course import followed
from casest.dynamics.filter import filtered

EARTH = np.array([18.0, -4.0, 43.0])
IRON = np.array([[1.0, 0.05, -0.02], [0.03, 0.9, 0.04], [-0.01, 0.02, 1.1]])
OFFSET, DRIFT = np.array([12.0, -7.0, 4.0]), np.array([0.4, -0.3, 0.2])


def waved(path, seconds=40.0, rate=25.0):
    """A record in deg/s and mG, with columns that are called otherwise."""
    rng, t, h = np.random.default_rng(5), np.arange(0, seconds, 1 / rate), 1e-4

    def attitude(at):
        angles = np.array([[1.2], [0.9], [2.0]]) * np.sin(
            np.array([[0.9], [1.3], [0.5]]) * at + [[0.3], [1.0], [2.0]]
        )
        return Rotation.from_euler("ZYX", angles.T)

    turn = np.degrees((attitude(t - h).inv() * attitude(t + h)).as_rotvec() / (2 * h))
    field = attitude(t).inv().apply(EARTH) @ IRON.T + OFFSET
    w = turn + DRIFT + 0.2 * rng.standard_normal(turn.shape)
    m = 10 * (field + 0.3 * rng.standard_normal(field.shape))
    header = "time,MagX [mgauss],MagY [mgauss],MagZ [mgauss],gx [deg/s],gy [deg/s],gz [deg/s]"
    np.savetxt(path, np.column_stack([t, m, w]), delimiter=",", header=header, comments="")
    return path


@pytest.mark.long
def test_iron_offset_and_bias_are_found_without_a_rest(tmp_path):
    record = waved(tmp_path / "waved.csv")
    words = ["--columns", "t=time", "--columns", "m=MagX,MagY,MagZ", "--columns", "w=gx,gy,gz"]
    noise = ["--sensor-noise", "m=3 mgauss", "--sensor-noise", "w=0.2 deg/s"]
    out = tmp_path / "out"
    assert cli(["filter", "mag-gyro", str(record), *words, *noise, "-o", str(out)]) == 0
    found = json.loads((out / "filter.json").read_text(encoding="utf-8"))["states"]
    truth = {"iron": IRON.ravel()[1:], "offset": OFFSET, "drift": [radians(d) for d in DRIFT]}
    for name, value in truth.items():
        off = (np.array(found[name]["value"]) - value) / found[name]["std"]
        assert np.all(np.abs(off) < 4), (name, off)
    assert np.all(np.array(found["offset"]["std"]) < 0.1)
    assert np.all(np.array(found["drift"]["std"]) < 0.001)


@pytest.mark.long
def test_a_measured_record_gives_the_offset_that_cameras_give(shared_data):
    """BROAD's trial 26: offset with the optical attitude, which the estimator does not see, by
    linear least squares (-1.98, 0.32, -3.10) uT, iron within 0.04 of one."""
    from casest_problems.mag_gyro import mag_gyro

    rows = np.genfromtxt(shared_data / "broad" / "mag26.csv", delimiter=",", skip_header=1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    t, m, w = rows[:, 0], rows[:, 1:4], rows[:, 11:14]
    run = Run.raw("waved", {"m": m, "w": w}, units={"m": "uT", "w": "rad/s"}, time=t)
    found = filtered(mag_gyro.sensing(m=1.0**2 * 0.035, w=0.1**2 * 0.035), run)
    assert found.settled
    offset = found.smoothed[-1, 11:14]
    assert np.all(np.abs(offset - [-1.98, 0.32, -3.10]) < 0.3), offset
    assert np.all(np.abs(offset) + 1 > np.abs([-1.98, 0.32, -3.10]))


@pytest.mark.parametrize(
    ("option", "said", "because"),
    [
        (
            "--std",
            "offset=2 s",
            "s does not convert to uT: one is a time, the other a magnetic field",
        ),
        ("--std", "offset=wide", "'wide' is no number; write it as 0.2 (uT) or with its unit"),
        (
            "--sensor-noise",
            "w=0.2 uT",
            "uT does not convert to rad/s: one is a magnetic field, the other an angular",
        ),
        (
            "--sensor-noise",
            "w=loud",
            "in motion a sensor's noise is one number for all its readings and axes",
        ),
    ],
)
def test_what_is_known_in_another_unit_is_named(tmp_path, capsys, option, said, because):
    record = waved(tmp_path / "waved.csv", seconds=1)
    words = ["--columns", "t=time", "--columns", "m=MagX,MagY,MagZ", "--columns", "w=gx,gy,gz"]
    assert cli(["filter", "mag-gyro", str(record), *words, option, said]) == 1
    assert f"{option} {said}: {because}" in capsys.readouterr().err


def test_what_is_known_takes_units():
    moving = moving_model(
        "bias-gravity-magnitude",
        (Assignment("--set", "gravity_magnitude=981 cm/s^2"),),
        MotionOptions(stds=(Assignment("--std", "velocity=36 km/h"),)),
    )
    assert moving["velocity"].std == pytest.approx(10)
    (known,) = moving.constants
    assert known.array == pytest.approx(9.81)


@dynamics
def product(y=signal(), *, gain=state(start=1.0, std=5.0), level=state(start=1.0, std=5.0)):
    """A gain and a level of which only the product is read; the level is known exactly."""
    return Motion(
        rates={},
        outputs=(measured(y, gain * level, std=0.01),),
        constraints=(constraint(level, 2),),
    )


def test_what_is_known_exactly_holds_from_afar():
    """Their product is six and the level two: the gain is three, though its valley is bent."""
    rng, n = np.random.default_rng(0), 400
    y = 6 + 0.01 * rng.standard_normal((n, 1))
    run = Run.raw("read", {"y": y}, units={"y": "1"}, time=np.arange(n) * 0.1)
    for found in (filtered(product, run), followed(product, run)):
        gain, level = found.smoothed[-1]
        assert level == pytest.approx(2, abs=1e-9)
        assert gain == pytest.approx(y.mean() / 2, abs=2e-5)
        assert found.settled
