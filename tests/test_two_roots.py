"""A reading that two values give: the one in the range of the fit, in every form of export."""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from casest.cli import run as command

#: y = 50x − x² falls from 25 on: the fit saw 30 to 46, and 4 to 20 read the same.
BENT = '''
from casest import Residual, model, param, quantity, signal


@model
def bent(x=signal("V"), y=signal("V^2"), *, a=param("V", start=40.0), b=param(start=-0.9)):
    """A characteristic that is used beyond its top."""
    value = quantity("value", x, "V")
    return Residual(measured=y, predicted=a * value + b * value**2, corrected=value)
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("bent")
    (found / "bent.py").write_text(BENT, encoding="utf-8")
    x = np.linspace(30.0, 46.0, 40)
    y = 50 * x - x**2 + 1e-3 * np.random.default_rng(0).standard_normal(40)
    rows = np.column_stack([x, y])
    np.savetxt(found / "data.csv", rows, delimiter=",", header="x [V],y [V^2]", comments="")
    fit = ["calibrate", str(found / "bent.py"), str(found / "data.csv"), "-o", str(found / "out")]
    assert command(fit) == 0
    return found


def by_c(folder, single):
    """The exported source as a shared library: values (N,), NaN where it says 1."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler")
    source, library = folder / "bent.c", folder / ("single.so" if single else "double.so")
    flags = ["--float"] if single else []
    assert command(["export", str(folder / "out"), "--to", "c", *flags, "-o", str(source)]) == 0
    subprocess.run([compiler, "-O1", "-shared", "-fPIC", str(source), "-lm", "-o", str(library)],
                   check=True)  # fmt: skip
    text = source.read_text(encoding="utf-8")
    name = text.partition("int ")[2].partition("(")[0]
    real = ctypes.c_float if single else ctypes.c_double
    function = getattr(ctypes.CDLL(str(library)), name)

    def corrected(y):
        found = []
        for value in y:
            x = (real * 1)()
            code = function((real * 1)(value), x)
            found.append(x[0] if code == 0 else np.nan)
        return np.array(found)

    return corrected


def by_python(folder):
    assert (
        command(["export", str(folder / "out"), "--to", "python", "-o", str(folder / "b.py")]) == 0
    )
    code = "import json, sys, b; print(json.dumps(b.correct(json.load(sys.stdin)).tolist()))"

    def corrected(y):
        given = json.dumps(np.reshape(y, (-1, 1)).tolist())
        done = subprocess.run([sys.executable, "-c", code], input=given, cwd=folder,
                              capture_output=True, text=True, check=False)  # fmt: skip
        if done.returncode:
            assert "outside what the model can produce" in done.stderr
            return np.full(len(y), np.nan)
        return np.array(json.loads(done.stdout))[:, 0]

    return corrected


def by_apply(folder, capsys, result):
    def corrected(y):
        path = folder / "new.csv"
        np.savetxt(path, y, header="y [V^2]", comments="")
        capsys.readouterr()
        code = command(["apply", str(result), str(path)])
        said = capsys.readouterr()
        if code:
            assert "outside what the model can produce" in said.err
            return np.full(len(y), np.nan)
        return np.array([float(line.split(",")[-1]) for line in said.out.splitlines()[1:]])

    return corrected


@pytest.mark.parametrize("form", ["c", "float", "python", "json", "apply"])
def test_of_two_roots_the_one_in_the_range_of_the_fit_is_given(folder, form, capsys):
    """The quadratic's own two roots; the other one is nearer to zero."""
    corrected = {
        "c": lambda: by_c(folder, False),
        "float": lambda: by_c(folder, True),
        "python": lambda: by_python(folder),
        "apply": lambda: by_apply(folder, capsys, folder / "out"),
        "json": lambda: by_apply(folder, capsys, as_json(folder)),
    }[form]()
    true = np.array([27.0, 31.0, 38.0, 45.0, 49.0])
    a, b = fitted(folder)
    y = a * true + b * true**2
    other = -a / b - true
    assert np.all(np.abs(other) < true)
    tolerance = 2e-3 if form == "float" else 1e-6
    np.testing.assert_allclose(corrected(y), true, atol=tolerance)
    top = -(a**2) / b / 4
    assert np.isnan(corrected(np.array([1.01 * top]))).all()
    # Just below the top the two lie beside each other: 25 ± 0.5 by the numbers of the model.
    assert corrected(np.array([top + b * 0.25]))[0] == pytest.approx(-a / b / 2 + 0.5, abs=0.01)


def as_json(folder):
    path = folder / "bent.json"
    assert command(["export", str(folder / "out"), "--to", "json", "-o", str(path)]) == 0
    return path


def fitted(folder):
    result = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    found = result["estimate"]["parameters"]
    return found["a"]["value"], found["b"]["value"]
