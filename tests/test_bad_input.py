"""Bad input: one line that names the thing and the way out, exit code 1, nothing half written."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from casest.cli import run

MODELS = Path(__file__).parent / "models"
CELL = f"{MODELS / 'load_cell.py'}:load_cell"
GOOD = "output [mV],mass [kg]\n" + "".join(
    f"{0.5 + 0.98 * m + 0.001 * (-1) ** k:.6f},{m:.3f}\n"
    for k, m in enumerate(np.linspace(0, 5, 12))
)
HEADER = (
    "from casest import *\n\n\n@model\n"
    "def line(y=signal('V'), x=signal('A'), *, a=param('V'), r=param('ohm')):\n"
    "    '''Ohm's law with an offset.'''\n"
)
BODY = "    return Residual(measured=y, predicted=a + r * x)\n"


@pytest.fixture
def refused(tmp_path, capsys, monkeypatch):
    """Run a calibration in a folder of its own; return the one line that it leaves on stderr."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.csv").write_text(GOOD, encoding="utf-8")

    def call(*arguments: str, files: dict[str, str] | None = None, code: int = 1) -> str:
        for name, text in (files or {}).items():
            (tmp_path / name).write_text(text, encoding="utf-8")
        assert run([*arguments]) == code
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith("casest: ")
        assert printed.err.count("\n") == 1, printed.err
        assert "internal error" not in printed.err
        assert "Traceback" not in printed.err
        assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())
        return printed.err.removeprefix("casest: ").rstrip("\n")

    return call


def calibrate(*more: str) -> list[str]:
    return ["calibrate", CELL, *more, "-o", "out"]


def replaced(old: str, new: str) -> dict[str, str]:
    """The good record with one text in it replaced."""
    assert old in GOOD
    return {"bad.csv": GOOD.replace(old, new, 1)}


# -- the record -----------------------------------------------------------------------------------


def test_a_missing_file_is_named_with_a_near_one(refused):
    text = refused(*calibrate("goood.csv"))
    assert "goood.csv: no such file" in text
    assert "good.csv" in text.split("did you mean")[1]


@pytest.mark.parametrize("content", ["", "\n", "output [mV],mass [kg]\n"])
def test_an_empty_file_is_named(refused, content):
    text = refused(*calibrate("bad.csv"), files={"bad.csv": content})
    assert text.startswith("bad.csv")
    assert re.search("empty|no data|no rows|no numbers", text)


def test_a_missing_column_is_named_with_what_there_is(refused):
    text = refused(*calibrate("bad.csv"), files=replaced("mass [kg]", "weight [kg]"))
    assert text.startswith("bad.csv: ")
    assert "signal mass" in text
    assert "weight" in text
    assert "--columns mass=" in text


def test_a_misnamed_column_suggests_the_near_one(refused):
    text = refused(*calibrate("good.csv", "--columns", "mass=mas"))
    assert "good.csv: no column mas for signal mass; did you mean mass?" in text


@pytest.mark.parametrize("cell", ["oops", "inf", "-inf", "1e400"])
def test_a_cell_that_is_no_finite_number_is_named_by_column_row_and_value(refused, cell):
    lines = GOOD.splitlines()
    lines[4] = f"{lines[4].split(',')[0]},{cell}"
    text = refused(*calibrate("bad.csv"), files={"bad.csv": "\n".join(lines) + "\n"})
    assert text.startswith("bad.csv: column mass row 3 ")
    assert cell in text
    assert "signal mass" in text


