"""Names that others wrote are text wherever they are put: C, Python, JSON, HTML, terminals."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import sys
import unicodedata
from pathlib import Path

import numpy as np
import pytest

from casest import escaping
from casest.cli import run
from casest.report.html.page import document

WICKED = [
    '*/\n#include "evil.h"\nint evil(void) { return 1; }\n/*',
    '*\\\n/ int evil; /*',
    "*??/\n/ int evil; /*",
    "/**//**/ int evil; /*/",
    '"""\nimport evil\n"""',
    '\\u zero \\N{no} \\x \\"""\nimport evil\n\\',
    "\x1b]0;title\x07\x1b[2J\x9b31m\x7f\r\b",
    "\u202etxt.exe\u2028\udcff\U000e0001",
    "größe µ → ° ²",
]  # fmt: skip


def test_what_can_be_seen_stays_as_it_is():
    for text in ("größe µ → ° ²", "a b_c[0]", "日本語", ""):
        for function in (escaping.visible, escaping.terminal, escaping.one_line):
            assert function(text) == text
    assert escaping.terminal("a\n\tb") == "a\n\tb"
    assert escaping.one_line("a\nb") == "a b"


@pytest.mark.parametrize("text", WICKED, ids=range(len(WICKED)))
def test_no_control_character_is_left(text):
    for found in (escaping.terminal(text), escaping.one_line(text), escaping.c_comment(text)):
        kinds = {unicodedata.category(c) for c in found if c not in "\n\t"}
        assert not kinds & {"Cc", "Cf", "Cs", "Zl", "Zp"}
        found.encode("utf-8")
    # in JSON they mean what they meant
    sent = json.dumps({"name": text}, ensure_ascii=False)
    assert json.loads(escaping.terminal(sent)) == {"name": text}


def named(folder: Path, name: str) -> None:
    """A result whose model, signal, unit and effects bear a name."""
    content = json.loads((folder / "plain.json").read_text(encoding="utf-8"))
    carried = content["correction"]
    carried["model"] = name
    carried["not_undone"] = [name]
    carried["signals"][0]["name"] = carried["program"]["inputs"][0]["name"] = name
    carried["program"]["inputs"][0]["unit"] = name
    carried["program"]["output"] |= {"name": name, "unit": name}
    # "replace": a lone half of a character is no text in a file
    text = json.dumps(content, ensure_ascii=False).encode("utf-8", "replace")
    (folder / "result.json").write_bytes(text)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("named")
    rng = np.random.default_rng(0)
    v = rng.standard_normal((30, 3))
    v = 9.8 * v / np.linalg.norm(v, axis=1, keepdims=True) * [1.01, 0.99, 1.0]
    v += 0.01 * rng.standard_normal((30, 3))
    head = "vx [m/s^2],vy [m/s^2],vz [m/s^2]"
    np.savetxt(folder / "v.csv", v, delimiter=",", header=head, comments="")
    words = ["norm-diagonal", str(folder / "v.csv"), "--set", "norm=9.8", "-o", str(folder)]
    assert run(["calibrate", *words]) == 0
    shutil.copy(folder / "result.json", folder / "plain.json")
    return folder


@pytest.mark.parametrize("text", WICKED, ids=range(len(WICKED)))
def test_no_name_gets_out_of_the_comment_of_exported_c(result, text):
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler on this machine: the exported source is not compiled")
    named(result, text)
    source = result / "c.c"
    assert run(["export", str(result), "--to", "c", "-o", str(source)]) == 0
    assert source.read_text("utf-8").count("*/") >= 1
    strict = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-DCASEST_SELF_TEST"]
    program = str(result / "self-test")
    subprocess.run([compiler, *strict, str(source), "-o", program, "-lm"], check=True)
    assert subprocess.run([program], capture_output=True, check=False).returncode == 0
    lines = [compiler, "-E", "-P", "-std=c99", str(source)]
    done = subprocess.run(lines, capture_output=True, text=True, check=True)
    assert not re.search(r"\bevil\b", done.stdout)


@pytest.mark.parametrize("text", WICKED, ids=range(len(WICKED)))
def test_no_name_gets_out_of_the_docstring_of_exported_python(result, text):
    named(result, text)
    assert run(["export", str(result), "--to", "python", "-o", str(result / "c.py")]) == 0
    done = subprocess.run(
        [sys.executable, str(result / "c.py")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("largest error")


@pytest.mark.parametrize("text", WICKED[:-1], ids=range(len(WICKED) - 1))
def test_no_control_character_of_a_name_reaches_the_terminal(result, capsys, text):
    """Of an input that the data lack, of a file, of an option, of a model."""
    named(result, text)
    for words in (
        ["apply", str(result), str(result / "v.csv")],
        ["apply", str(result), f"{text}.csv"],
        ["calibrate", text, str(result / "v.csv")],
        ["calibrate", "norm-diagonal", str(result / "v.csv"), "--set", f"{text}=1"],
    ):
        capsys.readouterr()
        assert run([word.replace("\0", "") for word in words]) == 1
        printed = capsys.readouterr()
        assert printed.err.count("\n") == 1
        assert printed.err[:-1].isprintable()
    assert run(["export", str(result), "--to", "c"]) == 0
    assert capsys.readouterr().out.replace("\n", "").isprintable()


@pytest.mark.long
def test_a_column_with_an_escape_sequence_is_named_without_it(tmp_path, capsys):
    rng = np.random.default_rng(4)
    mass, drift = rng.uniform(0, 5, 200), np.linspace(0, 1, 200)
    output = 0.5 + 0.1 * 9.81 * mass + 0.2 * drift + 1e-3 * rng.standard_normal(200)
    table = np.column_stack([mass, 20 + drift, output, drift])
    head = "mass [kg],temperature [degC],output [mV],\x1b[31mheat\x07"
    file = tmp_path / "cell.csv"
    np.savetxt(file, table, delimiter=",", header=head, comments="")
    model = str(Path(__file__).parent / "models" / "load_cell.py:load_cell")
    assert run(["close", model, str(file), "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    assert "heat" in printed.out
    assert "\x1b" not in printed.out + printed.err
    assert "\x07" not in printed.out + printed.err
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "\x1b" not in page
    assert "\x07" not in page


def test_a_page_shows_characters_without_a_shape_as_they_are_written():
    page = document("a\x1b\u202eb", "", [], [], trusted=True)
    assert "a\\u001b\\u202eb" in html.unescape(page)
