"""A model is a value: it is evaluated, printed, compared and changed, never stored into."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from models.load_cell import load_cell
from models.wheel import quadratic, wheel

from casest import (
    DeclarationError,
    Residual,
    Run,
    UnitError,
    UsageError,
    attitude,
    constant,
    full,
    inf,
    lower,
    model,
    param,
    quantity,
    rotation_matrix,
    signal,
    sin,
    unit_vector,
)
from casest.declaration.dimensions import check_units
from casest.estimate.calibrate import attempt

TRUTH = {
    "offset": np.array([0.1, -0.2, 0.3]),
    "gain": np.array([1.02, 0.97, 1.01]),
    "misalignment": np.array([0.02, -0.03, 0.05]),
    "tilt": 0.7,
    "phase": -2.0,
    "speed": np.array([9.0, -0.4, 0.03, -0.002]),
}


def about(axis, angle):
    """Rotation matrix about one axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


def pedersini(t, truth, radius=0.28, gravity=9.80665):
    """Pedersini (1)-(7) in plain NumPy: angle (N,), specific force (N, 3), reading (N, 3)."""
    c = truth["speed"]
    angle = truth["phase"] + sum(c[k] * t ** (k + 1) / (k + 1) for k in range(4))
    rate = sum(c[k] * t**k for k in range(4))
    acceleration = sum(k * c[k] * t ** (k - 1) for k in range(1, 4))
    s = gravity * np.sin(truth["tilt"])
    a = np.column_stack(
        [
            radius * rate**2 + s * np.cos(angle),
            radius * acceleration + s * np.sin(angle),
            np.full(len(t), gravity * np.cos(truth["tilt"])),
        ]
    )
    x, y, z = truth["misalignment"]
    force = a @ (about(0, x) @ about(1, y) @ about(2, z)).T
    return angle, force, truth["offset"] + truth["gain"] * force


TIME = np.linspace(0.0, 3.0, 31)


# -- numbers --------------------------------------------------------------------------------------


def test_the_wheel_of_the_design_is_pedersinis_wheel():
    angle, force, reading = pedersini(TIME, TRUTH)
    found = wheel(t=TIME, v=np.zeros((31, 3)), **TRUTH)
    np.testing.assert_allclose(found["angle"][:, 0], angle, rtol=1e-13)
    np.testing.assert_allclose(found["specific_force"], force, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found["reading"], reading, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found["predicted"], found["reading"])


def test_the_residual_is_the_reading_less_the_prediction():
    v = np.arange(93.0).reshape(31, 3)
    found = wheel(t=TIME, v=v, **TRUTH)
    np.testing.assert_allclose(found["residual"], v - pedersini(TIME, TRUTH)[2], atol=1e-11)


def test_one_sample_needs_no_sample_axis():
    found = wheel(t=0.5, v=[1.0, 2.0, 3.0], **TRUTH)
    assert found["residual"].shape == (1, 3)
    np.testing.assert_allclose(found["reading"], pedersini(np.array([0.5]), TRUTH)[2], rtol=1e-12)


def test_parameters_that_are_not_given_take_their_declared_start():
    found = wheel(t=0.0, v=np.zeros(3))
    # phase, speed, misalignment 0; tilt 0.8; gain 1; offset 0
    expected = 9.80665 * np.array([np.sin(0.8), 0.0, np.cos(0.8)])
    np.testing.assert_allclose(found["reading"][0], expected, atol=1e-14)


def test_constants_enter_with_their_values():
    found = wheel.having(radius=0.5, gravity=1.6)(t=TIME, v=np.zeros((31, 3)), **TRUTH)
    expected = pedersini(TIME, TRUTH, radius=0.5, gravity=1.6)[2]
    np.testing.assert_allclose(found["reading"], expected, rtol=1e-12, atol=1e-12)