def test_a_unit_of_the_same_kind_is_converted(refused, tmp_path, capsys):
    text = GOOD.replace("output [mV]", "output [V]")
    rows = [line.split(",") for line in text.splitlines()[1:]]
    lines = [text.splitlines()[0], *(f"{float(a) / 1000:.9f},{b}" for a, b in rows)]
    (tmp_path / "volts.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert run(["calibrate", CELL, "volts.csv", "--json"]) == 0
    volts = capsys.readouterr().out
    assert run(["calibrate", CELL, "good.csv", "--json"]) == 0
    import json

    found, expected = (json.loads(t)["estimate"] for t in (volts, capsys.readouterr().out))
    for name in ("zero", "sensitivity"):
        a, b = found["parameters"][name], expected["parameters"][name]
        assert a["unit"] == b["unit"]
        assert a["value"] == pytest.approx(b["value"], rel=1e-4)


def test_a_unit_of_another_kind_is_refused_by_column(refused):
    text = refused(*calibrate("bad.csv"), files=replaced("mass [kg]", "mass [degC]"))
    assert text.startswith("bad.csv: column mass is in degC and signal mass wants kg")
    assert "--unit mass=" in text


TIMED = (
    "from casest import *\n\n\n@model\n"
    "def drift(t=signal('s'), y=signal('V'), *, a=param('V'), b=param('V/s')):\n"
    "    '''A drift.'''\n    return Residual(measured=y, predicted=a + b * t)\n"
)


@pytest.mark.parametrize(
    ("times", "row", "words"),
    [([0, 1, 2, 1.5, 4, 5], 3, "back"), ([0, 1, 2, 2, 4, 5], 3, "repeat")],
)
def test_a_time_that_runs_backwards_or_repeats_is_named_by_row(refused, times, row, words):
    record = "t [s],y [V]\n" + "".join(f"{t},{np.sin(t):.4f}\n" for t in times)
    files = {"drift.py": TIMED, "bad.csv": record}
    text = refused("calibrate", "drift.py", "bad.csv", "-o", "out", files=files)
    assert text.startswith("bad.csv")
    assert f"row {row}" in text
    assert words in text


def test_fewer_rows_than_unknowns_are_refused_with_both_numbers(refused):
    lines = GOOD.splitlines()[:2]
    text = refused(*calibrate("bad.csv"), files={"bad.csv": "\n".join(lines) + "\n"})
    assert "bad.csv: 1 rows give 1 equations for the 2 unknowns of load-cell" in text
    assert "--fix" in text


def test_constant_data_are_refused(refused):
    record = "output [mV],mass [kg]\n" + "1.5,2.0\n" * 12
    text = refused(*calibrate("bad.csv"), files={"bad.csv": record})
    assert text.startswith("bad.csv: signal ")
    assert "in all 12 rows" in text


def test_clipped_readings_are_warned_of_with_their_count(tmp_path, capsys):
    rng = np.random.default_rng(0)
    u = rng.standard_normal((400, 3))
    v = 20 * u / np.linalg.norm(u, axis=1)[:, None] + 0.01 * rng.standard_normal((400, 3))
    clipped = np.clip(v, None, 16.0)
    count = int(np.sum(v[:, 0] > 16))
    rows = [",".join(f"{x:.4f}" for x in r) for r in clipped]
    lines = ["vx [m/s^2],vy [m/s^2],vz [m/s^2]", *rows]
    (tmp_path / "full.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    run(["calibrate", "norm-diagonal", str(tmp_path / "full.csv"), "--set", "norm=20"])
    text = " ".join(capsys.readouterr().out.split())
    assert f"vx: {count} readings at the largest value 16 — clipped at full scale?" in text


# -- the model file -------------------------------------------------------------------------------


def refused_model(refused, text: str) -> str:
    record = "y [V],x [A]\n" + "".join(f"{np.sin(k):.4f},{np.cos(k):.4f}\n" for k in range(9))
    files = {"own.py": text, "record.csv": record}
    return refused("calibrate", "own.py", "record.csv", "-o", "out", files=files)


def test_a_syntax_error_is_named_by_file_line_and_text(refused):
    text = refused_model(refused, HEADER + "    return Residual(measured=y, predicted=\n")
    assert re.search(r"own\.py, line 7: ", text)
    assert "Residual(measured=y" in text


def test_an_undeclared_name_is_named_by_model_file_and_line(refused):
    text = refused_model(refused, HEADER + BODY.replace("r * x", "slope * x"))
    assert "model line" in text
    assert re.search(r"own\.py, line 7: name 'slope' is not defined", text)
    assert "declare it in the model's signature" in text


def test_a_duplicate_argument_is_named_by_file_and_line(refused):
    text = refused_model(refused, HEADER.replace("r=param('ohm')", "a=param('ohm')") + BODY)
    assert re.search(r"own\.py, line 5: duplicate argument 'a'", text)


def test_a_duplicate_quantity_is_named_by_model_file_and_line(refused):
    twice = "    u = quantity('u', a, 'V')\n    w = quantity('u', r * x, 'V')\n"
    text = refused_model(refused, HEADER + twice + BODY)
    assert "model line" in text
    assert re.search(r"own\.py, line 8: name 'u' is used twice", text)


def test_an_impossible_bound_is_named_by_file_line_and_declaration(refused):
    text = refused_model(refused, HEADER.replace("param('V')", "param('V', bounds=(2, 1))") + BODY)
    assert re.search(r"own\.py, line 5", text)
    assert "a=param('V', bounds=(2, 1))" in text
    assert "bounds (2, 1) leave no room: lower must be below upper" in text


def test_a_start_outside_its_bounds_is_named_by_file_and_line(refused):
    changed = HEADER.replace("param('V')", "param('V', start=5, bounds=(0, 1))")
    text = refused_model(refused, changed + BODY)
    assert re.search(r"own\.py, line 5", text)
    assert "start 5 is outside bounds (0, 1)" in text


def test_an_unknown_unit_is_named_by_file_and_parameter(refused):
    text = refused_model(refused, HEADER.replace("'ohm'", "'ohmm'") + BODY)
    assert "own.py" in text
    assert "model line: r has unknown unit 'ohmm'" in text


@pytest.mark.parametrize("unit", ["F", "C"])
def test_what_may_be_meant_by_farad_or_coulomb_is_said_where_degrees_do_not_fit(refused, unit):
    text = refused_model(refused, HEADER.replace("'ohm'", f"'{unit}'") + BODY)
    assert "F and C are degrees here: write farad and coulomb" in text


def test_a_unit_that_does_not_fit_is_named_by_model_and_symbols(refused):
    text = refused_model(refused, HEADER.replace("'ohm'", "'kg'") + BODY)
    assert "model line" in text
    assert "units do not fit" in text
    assert "r [kg]" in text
    assert "a [V]" in text


def test_a_failing_import_is_named_by_file_and_line(refused):
    text = refused_model(refused, "import no_such_package\n" + HEADER + BODY)
    assert re.search(r"own\.py, line 1\b", text)
    assert "No module named 'no_such_package'" in text


def test_a_file_without_a_model_says_so(refused):
    assert refused_model(refused, "x = 1\n") == "own.py declares no @model"


def test_a_missing_model_file_is_named(refused):
    assert refused("calibrate", "nowhere.py", "good.csv") == "nowhere.py: no such file"


def test_a_body_that_returns_nothing_is_named_by_model_and_file(refused):
    text = refused_model(refused, HEADER + "    a + r * x\n")
    assert "model line" in text
    assert "own.py" in text
    assert "must return Residual(…), not NoneType" in text


def test_an_effect_that_fails_is_named_by_effect_file_and_line(refused):
    effect = (
        "from casest import *\n\n\n@effect(on='reading')\n"
        "def bend(reading, *, k=param('1/mV')):\n    return reading + kk * reading**2\n"
    )
    text = refused(*calibrate("good.csv", "--effects", "bend.py"), files={"bend.py": effect})
    assert re.search(r"effect bend, .*bend\.py, line 6: name 'kk' is not defined", text)


# -- the options ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--set", "gravty=9.8"], "has no 'gravty'; did you mean 'gravity'?"),
        (["--set", "zero=1"], "zero is an unknown of"),
        (["--set", "gravity=abc"], "--set gravity=abc: "),
        (["--set", "gravity=9.8 kg"], "gravity is declared in 'm/s^2': 'kg' does not fit"),
        (["--set", "gravity"], "--set gravity: write it as --set name=value"),
        (
            ["--set", "gravity=1,2"],
            "gravity is one number, and these are two; decimals stand behind a point: gravity=1.2",
        ),
        (["--free", "gravty"], "has no 'gravty'; did you mean 'gravity'?"),
        (["--free", "mass"], "mass is a signal of model load-cell"),
        (
            ["--fix", "zero=1,2"],
            "zero is one number, and these are two; decimals stand behind a point: zero=1.2",
        ),
        (["--fix", "zero=1,x"], "--fix zero=1,x: not a number, a list 1,2,3 or rows 1,0;0,1"),
        (["--fix", "zero=1,2 volt-ish"], "--fix zero=1,2 volt-ish: "),
        (["--fix", "zero=@nowhere.json"], "nowhere.json: no such result"),
        (["--fix", "zero=@good.csv"], "good.csv: not a result.json"),
        (["--fix", "zero=5 K"], "zero is declared in 'mV': 'K' does not fit"),
        (["--shared", "gravity"], "gravity is not a parameter of model load-cell"),
        (["--per-run", "nothing"], "has no 'nothing'"),
        (["--start", "nothing=1"], "has no 'nothing'"),
        (["--start", "zero=5 K"], "zero is declared in 'mV': 'K' does not fit"),
        (["--start", "zero=x"], "zero"),
        (["--columns", "output"], "--columns output: write it as --columns name=value"),
        (["--columns", "outptu=0"], "--columns outptu=…: no signal or column outptu"),
        (["--unit", "output=volt-ish"], "--unit output=volt-ish: "),
        (["--scale", "output=int16//2"], "output"),
        (["--rate", "0"], "rate 0.0 Hz makes no sense"),
        (["--rate", "fast"], "'fast' is not a valid float"),
        (["--seed", "x"], "'x' is not a valid integer"),
        (["--solver", "newton"], "unknown solver 'newton' for load-cell; it has ipopt"),
        (["--effects", "nowhere.py"], "nowhere.py: no such file"),
        (["--effects", "quadratc"], "no shipped effect; did you mean 'quadratic'?"),
        (["--effects", "vibration"], "needs its frequency, which only `casest close` finds"),
        (
            ["--effects", "temperature_bias"],
            "this effect needs the column it follows: --effects 'temperature_bias(COLUMN)'",
        ),
        (["--holdout", "nowhere.csv"], "nowhere.csv: no such file"),
        (["--bogus"], "No such option '--bogus'"),
    ],
    ids=lambda p: " ".join(p) if isinstance(p, list) else "",
)
def test_an_option_that_makes_no_sense_is_named(refused, options, words):
    assert words in refused(*calibrate("good.csv", *options))


