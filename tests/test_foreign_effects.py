"""What no sensor of a kind has is tried there only where it is asked for."""

from __future__ import annotations

import numpy as np
import pytest

from casest import Residual, Run, close, cos, effect, model, param, quantity, signal, sin
from casest.diagnose.candidates.grid import Seen, searched
from casest.diagnose.sensor import foretelling
from casest.effects import (
    creep,
    gain_matrix,
    hysteresis,
    low_pass,
    quadratic,
    signed_quadratic,
    soft_iron,
)
from casest.effects.kinds import foreign


def one_channel(unit):
    """A sensor against a reference of its own unit, read as 0.2 + 3 x."""

    @model
    def sensor(x=signal(unit), y=signal(unit), *, zero=param(unit), gain=param(start=1.0)):
        """A straight line."""
        met = quantity("met", x, unit)
        reading = quantity("reading", zero + gain * met, unit)
        return Residual(measured=y, predicted=reading, corrected=met)

    return sensor


def creeping(unit):
    """Steps held for 20 s, each of which 5 % come late, with a time constant of 6 s."""
    rng = np.random.default_rng(7)
    t = np.arange(1200) / 5
    x = np.repeat(rng.uniform(-2, 2, 12), 100)
    late = np.zeros_like(x)
    for k in range(1, len(x)):
        late[k] = x[k] + (late[k - 1] - x[k]) * np.exp(-0.2 / 6)
    y = 0.2 + 3 * (0.95 * x + 0.05 * late) + 0.01 * rng.standard_normal(len(x))
    units = {"x": unit, "y": unit}
    return Run.raw("r", {"x": x[:, None], "y": y[:, None]}, units=units, time=t)


def closed(unit, effect, **how):
    return close(one_channel(unit), [creeping(unit)], catalogue=(effect,), **how)


def names(closing):
    return [e.candidate.name for e in closing.effects]


@pytest.mark.parametrize("unit", ["N", "degC", "mV"])
def test_creep_is_found_where_sensors_creep(unit):
    assert names(closed(unit, creep)) == ["creep"]


@pytest.mark.parametrize("unit", ["uT", "gauss", "deg/s", "m/s^2", "g"])
def test_creep_of_a_field_a_turn_or_a_proof_mass_is_not_tried(unit):
    found = closed(unit, creep)
    assert not names(found)
    (reason,) = [s.reason for s in found.skipped if s.name == "creep"]
    assert reason == f"no sensor that reads {unit} is known to have it; ask for it by name"


def test_it_is_tried_where_the_user_says_that_it_is_there():
    assert names(closed("uT", creep, known=("creep",))) == ["creep"]


def test_a_gyroscope_has_no_hysteresis_and_a_magnetometer_may():
    reasons = {unit: {s.name for s in closed(unit, hysteresis).skipped} for unit in ("deg/s", "uT")}
    assert reasons == {"deg/s": {"hysteresis"}, "uT": set()}


# -- what only sensors of a kind have -------------------------------------------------------------


@pytest.mark.parametrize(
    ("units", "creeps"),
    [(["uT"], False), (["uT", "deg/s"], False), (["uT", "K"], True), ([None], True), ([], True)],
)
def test_what_is_foreign_to_some_readings_may_be_of_the_others(units, creeps):
    assert (foreign(creep, units) == "") is creeps


@pytest.mark.parametrize(
    ("units", "iron"), [(["gauss"], True), (["m/s^2"], False), (["count"], False), ([None], False)]
)
def test_iron_bends_fields_alone_and_elsewhere_it_is_a_matrix_of_gains(units, iron):
    assert (foreign(soft_iron, units) == "") is iron
    assert (foreign(gain_matrix, units) == "") is not iron


# -- what a memory began from ----------------------------------------------------------------------


def warming(odd, rows):
    """A thermometer on a bath that warms evenly, whose first reading is off by `odd`."""
    rng, t = np.random.default_rng(1), 20.0 * np.arange(rows)
    x = 20 + 0.01 * t
    y = 0.5 + 1.01 * x + 0.01 * rng.standard_normal(rows)
    y[0] += odd
    signals = {"x": x[:, None], "y": y[:, None]}
    return Run.raw("r", signals, units={"x": "degC", "y": "degC"}, time=t)


@pytest.mark.parametrize(("odd", "rows"), [(0.08, 35), (0.08, 60), (0.2, 60), (0.2, 120)])
def test_one_odd_reading_at_the_beginning_is_no_lag(odd, rows):
    """Behind an even rise a lag, which begins at rest, is an offset of all but the first row."""
    found = close(one_channel("degC"), [warming(odd, rows)], catalogue=(low_pass, creep))
    assert not names(found)


# -- what a record cannot show ---------------------------------------------------------------------


@pytest.mark.parametrize(("back", "tried"), [(0.0, 0), (0.05, 3), (0.5, 5)])
def test_a_loop_that_nothing_turned_round_in_is_not_tried(back, tried):
    """A sweep that comes back by a part of its span: loops up to that part are tried."""
    reading = np.concatenate([np.linspace(0, 1, 60), np.linspace(1, 1 - back, 20)])[:, None]
    assert len(searched(("share",), Seen(reading, reading, reading[:, 0], None))[0]) == tried


@effect(on="output", profile={"frequency": "frequency"})
def tide(y, t=signal("s"), *, sine=param("[y]"), cosine=param("[y]"), frequency=param("rad/s")):
    """A line of any frequency."""
    return y + sine * sin(frequency * t) + cosine * cos(frequency * t)


def test_a_line_of_ones_own_may_be_as_slow_as_it_likes():
    """An effect that states no least frequency has none."""
    rng, t = np.random.default_rng(6), 60.0 * np.arange(900)
    x = rng.uniform(-2, 2, len(t))
    y = 0.2 + 3 * x + 0.1 * np.sin(2 * np.pi * t / 3600) + 0.05 * rng.standard_normal(len(t))
    units = {"x": "N", "y": "N"}
    run = Run.raw("r", {"x": x[:, None], "y": y[:, None]}, units=units, time=t)
    found = close(one_channel("N"), [run], catalogue=(tide,))
    assert names(found) == ["tide"]
    size = found.after.values["tide.frequency"]
    assert abs(float(size)) == pytest.approx(2 * np.pi / 3600, rel=1e-3)


def test_of_readings_above_zero_what_goes_by_their_sign_is_no_rival():
    rng, x = np.random.default_rng(5), np.linspace(1, 10, 60)
    y = 0.2 + 3 * x + 0.02 * x**2 + 0.01 * rng.standard_normal(60)
    run = Run.raw("r", {"x": x[:, None], "y": y[:, None]}, units={"x": "N", "y": "N"})
    found = close(one_channel("N"), [run], catalogue=(quadratic, signed_quadratic))
    (effect,) = found.effects
    assert effect.candidate.name == "quadratic"
    assert not effect.indistinguishable_from


def test_what_held_out_data_are_foretold_worse_with_is_taken_out_again(monkeypatch):
    """Whatever columns and refits have promised: the errors that are printed must fall."""
    held_out = foretelling.held_out

    def worse(sensor, fit, folds):
        found = held_out(sensor, fit, folds)
        return tuple(100 * r for r in found) if fit.model.effects else found

    monkeypatch.setattr(foretelling, "held_out", worse)
    found = closed("N", creep)
    assert not names(found)
    assert found.after is found.before or not found.after.model.effects
    assert {r.reason for r in found.refused} == {"held-out data do not confirm it"}
    monkeypatch.undo()
    assert names(closed("N", creep)) == ["creep"]
