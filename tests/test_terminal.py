"""At the prompt: 80 columns, plain text, what is going on, and a next command that works."""

from __future__ import annotations

import io
import shlex
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import simulators as sim
from scipy.spatial.transform import Rotation

from casest.cli import commands, run
from casest.cli.waiting import Waiting
from casest.report.next_command import following, typed_words
from casest.report.text.layout import coloured
from casest.results.rounding import rounded

ROOT = Path(__file__).parents[1]
WORDS = {
    "calibrate": "calibrate norm-diagonal poses.csv --columns v=Acc --unit v=g -o fit",
    "calibrate without -o": "calibrate norm-diagonal poses.csv --columns v=Acc --unit v=g",
    "calibrate the wheel": "calibrate wheel wheel.csv --set 'radius=28 cm' -o w",
    "calibrate a matrix": "calibrate norm-triangular poses.csv --columns v=Acc --unit v=g -o tri",
    "held": "calibrate norm-triangular poses.csv --columns v=Acc --unit v=g --fix scale=@tri",
    "refused": "calibrate norm-full poses.csv --columns v=Acc --unit v=g -o refused",
    "close": "close norm-diagonal poses.csv --columns v=Acc --unit v=g -o closed",
    "observe": "observe norm-diagonal poses.csv --columns v=Acc --unit v=g -o seen",
    "observe in motion": "observe bias-gravity flight.csv -o flight",
    "observe without data": "observe bias-gravity",
    "close in motion": "close bias-gravity flight.csv",
    "filter": "filter bias-gravity flight.csv",
    "compare": "compare norm-diagonal poses.csv --columns v=Acc --unit v=g --starts 1 -o side",
    "simulate": "simulate norm-diagonal --directions 30 --noise 0.01 --set norm=9.81 -o made",
    "close in motion, kept": "close bias-gravity flight.csv -o moved",
    "apply": "apply fit poses.csv --columns v=Acc --unit v=g -o fit/corrected.csv",
    "export": "export fit --to c -o fit/correction.c",
    "export to python": "export fit --to python -o fit/correction.py",
    "export to json": "export fit --to json -o fit/correction.json",
    "apply json": "apply fit/correction.json poses.csv --columns v=Acc --unit v=g -o again.csv",
    "list": "list",
}


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """What each command prints, run one after the other in a folder of short names."""
    folder, rng = tmp_path_factory.mktemp("prompt"), np.random.default_rng(3)
    sensor = sim.accelerometer(rng, skew=False)
    v = sensor.read(sim.spread_poses(30, rng), 5e-3, rng)
    np.savetxt(folder / "poses.csv", v / sim.GRAVITY, delimiter=",", header="AccX,AccY,AccZ")
    shutil.copy(ROOT / "casest" / "demo" / "wheel.csv", folder)
    t = np.arange(0, 10, 0.02)
    omega = np.column_stack([0.3 * np.sin(0.2 * t), 0.3 * np.cos(0.3 * t), 0.2 + 0 * t])
    a = turned_back([0, 0, -9.81], t, omega) + 0.02 * rng.standard_normal((len(t), 3))
    table = np.column_stack([t, a, omega, 0.01 * rng.standard_normal((len(t), 3))])
    names = [f"{s}{axis} [{u}]" for s, u in (("a", "m/s^2"), ("omega", "rad/s"), ("v", "m/s"))
             for axis in "xyz"]  # fmt: skip
    header = ",".join(["t [s]", *names])
    np.savetxt(folder / "flight.csv", table, delimiter=",", header=header, comments="")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield {name: printed(words, patch) for name, words in WORDS.items()}


def turned_back(vector, t, omega):
    """What stands still outside (3,), as a body sees it that turns by `omega` (N, 3): (N, 3)."""
    seen = [np.array(vector)]
    for dt, rate in zip(np.diff(t), (omega[1:] + omega[:-1]) / 2, strict=True):
        seen.append(Rotation.from_rotvec(-dt * rate).apply(seen[-1]))
    return np.array(seen)


def printed(words: str, patch: pytest.MonkeyPatch) -> str:
    out = io.StringIO()
    patch.setattr("sys.stdout", out)
    code = run(shlex.split(words))
    assert code == (2 if "norm-full" in words else 0), words
    return out.getvalue()


@pytest.mark.parametrize("name", WORDS)
def test_every_line_fits_80_columns_and_is_plain_text(said, name):
    assert said[name].strip()
    for line in said[name].splitlines():
        assert len(line) <= 80, line
        assert line.isprintable(), line


@pytest.mark.parametrize("name", [None, *commands.commands])
def test_every_help_fits_80_columns(name, capsys):
    assert run([*([name] if name else []), "--help"]) == 0
    for line in capsys.readouterr().out.splitlines():
        assert len(line) <= 80, line


def nexts(text: str) -> list[str]:
    """The commands that stand under a line that begins with Next."""
    lines = text.replace("\\\n", " ").splitlines()
    return [lines[i + 1].strip() for i, line in enumerate(lines) if line.startswith("Next: ")]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("calibrate", ["close", "apply", "export"]),
        ("calibrate without -o", ["close", "calibrate"]),
        ("refused", ["observe"]),
        ("close", ["apply", "export"]),
        ("observe", ["calibrate"]),
        ("observe in motion", ["filter"]),
        ("filter", ["filter", "observe", "close"]),
        ("compare", ["calibrate"]),
        ("simulate", ["calibrate"]),
        ("close in motion, kept", ["filter", "observe"]),
        ("apply", ["export"]),
        ("export to json", ["apply"]),
    ],
)
def test_the_next_command_can_be_typed_as_it_stands(said, name, expected):
    commands = [shlex.split(line) for line in nexts(said[name])]
    assert [words[:2] for words in commands] == [["casest", word] for word in expected]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stdout", io.StringIO())
        for words in commands:
            if words[1:3] != ["close", "bias-gravity"]:  # has been run above
                assert run(words[1:]) == 0, words