def test_directions_rotations_and_attitudes_are_matrices_in_the_body():
    @model
    def mounted(
        a=signal(3),
        R=attitude(),
        *,
        M=param(rotation_matrix),
        up=param(unit_vector),
        L=param(lower(3)),
    ):
        return Residual(measured=a, predicted=quantity("r", L @ M @ R.T @ up))

    M, R = about(2, 0.4) @ about(0, -1.0), about(1, 2.0) @ about(2, 0.3)
    up, L = np.array([0.36, 0.48, -0.8]), np.array([[2.0, 0, 0], [0.1, 3, 0], [-0.2, 0.3, 4]])
    found = mounted(a=np.zeros(3), R=R.ravel(), M=M, up=up, L=L)
    np.testing.assert_allclose(found["r"][0], L @ M @ R.T @ up, atol=1e-13)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"t": 0.0}, "model wheel needs the signal 'v'"),
        ({"t": 0.0, "v": [0, 0, 0], "ofset": 1}, "has no 'ofset'; did you mean 'offset'?"),
        (
            {"t": 0.0, "v": [0, 0, 0], "radius": 0.3},
            "radius is a constant of model wheel: having(radius=…)",
        ),
    ],
)
def test_a_call_with_missing_or_unknown_names_is_refused(given, words):
    with pytest.raises(UsageError) as refused:
        wheel(**given)
    assert words in str(refused.value)


# -- a value --------------------------------------------------------------------------------------


def test_models_with_the_same_declarations_are_equal_and_hash_alike():
    same = wheel.having(radius=0.28)
    assert same is not wheel
    assert same == wheel
    assert hash(same) == hash(wheel)
    assert wheel.with_effect(quadratic) == wheel.with_effect(quadratic)
    assert len({wheel, same, wheel.having(radius=0.3)}) == 2


def test_models_that_differ_anywhere_are_unequal():
    others = [
        wheel.having(radius=0.3),
        wheel.having(offset=0.0),
        wheel.freed("radius"),
        wheel.scoped("tilt", "all"),
        wheel.with_effect(quadratic),
        load_cell,
    ]
    assert all(other != wheel for other in others)
    assert len(set(others)) == len(others)


def test_a_model_cannot_be_changed_in_place():
    with pytest.raises(FrozenInstanceError):
        wheel.name = "other"
    with pytest.raises(FrozenInstanceError):
        wheel["tilt"].start = (0.1,)


def test_every_change_returns_a_new_model_and_leaves_the_old_one():
    before = (wheel.parameters, wheel.constants, wheel.effects)
    wheel.having(radius=0.5, offset=0.0)
    wheel.freed("gravity")
    wheel.scoped("gain", "run")
    wheel.with_effect(quadratic)
    assert (wheel.parameters, wheel.constants, wheel.effects) == before


def test_a_printed_model_shows_every_symbol_with_its_unit_and_the_equations():
    text = str(wheel.with_effect(quadratic))
    lines = text.splitlines()
    about = "Accelerometer on a tilted, freely rotating wheel (Pedersini, eqs. 1-7)."
    assert lines[0] == f"wheel: {about}"
    kinds = ("signal", "parameter", "constant", "effect")
    rows = {w[1]: w for w in map(str.split, lines[1:]) if w and w[0] in kinds}
    assert rows["t"] == ["signal", "t", "1", "s"]
    assert rows["v"] == ["signal", "v", "3", "m/s^2"]
    assert rows["tilt"] == ["parameter", "tilt", "1", "rad", "per", "run"]
    assert rows["quadratic.k"] == ["parameter", "quadratic.k", "3", "1/(m/s^2)"]
    assert rows["radius"] == ["constant", "radius", "1", "m", "=", "0.28"]
    assert rows["quadratic"] == ["effect", "quadratic", "3", "on", "specific_force"]
    assert "  radius * rate**2 + gravity * sin(tilt) * cos(angle)," in text
    assert "return force + k * force**2" in text


def test_a_model_without_source_is_printed_from_its_expressions():
    body = (
        "from casest import *\n"
        "@model\n"
        "def line(y=signal('V'), x=signal('V'), *, a=param()):\n"
        "    r = quantity('r', a * x, 'V')\n"
        "    return Residual(measured=y, predicted=r + 1)\n"
    )
    space: dict = {}
    exec(body, space)
    assert "r = (a*x)" in str(space["line"])
    assert "predicted = (r+1)" in str(space["line"])
    assert "residual = (y-predicted)" in str(space["line"])


# -- changing what is known and unknown -----------------------------------------------------------


def test_a_number_fixes_a_parameter_and_freed_frees_it_again_from_that_value():
    fixed = wheel.having(gain=[1.0, 1.1, 0.9])
    assert "gain" in {c.name for c in fixed.constants}
    freed = fixed.freed("gain")
    assert freed["gain"].lower == wheel["gain"].lower
    assert freed["gain"].scope == wheel["gain"].scope
    np.testing.assert_array_equal(freed["gain"].start_value(), [1.0, 1.1, 0.9])


