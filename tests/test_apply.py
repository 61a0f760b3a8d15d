"""Corrections undo what lies between the corrected quantity and the reading."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import simulators as sim
from models.load_cell import curvature, load_cell, warming
from models.thermistor import thermistor
from models.wheel import quadratic, wheel

import casest
from casest import (
    DataError,
    Residual,
    Run,
    UsageError,
    calibrate,
    effect,
    model,
    param,
    quantity,
    signal,
)
from casest.cli import run
from casest.correction.inverse import Correction
from casest.effects import CATALOGUE
from casest.results.find import find_model


def as_run(**signals):
    columns = {n: np.asarray(s, float).reshape(len(s), -1) for n, s in signals.items()}
    return Run.raw("r", columns, units={}, file="r.csv")


def test_an_affine_explicit_model_is_inverted_exactly():
    rng = np.random.default_rng(0)
    force = rng.uniform(-20, 20, (50, 3))
    offset, gain = np.array([0.1, -0.2, 0.3]), np.array([1.02, 0.97, 1.01])
    found = Correction(wheel)(as_run(v=offset + gain * force), {"offset": offset, "gain": gain})
    np.testing.assert_allclose(found, force, rtol=1e-13, atol=1e-13)


def test_a_quadratic_effect_is_inverted_to_rounding():
    rng = np.random.default_rng(1)
    force = rng.uniform(-20, 20, (200, 3))
    k = np.array([1e-3, -2e-3, 5e-4])
    offset, gain = np.array([0.1, -0.2, 0.3]), np.array([1.02, 0.97, 1.01])
    reading = offset + gain * (force + k * force**2)
    values = {"offset": offset, "gain": gain, "quadratic.k": k}
    found = Correction(wheel.with_effect(quadratic))(as_run(v=reading), values)
    # what is corrected is the quantity as the body declares it: before its effects
    np.testing.assert_allclose(found, force, rtol=1e-11, atol=1e-11)


def test_of_two_solutions_the_one_in_the_range_of_the_fit_is_taken():
    bent = load_cell.with_effect(curvature)
    values = {"zero": 0.0, "sensitivity": 1.0, "curvature.k": -0.04}  # top at 12.5 N
    force = np.array([1.0, 5.0, 11.0])
    run = as_run(output=force - 0.04 * force**2)
    low = Correction(bent)(run, values, around=(0.0, 12.0))
    high = Correction(bent)(run, values, around=(13.0, 25.0))
    np.testing.assert_allclose(low[:, 0], force, rtol=1e-9)
    np.testing.assert_allclose(high[:, 0], 25 - force, rtol=1e-9)


def test_a_reading_out_of_reach_is_named_with_its_row():
    bent = load_cell.with_effect(curvature)
    values = {"zero": 0.0, "sensitivity": 1.0, "curvature.k": -0.04}  # at most 6.25 mV
    run = as_run(output=[1.0, 6.0, 7.0, 2.0, 6.5])
    with pytest.raises(DataError) as refused:
        Correction(bent)(run, values)
    text = str(refused.value)
    assert text.startswith("r.csv: row 2: reading [7.] has no force in the model (2 of 5 rows)")


def test_a_thermistor_gives_temperatures_back():
    kelvin = np.linspace(250, 370, 60)
    ohms = 10_000 * np.exp(3950 * (1 / kelvin - 1 / 298.15))
    values = {"r25": 10_000.0, "beta": 3950.0}
    found = Correction(thermistor)(as_run(resistance=ohms), values, around=(273.15, 353.15))
    np.testing.assert_allclose(found[:, 0], kelvin, rtol=1e-12)


def test_a_thermistor_gives_temperatures_back_without_knowing_the_range_of_the_fit():
    kelvin = np.linspace(250, 370, 60)
    ohms = 10_000 * np.exp(3950 * (1 / kelvin - 1 / 298.15))
    found = Correction(thermistor)(as_run(resistance=ohms), {"r25": 1e4, "beta": 3950.0})
    np.testing.assert_allclose(found[:, 0], kelvin, rtol=1e-12)


@pytest.mark.parametrize("name", ["norm-diagonal", "norm-triangular", "norm-full"])
def test_an_implicit_model_computes_its_correction(name):
    rng = np.random.default_rng(2)
    v, offset = rng.standard_normal((30, 3)), np.array([0.1, 0.2, -0.3])
    scale = np.diag([1.1, 0.9, 1.05])
    if name != "norm-diagonal":
        scale = scale + np.tril(0.1 * rng.standard_normal((3, 3)), -1)
    values = {"scale": np.diag(scale) if name == "norm-diagonal" else scale, "offset": offset}
    found = Correction(find_model(name))(as_run(v=v), values)
    np.testing.assert_allclose(found, (v - offset) @ scale.T, rtol=1e-13, atol=1e-14)


def test_a_correction_asks_only_for_the_signals_and_parameters_it_needs():
    assert [s.name for s in Correction(wheel).signals] == ["v"]
    assert Correction(wheel).parameters == {"offset", "gain"}
    assert [s.name for s in Correction(thermistor).signals] == ["resistance"]
    warm = Correction(load_cell.with_effect(warming))
    assert [s.name for s in warm.signals] == ["output", "temperature"]
    assert warm.parameters == {"zero", "sensitivity", "warming.drift"}


def test_an_effect_that_reads_a_column_is_undone_with_that_column():
    force, celsius = np.array([10.0, 20.0, 30.0]), np.array([10.0, 25.0, 40.0])
    reading = 0.5 + 0.1 * force + 0.02 * (celsius - 20)
    values = {"zero": 0.5, "sensitivity": 0.1, "warming.drift": 0.02}
    run = as_run(output=reading, temperature=celsius)
    found = Correction(load_cell.with_effect(warming))(run, values)
    np.testing.assert_allclose(found[:, 0], force, rtol=1e-12)


def test_an_effect_on_the_reading_itself_is_undone_too():
    @effect(on="output")
    def creep(output, *, k=param("1/mV")):
        return output + k * output**2

    output = np.array([1.0, 2.0, 3.0])
    values = {"zero": 0.5, "sensitivity": 0.1, "creep.k": 0.02}
    found = Correction(load_cell.with_effect(creep))(as_run(output=output), values)
    np.testing.assert_allclose(found[:, 0], (output + 0.02 * output**2 - 0.5) / 0.1, rtol=1e-12)


def test_a_model_that_names_no_corrected_quantity_says_so():
    @model
    def plain(y=signal("V"), *, a=param("V")):
        return Residual(measured=y, predicted=quantity("reading", a, "V"))

    with pytest.raises(UsageError, match="model plain names no corrected quantity"):
        Correction(plain)


def test_a_corrected_quantity_that_nothing_is_computed_from_is_named():
    @model
    def line(x=signal("1"), y=signal("V"), *, a=param("V"), b=param("V", start=1.0)):
        true = quantity("true", 2 * x, "1")
        return Residual(measured=y, predicted=a + b * x, corrected=true)

    with pytest.raises(UsageError, match="predicted does not depend on true, which corrected="):
        Correction(line)


def test_fewer_readings_than_components_are_refused():
    @model
    def projected(y=signal("V"), d=signal(3), *, a=param("V")):
        inner = quantity("field", 1.0 * d)
        return Residual(measured=y, predicted=a + inner[0] + inner[1], corrected=inner)

    with pytest.raises(UsageError, match="1 readings do not determine the 3 components of field"):
        Correction(projected)(as_run(y=[1.0], d=[[0, 0, 0]]), {"a": 1.0})


def test_an_effect_on_the_sequence_is_not_undone_in_silence():
    @effect(on="reading", kind="sequence")
    def low_pass(value, previous, dt, *, tau=param("s")):
        return previous + (value - previous) * dt / (dt + tau)

    with pytest.raises(UsageError, match="effect on the sequence of samples"):
        Correction(load_cell.with_effect(low_pass))


def test_what_follows_the_time_of_the_fitted_record_is_said_for_another_one(tmp_path, capsys):
    """A drift belongs to its record; the same file again is corrected for it without a word.

    Another one for what it was in the middle of that: force by hand, (reading − zero)/sensitivity.
    """
    rng = np.random.default_rng(3)
    for name in ("first", "other"):
        t, mass = np.arange(200) / 10, rng.uniform(0, 5, 200)
        reading = 0.5 + 0.1 * 9.81 * mass + 0.02 * t + 0.003 * rng.standard_normal(200)
        table = np.column_stack([t, mass, np.full(200, 20.0), reading])
        head = "t [s],mass [kg],temperature [degC],output [mV]"
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header=head, comments="")
    cell, out = str(Path(__file__).parent / "models" / "load_cell.py:load_cell"), tmp_path / "out"
    first, other = (str(tmp_path / f"{name}.csv") for name in ("first", "other"))
    assert run(["close", cell, first, "-o", str(out)]) == 0
    result, said, corrected = json.loads((out / "result.json").read_text("utf-8")), {}, {}
    for name in (first, other):
        capsys.readouterr()
        assert run(["apply", str(out), name, "-o", str(tmp_path / "c.csv")]) == 0
        said[name] = capsys.readouterr().err
        table = np.genfromtxt(tmp_path / "c.csv", delimiter=",", names=True)
        value = {n: p["value"] for n, p in result["after"]["parameters"].items()}
        t = np.arange(200) / 10 if name == first else 19.9 / 2
        plain = np.loadtxt(name, delimiter=",", skiprows=1)[:, 3] - value["bias_drift.k"] * t
        expected = (plain - value["zero"]) / value["sensitivity"]
        corrected[name] = table["force_N"]
        assert corrected[name] == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert "mean over that of what stayed: bias_drift" in said[other]
    assert "bias_drift" not in said[first]
    assert run(["export", str(out), "--to", "c", "-o", str(tmp_path / "c.c")]) == 0
    assert "mean over that of what stayed: bias_drift" in capsys.readouterr().err
    # In Python: the fitted record as a table, and the other one.
    found, tables = casest.load(out), [pd.read_csv(name) for name in (first, other)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        own = found(tables[0]).to_numpy().ravel()
    assert own == pytest.approx(corrected[first], rel=1e-8)
    with pytest.warns(UserWarning, match="bias_drift"):
        others = found(tables[1]).to_numpy().ravel()
    assert others == pytest.approx(corrected[other], rel=1e-8)


def test_an_effect_on_an_implicit_models_corrected_quantity_is_in_the_correction():
    """Fresh poses of a skew sensor have the known length: without its skew they would not."""
    rng = np.random.default_rng(5)
    sensor = sim.accelerometer(rng)
    skew = next(e for e in CATALOGUE if e.name == "cross_axis")
    whole = find_model("norm-diagonal").having(norm=sensor.norm).with_effect(skew, on="corrected")
    poses, fresh = (sensor.read(sim.spread_poses(n, rng), 0.0, rng) for n in (40, 25))
    found = calibrate(whole, [as_run(v=poses)])
    corrected = Correction(whole)(as_run(v=fresh), found.values)
    lengths = np.linalg.norm(corrected, axis=1)
    np.testing.assert_allclose(lengths, sensor.norm, rtol=1e-9)
    straight = (fresh - found.values["offset"]) * found.values["scale"]
    assert np.std(np.linalg.norm(straight, axis=1)) > 1e-3 * sensor.norm


@pytest.mark.parametrize("form", ["C", "Python", "apply"])
@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("Residual(measured=y, predicted=w, corrected=w)", "w, which corrected= names, is y as"),
        ("Residual(implicit=w - y, corrected=quantity('e', x))", "e, which corrected= names, is x"),
        ("Residual(implicit=w - y, corrected=quantity('e', 2 * a))", "is no signal's"),
    ],
    ids=["prediction", "input", "number"],
)
def test_a_correction_that_changes_nothing_is_refused(body, said, form, tmp_path, capsys):
    """The reference is calibrated against, and `corrected` names what is predicted of it."""
    (tmp_path / "m.py").write_text(
        "from casest import *\n@model\n"
        "def line(x=signal('m'), y=signal('m'), *, a=param('1')):\n"
        f"    '''A line.'''\n    w = quantity('w', a * x)\n    return {body}\n"
    )
    (tmp_path / "d.csv").write_text("x [m],y [m]\n1,2\n2,4.1\n3,6\n4,8.1\n")
    data, out = str(tmp_path / "d.csv"), str(tmp_path / "out")
    assert run(["calibrate", str(tmp_path / "m.py"), data, "-o", out]) == 0
    capsys.readouterr()
    assert run(["apply", out, data] if form == "apply" else ["export", out, "--to", form.lower()])
    printed = capsys.readouterr()
    assert printed.out == ""
    assert said in printed.err
    assert "nothing to correct" in printed.err


# -- readings that are not as those of the fit -----------------------------------------------------


def spheres(folder, **headers):
    """The same readings of ±9.8 m/s² under headers of several units, `name="[g]"`, and a fit of
    those called `fitted`."""
    rng = np.random.default_rng(0)
    v = rng.standard_normal((40, 3))
    v = 9.8 * v / np.linalg.norm(v, axis=1)[:, None] + [0.3, 0.2, -0.1]
    v += 0.01 * rng.standard_normal(v.shape)
    for name, (unit, factor) in headers.items():
        head = ",".join(f"v{a}{unit}" for a in "xyz")
        np.savetxt(folder / f"{name}.csv", factor * v, "%.9f", ",", header=head, comments="")
    fit = ["calibrate", "norm-diagonal", str(folder / "fitted.csv"), "--set", "norm=9.8"]
    assert run([*fit, "-o", str(folder / "out")]) == 0


def correcting(folder, data, capsys):
    """Exit code, corrected values and what is said."""
    capsys.readouterr()
    code = run(["apply", str(folder / "out"), str(folder / data)])
    said = capsys.readouterr()
    rows = [[float(x) for x in line.split(",")[-3:]] for line in said.out.splitlines()[1:]]
    return code, np.array(rows), " ".join(said.err.split())


def test_readings_in_another_unit_than_those_of_the_fit_are_converted(tmp_path, capsys):
    spheres(tmp_path, fitted=(" [m/s^2]", 1), g=(" [g]", 1 / 9.80665), mm=(" [mm/s^2]", 1e3))
    expected = correcting(tmp_path, "fitted.csv", capsys)[1]
    assert np.linalg.norm(expected, axis=1) == pytest.approx(9.8, abs=0.05)
    for other in ("g.csv", "mm.csv"):
        code, found, said = correcting(tmp_path, other, capsys)
        assert (code, said) == (0, "")
        np.testing.assert_allclose(found, expected, atol=1e-7)


def test_readings_in_a_unit_that_does_not_convert_are_refused(tmp_path, capsys):
    spheres(tmp_path, fitted=(" [m/s^2]", 1), tesla=(" [T]", 1), raw=(" [count]", 1))
    for other, unit in (("tesla.csv", "T"), ("raw.csv", "count")):
        code, _, said = correcting(tmp_path, other, capsys)
        assert code == 1
        assert f"{other}: column vx is in {unit} and signal v wants m/s^2" in said


def test_a_unit_that_only_one_of_fit_and_data_states_is_said(tmp_path, capsys):
    spheres(tmp_path, fitted=(" [m/s^2]", 1), silent=("", 1))
    code, _, said = correcting(tmp_path, "silent.csv", capsys)
    assert code == 0
    assert "v: no unit stated for vx vy vz, taken as m/s^2" in said
    spheres(tmp_path, fitted=("", 1), stated=(" [g]", 1))
    code, _, said = correcting(tmp_path, "stated.csv", capsys)
    assert code == 0
    assert "v is in g; nobody stated the unit of v when the result was made" in said


def test_readings_far_from_what_the_calibration_saw_are_counted_once(tmp_path, capsys):
    spheres(tmp_path, fitted=(" [m/s^2]", 1), near=(" [m/s^2]", 1.02), far=(" [m/s^2]", 1.5))
    assert correcting(tmp_path, "near.csv", capsys)[2] == ""
    readings = np.loadtxt(tmp_path / "fitted.csv", delimiter=",", skiprows=1)
    margin = 0.1 * np.ptp(readings, axis=0)
    low, high = readings.min(axis=0) - margin, readings.max(axis=0) + margin
    outside = ((1.5 * readings < low) | (1.5 * readings > high)).any(axis=1).sum()
    assert 10 < outside < 40
    _, _, said = correcting(tmp_path, "far.csv", capsys)
    assert said.startswith(f"casest: {outside} of 40 rows lie outside what the calibration saw")
    x = readings[:, 0]
    ranges = f"vx {1.5 * x.min():.4g} to {1.5 * x.max():.4g} ({x.min():.4g} to {x.max():.4g}), vy "
    assert ranges in said
    assert said.count("extrapolates") == 1


def test_a_temperature_beyond_those_of_the_fit_is_said(tmp_path, capsys):
    rng = np.random.default_rng(1)
    v = rng.standard_normal((60, 3))
    v = 9.8 * v / np.linalg.norm(v, axis=1)[:, None]
    temp = rng.uniform(20, 30, 60)
    reading = v + np.outer(temp - 25, [0.02, -0.01, 0.03]) + 0.005 * rng.standard_normal(v.shape)
    head = "vx [m/s^2],vy [m/s^2],vz [m/s^2],temp"
    for name, shift, unit in (("a", 0, "degC"), ("hot", 40, "degC"), ("kelvin", 273.15, "K")):
        table, named = np.column_stack([reading, temp + shift]), f"{head} [{unit}]"
        np.savetxt(tmp_path / f"{name}.csv", table, "%.9f", ",", header=named, comments="")
    fit = ["calibrate", "norm-diagonal", str(tmp_path / "a.csv"), "--set", "norm=9.8"]
    asked = ["--effects", "temperature_bias(temp)", "-o", str(tmp_path / "out")]
    assert run([*fit, *asked]) == 0
    expected = correcting(tmp_path, "a.csv", capsys)[1]
    _, found, said = correcting(tmp_path, "kelvin.csv", capsys)
    assert said == ""
    np.testing.assert_allclose(found, expected, atol=1e-7)
    said = correcting(tmp_path, "hot.csv", capsys)[2]
    assert "60 of 60 rows lie outside what the calibration saw, in brackets: temp 6" in said
