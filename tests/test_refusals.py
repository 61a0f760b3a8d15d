"""Every refusal has a page that says what it means, and names it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from casest import attempt
from casest.cli import run
from casest.demo import RECORD
from casest.estimate.reasons import Code

PAGE = Path(__file__).parents[1] / "docs" / "refusals.md"


def headings():
    return re.findall(r"^## (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)


def test_every_kind_of_refusal_is_explained_and_nothing_else():
    assert sorted(headings()) == sorted(c.name.lower().replace("_", "-") for c in Code)


def test_a_refusal_that_is_printed_names_its_heading(capsys):
    words = ["--columns", "v=a", "--rate", "50", "--at-rest", "--set", "norm=9.80665 m/s^2"]
    assert run(["calibrate", "norm-full", str(RECORD), *words]) == 2
    printed = capsys.readouterr().out
    named = re.findall(r"docs/refusals\.md#([\w-]+)", printed)
    assert named == ["not-determined"]


def test_the_report_of_a_refusal_says_what_it_means():
    poses = np.vstack([np.eye(3), -np.eye(3)]) * 9.81 + [0.1, 0.2, 0.3]
    page = attempt("norm-diagonal", poses, columns={"v": "0,1,2"}).page()
    assert "Six means of six positions are such a record. Give more poses, the raw record" in page
    assert "docs/refusals.md#no-redundancy" in page


def test_a_trusted_estimate_names_none(capsys):
    words = ["--columns", "v=a", "--rate", "50", "--at-rest", "--set", "norm=9.80665 m/s^2"]
    assert run(["calibrate", "norm-triangular", str(RECORD), *words]) == 0
    assert "refusals.md" not in capsys.readouterr().out


@pytest.mark.parametrize("count", [6])
def test_six_means_of_six_positions_are_told_what_is_missing(count):
    poses = np.vstack([np.eye(3), -np.eye(3)])[:count] * 9.81 + [0.1, 0.2, 0.3]
    found = attempt("norm-diagonal", poses, columns={"v": "0,1,2"})
    assert "docs/refusals.md#no-redundancy" in str(found)
