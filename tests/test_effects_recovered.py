"""A record that has an effect at a known size, made in plain NumPy: calibrate recovers the size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import simulators as sim
from scipy.integrate import solve_ivp

from casest import (
    Residual,
    Run,
    UnitError,
    UsageError,
    calibrate,
    effects,
    model,
    param,
    quantity,
    signal,
    sin,
)
from casest.correction.inverse import Correction, invertible
from casest.declaration.dimensions import check_units
from casest.declaration.effect import OVER_TIME, RATES, RECORDED
from casest.effects.on_axes import restricted
from casest.effects.placing import angles, placed_in, prepared, told
from casest.errors import CasestError
from casest.results.find import find_model
from casest.saved.model import saved_model

N, NOISE, FIELD = 600, 0.02, 48.0
HARD, ZERO, STEP = np.array([5.0, -8.0, 2.0]), 0.3, 0.1
T = STEP * np.arange(N)


@model
def compass(b=signal(3, "uT"), m=signal(3, "uT"), *, hard=param(3, "uT")):
    """A magnetometer in a field whose direction in the sensor is known."""
    field = quantity("field", b, "uT")
    return Residual(measured=m, predicted=quantity("reading", field + hard, "uT"), corrected=field)


@model
def cell(force=signal("N"), v=signal("mV"), *, zero=param("mV"), gain=2.0):
    """One axis: a load cell whose gain is in its certificate."""
    load = quantity("load", force, "N")
    return Residual(measured=v, predicted=zero + gain * load, corrected=load)


def known_field(seed=1):
    return FIELD * sim.sphere(N, np.random.default_rng(seed))


def known_force():
    return 20 * np.sin(0.37 * T)


def of_compass(read, b, name="r", **more):
    noise = NOISE * np.random.default_rng(2).standard_normal(read.shape)
    return recorded(name, {"b": b, "m": read + HARD + noise, **more}, {"b": "uT", "m": "uT"})


def of_cell(read, force, **more):
    noise = NOISE * np.random.default_rng(3).standard_normal(N)
    return recorded("r", {"force": force, "v": read + ZERO + noise, **more}, {"v": "mV"})


def recorded(name, signals, units):
    units = {"t": "s", "force": "N", "warm": "degC", "amps": "A", "heading": "deg", **units}
    columns = {n: np.asarray(s, float).reshape(N, -1) for n, s in {"t": T, **signals}.items()}
    return Run.raw(name, columns, units={n: units.get(n) for n in columns}, time=T)


def fitted(declared, effect, *runs, **columns):
    """The estimate with the effect in the model, told what the data tell."""
    found = calibrate(
        told(declared.with_effect(placed_in(effect, declared), columns=columns), runs), runs
    )
    assert found.certificate.trusted
    return found


def assert_recovered(found, **true):
    for name, value in true.items():
        (own,) = [n for n in found.values if n.rpartition(".")[2] == name]
        away = np.abs(np.array(found.values[own]) - value) / np.array(found.std[own])
        assert np.all(away < 4), (name, away)
        if np.any(value):
            assert np.all(np.array(found.std[own]) < 0.1 * np.abs(value).max())


# -- gains -----------------------------------------------------------------------------------------


def test_the_gain_of_each_axis():
    b, k = known_field(), np.array([0.02, -0.03, 0.01])
    found = fitted(compass, effects.axis_gain, of_compass(b * np.array([1.02, 0.97, 1.01]), b))
    assert_recovered(found, hard=HARD, k=k)


def test_the_gain_of_the_only_axis():
    force = known_force()
    found = fitted(cell, effects.axis_gain, of_cell(2 * 1.004 * force, force))
    assert_recovered(found, zero=ZERO, k=0.004)


def test_soft_iron_is_all_nine_numbers_of_a_field_bent_by_iron():
    """Iron rods along directions in the sensor: each adds what it gathers along itself."""
    b, rods = known_field(), sim.sphere(3, np.random.default_rng(7))
    bent, response = b.copy(), np.zeros((3, 3))
    for rod, pulls in zip(rods, (0.05, 0.03, -0.02), strict=True):
        seen_by = rod + np.array([0.2, 0.0, -0.1])  # what it gathers, it gives off elsewhere
        bent += pulls * np.outer(b @ rod, seen_by)
        response += pulls * np.outer(seen_by, rod)
    found = fitted(compass, effects.soft_iron, of_compass(bent, b))
    assert_recovered(found, hard=HARD, k=response.ravel())


def test_some_terms_of_soft_iron_are_named_by_row_and_column_and_kept_in_a_result():
    b, seen = known_field(), [[1, 0.03, 0], [0, 1, 0], [-0.02, 0, 1]]
    placed = replace(effects.soft_iron, on="field")
    part = restricted(placed, [1, 6], compass)
    found = fitted(compass, part, of_compass(b @ np.array(seen).T, b))
    assert_recovered(found, k_xy=0.03, k_zx=-0.02, hard=HARD)
    # What a result keeps of it: the whole effect's name, and the unknowns that it had.
    kept = {"name": "soft_iron", "on": "corrected", "file": effects.__file__, "columns": {}}
    numbers = {n: {"value": v} for n, v in (("soft_iron.k_xy", 0.03), ("soft_iron.k_zx", -0.02))}
    numbers |= {"scale": {"value": [1, 1, 1]}, "offset": {"value": [0, 0, 0]}}
    again, _ = saved_model(
        {"model": "norm-diagonal", "effects": [kept], "constants": {"norm": 1.0},
         "estimate": {"parameters": numbers}}
    )  # fmt: skip
    added = [p.name for p in again.parameters if p.name.startswith("soft_iron")]
    assert added == ["soft_iron.k_xy", "soft_iron.k_zx"]


def test_a_gain_that_differs_by_the_sign_of_the_input():
    b, k = known_field(), np.array([0.002, -0.004, 0.003])
    read = np.where(b > 0, b * (1 + k), b * (1 - k))
    assert_recovered(fitted(compass, effects.gain_by_sign, of_compass(read, b)), hard=HARD, k=k)
    force = known_force()
    read = 2 * np.where(force > 0, 1.003 * force, 0.997 * force)
    assert_recovered(fitted(cell, effects.gain_by_sign, of_cell(read, force)), k=0.003)


def test_an_accelerometer_in_poses_shows_the_gain_that_differs_by_the_sign():
    """Of the corrected value, so against what the reading does, to first order."""
    rng = np.random.default_rng(5)
    sensor, k = sim.accelerometer(rng), np.array([4e-3, -3e-3, 2e-3])
    force = sensor.norm * sim.spread_poses(60, rng)
    read = np.where(force > 0, force * (1 + k), force * (1 - k)) @ sensor.M.T + sensor.b
    v = read + 1e-3 * rng.standard_normal(read.shape)
    run = Run.raw("r", {"v": v}, units={"v": "m/s^2"})
    declared = find_model("norm-triangular").having(norm=sensor.norm)
    found = fitted(declared, effects.gain_by_sign, run)
    assert np.abs(found.values["gain_by_sign.k"] + k).max() < 2e-4


# -- in time ---------------------------------------------------------------------------------------


def test_a_pulse_is_what_a_magnet_does_that_comes_and_goes():
    b, k = known_field(), np.array([1.0, -0.6, 0.3])
    read = b.copy()
    read[200:350] += k
    held = effects.pulse.holding(start=19.95, stop=34.95)
    assert_recovered(fitted(compass, held, of_compass(read, b)), hard=HARD, k=k)
    force = known_force()
    read = 2 * force + np.where((T > 10) & (T < 12), 0.5, 0.0)
    held = effects.pulse.holding(start=10.0, stop=11.95)
    assert_recovered(fitted(cell, held, of_cell(read, force)), zero=ZERO, k=0.5)


def test_warming_up_is_a_heat_balance_after_switching_on():
    heat = solve_ivp(lambda t, y: -y / 12.0, (0, T[-1]), [1.0], "DOP853", T, rtol=1e-10)
    b, k = known_field(), np.array([0.8, -0.5, 0.3])
    run = of_compass(b + np.outer(heat.y[0], k), b)
    assert_recovered(fitted(compass, effects.warm_up.holding(tau=12.0), run), hard=HARD, k=k)
    free = effects.warm_up.starting(tau=20.0)
    assert_recovered(fitted(compass, free, run), hard=HARD, k=k, tau=12.0)
    force = known_force()
    found = fitted(cell, free, of_cell(2 * force + 0.4 * heat.y[0], force))
    assert_recovered(found, zero=ZERO, k=0.4, tau=12.0)


def swaying():
    """A course of six degrees without a mean, as a polynomial in its Chebyshev form."""
    x = 2 * T / T[-1] - 1
    way = np.polynomial.Chebyshev([0, 1, -2, 1.5, 1, -0.5, 0.8]) / 5
    return way(x) - 0.5 * (way.integ()(1) - way.integ()(-1))


def course(c):
    return np.polynomial.legendre.legval(2 * T / T[-1] - 1, [0, *c])


def test_a_field_that_sways_is_an_error_of_the_reference_and_of_no_offset():
    b, sway = known_field(), 0.006 * swaying()
    run = of_compass(b * (1 + sway)[:, None], b)
    found = fitted(compass, effects.reference_wander, run)
    seen = course(found.values["reference_wander.c"])
    assert np.std(seen - sway) < 0.05 * np.std(sway)
    assert_recovered(found, hard=HARD)
    assert np.isclose(found.rmse, NOISE, rtol=0.05)
    other = fitted(compass, effects.bias_course, run)  # which no offset can explain
    assert other.rmse > 3 * NOISE


def test_a_field_that_sways_is_not_taken_out_of_what_the_magnetometer_felt():
    b, sway = known_field(), 0.006 * swaying()
    run = of_compass(b * (1 + sway)[:, None], b)
    found = fitted(compass, effects.reference_wander, run)
    with pytest.raises(UsageError, match=r"describes a record .reference_wander.: not undone"):
        Correction(found.model)
    kept, left = invertible(found.model)
    assert left == ("reference_wander",)
    felt = Correction(kept)(run, {"hard": found.values["hard"]})
    assert np.abs(felt - b * (1 + sway)[:, None]).max() < 5 * NOISE


def test_an_offset_that_wanders_is_no_error_of_the_reference():
    b, k = known_field(), np.array([0.4, -0.2, 0.1])
    run = of_compass(b + np.outer(swaying(), k), b)
    found = fitted(compass, effects.bias_course, run)
    c = np.array([found.values[f"bias_course.c{i}"] for i in range(1, 7)])
    seen, true = course(c.ravel()[::3]), k[0] * swaying()
    assert np.std(seen - true) < 0.05 * np.std(true)
    assert np.isclose(found.rmse, NOISE, rtol=0.05)
    other = fitted(compass, effects.reference_wander, run)
    assert other.rmse > 3 * NOISE


def test_every_run_has_a_course_of_its_own():
    b, sway = known_field(), 0.006 * swaying()
    up, down = (of_compass(b * (1 + s * sway)[:, None], b, f"r{s}") for s in (1, -1))
    found = fitted(compass, effects.reference_wander, up, down)
    first, second = found.values["reference_wander.c"]
    np.testing.assert_allclose(first, -second, atol=5 * np.max(found.std["reference_wander.c"]))
    assert np.isclose(found.rmse, NOISE, rtol=0.05)


def test_what_describes_a_course_says_so_and_names_no_cause():
    described = {e.name for e in effects.CATALOGUE if e.describes}
    assert described == {"reference_wander", "bias_course", "bias_ramp", "bias_wander"}


# -- columns ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effect", "column"), [(effects.temperature_curve, "warm"), (effects.channel_curve, "amps")]
)
def test_an_offset_that_bends_with_a_column(effect, column):
    """Made about a value of 20 that is not the mean: only the bend is the same about any."""
    b, x = known_field(), 22 + 6 * np.sin(0.11 * T) + 0.05 * T
    k, bend = np.array([0.05, -0.02, 0.03]), np.array([0.004, 0.006, -0.003])
    run = of_compass(b + np.outer(x - 20, k) + np.outer((x - 20) ** 2, bend), b, **{column: x})
    found = fitted(compass, effect, run, channel=column)
    mean = np.mean(x) - 20
    assert_recovered(found, bend=bend, k=k + 2 * bend * mean, hard=HARD + k * mean + bend * mean**2)
    force = known_force()
    run = of_cell(2 * force + 0.004 * (x - 20) ** 2, force, **{column: x})
    assert_recovered(fitted(cell, effect, run, channel=column), bend=0.004)


@pytest.mark.parametrize(
    ("effect", "column"),
    [(effects.temperature_gain_curve, "warm"), (effects.channel_gain_curve, "amps")],
)
def test_a_gain_that_bends_with_a_column(effect, column):
    b, x = known_field(), 22 + 6 * np.sin(0.11 * T) + 0.05 * T
    bend = np.array([4e-5, 6e-5, -3e-5])
    away = x - np.mean(x)
    read = b + np.column_stack([b[:, i] * away * away * bend[i] for i in range(3)])
    found = fitted(compass, effect, of_compass(read, b, **{column: x}), channel=column)
    assert_recovered(found, bend=bend, k=np.zeros(3), hard=HARD)


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_harmonics_of_a_recorded_angle_in_its_own_unit(unit):
    """cos² is half a constant and half a second harmonic; a phasor's real part is a first one."""
    b, turn = known_field(), 0.8 * T + 0.3 * np.sin(0.2 * T)
    column = np.degrees(turn) if unit == "deg" else turn
    k, phase = np.array([0.6, 0.3, -0.4]), 0.7
    once = np.outer(np.real(np.exp(1j * (turn - phase))), k)
    run = of_compass(b + once, b, heading=column)
    run.units["heading"] = unit
    found = fitted(compass, effects.harmonic, run, channel="heading")
    assert_recovered(found, hard=HARD, cosine=k * np.cos(phase), sine=k * np.sin(phase))
    run = of_compass(b + np.outer(np.cos(turn - phase) ** 2, k), b, heading=column)
    run.units["heading"] = unit
    found = fitted(compass, effects.second_harmonic, run, channel="heading")
    cosine, sine = 0.5 * k * np.cos(2 * phase), 0.5 * k * np.sin(2 * phase)
    assert_recovered(found, hard=HARD + 0.5 * k, cosine=cosine, sine=sine)


