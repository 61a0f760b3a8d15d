"""A project file is the command line that one would have typed, and `init` writes a right one."""

from __future__ import annotations

import json
import shutil
import tomllib
from itertools import pairwise
from pathlib import Path

import click
import numpy as np
import pytest
import simulators as sim

from casest.cli import commands, run
from casest.cli.project import expanded
from casest.demo import FOLDER, RECORD, WHEEL

BENCH = """
model = "norm-triangular"
data = ["handheld.csv"]
rate = 50
at_rest = true
output = "out"
holdout = ["other.csv"]
effects = ["own.py:bump", "time_delay"]
[columns]
v = ["ax", "ay", "az"]
[constants]
norm = "9.80665 m/s^2"
[fix]
scale = "@lab/result.json"
offset = [1, 2.5, 3]
[compare]
starts = 0
"""


def words(text, folder, *typed):
    (folder / "bench.toml").write_text(text, encoding="utf-8")
    return expanded([typed[0], "--project", str(folder / "bench.toml"), *typed[1:]], commands)


def pairs(line):
    """Options of a command line with their values."""
    return {(a, b) for a, b in pairwise(line) if a.startswith("-")}


def test_entries_become_the_words_that_one_would_have_typed(tmp_path):
    line = words(BENCH, tmp_path, "close")
    assert line[:3] == ["close", "norm-triangular", str(tmp_path / "handheld.csv")]
    assert "--at-rest" in line
    assert pairs(line) >= {
        ("--rate", "50"),
        ("--columns", "v=ax,ay,az"),
        ("--set", "norm=9.80665 m/s^2"),
        ("--fix", f"scale=@{tmp_path}/lab/result.json"),
        ("--fix", "offset=1,2.5,3"),
        ("--holdout", str(tmp_path / "other.csv")),
        ("--effects", str(tmp_path / "own.py:bump")),
        ("--effects", "time_delay"),
        ("--output", str(tmp_path / "out")),
    }


def test_what_is_typed_comes_last_and_arguments_replace_arguments(tmp_path):
    line = words(BENCH, tmp_path, "calibrate", "new.csv", "--rate", "100", "-o", "elsewhere")
    assert line[:3] == ["calibrate", "norm-triangular", "new.csv"]
    assert line[-4:] == ["--rate", "100", "-o", "elsewhere"]
    line = words(BENCH, tmp_path, "calibrate", "norm-diagonal")
    assert line[:3] == ["calibrate", "norm-diagonal", str(tmp_path / "handheld.csv")]


def test_each_command_takes_what_it_has_and_what_stands_under_its_name(tmp_path):
    assert ("--starts", "0") in pairs(words(BENCH, tmp_path, "compare"))
    assert "--starts" not in words(BENCH, tmp_path, "observe")
    line = words(BENCH, tmp_path, "apply")
    assert line[:3] == ["apply", str(tmp_path / "out"), str(tmp_path / "handheld.csv")]
    assert "--set" not in line


def test_a_command_line_without_a_project_is_left_alone():
    typed = ["calibrate", "norm-full", "x.csv", "--columns", "v=--project"]
    assert expanded(typed, commands) == typed
    assert expanded([], commands) == []


def test_every_command_that_reads_records_has_the_option():
    having = {
        name for name, c in commands.commands.items()
        if any("--project" in p.opts for p in c.params if isinstance(p, click.Option))
    }  # fmt: skip
    assert having >= {"calibrate", "close", "observe", "filter", "compare", "apply"}


WRONG = [
    ("colums = {v = 'a'}", "no option colums; did you mean columns?"),
    ("rate = ", "is no TOML"),
    ("at_rest = 'yes'", "at-rest is true or false, not 'yes'"),
]


