"""Tab in a real shell: commands, options, models, effects, files."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from casest.cli.completing import declared_names

BIN = Path(sys.executable).parent
ENVIRONMENT = {**os.environ, "PATH": f"{BIN}:{os.environ['PATH']}"}


@cache
def printed() -> str:
    """The script for bash, as a shell that starts reads it."""
    words = ["casest", "completion", "bash"]
    done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, check=True)
    return done.stdout


def bash(folder: Path, *words: str) -> list[str]:
    """What bash offers for the last of `words`, by the script that casest prints."""
    listed = " ".join(f"'{word}'" for word in words)
    script = (
        'eval "$SCRIPT"; '
        f"COMP_WORDS=({listed}); COMP_CWORD={len(words) - 1}; COMPREPLY=(); "
        "compopt() { echo files; }; "
        "complete -p casest > /dev/null && _casest_completion casest; "
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "-c", script],
        cwd=folder,
        env={**ENVIRONMENT, "SCRIPT": printed()},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return [line for line in done.stdout.splitlines() if line]


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["casest", "cal"], ["calibrate"]),
        (["casest", "close", "norm-t"], ["norm-triangular"]),
        (["casest", "filter", "bias-gravity-po"], ["bias-gravity-position"]),
        (["casest", "filter", "wheel"], ["files"]),
        (["casest", "observe", "bias-gravity-po"], ["bias-gravity-position"]),
        (["casest", "observe", "whe"], ["wheel", "wheel-motion"]),
        (["casest", "close", "bias-gravity-po"], ["bias-gravity-position"]),
        (["casest", "calibrate", "b"], ["files"]),
        (["casest", "calibrate", "mine"], ["files"]),
        (["casest", "calibrate", "wheel", "rec"], ["files"]),
        (["casest", "simulate", "wheel", "--effect", "imb"], ["imbalance"]),
        (["casest", "calibrate", "wheel", "x.csv", "--solver", "tr"], ["trust-region"]),
        (["casest", "calibrate", "wheel", "x.csv", "--colu"], ["--columns"]),
        (
            ["casest", "export", "out", "--to", ""],
            ["c", "python", "json", "ros", "kalibr", "ardupilot", "px4", "dcc"],
        ),
    ],
)
def test_bash_offers_what_may_come_next(words, offered, tmp_path):
    assert bash(tmp_path, *words) == offered


@pytest.mark.skipif(shutil.which("zsh") is None, reason="no zsh here")
def test_zsh_takes_the_script(tmp_path):
    script = (
        "autoload -U compinit && compinit -u -d ./dump; "
        'eval "$(casest completion zsh)"; print ${_comps[casest]}'
    )
    done = subprocess.run(
        ["zsh", "-f", "-c", script],
        cwd=tmp_path,
        env={**os.environ, "PATH": f"{BIN}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "_casest_completion"


@pytest.mark.parametrize(
    ("shell", "lines"),
    [("zsh", ["plain", "wheel", "_", "plain", "wheel-motion", "_"]), ("fish", None)],
)
def test_other_shells_are_given_the_same_names(shell, lines, tmp_path):
    """What zsh and fish ask: their variables as the scripts of `casest completion` set them."""
    words = {"zsh": ("casest calibrate whe", "2"), "fish": ("casest calibrate whe", "whe")}[shell]
    done = subprocess.run(
        [str(BIN / "casest")],
        env={
            **os.environ,
            "_CASEST_COMPLETE": f"{shell}_complete",
            "COMP_WORDS": words[0],
            "COMP_CWORD": words[1],
        },
        capture_output=True,
        text=True,
        check=True,
    )
    if lines:
        assert done.stdout.split() == lines
    else:
        assert "wheel" in done.stdout


def test_the_names_are_those_of_the_catalogue_and_the_problems():
    from casest.effects import CATALOGUE
    from casest.results.find import MOVING, SHIPPED
    from casest.solve.strategy import SOLVERS

    assert declared_names("effects/__init__.py", "CATALOGUE") == [e.name for e in CATALOGUE]
    assert declared_names("results/find.py", "SHIPPED") == list(SHIPPED)
    assert declared_names("results/find.py", "MOVING") == list(MOVING)
    assert declared_names("solve/strategy.py", "SOLVERS") == list(SOLVERS)


def test_tab_needs_neither_numpy_nor_casadi(tmp_path):
    code = (
        "import os, sys\n"
        "os.environ |= {'_CASEST_COMPLETE': 'bash_complete', 'COMP_CWORD': '2',"
        " 'COMP_WORDS': 'casest close wh'}\n"
        "from casest.cli import run\n"
        "try:\n"
        "    run([])\n"
        "except SystemExit:\n"
        "    pass\n"
        "print(sorted({'numpy', 'casadi'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["plain,wheel", "plain,wheel-motion", "[]"]
