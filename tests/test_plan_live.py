"""`casest plan --live`: a growing file and a pipe are followed until the goal is reached."""

from __future__ import annotations

import io
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from casest.cli import run
from casest.plan import live
from casest.plan.candidates.attitudes import directions

POSES = ["plan", "norm-diagonal", "--set", "norm=9.81", "--unit", "v=m/s^2"]
POSES += ["--sensor-noise", "v=0.01", "--step", "45"]
GOAL = ["--until", "offset<0.004 m/s^2"]


def lines(count, seed=0):
    """Readings of poses, a header first."""
    rng = np.random.default_rng(seed)
    up = directions(45)
    v = (
        9.81 * up[rng.choice(len(up), count)]
        + [0.3, -0.2, 0.1]
        + 0.01 * rng.standard_normal((count, 3))
    )
    return ["vx,vy,vz\n", *(f"{x:.5f},{y:.5f},{z:.5f}\n" for x, y, z in v)]


@pytest.fixture(autouse=True)
def quickly(monkeypatch):
    monkeypatch.setattr(live, "LOOK", 0.02)


def test_a_growing_file_is_followed_until_the_goal(tmp_path, capsys):
    path, rows = tmp_path / "now.csv", lines(40)
    path.write_text("".join(rows[:3]))

    def measuring():
        for row in rows[3:]:
            time.sleep(0.03)
            with path.open("a") as file:
                file.write(row)

    person = threading.Thread(target=measuring)
    person.start()
    assert run([*POSES, *GOAL, "--live", str(path), "--idle", "5"]) == 0
    person.join()
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("0 poses; offset undetermined")
    assert "of 6 unknowns determined; next: " in said[0]
    assert said[-1] == "reached: stop here"
    taken = int(said[-2].split()[0])
    assert 8 <= taken <= 40
    assert "next:" not in said[-2]


def test_a_pipe_that_ends_is_said(tmp_path):
    words = [sys.executable, "-c", "from casest.cli import main; main()", *POSES, "--live", "-"]
    done = subprocess.run(
        words, input="".join(lines(12)), capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.splitlines()[-1] == "nothing more came; 12 poses were taken"
    assert "(std ×0." in done.stdout


def test_standard_input_without_a_file_behind_it_is_read_at_once(monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", io.StringIO("".join(lines(20))))
    assert run([*POSES, *GOAL, "--live", "-"]) == 0
    assert "20 poses; offset 0.00" in capsys.readouterr().out


def test_a_source_that_is_not_there_is_one_sentence(tmp_path, capsys):
    assert run([*POSES, "--live", str(tmp_path / "no.csv")]) == 1
    assert "cannot be read" in capsys.readouterr().err
    assert run([*POSES, "--live", "-", "--count", "3"]) == 1
    assert "leave --count" in capsys.readouterr().err


def test_a_port_needs_the_library_or_says_that_it_cannot_be_opened(capsys):
    assert run([*POSES, "--live", "/dev/ttyNOPE9"]) == 1
    said = capsys.readouterr().err
    assert "casest[live]" in said or "cannot be opened" in said


def test_what_is_no_table_is_one_sentence(tmp_path, capsys):
    path = tmp_path / "bad.csv"
    path.write_text("a,b\n1,2\n3,4\n5,6\n")
    assert run([*POSES, "--live", str(path), "--idle", "0.1"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "--live" in said
