"""What a newcomer does with files of his own, mistakes included, and what casest says to it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import simulators as sim

from casest.cli import run

MODELS = Path(__file__).parent / "models"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A record, and what the commands make of it, one folder each."""
    folder, rng = tmp_path_factory.mktemp("steps"), np.random.default_rng(3)
    sensor = sim.accelerometer(rng, skew=False)
    v = sensor.read(sim.spread_poses(30, rng), 5e-3, rng)
    np.savetxt(folder / "poses.csv", v / sim.GRAVITY, delimiter=",", header="AccX,AccY,AccZ")
    words = [str(folder / "poses.csv"), "--columns", "v=Acc", "--unit", "v=g"]
    for command in ("calibrate", "observe"):
        assert run([command, "norm-diagonal", *words, "-o", str(folder / command)]) == 0
    once = ["--solver", "ipopt", "--starts", "0", "-o", str(folder / "compare")]
    assert run(["compare", "norm-diagonal", *words, *once]) == 0
    made = ["--directions", "20", "-o", str(folder / "simulate")]
    assert run(["simulate", "norm-diagonal", *made]) == 0
    exported = ["--to", "json", "-o", str(folder / "correction.json")]
    assert run(["export", str(folder / "calibrate"), *exported]) == 0
    return folder


def said(capsys, code, *arguments) -> str:
    """The error of a command, on one line of words."""
    capsys.readouterr()
    assert run([str(a) for a in arguments]) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    return printed.err


@pytest.mark.parametrize("command", ["observe", "compare", "simulate"])
def test_a_folder_of_another_command_is_no_result(command, folder, capsys):
    for words in (["apply", folder / command, folder / "poses.csv"],
                  ["export", folder / command, "--to", "c"]):  # fmt: skip
        text = said(capsys, 1, *words)
        assert f"of `casest {command}`; casest calibrate (or close) MODEL DATA -o" in text


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("observe/observe.json", "not a result of calibrate or close, but what `casest observe`"),
        ("compare/compare.json", "not a result of calibrate or close, but what `casest compare`"),
        ("simulate/truth.json", "not a result of calibrate or close, but what `casest simulate`"),
        ("correction.json", "is a correction exported already"),
        ("calibrate/report.html", "calibrate/result.json?"),
        ("poses.csv", "poses.csv: not a result.json"),
        ("nowhere", "nowhere: no such result; casest calibrate (or close) MODEL DATA -o"),
    ],
)
def test_a_file_that_is_no_result_is_said_to_be_what_it_is(file, words, folder, capsys):
    assert words in said(capsys, 1, "export", folder / file, "--to", "c")


def test_a_parameter_is_not_taken_from_what_is_no_result(folder, capsys):
    words = ["norm-diagonal", folder / "poses.csv", "--columns", "v=Acc"]
    held = f"scale=@{folder / 'observe' / 'observe.json'}"
    assert "but what `casest observe` writes" in said(capsys, 1, "calibrate", *words, "--fix", held)


def test_apply_takes_the_options_of_the_fit(tmp_path, capsys):
    mass, celsius = np.linspace(0, 5, 40), np.tile([10.0, 40.0], 20)
    output = 0.5 + 0.1 * 9.80665 * mass
    file = tmp_path / "cell.csv"
    np.savetxt(
        file, np.c_[output, 1000 * mass, celsius],
        delimiter=",", header="signal [mV],weight [g],temperature [degC]", comments="",
    )  # fmt: skip
    words = [str(file), "--columns", "mass=weight", "--columns", "output=signal"]
    out = str(tmp_path / "out")
    assert run(["calibrate", f"{MODELS / 'load_cell.py'}:load_cell", *words, "-o", out]) == 0
    capsys.readouterr()
    assert run(["apply", out, *words]) == 0
    rows = capsys.readouterr().out.splitlines()
    force = np.array([row.split(",")[-1] for row in rows[1:]], dtype=float)
    np.testing.assert_allclose(force, 9.80665 * mass, atol=1e-6)


def test_a_file_in_the_place_of_the_folder_is_refused_before_the_fit(folder, capsys):
    file = folder / "poses.csv"
    before = file.read_bytes()
    text = said(capsys, 1, "calibrate", "norm-diagonal", file, "--columns", "v=Acc", "-o", file)
    assert "Invalid value for '-o' / '--output'" in text
    assert "is a file" in text
    assert file.read_bytes() == before


def test_held_numbers_are_printed_as_written(folder, capsys):
    words = ["norm-diagonal", str(folder / "poses.csv"), "--columns", "v=Acc", "--unit", "v=g"]
    assert run(["calibrate", *words, "--set", "norm=1 g"]) == 0
    assert "\n  norm = 1 g (held)\n" in capsys.readouterr().out
    assert run(["calibrate", *words, "--fix", "scale=1,1.01,1"]) == 0
    assert "\n  scale = [1, 1.01, 1] " in capsys.readouterr().out


