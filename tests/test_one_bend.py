"""What does the same has one name: bends over inputs of one sign, an angle of a few degrees; what
stands in the place of the inputs, or still where they go on, is called what it is."""

from __future__ import annotations

import numpy as np
import pytest

from casest import close
from casest.cli import run
from casest.data.checks import full_scales


def names(closing):
    return [e.candidate.label for e in closing.effects]


def skipped(closing):
    return {s.name: s.reason for s in closing.skipped}


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_over_inputs_above_zero_a_square_has_one_name(seed):
    rng = np.random.default_rng(seed)
    x = rng.uniform(1, 9, 200)
    reading = 0.4 + 1.02 * x + 0.02 * x**2 + rng.normal(0, 0.03, 200)
    closing = close("linear", {"reference": x, "reading": reading})
    assert names(closing) == ["quadratic"]
    (found,) = closing.effects
    assert "signed_quadratic" not in found.rivals
    assert skipped(closing)["signed_quadratic"] == "does here what quadratic does"
    both = close("linear", {"reference": x - 5, "reading": reading})
    assert "signed_quadratic" not in skipped(both)


def test_an_offset_of_the_reference_at_nothing_makes_no_second_bend():
    """Of a pyranometer, which reads a little less than nothing at night (strangers.md)."""
    rng = np.random.default_rng(7)
    x = np.r_[rng.uniform(1, 9, 150), np.full(150, -0.03)]
    reading = 0.4 + 1.02 * x + 0.02 * x**2 + rng.normal(0, 0.03, 300)
    closing = close("linear", {"reference": x, "reading": reading})
    assert names(closing) == ["quadratic"]
    assert skipped(closing)["signed_quadratic"] == "does here what quadratic does"


def test_a_constant_of_the_model_comes_before_an_effect_that_does_the_same():
    """A crystal's frequency over its temperature: a polynomial of the third degree."""
    rng = np.random.default_rng(1)
    x = np.linspace(20, 100, 24)
    reading = 50 + 9 * x - 0.11 * x**2 + 3.8e-4 * x**3 + rng.normal(0, 0.3, 24)
    closing = close("polynomial", {"reference": x, "reading": reading})
    assert names(closing) == ["cubic"]
    assert closing.after.values["cubic"] == pytest.approx(3.8e-4, abs=4e-5)
    assert skipped(closing)["quadratic"] == "does here what cubic does"


@pytest.mark.long
def test_an_angle_of_a_few_degrees_is_no_harmonic():
    """Twice per turn cannot be seen there, and would put the offset anywhere."""
    rng = np.random.default_rng(2)
    t = np.arange(600) / 30
    yaw = 40 * np.sin(0.5 * t)
    roll = 1.2 + 1.5 * np.sin(0.9 * t + 0.3)
    reading = 0.3 + 0.03 * yaw - 0.083 * roll + rng.normal(0, 0.05, 600)
    given = {"t": t, "reference": yaw, "reading": reading, "roll_deg": roll}
    closing = close("linear", given, units={"roll_deg": "deg"})
    assert names(closing) == ["channel_bias(roll_deg)"]
    assert closing.after.values["offset"] == pytest.approx(0.3 - 0.083 * 1.2, abs=0.1)


@pytest.mark.long
@pytest.mark.parametrize("top", [4095.0, 3800.0])
def test_a_ramp_that_ends_at_a_full_scale(tmp_path, capsys, top):
    """A converter on a slow ramp: it climbs count by count, and bends on the way."""
    rng = np.random.default_rng(3)
    x = np.linspace(100, 4000, 2000)
    bent = 20 + 1.06 * x - 3e-6 * (x - 2000) ** 2
    reading = np.minimum(np.round(bent + rng.normal(0, 0.4, 2000)), top)
    closing = close("linear", {"reference": x, "reading": reading})
    assert "saturation" in names(closing)
    assert closing.after.values["saturation.level"] == pytest.approx(top, abs=3)
    assert "dead_zone" not in names(closing)
    file = tmp_path / "ramp.csv"
    np.savetxt(file, np.c_[x, reading], delimiter=",", header="reference,reading", comments="")
    run(["calibrate", "linear", str(file), "-o", str(tmp_path / "out")])
    count = np.count_nonzero(reading == top)
    assert f"{count} readings at the largest value {top:g}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "count"),
    [
        (np.arange(120.0), 1),
        (np.r_[np.full(78, np.nan), np.arange(42.0)], 0),  # nothing beside what stands still
        (np.r_[np.zeros(78), np.arange(42.0)], 0),
    ],
)
def test_readings_that_stand_still_are_told_by_an_input_that_is_known_elsewhere_too(given, count):
    reading = np.r_[np.repeat(np.arange(40.0), 2), np.full(40, 39.0)]
    assert len(list(full_scales(reading[:, None], given[:, None]))) == count


def test_other_outputs_of_the_sensor_do_not_take_the_place_of_what_it_measures():
    """Dust by counts of three sizes beside a station somewhere else: the reading is computed of
    them, and damp air adds to all."""
    rng = np.random.default_rng(4)
    n = 1500
    station = np.exp(0.02 * rng.normal(size=n).cumsum() + 3)
    air = station * np.exp(0.3 * rng.normal(size=n))
    damp = 50 + 25 * np.sin(np.arange(n) / 35)
    sizes = {f"n{k}": air * c * np.exp(0.03 * rng.normal(size=n)) for k, c in enumerate((9, 3, 1))}
    reading = 0.05 * sizes["n0"] + 0.1 * sizes["n1"] + 0.2 * sizes["n2"] + 0.2 * damp
    given = {"reference": station, "reading": reading, "damp": damp, **sizes}
    closing = close("linear", given)
    before, after = (e.values["gain"] for e in (closing.before, closing.after))
    assert after == pytest.approx(before, rel=0.3)
    for name in sizes:
        assert "another meter" in skipped(closing)[name]


def test_a_column_called_t_that_goes_back_is_no_time_where_there_is_one(tmp_path, capsys):
    rng = np.random.default_rng(5)
    t = np.arange(300.0)
    x = np.sin(t / 20)
    file = tmp_path / "air.csv"
    table = np.c_[t, 20 + 5 * np.sin(t / 30), x, 2 * x + rng.normal(0, 0.01, 300)]
    np.savetxt(file, table, delimiter=",", header="time,t,reference,reading", comments="")
    run(["calibrate", "linear", str(file), "-o", str(tmp_path / "out")])
    assert "time not used" not in capsys.readouterr().out


def test_few_rows_say_how_few_they_are(tmp_path, capsys):
    rng = np.random.default_rng(6)
    x = np.linspace(1, 12, 12)
    file = tmp_path / "few.csv"
    table = np.c_[x, 2 * x + rng.normal(0, 0.1, 12)]
    np.savetxt(file, table, delimiter=",", header="reference,reading", comments="")
    run(["close", "linear", str(file), "-o", str(tmp_path / "out")])
    assert "adequate: nothing that 12 rows can show is missing" in capsys.readouterr().out
