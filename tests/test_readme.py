"""Every command and every file in the README works as it stands there."""

from __future__ import annotations

import re
import sys

import pytest
from pages import ROOT, first_apart, folder_of_a_reader, follow, run

README = ROOT / "README.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return folder_of_a_reader(README, tmp_path_factory.mktemp("reader"))


@pytest.mark.long
def test_every_command_of_the_readme_does_what_it_shows(folder):
    assert follow(README, folder, first_apart()) >= 7


def test_the_python_of_the_readme_prints_an_offset_with_its_uncertainty(folder):
    done = run(f"{sys.executable} -P fit.py", folder)
    assert done.returncode == 0, done.stderr
    assert "±" in done.stdout.splitlines()[-1]


def test_make_targets_of_the_readme_exist():
    readme = README.read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    named = re.findall(r"^make (\w+)", readme, re.MULTILINE)
    assert named == ["demo", "test"]
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in named)
