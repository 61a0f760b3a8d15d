"""The command line and the files it writes: the fixed contract of the design, section 10."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import simulators as sim

from casest.cli import run

MODELS = Path(__file__).parent / "models"
THERMISTOR, LOAD_CELL = MODELS / "thermistor.py", MODELS / "load_cell.py"
G = ("--set", "norm=9.80665 m/s^2")


def write(path: Path, header: str, *columns: np.ndarray) -> Path:
    rows = np.column_stack(columns)
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.12g")
    return path


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Simulated records with known truth, by plain NumPy."""
    folder, rng = tmp_path_factory.mktemp("records"), np.random.default_rng(0)
    kelvin = np.linspace(273.15, 353.15, 60)
    ohms = 10_000 * np.exp(3950 * (1 / kelvin - 1 / 298.15)) + 5 * rng.standard_normal(60)
    write(folder / "thermistor.csv", "resistance [ohm],reference [K]", ohms, kelvin)
    write(folder / "field.csv", "resistance [ohm]", ohms)
    mass, celsius = rng.uniform(0, 5, 40), rng.uniform(10, 40, 40)
    force = 9.80665 * mass
    output = 0.5 + 0.1 * (force + 2e-3 * force**2) + 0.02 * (celsius - 20)
    output += 1e-4 * rng.standard_normal(40)
    header = "output [mV],mass [kg],temperature [degC]"
    write(folder / "cell.csv", header, output, mass, celsius)
    header = "vx [m/s^2],vy [m/s^2],vz [m/s^2]"
    for name, seed, shift in (("lab", 1, 0.0), ("field", 2, 0.05), ("other", 3, 0.0)):
        own = np.random.default_rng(seed)
        sensor = sim.accelerometer(np.random.default_rng(1))
        sensor = sim.Sensor(sensor.M, sensor.b + shift, sensor.norm)
        v = sensor.read(sim.spread_poses(30, own), 5e-3, own)
        write(folder / f"{name}_acc.csv", header, *v.T)
        write(folder / f"{name}_bare.csv", "a,b,c", *v.T)
    return folder


def calibrated(tmp_path, *arguments):
    """Exit code and result.json of a calibration."""
    out = tmp_path / "out"
    code = run(["calibrate", *map(str, arguments), "-o", str(out)])
    return code, json.loads((out / "result.json").read_text(encoding="utf-8"))


def parameter(result, name, what="value"):
    return np.array(result["estimate"]["parameters"][name][what], dtype=float)


# -- the forms of the files -----------------------------------------------------------------------


def test_result_json_has_the_keys_of_the_contract(records, tmp_path, capsys):
    lab = records / "lab_acc.csv"
    code, result = calibrated(tmp_path, "norm-triangular", lab, *G)
    assert code == 0
    for key in ("casest", "model", "data", "runs", "constants", "verdict", "noise", "estimate",
                "effects", "invisible", "unexplained", "trusted"):  # fmt: skip
        assert key in result
    assert result["model"] == "norm-triangular"
    assert result["data"] == [str(lab)]
    assert result["runs"] == ["lab_acc"]
    assert result["constants"] == {"norm": 9.80665}
    assert result["verdict"] is None
    assert result["trusted"] is True
    assert result["noise"]["unit"] == "m/s^2"
    assert len(result["noise"]["sigma"]) == 1
    estimate = result["estimate"]
    assert estimate["certificate"]["trusted"] is True
    assert all(isinstance(reason, str) for reason in estimate["certificate"]["reasons"])
    offset = estimate["parameters"]["offset"]
    assert set(offset) >= {"value", "std", "unit"}
    assert offset["unit"] == "m/s^2"
    assert np.shape(estimate["parameters"]["scale"]["value"]) == (3, 3)
    assert estimate["rmse_fit"] > 0


