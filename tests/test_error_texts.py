"""Error texts that no other test meets: each names the thing and the way out, in one line."""

from __future__ import annotations

import json

import numpy as np
import pytest
import simulators as sim

from casest import (
    DataError,
    DeclarationError,
    NotTrusted,
    Residual,
    Run,
    UsageError,
    attempt,
    load_runs,
    model,
    param,
    read_table,
    signal,
)
from casest.cli import run
from casest.cli.earth import normal_gravity
from casest.data.rest import at_rest
from casest.data.write import write_atomically
from casest.errors import library
from casest.leastsquares.problem import Problem
from casest.results.find import find_effects, find_model
from casest.saved.model import saved_model
from casest.solve.strategy import solve
from casest_problems import norm, rate_table, wheel

G = ["--set", "norm=9.80665"]


@pytest.fixture
def readings(tmp_path):
    rng = np.random.default_rng(0)
    v = sim.accelerometer(rng).read(sim.spread_poses(24, rng), 0.005, rng)
    rows = "\n".join(",".join(f"{x:.6f}" for x in row) for row in v)
    path = tmp_path / "v.csv"
    path.write_text("vx [m/s^2],vy [m/s^2],vz [m/s^2]\n" + rows + "\n", encoding="utf-8")
    return path


def failing(capsys, *arguments):
    """The one line of a command that must end with exit code 1."""
    capsys.readouterr()
    assert run([str(a) for a in arguments]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def edited(folder, change):
    """A saved result with something changed in it."""
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    change(result)
    (folder / "result.json").write_text(json.dumps(result), encoding="utf-8")


@pytest.fixture
def saved(readings, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["calibrate", "norm-diagonal", str(readings), *G, "-o", str(out)]) == 0
    return out


def test_fixing_from_a_result_that_lacks_refuses_or_misses_the_parameter(saved, readings, capsys):
    command = ["calibrate", "norm-diagonal", readings, *G, "--fix"]
    assert "no parameter 'scale'" in _after(
        capsys, saved, lambda r: r["estimate"]["parameters"].pop("scale"), command, "scale"
    )
    assert "has no value" in _after(
        capsys,
        saved,
        lambda r: r["estimate"]["parameters"]["offset"].update(value=[None, 0, 0]),
        command,
        "offset",
    )
    assert "was refused" in _after(
        capsys, saved, lambda r: r.update(trusted=False), command, "offset"
    )


def _after(capsys, saved, change, command, name):
    edited(saved, change)
    return failing(capsys, *command, f"{name}=@{saved}/result.json")


def test_a_fixed_value_in_another_unit_than_the_data_need(saved, tmp_path, capsys):
    counts = tmp_path / "counts.csv"
    rows = "\n".join(f"{x},{y},{z}" for x, y, z in np.eye(3) * 100 + 1)
    counts.write_text(f"vx,vy,vz\n{rows}\n-100,1,2\n3,-99,4\n", encoding="utf-8")
    command = ["calibrate", "norm-diagonal", counts, "--unit", "v=count"]
    error = failing(capsys, *command, "--fix", f"offset=@{saved}/result.json")
    assert "is in m/s^2, but with these data it must be in count" in error


def test_an_effects_file_that_has_gone_since_the_calibration(saved):
    result = json.loads((saved / "result.json").read_text(encoding="utf-8"))
    effect = {"name": "bend", "on": "corrected", "columns": {}, "file": "/nowhere/bend.py"}
    result["effects"].append(effect)
    with pytest.raises(UsageError, match=r"was fitted with the effect bend: /nowhere/bend\.py: no"):
        saved_model(result)


def test_a_result_without_a_parameters_value(saved):
    result = json.loads((saved / "result.json").read_text(encoding="utf-8"))
    del result["estimate"]["parameters"]["offset"]
    with pytest.raises(DataError, match="no value for 'offset'"):
        saved_model(result)


def test_a_start_for_a_constant(readings, capsys):
    error = failing(capsys, "calibrate", "norm-diagonal", readings, *G, "--start", "norm=3")
    assert "norm is no unknown" in error


def test_a_record_held_out_that_was_fitted(readings, capsys):
    error = failing(capsys, "calibrate", "norm-diagonal", readings, *G, "--holdout", readings)
    assert "the fit has seen this file" in error


def test_a_held_out_record_too_short_for_parameters_of_its_own(readings, tmp_path, capsys):
    other = tmp_path / "other.csv"
    lines = readings.read_text(encoding="utf-8").splitlines()[:2]
    other.write_text("\n".join(lines) + "\n", encoding="utf-8")
    command = ["calibrate", "norm-diagonal", readings, *G, "--per-run", "offset"]
    assert "cannot be split into 2 folds" in failing(capsys, *command, "--holdout", other)


def test_values_of_a_place_that_are_not_numbers(readings, capsys):
    error = failing(capsys, "calibrate", "norm-diagonal", readings, "--set", "norm=field(1,2)")
    assert "field(latitude, longitude, height, year)" in error


def test_time_given_as_two_columns(readings, capsys):
    error = failing(capsys, "calibrate", "norm-diagonal", readings, *G, "--columns", "t=vx,vy")
    assert "must name one column" in error


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("text.csv", "some words\nwithout any\nnumbers in them\n", "no table|no columns|header"),
        ("broken.npy", b"\x93NUMPY\x01\x00broken", "cannot be read as NumPy"),
        ("broken.npz", b"PK\x03\x04broken", "cannot be read as NumPy"),
    ],
)
def test_files_without_a_table(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DataError, match=words):
        read_table(path)