def test_a_shipped_model_is_suggested_for_a_near_name(refused):
    text = refused("calibrate", "norm-triangel", "good.csv")
    assert "no model 'norm-triangel'; did you mean 'norm-triangular'?" in text


def test_a_file_of_that_name_is_suggested(refused):
    Path("scales.py").write_text("", encoding="utf-8")
    text = refused("calibrate", "scales", "good.csv")
    assert "no model 'scales'; did you mean 'scales.py'?" in text
    text = refused(*calibrate("good.csv", "--effects", "scales"))
    assert "no shipped effect; did you mean 'scales.py'?" in text


def test_several_models_in_a_file_must_be_told_apart(refused):
    text = refused("calibrate", str(MODELS / "load_cell.py"), "good.csv")
    assert "load_cell.py declares load_cell, zero_only: say which, as" in text


def test_a_missing_argument_is_named(refused):
    assert "Missing argument 'DATA...'" in refused("calibrate", "norm-full")
    assert "No such command 'calibrat'" in refused("calibrat")


def test_an_output_that_is_no_folder_is_refused_and_left_alone(refused, tmp_path):
    text = refused("calibrate", CELL, "good.csv", "-o", "good.csv")
    assert "-o" in text
    assert "'good.csv' is a file" in text
    assert (tmp_path / "good.csv").read_text(encoding="utf-8") == GOOD


