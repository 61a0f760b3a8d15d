"""`--effects "NAME(COLUMN)"`: an effect with the column that it is known to follow."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from casest.cli import run

G = ["--set", "norm=9.81 m/s^2"]
OWN = """
from casest import constant, each, effect, param
@effect(on="output", columns={"amps": "any"}, numbers={"at": "mean"})
def pull(y, amps, *, k=param(each, "[y]/[amps]"), at=constant(0.0)):
    '''A current pulls.'''
    return y + k * (amps - at)
"""
#: m/s² for each ampere, on the reading; the sensor's gain is 1.02.
PULL, GAIN, OFFSET = np.array([0.03, -0.015, 0.006]), 1.02, np.array([0.1, 0.2, -0.1])


@pytest.fixture
def record(tmp_path, monkeypatch):
    """Poses of an accelerometer beside a motor, in plain NumPy; its mean current is returned."""
    monkeypatch.chdir(tmp_path)
    rng, n = np.random.default_rng(0), 80
    v = rng.standard_normal((n, 3))
    v *= 9.81 / np.linalg.norm(v, axis=1)[:, None]
    amps, temp = rng.uniform(0, 5, n), rng.uniform(20, 30, n)
    reading = GAIN * v + OFFSET + np.outer(amps, PULL) + 5e-3 * rng.standard_normal((n, 3))
    header = "vx [m/s^2],vy [m/s^2],vz [m/s^2],motor current [A],temp [degC]"
    table = np.column_stack([reading, amps, temp])
    np.savetxt("poses.csv", table, delimiter=",", header=header, comments="")
    (tmp_path / "own.py").write_text(OWN)
    return float(np.mean(amps))


def result(*words: str):
    code = run([*words, *G, "-o", "out"])
    with open("out/result.json", encoding="utf-8") as file:
        return code, json.load(file)


@pytest.mark.parametrize(
    ("asked", "name"),
    [
        ("channel_bias(motor current)", "channel_bias(motor current).k"),
        ("own.py:pull(motor current)", "pull(motor current).k"),
        ("own.py(motor current)", "pull(motor current).k"),
    ],
)
def test_calibrate_fits_the_effect_of_the_column_that_is_named(record, asked, name):
    code, found = result("calibrate", "norm-diagonal", "poses.csv", "--effects", asked)
    assert code == 0
    fitted = found["estimate"]["parameters"]
    assert fitted[name]["unit"] == "(m/s^2)/A"
    # of the corrected value, so against the pull and without the gain; about the mean current
    k, std = (np.array(fitted[name][what]) for what in ("value", "std"))
    assert (np.abs(k + PULL / GAIN) < 4 * std).all()
    offset, std = (np.array(fitted["offset"][what]) for what in ("value", "std"))
    assert (np.abs(offset - OFFSET - PULL * record) < 4 * std).all()
    assert list(found["effects"][0]["columns"].values()) == ["motor current"]


@pytest.mark.parametrize("command", ["calibrate", pytest.param("close", marks=pytest.mark.long)])
def test_a_result_with_a_column_is_applied_with_it(record, command, capsys):
    asked = ["--effects", "channel_bias(motor current)"]
    assert result(command, "norm-diagonal", "poses.csv", *asked)[0] == 0
    capsys.readouterr()
    assert run(["apply", "out", "poses.csv"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    table = np.array([[float(x) for x in row.split(",")] for row in rows])
    corrected = table[:, [head.split(",").index(f"corrected_{a} [m/s^2]") for a in "xyz"]]
    assert np.std(np.linalg.norm(corrected, axis=1)) < 6e-3  # the noise; 0.03 with the current


@pytest.mark.parametrize(
    ("asked", "follows"),
    [
        pytest.param("channel_bias(motor current)", True, marks=pytest.mark.long),
        pytest.param("own.py(temp)", False, marks=pytest.mark.long),
    ],
)
def test_close_judges_the_effect_of_the_column_that_is_named(record, asked, follows):
    code, found = result("close", "norm-diagonal", "poses.csv", "--effects", asked)
    assert code == 0
    assert found["effects"][0]["name"] == "channel_bias"
    assert found["effects"][0]["column"] == "motor current"
    refused = {r["name"]: r["reason"] for r in found["refused"]}
    assert ("pull(temp)" in refused) is not follows
    assert "pull(motor current)" not in json.dumps(found)


@pytest.mark.long
def test_a_column_that_would_not_be_tried_is_tried_where_it_is_named(record):
    """Of a temperature the catalogue tries temperature_bias alone."""
    asked = ["--effects", "channel_bias(temp)"]
    _, found = result("close", "norm-diagonal", "poses.csv", *asked)
    refused = {r["name"]: r["reason"] for r in found["refused"]}
    assert "no more of it than noise like what is left" in refused["channel_bias(temp)"]


def spoiled(cell: str, column: int = 3):
    """The record with that cell in two rows of its column of currents."""
    with open("poses.csv", encoding="utf-8") as file:
        head, *rows = file.read().splitlines()
    for k in (7, 30):
        cells = rows[k].split(",")
        cells[column] = cell
        rows[k] = ",".join(cells)
    with open("spoiled.csv", "w", encoding="utf-8") as file:
        file.write("\n".join([head, *rows]) + "\n")


@pytest.mark.parametrize(
    ("command", "cell"),
    [
        ("calibrate", ""),
        ("calibrate", "nan"),
        pytest.param("close", "", marks=pytest.mark.long),
        pytest.param("close", "nan", marks=pytest.mark.long),
    ],
)
def test_a_row_without_the_followed_column_is_dropped_as_one_without_a_reading(
    record, command, cell
):
    spoiled(cell)
    asked = ["--effects", "channel_bias(Motor_Current)"]
    code, found = result(command, "norm-diagonal", "spoiled.csv", *asked)
    assert code == 0
    assert found["effects"][0]["name"] == "channel_bias"
    with open("out/residuals.csv", encoding="utf-8") as file:
        rows = {int(line["row"]) for line in csv.DictReader(file)}
    assert rows == {*range(80)} - {7, 30}
    said = "2 of 80 rows dropped: 2 without motor current, the first row 7"
    assert any(said in note for note in found["notes"])


@pytest.mark.parametrize(
    ("command", "cell"),
    [
        ("calibrate", "inf"),
        ("calibrate", "ERR"),
        pytest.param("close", "inf", marks=pytest.mark.long),
        pytest.param("close", "ERR", marks=pytest.mark.long),
    ],
)
def test_a_followed_column_that_holds_no_number_is_refused_as_a_reading_is(
    record, command, cell, capsys
):
    spoiled(cell)
    asked = ["--effects", "channel_bias(motor current)"]
    assert run([command, "norm-diagonal", "spoiled.csv", *G, *asked]) == 1
    said = f"column motor current row 7 holds '{cell}' (and 1 more such rows)"
    assert said in capsys.readouterr().err
    spoiled(cell, column=4)  # a column that nobody asked for is left out
    assert run([command, "norm-diagonal", "spoiled.csv", *G, *asked]) == 0


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("channel_bias(volts)", "poses.csv: no columns volts for signal volts"),
        ("quadratic(temp)", "--effects quadratic(temp): quadratic follows no column; leave (temp)"),
        ("temperature_bias", "needs the column it follows: --effects 'temperature_bias(COLUMN)'"),
        ("chanel_bias(temp)", "--effects chanel_bias: no shipped effect; did you mean"),
        ("two.py(temp)", "two.py declares pull, push: say which, as two.py:pull(temp)"),
    ],
)
def test_what_cannot_follow_a_column_is_said(record, asked, said, capsys):
    with open("own.py", encoding="utf-8") as file:
        own = file.read()
    with open("two.py", "w", encoding="utf-8") as file:
        file.write(own + own[own.index("@effect") :].replace("pull", "push"))
    assert run(["calibrate", "norm-diagonal", "poses.csv", *G, "--effects", asked]) == 1
    assert said in capsys.readouterr().err


def test_close_refuses_a_column_that_is_not_there_as_calibrate_does(record, capsys):
    words = ["close", "norm-diagonal", "poses.csv", *G, "--effects"]
    assert run([*words, "channel_bias(motor curent)"]) == 1
    assert "no column motor curent" in capsys.readouterr().err