@model
def encoder(
    shaft=signal("deg"), v=signal("V"), *, zero=param("V"), gain=param("V/deg", start=0.01)
):
    turned = quantity("turned", shaft, "deg")
    return Residual(measured=v, predicted=zero + gain * turned, corrected=turned)


@pytest.mark.parametrize("column", ["shaft", "turned"])
def test_a_signal_or_quantity_of_the_model_may_be_the_angle(column):
    shaft = np.linspace(0, 700, N)
    v = 0.1 + 0.01 * shaft + 0.03 * np.sin(np.radians(shaft)) + 1e-3 * np.cos(7 * T)
    run = recorded("r", {"shaft": shaft, "v": v}, {"shaft": "deg", "v": "V"})
    assert angles(encoder, prepared(encoder, [run])) == ["shaft", "turned"]
    found = fitted(encoder, effects.harmonic, run, channel=column)
    assert abs(found.values[f"harmonic({column}).sine"] - 0.03) < 3e-4
    check_units(found.model)


def test_the_angle_that_a_wheel_turns_by_is_left_to_the_effects_on_it():
    wheel = find_model("wheel")
    run = recorded("r", {"v": np.zeros((N, 3)), "roll": T}, {"roll": "deg"})
    run = replace(run, columns={"roll": T, "angle": T}, column_units={"roll": "deg"})
    assert angles(wheel, prepared(wheel, [run])) == ["roll"]


@pytest.mark.parametrize(("unit", "said"), [(None, "has no unit"), ("V", "is in V")])
def test_a_harmonic_of_what_is_no_angle_is_refused_with_the_unit(unit, said):
    b = known_field()
    run = of_compass(b, b, heading=T)
    run.units["heading"] = unit
    with pytest.raises(UnitError, match=f"heading {said}, .* --unit heading=deg"):
        fitted(compass, effects.harmonic, run, channel="heading")


def test_an_angle_in_two_units_is_refused():
    b = known_field()
    runs = [of_compass(b, b, name, heading=T) for name in "ab"]
    runs[1].units["heading"] = "rad"
    with pytest.raises(UnitError, match="heading is in deg and in rad: give all files in one"):
        fitted(compass, effects.harmonic, *runs, channel="heading")


# -- all of them: there is something to be found at null -------------------------------------------

SEARCHED = {
    "frequency": 3.0,
    "when": 0.6,
    "start": 0.6,
    "stop": 1.5,
    "tau": 2.0,
    "level": 0.5,
    "begin": 0.6,
}
#: Where nothing is still, and no axis points along another.
SOMEWHERE = {
    "wheel": {
        "misalignment": [0.3, 0.2, 0.4],
        "tilt": 0.8,
        "phase": 0.5,
        "speed": [9.0, -0.1, 5e-4, 2e-6],
    },
    "rate-table": {"gravity_direction": [0.6, 0.0, 0.8]},
    "swing": {"pace": 2.0},
}


