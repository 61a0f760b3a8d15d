"""What a careful engineer would notice is said, and mistakes that look fine are caught."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import simulators as sim

from casest import Run, attempt
from casest.cli import run
from casest.data import load_runs
from casest.results.find import find_model

MODELS = Path(__file__).parent / "models"


def poses(v, unit="m/s^2"):
    return Run.raw("poses", {"v": v}, units={"v": unit})


def noted(found, words):
    return any(words in note for note in found.notes)


def table(path, header, rows):
    lines = [header, *(",".join(f"{x:.8g}" for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return str(path)


@pytest.fixture
def sphere(tmp_path):
    rng = np.random.default_rng(0)
    sensor = sim.accelerometer(rng)
    v = sensor.read(sim.spread_poses(30, rng), 0.005, rng)
    return table(tmp_path / "sphere.csv", "vx [m/s^2],vy [m/s^2],vz [m/s^2]", v)


def test_a_norm_in_another_unit_than_the_readings_is_noticed():
    rng = np.random.default_rng(1)
    v = sim.accelerometer(rng).read(sim.spread_poses(30, rng), 0.005, rng)
    mixed_up = attempt(find_model("norm-triangular").having(norm=1.0), [poses(v)])
    assert noted(mixed_up, "times the norm")
    right = attempt(find_model("norm-triangular").having(norm=9.80665), [poses(v)])
    assert not right.notes


def test_a_norm_of_another_size_in_another_unit_of_its_kind_is_noticed(tmp_path):
    rng = np.random.default_rng(1)
    v = sim.accelerometer(rng).read(sim.spread_poses(30, rng), 0.005, rng)
    file = table(tmp_path / "x.csv", "vx [m/s^2],vy [m/s^2],vz [m/s^2]", v)
    model = find_model("norm-triangular")
    runs = load_runs([file], model.signals)
    assert noted(attempt(model.having(norm="1 mg"), runs), "times the norm (1 mg): is one of")
    assert not attempt(model.having(norm="1 g"), runs).notes


def test_poses_near_a_plane_are_called_so():
    rng = np.random.default_rng(2)
    directions = sim.spread_poses(40, rng) * [1, 1, 0.03]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    v = sim.accelerometer(rng).read(directions, 0.005, rng)
    found = attempt(find_model("norm-diagonal").having(norm=9.80665), [poses(v)])
    assert noted(found, "close to a plane")


def test_one_pose_that_is_off_is_named():
    rng = np.random.default_rng(3)
    v = sim.accelerometer(rng).read(sim.spread_poses(40, rng), 0.005, rng)
    v[17] *= 1.05
    found = attempt(find_model("norm-triangular").having(norm=9.80665), [poses(v)])
    assert noted(found, "row 17 of poses")


def test_gaussian_noise_has_no_pose_that_is_off():
    """Six robust deviations with 31 poses and 9 unknowns: none in forty records."""
    rng, found = np.random.default_rng(4), 0
    for _ in range(40):
        v = sim.accelerometer(rng).read(sim.spread_poses(31, rng), 0.005, rng)
        estimate = attempt(
            find_model("norm-triangular").having(norm=9.80665), [poses(v)], solver="trust-region"
        )
        found += noted(estimate, "look at it first")
    assert found == 0


def test_the_second_order_shift_by_noise_is_the_one_that_is_seen():
    """Noise of 4 % of the norm in every reading: the mean error of many fits is the shift added.

    By hand: ‖x + η‖ exceeds ‖x‖ by σ²/‖x‖ on average (two of three components count), so that
    radii come out too large, and scales too small, by the square of the relative noise.
    """
    rng, shifts, relative = np.random.default_rng(5), [], 0.04
    for _ in range(6):
        directions = sim.sphere(4000, rng)
        v = directions + relative * rng.standard_normal((4000, 3))
        found = attempt(find_model("norm-diagonal"), [poses(v, "gauss")], solver="trust-region")
        assert noted(found, "second order")
        shifts.append(found.values["scale"] - 1)
        assert np.all(np.abs(found.values["scale"] - 1) < 3 * found.std["scale"])
        assert np.all(found.std["scale"] < 3 * relative**2)
    assert np.mean(shifts) == pytest.approx(-(relative**2), rel=0.25)


def test_a_unit_stated_against_the_header_is_followed_and_said(sphere, capsys):
    assert run(["calibrate", "norm-triangular", sphere, "--unit", "v=g", "--set", "norm=9.8"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "the header says m/s^2, --unit says g" in printed


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--set", "norm=9.8 kg"], "norm is set in kg"),
        (["--set", "norm=0"], "a length must be positive"),
        (["--set", "norm=-9.8"], "a length must be positive"),
    ],
)
def test_a_norm_that_cannot_be_is_refused(sphere, capsys, options, words):
    assert run(["calibrate", "norm-triangular", sphere, *options]) == 1
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_one_file_given_twice_is_refused(sphere, capsys):
    assert run(["calibrate", "norm-triangular", sphere, sphere]) == 1
    assert "given twice" in capsys.readouterr().err


def test_held_values_are_printed_with_what_they_leave_out(sphere, capsys):
    command = ["calibrate", "norm-triangular", sphere, "--set", "norm=9.80665", "--fix", "scale=1"]
    run(command)
    printed = capsys.readouterr().out
    assert "scale = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]" in printed
    assert "norm = 9.80665 m/s^2 (held)" in printed
    assert "uncertainty of held values" in printed


def test_a_column_may_be_named_as_its_header_is_written(tmp_path, capsys):
    rng = np.random.default_rng(6)
    sensor = sim.accelerometer(rng)
    v, _ = sim.handheld(sensor, sim.spread_poses(20, rng), 0.02, rng)
    rows = np.column_stack([10.0 * np.arange(len(v)), v])
    path = table(tmp_path / "de.csv", "Zeit (ms),Bx [m/s^2],By [m/s^2],Bz [m/s^2]", rows)
    command = ["calibrate", "norm-triangular", path, "--set", "norm=9.80665", "--at-rest"]
    columns = ["--columns", "t=Zeit (ms)", "--columns", "v=Bx,By,Bz [m/s^2]"]
    assert run([*command, *columns]) == 0
    assert "rate unknown" not in capsys.readouterr().out
    assert run([*command, "--columns", "v=Bx,By,Bz"]) == 0
    assert "--columns t=NAME" in " ".join(capsys.readouterr().out.split())


@pytest.fixture
def cell(tmp_path):
    """A folder with a user's model, two records, and a calibration of both, zero per run."""
    (tmp_path / "cell.py").write_text(
        "from casest import Residual, model, param, quantity, signal\n\n\n"
        "@model\n"
        'def cell(force=signal("N"), out=signal("mV"), *, gain=param("mV/N"), zero=param("mV")):\n'
        '    """A load cell."""\n'
        '    true = quantity("true", force, "N")\n'
        "    return Residual(measured=out, predicted=zero + gain * true, corrected=true)\n",
        encoding="utf-8",
    )
    rng = np.random.default_rng(7)
    for name, zero in (("a", 1.0), ("b", -2.0)):
        force = np.linspace(0, 10, 12)
        out = zero + 2 * force + 1e-3 * rng.standard_normal(12)
        table(tmp_path / f"{name}.csv", "force [N],out [mV]", np.column_stack([force, out]))
    return tmp_path


