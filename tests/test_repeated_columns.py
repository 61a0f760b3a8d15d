"""Columns that record once more what the model reads name no cause; an influence still does."""

from __future__ import annotations

import numpy as np
import pytest

from casest import close
from casest.results.find import find_model

ROWS = 600


@pytest.fixture
def record():
    """A load that sways, and its reading: 0.2 + 3 x, noise 0.05; nothing is missing."""
    rng = np.random.default_rng(20261123)
    t = np.arange(ROWS) / 10
    reference = 5 * np.sin(t / 3) + 0.05 * rng.normal(size=ROWS).cumsum()
    reading = 0.2 + 3 * reference + rng.normal(0, 0.05, ROWS)
    return {"t": t, "reference": reference, "reading": reading}


def warm(t):
    return 25 + 4 * np.sin(0.11 * t) + 2 * np.sin(0.31 * t)


def skipped(closing):
    return {s.name: s.reason for s in closing.skipped}


@pytest.mark.parametrize("step", [1000, 20])
def test_raw_counts_of_the_reading_explain_nothing(record, step):
    """A gain of nothing, and all of the reading explained by itself, is no calibration."""
    closing = close("linear", {**record, "raw": np.round((record["reading"] - 1) * step)})
    assert not closing.effects
    assert closing.after.values["gain"] == pytest.approx(3, abs=0.005)
    assert "once more" in skipped(closing)["raw"]


def test_a_second_meter_of_the_reference_explains_nothing(record):
    meter = 0.1 + record["reference"] * (1 + np.random.default_rng(1).normal(0, 1e-3, ROWS))
    closing = close("linear", {**record, "meter": meter})
    assert not closing.effects
    assert "column is reference once more" in skipped(closing)["meter"]


@pytest.mark.long
def test_a_meter_beside_the_reading_explains_nothing(record):
    """Of two thermometers in one box each tells the other better than the weather station does."""
    rng = np.random.default_rng(6)
    box = record["reference"] + 1.5 * np.sin(0.7 * record["t"])  # what the station does not see
    reading = 0.2 + 3 * box + rng.normal(0, 0.02, ROWS)
    given = {**record, "reading": reading, "beside": box + rng.normal(0, 0.3, ROWS)}
    closing = close("linear", given)
    assert "column tells reading better than its inputs do" in skipped(closing)["beside"]
    assert closing.after.values["gain"] == pytest.approx(3, abs=0.1)


@pytest.mark.long
def test_a_temperature_that_is_most_of_the_reading_is_found_where_the_load_hardly_moves(record):
    """Then the reading follows it within a part in a thousand, and is not that temperature."""
    still = 0.01 * record["reference"]
    temperature = warm(record["t"])
    noise = record["reading"] - 0.2 - 3 * record["reference"]
    reading = 0.2 + 3 * still + 2 * (temperature - 25) + 0.05 * noise
    given = {**record, "reference": still, "reading": reading, "temperature": temperature}
    closing = close("linear", given)
    assert [e.candidate.label for e in closing.effects] == ["temperature_bias(temperature)"]
    assert closing.after.values["gain"] == pytest.approx(3, abs=0.05)


def test_raw_counts_of_a_reading_that_no_input_tells_explain_nothing(record):
    """Its noise is theirs."""
    rng = np.random.default_rng(2)
    quiet = np.full(ROWS, 1.0) + rng.normal(0, 1e-3, ROWS)
    reading = 0.2 + 3 * quiet + rng.normal(0, 0.05, ROWS)
    given = {**record, "reference": quiet, "reading": reading, "raw": np.round(1e4 * reading)}
    assert not close("linear", given).effects


@pytest.mark.parametrize("whole", [True, False])
def test_what_rises_wherever_the_reading_does_explains_nothing(record, whole):
    """The reading is a logarithm of it, to the next count or not."""
    raw = 1e3 * np.exp(record["reading"] / 5)
    closing = close("linear", {**record, "raw": np.round(raw) if whole else -raw})
    assert not closing.effects
    assert closing.after.values["gain"] == pytest.approx(3, abs=0.005)
    assert "column is reading once more" in skipped(closing)["raw"]


@pytest.mark.long
def test_of_columns_that_go_with_the_input_none_is_claimed_where_the_response_bends(record):
    """Set value, current and meter of a lamp: what they do can be a bend, and is one."""
    rng = np.random.default_rng(3)
    x = record["reference"]
    lamp = {f"c{k}": x + 0.01 * k * x**2 + rng.normal(0, 0.1, ROWS) for k in (1, -1)}
    reading = record["reading"] + 0.03 * x**2
    closing = close("linear", {**record, **lamp, "reading": reading})
    assert [e.candidate.label for e in closing.effects] == ["quadratic"]
    for name in lamp:
        assert "goes with reference: what follows it could be a bend" in skipped(closing)[name]


