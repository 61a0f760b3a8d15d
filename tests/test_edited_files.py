"""Edited `result.json` and `correction.json`: a sentence that says what is wrong, or it works."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from casest import CasestError
from casest.cli import run
from casest.cli.values import parse_value
from casest.results.find import find_model
from casest.results.saved import saved_result
from casest.saved.apply import corrected_csv, of_another_time
from casest.saved.export import applied, exported, is_exported

NTC = '''
from casest import Residual, exp, model, param, quantity, signal


@model
def ntc(T=signal("K"), r=signal("ohm"), *, a=param("ohm", start=9e3), b=param("K", start=3e3)):
    """Not linear, and without a closed form: Newton's method."""
    temperature = quantity("temperature", T, "K")
    reading = quantity("reading", a * exp(b * (1 / temperature - 1 / 298.15)), "ohm")
    return Residual(measured=r, predicted=reading, corrected=temperature)
'''
#: What somebody may put in the place of a value.
VALUES: list[Any] = [
    None, True, "", "x", "\u202e\x1b", [], {}, [[]], [1, [2]], {"a": 1}, 0, -1, -2, 1, 3, 7, 2.5,
    -1e-300, 1e308, 10**400, 10**12, 4097, "NaN", ["a", "b"], [None], "sin", "input", [1e308] * 3,
]  # fmt: skip
#: Edits of the text itself.
TEXTS: list[Callable[[str], str]] = [
    lambda text: text[: len(text) // 2],
    lambda text: "",
    lambda text: "[" * 100_000,
    lambda text: text.replace("1", "NaN", 1),
    lambda text: text.replace("0.", "Infinity", 1),
    lambda text: text.replace(":", ": 1e999,", 1),
    lambda text: "\ufeff" + text,
    lambda text: text.replace('"model"', '"model" : "\\ud800", "model"', 1),
    lambda text: "[" + text + "]",
    lambda text: "null",
    lambda text: text.replace("1", "1" + 6000 * "0", 1),
    lambda text: text.replace('["input", 0, 0]', f'["input", 0, 1{6000 * "0"}]'),
    lambda text: text.replace('["input", 0, 0]', f'["constant", 0, 1{6000 * "0"}]'),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Results of both kinds of correction, shared and per run, each with its record and export."""
    folder, rng = tmp_path_factory.mktemp("edited"), np.random.default_rng(0)
    (folder / "ntc.py").write_text(NTC, encoding="utf-8")
    kelvin = np.linspace(270.0, 345.0, 30)
    for name, r25 in (("a", 1e4), ("b", 1.1e4)):
        ohm = r25 * np.exp(3950 * (1 / kelvin - 1 / 298.15))
        ohm *= 1 + 1e-4 * rng.standard_normal(30)
        table = np.column_stack([kelvin, ohm])
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header="T [K],r [ohm]",
                   comments="")  # fmt: skip
    v = rng.standard_normal((30, 3))
    v = 9.8 * v / np.linalg.norm(v, axis=1, keepdims=True) * [1.01, 0.99, 1.0]
    v += 0.01 * rng.standard_normal((30, 3))
    head = "vx [m/s^2],vy [m/s^2],vz [m/s^2]"
    np.savetxt(folder / "v.csv", v, delimiter=",", header=head, comments="")
    model, a, b = (str(folder / name) for name in ("ntc.py", "a.csv", "b.csv"))
    for name, words in (
        ("newton", [model, a]),
        ("runs", [model, a, b, "--per-run", "a"]),
        ("direct", ["norm-diagonal", str(folder / "v.csv"), "--set", "norm=9.8"]),
    ):
        assert run(["calibrate", *words, "-o", str(folder / name)]) == 0
        made = str(folder / f"{name}.json")
        assert run(["export", str(folder / name), "--to", "json", "-o", made]) == 0
    assert run(["close", "norm-diagonal", str(folder / "v.csv"), "--set", "norm=9.8", "-o",
                str(folder / "closed")]) == 0  # fmt: skip
    return folder


def places(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every key and index in it."""
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in items:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


def edited(content: Any, rng: np.random.Generator) -> tuple[Any, str]:
    """A copy with one to three edits, and which."""
    content, said = copy.deepcopy(content), []
    for _ in range(rng.integers(1, 4)):
        every = list(places(content))
        # what is read again, oftener than the rest; and keys as often as what lies deep in lists
        read = [p for p in every if p[0] in ("correction", "program", "estimate", "after")]
        pool = read if read and rng.random() < 0.7 else every
        depth = rng.integers(1, 1 + max(map(len, pool)))
        pool = [p for p in pool if len(p) <= depth] or pool
        *above, key = pool[rng.integers(len(pool))]
        holder = content
        for step in above:
            holder = holder[step]
        kind = rng.choice(["delete", "replace", "double", "negate", "swap"])
        said.append(f"{kind} {[*above, key]}")
        if kind == "delete":
            del holder[key]
        elif kind == "double" and isinstance(holder, list):
            holder.insert(key, copy.deepcopy(holder[key]))
        elif kind == "negate" and isinstance(holder[key], int | float):
            holder[key] = -holder[key] - 1
        elif kind == "swap" and isinstance(holder, list):
            holder.reverse()
        else:
            value = VALUES[rng.integers(len(VALUES))]
            holder[key] = copy.deepcopy(value)
            said[-1] += f" by {str(value)[:20]!r}"
        if not isinstance(content, dict | list) or not content:
            break
    return content, "; ".join(said)


def used(path: Path, folder: Path, name: str) -> int:
    """Everything that reads a result or an exported correction; how often it refused."""
    data = str(folder / ("v.csv" if name in ("direct", "closed") else "a.csv"))
    model = find_model("norm-diagonal") if data.endswith("v.csv") else None
    calls: list[Callable[[], Any]] = [
        lambda: corrected_csv(path, data, {}),
        lambda: corrected_csv(path, data, {}, force=True),
        lambda: of_another_time(path, data),
        lambda: applied(path, data, {}) if is_exported(path) else saved_result(path),
        *(lambda to=to: exported(path, to, force=True) for to in ("c", "python", "json")),
        lambda: exported(path, "json", run=1),
    ]
    if model is not None:
        calls += [
            lambda name=name: model.having(**{name: parse_value(name, f"@{path}", "--fix", model)})
            for name in ("scale", "offset")
        ]
    said = []
    for call in calls:
        try:
            call()
        except CasestError as error:
            said.append(str(error))
    assert all(said)
    return len(said)


EDITS = [12, pytest.param(75, marks=pytest.mark.long)]


@pytest.mark.parametrize("edits", EDITS)
@pytest.mark.parametrize(
    "name", [pytest.param("newton", marks=pytest.mark.long), "runs", "direct", "closed"]
)
def test_an_edited_result_gives_a_sentence_or_works(folder, tmp_path, name, edits):
    rng = np.random.default_rng(len(name))
    text = (folder / name / "result.json").read_text(encoding="utf-8")
    path, refused = tmp_path / "result.json", 0
    assert used(folder / name / "result.json", folder, name) <= 2
    for k in range(edits):
        content, said = edited(json.loads(text), rng)
        path.write_text(json.dumps(content), encoding="utf-8")
        try:
            refused += used(path, folder, name) > 0
        except Exception as error:
            pytest.fail(f"edit {k}: {said}: {type(error).__name__}: {error}")
    assert refused > 20 / 75 * edits


@pytest.mark.parametrize("edits", EDITS)
@pytest.mark.parametrize("name", ["newton", "direct"])
def test_an_edited_correction_gives_a_sentence_or_works(folder, tmp_path, name, edits):
    rng = np.random.default_rng(3 + len(name))
    text = (folder / f"{name}.json").read_text(encoding="utf-8")
    path = tmp_path / "correction.json"
    for k in range(edits):
        content, said = edited(json.loads(text), rng)
        path.write_text(json.dumps(content), encoding="utf-8")
        try:
            used(path, folder, name)
        except Exception as error:
            pytest.fail(f"edit {k}: {said}: {type(error).__name__}: {error}")


@pytest.mark.parametrize("which", range(len(TEXTS)))
@pytest.mark.parametrize("file", ["direct/result.json", "direct.json"])
def test_a_file_whose_text_is_damaged_gives_a_sentence_or_works(folder, tmp_path, file, which):
    text = TEXTS[which]((folder / file).read_text(encoding="utf-8"))
    path = tmp_path / Path(file).name
    path.write_text(text, encoding="utf-8")
    used(path, folder, "direct")


def change(content: Any, key: str, value: Any) -> None:
    *above, last = [int(k) if k.lstrip("-").isdigit() else k for k in key.split(".")]
    for step in above:
        content = content[step]
    content[last] = value


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("steps.0", ["inptu", 0, 0], "steps[0]: no operation is called 'inptu'"),
        ("steps.0", ["input", -1, 0], "steps[0]: there is no place -1"),
        ("steps.0", ["input", 10**9, 0], "steps[0]: there is no place 1000000000"),
        ("steps.0", ["input", 0, 7], "steps[0]: there is no input 7"),
        ("steps.0", ["constant", 0, "x"], "steps[0]: 'x' is no number"),
        ("steps.0", ["constant", 0, 10**400], "steps[0]: 1000000"),
        ("steps.0", ["add", 0, 0], "steps[0]: add has 1 operands"),
        ("steps.0", ["sin", 0, 0], "steps[0]: nothing is in register [0]"),
        ("steps.0", "add", "steps[0]: Expected `array`, got `str`"),
        ("steps", [], "fewer steps"),
        ("registers", 10**12, "registers: Expected `int` <= 100000"),
        ("inputs.0.size", 0, "inputs[0].size: Expected `int` >= 1"),
        ("inputs.0.size", 10**9, "inputs[0].size: Expected `int` <= 4096"),
        ("kind", "newtno", "kind: Invalid enum value 'newtno'"),
        ("newton.measured", [0, 9], "newton.measured: [0, 9] lies outside the inputs"),
        ("newton.measured", [-1, 1], "newton.measured: [-1, 1] lies outside the inputs"),
        ("newton.starts", [0.0] * 1000, "newton.starts: Expected `array` of length <= 100"),
        ("newton.largest", 0, "newton.largest: Expected `float` > 0.0"),
        ("newton", None, "newton: of newton"),
    ],
)
def test_what_is_wrong_in_a_program_is_named(folder, tmp_path, key, value, said):
    data = str(folder / "a.csv")
    shutil.copytree(folder / "newton", tmp_path / "out")
    result = json.loads((tmp_path / "out/result.json").read_text(encoding="utf-8"))
    change(result["correction"]["program"], key, value)
    (tmp_path / "out/result.json").write_text(json.dumps(result), encoding="utf-8")
    correction = json.loads((folder / "newton.json").read_text(encoding="utf-8"))
    change(correction["program"], key, value)
    (tmp_path / "c.json").write_text(json.dumps(correction), encoding="utf-8")
    for call in (
        lambda: corrected_csv(tmp_path / "out", data, {}),
        lambda: applied(tmp_path / "c.json", data, {}),
    ):
        with pytest.raises(CasestError) as refused:
            call()
        assert said in str(refused.value)
        assert "program" in str(refused.value)
        assert "calibrate or export again" in str(refused.value)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("trusted", "yes", "trusted: Expected `bool`, got `str`"),
        ("data", None, "data: Expected `array`, got `null`"),
        ("units.r", 3, "units[...]: Expected `str`, got `int`"),
        ("correction.signals", [], "correction.signals: none is the program's input 'r'"),
        ("correction.own", [[1.0]], "correction.own: not 1 numbers for each of 2 runs"),
        ("correction.range", [[0.0, 1.0]] * 9, "correction.range: not low and high of"),
        ("correction.range.0", [1.0, 0.0], "correction.range: not low and high of"),
        ("correction.readings.0.0", [1.0, 2.0], "correction.readings: 2 numbers in a row"),
        ("runs", ["a"], "runs"),
    ],
)
def test_what_is_wrong_in_a_result_is_named(folder, tmp_path, key, value, said):
    shutil.copytree(folder / "runs", tmp_path / "out")
    result = json.loads((tmp_path / "out/result.json").read_text(encoding="utf-8"))
    change(result, key, value)
    (tmp_path / "out/result.json").write_text(json.dumps(result), encoding="utf-8")
    with pytest.raises(CasestError) as refused:
        corrected_csv(tmp_path / "out", str(folder / "a.csv"), {})
    assert said in str(refused.value)


@pytest.mark.parametrize("key", ["value", "trusted"])
def test_values_or_trust_edited_by_hand_are_refused_for_the_correction_is_of_others(
    folder, tmp_path, capsys, key
):
    content = json.loads((folder / "direct" / "result.json").read_text(encoding="utf-8"))
    if key == "trusted":
        content["trusted"] = not content["trusted"]
    else:
        parameter = next(iter(content["estimate"]["parameters"].values()))
        parameter["value"] = json.loads(json.dumps(parameter["value"]).replace("1", "2"))
    (tmp_path / "result.json").write_text(json.dumps(content), encoding="utf-8")
    assert run(["export", str(tmp_path), "--to", "c", "--force"]) == 1
    assert "its parameters are not those that its correction was made from" in (
        capsys.readouterr().err
    )
