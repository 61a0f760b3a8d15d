"""Studies and benchmarks run for hours, so nobody runs them daily: they must at least load."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROGRAMS = sorted([*ROOT.glob("studies/*.py"), *ROOT.glob("benchmarks/*.py")])
HELPERS = {
    *("loop_table", "mutants", "resumed", "by_hand", "fused"),
    *("record_files", "record_models", "record_rows"),
}


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_every_name_that_a_study_needs_is_there(path, monkeypatch):
    monkeypatch.setattr(sys, "path", [str(path.parent), str(ROOT), *sys.path])
    name = f"loaded_{path.parent.name}_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    assert path.stem in HELPERS or callable(module.main)


def test_every_mistake_of_the_mutation_study_is_in_the_code_once(monkeypatch):
    """The list follows the code: what moves must be moved there too."""
    monkeypatch.setattr(sys, "path", [str(ROOT / "studies"), *sys.path])
    mutants = importlib.import_module("mutants")
    for m in mutants.MUTANTS:
        text = (ROOT / "casest" / m.path).read_text(encoding="utf-8")
        assert (m.path, m.old, text.count(m.old)) == (m.path, m.old, 1)
        assert all((ROOT / "tests" / name).exists() for name in m.tests)
    assert len({m.name for m in mutants.MUTANTS}) == len(mutants.MUTANTS)
