"""Files that others wrote or changed: nothing of them is run, and what is wrong in them is said."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from casest import UsageError
from casest.cli import run
from casest.results.saved import saved_result
from casest.saved.model import saved_model

CELL = '''
from casest import Residual, model, param, quantity, signal


@model
def cell(force=signal("N"), y=signal("mV"), *, zero=param("mV"), gain=param("mV/N", start=1.0)):
    """A straight load cell."""
    true = quantity("true", force, "N")
    reading = quantity("reading", zero + gain * true, "mV")
    return Residual(measured=y, predicted=reading, corrected=true)
'''
TILTED = """
from casest import Residual, attitude, model, param, quantity, signal


@model
def tilted(f=signal(3, "N"), y=signal(3, "N"), R=attitude(), *, zero=param(3, "N")):
    force = quantity("force", f, "N")
    return Residual(measured=y, predicted=R.T @ force + zero, corrected=force)
"""
BEND = """
from casest import effect, param


@effect(on="reading")
def bend(reading, *, k=param("1/mV")):
    return reading + k * reading**2
"""
#: What somebody puts in the place of a file: it leaves a trace where it is run.
HOSTILE = "from pathlib import Path\nPath({!r}).write_text('ran')\n"


def record(path: Path, zero: float = 0.5, bend: float = 0.0) -> Path:
    """Forces and readings of a load cell, by its formula alone."""
    rng = np.random.default_rng(1)
    force = np.linspace(-10, 10, 60)
    y = zero + 0.2 * force
    y = y + bend * y**2 + 1e-4 * rng.standard_normal(60)
    table = np.column_stack([force, y])
    np.savetxt(path, table, delimiter=",", header="force [N],y [mV]", comments="")
    return path


@pytest.fixture
def fitted(tmp_path, monkeypatch):
    """A folder with a model, an effect, a record and the result of a fit with both."""
    monkeypatch.chdir(tmp_path)
    Path("cell.py").write_text(CELL, encoding="utf-8")
    Path("bend.py").write_text(BEND, encoding="utf-8")
    record(tmp_path / "a.csv", bend=0.03)
    words = ["calibrate", "cell.py", "a.csv", "--effects", "bend.py", "-o", "out"]
    assert run(words) == 0
    return tmp_path


def applied(capsys, *words: str) -> np.ndarray:
    capsys.readouterr()
    assert run(["apply", *words]) == 0
    rows = capsys.readouterr().out.splitlines()[1:]
    return np.array([row.split(",")[-1] for row in rows], dtype=float)


@pytest.mark.parametrize("file", ["cell.py", "bend.py"])
def test_what_a_result_names_is_not_run_and_its_correction_stays(fitted, capsys, file):
    before = applied(capsys, "out", "a.csv")
    np.testing.assert_allclose(before, np.linspace(-10, 10, 60), atol=5e-3)
    trace = fitted / "trace"
    (fitted / file).write_text(HOSTILE.format(str(trace)) + (fitted / file).read_text("utf-8"))
    np.testing.assert_array_equal(applied(capsys, "out", "a.csv"), before)
    for to in ("c", "python", "json"):
        assert run(["export", "out", "--to", to, "-o", f"c.{to}"]) == 0
    assert run(["calibrate", "norm-diagonal", "a.csv", "--fix", "scale=@out/result.json"]) == 1
    assert not trace.exists()


def test_a_result_is_applied_where_no_file_of_the_model_is(fitted, capsys):
    before = applied(capsys, "out", "a.csv")
    for file in ("cell.py", "bend.py"):
        (fitted / file).unlink()
    shutil.rmtree(fitted / "__pycache__", ignore_errors=True)
    np.testing.assert_array_equal(applied(capsys, "out", "a.csv"), before)


@pytest.mark.parametrize("where", ["a result's own name", "where it was declared", "an effect"])
def test_a_result_that_names_another_file_does_not_run_it(fitted, capsys, where):
    trace = fitted / "trace"
    (fitted / "evil.py").write_text(HOSTILE.format(str(trace)) + CELL + BEND, encoding="utf-8")
    content = json.loads((fitted / "out/result.json").read_text("utf-8"))
    evil = str(fitted / "evil.py")
    if where == "an effect":
        content["effects"][0]["file"] = evil
    elif where == "where it was declared":
        content |= {"model": "gone.py", "declared_in": content["declared_in"] | {"file": evil}}
    else:
        content["model"] = "evil.py"
    (fitted / "out/result.json").write_text(json.dumps(content), encoding="utf-8")
    applied(capsys, "out", "a.csv")
    assert run(["export", "out", "--to", "c", "-o", "c.c"]) == 0
    if where == "a result's own name":  # the declaration that was recorded is meant
        assert saved_model(content)[0].name == "cell"
    else:
        with pytest.raises(UsageError, match=r"evil\.py has changed since the result was made"):
            saved_model(content)
    assert not trace.exists()


@pytest.mark.parametrize("file", ["cell.py", "bend.py"])
def test_a_declaration_that_was_edited_is_refused_before_it_is_run(fitted, file):
    content = json.loads((fitted / "out/result.json").read_text("utf-8"))
    assert saved_model(content)[1].keys() == {"zero", "gain", "bend.k"}
    trace, text = fitted / "trace", (fitted / file).read_text("utf-8")
    (fitted / file).write_text(HOSTILE.format(str(trace)) + text, encoding="utf-8")
    with pytest.raises(UsageError, match=f"{file} has changed since the result was made"):
        saved_model(content)
    assert not trace.exists()


def test_a_result_of_an_older_version_says_to_calibrate_again(fitted, capsys):
    content = json.loads((fitted / "out/result.json").read_text("utf-8"))
    del content["correction"]
    (fitted / "out/result.json").write_text(json.dumps(content), encoding="utf-8")
    for words in (["apply", "out", "a.csv"], ["export", "out", "--to", "c"]):
        assert run(words) == 1
        said = capsys.readouterr().err
        assert "made by an older casest, and carries no correction: calibrate again" in said


def test_a_model_without_a_correction_says_why_in_its_result(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("cell.py").write_text(CELL.replace(", corrected=true", ""), encoding="utf-8")
    assert run(["calibrate", "cell.py", str(record(tmp_path / "a.csv")), "-o", "out"]) == 0
    content = json.loads(Path("out/result.json").read_text("utf-8"))
    assert content["correction"] == {
        "reason": "model cell names no corrected quantity: Residual(…)"
    }
    capsys.readouterr()
    assert run(["apply", "out", "a.csv"]) == 1
    assert "model cell names no corrected quantity" in capsys.readouterr().err


def test_each_run_is_corrected_and_exported_with_its_own_numbers(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("cell.py").write_text(CELL, encoding="utf-8")
    zeros = {"a": 0.5, "b": -1.5, "c": 3.0}
    files = [str(record(tmp_path / f"{name}.csv", zero)) for name, zero in zeros.items()]
    assert run(["calibrate", "cell.py", *files, "--per-run", "zero", "-o", "out"]) == 0
    for k, (name, zero) in enumerate(zeros.items()):
        np.testing.assert_allclose(applied(capsys, "out", f"{name}.csv"),
                                   np.linspace(-10, 10, 60), atol=2e-3)  # fmt: skip
        words = ["export", "out", "--to", "json", "--run", str(k), "-o", f"{name}.json"]
        assert run(words) == 0
        found = applied(capsys, f"{name}.json", f"{name}.csv")
        np.testing.assert_allclose(found, np.linspace(-10, 10, 60), atol=2e-3)
        value = json.loads(Path(f"{name}.json").read_text("utf-8"))["parameters"]["zero"]["value"]
        assert value == pytest.approx(zero, abs=1e-3)
    capsys.readouterr()
    assert run(["export", "out", "--to", "c", "--run", "3"]) == 1
    assert "--run 3: there are runs 0 to 2" in capsys.readouterr().err


def test_a_unit_that_the_fit_did_not_know_is_asked_of_nobody(tmp_path, capsys, monkeypatch):
    """Counts without a unit: the exported correction takes them as the result does."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    v = rng.standard_normal((30, 3))
    v = 500 * v / np.linalg.norm(v, axis=1, keepdims=True) + [3, -2, 1] + rng.standard_normal(3)
    v += 0.1 * rng.standard_normal((30, 3))
    np.savetxt("v.csv", v, delimiter=",", header="vx,vy,vz", comments="")
    assert run(["calibrate", "norm-diagonal", "v.csv", "--set", "norm=500", "-o", "out"]) == 0
    assert run(["export", "out", "--to", "json", "-o", "c.json"]) == 0
    assert json.loads(Path("c.json").read_text("utf-8"))["program"]["inputs"][0]["unit"] == "[v]"
    printed = []
    for result in ("out", "c.json"):
        capsys.readouterr()
        assert run(["apply", result, "v.csv"]) == 0
        printed.append(capsys.readouterr().out.splitlines())
    lengths = [np.linalg.norm([float(x) for x in row.split(",")[-3:]]) for row in printed[0][1:]]
    np.testing.assert_allclose(lengths, 500, rtol=2e-3)
    assert printed[0][1:] == printed[1][1:]