def test_the_printed_json_is_the_written_one(records, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["calibrate", "norm-diagonal", str(records / "lab_acc.csv"), *G, "--json"]
    assert run([*arguments, "-o", str(out)]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert printed.err == ""


def test_residuals_csv_has_the_columns_of_the_contract(records, tmp_path, capsys):
    lab = records / "lab_acc.csv"
    calibrated(tmp_path, "norm-triangular", lab, *G)
    with (tmp_path / "out" / "residuals.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["file", "run", "row", "t", "axis", "split", "before", "after"]
    assert [int(r["row"]) for r in rows] == list(range(30))
    assert {r["axis"] for r in rows} == {"norm"}
    assert {r["file"] for r in rows} == {str(lab)}
    assert {r["run"] for r in rows} == {"lab_acc"}
    assert {r["after"] for r in rows} == {""}
    before = np.array([float(r["before"]) for r in rows])
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert np.sqrt(np.mean(before**2)) == pytest.approx(result["estimate"]["rmse_fit"], rel=1e-9)
    # (‖S(v−o)‖ − g)/‖Sᵀn‖ by hand
    v = np.loadtxt(lab, delimiter=",", skiprows=1)
    S, o = parameter(result, "scale"), parameter(result, "offset")
    c = (v - o) @ S.T
    length = np.linalg.norm(c, axis=1)
    expected = (length - 9.80665) / np.linalg.norm((c / length[:, None]) @ S, axis=1)
    np.testing.assert_allclose(before, expected, atol=1e-12)


def test_explicit_vector_models_name_their_axes_and_times(tmp_path, capsys):
    rng = np.random.default_rng(0)
    t = np.arange(50) / 25
    v = np.column_stack([np.sin(t), np.cos(t), 1 + 0 * t]) + 0.01 * rng.standard_normal((50, 3))
    write(tmp_path / "v.csv", "t [s],vx,vy,vz", t, *v.T)
    (tmp_path / "still.py").write_text(
        "from casest import *\n@model\n"
        "def still(t=signal('s'), v=signal(3), *, o=param(3, '[v]')):\n"
        "    '''A constant.'''\n    return Residual(measured=v, predicted=o)\n"
    )
    calibrated(tmp_path, tmp_path / "still.py", tmp_path / "v.csv")
    with (tmp_path / "out" / "residuals.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [r["axis"] for r in rows[:4]] == ["x", "y", "z", "x"]
    np.testing.assert_allclose([float(r["t"]) for r in rows[::3]], t, atol=1e-12)
    assert len(rows) == 150


def test_files_are_replaced_whole_and_nothing_else_is_left(records, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "result.json").write_text("old", encoding="utf-8")
    before = (out / "result.json").stat().st_ino
    code, result = calibrated(tmp_path, "norm-diagonal", records / "lab_acc.csv", *G)
    assert code == 0
    assert result["model"] == "norm-diagonal"
    assert (out / "result.json").stat().st_ino != before  # renamed into place, not written over
    assert sorted(p.name for p in out.iterdir()) == ["report.html", "residuals.csv", "result.json"]


def test_an_untrusted_estimate_is_written_with_exit_code_two(records, tmp_path, capsys):
    code, result = calibrated(tmp_path, "norm-full", records / "lab_acc.csv", *G)
    assert code == 2
    assert result["verdict"] is None
    assert result["trusted"] is False
    assert result["estimate"]["certificate"]["trusted"] is False
    assert result["identifiability"]["rank"] == 9
    assert result["identifiability"]["unknowns"] == 12
    assert len(result["identifiability"]["unobservable"]) == 3
    assert np.all(np.isnan(parameter(result, "scale", "std")))
    printed = capsys.readouterr()
    assert "NOT TRUSTED" in printed.out
    assert "rotation of the sensor frame" in printed.out
    assert printed.err.startswith("casest: no trustworthy estimate: not determined: a rotation")
    assert printed.err.count("\n") == 1


def test_the_table_shows_values_with_std_and_unit(records, capsys):
    assert run(["calibrate", str(THERMISTOR), str(records / "thermistor.csv")]) == 0
    lines = capsys.readouterr().out.splitlines()
    (beta,) = [line.split() for line in lines if line.split()[:1] == ["beta"]]
    assert beta[2] == "±"
    assert beta[4] == "K"
    assert abs(float(beta[1]) - 3950) < 4 * float(beta[3])
    assert all(len(line) <= 80 for line in lines)


# -- commands -------------------------------------------------------------------------------------


def test_list_names_the_shipped_problems(capsys):
    assert run(["list"]) == 0
    text = capsys.readouterr().out
    for name in ("norm-diagonal", "norm-triangular", "norm-full"):
        assert f"\n  {name}\n" in text
    assert "closed-form" in text


def test_list_for_programs(capsys):
    assert run(["list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    problems, motion = listed["problems"], [(e["name"], e["on"]) for e in listed["motion_effects"]]
    assert ("time_delay", "an output") in motion
    assert problems["norm-full"]["signals"] == ["v"]
    assert problems["norm-full"]["parameters"] == ["scale", "offset"]
    assert problems["norm-full"]["constants"] == {"norm": 1.0}


@pytest.mark.long
def test_the_demo_finds_the_effect_and_comes_close_to_the_truth(tmp_path, capsys):
    assert run(["demo", "-o", str(tmp_path / "demo")]) == 0
    text = capsys.readouterr().out
    assert "extended: imbalance was missing" in text
    errors = [
        [float(z) for z in re.findall(r"\(([+-][\d.]+)\)", line)]
        for line in text.splitlines()
        if line.count("(") == 2 and line.split()[0].startswith(("offset", "gain", "tilt"))
    ]
    before, after = np.abs(np.array(errors)).T
    assert len(before) == 7
    assert before.max() > 50
    assert after.max() < 4
    assert (tmp_path / "demo" / "result.json").exists()


@pytest.mark.long
def test_a_real_process_does_the_same(records, tmp_path):
    command = [str(Path(sys.executable).parent / "casest")]
    lab = str(records / "lab_acc.csv")
    done = subprocess.run(
        [*command, "calibrate", "norm-triangular", lab, *G, "-o", "out"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    done = subprocess.run(
        [*command, "apply", "out", lab], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert len(done.stdout.splitlines()) == 31
    done = subprocess.run(
        [*command, "apply", "nowhere", lab],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("casest: nowhere: no such result")


def test_help_ends_with_exit_code_zero(capsys):
    assert run(["calibrate", "--help"]) == 0
    text = capsys.readouterr().out
    for option in ("--set", "--free", "--fix", "--shared", "--per-run", "--columns", "--unit",
                   "--scale", "--rate", "--at-rest", "--holdout", "--effects", "--solver",
                   "--seed", "--json"):  # fmt: skip
        assert option in text


# -- apply ----------------------------------------------------------------------------------------


def applied(capsys, *arguments):
    """Header and numbers of what apply prints."""
    capsys.readouterr()
    assert run(["apply", *map(str, arguments)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    rows = list(csv.reader(printed.out.splitlines()))
    return rows[0], np.array(rows[1:], dtype=float)


def test_applying_a_norm_calibration_gives_the_corrected_vector(records, tmp_path, capsys):
    _, result = calibrated(tmp_path, "norm-triangular", records / "lab_acc.csv", *G)
    header, rows = applied(capsys, tmp_path / "out", records / "lab_acc.csv")
    assert header[0] == "row"
    assert header[1:4] == ["vx [m/s^2]", "vy [m/s^2]", "vz [m/s^2]"]
    assert header[4:] == [f"corrected_{a} [m/s^2]" for a in "xyz"]
    v = np.loadtxt(records / "lab_acc.csv", delimiter=",", skiprows=1)
    expected = (v - parameter(result, "offset")) @ parameter(result, "scale").T
    np.testing.assert_allclose(rows[:, 4:], expected, rtol=1e-7)


def test_applying_a_thermistor_needs_no_reference_thermometer(records, tmp_path, capsys):
    calibrated(tmp_path, THERMISTOR, records / "thermistor.csv")
    header, rows = applied(capsys, tmp_path / "out", records / "field.csv")
    assert header[-1] == "temperature [K]"
    truth = np.linspace(273.15, 353.15, 60)
    # 5 Ω of noise at the hot end, where a kelvin is 48 Ω
    np.testing.assert_allclose(rows[:, -1], truth, atol=0.5)


def test_the_constants_that_were_set_are_applied(records, tmp_path, capsys):
    arguments = (f"{LOAD_CELL}:load_cell", records / "cell.csv")
    _, result = calibrated(tmp_path, *arguments, "--set", "gravity=9.7")
    assert result["constants"]["gravity"] == 9.7
    _, rows = applied(capsys, tmp_path / "out", records / "cell.csv")
    expected = (rows[:, 1] - parameter(result, "zero")) / parameter(result, "sensitivity")
    np.testing.assert_allclose(rows[:, -1], expected, rtol=1e-7)


def test_a_freed_constant_is_applied_with_its_estimate(records, tmp_path, capsys):
    arguments = (THERMISTOR, records / "thermistor.csv", "--fix", "r25=9000", "--free", "t25")
    code, result = calibrated(tmp_path, *arguments)
    assert code == 0
    t25, beta = parameter(result, "t25"), parameter(result, "beta")
    assert t25 > 300  # the temperature at which this thermistor has 9000 Ω
    _, rows = applied(capsys, tmp_path / "out", records / "thermistor.csv")
    expected = 1 / (np.log(rows[:, 1] / 9000) / beta + 1 / t25)
    np.testing.assert_allclose(rows[:, -1], expected, rtol=1e-7)


def test_effects_that_were_fitted_are_applied_too(records, tmp_path, capsys):
    arguments = (f"{LOAD_CELL}:load_cell", records / "cell.csv", "--effects", LOAD_CELL)
    code, result = calibrated(tmp_path, *arguments)
    assert code == 0
    assert parameter(result, "curvature.k") == pytest.approx(2e-3, rel=0.05)
    _, rows = applied(capsys, tmp_path / "out", records / "cell.csv")
    mass = np.loadtxt(records / "cell.csv", delimiter=",", skiprows=1)[:, 1]
    np.testing.assert_allclose(rows[:, -1], 9.80665 * mass, atol=0.02)


def test_a_result_that_was_refused_is_applied_by_force_only(records, tmp_path, capsys):
    calibrated(tmp_path, "norm-full", records / "lab_acc.csv", *G)
    capsys.readouterr()
    assert run(["apply", str(tmp_path / "out"), str(records / "lab_acc.csv")]) == 1
    assert "this estimate was refused; --force applies it" in capsys.readouterr().err
    applied(capsys, tmp_path / "out", records / "lab_acc.csv", "--force")


def test_a_correction_that_differs_from_run_to_run_is_not_applied(records, tmp_path, capsys):
    both = (records / "lab_acc.csv", records / "field_acc.csv")
    code, _ = calibrated(tmp_path, "norm-triangular", *both, *G, "--per-run", "offset")
    assert code == 0
    capsys.readouterr()
    other = str(records / "other_acc.csv")
    assert run(["apply", str(tmp_path / "out"), other]) == 1
    assert "offset differs from run to run" in capsys.readouterr().err


def test_apply_writes_a_file_or_into_a_folder(records, tmp_path, capsys):
    calibrated(tmp_path, "norm-diagonal", records / "lab_acc.csv", *G)
    base = ["apply", str(tmp_path / "out"), str(records / "lab_acc.csv"), "-o"]
    assert run([*base, str(tmp_path / "a.csv")]) == 0
    assert run([*base, str(tmp_path / "folder")]) == 0
    first, second = tmp_path / "a.csv", tmp_path / "folder" / "corrected.csv"
    assert first.read_text(encoding="utf-8") == second.read_text(encoding="utf-8")


def test_a_reading_out_of_reach_is_named_and_nothing_is_written(records, tmp_path, capsys):
    calibrated(tmp_path, THERMISTOR, records / "thermistor.csv")
    write(tmp_path / "broken.csv", "resistance [ohm]", np.array([10_000.0, -5.0, 9_000.0]))
    target = tmp_path / "corrected.csv"
    arguments = [str(tmp_path / "out"), str(tmp_path / "broken.csv"), "-o", str(target)]
    capsys.readouterr()
    assert run(["apply", *arguments]) == 1
    text = capsys.readouterr().err
    assert f"{tmp_path / 'broken.csv'}: row 1: reading [-5.] has no temperature" in text
    assert not target.exists()


# -- options --------------------------------------------------------------------------------------


def test_scale_from_the_laboratory_and_bias_in_the_field(records, tmp_path, capsys):
    code, lab = calibrated(tmp_path, "norm-triangular", records / "lab_acc.csv", *G)
    assert code == 0
    saved = tmp_path / "lab"
    (tmp_path / "out").rename(saved)
    few = tmp_path / "six.csv"
    lines = (records / "field_acc.csv").read_text(encoding="utf-8").splitlines()
    few.write_text("\n".join(lines[:8]) + "\n", encoding="utf-8")
    fixed = ("--fix", f"scale=@{saved / 'result.json'}")
    code, field = calibrated(tmp_path, "norm-triangular", few, *G, *fixed)
    assert code == 0
    assert list(field["estimate"]["parameters"]) == ["offset"]
    np.testing.assert_array_equal(field["constants"]["scale"], parameter(lab, "scale"))
    shift = parameter(field, "offset") - parameter(lab, "offset")
    assert np.all(np.abs(shift - 0.05) < 5 * parameter(field, "offset", "std") + 0.01)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("offset=0.5", [0.5, 0.5, 0.5]),
        ("offset=0.1,0.2,0.3", [0.1, 0.2, 0.3]),
        ("scale=1,0,0;0.1,1,0;0,0,1", [[1, 0, 0], [0.1, 1, 0], [0, 0, 1]]),
        ("scale=1", np.eye(3)),
        ("scale=1,2,3", np.diag([1.0, 2, 3])),
    ],
)
def test_a_parameter_is_held_at_a_number_a_list_or_rows(records, tmp_path, text, value, capsys):
    _, result = calibrated(tmp_path, "norm-triangular", records / "lab_acc.csv", "--fix", text)
    np.testing.assert_array_equal(result["constants"][text.partition("=")[0]], value)


def test_a_value_may_carry_its_unit(records, tmp_path, capsys):
    cell = (f"{LOAD_CELL}:load_cell", records / "cell.csv")
    _, result = calibrated(tmp_path, *cell, "--fix", "zero=500 uV", "--set", "gravity=980 cm/s^2")
    assert result["constants"]["zero"] == pytest.approx(0.5)
    assert result["constants"]["gravity"] == pytest.approx(9.8)
    assert result["units"]["gravity"] == "m/s^2"


def test_a_constant_set_free_is_estimated(records, tmp_path, capsys):
    cell = (f"{LOAD_CELL}:load_cell", records / "cell.csv", "--effects", LOAD_CELL)
    code, result = calibrated(tmp_path, *cell, "--free", "gravity", "--fix", "sensitivity=0.1")
    assert code == 0
    assert abs(parameter(result, "gravity") - 9.80665) < 4 * parameter(result, "gravity", "std")


def test_freeing_what_only_scales_is_refused_in_words(records, capsys):
    arguments = ["calibrate", "norm-triangular", str(records / "lab_acc.csv"), *G]
    assert run([*arguments, "--free", "norm"]) == 2
    text = capsys.readouterr().err
    assert "not determined" in text
    assert "`norm`" in text
    assert "cannot be told apart" in text


def test_an_offset_per_run_and_a_shared_scale(records, tmp_path, capsys):
    both = (records / "lab_acc.csv", records / "field_acc.csv")
    code, result = calibrated(tmp_path, "norm-triangular", *both, *G, "--per-run", "offset")
    assert code == 0
    assert result["runs"] == ["lab_acc", "field_acc"]
    offset, std = parameter(result, "offset"), parameter(result, "offset", "std")
    assert offset.shape == (2, 3)
    assert parameter(result, "scale").shape == (3, 3)
    difference = offset[1] - offset[0]
    assert np.all(np.abs(difference - 0.05) < 4 * np.sqrt(2) * std.max())


def test_per_run_and_shared_undo_each_other(records, tmp_path, capsys):
    both = (records / "lab_acc.csv", records / "other_acc.csv")
    _, plain = calibrated(tmp_path, "norm-diagonal", *both, *G)
    options = ("--per-run", "offset", "--per-run", "scale")
    _, apart = calibrated(tmp_path, "norm-diagonal", *both, *G, *options)
    assert parameter(plain, "offset").shape == (3,)
    assert parameter(apart, "scale").shape == (2, 3)
    (tmp_path / "per_run.py").write_text(
        "from casest import *\n@model\ndef m(v=signal(3), *, o=param(3, '[v]', per='run')):\n"
        "    '''A constant.'''\n    return Residual(measured=v, predicted=o)\n"
    )
    _, shared = calibrated(tmp_path, tmp_path / "per_run.py", *both, "--shared", "o")
    assert parameter(shared, "o").shape == (3,)


@pytest.mark.parametrize("columns", ["v=a,b,c", "v=0,1,2"])
def test_columns_by_name_and_by_position_with_unit(records, tmp_path, columns, capsys):
    options = ("--columns", columns, "--unit", "v=m/s^2")
    _, bare = calibrated(tmp_path, "norm-triangular", records / "lab_bare.csv", *G, *options)
    _, named = calibrated(tmp_path, "norm-triangular", records / "lab_acc.csv", *G)
    np.testing.assert_allclose(parameter(bare, "offset"), parameter(named, "offset"), rtol=1e-12)
    assert bare["estimate"]["parameters"]["offset"]["unit"] == "m/s^2"


def test_the_unit_says_what_the_numbers_are(records, tmp_path, capsys):
    options = ("--columns", "v=a,b,c", "--unit", "v=g")
    _, result = calibrated(tmp_path, "norm-triangular", records / "lab_bare.csv", *options)
    assert result["estimate"]["parameters"]["offset"]["unit"] == "g"


def test_raw_counts_are_scaled(records, tmp_path, capsys):
    v = np.loadtxt(records / "lab_acc.csv", delimiter=",", skiprows=1)
    counts = np.round(v * 1000)
    write(tmp_path / "raw.csv", "vx,vy,vz", *counts.T)
    options = ("--scale", "v=int16/1000", "--unit", "v=m/s^2")
    _, scaled = calibrated(tmp_path, "norm-triangular", tmp_path / "raw.csv", *G, *options)
    _, plain = calibrated(tmp_path, "norm-triangular", records / "lab_acc.csv", *G)
    np.testing.assert_allclose(parameter(scaled, "offset"), parameter(plain, "offset"), atol=2e-3)


def test_a_raw_record_is_averaged_at_rest(tmp_path, capsys):
    rng = np.random.default_rng(4)
    sensor = sim.accelerometer(np.random.default_rng(1))
    v, rests = sim.handheld(sensor, sim.spread_poses(15, rng), 0.02, rng)
    write(tmp_path / "hand.csv", "vx [m/s^2],vy [m/s^2],vz [m/s^2]", *v.T)
    options = ("--rate", "100", "--at-rest")
    code, result = calibrated(tmp_path, "norm-triangular", tmp_path / "hand.csv", *G, *options)
    assert code == 0
    assert result["samples"][0]["samples"] == len(rests)
    z = (parameter(result, "offset") - sensor.b) / parameter(result, "offset", "std")
    assert np.all(np.abs(z) < 5)
    with (tmp_path / "out" / "residuals.csv").open(encoding="utf-8") as file:
        assert [int(r["row"]) for r in csv.DictReader(file)] == list(range(len(rests)))


def test_a_held_out_record_is_scored_and_not_fitted(records, tmp_path, capsys):
    lab, other = records / "lab_acc.csv", records / "other_acc.csv"
    _, alone = calibrated(tmp_path, "norm-triangular", lab, *G)
    _, scored = calibrated(tmp_path, "norm-triangular", lab, *G, "--holdout", other)
    assert scored["estimate"]["parameters"] == alone["estimate"]["parameters"]
    S, o = parameter(scored, "scale"), parameter(scored, "offset")
    c = (np.loadtxt(other, delimiter=",", skiprows=1) - o) @ S.T
    length = np.linalg.norm(c, axis=1)
    r = (length - 9.80665) / np.linalg.norm((c / length[:, None]) @ S, axis=1)
    expected = np.sqrt(np.mean(r**2))
    assert scored["estimate"]["rmse_holdout"] == pytest.approx(expected, rel=1e-9)
    assert alone["estimate"]["rmse_holdout"] is None


@pytest.mark.parametrize("solver", ["ipopt", "ipopt-exact", "trust-region"])
def test_every_solver_gives_the_same_parameters(records, tmp_path, solver, capsys):
    cell = (f"{LOAD_CELL}:load_cell", records / "cell.csv")
    _, result = calibrated(tmp_path, *cell, "--solver", solver, "--seed", "7")
    assert result["solver"]["name"] == solver
    output, mass, _ = np.loadtxt(records / "cell.csv", delimiter=",", skiprows=1).T
    slope, zero = np.polyfit(9.80665 * mass, output, 1)
    assert parameter(result, "sensitivity") == pytest.approx(slope, rel=1e-9)
    assert parameter(result, "zero") == pytest.approx(zero, rel=1e-9)


@pytest.mark.parametrize("start", ["r25=20000", "r25=20 kohm"])
def test_a_start_may_be_given_with_or_without_a_unit(records, tmp_path, start, capsys):
    arguments = (THERMISTOR, records / "thermistor.csv", "--start", start)
    code, result = calibrated(tmp_path, *arguments, "--start", "beta=4500")
    assert code == 0
    assert parameter(result, "r25") == pytest.approx(10_000, abs=10)


def test_a_start_for_a_vector(records, tmp_path, capsys):
    arguments = ("norm-triangular", records / "lab_acc.csv", *G, "--start", "offset=0.1,0,0")
    code, result = calibrated(tmp_path, *arguments)
    _, plain = calibrated(tmp_path, "norm-triangular", records / "lab_acc.csv", *G)
    assert code == 0
    np.testing.assert_allclose(parameter(result, "offset"), parameter(plain, "offset"), rtol=1e-8)


# -- a user's own sensor --------------------------------------------------------------------------


def test_a_thermistor_of_the_users_own_is_calibrated(records, tmp_path, capsys):
    code, result = calibrated(tmp_path, THERMISTOR, records / "thermistor.csv")
    assert code == 0
    for name, true, unit in (("r25", 10_000, "ohm"), ("beta", 3950, "K")):
        assert abs(parameter(result, name) - true) < 4 * parameter(result, name, "std")
        assert result["estimate"]["parameters"][name]["unit"] == unit


@pytest.mark.parametrize("name", ["load_cell", "load-cell"])
def test_one_of_several_models_in_a_file_is_named_after_a_colon(records, tmp_path, name, capsys):
    _, result = calibrated(tmp_path, f"{LOAD_CELL}:{name}", records / "cell.csv")
    assert set(result["estimate"]["parameters"]) == {"zero", "sensitivity"}


def test_effects_of_the_users_own_are_estimated(records, tmp_path, capsys):
    cell = (f"{LOAD_CELL}:load_cell", records / "cell.csv")
    code, result = calibrated(tmp_path, *cell, "--effects", LOAD_CELL)
    assert code == 0
    for name, true in (("warming.drift", 0.02), ("curvature.k", 2e-3)):
        assert abs(parameter(result, name) - true) < 5 * parameter(result, name, "std")
    assert result["estimate"]["parameters"]["warming.drift"]["unit"] == "mV/K"


def test_one_effect_of_a_file_and_one_of_its_parameters_held(records, tmp_path, capsys):
    cell = (f"{LOAD_CELL}:load_cell", records / "cell.csv", "--effects", f"{LOAD_CELL}:warming")
    code, result = calibrated(tmp_path, *cell, "--fix", "warming.drift=0.02")
    assert code == 0
    assert set(result["estimate"]["parameters"]) == {"zero", "sensitivity"}
    assert result["constants"]["warming.drift"] == 0.02
    output, mass, celsius = np.loadtxt(records / "cell.csv", delimiter=",", skiprows=1).T
    slope, _ = np.polyfit(9.80665 * mass, output - 0.02 * (celsius - 20), 1)
    assert parameter(result, "sensitivity") == pytest.approx(slope, rel=1e-9)


@pytest.mark.long
def test_outliers_are_an_effect_on_the_noise_from_a_file(records, tmp_path, capsys):
    lines = (records / "cell.csv").read_text(encoding="utf-8").splitlines()
    for k in (5, 17, 29):  # three readings of 40 are off by a volt
        output, rest = lines[k].split(",", 1)
        lines[k] = f"{float(output) + 1000},{rest}"
    (tmp_path / "hit.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (tmp_path / "noise.py").write_text(
        "from casest import *\n\n\n@effect(on='noise')\ndef outliers(r, *, nu=3.0):\n"
        "    return (nu + 1) / (nu + r**2)\n",
        encoding="utf-8",
    )
    cell = (f"{LOAD_CELL}:load_cell", tmp_path / "hit.csv", "--effects", LOAD_CELL)
    code, result = calibrated(tmp_path, *cell, "--effects", tmp_path / "noise.py")
    assert code == 0
    assert parameter(result, "zero") == pytest.approx(0.5, abs=0.01)
    _, fooled = calibrated(tmp_path, *cell)
    assert abs(parameter(fooled, "zero") - 0.5) > 1


def test_a_low_pass_from_a_file_is_estimated(tmp_path, capsys):
    rng, dt, tau = np.random.default_rng(0), 0.01, 0.05
    t = np.arange(600) * dt
    x, y = np.sin(8 * t) + 0.3 * np.sin(31 * t), np.zeros(600)
    y[0] = x[0]
    for k in range(1, 600):
        y[k] = y[k - 1] + (x[k] - y[k - 1]) * dt / (dt + tau)
    y += 1e-3 * rng.standard_normal(600)
    write(tmp_path / "r.csv", "t [s],x [V],y [V]", t, x, y)
    (tmp_path / "amp.py").write_text(
        "from casest import *\n\n\n@model\n"
        "def amp(x=signal('V'), y=signal('V'), *, gain=param(start=1.0)):\n"
        "    '''An amplifier.'''\n"
        "    return Residual(measured=y, predicted=quantity('reading', gain * x, 'V'))\n\n\n"
        "@effect(on='reading', kind='sequence')\n"
        "def low_pass(value, previous, dt, *, tau=param('s', bounds=(0, 10))):\n"
        "    return previous + (value - previous) * dt / (dt + tau)\n",
        encoding="utf-8",
    )
    model = tmp_path / "amp.py"
    code, result = calibrated(tmp_path, model, tmp_path / "r.csv", "--effects", model)
    assert code == 0
    std = parameter(result, "low_pass.tau", "std")
    assert abs(parameter(result, "low_pass.tau") - tau) < 4 * std