def test_one_number_fixes_every_entry():
    np.testing.assert_array_equal(wheel.having(offset=0.5)["offset"].array, [0.5] * 3)


def test_a_freed_constant_starts_from_its_value_in_its_unit():
    freed = wheel.freed("radius")["radius"]
    assert freed.units == ("m",)
    assert freed.start_value() == 0.28
    assert wheel.freed("tilt") == wheel


def test_a_constant_becomes_a_parameter_as_redeclared():
    radius = wheel.having(radius=param("m", start=0.3, bounds=(0.2, inf), per="run"))["radius"]
    assert (radius.name, radius.units, radius.start, radius.lower) == (
        "radius",
        ("m",),
        (0.3,),
        (0.2,),
    )
    assert radius.scope == "run"


def test_a_parameter_of_an_effect_is_fixed_like_any_other():
    bent = wheel.with_effect(quadratic)
    fixed = bent.having(**{"quadratic.k": [1e-3, 0.0, 0.0]})
    assert "quadratic.k" not in {p.name for p in fixed.parameters}
    v = np.zeros((31, 3))
    _, force, _ = pedersini(TIME, TRUTH)
    found = fixed(t=TIME, v=v, **TRUTH)["specific_force"]
    np.testing.assert_allclose(found, force + np.array([1e-3, 0, 0]) * force**2, atol=1e-11)


def test_a_constant_in_another_unit_is_converted():
    radius = wheel.having(radius=constant(28, "cm"))["radius"]
    assert radius.array == pytest.approx(0.28, rel=1e-15)
    assert radius.unit == "m"


def test_a_parameter_fixed_in_another_unit_is_converted():
    fixed = wheel.having(tilt=constant(45, "deg"))["tilt"]
    assert fixed.array == pytest.approx(np.pi / 4, rel=1e-15)


def test_a_parameter_redeclared_in_another_unit_is_converted_or_refused():
    try:
        radius = wheel.having(radius=param("cm", start=28, bounds=(20, 40)))["radius"]
    except UnitError:
        return
    assert radius.units == ("m",)
    assert radius.start_value() == pytest.approx(0.28)
    assert (radius.lower, radius.upper) == (pytest.approx((0.2,)), pytest.approx((0.4,)))


@pytest.mark.parametrize("change", [constant(1.0, "kg"), param("kg")])
def test_a_unit_of_another_dimension_is_refused(change):
    with pytest.raises(UnitError, match="radius is declared in 'm': 'kg' does not fit"):
        wheel.having(radius=change)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"radios": 1.0}, "model wheel has no 'radios'; did you mean 'radius'?"),
        ({"v": 1.0}, "v is a signal of model wheel: data give it"),
        (
            {"offset": [1.0, 2.0]},
            "offset of model wheel: it takes a list of 3 (1,2,3), and a list of 2",
        ),
        ({"radius": [1.0, 2.0]}, "radius of model wheel is one number, and a list of 2 is given"),
    ],
)
def test_a_change_that_does_not_fit_is_refused_by_name(change, words):
    with pytest.raises(UsageError) as refused:
        wheel.having(**change)
    assert words in str(refused.value)


@model
def pointed(a=signal(3), *, up=param(unit_vector), M=param(rotation_matrix)):
    return Residual(measured=a, predicted=M @ up)


@pytest.mark.parametrize(
    ("name", "value", "held"),
    [("up", [0.0, 0, -2], [0.0, 0, -1]), ("M", 2 * np.eye(3), np.eye(3))],
)
def test_a_direction_or_rotation_is_held_as_one_or_refused(name, value, held):
    try:
        fixed = pointed.having(**{name: value})
    except (DeclarationError, UsageError):
        return
    np.testing.assert_allclose(fixed[name].array, held)


def test_a_direction_of_no_length_is_refused():
    with pytest.raises(DeclarationError):
        param(unit_vector, start=[0.0, 0.0, 0.0])