def test_an_attitude_is_read_as_one_from_whatever_carries_the_correction(
    tmp_path, capsys, monkeypatch
):
    """A correction that reads a rotation, given as a quaternion in other columns."""
    monkeypatch.chdir(tmp_path)
    Path("tilted.py").write_text(TILTED, encoding="utf-8")
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(7)
    turned = Rotation.random(60, random_state=7)
    true = rng.uniform(-5, 5, (60, 3))
    reading = turned.inv().apply(true) + [0.1, -0.2, 0.3] + 1e-4 * rng.standard_normal((60, 3))
    q = turned.as_quat()[:, [3, 0, 1, 2]]
    head = "fx [N],fy [N],fz [N],yx [N],yy [N],yz [N],qw,qx,qy,qz"
    table = np.hstack([true, reading, q])
    np.savetxt("a.csv", table, delimiter=",", header=head, comments="")
    assert run(["calibrate", "tilted.py", "a.csv", "-o", "out"]) == 0
    assert run(["export", "out", "--to", "json", "-o", "c.json"]) == 0
    for result in ("out", "c.json"):
        capsys.readouterr()
        assert run(["apply", result, "a.csv"]) == 0
        rows = capsys.readouterr().out.splitlines()[1:]
        found = np.array([row.split(",")[-3:] for row in rows], dtype=float)
        np.testing.assert_allclose(found, true, atol=2e-3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("zero + gain * true", "zero + gain * true[0]"), "do not determine the 2 components"),
        (("    return Residual", "    return  Residual"), "its correction fails: nothing"),
    ],
)
def test_a_fit_is_kept_where_its_correction_cannot_be_built(tmp_path, monkeypatch, change, said):
    monkeypatch.chdir(tmp_path)
    text = CELL.replace(*change)
    if "true[0]" in text:
        text = text.replace('signal("N")', 'signal(2, "N")')
    else:
        text += "\n\n@cell.with_inverse\ndef cell(known, reading):\n"
        text += "    raise ValueError('nothing')\n"
    Path("cell.py").write_text(text, encoding="utf-8")
    table = np.loadtxt(record(tmp_path / "a.csv"), delimiter=",", skiprows=1)
    np.savetxt("b.csv", table[:, [0, 0, 1]], delimiter=",", header="f0 [N],f1 [N],y [mV]",
               comments="")  # fmt: skip
    data = ["b.csv", "--columns", "force=f0,f1"] if "true[0]" in text else ["a.csv"]
    assert run(["calibrate", "cell.py", *data, "-o", "out"]) == 0
    assert said in json.loads(Path("out/result.json").read_text("utf-8"))["correction"]["reason"]


