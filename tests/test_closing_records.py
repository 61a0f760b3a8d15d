"""The closing loop on measured records: what they can support, and what they cannot."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from casest import load_runs
from casest.cli import run
from casest.diagnose.loop import close
from casest.effects import CATALOGUE
from casest.results.find import find_model

EXAMPLE = Path(__file__).parents[1] / "examples" / "at_rest.py"
OF_NOISE = {effect.name for effect in CATALOGUE if effect.kind == "noise"}
COOLING = (
    "psim-thermal/TVCtest3_7_20.csv", "--columns", "v=gyrox,gyroy,gyroz", "--unit", "v=rad/s",
    "--scale", "temp=int16/256+25", "--unit", "temp=degC",
)  # fmt: skip
STILL = ("mpu6050-tomisuarez/imu_static_test.csv", "--unit", "v=count", "--rate", "100")
GYRO, ACCELEROMETER = (*STILL, "--columns", "v=gx,gy,gz"), (*STILL, "--columns", "v=ax,ay,az")
MODELS = Path(__file__).parents[1] / "studies" / "record_models.py"
POSITIONS = ("--columns", "v=0,1,2", "--rate", "100", "--at-rest", "--set", "norm=9.80665")


@pytest.fixture(scope="module")
def closed(shared_data, tmp_path_factory):
    """The result of `casest close MODEL FILE OPTIONS`, made once for all tests of a record."""

    @cache
    def result(model, file, *options):
        folder = tmp_path_factory.mktemp("closed")
        words = ["close", str(model), str(shared_data / file), *options, "-o", str(folder)]
        assert run(words) == 0
        return json.loads((folder / "result.json").read_text(encoding="utf-8"))

    return result


@pytest.fixture(scope="module")
def counting(tmp_path_factory):
    """The example of a sensor at rest, which reads counts."""
    model = tmp_path_factory.mktemp("model") / "rest.py"
    text = EXAMPLE.read_text(encoding="utf-8")
    model.write_text(text.replace("rad/s", "count"), encoding="utf-8")
    return model


def labels(result):
    return [_label(e) for e in result["effects"]]


def _label(effect):
    return f"{effect['name']}({effect['column']})" if effect["column"] else effect["name"]


def improved(result):
    """Error on data the fit never saw, after over before, of every axis."""
    before, after = (result[k]["rmse_holdout_by_axis"] for k in ("before", "after"))
    return {axis: after[axis] / before[axis] for axis in before}


UNITS = [pytest.param(f"imu{k}", marks=[pytest.mark.long] * (k != 1)) for k in range(3)]


@pytest.mark.long
@pytest.mark.parametrize("unit", UNITS)
def test_the_mpu9150s_skew_is_found_and_nothing_else(closed, unit):
    """Three units of 23 or fewer positions: the model without skew lacks the skew.

    A norm does not tell it from two entries of a whole matrix of gains: then both are named.
    """
    result = closed("norm-diagonal", f"mpu9150-mikoff/{unit}.log", *POSITIONS)
    (effect,) = result["effects"]
    named = {effect["name"], *effect["indistinguishable_from"]}
    assert "cross_axis" in named
    assert named <= {"cross_axis", "gain_matrix"}


@pytest.mark.parametrize("unit", UNITS)
def test_with_its_skew_the_mpu9150_is_predicted_several_times_better(closed, unit):
    result = closed("norm-diagonal", f"mpu9150-mikoff/{unit}.log", *POSITIONS)
    assert max(improved(result).values()) < 1 / 4


@pytest.mark.long
def test_a_cooling_gyro_has_an_offset_that_time_explains_as_well_as_temperature(closed):
    """They are correlated by -0.999: whichever is kept, the other must be named."""
    result = closed(EXAMPLE, *COOLING)
    (moved,) = [e for e in result["effects"] if e["name"] not in OF_NOISE]
    named = {_label(moved), *moved["indistinguishable_from"], *moved["less_likely"]}
    bent = {"temperature_bias(temp)", "temperature_curve(temp)"}
    assert named & bent
    assert named & {"bias_drift", "warm_up"}
    assert "outliers" in labels(result)  # two spikes in x
    assert improved(result)["x"] < 0.5
    assert improved(result)["y"] < 0.5


@pytest.mark.long
def test_the_mpu6050_at_rest_has_no_nonlinearity_and_hardly_anything_to_gain(closed, counting):
    """100 s at rest: no input varies; drift and step are not told apart in it."""
    result = closed(counting, *GYRO)
    assert set(labels(result)) <= {"vibration", "bias_step", "bias_drift"}
    for e in result["effects"]:
        if e["name"] in ("bias_step", "bias_drift"):
            assert {"bias_step", "bias_drift"} & set(e["indistinguishable_from"])
    assert min(improved(result).values()) > 0.98


@pytest.mark.long
def test_the_accelerometer_beside_it_has_nothing_but_samples_far_out(closed, counting):
    assert set(labels(closed(counting, *ACCELEROMETER))) <= {"outliers"}


@pytest.mark.long
@pytest.mark.parametrize("which", ["noisy", "filtered"])
def test_a_magnetometer_turned_by_hand_asks_for_no_cubic(shared_data, which):
    """Of its misfit of 6 % of the radius no effect explains a good part."""
    model = find_model("norm-triangular").having(norm=1.0)
    runs = load_runs(
        shared_data / f"qmc5883l-tomisuarez/{which}_raw_data.csv",
        model.signals,
        columns={"v": "mx,my,mz"},
        units={"v": "count"},
        rate=50,
    )
    found = close(model, runs)
    assert not {"cubic", "signed_cubic"} & {e.candidate.label for e in found.effects}
    assert rms(found.after_held_out) > 0.85 * rms(found.before_held_out)


def rms(parts):
    return np.sqrt(np.mean(np.vstack(parts) ** 2, axis=0))


@pytest.mark.long
def test_the_example_of_a_gyro_at_rest_traces_a_cold_test(closed):
    """The z axis is the control: what x and y follow is not in it."""
    result = closed(EXAMPLE, *COOLING)
    assert result["verdict"] != "adequate"
    (moved,) = [e for e in result["effects"] if e["name"] not in OF_NOISE]
    others = [*moved["indistinguishable_from"], *moved["less_likely"]]
    named = {moved["name"], *(n.partition("(")[0] for n in others)}
    assert named & {"temperature_bias", "temperature_curve"}
    assert named & {"bias_drift", "warm_up"}
    assert improved(result)["y"] < 0.45
    assert 0.95 < improved(result)["z"] < 1.0


@pytest.mark.long
def test_of_the_mpu6050_at_rest_the_accelerometer_is_adequate_and_nothing_is_a_formula(
    closed, counting
):
    assert closed(counting, *ACCELEROMETER)["verdict"] == "adequate"
    gyro = closed(counting, *GYRO)
    assert "formula" not in [e["name"] for e in gyro["effects"]]
    assert gyro["after"]["rmse_holdout"] > 0.99 * gyro["before"]["rmse_holdout"]


def test_six_orientations_name_nothing_and_what_is_left_is_said(closed):
    """A Ferraris session: each of its six positions has one unknown to itself. Two rests of one
    position read 10.3422 and 10.3335 m/s^2 (by NumPy), with standard errors below
    0.001; so there is a misfit, as `calibrate` says, and nobody can say of what."""
    result = closed(
        "norm-diagonal", "imucal/example_ferraris_session.csv", "--columns", "v=acc_x,acc_y,acc_z",
        "--unit", "v=m/s^2", "--rate", "102.4", "--at-rest", "--set", "norm=9.80665",
    )  # fmt: skip
    assert result["verdict"] == "unexplained"
    assert result["trusted"]
    assert result["effects"] == []
    assert "between rest intervals" in result["unexplained"]["where"]


@pytest.mark.long
def test_four_plateaus_of_a_load_cell_are_a_straight_line(shared_data, tmp_path):
    """A pair of causes was strong evidence, and each alone is none.

    By NumPy from the means of the plateaus: a quadratic term has F(1, 1) = 0.39. What is left is
    no noise: on the last plateau the load swings at 2.8 Hz, with 17.6 times the mean power of 58
    frequencies (chance 1e-6).
    """
    lines = (shared_data / "swing-project/loadcell_swing.csv").read_text("utf-8").splitlines()
    half = tmp_path / "half.csv"
    half.write_text("\n".join(lines[: 1 + len(lines) // 2]) + "\n", encoding="utf-8")
    words = ["close", f"{MODELS}:cell", str(half), "--columns", "load=load_lb"]
    words += ["--columns", "counts=cellA_counts", "--unit", "load=lbf", "--unit", "counts=count"]
    assert run([*words, "-o", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert labels(result) == []
    assert result["verdict"] == "unexplained"
    assert "a line at 0.2798 cycles per sample" in result["unexplained"]["where"]


@pytest.mark.long
def test_beside_a_lag_the_soft_iron_is_whole_and_no_axis_of_the_motion_a_cause(closed):
    """By NumPy: a lag of 11 ms, a 3x3, an offset while it is moved: 0.744 uT on stretches; what
    else there is makes 0.6 % at most."""
    result = closed(f"{MODELS}:compass", "broad/mag01.csv")
    assert labels(result) == ["signal_lag", "soft_iron", "pulse"]
    assert result["verdict"] == "unexplained"
    assert result["after"]["rmse_holdout"] < 0.75


@pytest.mark.long
def test_what_is_better_alone_comes_before_a_pair_of_others(closed):
    """A magnet that came and went, and iron: not products of two axes with a step."""
    found = labels(closed(f"{MODELS}:compass", "broad/mag32s.csv"))
    assert found[:3] == ["pulse", "signal_lag", "soft_iron"]
    assert not {"cross_quadratic", "cubic", "vibration"} & set(found)


@pytest.fixture(scope="module")
def cut(shared_data, tmp_path_factory):
    """Tables that are made from the records: of MAG3 until the copter falls, of two gyros."""
    folder = tmp_path_factory.mktemp("cut")
    header, *rows = (shared_data / "ardupilot-log171/MAG3_all.csv").read_text("utf-8").splitlines()
    flown = [row for row in rows if float(row.split(",")[0]) < 238.0]
    (folder / "MAG3.csv").write_text("\n".join([header, *flown]) + "\n", encoding="utf-8")
    mine, other = (
        np.genfromtxt(shared_data / f"twistnsync/twist_{who}.csv", delimiter=",", skip_header=1)
        for who in ("mcu", "phone")
    )
    mine = mine[(mine[:, 0] >= other[0, 0]) & (mine[:, 0] <= other[-1, 0])]
    later = [np.interp(mine[:, 0], other[:, 0], other[:, k]) for k in (1, 2, 3)]
    names = [f"{signal}_{axis} [rad/s]" for signal in "wu" for axis in "xyz"]
    np.savetxt(
        folder / "twist.csv", np.column_stack([mine[:, :4], *later]),
        delimiter=",", header=",".join(["t [s]", *names]), comments="",
    )  # fmt: skip
    return folder


@pytest.mark.long
def test_behind_a_lag_of_a_third_of_a_second_nothing_stands_in_for_what_nobody_recorded(
    closed, cut
):
    """By NumPy: 0.3268 s; 0.0022 rad/s left with cubic splines between the samples of the other
    gyro, 0.0020 with lines, 0.0018 with two derivatives: what smooths its noise (0.0006 by third
    differences) leaves less, and is no cause. An offset during any part of the record changes the
    fourth digit."""
    result = closed(f"{MODELS}:two_gyros", cut / "twist.csv")
    assert not {"pulse", "bias_step"} & {e["name"] for e in result["effects"]}
    late = [e for e in result["effects"] if e["name"] in ("signal_lag", "low_pass")]
    values = [np.ravel(p["value"])[0] for e in late for p in e["parameters"].values()]
    assert sum(values) == pytest.approx(0.3268, abs=5e-4)
    assert result["after"]["rmse_fit"] < 0.0025


@pytest.mark.long
def test_current_and_take_off_stand_beside_each_other(closed, cut):
    """By NumPy on stretches held out: current 25.6 mG, a step at take-off 25.6, of 47.8."""
    result = closed(f"{MODELS}:compass", cut / "MAG3.csv")
    both = [{_label(e), *e["indistinguishable_from"], *e["less_likely"]} for e in result["effects"]]
    follows = [names for names in both if any("(current)" in name for name in names)]
    assert follows
    assert all("bias_step" in names for names in follows)