@pytest.mark.parametrize("digits", [6, 2])
def test_a_magnitude_that_was_computed_from_the_axes_explains_nothing(digits):
    """As telephones log it."""
    rng = np.random.default_rng(4)
    d = rng.normal(size=(300, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    v = 9.81 * d * [1, 1.01, 0.99] + [0.1, 0.2, 0.3] + rng.normal(0, 0.02, (300, 3))
    total = np.round(np.linalg.norm(v, axis=1), digits)
    model = find_model("norm-diagonal").having(norm=9.81)
    closing = close(model, {"v": v, "absolute": total})
    assert not closing.effects
    assert closing.result.verdict == "adequate"
    np.testing.assert_allclose(closing.after.values["offset"], [0.1, 0.2, 0.3], atol=0.01)


def test_a_second_clock_is_the_time(record):
    """What goes with it goes with time."""
    drifting = record["reading"] + 0.004 * record["t"]
    clock = np.round(1000 * record["t"]) + 123456
    closing = close("linear", {**record, "reading": drifting, "millis": clock})
    assert [e.candidate.label for e in closing.effects] == ["bias_drift"]
    assert "copy of t" in skipped(closing)["millis"]


def bent_table(rows=35):
    """A foot, a slope and a plateau, as of an attenuator: no shape of the catalogue."""
    rng, x = np.random.default_rng(8), np.linspace(-1, 1, rows)
    return x, 100 * np.tanh(2 * x) + rng.normal(0, 1.0, rows), rng


@pytest.mark.long
def test_of_few_rows_a_column_that_goes_with_the_input_is_no_influence():
    """A position on a stage, in proportion to the input but for 15 %: its curve is the bend's."""
    x, y, rng = bent_table()
    position = 1000 * (x + 0.1 * rng.standard_normal(len(x)))
    closing = close("linear", {"reference": x, "reading": y, "position": position})
    assert "could be a bend" in skipped(closing)["position"]
    assert not [e for e in closing.effects if e.candidate.column]


@pytest.mark.long
def test_a_column_that_is_named_as_an_uncertainty_is_no_influence():
    x, y, rng = bent_table()
    error = 2 + 0.05 * np.abs(y) + rng.normal(0, 1.5, len(x))
    closing = close("linear", {"reference": x, "reading": y, "std err": error})
    assert "uncertainty" in skipped(closing)["std err"]


def test_of_few_rows_an_influence_that_does_not_go_with_the_input_is_found():
    rng, x = np.random.default_rng(9), np.linspace(-1, 1, 40)
    temperature = rng.uniform(10, 40, 40)
    y = 0.2 + 3 * x + 0.02 * (temperature - 25) + rng.normal(0, 0.02, 40)
    closing = close("linear", {"reference": x, "reading": y, "temperature": temperature})
    assert [e.candidate.label for e in closing.effects] == ["temperature_bias(temperature)"]


@pytest.mark.parametrize("kind", ["difference", "sheet's sign", "percent", "size"])
def test_the_error_that_a_sheet_computed_is_no_influence(kind):
    """A meter beside its reference, 30 readings to two digits, and their errors beside them."""
    rng = np.random.default_rng(9)
    reference = np.round(rng.uniform(90, 240, 30), 2)
    reading = np.round(reference + rng.normal(0.3, 0.6, 30), 2)
    error = {
        "difference": reading - reference,
        "sheet's sign": reference - reading,
        "percent": 100 * (reading - reference) / reference,
        "size": np.abs(reading - reference),
    }[kind]
    closing = close("linear", {"reference": reference, "reading": reading, "e": np.round(error, 3)})
    assert not closing.effects
    assert "column is the error of reading against reference" in skipped(closing)["e"]


def test_an_influence_that_makes_nearly_all_of_the_error_is_one():
    rng = np.random.default_rng(10)
    reference, warmth = rng.uniform(0, 10, 60), rng.uniform(10, 40, 60)
    reading = reference + 0.05 * (warmth - 20) + rng.normal(0, 0.01, 60)
    closing = close("linear", {"reference": reference, "reading": reading, "temp": warmth})
    assert "temp" not in skipped(closing)
    assert any("temp" in e.candidate.label for e in closing.effects)


def swung(rng, frequencies, late=0.007, step=0.002, rows=3000):
    """A motor's rate and angle, and a gyroscope that is late by so much, in closed form."""
    t = np.arange(rows) * step
    rate = sum(30 * np.cos(2 * np.pi * f * t + f) for f in frequencies)
    angle = sum(30 / (2 * np.pi * f) * np.sin(2 * np.pi * f * t + f) for f in frequencies)
    seen = sum(30 * np.cos(2 * np.pi * f * (t - late) + f) for f in frequencies)
    gyro = 0.4 + 0.257 * seen + rng.normal(0, 0.3, rows)
    noisy = rate + rng.normal(0, 0.3, rows)
    return {"t": t, "reference": noisy, "reading": gyro, "angle": np.round(angle, 3)}


@pytest.mark.long
def test_in_one_sine_the_angle_is_the_rate_at_another_time():
    """A bias over the angle would explain all of the lag, with a size that goes as f²."""
    closing = close("linear", swung(np.random.default_rng(11), [5.0]))
    assert "column is reference at other times" in skipped(closing)["angle"]
    assert {e.candidate.label for e in closing.effects} <= {"signal_lag(reference)", "low_pass"}
    assert closing.after.values["gain"] == pytest.approx(0.257, rel=0.03)


@pytest.mark.long
def test_in_a_motion_of_several_frequencies_the_angle_is_a_column_of_its_own():
    record = swung(np.random.default_rng(12), [0.7, 2.3, 5.0])
    closing = close("linear", record)
    assert "angle" not in skipped(closing)
    assert [e.candidate.label for e in closing.effects] == ["signal_lag(reference)"]
    lag = closing.after.values["signal_lag(reference).delay"]
    assert lag == pytest.approx(0.007, abs=0.001)


@pytest.mark.long
def test_a_quotient_of_the_reading_and_another_column_explains_nothing(record):
    """A log of a motor holds its torque over its current; the current itself is an influence."""
    rng = np.random.default_rng(7)
    current = 2 + np.sin(0.9 * record["t"]) + rng.normal(0, 0.02, ROWS)
    reading = record["reading"] + 0.5 * current
    given = {**record, "reading": reading, "current": current, "constant": reading / current}
    closing = close("linear", given)
    assert [e.candidate.label for e in closing.effects] == ["channel_bias(current)"]
    assert skipped(closing)["constant"].startswith("column is made of reading and current")


@pytest.mark.long
def test_a_column_that_is_asked_for_by_name_is_tried_whatever_it_resembles(record):
    """As of the meter in the box above: the user says that it is no meter of the reading."""
    rng = np.random.default_rng(6)
    box = record["reference"] + 1.5 * np.sin(0.7 * record["t"])
    reading = 0.2 + 3 * box + rng.normal(0, 0.02, ROWS)
    given = {**record, "reading": reading, "beside": box + rng.normal(0, 0.3, ROWS)}
    asked = close("linear", given, known=["channel_bias(beside)"])
    assert "beside" not in skipped(asked)
    said = {e.candidate.label for e in asked.effects} | {s.name for s in asked.refused}
    assert "channel_bias(beside)" in said


def test_a_lag_that_is_asked_for_is_judged_by_its_own_f_test():
    """Of 85 rows behind a reference that is read with noise: that noise may feign a lag, and
    nothing is claimed. Who knows that there is one asks for it, and gets it."""
    rng = np.random.default_rng(8)
    t = 300.0 * np.arange(85)
    course = np.cumsum(rng.normal(size=8500)) / 10
    fine = 3.0 * np.arange(8500)
    light = np.interp(t, fine, course) + rng.normal(0, 0.05, 85)
    counts = 2 * np.interp(t - 170, fine, course) + rng.normal(0, 0.3, 85)
    given = {"t": t, "reference": light, "reading": counts}
    asked = close("linear", given, known=["signal_lag(reference)"])
    assert [e.candidate.label for e in asked.effects] == ["signal_lag(reference)"]
    assert asked.after.values["signal_lag(reference).delay"] == pytest.approx(170, abs=60)
    # Where there is none it is not there for the asking.
    counts = 2 * np.interp(t, fine, course) + rng.normal(0, 0.3, 85)
    closing = close("linear", {**given, "reading": counts}, known=["signal_lag(reference)"])
    assert not closing.effects


def height(rng):
    """A height that goes to and fro, and how fast it does, by a filter that is not quite it."""
    t = 0.02 * np.arange(3000)
    parts = [(0.4, 0.31, 0.2), (0.2, 0.83, 1.1), (0.05, 2.9, 2.0)]
    z = sum(a * np.sin(w * t + p) for a, w, p in parts)
    speed = sum(a * w * np.cos(w * (t - 0.05) + p) for a, w, p in parts)
    return t, z, speed + 0.03 * rng.standard_normal(t.size)


@pytest.mark.long
def test_the_speed_of_an_input_is_no_influence_beside_its_lag():
    """Of a drone's height a lag of 0.155 s was printed, and its speed beside it."""
    rng = np.random.default_rng(3)
    t, z, speed = height(rng)
    reading = np.interp(t - 0.12, t, z) + 0.004 * rng.standard_normal(t.size)
    closing = close("linear", {"t": t, "reference": z, "reading": reading, "vz": speed})
    assert "column is how fast reference changes" in skipped(closing)["vz"]
    assert [e.candidate.label for e in closing.effects] == ["signal_lag(reference)"]
    assert closing.after.values["signal_lag(reference).delay"] == pytest.approx(0.12, abs=0.002)


@pytest.mark.long
def test_a_speed_of_something_else_is_an_influence_still():
    rng = np.random.default_rng(4)
    t, z, _ = height(rng)
    wind = np.sin(0.57 * t) + 0.6 * np.sin(1.7 * t + 1)
    reading = z + 0.01 * wind + 0.004 * rng.standard_normal(t.size)
    closing = close("linear", {"t": t, "reference": z, "reading": reading, "wind": wind})
    assert [e.candidate.label for e in closing.effects] == ["channel_bias(wind)"]
