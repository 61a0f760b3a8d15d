"""Every example runs as it stands, and is short."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("[0-9]*.py"))
LONG = {
    "02_was_the_motion_enough", "05_gyro_bias_and_temperature", "08_find_the_missing_effect",
    "10_compare_solvers", "12_compass_with_attitude",
}  # fmt: skip


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, id=p.stem, marks=[pytest.mark.long] * (p.stem in LONG)) for p in EXAMPLES],
)
def test_example_runs_and_its_own_assertions_hold(path, tmp_path, monkeypatch, capsys):
    """As `python PATH` runs it, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(path)])
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out
    assert "assert " in path.read_text(encoding="utf-8")


def test_an_example_is_a_program_of_its_own(tmp_path):
    done = subprocess.run(
        [sys.executable, str(EXAMPLES[0])],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout
