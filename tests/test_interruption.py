"""Ctrl-C at any moment: exit code 130, and not a file; or it came too late, and all is there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest

import casest
from casest import Residual, Run, model, param
from casest.cli import run
from casest.comparison.judge import SOLVERS, compare
from casest.data import write_atomically, written_together
from casest.data.write import make_folder
from casest.demo import RECORD, WHEEL
from casest.interruption import held_back, waits
from casest.solve.ipopt import ipopt
from casest.solve.others import sqpmethod

HANDHELD = [str(RECORD), "--columns", "v=ax,ay,az", "--rate", "50", "--at-rest"]
NORM = ["--set", "norm=9.80665 m/s^2"]
SAID = "casest: interrupted; nothing was written"
#: The command line as the script calls it, which says when signals can be sent.
PROGRAM = "import sys; from casest.cli import main; print('ready', flush=True); main()"
COMMANDS = {
    "calibrate poses": (["calibrate", "norm-diagonal", *HANDHELD, *NORM], 2),
    "calibrate": (["calibrate", "wheel", str(WHEEL)], 6),
    "close": (["close", "wheel", str(WHEEL)], 4),
    "compare": (["compare", "norm-triangular", *HANDHELD, *NORM, "--starts", "2"], 2),
}


def started(*words: str) -> subprocess.Popen[str]:
    """The command line in a process of its own, which gets Ctrl-C although a shell may not."""
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def interrupted(words: list[str], after: float) -> tuple[int, str]:
    """Exit code and standard error of a command that gets Ctrl-C after so many seconds."""
    with started(*words) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(after)
        process.send_signal(signal.SIGINT)
        _, words_of_it = process.communicate(timeout=60)
    return process.returncode, words_of_it


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.long] * (n != "calibrate poses")) for n in COMMANDS],
)
def test_ctrl_c_at_any_moment_ends_with_130_and_no_file(name, tmp_path):
    words, moments = COMMANDS[name]
    began = time.perf_counter()
    with started(*words, "-o", str(tmp_path / "whole")) as process:
        process.communicate(timeout=120)
    whole, length = sorted(os.listdir(tmp_path / "whole")), time.perf_counter() - began
    codes = []
    for k, share in enumerate(np.linspace(0.02, 0.9, moments)):
        folder = tmp_path / str(k)
        code, said = interrupted([*words, "-o", str(folder)], share * length)
        codes.append(code)
        files = sorted(os.listdir(folder)) if folder.exists() else []
        assert (code, files) in ((130, []), (0, whole)), said
        assert code == 0 or said.strip() == SAID
    assert codes.count(130) >= moments // 2


def test_a_second_ctrl_c_ends_at_once_within_the_code_of_another_library(tmp_path):
    """A model whose import never ends, and that catches every KeyboardInterrupt."""
    path = tmp_path / "stubborn.py"
    path.write_text(
        "import sys, time\n"
        "while True:\n"
        "    try:\n"
        "        print('waiting', file=sys.stderr, flush=True)\n"
        "        time.sleep(60)\n"
        "    except KeyboardInterrupt:\n"
        "        pass\n"
    )
    with started("calibrate", str(path), str(WHEEL)) as process:
        assert process.stderr is not None
        for _ in range(2):
            assert process.stderr.readline() == "waiting\n"
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == -signal.SIGINT


def test_a_ctrl_c_that_a_model_swallows_still_writes_nothing(tmp_path):
    path = tmp_path / "swallows.py"
    path.write_text(
        "import os, signal as signals\n"
        "from casest import *\n"
        "try:\n"
        "    os.kill(os.getpid(), signals.SIGINT)\n"
        "except BaseException:\n"
        "    pass\n"
        "@model\n"
        "def line(x=signal('m'), y=signal('m'), *, a=param('1')):\n"
        "    '''A line.'''\n"
        "    return Residual(measured=y, predicted=a * x)\n"
    )
    (tmp_path / "d.csv").write_text("x [m],y [m]\n1,2\n2,4.1\n3,6\n4,8.1\n")
    with started("calibrate", str(path), str(tmp_path / "d.csv"), "-o", str(tmp_path / "o")) as p:
        _, said = p.communicate(timeout=60)
    assert (p.returncode, said.strip()) == (130, SAID)
    assert not list((tmp_path / "o").glob("*"))


def test_a_ctrl_c_that_python_itself_drops_is_repeated(tmp_path):
    """Where a weak reference dies Python prints an exception and goes on: here for a minute."""
    path = tmp_path / "dropped.py"
    path.write_text(
        "import os, signal as signals, time, weakref\n"
        "class Thing: pass\n"
        "thing = Thing()\n"
        "kept = weakref.ref(thing, lambda _: os.kill(os.getpid(), signals.SIGINT))\n"
        "del thing\n"
        "time.sleep(60)\n"
    )
    with started("calibrate", str(path), str(WHEEL), "-o", str(tmp_path / "o")) as process:
        _, said = process.communicate(timeout=30)
    assert (process.returncode, said.strip()) == (130, SAID)


# -- from Python -----------------------------------------------------------------------------------


@model
def wave(t=casest.signal(), y=casest.signal(), *, rate=param(start=2.02)):
    """A sine of unknown rate."""
    return Residual(measured=y, predicted=casest.sin(rate * t))


def wave_run():
    t = np.linspace(0, 20, 200)
    y = np.sin(2 * t) + 0.05 * np.random.default_rng(0).standard_normal(200)
    return Run.raw("r", {"t": t[:, None], "y": y[:, None]}, units={})


def pressed() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("solve", [ipopt, partial(ipopt, exact=True), sqpmethod])
def test_ctrl_c_within_a_callback_of_casadi_is_raised_by_the_solver(solve, monkeypatch):
    """CasADi prints and drops what a callback raises: here every one of them gets Ctrl-C."""
    problem = casest.calibrate(wave, [wave_run()]).problem
    start, seen = problem.start(), []
    normal = type(problem).normal

    def pressing(self, point):
        if len(seen) == 3:
            pressed()
        seen.append(point)
        return normal(self, point)

    monkeypatch.setattr(type(problem), "normal", pressing)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        solve(problem, start)
    assert len(seen) < 50
    assert not waits()
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("name", ["ipopt", "ipopt-exact", "sqpmethod", "trust-region", "scipy-lm"])
def test_ctrl_c_ends_a_comparison_in_every_solver(name, monkeypatch):
    solve, seen = SOLVERS[name], []

    def pressing(problem, start):
        seen.append(start)
        if len(seen) == 5:
            pressed()
        return solve(problem, start)

    monkeypatch.setitem(SOLVERS, name, pressing)
    with pytest.raises(KeyboardInterrupt):
        compare(wave, [wave_run()], starts=4, sizes=(1e-3,), solvers=[name])
    assert len(seen) == 5


def test_held_back_it_takes_effect_at_the_end_and_a_second_one_at_once():
    reached = []

    def twice() -> None:
        with held_back():
            pressed()
            reached.append(waits())
            with pytest.raises(KeyboardInterrupt):
                pressed()
            reached.append(waits())

    with pytest.raises(KeyboardInterrupt):
        twice()
    assert reached == [True, True]
    assert not waits()


@written_together()
def two_texts_and_bytes(folder, wrong=False):
    write_atomically(folder / "a.txt", "one")
    write_atomically(folder / "a.txt", "two")
    write_atomically(folder / "b.bin", b"\x00\r\n")
    assert not list(folder.glob("[ab]*"))
    if wrong:
        raise KeyboardInterrupt


def test_files_written_together_appear_at_the_end_or_not_at_all(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        two_texts_and_bytes(tmp_path, wrong=True)
    assert os.listdir(tmp_path) == []
    two_texts_and_bytes(tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["a.txt", "b.bin"]
    assert (tmp_path / "a.txt").read_text() == "two"
    assert (tmp_path / "b.bin").read_bytes() == b"\x00\r\n"


def test_a_folder_that_was_made_for_files_that_never_came_is_removed(tmp_path):
    (tmp_path / "there").mkdir()

    @written_together()
    def into(folder, wrong):
        make_folder(folder)
        two_texts_and_bytes.__wrapped__(folder, wrong)

    for folder in (tmp_path / "out" / "deep", tmp_path / "there" / "new", tmp_path / "there"):
        with pytest.raises(KeyboardInterrupt):
            into(folder, wrong=True)
    assert [p.name for p in tmp_path.rglob("*")] == ["there"]  # an empty one of the user's stays
    into(tmp_path / "out" / "deep", wrong=False)
    assert sorted(os.listdir(tmp_path / "out" / "deep")) == ["a.txt", "b.bin"]


def test_ctrl_c_while_files_get_their_names_waits_until_all_have_them(tmp_path, monkeypatch):
    replace = os.replace

    def pressing(old, new):
        if str(new).endswith("b.bin"):
            pressed()
        replace(old, new)

    monkeypatch.setattr(os, "replace", pressing)
    with pytest.raises(KeyboardInterrupt):
        two_texts_and_bytes(tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["a.txt", "b.bin"]


def test_what_python_makes_of_ctrl_c_is_ctrl_c(monkeypatch, capsys):
    """In a class that is being made, Python 3.11 raises a RuntimeError from it."""

    def pressed(*_, **__):
        raise RuntimeError("Error calling __set_name__") from KeyboardInterrupt()

    monkeypatch.setattr("casest.cli.commands.main", pressed)
    assert run(["list"]) == 130
    assert "interrupted; nothing was written" in capsys.readouterr().err
