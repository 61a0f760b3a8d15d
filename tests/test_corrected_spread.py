"""Standard deviations of corrected readings, against the same calibration done many times over."""

from __future__ import annotations

import csv
import importlib.util
import io
import shutil
import subprocess

import numpy as np
import pytest

import casest as c
from casest.cli import run
from casest.leastsquares.stated import stated_noise
from casest_problems.norm import norm_triangular

LOADCELL = '''
from casest import Residual, constant, model, param, quantity, signal


@model
def cell(
    mass=signal("kg"), reading=signal("mV"), *,
    zero=param("mV"), gain=param("mV/N", start=1.0), bend=param("mV/N^2"),
    gravity=constant(9.8, "m/s^2", std=0.02),
):
    """A bent load cell."""
    force = quantity("force", mass * gravity, "N")
    told = quantity("told", zero + gain * force + bend * force**2, "mV")
    return Residual(measured=reading, predicted=told, corrected=force)
'''
HEADER = "mass [kg],reading [mV]"
TRUE, MASSES, NOISE = (0.3, 2.0, 0.002), np.linspace(0, 10, 15), 0.05


def readings_of(mass, gravity, rng, noise=NOISE):
    force = np.asarray(mass) * gravity
    told = TRUE[0] + TRUE[1] * force + TRUE[2] * force**2
    return told + noise * rng.standard_normal(force.shape)


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A calibrated cell, and readings to correct."""
    folder = tmp_path_factory.mktemp("cell")
    (folder / "cell.py").write_text(LOADCELL)
    rng = np.random.default_rng(1)
    for name, mass in (("fit", MASSES), ("new", np.array([0.5, 5.0, 9.0]))):
        table = np.column_stack([mass, readings_of(mass, 9.8, rng)])
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=HEADER, comments="")
    noise = ["--sensor-noise", f"reading={NOISE}"]
    given = ["calibrate", f"{folder}/cell.py", f"{folder}/fit.csv", *noise, "-o", f"{folder}/out"]
    assert run(given) == 0
    return folder


def applied(folder, capsys, what="out"):
    capsys.readouterr()
    assert run(["apply", f"{folder}/{what}", f"{folder}/new.csv", "--with-std"]) == 0
    return list(csv.DictReader(io.StringIO(capsys.readouterr().out)))


def test_the_parts_are_what_repeated_calibrations_scatter_by(cell, capsys):
    """Each trial: another gravity, other readings, a fit by NumPy, a reading corrected by it."""
    rows = applied(cell, capsys)
    new = np.array([float(r["reading [mV]"]) for r in rows])
    rng, trials = np.random.default_rng(2), []
    made = [readings_of(MASSES, 9.8 + 0.02 * rng.standard_normal(), rng) for _ in range(4000)]
    for fit in np.polynomial.polynomial.polyfit(MASSES * 9.8, np.transpose(made), 2).T:
        x = new + NOISE * rng.standard_normal(3)
        b, a = fit[1], fit[2]
        trials.append((-b + np.sqrt(b**2 - 4 * a * (fit[0] - x))) / (2 * a))
    scatter = np.std(trials, axis=0)
    std = np.array([float(r["force_std [N]"]) for r in rows])
    assert std == pytest.approx(scatter, rel=0.05)
    parts = [
        [float(r[f"force_std_{part} [N]"]) for r in rows]
        for part in ("parameters", "noise", "reference")
    ]
    assert np.sqrt(np.sum(np.square(parts), axis=0)) == pytest.approx(std, rel=1e-8)


def test_python_and_json_give_the_same(cell, capsys):
    rows = applied(cell, capsys)
    assert run(["export", f"{cell}/out", "--to", "json", "--with-std", "-o", f"{cell}/c.json"]) == 0
    assert applied(cell, capsys, "c.json") == rows
    assert (
        run(["export", f"{cell}/out", "--to", "python", "--with-std", "-o", f"{cell}/corr.py"]) == 0
    )
    spec = importlib.util.spec_from_file_location("corr", cell / "corr.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found = module.spread(np.array([[float(r["reading [mV]"])] for r in rows]))
    std = [float(r["force_std [N]"]) for r in rows]
    assert found[:, 3] == pytest.approx(std, rel=1e-8)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_c_gives_the_same(cell, capsys):
    rows = applied(cell, capsys)
    assert run(["export", f"{cell}/out", "--to", "c", "--with-std", "-o", f"{cell}/corr.c"]) == 0
    values = ", ".join(r["reading [mV]"] for r in rows)
    (cell / "main.c").write_text(
        '#include <stdio.h>\n#include "corr.c"\n'
        f"int main(void) {{ double x[] = {{{values}}}, f[1], s[4];\n"
        "for (int k = 0; k < 3; ++k) { correct_cell(x + k, f); correct_cell_std(x + k, f, s);\n"
        'printf("%.12g %.12g\\n", s[0], s[3]); } return 0; }\n'
    )
    subprocess.run(
        ["cc", "-std=c99", "-Wall", "-Werror", "main.c", "-lm", "-o", "main"], cwd=cell, check=True
    )
    said = subprocess.run([str(cell / "main")], capture_output=True, text=True, check=True).stdout
    found = np.array([line.split() for line in said.splitlines()], dtype=float)
    assert found[:, 0] == pytest.approx([float(r["force_std_parameters [N]"]) for r in rows])
    assert found[:, 1] == pytest.approx([float(r["force_std [N]"]) for r in rows])


def test_an_exported_correction_without_std_says_so(cell, capsys):
    assert run(["export", f"{cell}/out", "--to", "json", "-o", f"{cell}/plain.json"]) == 0
    assert run(["apply", f"{cell}/plain.json", f"{cell}/new.csv", "--with-std"]) == 1
    assert "it was exported without --with-std" in capsys.readouterr().err


@pytest.mark.long
def test_intervals_of_corrected_readings_hold_the_truth():
    """A norm with noise of its own on every axis: 25 calibrations, 100 fresh readings of each."""
    from casest.correction import runtime
    from casest.correction.numpy_module import as_data
    from casest.correction.spread import slopes, spread_program

    rng, std = np.random.default_rng(7), np.array([0.02, 0.05, 0.1])
    scale = np.array([[1, 0, 0], [0.02, 1.03, 0], [-0.01, 0.015, 0.98]])
    offset, held = np.array([0.3, -0.2, 0.1]), []
    for _ in range(25):
        u = rng.standard_normal((130, 3))
        force = 9.81 * u / np.linalg.norm(u, axis=1)[:, None]
        v = force @ np.linalg.inv(scale).T + offset + std * rng.standard_normal(u.shape)
        stated = 9.81 + 0.02 * rng.standard_normal()
        model = norm_triangular.having(norm=c.constant(stated, std=0.02))
        record = c.Run.raw("r", {"v": v[:30]}, units={"v": "1"})
        found = c.calibrate(*stated_noise(model, [record], {"v": [std]}))
        program = spread_program(found, slopes(found, {}), {}, "corrected")
        got = (v[30:] - found.values["offset"]) @ found.values["scale"].T
        spread = runtime.attempted(as_data(program), np.hstack([v[30:], got]))[:, -3:]
        held.append(np.abs(got - force[30:]) < 1.959964 * spread)
    assert 0.94 < np.mean(held) < 0.96


def test_a_correction_is_traced_once_for_all_that_a_result_says_of_it(monkeypatch):
    """Tracing is what takes time; std and budget of a corrected reading ask for the same one."""
    from casest.correction import inverse
    from casest.results.calibration import calibration_result

    @c.model
    def cell(load=c.signal("N"), v=c.signal("V"), *, gain=c.param("V/N", start=1.0)):
        """A straight line."""
        force = c.quantity("force", load, "N")
        return c.Residual(measured=v, predicted=gain * force, corrected=force)

    load = np.arange(1.0, 9.0)[:, None]
    record = c.Run.raw("r", {"load": load, "v": 2 * load + 0.01 * np.sin(9 * load)}, units={})
    found, calls, whole = c.attempt(cell, [record]), [], inverse.trace
    monkeypatch.setattr(inverse, "trace", lambda *a, **k: calls.append(k) or whole(*a, **k))
    result = calibration_result(found, model_name="cell", data=["r"])
    assert len(calls) == 1
    assert result.content()["corrected_budget"]["std"][0] > 0