def test_arrays_without_numbers(tmp_path):
    np.savez(tmp_path / "one.npz", a=np.array(3.0))
    with pytest.raises(DataError, match="no array with more than one number"):
        read_table(tmp_path / "one.npz")
    np.save(tmp_path / "none.npy", np.zeros((0, 3)))
    with pytest.raises(DataError, match=r"no array|no rows|no columns"):
        read_table(tmp_path / "none.npy")


def test_rest_that_cannot_be_told_from_slow_motion(shared_data):
    """Of the ckexplorer pair the sensors were never laid down."""
    runs = load_runs(
        shared_data / "ckexplorer/acc_mag_log.csv",
        find_model("norm-diagonal").signals,
        columns={"v": ("ax", "ay", "az")},
        rate=100,
    )
    with pytest.raises(DataError, match=r"rest|slow motion"):
        at_rest(runs[0])


def test_a_folder_that_does_not_exist(tmp_path):
    with pytest.raises(DataError, match=r"x: cannot be written .*give a folder that exists"):
        write_atomically(tmp_path / "missing" / "x", "text")


def test_a_target_that_is_a_folder(tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(DataError, match="taken: cannot be written"):
        write_atomically(tmp_path / "taken", "text")
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]


def test_bounds_of_another_shape():
    with pytest.raises(DeclarationError, match=r"a bound of shape \(2,\) does not fit"):
        param(3, bounds=([0, 0], 1))


def test_no_runs():
    with pytest.raises(DataError, match="no runs to fit"):
        attempt(find_model("norm-diagonal"), [])


def test_a_body_with_an_error_in_it_names_its_line():
    @model
    def broken(a=signal("m"), *, b=param("m")):
        """A body that divides by a text."""
        return Residual(measured=a, predicted=b / "two")

    with pytest.raises(DeclarationError, match=r"model broken, .*test_error_texts.py, line \d+"):
        _ = broken.traced


def test_an_unknown_solver_of_a_problem():
    run_ = Run.raw("r", {"v": np.eye(3)}, units={"v": "g"})
    problem = Problem(find_model("norm-diagonal"), (run_,))
    with pytest.raises(UsageError, match="unknown solver 'newton'"):
        solve(problem, problem.start(), solver="newton")


