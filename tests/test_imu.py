"""A gyroscope by rests and turns, against an independent simulator and measured records."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from imus import an_imu, recorded, waved, written

from casest import DataError, Run, attempt
from casest.cli import run as casest_run
from casest.data import at_rest
from casest.results.find import find_model

GYRO = find_model("gyro-rests")
UNITS = {"a": "m/s^2", "w": "rad/s", "m": "uT"}


def rests(record, names="aw"):
    raw = Run.raw("imu", {n: record[n] for n in names}, units=UNITS, time=record["t"])
    return at_rest(raw)


def away(found, truth):
    """Distances from the truth in standard deviations, of all that is unknown."""
    away = []
    for name, value in found.values.items():
        off, std = np.asarray(value) - truth[name], found.std[name]
        free = (std > 0) | (off != 0)  # above a diagonal there is nothing to know
        away.append(np.ravel(off[free] / std[free]))
    return np.concatenate(away)


def command(arguments, capsys):
    code = casest_run([str(a) for a in arguments])
    return code, capsys.readouterr()


def xsens(shared_data):
    folder = shared_data / "xsens-imutk"
    pair = f"{folder / 'xsens_acc.mat'}+{folder / 'xsens_gyro.mat'}"
    axes = [f"{n}={f}.1,{f}.2,{f}.3" for n, f in (("a", "xsens_acc"), ("w", "xsens_gyro"))]
    columns = [part for text in ("t=0", *axes) for part in ("--columns", text)]
    return [pair, *columns, "--set", "gravity=9.81744"]


@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3))]
)
def test_accelerometer_and_gyroscope_are_found_within_their_uncertainty(seed):
    rng = np.random.default_rng(seed)
    imu = an_imu(rng)
    found = attempt(GYRO, [rests(recorded(waved(rng), imu, rng))])
    assert found.certificate.trusted
    z = away(found, imu.truth)
    assert len(z) == 21
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert np.abs(z).max() < 4.5


@pytest.mark.long
def test_the_noise_of_every_kind_is_found():
    rng = np.random.default_rng(5)
    record = recorded(waved(rng, rests=60), an_imu(rng), rng)
    found = attempt(GYRO, [rests(record)], intervals=False)
    noise = {c.name: float(c.array) for c in found.model.constants if c.name.endswith("noise")}
    # Means of about 200 readings of 0.02 m/s² and 0.003 rad/s; 150 steps of 0.01 s at 0.003 rad/s
    # and two directions, each 0.02/√200/g.
    assert noise["accelerometer_noise"] == pytest.approx(0.02 / np.sqrt(200), rel=0.25)
    assert noise["gyroscope_noise"] == pytest.approx(0.003 / np.sqrt(200), rel=0.25)
    turn = np.degrees(np.hypot(0.003 * 0.01 * np.sqrt(155), np.sqrt(2) * 0.02 / np.sqrt(200) / 9.8))
    assert noise["turn_noise"] == pytest.approx(turn, rel=0.25)
    assert found.noise.sigma == pytest.approx(1, rel=1e-3)


def test_a_gyroscope_in_degrees_or_mounted_on_its_side_is_found_as_well():
    rng = np.random.default_rng(6)
    imu = an_imu(rng)
    side = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
    imu.gyroscope = np.degrees(side @ imu.gyroscope)
    imu.gyroscope_bias = np.degrees(side @ imu.gyroscope_bias)
    imu.noises = (0.02, np.degrees(0.003), 0.3)
    found = attempt(GYRO, [rests(recorded(waved(rng), imu, rng))])
    assert found.certificate.trusted
    assert np.abs(away(found, imu.truth)).max() < 4.5


def test_a_first_rest_has_no_turn_and_counts_as_none():
    rng = np.random.default_rng(7)
    run = rests(recorded(waved(rng, rests=15), an_imu(rng), rng))
    found = attempt(GYRO, [run], intervals=False)
    assert found.problem.residual_count == 6 * len(run) - 2


def test_across_a_gap_nothing_is_integrated():
    rng = np.random.default_rng(8)
    record = recorded(waved(rng, rests=20), an_imu(rng), rng)
    run = rests(record)
    middle = int(run.averaged.last[9] + run.averaged.first[10]) // 2
    keep = np.ones(len(record["t"]), bool)
    keep[middle - 10 : middle + 10] = False
    cut = Run.raw("imu", {n: record[n][keep] for n in "aw"}, units=UNITS, time=record["t"][keep])
    block = (record["t"][keep] > record["t"][middle]).astype(int)
    found = attempt(GYRO, [at_rest(replace(cut, block=block))])
    assert found.problem.residual_count == 6 * len(found.problem.runs[0]) - 4
    assert found.certificate.trusted


def test_rests_that_are_none_are_asked_for():
    rng = np.random.default_rng(9)
    record = recorded(waved(rng, rests=3), an_imu(rng), rng)
    raw = Run.raw("walk", {n: record[n] for n in "aw"}, units=UNITS, time=record["t"])
    with pytest.raises(DataError, match=r"walk: .*at_rest=True"):
        attempt(GYRO, [raw])


def test_without_a_time_it_says_how_to_give_one(tmp_path, capsys):
    rng = np.random.default_rng(10)
    record = recorded(waved(rng, rests=6), an_imu(rng), rng)
    file = tmp_path / "imu.csv"
    np.savetxt(file, np.hstack([record["a"], record["w"]]), delimiter=",")
    code, said = command(
        ["calibrate", "gyro-rests", file, "--columns", "a=0,1,2", "--columns", "w=3,4,5"], capsys
    )
    assert code == 1
    assert "--rate" in said.err


@pytest.mark.long
def test_the_xsens_record_is_that_of_its_factory_sheet(shared_data, tmp_path, capsys):
    code, said = command(
        ["calibrate", "gyro-rests", *xsens(shared_data), "--free", "g_sensitivity", "-o", tmp_path],
        capsys,
    )
    assert code == 0, said.err
    result = json.loads((tmp_path / "result.json").read_text())
    values = {n: p["value"] for n, p in result["estimate"]["parameters"].items()}
    accelerometer = 1 / np.diag(values["accelerometer_scale"])
    assert accelerometer == pytest.approx([414.4, 412.1, 414.5], abs=0.3)
    gyroscope = 1 / np.diag(values["gyroscope_scale"])
    assert gyroscope == pytest.approx([4778, 4758, 4766], rel=0.002)
    assert result["constants"]["turn_noise"] < 0.2


# -- accelerometer, gyroscope and magnetometer together --------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A record of all three in one file, its result in a folder, and the truth."""
    rng = np.random.default_rng(21)
    imu, folder = an_imu(rng), tmp_path_factory.mktemp("whole")
    record = recorded(waved(rng, rests=20), imu, rng)
    file = written(folder / "imu.csv", record)
    words = ["calibrate", "imu", file, "--set", "field=48 uT", "-o", str(folder / "out")]
    assert casest_run(words) == 0
    return folder, record, {**imu.truth, "dip": np.array(1.1)}