def test_after_an_export_comes_its_self_test(said):
    assert nexts(said["export"]) == [
        "cc -DCASEST_SELF_TEST fit/correction.c -lm -o self-test && ./self-test"
    ]
    assert nexts(said["export to python"]) == ["python fit/correction.py"]


def test_every_command_that_left_files_says_what_to_type_next(said):
    for name, text in said.items():
        assert ("Written: " in text) <= ("Next: " in text), name


def test_a_long_command_continues_as_a_shell_reads_it():
    column = "v=" + ",".join(f"accelerometer {axis}" for axis in "xyz")
    command = shlex.join(
        ["casest", "calibrate", "wheel", "my record.csv", "--columns", column, "--rate=100",
         "--at-rest", "-oout dir"]
    )  # fmt: skip
    text = following(command, "out dir")
    assert max(map(len, text.splitlines())) <= 80
    words = shlex.split(nexts(text)[1])
    assert words[:4] == ["casest", "apply", "out dir", "my record.csv"]
    assert words[words.index("--columns") + 1] == column
    assert words[words.index("--rate") + 1] == "100"
    assert "--at-rest" not in words
    assert typed_words("pytest -q tests") is None


def test_the_list_names_every_shipped_problem_and_effect(said):
    from casest.effects import CATALOGUE
    from casest.results.find import MOVING, SHIPPED

    names = {line.strip().partition(":")[0] for line in said["list"].splitlines()}
    assert {*SHIPPED, *MOVING, *(e.name for e in CATALOGUE)} <= names
    for effect in ("bias of an input", "lever_arm of an output", "coloured_noise of any signal"):
        assert effect in names


# -- what is going on ------------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def screen(stream: io.StringIO) -> str:
    """What stands on one line of a terminal after all that was written to it."""
    line: list[str] = []
    place = 0
    for sign in stream.getvalue():
        if sign == "\r":
            place = 0
        else:
            line[place : place + 1] = [sign]
            place += 1
    return "".join(line).rstrip()


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr("casest.cli.waiting.PATIENCE", 0.0)
    monkeypatch.setattr("casest.cli.waiting._TICK", 0.002)


def waited(stream: io.StringIO, words: str) -> bool:
    for _ in range(500):
        if words in screen(stream):
            return True
        time.sleep(0.002)
    return False


def test_what_is_going_on_is_said_on_a_terminal_and_wiped_away(impatient, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    waiting = Waiting()
    waiting.say("reading a record with a long name")
    assert waited(terminal, "casest: reading a record with a long name … 0 s")
    waiting.say("fitting")
    assert waited(terminal, "casest: fitting … 0 s")
    waiting.done()
    assert screen(terminal) == ""
    assert "\x1b" not in terminal.getvalue()
    monkeypatch.setenv("COLUMNS", "30")
    waiting.say("fitting a model with a very long name indeed")
    assert waited(terminal, "casest: fitting a model with")
    waiting.done()
    assert max(map(len, terminal.getvalue().splitlines())) < 80


@pytest.mark.parametrize(
    ("words", "code", "verdict"),
    [
        ("m on a.csv: 9 samples, rank 9:\ntrusted", 32, "trusted"),
        ("m on a.csv: 9 samples, rank 8: NOT\nTRUSTED", 31, "NOT\nTRUSTED"),
        ("m on a.csv: adequate: nothing is missing", 32, "adequate"),
        ("m on a.csv: extended: cubic was missing", 33, "extended"),
        ("m on a.csv: unexplained: a misfit remains", 31, "unexplained"),
    ],
)
def test_the_verdict_is_coloured_on_a_terminal_that_wants_it(words, code, verdict, monkeypatch):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    text = f"{words}\n\n  trusted and adequate: words of the rest"
    shown = coloured(text, Terminal())
    assert shown == text.replace(verdict, f"\x1b[1;{code}m{verdict}\x1b[0m", 1)
    assert coloured(text, io.StringIO()) == text
    monkeypatch.setenv("NO_COLOR", "1")
    assert coloured(text, Terminal()) == text


def test_nothing_is_said_where_nobody_watches_or_within_a_second(impatient, monkeypatch):
    piped = io.StringIO()
    monkeypatch.setattr("sys.stderr", piped)
    waiting = Waiting()
    waiting.say("fitting")
    time.sleep(0.02)
    waiting.done()
    assert piped.getvalue() == ""
    monkeypatch.setattr("casest.cli.waiting.PATIENCE", 1.0)
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    waiting.say("fitting")
    time.sleep(0.02)
    waiting.done()
    assert terminal.getvalue() == ""


def test_the_line_is_wiped_away_before_an_error(impatient, monkeypatch, tmp_path):
    """A command that fails while it reads ends with its error alone on the line."""
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setattr("casest.data.bind.read_table", lambda path: time.sleep(0.05))
    assert run(["calibrate", "norm-diagonal", "poses.csv"]) == 3
    last = terminal.getvalue().rpartition("\r")[2]
    assert last.startswith("casest: ")
    assert "reading poses.csv" in terminal.getvalue()


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (2.01, 9.7e-17, ("2.01", "1e-16")),
        (9.80665, 0.0, ("9.80665", "0")),
        (0.98957, 0.00023, ("0.98957", "0.00023")),
    ],
)
def test_digits_end_where_the_standard_deviation_or_the_double_does(value, std, text):
    assert rounded(value, std) == text