def test_a_held_value_from_a_refused_result_is_refused(refused, tmp_path, capsys):
    v = np.random.default_rng(0).standard_normal((30, 3))
    lines = ["vx,vy,vz"] + [",".join(f"{x:.6f}" for x in r / np.linalg.norm(r)) for r in v]
    (tmp_path / "v.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert run(["calibrate", "norm-full", "v.csv", "-o", "lab"]) == 2
    capsys.readouterr()
    text = refused("calibrate", "norm-triangular", "v.csv", "--fix", "scale=@lab")
    assert "its estimate was refused; calibrate again before using its scale" in text


def test_a_refusal_leaves_an_earlier_result_as_it_was(refused, tmp_path, capsys):
    assert run(["calibrate", CELL, "good.csv", "-o", "kept"]) == 0
    capsys.readouterr()
    before = {p.name: p.read_bytes() for p in (tmp_path / "kept").iterdir()}
    refused("calibrate", CELL, "goood.csv", "-o", "kept")
    assert {p.name: p.read_bytes() for p in (tmp_path / "kept").iterdir()} == before


@pytest.mark.parametrize("content", ["{", "[]", '{"no": "model"}', ""])
def test_what_is_no_result_is_not_applied(refused, content):
    text = refused("apply", "r.json", "good.csv", files={"r.json": content})
    assert text.startswith("r.json: not a")
