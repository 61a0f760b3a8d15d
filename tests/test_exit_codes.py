"""Whatever a command meets: one line, the exit code of the contract, and no half-written file."""

from __future__ import annotations

import builtins
import errno
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from casest.cli import fitting, run
from casest.demo import RECORD, WHEEL

resource = pytest.importorskip("resource", reason="there are no limits to set")

POSES = ["norm-diagonal", str(RECORD), "--columns", "v=ax,ay,az", "--rate", "50", "--at-rest"]
POSES += ["--set", "norm=9.80665"]
LINE = (
    "import sys\n"
    "from casest import *\n"
    "@model\n"
    "def line(x=signal('m'), y=signal('m'), *, a=param('1')):\n"
    "    '''A line.'''\n"
)
RETURNED = "    return Residual(measured=y, predicted=a * x)\n"
PROGRAM = [sys.executable, "-c", "from casest.cli import main; main()"]


@pytest.fixture
def line(tmp_path, capsys, monkeypatch):
    """Calibrate a model file on four points; exit code, standard output and error."""
    monkeypatch.chdir(tmp_path)
    Path("d.csv").write_text("x [m],y [m]\n1,2\n2,4.1\n3,6\n4,8.1\n")

    def call(text: str | bytes | None, *more: str) -> tuple[int, str, str]:
        if text is not None:
            Path("m.py").write_bytes(text if isinstance(text, bytes) else text.encode())
        code = run(["calibrate", "m.py", "d.csv", "-o", "out", *more])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return call


def ended(*words: str, **how: object) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    return subprocess.run(
        [*PROGRAM, *words], text=True, timeout=60, check=False, **{"stderr": subprocess.PIPE, **how}
    )


def written(folder: Path) -> list[Path]:
    return list(folder.rglob("*")) if folder.exists() else []


# -- a model's file --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import sys\nsys.exit(0)\n", "m.py, line 2, 'sys.exit(0)': SystemExit: 0"),
        (LINE + "    sys.exit(0)\n", "line 6: it ends the program (SystemExit: 0)"),
        ("def f():\n    f()\nf()\n", "m.py, line 2, 'f()': RecursionError: maximum recursion"),
        (LINE + "    return f(x)\n\n\ndef f(x):\n    return f(x)\n", "line 6: maximum recursion"),
        (
            LINE + f"    return Residual(measured=y, predicted={' + '.join(['a * x'] * 3000)})\n",
            "m.py: an expression is too long for Python; build it up in several lines or a loop",
        ),
        ("hello text\n", "m.py, line 1: invalid syntax: 'hello text'"),
        (b"\x00\x01\xff", "m.py: source code string cannot contain null bytes"),
        ("", "m.py declares no @model"),
    ],
    ids=["exit", "body-exit", "recursion", "body-recursion", "terms", "text", "binary", "empty"],
)
def test_a_model_that_cannot_be_run_is_one_line(line, text, said):
    code, out, err = line(text)
    assert (code, out) == (1, "")
    assert said in err
    assert err.count("\n") == 1
    assert not Path("out").exists()


def test_a_starter_that_ends_the_program_is_bad_input(line):
    begin = "def begin(model, runs):\n    sys.exit(0)\nline = line.starting(begin)\n"
    code, out, err = line(LINE + RETURNED + begin)
    assert (code, out) == (1, "")
    assert err == "casest: the model's code ends the program (SystemExit: 0); let it return\n"


def test_a_keyboard_interrupt_of_a_model_is_one(line):
    code, _, err = line("raise KeyboardInterrupt\n")
    assert (code, err.strip()) == (130, "casest: interrupted; nothing was written")


@pytest.mark.long
def test_a_sum_of_3000_terms_is_fitted(line):
    loop = "    t = 0 * x\n    for k in range(3000):\n        t = t + a * x / 3000\n"
    code, _, _ = line(LINE + loop + "    return Residual(measured=y, predicted=t)\n")
    assert code == 0


def test_what_a_model_prints_does_not_reach_standard_output(line):
    loud = LINE.replace("import sys\n", "import sys\nprint('hello')\n") + "    print('body')\n"
    code, out, err = line(loud + RETURNED, "--json")
    assert code == 0
    assert json.loads(out)["trusted"] is True
    assert "hello\n" in err
    assert "body\n" in err


def test_a_folder_as_a_model_or_as_data_is_named(line):
    Path("m.py").mkdir()
    assert line(None) == (1, "", "casest: m.py: is a folder; give the .py file in it\n")
    Path("m.py").rmdir()
    Path("d.csv").unlink()
    Path("d.csv").mkdir()
    code, _, err = line(LINE + RETURNED)
    assert code == 1
    assert err == "casest: d.csv: is a folder; name the files in it, for example d.csv/*.csv\n"


@pytest.mark.parametrize("name", ["m.py", "d.csv"])
def test_a_file_that_may_not_be_read_is_named(line, name, monkeypatch):
    Path("m.py").write_text(LINE + RETURNED)
    opened = io.open

    def forbidden(file, *args, **kwargs):
        if str(file).endswith(name):
            raise PermissionError(errno.EACCES, "Permission denied", str(file))
        return opened(file, *args, **kwargs)

    monkeypatch.setattr(io, "open", forbidden)
    monkeypatch.setattr(builtins, "open", forbidden)
    code, out, err = line(None)
    assert (code, out) == (1, "")
    assert name in err
    assert "ermission denied" in err
    assert "internal" not in err


# -- casest's own error ----------------------------------------------------------------------------


