"""What the user gives and asks for is answered: a record to be foretold, an effect by its name."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from casest import close
from casest.cli import run
from casest.estimate.held_out import times_larger


def warm(path, seed, follows):
    """Two records beside a temperature that rises; the reading follows it in one of them."""
    rng, t = np.random.default_rng(seed), 0.1 * np.arange(600)
    reference, temperature = rng.uniform(-5, 5, 600), 20 + 0.1 * t + 0.2 * rng.standard_normal(600)
    reading = 2 * reference + follows * (temperature - 20) + 0.1 * rng.standard_normal(600)
    table = np.column_stack([t, reference, reading, temperature])
    head = "t [s],reference,reading,temp [degC]"
    np.savetxt(path, table, delimiter=",", header=head, comments="")
    return str(path)


def headline(capsys, *words, model="linear"):
    assert run(["close", model, *words]) == 0
    return " ".join(capsys.readouterr().out.split("\n\n")[0].split())


def test_a_record_that_is_foretold_worse_is_named(tmp_path, capsys):
    one, other = (warm(tmp_path / f"{k}.csv", k, f) for k, f in ((1, 0.5), (2, 0.0)))
    said = headline(capsys, one, "--holdout", other)
    assert "temperature_bias" in said
    assert said.endswith("what is left is noise")
    assert f"but {other} is foretold worse with it" in said.replace("- ", "-")
    same = warm(tmp_path / "3.csv", 3, 0.5)
    assert "worse" not in headline(capsys, one, "--holdout", same)


def knocked(seed=0):
    """A pressure of a hundred rows that was raised for a while, and so was the temperature: beside
    the pulse it does nothing."""
    rng, t = np.random.default_rng(seed), 1.5 * np.arange(100)
    raised = ((np.arange(100) >= 18) & (np.arange(100) < 35)).astype(float)
    course = gaussian_filter1d(rng.standard_normal(100), 5) * np.sqrt(2 * np.sqrt(np.pi) * 5)
    temperature = 27 + 2.5 * raised + 1.2 * course + 0.02 * rng.standard_normal(100)
    pressure = 996 + 8.2 * raised + 0.6 * rng.standard_normal(100)
    return {"t": t, "reference": temperature, "reading": pressure}


def test_what_is_asked_for_takes_the_place_of_an_input():
    found = close("linear", knocked(), known={"pulse"})
    assert found.effects[0].candidate.label == "pulse"
    gain, std = float(found.after.values["gain"]), float(found.after.std["gain"])
    assert abs(gain) < 3 * std
    assert float(found.before.values["gain"]) > 1


@pytest.mark.parametrize("zero", [0.0, 12.6, -293.0])
def test_a_bend_is_the_same_wherever_the_input_is_counted_from(tmp_path, capsys, zero):
    """From 12.5 to 12.7 a square about zero is a line but for 2e-5."""
    rng = np.random.default_rng(5)
    x = rng.uniform(-0.1, 0.1, 60)
    y = 30 * x + 400 * x**2 + 0.2 * rng.standard_normal(60)
    path = tmp_path / "ruler.csv"
    table = np.column_stack([x + zero, y])
    np.savetxt(path, table, delimiter=",", header="reference,reading", comments="")
    assert run(["close", "linear", str(path), "--effects", "quadratic", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    (effect,) = found["effects"]
    assert effect["name"] == "quadratic"
    at = effect["numbers"]["at"]
    assert at == (pytest.approx(zero + x.mean(), rel=1e-5) if zero else 0)
    # The slope at the middle is the gain there, and the bend over the gain is what it is.
    values = {name: p["value"] for name, p in found["after"]["parameters"].items()}
    middle = values["gain"] * (1 + 2 * values["quadratic.k"] * (zero - at))
    assert middle == pytest.approx(30, abs=3)
    assert values["gain"] * values["quadratic.k"] == pytest.approx(400, abs=40)
    shown = "u + k·(u −" if zero else "u + k·u²"
    assert effect["formula"].startswith(shown)


@pytest.mark.long
@pytest.mark.parametrize("bend", [0.003, 0.03, 0.3])
def test_a_thermometer_in_kelvin_bends(bend):
    """Of 0.3 to 30 % over 270 to 310 K: about zero kelvin the gain would have to pass zero."""
    rng, t = np.random.default_rng(7), 0.1 * np.arange(400)
    x = np.sin(0.7 * t) * np.cos(0.13 * t)
    y = 1.02 * 20 * x + 20 * bend * x**2 + 0.01 * rng.standard_normal(400)
    found = close("linear", {"t": t, "reference": 290 + 20 * x, "reading": y})
    assert [e.candidate.label for e in found.effects] == ["quadratic"]
    assert found.verdict == "extended"
    assert found.after.rmse == pytest.approx(0.01, rel=0.1)


def foretold(rng, rows, level):
    """Errors of a line through 60 rows on those, and on `rows` others of a noise `level`."""
    x, there = rng.uniform(-1, 1, 60), rng.uniform(-1, 1, rows)
    y = 1 + 2 * x + rng.standard_normal(60)
    line = np.polynomial.Polynomial.fit(x, y, 1)
    other = 1 + 2 * there + level * rng.standard_normal(rows) - line(there)
    return [(y - line(x))[:, None]], [other[:, None]]


def test_of_records_alike_hardly_one_is_said_to_be_foretold_worse():
    """An F test at 0.001, and half as large again: of 2000 none but by what a line is not known."""
    rng = np.random.default_rng(11)
    for rows in (6, 60, 600):
        said = [times_larger(*foretold(rng, rows, 1.0), 58, 1.0) for _ in range(2000)]
        assert sum(s is not None for s in said) <= 6  # binomial at 0.001: one in 500 has more
    told = [times_larger(*foretold(rng, 60, 3.0), 58, 1.0) for _ in range(200)]
    assert np.mean([t is not None for t in told]) > 0.99
    assert np.median([t for t in told if t]) == pytest.approx(3.0, rel=0.1)
    fitted, other = foretold(rng, 60, 1.0)
    other[0][7] = 50.0
    assert times_larger(fitted, other, 58, 1.0) is None  # a spike


def test_a_record_with_another_gain_is_named_beside_adequate(tmp_path, capsys):
    rng, files = np.random.default_rng(3), []
    for gain in (2.0, 2.0, 2.2):
        x = rng.uniform(-5, 5, 80)
        files.append(str(tmp_path / f"{len(files)}.csv"))
        table = np.column_stack([x, gain * x + 0.1 * rng.standard_normal(80)])
        np.savetxt(files[-1], table, delimiter=",", header="reference,reading", comments="")
    first, alike, other = files
    assert "errors on" not in headline(capsys, first, "--holdout", alike)
    said = headline(capsys, first, "--holdout", other)
    assert said.startswith("linear on 0.csv: adequate")
    assert f"but errors on {other} are " in said.replace("- ", "-")
    assert float(said.rpartition(" are ")[2].split()[0]) == pytest.approx(5.7, rel=0.25)
    assert run(["calibrate", "linear", first, "--holdout", other]) == 0
    said = " ".join(capsys.readouterr().out.split("\n\n")[0].split())
    assert f"trusted; but errors on {other} are " in said.replace("- ", "-")


def test_what_is_asked_for_and_has_no_place_is_said_first_with_the_reason(tmp_path, capsys):
    """A model without a corrected quantity has no input on which a gain could act."""
    rng, path, model = np.random.default_rng(4), tmp_path / "rows.csv", tmp_path / "plain.py"
    model.write_text(
        "import casest as c\n"
        "@c.model\n"
        "def plain(x=c.signal('m'), y=c.signal('m'), *, a=c.param('m'), b=c.param(start=1.0)):\n"
        "    return c.Residual(measured=y, predicted=c.quantity('shown', a + b * x, 'm'))\n"
    )
    x, roll = rng.uniform(-1, 1, (2, 200))
    table = np.column_stack([x, 1 + 2 * x + 0.01 * rng.standard_normal(200), roll])
    np.savetxt(path, table, delimiter=",", header="x,y,roll", comments="")
    assert run(["close", str(model), str(path), "--effects", "channel_gain(roll)"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    refused = said.partition("channel_gain(roll) was not added: ")[2]
    assert refused.startswith("model plain declares no corrected quantity")


def test_what_remembers_is_not_tried_without_a_time_and_the_column_that_may_be_it_is_named(
    tmp_path, capsys
):
    rng, path, t = np.random.default_rng(6), tmp_path / "cell.csv", 0.5 * np.arange(300)
    load = 5.0 * (np.arange(300) // 60 % 2)
    crept = np.zeros(300)
    for k in range(1, 300):
        crept[k] = crept[k - 1] + (load[k - 1] - crept[k - 1]) * 0.5 / 20
    table = np.column_stack([t, load, 2 * load + 0.04 * crept + 0.005 * rng.standard_normal(300)])
    np.savetxt(path, table, delimiter=",", header="zeit [s],load [kg],reading [mV]", comments="")
    assert run(["close", "load-cell", str(path), "--effects", "creep"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "creep was not added: rows without a time are in no order" in said
    assert "if it is the time, say --columns t=zeit" in said
    said = headline(
        capsys, str(path), "--columns", "t=zeit", "--effects", "creep", model="load-cell"
    )
    assert "creep" in said.partition(":")[2].split(";")[0]


def test_a_lag_of_the_reference_is_left_in_and_said_where_readings_are_corrected(tmp_path, capsys):
    rng, t, path = np.random.default_rng(7), 0.05 * np.arange(800), tmp_path / "late.csv"
    x, late = (np.sin(0.9 * u) + np.sin(0.37 * u + 1) for u in (t, t - 0.3))
    table = np.column_stack([t, x, 0.2 + 1.1 * late + 0.01 * rng.standard_normal(800)])
    np.savetxt(path, table, delimiter=",", header="t,reference,reading", comments="")
    out = tmp_path / "out"
    assert run(["close", "linear", str(path), "-o", str(out)]) == 0
    capsys.readouterr()
    assert run(["apply", str(out), str(path), "-o", str(tmp_path / "corrected.csv")]) == 0
    assert "signal_lag(reference)" in capsys.readouterr().err
