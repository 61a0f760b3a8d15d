"""Simulated records are read and calibrated back to their truth; what cannot be made is said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from casest.cli import run as command

LOAD_CELL = str(Path(__file__).parent / "models" / "load_cell.py:load_cell")
WHEEL = [
    "--duration", "60", "--rate", "100", "--noise", "0.05",
    "--value", "speed=10,-0.05,1e-4,1e-7", "--value", "misalignment=0.5,0.4,0.3",
    "--value", "tilt=0.8", "--value", "offset=0.2,-0.1,0.3", "--value", "phase=1",
]  # fmt: skip
G = ["--set", "norm=9.80665"]


def made(folder, model, *arguments):
    assert command(["simulate", model, *arguments, "-o", str(folder)]) == 0
    return folder / "record.csv", json.loads((folder / "truth.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("model", "arguments", "settings"),
    [
        ("wheel", WHEEL, []),
        ("norm-diagonal", ["--directions", "30", "--noise", "0.01", *G], G),
        ("norm-triangular", ["--directions", "30", "--noise", "0.01", *G], G),
        ("rate-table", ["--directions", "40", "--noise", "0.002", "--value", "bias=0.1,0,0"], []),
    ],
)
def test_a_simulated_record_is_calibrated_back_to_its_truth(
    tmp_path, capsys, model, arguments, settings
):
    record, truth = made(tmp_path, model, *arguments)
    capsys.readouterr()
    assert command(["calibrate", model, str(record), *settings, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["estimate"]
    for name, true in truth["parameters"].items():
        value = np.ravel(found["parameters"][name]["value"])
        std = np.ravel(found["parameters"][name]["std"])
        away = np.abs(value - np.ravel(true))[std > 0] / std[std > 0]
        assert away.max() < 6, name


@pytest.mark.long
def test_an_effect_of_poses_that_was_added_is_what_the_loop_finds(tmp_path, capsys):
    added = ["--effect", "cross_axis", "--value", "cross_axis.k=0.02,-0.01,0.03"]
    record, truth = made(
        tmp_path, "norm-diagonal", "--directions", "60", "--noise", "0.003", *G, *added
    )
    assert truth["effects"] == ["cross_axis"]
    out = tmp_path / "out"
    assert command(["close", "norm-diagonal", str(record), *G, "-o", str(out)]) == 0
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert [e["name"] for e in result["effects"]] == ["cross_axis"]
    found = result["after"]["parameters"]["cross_axis.k"]
    away = np.subtract(found["value"], truth["parameters"]["cross_axis.k"])
    assert np.all(np.abs(away) < 5 * np.array(found["std"]))


@pytest.mark.long
def test_an_effect_that_was_added_is_what_the_loop_finds(tmp_path, capsys):
    effect = ["--effect", "imbalance", "--value", "imbalance.sine=0.3"]
    record, truth = made(tmp_path, "wheel", *WHEEL, *effect)
    assert truth["effects"] == ["imbalance"]
    assert command(["close", "wheel", str(record), "-o", str(tmp_path / "out")]) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert [e["name"] for e in result["effects"]] == ["imbalance"]
    sine = result["after"]["parameters"]["imbalance.sine"]
    assert abs(sine["value"] - 0.3) < 5 * sine["std"]


def test_the_known_length_is_found_by_what_the_residual_does_and_not_by_its_name(tmp_path):
    (tmp_path / "sphere.py").write_text(
        "from casest import Residual, constant, model, norm_2, param, quantity, signal\n"
        "@model\n"
        'def sphere(m=signal(3), *, centre=param(3, "[m]"), norm=constant(2.0), '
        'earth=constant(48.0, "[m]")):\n'
        '    """A field of known strength; `norm` is something else."""\n'
        '    field = quantity("field", m - centre, "[m]")\n'
        '    return Residual(implicit=norm * (norm_2(field) - earth), unit="[m]",\n'
        '                    corrected=field, axes=("norm",))\n',
        encoding="utf-8",
    )
    record, _ = made(tmp_path / "out", str(tmp_path / "sphere.py"), "--directions", "20",
                     "--value", "centre=1,2,3")  # fmt: skip
    readings = np.loadtxt(record, delimiter=",", skiprows=1)
    assert np.linalg.norm(readings - [1, 2, 3], axis=1) == pytest.approx(48, rel=1e-9)


def test_other_signals_and_columns_come_from_a_file(tmp_path, capsys):
    (tmp_path / "cell.py").write_text(
        "from casest import Residual, model, param, quantity, signal\n"
        "@model\n"
        'def cell(force=signal("N"), v=signal("mV"), *, zero=param("mV"), '
        'gain=param("mV/N", start=2.0)):\n'
        '    """Linear."""\n'
        '    load = quantity("load", force, "N")\n'
        '    reading = quantity("reading", zero + gain * load, "mV")\n'
        "    return Residual(measured=v, predicted=reading, corrected=load)\n",
        encoding="utf-8",
    )
    force, warm = np.linspace(0, 20, 60), 20 + 5 * np.sin(np.arange(60))
    loads = tmp_path / "loads.csv"
    table = np.column_stack([force, warm])
    np.savetxt(loads, table, delimiter=",", header="force [N],temp", comments="")
    model = str(tmp_path / "cell.py")
    arguments = ["--input", str(loads), "--effect", "temperature_bias(temp)", "--noise", "0.01"]
    record, truth = made(tmp_path / "out", model, *arguments, "--value", "zero=0.5")
    head, *rows = record.read_text(encoding="utf-8").splitlines()
    assert head == "force [N],v [mV],temp"
    assert len(rows) == 60
    assert truth["effects"] == ["temperature_bias(temp)"]


def test_the_only_column_is_the_one_that_an_effect_follows(tmp_path):
    loads = tmp_path / "loads.csv"
    loads.write_text("mass [kg],volt [V]\n1,5.0\n2,5.1\n3,5.2\n")
    _, truth = made(
        tmp_path / "out", LOAD_CELL, "--input", str(loads), "--effect", "channel_bias",
    )  # fmt: skip
    assert truth["effects"] == ["channel_bias(volt)"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["norm-diagonal"], "give --directions N"),
        (["wheel"], "say --duration and --rate"),
        (["wheel", "--duration", "-1", "--rate", "10"], "both must be positive"),
        (["wheel", *WHEEL, "--effect", "nothing"], "no such effect"),
        (["wheel", *WHEEL, "--effect", "imbalace"], "did you mean imbalance?"),
        (["wheel", *WHEEL, "--effect", "temperature_bias"], "say which, temperature_bias(COLUMN)"),
        ([LOAD_CELL], "load-cell needs mass: give --input FILE with them"),
        (["wheel", *WHEEL, "--effect", "outliers"], "it describes noise and makes none"),
        (["wheel", *WHEEL, "--noise", "-1"], "a standard deviation, not negative"),
        (["wheel", *WHEEL, "--value", "radius=1"], "unknowns are gain"),
        (["bias-gravity"], "say --duration and --rate"),
        (["norm-pair", "--directions", "5"], "cannot be simulated"),
    ],
)
def test_what_cannot_be_simulated_is_said(tmp_path, capsys, arguments, words):
    assert command(["simulate", *arguments, "-o", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error
    assert not (tmp_path / "record.csv").exists()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_a_script_for_the_shell(capsys, shell):
    assert command(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "_CASEST_COMPLETE" in script
    assert shell in script


CURVE = '''
from casest import Residual, model, param, signal


@model
def curve(x=signal("1", std=0.1), y=signal("1"), *, b=param("1", start=2.0)):
    """A line through nought."""
    return Residual(measured=y, predicted=b * x)
'''


def test_every_sensor_of_a_record_has_its_own_noise(tmp_path, capsys):
    """What the model reads too: declared, as a number, and what two signals share."""
    (tmp_path / "m.py").write_text(CURVE)
    x = np.linspace(0, 1, 4000)
    np.savetxt(tmp_path / "x.csv", x[:, None], header="x", comments="", fmt="%.17g")

    def noise(*words):
        given = ["simulate", f"{tmp_path}/m.py", "--input", f"{tmp_path}/x.csv", *words]
        assert command([*given, "-o", f"{tmp_path}/s"]) == 0
        found = np.loadtxt(tmp_path / "s" / "record.csv", delimiter=",", skiprows=1)
        return found - np.column_stack([x, 2 * x])

    declared = noise()
    assert declared[:, 0].std() == pytest.approx(0.1, rel=0.05)
    assert np.abs(declared[:, 1]).max() < 1e-9
    both = noise("--sensor-noise", "x,y=0.04,0.03;0.03,0.09")
    assert np.cov(both.T) == pytest.approx(np.array([[0.04, 0.03], [0.03, 0.09]]), abs=0.005)
    assert noise("--sensor-noise", "x=0.3", "--noise", "0.2").std(axis=0) == pytest.approx(
        [0.3, 0.2], rel=0.05
    )
    twice = ["--input", f"{tmp_path}/x.csv", "--noise", "0.2", "--sensor-noise", "y=0.2"]
    assert command(["simulate", f"{tmp_path}/m.py", *twice, "-o", f"{tmp_path}/no"]) == 1
    assert "--noise and --sensor-noise y=… both say the noise of y" in capsys.readouterr().err