@pytest.mark.parametrize("limit", ["inf", "-inf"])
def test_a_limit_at_infinity_is_carried_and_exported(tmp_path, capsys, monkeypatch, limit):
    """JSON has no infinity; a correction may: here for every reading without a value."""
    monkeypatch.chdir(tmp_path)
    text = CELL.replace("import Residual", "import Residual, if_else, fabs")
    text = text.replace(
        "zero + gain * true", f"if_else(fabs(true) < 1e3, zero + gain * true, {limit})"
    )
    Path("cell.py").write_text("from math import inf\n" + text, encoding="utf-8")
    record(tmp_path / "a.csv")
    assert run(["calibrate", "cell.py", "a.csv", "-o", "out"]) == 0
    np.testing.assert_allclose(applied(capsys, "out", "a.csv"), np.linspace(-10, 10, 60), atol=2e-3)
    assert run(["export", "out", "--to", "json", "-o", "c.json"]) == 0
    json.loads(Path("c.json").read_text("utf-8"), parse_constant=pytest.fail)


def test_a_parameter_is_taken_from_a_result_in_motion(tmp_path):
    content = {
        "model": "bias-gravity",
        "trusted": True,
        "after": {"parameters": {"b": {"value": [1, 2, 3], "std": [1, 1, 1], "unit": "m/s^2"}}},
        "innovations": {},
    }
    (tmp_path / "result.json").write_text(json.dumps(content), encoding="utf-8")
    assert saved_result(tmp_path).parameters["b"].value == [1, 2, 3]
