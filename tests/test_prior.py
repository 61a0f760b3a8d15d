"""An earlier result as a prior: updating is the joint fit; disagreement is said first."""

from __future__ import annotations

import json

import numpy as np
import pytest

from casest.cli import run

LINE = '''
from casest import Residual, model, param, quantity, signal


@model
def line(y=signal("1"), x=signal("1"), *, b0=param("1"), b1=param("1", start=1.0)):
    """x = b0 + b1 y."""
    return Residual(measured=x, predicted=b0 + b1 * y)


@model
def parabola(y=signal("1"), x=signal("1"), *, c0=param("1"), c1=param("1"), c2=param("1")):
    """Another model."""
    return Residual(measured=x, predicted=c0 + c1 * y + c2 * y**2)
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prior")
    (folder / "m.py").write_text(LINE)
    rng = np.random.default_rng(1)
    y = np.linspace(0, 3, 30)
    table = np.column_stack([y, 3 + 2 * y + 0.05 * rng.standard_normal(30)])
    moved = np.add(table[18:], [0, 0.5])
    parts = {"all": table, "first": table[:18], "second": table[18:], "moved": moved}
    for name, rows in parts.items():
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header="y,x", comments="")
    given = ["calibrate", f"{folder}/m.py:line", f"{folder}/first.csv", "--sensor-noise", "x=0.05"]
    assert run([*given, "-o", str(folder / "first")]) == 0
    return folder


@pytest.fixture
def fitted(folder, capsys):
    def command(name, *words, model="line", noise="0.05"):
        given = ["--sensor-noise", f"x={noise}", "--json", *words]
        code = run(["calibrate", f"{folder}/m.py:{model}", f"{folder}/{name}.csv", *given])
        out, err = capsys.readouterr()
        return json.loads(out) if code == 0 else (code, err)

    return command


def test_updating_a_calibration_is_the_fit_of_all_data_together(folder, fitted):
    both, updated = fitted("all"), fitted("second", "--prior", f"@{folder}/first/result.json")
    first = json.loads((folder / "first" / "result.json").read_text())
    for name in ("b0", "b1"):
        values = [r["estimate"]["parameters"][name]["value"] for r in (both, updated)]
        assert values[1] == pytest.approx(values[0], rel=1e-12)
    matrices = [r["estimate"]["covariance"]["matrix"] for r in (both, updated)]
    assert np.array(matrices[1]) == pytest.approx(np.array(matrices[0]), rel=1e-11)
    squares = first["noise"]["chi_square"] + updated["noise"]["chi_square"]
    assert squares == pytest.approx(both["noise"]["chi_square"], rel=1e-11)


def test_data_that_contradict_the_prior_are_said_first(folder, fitted):
    found = fitted("moved", "--prior", f"@{folder}/first/result.json")
    assert "and these data disagree: chi-square" in found["notes"][2]
    assert "and these data disagree" in found["misfit"][0]["where"]
    agreeing = fitted("second", "--prior", f"@{folder}/first/result.json")
    assert not any("disagree" in note for note in agreeing["notes"])


def test_one_reading_updates_what_two_could_not_determine(folder, fitted):
    (folder / "one.csv").write_text("y,x\n10,23\n10.5,24\n")
    before = json.loads((folder / "first" / "result.json").read_text())["estimate"]["parameters"]
    after = fitted("one", "--prior", f"@{folder}/first/result.json")["estimate"]["parameters"]
    assert after["b1"]["std"] < 0.5 * before["b1"]["std"]


@pytest.mark.parametrize(
    ("words", "model", "said"),
    [
        (["--prior", "first/result.json"], "line", "write it as --prior @old/result.json"),
        (["--prior", "@nowhere"], "line", "no such result"),
        (["--prior", "@FIRST"], "parabola", "and no prior for parabola"),
    ],
)
def test_a_prior_that_is_none_is_refused(folder, fitted, words, model, said):
    given = [w.replace("FIRST", f"{folder}/first") for w in words]
    code, err = fitted("second", *given, model=model)
    assert code == 1
    assert said in err


def test_a_prior_in_another_unit_is_refused(tmp_path, capsys):
    from casest.demo import RECORD

    given = ["norm-diagonal", str(RECORD), "--columns", "v=ax,ay,az", "--rate", "50", "--at-rest"]
    given += ["--set", "norm=9.80665"]
    assert run(["calibrate", *given, "-o", str(tmp_path)]) == 0
    assert run(["calibrate", *given, "--unit", "v=gauss", "--prior", f"@{tmp_path}"]) == 1
    assert "its offset is in m/s^2, and with these data it is in gauss" in capsys.readouterr().err