def test_all_three_are_found_in_one_command(whole):
    folder, _, truth = whole
    result = json.loads((folder / "out" / "result.json").read_text())
    assert result["trusted"]
    away = []
    for name, found in result["estimate"]["parameters"].items():
        std = np.array(found["std"])
        away.append(((np.array(found["value"]) - truth[name])[std > 0] / std[std > 0]).ravel())
    z = np.concatenate(away)
    assert len(z) == 34
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert len(result["estimate"]["correlation"]["names"]) == 34


def test_apply_corrects_all_three_into_one_frame(whole):
    folder, _, _ = whole
    out = folder / "corrected.csv"
    assert casest_run(["apply", str(folder / "out"), str(folder / "imu.csv"), "-o", str(out)]) == 0
    corrected = np.loadtxt(out, delimiter=",", skiprows=1)[:, -9:]
    still = np.linalg.norm(corrected[:, 3:6], axis=1) < 0.02
    assert still.mean() > 0.4
    force, flux = corrected[still, :3], corrected[still, 6:]
    assert np.linalg.norm(force, axis=1).mean() == pytest.approx(9.80665, abs=2e-3)
    assert np.linalg.norm(flux, axis=1).mean() == pytest.approx(48, abs=0.02)
    below = -np.sum(force * flux, axis=1) / 9.80665 / 48
    assert np.arcsin(below.mean()) == pytest.approx(1.1, abs=2e-3)


