"""No command writes its results over what it reads, nor suggests to."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest

from casest.cli import run
from casest.report.next_command import following


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A record, a result of it in `out`, and corrected readings there."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(2)
    v = rng.standard_normal((40, 3))
    v = 9.8 * v / np.linalg.norm(v, axis=1, keepdims=True) * [1.01, 0.99, 1.0]
    v += 0.01 * rng.standard_normal((40, 3))
    head = "vx [m/s^2],vy [m/s^2],vz [m/s^2]"
    np.savetxt("v.csv", v, delimiter=",", header=head, comments="")
    assert run(["calibrate", "norm-diagonal", "v.csv", "--set", "norm=9.8", "-o", "out"]) == 0
    assert run(["export", "out", "--to", "json", "-o", "out/c.json"]) == 0
    shutil.copy("v.csv", "out/residuals.csv")
    shutil.copy("v.csv", "out/corrected.csv")
    os.symlink("out/result.json", "link.json")
    os.symlink("v.csv", "linked.csv")
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [
        "apply out v.csv -o v.csv",
        "apply out v.csv --output=./v.csv",
        "apply out v.csv -ov.csv",
        "apply out linked.csv -o v.csv",
        "apply out out/corrected.csv -o out",
        "apply out/c.json v.csv -o out/../v.csv",
        "export out --to json -o out/result.json",
        "export link.json --to json -o out/result.json",
        "export out --to c -o v.csv",
        "export link.json --to python -o ./v.csv",
        "export out --to c --output out/result.json",
        "calibrate norm-diagonal v.csv --fix scale=@out/result.json -o out",
        "calibrate norm-diagonal v.csv --fix scale=@out -o out",
        "close norm-diagonal v.csv --fix scale=@out/result.json -o out",
        "calibrate norm-diagonal out/residuals.csv -o out",
        "calibrate norm-diagonal v.csv --holdout out/residuals.csv -o out",
        "close norm-diagonal v.csv --effects out/formula.py:formula -o out",
        "compare norm-diagonal out/compare.json -o out",
        "filter bias-gravity out/states.csv -o out",
        "filter bias-gravity v.csv --rest out/states.csv -o out",
        "simulate norm-diagonal --input simulated/record.csv",
    ],
)
def test_what_is_read_is_not_written_over(folder, capsys, words):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    capsys.readouterr()
    assert run(words.split()) == 1
    said = capsys.readouterr().err
    assert "is read, and would be written over; give another -o" in said
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "words",
    [
        "apply out v.csv -o out",
        "apply out v.csv -o linked.csv",  # the link is replaced, the record stays
        "export out --to c -o out/correction.c",
        "calibrate norm-diagonal v.csv --set norm=9.8 --fix scale=@out/result.json -o other",
        "calibrate norm-diagonal out/corrected.csv --set norm=9.8 -o out",
        "calibrate norm-diagonal v.csv --set norm=9.8 -o out",
        "calibrate norm-diagonal v.csv --set norm=9.8 -o norm-diagonal",
    ],
)
def test_what_is_not_read_may_be_written_over(folder, words):
    record = (folder / "v.csv").read_bytes()
    assert run(words.split()) == 0
    assert (folder / "v.csv").read_bytes() == record


@pytest.mark.parametrize(
    ("command", "output", "suggested"),
    [
        ("casest calibrate m v.csv --fix scale=@out/result.json", None, "-o out-2"),
        ("casest calibrate m v.csv --fix scale=@out/result.json", "fit", "-o fit/corrected.csv"),
        ("casest calibrate m v.csv --fix scale=@fit/closed -o fit", "fit", "-o fit/closed-2"),
        ("casest calibrate m fit/corrected.csv -o fit", "fit", "-o fit/corrected-2.csv"),
        ("casest calibrate m v.csv", None, "-o out"),
    ],
)
def test_the_next_command_writes_over_nothing_it_reads(folder, command, output, suggested):
    lines = following(command, output).replace("\\\n", " ").splitlines()
    assert any(line.endswith(suggested) for line in lines)


def test_what_is_suggested_after_a_fit_runs(folder, capsys):
    words = "calibrate norm-diagonal v.csv --set norm=9.8 --fix scale=@out/result.json"
    capsys.readouterr()
    assert run(words.split()) == 0
    said = capsys.readouterr().out.replace("\\\n", " ")
    nexts = [line.split()[1:] for line in said.splitlines() if line.startswith("  casest ")]
    assert nexts
    for typed in nexts:
        assert run(typed) == 0


def test_a_file_in_the_place_of_the_folder_of_corrected_readings(folder, capsys):
    assert run(["apply", "out", "v.csv", "-o", "link.json"]) == 1
    assert "link.json: cannot be made" in capsys.readouterr().err
