"""Models that cannot be solved: each ends with a statement, exit code 2, and nothing trusted."""

from __future__ import annotations

import json

import numpy as np
import pytest

from casest.cli import run
from casest.solve import global_search, many_descents, strategy
from casest.solve.trust_region import trust_region

HEAD = """
import os, signal as signals
from casest import Residual, exp, log, model, param, quantity, signal, sqrt
"""
BODIES = {
    "not finite at the start": (
        "a=param(start=-1.0), b=param(start=1.0)",
        "b * log(a * x)",
        "not finite at the start values in 40 of 40 rows",
    ),
    "not finite in part of the data": (
        "a=param(start=1.0), b=param(start=1.0)",
        "a + b * log(x - 3)",
        "not finite at the start values in 7 of 40 rows, first in",
    ),
    "a column that is zero": (
        "a=param(start=1.0), b=param(start=1.0), c=param()",
        "a + b * x + 0 * c * x",
        "`c` changes no residual",
    ),
    "no minimum": (
        "a=param(start=1.0), b=param(start=1.0)",
        "y - exp(-a * (1 + b**2))",
        "not",
    ),
}


@pytest.fixture
def line(tmp_path):
    """A noisy straight line, 40 rows."""
    rng = np.random.default_rng(1)
    x = np.arange(40) / 2
    table = np.column_stack([x, 1 + 2 * x + 0.1 * rng.standard_normal(40)])
    np.savetxt(tmp_path / "d.csv", table, delimiter=",", header="x,y", comments="")
    return tmp_path


def declared(folder, parameters, expression, more=""):
    lines = [
        HEAD,
        "@model",
        f'def bad(x=signal("1"), y=signal("1"), *, {parameters}):',
        '    """A model."""',
        f'    return Residual(measured=y, predicted=quantity("p", {expression}, ""))',
        more,
    ]
    (folder / "m.py").write_text("\n".join(lines))
    return str(folder / "m.py")


def fitted(folder, path):
    code = run(["calibrate", path, str(folder / "d.csv"), "-o", str(folder / "out")])
    return code, json.loads((folder / "out" / "result.json").read_text())


@pytest.mark.parametrize("case", BODIES)
def test_what_cannot_be_solved_is_refused_with_the_reason(case, line, capsys):
    parameters, expression, words = BODIES[case]
    code, result = fitted(line, declared(line, parameters, expression))
    shown = capsys.readouterr()
    assert code == 2
    assert result["trusted"] is False
    assert result["verdict"] is None
    assert any(words in reason for reason in result["estimate"]["certificate"]["reasons"])
    assert shown.err.startswith("casest: no trustworthy estimate: ")
    assert shown.err.count("\n") == 1


def test_scales_that_differ_by_1e12_are_no_obstacle(line):
    path = declared(line, "a=param(start=1e-6), b=param(start=1e6)", "a * 1e6 * x + b * 1e-6")
    code, result = fitted(line, path)
    found = result["estimate"]["parameters"]
    assert code == 0
    assert abs(found["a"]["value"] - 2e-6) < 4 * found["a"]["std"]
    assert abs(found["b"]["value"] - 1e6) < 4 * found["b"]["std"]


def test_a_point_that_is_not_finite_on_the_way_is_stepped_back_from(line, capsys):
    """√(b − x): a full step would leave the domain."""
    table = np.loadtxt(line / "d.csv", delimiter=",", skiprows=1)
    y = 3 * np.sqrt(25 - table[:, 0]) + 0.01 * np.random.default_rng(2).standard_normal(40)
    np.savetxt(line / "d.csv", np.c_[table[:, 0], y], delimiter=",", header="x,y", comments="")
    path = declared(line, "a=param(start=0.1), b=param(start=400.0)", "a * sqrt(b - x)")
    code, result = fitted(line, path)
    assert code == 0
    assert abs(result["estimate"]["parameters"]["b"]["value"] - 25) < 0.5
    assert "WARNING" not in capsys.readouterr().err


def test_a_start_that_cannot_be_computed_is_no_traceback(line, capsys):
    more = """
import numpy
def begin(model, runs):
    return {"a": numpy.linalg.inv(numpy.zeros((2, 2)))}
bad = bad.starting(begin)
"""
    path = declared(line, "a=param(start=1.0), b=param(start=1.0)", "a + b * x", more)
    code, result = fitted(line, path)
    shown = capsys.readouterr().err
    assert code == 2
    assert (result["trusted"], result["verdict"]) == (False, None)
    assert "no start values follow from these readings (Singular matrix)" in shown


def test_a_solver_that_runs_out_of_iterations_is_not_trusted(line, monkeypatch, capsys):
    """Twenty iterations would do from this start; none of the ways is given more than one."""

    def hasty(problem, start, **options):
        return trust_region(problem, start, **{**options, "max_iterations": 1})

    for ways in (strategy, global_search):
        monkeypatch.setattr(ways, "trust_region", hasty)
    monkeypatch.setattr(many_descents, "STEPS", 1)
    path = declared(line, "a=param(start=40.0), b=param(start=-6.0)", "a * exp(b * x / 10)")
    model = [path, str(line / "d.csv"), "--solver", "trust-region", "-o", str(line / "out")]
    code = run(["calibrate", *model])
    result = json.loads((line / "out" / "result.json").read_text())
    assert code == 2
    assert result["trusted"] is False
    assert "not a stationary point" in result["estimate"]["certificate"]["reasons"][0]
    assert "standard deviations long" in capsys.readouterr().err
