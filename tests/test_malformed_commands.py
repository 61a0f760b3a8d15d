"""Malformed files and words through the command line: one line, a code of the contract, no hang."""

from __future__ import annotations

import random
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from casest.cli import run

#: Seconds after which a command hangs.
HANGS = 10
SEED = 20261
#: Thirty orientations of a sensor with a zero, in plain NumPy.
_RNG = np.random.default_rng(SEED)
_POSES = _RNG.standard_normal((30, 3))
_POSES *= 9.8 / np.linalg.norm(_POSES, axis=1)[:, None]
_POSES += 0.2 + 0.01 * _RNG.standard_normal((30, 3))
TABLE = "n,ax,ay,az\n" + "".join(
    f"{k}," + ",".join(f"{x:.4f}" for x in pose) + "\n" for k, pose in enumerate(_POSES)
)
MODEL = (
    "from casest import *\n"
    "@model\n"
    "def line(x=signal('m'), y=signal('m'), *, a=param('1', start=1.0), b=param('m')):\n"
    "    '''A line.'''\n"
    "    p = quantity('p', a * x, 'm')\n"
    "    return Residual(measured=y, predicted=p + b, corrected=p)\n"
)
#: What is put in at a random place: of text, of numbers, of bytes.
BITS = [
    "", ",", ";", "\n", "\n\n", '"', "nan", "inf", "-", "1e309", "1e-310", "1e", "x", "\t", "\0",
    "é", "\ufeff", "0x1", "1,2", "=", "(", "))", "# ", "\r", "%", "99999999999999999999",
]  # fmt: skip
V, N = ["--columns", "v=ax,ay,az"], ["--set", "norm=9.8"]
COMMANDS = [
    ["calibrate", "norm-diagonal", "bad.csv", *V, *N],
    ["calibrate", "norm-triangular", "bad.csv", "--columns", "v=1,2,3", *N],
    ["calibrate", "norm-diagonal", "bad.csv", *V, *N, "-o", "out"],
    ["calibrate", "wheel", "bad.csv", *V, "--rate", "50"],
    ["close", "norm-diagonal", "bad.csv", *V, *N],
    ["observe", "norm-diagonal", "bad.csv", *V, *N],
    ["filter", "bias-gravity", "bad.csv", "--columns", "omega=ax,ay,az", *V],
    ["apply", "bad.csv", "bad.csv"],
    ["calibrate", "norm-diagonal", "good.csv", *V, *N, "--fix", "scale=@bad.csv"],
    ["export", "bad.csv", "--to", "c"],
]
WORDS = [
    "calibrate", "close", "observe", "filter", "compare", "simulate", "export", "apply", "list",
    "norm-diagonal", "wheel", "bias-gravity", "good.csv", "m.py", "m.py:line", "m.py:", ":",
    "--set", "--fix", "--free", "--columns", "--unit", "--scale", "--rate", "--effects", "-o",
    "--start", "--solver", "--shared", "--per-run", "--holdout", "--seed", "--to", "--value",
    "--effect", "--noise", "--directions", "--duration", "--starts", "--limit", "--window",
    "norm=", "norm=9.8", "norm=nan", "norm=1e400", "=1", "v=ax,ay,az", "v=", "v=0,0,0", "v=,,",
    "v=é", "quadratic", "channel_bias(ax)", "channel_bias()", "channel_bias(((", "scale=@m.py",
    "@", "0", "-1", "nan", "inf", "1e9", "5", "c", "json", "../..", "radius=gravity(1)",
    "v=int16//2", "v=1/0", "trust-region", "norm=9.8kg", "--at-rest", "--json", "--float", "",
    "\x1b[31m", "norm=9.8 parsec", "norm = 9.8",
]  # fmt: skip
WORDS += ["a" * 300]


class Hangs(BaseException):
    """Raised by the clock."""


@pytest.fixture
def ends(tmp_path, monkeypatch, capfd) -> Callable[[list[str]], None]:
    """A command that must end as the contract says."""
    monkeypatch.chdir(tmp_path)
    Path("good.csv").write_text(TABLE)
    Path("m.py").write_text(MODEL)
    if not hasattr(signal, "SIGALRM"):
        pytest.skip("there is no clock to stop it")

    def late(_number, _frame):
        raise Hangs

    def call(words: list[str]) -> None:
        before = signal.signal(signal.SIGALRM, late)
        signal.alarm(HANGS)
        try:
            code = run(words)
        finally:
            signal.alarm(0)
            signal.signal(signal.SIGALRM, before)
        printed = capfd.readouterr()
        assert code in (0, 1, 2), (words, code, printed.err)
        assert "Traceback" not in printed.err + printed.out, words
        assert "internal error" not in printed.err, (words, printed.err)
        if code == 1:
            assert printed.err.startswith(("casest: ", "Usage: ")), (words, printed.err)
            assert printed.err.count("\n") <= 2, (words, printed.err)

    return call