def test_a_result_per_run_is_applied_to_the_runs_it_was_fitted_to(cell, capsys, monkeypatch):
    monkeypatch.chdir(cell)
    assert run(["calibrate", "cell.py", "a.csv", "b.csv", "--per-run", "zero", "-o", "both"]) == 0
    capsys.readouterr()
    for name in ("a", "b"):
        assert run(["apply", "both", f"{name}.csv"]) == 0
        rows = capsys.readouterr().out.splitlines()[1:]
        found = np.array([float(row.split(",")[-1]) for row in rows])
        np.testing.assert_allclose(found, np.linspace(0, 10, 12), atol=3e-3)
    shutil.copy("a.csv", "c.csv")
    assert run(["apply", "both", "c.csv"]) == 1
    assert "differs from run to run" in capsys.readouterr().err


def test_a_result_is_applied_from_another_folder(cell, capsys, monkeypatch):
    monkeypatch.chdir(cell)
    assert run(["calibrate", "cell.py", "a.csv", "-o", "out"]) == 0
    (cell / "elsewhere").mkdir()
    monkeypatch.chdir(cell / "elsewhere")
    capsys.readouterr()
    assert run(["apply", "../out", "../a.csv"]) == 0
    assert capsys.readouterr().out.startswith("row,")


def test_a_result_says_its_convention_and_where_its_model_is(cell, sphere, monkeypatch):
    monkeypatch.chdir(cell)
    command = ["calibrate", "norm-triangular", sphere, "--set", "norm=9.80665", "-o", "out"]
    assert run(command) == 0
    result = json.loads((cell / "out" / "result.json").read_text(encoding="utf-8"))
    assert "corrected = scale" in result["convention"]
    assert len(result["declared_in"]["sha256"]) == 64


def test_without_redundancy_rest_intervals_are_all_that_speaks(tmp_path):
    rng = np.random.default_rng(8)
    sensor = sim.accelerometer(rng, skew=False)
    v, _ = sim.handheld(sensor, sim.spread_poses(6, rng), 0.02, rng)
    path = table(tmp_path / "six.csv", "vx,vy,vz", v)
    command = ["calibrate", "norm-diagonal", path, "--rate", "100", "--at-rest"]
    options = ["--unit", "v=m/s^2", "--set", "norm=9.80665", "-o", str(tmp_path / "o")]
    assert run([*command, *options]) == 0
    result = json.loads((tmp_path / "o" / "result.json").read_text(encoding="utf-8"))
    assert any("nothing checks the model" in note for note in result["notes"])


@pytest.mark.parametrize(("digits", "said"), [(4, True), (0, False)])
def test_rows_that_are_there_twice_are_a_copy_where_readings_scatter_by_many_digits(digits, said):
    """18 rows, and the same 18 once more; rounded to more than the noise any two may be alike."""
    rng = np.random.default_rng(7)
    given = np.linspace(0, 50, 18)
    reading = np.round(0.2 + 0.97 * given + 0.3 * rng.standard_normal(18), digits)
    signals = {"reference": np.tile(given, 2)[:, None], "reading": np.tile(reading, 2)[:, None]}
    found = attempt(find_model("linear"), [Run.raw("twice", signals, units={})])
    copied = "rows 18 to 35 of twice are rows 0 to 17 again, to the last digit"
    assert noted(found, copied) is said