def test_the_export_is_one_function_of_nine_readings(whole):
    folder, record, _ = whole
    file = folder / "correction.py"
    assert casest_run(["export", str(folder / "out"), "--to", "python", "-o", str(file)]) == 0
    names: dict = {}
    exec(file.read_text(), names)
    rows = np.hstack([record[n] for n in "awm"])[:50]
    apart = np.loadtxt(folder / "corrected.csv", delimiter=",", skiprows=1)[:50, -9:]
    assert np.abs(names["correct"](rows) - apart).max() < 1e-6


@pytest.mark.long
def test_three_files_with_clocks_of_their_own_are_one_record(whole, tmp_path, capsys):
    _, record, truth = whole
    late = {**record, "t": record["t"] + 0.0031}
    files = [written(tmp_path / f"{n}.csv", record if n == "a" else late, n) for n in "awm"]
    code, said = command(
        ["calibrate", "imu", "+".join(files), "--set", "field=48 uT", "--json"], capsys
    )
    assert code == 0, said.err
    found = json.loads(said.out)["estimate"]["parameters"]
    for name in ("gyroscope_scale", "magnetometer_scale", "dip"):
        std = np.array(found[name]["std"])
        assert (np.abs(np.array(found[name]["value"]) - truth[name]) < 5 * std).all(), name


# -- what cannot be --------------------------------------------------------------------------------


def test_turns_about_one_axis_are_refused_with_the_axis_left_out():
    rng = np.random.default_rng(31)
    motion = waved(rng, rests=15, axes=np.array([[0.0, 0, 1]]), wobble=0.0)
    found = attempt(GYRO, [rests(recorded(motion, an_imu(rng), rng))])
    assert not found.certificate.trusted
    assert "leave an axis of the gyroscope out" in found.certificate.reasons[0]


def test_a_turn_at_full_scale_is_left_out_and_said():
    rng = np.random.default_rng(32)
    imu = an_imu(rng)
    record = recorded(waved(rng, rests=24), imu, rng)
    fast = np.sort(np.abs(record["w"]).max(axis=1))[-30]
    record["w"] = np.clip(record["w"], -fast, fast)
    found = attempt(GYRO, [rests(record)])
    assert any("full scale" in note for note in found.notes)
    assert found.certificate.trusted
    assert np.abs(away(found, imu.truth)).max() < 4.5


@pytest.mark.long
def test_a_gyroscope_of_another_unit_is_refused():
    rng = np.random.default_rng(33)
    run = rests(recorded(waved(rng), an_imu(rng), rng))
    raw = run.averaged.run
    other = replace(raw, signals={**raw.signals, "w": raw.signals["w"][::-1]})
    found = attempt(GYRO, [replace(run, averaged=replace(run.averaged, run=other))])
    assert not found.certificate.trusted


@pytest.mark.long
def test_a_start_in_the_wrong_valley_of_the_xsens_record_leads_to_the_right_one(
    shared_data, capsys
):
    wrong = f"gyroscope_scale={1 / 6258},0,0;0,{1 / 4758},0;0,0,{1 / 4766}"
    code, said = command(
        ["calibrate", "gyro-rests", *xsens(shared_data), "--start", wrong, "--json"], capsys
    )
    found = json.loads(said.out)
    scale = 1 / np.diag(found["estimate"]["parameters"]["gyroscope_scale"]["value"])
    assert code == 2 or scale == pytest.approx([4778, 4758, 4766], rel=0.01)