@pytest.mark.parametrize(("text", "said"), WRONG)
def test_a_project_that_cannot_be_meant_is_refused_in_one_line(text, said, tmp_path, capsys):
    (tmp_path / "bench.toml").write_text(text)
    assert run(["calibrate", "--project", str(tmp_path / "bench.toml")]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_a_project_that_is_not_there_says_how_one_is_made(tmp_path, capsys):
    assert run(["close", "--project", str(tmp_path / "no.toml")]) == 1
    assert "`casest init DATA` writes one" in capsys.readouterr().err


def initiated(folder, *typed):
    """What `init` writes for a file, read again."""
    assert run(["init", *map(str, typed), "-o", str(folder / "bench.toml"), "--force"]) == 0
    return tomllib.loads((folder / "bench.toml").read_text(encoding="utf-8"))


def test_init_and_calibrate_find_what_the_shipped_record_was_made_from(tmp_path, capsys):
    shutil.copy(RECORD, tmp_path)
    found = initiated(tmp_path, tmp_path / "handheld.csv")
    assert found["data"] == ["handheld.csv"]
    assert found["at_rest"]
    assert run(["calibrate", "--project", str(tmp_path / "bench.toml")]) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    truth = json.loads((FOLDER / "truth.json").read_text())["parameters"]
    for name, p in result["estimate"]["parameters"].items():
        value, std = np.array(p["value"]), np.array(p["std"])
        assert np.all(np.abs(value - truth[name]) <= 4 * std + 1e-12), name
    assert f"casest calibrate norm-triangular {tmp_path}" in result["reproduce"]["command"]
    assert "Next:" in capsys.readouterr().out


def table(path, header, values):
    np.savetxt(path, values, delimiter=",", header=header, comments="", fmt="%.8g")
    return path


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(4)
    return sim.accelerometer(rng).read(sim.spread_poses(30, rng), 1e-3, rng)


def test_units_are_read_from_names_and_sizes_and_marked_as_guesses(tmp_path, poses):
    g = poses / sim.GRAVITY
    cases = {
        "acc_x,acc_y,acc_z": (poses, "m/s^2"),
        "ax,ay,az": (g, "g"),
        "magx,magy,magz": (g * 0.48, "gauss"),
        "m_x_uT,m_y_uT,m_z_uT": (g * 48, "uT"),
        "mag_x_mGauss,mag_y_mGauss,mag_z_mGauss": (g * 480, "mgauss"),
        "hx,hy,hz": (np.round(g * 4000), "count"),
    }
    for header, (values, unit) in cases.items():
        found = initiated(tmp_path, table(tmp_path / "x.csv", header, values))
        assert found["units"] == {"v": unit}, header
        assert found["model"] == "norm-triangular"
    text = (tmp_path / "bench.toml").read_text()
    assert "# no header says it; the median length is" in text


def test_a_time_and_angles_are_read_from_the_last_words_of_their_names(tmp_path, poses):
    ticks = np.arange(len(poses)) * 10_000
    angles = np.linspace(-170, 170, 3 * len(poses)).reshape(-1, 3)
    rows = np.column_stack([ticks, poses, angles])
    header = "tick_us,ax,ay,az,roll_deg,pitch_deg,yaw_deg"
    found = initiated(tmp_path, table(tmp_path / "x.csv", header, rows))
    assert found["columns"]["t"] == ["tick_us"]
    assert found["units"]["attitude"] == "deg"
    again = table(tmp_path / "x.csv", "k,ax,ay,az,roll,pitch,yaw", rows)
    assert initiated(tmp_path, again)["units"]["attitude"] == "deg"  # none turns 170 rad
    counted = table(tmp_path / "y.csv", "ax_raw,ay_raw,az_raw", np.round(poses * 400))
    counts = initiated(tmp_path, counted)
    assert counts["units"]["v"] == "count"
    assert counts["constants"]["norm"] == "9.80665 m/s^2"


def test_two_columns_for_two_signals_are_taken_in_order_and_marked(tmp_path, capsys):
    file = table(tmp_path / "x.csv", "Gewicht,ADC", np.array([[0, 8110], [1, 8530], [2, 8949.0]]))
    found = initiated(tmp_path, file, "--model", "load-cell")
    assert found["columns"] == {"load": ["Gewicht"], "reading": ["ADC"]}
    assert "a guess, by the order of the columns" in (tmp_path / "bench.toml").read_text()
    assert "column of load guessed: Gewicht" in capsys.readouterr().out


def test_a_unit_in_the_header_is_not_said_again(tmp_path, poses):
    file = table(tmp_path / "x.csv", "vx [m/s^2],vy [m/s^2],vz [m/s^2]", poses)
    assert "units" not in initiated(tmp_path, file)


def test_the_model_follows_from_what_the_columns_measure(tmp_path, poses):
    six = np.hstack([poses, poses[::-1] * 5])
    both = initiated(tmp_path, table(tmp_path / "a.csv", "ax,ay,az,mx,my,mz", six))
    assert both["model"] == "norm-pair"
    assert both["columns"] == {"a": ["ax", "ay", "az"], "m": ["mx", "my", "mz"]}
    turned = table(tmp_path / "b.csv", "ax,ay,az,roll [deg],pitch [deg],yaw [deg]", six)
    assert initiated(tmp_path, turned)["model"] == "rate-table"
    few = initiated(tmp_path, table(tmp_path / "c.csv", "ax,ay,az", poses[:9]))
    assert few["model"] == "norm-diagonal"
    wheel = initiated(tmp_path, WHEEL, "--model", "wheel")
    assert wheel["columns"] == {"v": ["vx", "vy", "vz"]}


def test_a_model_of_ones_own_is_found_again_from_the_projects_folder(tmp_path):
    own = Path(__file__).parent / "models"
    (tmp_path / "bench").mkdir()
    shutil.copy(own / "load_cell.py", tmp_path)
    file = table(tmp_path / "x.csv", "Masse [g],Temp [degC],U [mV]", np.eye(3) + 1)
    found = initiated(tmp_path / "bench", file, "--model", tmp_path / "load_cell.py:load_cell")
    assert found["model"] == "../load_cell.py:load_cell"
    assert found["data"] == ["../x.csv"]
    assert found["columns"] == {"output": ["U"], "mass": ["Masse"]}


def test_what_has_no_axes_asks_for_a_model(tmp_path, capsys):
    file = table(tmp_path / "x.csv", "load,bridge", np.eye(2))
    assert run(["init", str(file), "-o", str(tmp_path / "b.toml")]) == 1
    assert "name the model: casest init" in capsys.readouterr().err
    assert not (tmp_path / "b.toml").exists()


def test_a_project_file_is_not_written_over(tmp_path, capsys):
    (tmp_path / "b.toml").write_text("mine")
    assert run(["init", str(RECORD), "-o", str(tmp_path / "b.toml")]) == 1
    assert "--force writes over it" in capsys.readouterr().err
    assert (tmp_path / "b.toml").read_text() == "mine"