def test_scope_is_changed_for_parameters_only():
    assert wheel.scoped("tilt", "all")["tilt"].scope == "all"
    assert wheel.scoped("offset", "run")["offset"].scope == "run"
    with pytest.raises(UsageError, match="radius is not a parameter of model wheel"):
        wheel.scoped("radius", "run")
    with pytest.raises(UsageError, match="v is a signal of model wheel, not a constant"):
        wheel.freed("v")


# -- the body -------------------------------------------------------------------------------------


def test_an_undeclared_name_in_the_body_is_named_with_file_and_line():
    @model
    def line(y=signal("V"), *, a=param("V")):
        return Residual(measured=y, predicted=a + slope)  # noqa: F821

    with pytest.raises(DeclarationError) as refused:
        line(y=0.0)
    text, number = str(refused.value), line.function.__code__.co_firstlineno + 2
    assert "name 'slope' is not defined" in text
    assert f"{__file__}, line {number}" in text


def refused_body(make):
    """Text of the refusal of a model's body."""
    with pytest.raises(DeclarationError) as refused:
        make(y=0.0)
    return str(refused.value)


def test_a_name_used_twice_is_refused_with_model_file_and_line():
    @model
    def twice(y=signal("V"), *, a=param("V")):
        inner = quantity("inner", a, "V")
        return Residual(measured=y, predicted=quantity("inner", inner, "V"))

    text = refused_body(twice)
    assert "model twice" in text
    assert "name 'inner' is used twice" in text
    assert f"{__file__}, line {twice.function.__code__.co_firstlineno + 3}" in text


def test_a_quantity_may_not_have_the_name_of_a_symbol():
    @model
    def clash(y=signal("V"), *, a=param("V")):
        return Residual(measured=y, predicted=quantity("a", a, "V"))

    assert "name 'a' is used twice" in refused_body(clash)


def test_a_body_without_a_residual_is_refused_with_model_and_file():
    @model
    def empty(y=signal("V"), *, a=param("V")):
        quantity("inner", a + y, "V")

    text = refused_body(empty)
    assert "model empty" in text
    assert __file__ in text
    assert "must return Residual(…), not NoneType" in text


def test_a_prediction_of_another_shape_is_refused_with_the_models_name():
    @model
    def misfit(y=signal("V"), *, a=param(3, "V")):
        return Residual(measured=y, predicted=a + y)

    text = refused_body(misfit)
    assert "misfit" in text
    assert "(1, 1)" in text
    assert "(3, 1)" in text


def test_what_is_measured_must_be_a_signal():
    @model
    def derived(y=signal("V"), *, a=param("V")):
        return Residual(measured=2 * y, predicted=a)

    assert "measured= must be one of the model's signals" in refused_body(derived)


def test_what_is_corrected_must_be_a_quantity():
    @model
    def loose(y=signal("V"), *, a=param("V")):
        return Residual(measured=y, predicted=a, corrected=2 * a)

    assert "corrected= must be a quantity of the model: wrap the expression" in refused_body(loose)


def test_a_signal_cannot_be_what_is_corrected_and_the_way_out_works():
    @model
    def bare(T=signal("degC"), y=signal("V"), *, a=param("V/K")):
        return Residual(measured=y, predicted=a * T, corrected=T)

    with pytest.raises(DeclarationError) as refused:
        bare(T=20.0, y=0.0)
    text = str(refused.value)
    assert "corrected= is the signal T" in text
    assert 'wanted = quantity("wanted", T, "degC")' in text

    @model
    def named(T=signal("degC"), y=signal("V"), *, a=param("V/K")):
        wanted = quantity("wanted", T, "degC")
        return Residual(measured=y, predicted=a * wanted, corrected=wanted)

    assert named.traced.corrected == "wanted"


def test_a_prediction_in_another_dimension_than_the_reading_is_refused():
    @model
    def mixed(y=signal("ohm"), *, a=param("V")):
        return Residual(measured=y, predicted=quantity("reading", a, "V"))

    with pytest.raises(UnitError) as refused:
        check_units(mixed)
    assert "the prediction of y [ohm]" in str(refused.value)


def test_a_quantity_in_an_unknown_unit_is_refused():
    @model
    def strange(y=signal("V"), *, a=param("V")):
        return Residual(measured=y, predicted=quantity("reading", a, "bogus"))

    with pytest.raises(UnitError, match="quantity reading is declared in bogus"):
        check_units(strange)


