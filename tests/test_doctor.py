"""`casest doctor` says what is there, what is not, and how to get it."""

from __future__ import annotations

import json
import platform

import numpy as np
import pytest

from casest.cli import health, run


def findings(capsys):
    code = run(["doctor", "--json"])
    return code, {f["name"]: f for f in json.loads(capsys.readouterr().out)["findings"]}


def test_versions_are_those_of_this_process_and_the_fit_meets_the_truth(capsys):
    code, found = findings(capsys)
    assert code == 0
    assert found["numpy"]["found"] == np.__version__
    assert found["python"]["found"].startswith(platform.python_version())
    assert "standard deviations from the truth" in found["handheld.csv"]["found"]
    assert found["handheld.csv"]["ok"]


def test_without_a_compiler_it_says_what_that_costs_and_what_to_do(capsys, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    code, found = findings(capsys)
    assert code == 0
    assert "computed by NumPy" in found["compiler"]["found"]
    assert found["compiler"]["do"] == "install gcc or clang"


def test_a_cache_that_others_can_write_is_not_used_and_named(capsys, monkeypatch, tmp_path):
    shared = tmp_path / "open"
    shared.mkdir()
    shared.chmod(0o777)
    monkeypatch.setenv("CASEST_CACHE", str(shared))
    _, found = findings(capsys)
    assert "no safe folder" in found["cache"]["found"]
    assert "CASEST_CACHE" in found["cache"]["do"]


@pytest.mark.parametrize(("there", "said"), [(False, "pip install 'casest[ros]'"), (True, "")])
def test_a_reader_that_is_missing_comes_with_its_installation(there, said, capsys, monkeypatch):
    find = health.find_spec
    monkeypatch.setattr(health, "find_spec", lambda n: find(n) if there or n != "rosbags" else None)
    _, found = findings(capsys)
    assert found["rosbags"]["do"] == said


def test_a_wrong_answer_is_an_error_that_is_seen(capsys, monkeypatch):
    monkeypatch.setattr("casest.demo.furthest", lambda values, std: 40.0)
    assert run(["doctor"]) == 1
    text = capsys.readouterr().out
    assert "! handheld.csv" in text
    assert text.endswith("What is marked ! is wrong.\n")
