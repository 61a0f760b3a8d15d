"""Every command and every file in the README works as it stands there."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def readme():
    return (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory, readme):
    """A folder with the shipped record and the files that the README shows."""
    folder = tmp_path_factory.mktemp("reader")
    shutil.copytree(ROOT / "casest" / "demo", folder / "casest" / "demo")
    for language, text in BLOCK.findall(readme):
        first, _, rest = text.partition("\n")
        if language in ("python", "csv") and first.startswith("# "):
            (folder / first[2:]).write_text(rest, encoding="utf-8")
    return folder


def run(command, folder):
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    # The folder holds only the demo of casest: the installed package must win over it.
    return subprocess.run(
        command,
        shell=True,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_every_command_of_the_readme_succeeds(readme, folder):
    commands = [
        line
        for language, text in BLOCK.findall(readme)
        if language == "sh"
        for line in text.splitlines()
    ]
    assert len(commands) >= 7
    for command in commands:
        done = run(command, folder)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        assert done.stderr == "", command


def test_the_python_of_the_readme_prints_an_offset_with_its_uncertainty(folder):
    done = run(f"{sys.executable} -P fit.py", folder)
    assert done.returncode == 0, done.stderr
    assert "±" in done.stdout.splitlines()[-1]


def test_the_table_in_the_readme_is_what_the_command_prints(readme, folder):
    printed = run(
        "casest calibrate norm-triangular casest/demo/handheld.csv --columns v=ax,ay,az --rate 50 "
        '--at-rest --set "norm=9.80665 m/s^2"',
        folder,
    ).stdout.splitlines()
    shown = next(t for language, t in BLOCK.findall(readme) if language == "text").splitlines()
    for line in shown:
        digits = "stationary" not in line  # rounding differs from machine to machine
        if line.strip() and line.strip() != "..." and digits:
            assert line in printed


def test_make_targets_of_the_readme_exist(readme):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    named = re.findall(r"^make (\w+)", readme, re.MULTILINE)
    assert named == ["demo", "test"]
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in named)
