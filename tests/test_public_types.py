"""What a stranger's type checker sees of the package: mypy over files that import it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import casest

ROOT = Path(__file__).parents[1]

USER = """\
from casest import Estimate, calibrate, effect, model
import casest

reveal_type(calibrate)
reveal_type(model)
reveal_type(effect(on="output"))
def of(found: Estimate) -> None: reveal_type(found.values)
reveal_type(casest.load_runs)
def array(found: Estimate) -> None: reveal_type(found(found.values["offset"]))
casest.modle
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory) -> list[str]:
    """Lines of mypy on the file above, one of all names, and the files of the README."""
    folder = tmp_path_factory.mktemp("stranger")
    (folder / "casest").symlink_to(ROOT / "casest")
    (folder / "casest_problems").symlink_to(ROOT / "problems")
    names = [n for n in casest.__all__ if n != "__version__"]
    every = "".join(f"reveal_type(casest.{n})\n" for n in names)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    files = dict(re.findall(r"```python\n# (\w+\.py)\n(.*?)```", readme, re.S))
    assert {"loadcell.py", "fit.py"} <= set(files)
    files |= {"user.py": USER, "every.py": "import casest\n" + every}
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    words = ["--follow-imports=silent", "--config-file=", "--cache-dir", str(folder / "cache")]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words, *files],
        cwd=folder,
        env={**os.environ, "MYPYPATH": str(folder)},
        capture_output=True,
        text=True,
    )
    return [line for line in done.stdout.splitlines() if not line.startswith("Found ")]


def of(said: list[str], file: str) -> list[str]:
    """What it says of a file, the hints (`see …`) left out."""
    own = [line.partition(": ")[2] for line in said if line.startswith(f"{file}:")]
    return [line for line in own if "Revealed" in line or line.startswith("error")]


@pytest.mark.long
def test_a_type_checker_sees_what_public_names_are(said):
    fit, declare, effects, values, load, array, wrong = of(said, "user.py")
    assert "model: casest.declaration.model.Model" in fit
    assert fit.endswith('-> casest.interface.estimate.Estimate"')
    assert declare.endswith('-> casest.declaration.model.Model"')
    assert effects.endswith('-> casest.declaration.effect.Effect"')
    assert "Mapping[str, numpy.ndarray" in values
    assert "casest.data.run.Run" in load
    assert "numpy.ndarray" in array  # what a call with an array returns
    assert wrong.startswith('error: Module has no attribute "modle"')


@pytest.mark.long
def test_no_public_name_is_any_for_a_type_checker(said):
    revealed = of(said, "every.py")
    assert len(revealed) == len(casest.__all__) - 1
    assert [line for line in revealed if 'Revealed type is "Any"' in line] == []


@pytest.mark.long
def test_a_type_checker_has_nothing_against_the_files_of_the_readme(said):
    assert [line for line in said if not line.startswith(("user.py:", "every.py:"))] == []


def test_without_its_source_the_package_says_what_to_install(monkeypatch):
    monkeypatch.setattr(casest, "_HOMES", {})
    monkeypatch.setattr(casest.__spec__, "loader", None)
    with pytest.raises(ImportError, match=r"without its source, .* install casest with its \.py"):
        _ = casest.model


def test_names_are_listed_as_they_are_imported():
    assert dir(casest) == sorted(casest.__all__)
    assert casest.model.__module__ == "casest.declaration.model"