@model
def swing(t=signal("s"), v=signal("V"), *, gain=param("V", start=1.0), pace=param("rad/s")):
    """A user's own model in time, of one axis."""
    u = quantity("u", sin(pace * t) + 0.3 * t, "1")
    return Residual(measured=v, predicted=quantity("seen", gain * u, "V"), corrected=u)


OWN = {"compass": compass, "cell": cell, "swing": swing}


#: Those that act on a signal as another instrument has recorded it are tested in test_memory.py,
#: those on rates in test_effects_on_rates.py.
ON_SAMPLES = [e for e in effects.CATALOGUE if e.on not in ("noise", RECORDED, RATES)]


@pytest.mark.parametrize("effect", ON_SAMPLES, ids=lambda e: e.name)
@pytest.mark.parametrize("name", [*OWN, "wheel", "rate-table", "norm-triangular"])
def test_each_unknown_of_an_effect_changes_the_residual_from_null_on(effect, name):
    """By differences: finite, and not zero, wherever the effect is attached."""
    declared = OWN[name] if name in OWN else find_model(name)
    searched = SEARCHED | ({"level": 50.0} if effect.name == "floor" else {})  # above all readings
    held = effect.holding(**{n: searched[n] for n, _ in effect.profile if n in searched})
    columns = {s.name: "warm" for s in effect.extras if s.name == "channel"}
    try:
        changed = declared.with_effect(placed_in(held, declared), columns=columns)
    except CasestError:
        return  # tests/test_effects.py says where and why
    if changed.effects[-1].kind in OVER_TIME:
        return  # it acts along a record, not on samples one by one: tests/test_memory.py
    rng = np.random.default_rng(4)
    samples = {s.name: rng.uniform(0.2, 2, (12, s.size)) for s in changed.signals}
    at = SOMEWHERE.get(name, {})

    def residual(**more):
        return changed(**samples, **at, **more)["residual"]

    null = residual()
    assert np.isfinite(null).all()
    for p in changed.parameters:
        if p.name not in changed.unknowns_of(changed.effects[-1].label):
            continue
        start = p.start_value()
        for i in range(p.shape.size):
            moved = start + 1e-5 * (np.arange(p.shape.size) == i)
            slope = (residual(**{p.name: p.shape.unpack(moved)}) - null) / 1e-5
            assert np.isfinite(slope).all()
            assert np.abs(slope).max() > 1e-6, f"{p.name}[{i}]"


def test_effects_of_time_and_of_single_inputs_fit_a_model_of_one_axis():
    fits = set()
    for effect in effects.CATALOGUE:
        try:
            swing.with_effect(placed_in(effect, swing), columns={
                s.name: "warm" for s in effect.extras if s.name == "channel"})  # fmt: skip
            fits.add(effect.name)
        except CasestError:
            continue
    three = {"cross_axis", "soft_iron", "gain_matrix", "cross_quadratic", "g_sensitivity"}
    wheels = {"imbalance", "speed_polynomial", "table_angle", "lever_arm"}
    rates = {e.name for e in effects.CATALOGUE if e.on == RATES}  # of differential equations
    recorded = {"signal_lag"}  # of a signal besides the time and what is measured: there is none
    rates = {e.name for e in effects.CATALOGUE if e.kind == "rate"}
    assert {e.name for e in effects.CATALOGUE} - fits == three | wheels | recorded | rates | rates