ODOMETER = '''
from casest import Residual, constant, model, param, pi, quantity, signal

@model
def odometer(distance=signal("m"), load=signal("kg"), ticks=signal("count"), *,
             radius=param("m", start=0.3, bounds=(0.1, 1.0)), softness=param("m/kg"),
             per_turn=constant(1024, "count")):
    """Ticks of a wheel that gives way under load."""
    travelled = quantity("travelled", distance, "m")
    turns = travelled / (2 * pi * (radius - softness * load))
    return Residual(measured=ticks, predicted=quantity("predicted", per_turn * turns, "count"),
                    corrected=travelled)
'''


def test_a_sensor_never_heard_of_is_closed_with_units_and_numbers_of_its_columns(tmp_path):
    """A wheel odometer whose tyre grows by 4e-4/K, which nobody declared, in the user's own file.

    Decimal commas, semicolons, cm; the truth is the simulation's.
    """
    rng = np.random.default_rng(8)
    d, load, T = rng.uniform(10, 400, 80), rng.choice([0, 150, 300], 80), rng.uniform(5, 35, 80)
    radius = (0.305 - 3e-6 * load) * (1 + 4e-4 * (T - 20))
    ticks = np.round(1024 * d / (2 * np.pi * radius) + 3 * rng.standard_normal(80))
    rows = [
        f"{100 * a:.2f};{b};{c:.3f};{e:.0f}" for a, b, c, e in zip(d, load, T, ticks, strict=True)
    ]
    lines = ["Strecke [cm];payload [kg];tyre temp [°C];encoder [LSB]", *rows]
    (tmp_path / "drive.csv").write_text("\n".join(lines).replace(".", ","), encoding="utf-8")
    (tmp_path / "odometer.py").write_text(ODOMETER, encoding="utf-8")
    words = ["--columns", "distance=Strecke", "--columns", "load=payload"]
    files = [str(tmp_path / "odometer.py"), str(tmp_path / "drive.csv")]
    out = tmp_path / "out"
    assert run(["close", *files, *words, "--columns", "ticks=encoder", "-o", str(out)]) == 0
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert result["verdict"] == "extended"
    (found,) = result["effects"]
    assert (found["name"], found["column"]) == ("temperature_gain_curve", "tyre temp")
    k = found["parameters"]["k"]
    assert k["unit"] == "1/K"
    # The distance belongs to a larger tyre: fewer ticks, by the growth from the mean temperature.
    assert abs(k["value"] + 4e-4) < 5 * k["std"] + 4e-4**2 * 15
    # And of 1/(1 + x) it is x² that bends it: up to eight ticks, of a noise of three.
    bend = found["parameters"]["bend"]
    assert abs(bend["value"] - 4e-4**2) < 4 * bend["std"]
    about = f"(tyre temp − {np.mean(T.round(3)):.6g})"
    assert found["formula"] == f"u·(1 + k·{about} + bend·{about}²)"


BODY = """
import math
import numpy as np
from casest import Residual, model, param, signal

@model
def line(x=signal("1"), y=signal("1"), *, k=param("1", start=1.0), c=param("1")):
    return Residual(measured=y, predicted={})
"""


@pytest.mark.parametrize(
    ("formula", "words"),
    [
        ("k * x if x > 0 else c", "write if_else(condition, one, other)"),
        ("k * math.sin(x) + c", "functions of `math` take numbers alone: use casest's"),
    ],
)
def test_python_where_casadi_is_meant_is_explained(formula, words, tmp_path, capsys):
    (tmp_path / "line.py").write_text(BODY.format(formula), encoding="utf-8")
    (tmp_path / "d.csv").write_text("x,y\n1,2\n2,3\n3,4.1\n4,5\n", encoding="utf-8")
    text = said(capsys, 1, "calibrate", tmp_path / "line.py", tmp_path / "d.csv")
    assert words in text
    assert "line.py, line " in text


def test_a_function_of_numpy_does_what_it_says(tmp_path, capsys):
    (tmp_path / "line.py").write_text(BODY.format("k * np.sin(x) + c"), encoding="utf-8")
    x = np.linspace(0, 3, 20)
    rows = "\n".join(f"{a},{2 * np.sin(a) - 1 + 1e-3 * (-1) ** i}" for i, a in enumerate(x))
    (tmp_path / "d.csv").write_text(f"x,y\n{rows}\n", encoding="utf-8")
    out = tmp_path / "out"
    files = [str(tmp_path / "line.py"), str(tmp_path / "d.csv")]
    assert run(["calibrate", *files, "-o", str(out)]) == 0
    assert capsys.readouterr().err == ""
    found = json.loads((out / "result.json").read_text(encoding="utf-8"))["estimate"]["parameters"]
    assert abs(found["k"]["value"] - 2) < 5e-3
    assert abs(found["c"]["value"] + 1) < 5e-3