def test_an_internal_error_is_exit_code_3_says_where_to_and_leaves_nothing(
    tmp_path, capsys, monkeypatch
):
    """The text is made after the files: they must not be there all the same."""
    from casest.report.text import calibration

    def broken(*_):
        raise KeyError("nothing\nof that name")

    monkeypatch.setattr(calibration, "calibration_text", broken)
    words = ["calibrate", *POSES, "-o", str(tmp_path / "out")]
    assert run(words) == 3
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == (
        "casest: internal error (KeyError: 'nothing\\nof that name'), nothing was written; please "
        "report it with the command and `casest --version`; CASEST_TRACEBACK=1 shows where\n"
    )
    assert not written(tmp_path / "out")
    monkeypatch.setenv("CASEST_TRACEBACK", "1")
    assert run(words) == 3
    assert "test_exit_codes.py" in capsys.readouterr().err


def test_an_end_of_file_within_is_no_ctrl_c(capsys, monkeypatch):
    """As of a compiled module that was cut: click would call it an abort."""

    def cut(*_):
        raise EOFError("marshal data too short")

    monkeypatch.setattr(fitting, "model_and_records", cut)
    assert run(["calibrate", *POSES]) == 3
    assert "internal error (EOFError: marshal data too short)" in capsys.readouterr().err


def test_too_little_memory_for_the_data_is_said(capsys, monkeypatch):
    def little(*_):
        raise MemoryError("Unable to allocate 14.7 MiB")

    monkeypatch.setattr(fitting, "model_and_records", little)
    assert run(["calibrate", *POSES]) == 1
    assert capsys.readouterr().err == (
        "casest: out of memory (Unable to allocate 14.7 MiB); give a shorter record\n"
    )


# -- where it runs ---------------------------------------------------------------------------------


def test_a_limit_on_memory_is_said_instead_of_waited_for(tmp_path):
    def limited():
        resource.setrlimit(resource.RLIMIT_AS, (400_000_000, 400_000_000))

    done = ended("calibrate", "wheel", str(WHEEL), preexec_fn=limited)
    assert done.returncode == 1
    assert done.stderr == (
        "casest: less than 1 GB of address space are free, and linear algebra would wait for more "
        "without end; raise the limit (ulimit -v)\n"
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_standard_output_is_said_and_nothing_is_written(tmp_path):
    with open("/dev/full", "w") as full:
        done = ended("calibrate", *POSES, "-o", str(tmp_path / "out"), stdout=full)
    assert done.returncode == 1
    assert done.stderr == ("casest: standard output cannot be written (No space left on device)\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize(
    ("words", "output"),
    [
        (["simulate", "norm-diagonal", "--directions", "9"], "simulated"),
        pytest.param(["compare", *POSES, "--starts", "0"], "compared", marks=pytest.mark.long),
        (["apply", "fit", *POSES[1:6]], "corrected/new.csv"),
        (["export", "fit", "--to", "c"], "device/new.c"),
    ],
)
def test_a_command_that_fails_leaves_no_empty_folder(tmp_path, monkeypatch, capsys, words, output):
    monkeypatch.chdir(tmp_path)
    assert run(["calibrate", *POSES, "-o", "fit"]) == 0
    with open("/dev/full", "w") as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        code = run([*words, "-o", output])
    assert "standard output cannot be written" in capsys.readouterr().err
    assert (code, os.listdir(tmp_path)) == (1, ["fit"])


def test_a_closed_standard_output_is_said_before_anything_is_computed(tmp_path):
    words = ["calibrate", *POSES, "-o", str(tmp_path / "out")]
    done = ended(*words, preexec_fn=lambda: os.close(1))
    assert done.returncode == 1
    assert done.stderr == (
        "casest: standard output is closed; send it to a file, or to /dev/null\n"
    )
    assert not written(tmp_path / "out")


def test_without_standard_error_the_answer_is_the_same(capsys):
    how = {"stdout": subprocess.PIPE, "stderr": None, "preexec_fn": lambda: os.close(2)}
    closed = ended("calibrate", *POSES, **how)
    assert run(["calibrate", *POSES]) == 0
    assert (closed.returncode, closed.stdout) == (0, capsys.readouterr().out)


@pytest.mark.long
def test_a_reader_who_closes_the_pipe_gets_silence_and_the_files(tmp_path):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as nobody:
        done = ended("calibrate", *POSES, "-o", str(tmp_path / "out"), stdout=nobody)
        for words in (["calibrate", "--help"], ["--help"], ["list"]):
            assert ended(*words, stdout=nobody).stderr == ""
    assert (done.returncode, done.stderr) == (0, "")
    names = {path.name for path in written(tmp_path / "out")}
    assert names == {"result.json", "residuals.csv", "report.html"}


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(["simulate", "wheel", "--duration", "20", "--rate", "50"], id="simulate"),
        pytest.param(["calibrate", *POSES], id="calibrate"),
        pytest.param(["compare", *POSES, "--starts", "0"], id="compare", marks=pytest.mark.long),
    ],
)
def test_a_disk_that_fills_up_leaves_no_half_of_the_files(words, tmp_path):
    """Files of more than 2 kB are too much: the first of a command fits, or none does."""

    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    # Nor does Python keep half of a compiled module, which others would stumble over.
    alone = {**os.environ, "CASEST_KERNEL": "off", "PYTHONDONTWRITEBYTECODE": "1"}
    folder = tmp_path / "out"
    done = ended(*words, "-o", str(folder), preexec_fn=limited, env=alone, stdout=subprocess.PIPE)
    assert done.returncode == 1
    assert "cannot be written (File too large)" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not written(folder)


def test_no_space_left_is_said(tmp_path, capsys, monkeypatch):
    def full(_handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    words = ["simulate", "norm-diagonal", "--directions", "12", "--set", "norm=9.8"]
    assert run([*words, "-o", str(tmp_path / "out")]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "record.csv: cannot be written (No space left on device)" in printed.err
    assert not written(tmp_path / "out")