def test_files_of_declarations_that_declare_nothing(tmp_path):
    (tmp_path / "empty.py").write_text("x = 1\n", encoding="utf-8")
    with pytest.raises(UsageError, match="declares no @effect"):
        find_effects(str(tmp_path / "empty.py"))
    with pytest.raises(UsageError, match="declares no @model"):
        find_model(str(tmp_path / "empty.py"))
    with pytest.raises(UsageError, match="has no model 'cell'"):
        find_model(f"{tmp_path / 'empty.py'}:cell")


def test_a_model_declared_twice_in_one_file(tmp_path):
    one = (
        "@model\ndef m(a=signal(1), *, b=param()):\n    return Residual(measured=a, predicted=b)\n"
    )
    text = "from casest import Residual, model, param, signal\n" + one + one
    (tmp_path / "twice.py").write_text(text, encoding="utf-8")
    with pytest.raises(DeclarationError, match=r"line 6: 'm' is declared twice \(first in line 3"):
        find_model(str(tmp_path / "twice.py"))


def test_a_library_that_is_missing_is_named():
    with pytest.raises(UsageError, match=r"library no_such_library: pip install 'casest\[earth\]'"):
        library("no_such_library", "earth")
    with pytest.raises(UsageError, match="height -5"):
        normal_gravity(0.0, -5.0)


def test_closed_forms_refuse_what_they_cannot_solve():
    t = np.linspace(-1, 1, 12)
    saddle = np.column_stack([np.cosh(t), np.sinh(t), 0.1 * np.cos(9 * t)])
    both = np.vstack([saddle, -saddle + 0.01])
    with pytest.raises(NotTrusted, match="closed form"):
        norm.burkhard_full(both, 1.0)
    only_up = np.array([[9.8, 0.1, 0.1], [-9.8, 0, 0], [0, 9.8, 0.1], [0, -9.8, 0.1], [0, 0, 9.8]])
    with pytest.raises(NotTrusted, match="no pose has z"):
        norm.six_positions(only_up, 9.8)


def test_the_papers_algorithms_refuse_what_they_were_not_made_for():
    with pytest.raises(NotTrusted, match="needs the radius"):
        wheel.four_step(wheel.wheel.freed("radius"), [])
    still = {"a": np.tile([0, 0, 9.8], (9, 1)), "attitude": np.tile(np.eye(3).ravel(), (9, 1))}
    table = Run.raw("t", still, units={"a": "m/s^2", "attitude": None})
    with pytest.raises(NotTrusted, match="more than one solution"):
        rate_table.two_stage(rate_table.rate_table, [table])


@pytest.mark.parametrize(
    ("first", "then", "forms"),
    [
        ("norm-triangular", "norm-diagonal", ("a 3 by 3 matrix", "a list of 3")),
        ("norm-diagonal", "norm-triangular", ("a list of 3", "a 3 by 3 matrix")),
    ],
)
def test_a_value_of_a_result_of_another_form_names_both_and_the_way_out(
    readings, tmp_path, capsys, first, then, forms
):
    out = tmp_path / first
    assert run(["calibrate", first, str(readings), *G, "-o", str(out)]) == 0
    error = failing(capsys, "calibrate", then, readings, *G, "--fix", f"scale=@{out}")
    there, here = forms
    assert f"--fix scale=@{out}: scale of {first} is {there}, that of {then} {here}" in error
    assert f"calibrate with {first}, or type the numbers that you mean" in error


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--fix", "scale=1,2"],
            "takes a 3 by 3 matrix (1,0,0;0,1,0;0,0,1), and a list of 2 is given",
        ),
        (["--start", "offset=1,2,3,4"], "takes a list of 3 (1,2,3), and a list of 4 is given"),
        (
            ["--set", "norm=1,2,3"],
            "norm of model norm-triangular is one number, and a list of 3 is",
        ),
    ],
)
def test_a_typed_value_of_the_wrong_form_shows_how_it_is_written(readings, capsys, words, said):
    assert said in failing(capsys, "calibrate", "norm-triangular", readings, *words)
