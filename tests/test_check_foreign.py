"""`casest check` of a correction that ROS, Kalibr, ArduPilot or PX4 wrote."""

from __future__ import annotations

import json
import shlex

import numpy as np
import pytest

from casest import Run
from casest.cli import run as casest
from casest.correction.formats_read import sensors_read
from casest.saved.check_foreign import foreign_estimate
from casest.validity.check import check
from casest_problems.norm import norm_triangular

G = 9.80665
#: PX4's correction: scale·(reading − offset), axis by axis.
PX4 = """# onboard parameters
1 1 CAL_ACC0_XOFF 0.3 9
1 1 CAL_ACC0_YOFF -0.2 9
1 1 CAL_ACC0_ZOFF 0.5 9
1 1 CAL_ACC0_XSCALE 1.02 9
1 1 CAL_ACC0_YSCALE 0.98 9
1 1 CAL_ACC0_ZSCALE 1.01 9
"""
KNOCK = np.array([0, 0, 0.07])
OFFSET, DIAGONAL = np.array([0.3, -0.2, 0.5]), np.array([1.02, 0.98, 1.01])
#: imu_calib's: SM·reading − bias, with axes that are not square.
SM = np.array([[1.02, 0.03, 0.0], [-0.01, 0.98, 0.02], [0.02, 0.0, 1.01]])
ROS = f"SM: {SM.ravel().tolist()}\nbias: {(SM @ OFFSET).tolist()}\n"


def poses(rng, matrix, offset, count=24, noise=0.01):
    n = rng.standard_normal((count, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    return np.linalg.solve(matrix, G * n.T).T + offset + rng.normal(0, noise, n.shape)


def written(path, v):
    header = "ax [g],ay [g],az [g]"
    np.savetxt(path, v / G, delimiter=",", header=header, comments="", fmt="%.15g")
    return str(path)


@pytest.fixture
def there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "px4.params").write_text(PX4)
    (tmp_path / "imu_calib.yaml").write_text(ROS)
    rng = np.random.default_rng(1)
    for name, matrix in (("px4", np.diag(DIAGONAL)), ("ros", SM)):
        written(tmp_path / f"{name}.csv", poses(rng, matrix, OFFSET))
        written(tmp_path / f"{name}_knocked.csv", poses(rng, matrix, OFFSET + KNOCK))
    return tmp_path


@pytest.mark.parametrize(("file", "name"), [("px4.params", "px4"), ("imu_calib.yaml", "ros")])
def test_a_knock_is_found_and_repaired(there, capsys, file, name):
    words = ["--set", "norm=1 g", "--columns", "a=ax,ay,az", "-o", "out"]
    assert casest(["check", file, f"{name}.csv", *words]) == 0
    assert "taken as exact" in " ".join(capsys.readouterr().out.split())
    assert casest(["check", file, f"{name}_knocked.csv", *words]) == 2
    said = json.loads((there / "out" / "check.json").read_text())
    (moved,) = said["changed"]
    assert moved["name"] == "offset[2]"
    assert abs(moved["now"] - 0.57) < 4 * moved["std"]
    assert said["noise"]["before"] is None
    # What it proposes runs, and gives the offset that is there now.
    assert casest([*shlex.split(said["recalibrate"]["command"])[1:], "-o", "again"]) == 0
    again = json.loads((there / "again" / "result.json").read_text())
    offset = np.array(again["estimate"]["parameters"]["offset"]["value"]) * G
    np.testing.assert_allclose(offset, OFFSET + KNOCK, atol=0.02)


def test_a_length_does_not_see_how_the_sensor_is_mounted(tmp_path):
    """A correction turned as a whole is the same one."""
    (tmp_path / "a.yaml").write_text(ROS)
    rng, alarms = np.random.default_rng(3), 0
    (sensor,) = sensors_read(tmp_path / "a.yaml")
    old = foreign_estimate(sensor, norm_triangular, norm_triangular.having(norm="1 g")["norm"])
    turned, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    for _ in range(40):
        v = poses(rng, turned @ SM, OFFSET)
        runs = (Run.raw("poses", {"v": v}, units={"v": "m/s^2"}),)
        alarms += not check(old, [runs], level=0.05).valid
    assert alarms <= 6  # of 40 at 5 % more are in 1 of 300 such studies


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["px4.params", "px4.csv", "--columns", "a=ax,ay,az"], "--set 'norm=9.80665 m/s^2'"),
        (["px4.params", "px4.csv", "--set", "norm=48 uT", "--columns", "a=ax,ay,az"], "uT"),
        (["gyro.params", "px4.csv", "--set", "norm=1", "--columns", "w=ax,ay,az"], "gyroscope"),
        (["px4.params", "few.csv", "--set", "norm=1 g", "--columns", "a=ax,ay,az"], "more reading"),
    ],
    ids=["no length", "another length", "a gyroscope", "six poses"],
)
def test_what_cannot_be_checked_is_a_sentence(there, capsys, words, said):
    (there / "gyro.params").write_text(PX4.replace("ACC0", "GYRO0"))
    written(there / "few.csv", poses(np.random.default_rng(0), SM, OFFSET, 6))
    assert casest(["check", *words]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
