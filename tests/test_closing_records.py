"""The closing loop on measured records: what they can support, and what they cannot."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import casest as c
from casest import load_runs
from casest.cli import run
from casest.closing.closed import OF_NOISE
from casest.closing.loop import close
from casest.problem import find_model


def at_rest(unit):
    """A sensor at rest reads its bias."""

    @c.model
    def constant_bias(v=c.signal(3, unit), *, bias=c.param(3, unit)):
        return c.Residual(measured=v, predicted=c.quantity("reading", bias, unit))

    return constant_bias


def closed(shared_data, file, columns, unit, model=None, **options):
    model = model or at_rest(unit)
    units = {"v": unit, **options.pop("units", {})}
    runs = load_runs(
        shared_data / file, model.signals, columns={"v": columns}, units=units, **options
    )
    return close(model, runs)


def labels(found):
    return [e.candidate.label for e in found.effects]


def rms(parts):
    return np.sqrt(np.mean(np.vstack(parts) ** 2, axis=0))


@pytest.mark.parametrize("unit", ["imu0", "imu1", "imu2"])
def test_the_mpu9150s_skew_is_found_and_nothing_else(shared_data, tmp_path, unit):
    """Three units of 23 or fewer positions: the model without skew lacks the skew."""
    log = str(shared_data / "mpu9150-mikoff" / f"{unit}.log")
    arguments = ["close", "norm-diagonal", log, "--columns", "v=0,1,2", "--rate", "100"]
    assert run([*arguments, "--at-rest", "--set", "norm=9.80665", "-o", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert [e["name"] for e in result["effects"]] == ["cross_axis"]


@pytest.mark.parametrize("unit", ["imu0", "imu1", "imu2"])
def test_with_its_skew_the_mpu9150_is_predicted_several_times_better(shared_data, unit):
    model = find_model("norm-diagonal").having(norm=9.80665)
    file = f"mpu9150-mikoff/{unit}.log"
    found = closed(shared_data, file, "0,1,2", "m/s^2", model, rate=100, at_rest=True)
    assert rms(found.after_held_out) < rms(found.before_held_out) / 4


def test_a_cooling_gyro_has_an_offset_that_time_explains_as_well_as_temperature(shared_data):
    """They are correlated by -0.999: whichever is kept, the other must be named."""
    found = closed(
        shared_data,
        "psim-thermal/TVCtest3_7_20.csv",
        "gyrox,gyroy,gyroz",
        "rad/s",
        scales={"temp": "int16/256+25"},
        units={"temp": "degC"},
    )
    (moved,) = [e for e in found.effects if e.candidate.label not in OF_NOISE]
    named = {moved.candidate.label, *moved.indistinguishable_from}
    assert {"temperature_bias(temp)", "bias_drift"} <= named
    assert "outliers" in labels(found)  # two spikes in x
    assert np.all(rms(found.after_held_out)[:2] < 0.5 * rms(found.before_held_out)[:2])


def test_the_mpu6050_at_rest_has_no_nonlinearity_and_hardly_anything_to_gain(shared_data):
    """100 s at rest: no input varies; drift and step are not told apart in it."""
    file = "mpu6050-tomisuarez/imu_static_test.csv"
    found = closed(shared_data, file, "gx,gy,gz", "count", rate=100)
    assert set(labels(found)) <= {"vibration", "bias_step", "bias_drift"}
    for e in found.effects:
        if e.candidate.label in ("bias_step", "bias_drift"):
            assert {"bias_step", "bias_drift"} & set(e.indistinguishable_from)
    assert np.all(rms(found.after_held_out) > 0.98 * rms(found.before_held_out))


def test_the_accelerometer_beside_it_has_nothing_but_samples_far_out(shared_data):
    file = "mpu6050-tomisuarez/imu_static_test.csv"
    assert set(labels(closed(shared_data, file, "ax,ay,az", "count", rate=100))) <= {"outliers"}


@pytest.mark.parametrize("which", ["noisy", "filtered"])
def test_a_magnetometer_turned_by_hand_asks_for_no_cubic(shared_data, which):
    """Of its misfit of 6 % of the radius no effect explains a good part."""
    file = f"qmc5883l-tomisuarez/{which}_raw_data.csv"
    model = find_model("norm-triangular").having(norm=1.0)
    found = closed(shared_data, file, "mx,my,mz", "count", model, rate=50)
    assert not {"cubic", "signed_cubic"} & set(labels(found))
    assert rms(found.after_held_out) > 0.85 * rms(found.before_held_out)


def from_the_command_line(tmp_path, *arguments):
    assert run(["close", *map(str, arguments), "-o", str(tmp_path)]) == 0
    return json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))


def test_the_example_of_a_gyro_at_rest_traces_a_cold_test(shared_data, tmp_path):
    """The z axis is the control: what x and y follow is not in it."""
    example = Path(__file__).parents[1] / "examples" / "at_rest.py"
    record = shared_data / "psim-thermal" / "TVCtest3_7_20.csv"
    result = from_the_command_line(
        tmp_path, example, record, "--columns", "v=gyrox,gyroy,gyroz", "--unit", "v=rad/s",
        "--scale", "temp=int16/256+25", "--unit", "temp=degC",
    )  # fmt: skip
    assert result["verdict"] == "extended"
    (moved,) = [e for e in result["effects"] if e["name"] not in OF_NOISE]
    assert {moved["name"], *(n.partition("(")[0] for n in moved["indistinguishable_from"])} >= {
        "temperature_bias",
        "bias_drift",
    }
    before, after = (result[k]["rmse_holdout_by_axis"] for k in ("before", "after"))
    assert after["y"] < 0.45 * before["y"]
    assert 0.95 < after["z"] / before["z"] < 1.0


def test_of_the_mpu6050_at_rest_the_accelerometer_is_adequate_and_nothing_is_a_formula(
    shared_data, tmp_path
):
    model = tmp_path / "rest.py"
    example = Path(__file__).parents[1] / "examples" / "at_rest.py"
    model.write_text(example.read_text(encoding="utf-8").replace("rad/s", "count"))
    record = shared_data / "mpu6050-tomisuarez" / "imu_static_test.csv"
    options = ("--unit", "v=count", "--rate", "100")
    still = from_the_command_line(tmp_path, model, record, "--columns", "v=ax,ay,az", *options)
    assert still["verdict"] == "adequate"
    gyro = from_the_command_line(tmp_path, model, record, "--columns", "v=gx,gy,gz", *options)
    assert "formula" not in [e["name"] for e in gyro["effects"]]
    assert gyro["after"]["rmse_holdout"] > 0.99 * gyro["before"]["rmse_holdout"]


def test_six_orientations_have_none_to_spare(shared_data, tmp_path):
    """A Ferraris session: without one of its six positions the rest foretells nothing of it."""
    record = shared_data / "imucal" / "example_ferraris_session.csv"
    result = from_the_command_line(
        tmp_path, "norm-diagonal", record, "--columns", "v=acc_x,acc_y,acc_z", "--unit",
        "v=m/s^2", "--rate", "102.4", "--at-rest", "--set", "norm=9.80665",
    )  # fmt: skip
    assert result["verdict"] is None
    assert result["trusted"]
    assert any("record more orientations" in r["reason"] for r in result["refused"])