def spoilt(text: str, chance: random.Random) -> str:
    """The text with a few places cut, doubled or replaced."""
    for _ in range(chance.randint(1, 4)):
        i, j = sorted(chance.randrange(len(text) + 1) for _ in range(2))
        j = min(j, i + chance.choice([0, 1, 5, 80]))
        bit = chance.choice([*BITS, text[i:j] * 2])
        text = text[:i] + bit + text[j:]
        if chance.random() < 0.1:
            text = text[: chance.randrange(len(text) + 1)]
    return text


@pytest.mark.parametrize("part", range(5))
def test_a_malformed_table_is_one_line(part, ends):
    chance = random.Random(SEED + part)
    for _ in range(12):
        content = spoilt(TABLE, chance)
        Path("bad.csv").write_bytes(content.encode("utf-8", "replace"))
        ends(chance.choice(COMMANDS))


@pytest.mark.parametrize(
    "part", [3, *(pytest.param(part, marks=pytest.mark.long) for part in (0, 1, 2))]
)
def test_a_table_of_wild_numbers_ends(part, ends):
    """What can be read may be anything: constant, huge, tiny, the same twice."""
    chance = random.Random(SEED + 300 + part)
    for _ in range(6):
        table = _POSES.copy()
        for _ in range(chance.randint(1, 3)):
            rows, column = chance.choice([slice(None), chance.randrange(30)]), chance.randrange(3)
            size = chance.choice([0.0, 1e-310, 1e-300, 1e-12, -1.0, 1e6, 1e150, 1e300])
            with np.errstate(over="ignore"):
                table[rows, column] *= size
        lines = [f"{k}," + ",".join(f"{x:.17g}" for x in row) for k, row in enumerate(table)]
        Path("bad.csv").write_text("\n".join(["n,ax,ay,az", *lines]) + "\n")
        ends(chance.choice(COMMANDS[:6]))


@pytest.mark.parametrize("part", range(2))
def test_a_malformed_model_is_one_line(part, ends):
    chance = random.Random(SEED + 100 + part)
    x = np.linspace(1, 2, 9)
    rows = "".join(f"{a:.3f},{2 * a + 0.01 * (-1) ** k:.3f}\n" for k, a in enumerate(x))
    Path("xy.csv").write_text("x [m],y [m]\n" + rows)
    for k in range(12):
        name = f"model_{part}_{k}.py"
        Path(name).write_bytes(spoilt(MODEL, chance).encode("utf-8", "replace"))
        ends(["calibrate", name, "xy.csv"])


#: How files of other kinds begin, and are called.
HEADS = [
    b"", b"\x93NUMPY\x01\x00v\x00{", b"PK\x03\x04", b"PAR1", b"MATLAB 5.0", b"#ROSBAG V2.0\n",
    b"ULog\x01\x12\x35\x01", b"{", b"SQLite format 3\0",
]  # fmt: skip
KINDS = ["npy", "npz", "mat", "parquet", "json", "bag", "ulg", "csv", "db3"]


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_under_any_name_are_one_line(kind, ends):
    chance = random.Random(kind)
    for head in chance.sample(HEADS, 3):
        Path(f"bad.{kind}").write_bytes(head + chance.randbytes(chance.choice([0, 7, 600])))
        ends(["calibrate", "norm-diagonal", f"bad.{kind}", "--set", "norm=1"])
        ends(["apply", f"bad.{kind}", "good.csv"])


@pytest.mark.parametrize("part", range(5))
def test_malformed_words_are_one_line(part, ends):
    chance = random.Random(SEED + 200 + part)
    base = ["calibrate", "norm-diagonal", "good.csv", *V, *N]
    for k in range(20):
        if k % 2:
            words = [*base, *chance.choices(WORDS, k=chance.randint(1, 3))]
        else:
            words = chance.choices(WORDS, k=chance.randint(1, 6))
        ends(words)


@pytest.mark.parametrize(
    ("first", "second", "name"),
    [
        (["--columns", "reading=a"], ["--columns", "reading=b"], "reading"),
        (["--unit", "reading=V"], ["--unit=reading=mV"], "reading"),
    ],
)
def test_two_values_for_one_name_are_refused(tmp_path, capsys, first, second, name):
    """One of them was left out without a word."""
    (tmp_path / "d.csv").write_text("a,b,reference\n1,2,3\n2,3,4\n3,4,5\n")
    assert run(["calibrate", "linear", str(tmp_path / "d.csv"), *first, *second]) == 1
    assert f"{name} has one value" in capsys.readouterr().err