def declared_sum(unit):
    """Volts plus `unit`: a model whose units fit only where that is volts."""

    @model
    def total(y=signal("V"), x=signal("A"), *, a=param("V"), b=param(unit)):
        return Residual(measured=y, predicted=quantity("reading", a + b * x, "V"))

    return total


def test_units_that_fit_are_accepted():
    for fitting in (wheel, wheel.with_effect(quadratic), load_cell, declared_sum("ohm")):
        check_units(fitting)


@pytest.mark.parametrize("unit", ["V", "mohm", "kg"])
def test_a_sum_of_different_units_is_refused_with_both_sides(unit):
    with pytest.raises(UnitError, match="model total: units do not fit") as refused:
        check_units(declared_sum(unit))
    assert f"b [{unit}]" in str(refused.value)
    assert "a [V]" in str(refused.value)


def test_degrees_inside_a_sine_are_refused():
    @model
    def tilted(y=signal("m/s^2"), *, tilt=param("deg"), g=constant(9.8, "m/s^2")):
        return Residual(measured=y, predicted=g * sin(tilt))

    with pytest.raises(UnitError, match="the argument of sin: units do not fit") as refused:
        check_units(tilted)
    assert "one kind in two units, 57.3 to 1" in str(refused.value)


# -- start values and estimators ------------------------------------------------------------------


def test_start_values_come_from_a_function_of_the_models_own_name():
    @model
    def level(y=signal("V"), *, a=param("V")):
        return Residual(measured=y, predicted=a)

    plain = level

    @level.start
    def level(model, runs):
        return {"a": float(np.mean(runs[0].signals["y"]))}

    assert level.starter is not None
    assert plain.starter is None
    with pytest.raises(DeclarationError, match="decorates a function of the same name"):

        @plain.start
        def begin(model, runs):
            return {}


def test_an_implicit_model_says_so_and_an_explicit_one_does_not():
    @model
    def ball(v=signal(3), *, o=param(3)):
        return Residual(implicit=(v - o)[0], unit="[v]")

    assert ball.implicit
    assert not wheel.implicit
    assert ball.residual_unit == "[v]"
    assert wheel.residual_unit == "m/s^2"


@pytest.mark.long
def test_a_wheel_at_three_tilts_is_calibrated_from_pedersinis_equations():
    rng = np.random.default_rng(0)
    t = np.linspace(0, 4, 120)
    tilts, phases = [0.4, 0.8, 1.2], [-2.0, 0.5, 2.5]
    runs = []
    for k in range(3):
        truth = {**TRUTH, "tilt": tilts[k], "phase": phases[k], "misalignment": np.zeros(3)}
        v = pedersini(t, truth)[2] + 0.02 * rng.standard_normal((120, 3))
        runs.append(Run.raw(f"r{k}", {"t": t[:, None], "v": v}, units={}, time=t))
    held = wheel.having(misalignment=0.0)
    start = {"phase": [-1.9, 0.6, 2.4], "speed": [9.1, -0.45, 0.03, -0.002], "tilt": 0.9}
    found = attempt(held, runs, start=start, solver="trust-region")
    assert found.certificate.trusted, found.certificate.reasons
    expected = {"offset": TRUTH["offset"], "gain": TRUTH["gain"], "tilt": tilts, "phase": phases}
    z = [(found.values[n] - x) / found.std[n] for n, x in expected.items()]
    z = np.concatenate(
        [*z, ((found.values["speed"] - TRUTH["speed"]) / found.std["speed"]).ravel()]
    )
    assert np.all(np.abs(z) < 4.5)
    assert found.noise.sigma == pytest.approx(0.02, rel=0.1)


def test_the_sign_that_a_matrix_is_given_is_shown_where_it_is_declared():
    @model
    def matrices(
        v=signal(3, "m"),
        *,
        signed=param(full(3)),
        free=param((3, 3)),
        wide=param(full(3), bounds=(-5, 5)),
    ):
        """Three matrices on one vector."""
        return Residual(implicit=(signed + free + wide) @ v, unit="m")

    lines = {line.split()[1]: line for line in str(matrices).splitlines()[1:5]}
    assert lines["signed"].endswith("diagonal > 0")
    assert "diagonal" not in lines["free"] + lines["wide"]
    assert matrices["signed"].lower[0] == 0
    assert matrices["wide"].lower[0] == -5
