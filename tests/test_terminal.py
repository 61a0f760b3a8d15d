"""At the prompt: 80 columns, plain text, what is going on, and a next command that works."""

from __future__ import annotations

import io
import re
import shlex
import shutil
import time
from pathlib import Path

import click
import numpy as np
import pytest
import simulators as sim
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from casest.cli import commands, run
from casest.cli.waiting import Waiting
from casest.report.next_command import following, typed_words
from casest.report.text.layout import coloured
from casest.results.rounding import percent, rounded

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
    "filter": "filter bias-gravity flight.csv",
    "compare": "compare norm-diagonal poses.csv --columns v=Acc --unit v=g --starts 1 -o side",
    "simulate": "simulate norm-diagonal --directions 30 --noise 0.01 --set norm=9.81 -o made",
    "close in motion": "close bias-gravity flight.csv -o moved",
    "apply": "apply fit poses.csv --columns v=Acc --unit v=g -o fit/corrected.csv",
    "export": "export fit --to c -o fit/correction.c",
    "export to python": "export fit --to python -o fit/correction.py",
    "export to json": "export fit --to json -o fit/correction.json",
    "apply json": "apply fit/correction.json poses.csv --columns v=Acc --unit v=g -o again.csv",
    "list": "list",
    "budget": "budget tri",
    "check": "check fit poses.csv --columns v=Acc --unit v=g",
    "plan": "plan fit --count 3",
    "report": "report fit tri",
    "six means": "calibrate norm-diagonal six.csv --columns v=Acc --unit v=g",
    "counts": "calibrate norm-diagonal counts.csv --columns v=Acc",
}
#: Commands that end with another exit code than 0.
REFUSED = ("refused", "six means")


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """What each command prints, run one after the other in a folder of short names."""
    folder, rng = tmp_path_factory.mktemp("prompt"), np.random.default_rng(3)
    sensor = sim.accelerometer(rng, skew=False)
    v = sensor.read(sim.spread_poses(30, rng), 5e-3, rng)
    header = "AccX,AccY,AccZ"
    np.savetxt(folder / "poses.csv", v / sim.GRAVITY, delimiter=",", header=header)
    np.savetxt(folder / "counts.csv", 300 * v, delimiter=",", header=header)
    six = sensor.read(np.vstack([np.eye(3), -np.eye(3)]), 5e-3, rng)
    np.savetxt(folder / "six.csv", six / sim.GRAVITY, delimiter=",", header=header)
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
        patch.setattr("casest.report.picture.draw", lambda _, to: [to / "compare.png"])
        yield {name: printed(name, patch) for name in WORDS}


def turned_back(vector, t, omega):
    """What stands still outside (3,), as a body sees it that turns by `omega` (N, 3): (N, 3)."""
    seen = [np.array(vector)]
    for dt, rate in zip(np.diff(t), (omega[1:] + omega[:-1]) / 2, strict=True):
        seen.append(Rotation.from_rotvec(-dt * rate).apply(seen[-1]))
    return np.array(seen)


def printed(name: str, patch: pytest.MonkeyPatch) -> str:
    out = io.StringIO()
    patch.setattr("sys.stdout", out)
    assert run(shlex.split(WORDS[name])) == (2 if name in REFUSED else 0), name
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
        ("close in motion", ["filter", "observe"]),
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


def test_a_command_is_read_again_whichever_of_its_options_have_no_value():
    context = click.Context(commands)
    for name in commands.list_commands(context):
        command = commands.get_command(context, name)
        flags = {
            word
            for option in command.params
            if isinstance(option, click.Option) and option.is_flag
            for word in option.opts
        }
        for flag in flags:
            typed = typed_words(f"casest {name} {flag} given")
            assert typed.arguments == ("given",), f"{name} {flag}"
            assert typed.options == ((flag, None),)


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


def test_after_a_misfit_the_next_command_asks_for_a_cause_and_corrects_nothing(tmp_path, capsys):
    """A drift beside slow noise: that, or a step, explains most of it, and so may the noise."""
    rng, t = np.random.default_rng(4), 0.5 * np.arange(600)
    x, slow = rng.uniform(0, 10, 600), gaussian_filter1d(rng.standard_normal(600), 40)
    y = 1 + 2 * x + 0.0004 * t + 0.03 * slow / slow.std() + 0.01 * rng.standard_normal(600)
    np.savetxt(tmp_path / "t.csv", np.c_[t, x, y], "%.6f", ",", header="t [s],x,y", comments="")
    words = ["close", "linear", str(tmp_path / "t.csv"), "--columns", "reference=x"]
    words += ["--columns", "reading=y", "-o", str(tmp_path / "out")]
    assert run(words) == 0
    printed = capsys.readouterr().out
    assert "unexplained" in printed
    assert "Next: correct readings" not in printed
    (asked,) = nexts(printed)
    assert asked.startswith("casest close linear ")
    again = shlex.split(asked)[1:]
    name = again[again.index("--effects") + 1]
    assert f"says so, as --effects {name}" in printed
    assert run(again) == 0
    printed = capsys.readouterr().out
    assert f"{name} was not added: no more of it than noise" in " ".join(printed.split())
    assert "says so, as" not in printed  # it was


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
        (
            "m: trusted, but the\nresidual is not noise",
            33,
            "trusted, but the\nresidual is not noise",
        ),
        ("m on a.csv: 9 samples, rank 8: NOT\nTRUSTED", 31, "NOT\nTRUSTED"),
        ("m by out on a.csv: valid", 32, "valid"),
        ("m by out on a.csv: NOT VALID: the scale changed", 31, "NOT VALID"),
        ("m on a.csv: adequate: nothing is missing", 32, "adequate"),
        ("m on a.csv: extended: cubic was missing", 36, "extended"),
        ("m on a.csv: unexplained: a misfit remains", 35, "unexplained"),
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
        (0.98957, 0.000996, ("0.9896", "0.0010")),
        (0.98957, float("nan"), ("–", "not determined")),
    ],
)
def test_digits_end_where_the_standard_deviation_or_the_double_does(value, std, text):
    assert rounded(value, std) == text


