"""The budget: shares sum to one, two noises are told apart, a result without one is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from casest.cli import run

MODEL = '''
from casest import Residual, constant, model, param, quantity, signal


@model
def line(y=signal("1"), x=signal("1"), *, b0=param("1"), b1=param("1", start=1.0),
         shift=constant(0.1, "1", std=0.02)):
    """x = b0 + b1 (y - shift)."""
    truth = quantity("truth", y - shift, "1")
    return Residual(measured=x, predicted=b0 + b1 * truth, corrected=truth)
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("budget")
    (folder / "line.py").write_text(MODEL)
    rng = np.random.default_rng(3)
    y = np.linspace(1, 5, 12)
    x = 3 + 2 * y + 0.05 * rng.standard_normal(12)
    rows = np.column_stack([y + 0.02 * rng.standard_normal(12), x])
    np.savetxt(folder / "data.csv", rows, delimiter=",", header="y,x", comments="")
    noise = ["--sensor-noise", "x=0.05", "--sensor-noise", "y=0.02"]
    given = ["calibrate", f"{folder}/line.py", f"{folder}/data.csv", *noise]
    assert run([*given, "-o", f"{folder}/out"]) == 0
    assert run(["budget", f"{folder}/out", "-o", f"{folder}/budget"]) == 0
    return folder


def test_shares_of_every_value_and_of_a_corrected_reading_sum_to_one(folder):
    budget = json.loads((folder / "budget" / "budget.json").read_text())
    assert [i["name"] for i in budget["inputs"]] == ["shift", "noise of y", "noise of x"]
    for value in budget["values"]:
        shares = [i["share"][value["name"]] for i in budget["inputs"]]
        assert sum(shares) == pytest.approx(1, abs=1e-9)
    assert sum(s[0] for s in budget["corrected"]["share"].values()) == pytest.approx(1, abs=1e-9)


def test_the_noise_of_input_and_reading_have_the_shares_of_a_straight_line(folder):
    """The residual's variance is u_x² + b₁²u_y²: so are the parts of what it does."""
    budget = json.loads((folder / "budget" / "budget.json").read_text())
    slope = next(v["value"] for v in budget["values"] if v["name"] == "b1")
    of = {i["name"]: i["share"]["b1"] for i in budget["inputs"]}
    assert of["noise of y"] / of["noise of x"] == pytest.approx((slope * 0.02 / 0.05) ** 2)


def test_a_common_shift_moves_the_intercept_alone(folder):
    budget = json.loads((folder / "budget" / "budget.json").read_text())
    (shift,) = [i for i in budget["inputs"] if i["kind"] == "reference"]
    slope = next(v["value"] for v in budget["values"] if v["name"] == "b1")
    assert shift["sensitivity"]["b0"] == pytest.approx(slope, rel=1e-3)
    assert shift["share"]["b1"] == pytest.approx(0, abs=1e-3)


def test_the_table_and_the_page_say_what_the_file_says(folder, capsys):
    assert run(["budget", f"{folder}/out"]) == 0
    out = capsys.readouterr().out
    assert "Of the variance of each value, in percent:" in out
    assert out.count("reading's") == 1
    said = out.split("Sensitivity of each value, its unit over that of the input:")[1].split()
    slope = json.loads((folder / "budget" / "budget.json").read_text())["inputs"][0]["sensitivity"]
    assert said[:4] == ["value", "shift", "b0", f"{slope['b0']:.3g}"]
    page = (folder / "budget" / "budget.html").read_text()
    assert page.count("<rect") > 6
    assert "noise of y" in page
    assert f"{slope['b0']:.3g}" in page.split("Sensitivities")[-1]


def test_a_result_of_an_older_casest_has_no_budget(folder, capsys, tmp_path):
    saved = json.loads((folder / "out" / "result.json").read_text())
    del saved["estimate"]["covariance"]
    (tmp_path / "result.json").write_text(json.dumps(saved))
    assert run(["budget", str(tmp_path)]) == 1
    assert "made by an older casest, without a budget" in capsys.readouterr().err