def test_nearly_all_is_100_percent_and_no_power_of_ten():
    shares = [0.9994, 0.995, 0.66, 0.0994, 0.0123, 0.0]
    assert [percent(x) for x in shares] == ["100 %", "100 %", "66 %", "9.9 %", "1.2 %", "0 %"]


PAIR = re.compile(r"(-?\d\S*) +± +(\d\S*)")


@pytest.mark.parametrize("name", ["calibrate", "close", "filter", "close in motion", "budget"])
def test_values_end_at_the_second_digit_of_their_standard_deviation(said, name):
    shown = [list(pair) for line in said[name].splitlines()
             for pair in [PAIR.search(line)] if pair for pair in [pair.groups()]]  # fmt: skip
    assert len(shown) >= 6
    for value, std in shown:
        if "e" in std:
            continue
        decimals = [text.partition(".")[2] for text in (value, std)]
        assert len(decimals[0]) == len(decimals[1]), (value, std)
        assert len(std.replace(".", "").lstrip("0")) == 2 or float(std) >= 100, std


def test_six_means_say_what_is_missing_and_that_it_can_be_stated(said, monkeypatch, capsys):
    """Nothing is called undetermined there: what nothing shows is the noise."""
    text = " ".join(said["six means"].split())
    assert "say how large it is: --sensor-noise v=STD" in text
    assert "± unknown" in text
    assert "noise of one residual unknown" in text
    for words in ("not determined", "determine every unknown", "nan", "alone"):
        assert words not in text


def test_the_way_out_of_six_means_leads_out(tmp_path, monkeypatch):
    poses = np.vstack([np.eye(3), -np.eye(3)]) * 9.81 + [0.1, -0.2, 0.3]
    np.savetxt(tmp_path / "six.csv", poses, delimiter=",", header="ax,ay,az")
    out = io.StringIO()
    monkeypatch.setattr("sys.stdout", out)
    words = f"calibrate norm-diagonal {tmp_path / 'six.csv'} --columns v=a --unit v=m/s^2"
    assert run([*shlex.split(words), "--set", "norm=9.81", "--sensor-noise", "v=0.02"]) == 0
    text = " ".join(out.getvalue().split())
    assert "the standard deviations rest on the stated noise alone" in text
    assert re.search(r"offset\[2\] 0\.300 ± 0\.014 m/s\^2", text)


def test_readings_of_no_stated_unit_and_a_norm_of_another_size_do_not_share_a_unit(said):
    """Counts and a norm of 1: `[v]` is the unit of the readings alone."""
    lines = said["counts"].splitlines()
    assert "  norm = 1 (held)" in lines
    units = [line.split()[-1] for line in lines if re.match(r"  (scale|offset)\[", line)]
    assert units == ["1/[v]"] * 3 + ["[v]"] * 3


def test_a_norm_that_is_found_has_the_unit_that_scale_and_correction_are_in(tmp_path):
    """Scale held at one is a pure number, and the correction goes to a file in tesla."""
    rng = np.random.default_rng(5)
    poses = 480 * sim.spread_poses(20, rng) / sim.GRAVITY + [100, -50, 20]
    file = tmp_path / "m.csv"
    np.savetxt(file, poses, delimiter=",", header="mx [mgauss],my [mgauss],mz [mgauss]")
    words = f"calibrate norm-diagonal {file} --columns v=m --fix scale=1,1,1 --free norm"
    out = str(tmp_path / "out")
    assert run([*shlex.split(words), "--set", "norm=450 mgauss", "-o", out]) == 0
    assert run(["export", out, "--to", "ardupilot", "-o", f"{out}/m.param"]) == 0
    text = (tmp_path / "out" / "m.param").read_text(encoding="utf-8")
    assert float(re.search(r"COMPASS_OFS_X,(\S+)", text)[1]) == pytest.approx(-100, abs=1e-6)
