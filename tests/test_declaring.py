"""Signals, parameters, constants, shapes and the vocabulary of a model's body."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from models.wheel import wheel

from casest import (
    DeclarationError,
    Residual,
    UnitError,
    attitude,
    constant,
    der,
    diagonal,
    each,
    full,
    inf,
    integral,
    lower,
    model,
    param,
    polynomial,
    quantity,
    rotation,
    rotation_matrix,
    signal,
    unit_vector,
)
from casest.declaration.physics import chart


def with_parameter(declaration):
    """A model with one parameter `p` and a scalar reading, to see how `p` was declared."""

    @model
    def line(y=signal("V"), *, p=declaration):
        return Residual(measured=y, predicted=ca.sum1(ca.vec(ca.SX(p))))

    return line["p"]


# -- forms of a parameter -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("form", "dims", "entries", "unknowns"),
    [
        (None, (), ("p",), 1),
        (2, (2,), ("p[0]", "p[1]"), 2),
        ((2, 2), (2, 2), ("p[0,0]", "p[0,1]", "p[1,0]", "p[1,1]"), 4),
        (diagonal(3), (3,), ("p[0]", "p[1]", "p[2]"), 3),
        (lower(2), (2, 2), ("p[0,0]", "p[1,0]", "p[1,1]"), 3),
        (full(2), (2, 2), ("p[0,0]", "p[0,1]", "p[1,0]", "p[1,1]"), 4),
        (unit_vector, (3,), ("p[0]", "p[1]", "p[2]"), 2),
        (rotation_matrix, (3, 3), tuple(f"p[{i},{j}]" for i in range(3) for j in range(3)), 3),
    ],
    ids=["scalar", "vector", "matrix", "diagonal", "lower", "full", "direction", "rotation"],
)
def test_a_form_has_its_entries_and_its_number_of_unknowns(form, dims, entries, unknowns):
    p = with_parameter(param(form))
    assert p.shape.dims == dims
    assert p.entry_names == entries
    assert p.shape.coordinates == unknowns


def test_a_triangular_value_survives_packing_and_unpacking():
    shape = lower(3)
    value = np.array([[1.0, 0, 0], [2, 3, 0], [4, 5, 6]])
    np.testing.assert_array_equal(shape.pack(value), [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(shape.unpack(shape.pack(value)), value)


def test_a_vector_for_a_square_matrix_is_its_diagonal():
    np.testing.assert_array_equal(
        full(3).unpack(full(3).pack([1.0, 2.0, 3.0])), np.diag([1.0, 2.0, 3.0])
    )


@pytest.mark.parametrize("form", [lower(3), full(3)])
def test_an_undeclared_start_of_a_square_matrix_is_the_identity(form):
    p = with_parameter(param(form))
    np.testing.assert_array_equal(p.shape.unpack(p.start_value()), np.eye(3))


@pytest.mark.parametrize("form", [diagonal(3), lower(3), full(3)])
def test_the_diagonal_of_a_scale_matrix_is_positive_and_the_rest_is_free(form):
    p = with_parameter(param(form))
    lows = dict(zip(p.shape.entries, p.lower, strict=True))
    assert all(low == (0.0 if len(set(i)) == 1 else -inf) for i, low in lows.items())
    assert set(p.upper) == {inf}


def test_an_effects_parameter_takes_the_length_of_what_it_acts_on():
    from casest import effect

    @effect(on="specific_force")
    def cubic(force, *, k=param(each, "1/[force]^2")):
        return force + k * force**3

    p = wheel.with_effect(cubic)["cubic.k"]
    assert p.shape.dims == (3,)
    assert p.units == ("1/(m/s^2)^2",) * 3


@pytest.mark.parametrize(
    ("bounds", "start"),
    [((2.0, 4.0), 3.0), ((2.0, inf), 3.0), ((-inf, -2.0), -3.0), ((-1.0, 1.0), 0.0)],
)
def test_without_a_start_a_parameter_begins_inside_its_bounds(bounds, start):
    assert with_parameter(param("V", bounds=bounds)).start_value() == pytest.approx(start)


def test_units_may_differ_from_entry_to_entry():
    speed = wheel["speed"]
    assert speed.units == ("rad/s", "rad/s^2", "rad/s^3", "rad/s^4")
    assert speed.unit == "rad/s, rad/s^2, rad/s^3, rad/s^4"


def test_bounds_may_differ_from_entry_to_entry():
    p = with_parameter(param(2, bounds=([0.0, -1.0], [1.0, inf])))
    assert (p.lower, p.upper) == ((0.0, -1.0), (1.0, inf))


def test_a_parameter_is_for_all_runs_unless_it_says_per_run():
    assert wheel["offset"].scope == "all"
    assert wheel["tilt"].scope == "run"


def test_signals_have_size_and_unit_or_take_any_unit():
    assert (wheel["t"].size, wheel["t"].unit) == (1, "s")
    assert (wheel["v"].size, wheel["v"].unit) == (3, "m/s^2")
    assert (signal(3).size, signal(3).unit) == (3, None)
    assert (attitude().size, attitude().kind) == (9, "rotation")


def test_a_number_in_the_signature_is_a_constant_without_a_unit():
    @model
    def line(y=signal("V"), *, p=param("V"), slope=2):
        return Residual(measured=y, predicted=p * slope)

    assert line["slope"].array == 2.0
    assert line["slope"].unit == ""


def test_a_constant_may_be_an_array():
    matrix = constant([[1, 2], [3, 4]], "V")
    np.testing.assert_array_equal(matrix.array, [[1, 2], [3, 4]])


# -- what is refused, and in which words ---------------------------------------------------------


@pytest.mark.parametrize(
    ("declare", "words"),
    [
        (lambda: param("V", bounds=(2, 1)), "bounds (2, 1) leave no room: lower must be below"),
        (lambda: param("V", bounds=(1, 1)), "bounds (1, 1) leave no room"),
        (lambda: param("V", bounds=(float("nan"), 1)), "bounds (nan, 1) leave no room"),
        (lambda: param("V", bounds=3), "bounds 3 are not a pair (lower, upper)"),
        (lambda: param("V", start=5, bounds=(0, 1)), "start 5 is outside bounds (0, 1)"),
        (lambda: param(3, ("V", "A")), "2 units for 3 entries: give one, or one each"),
        (
            lambda: param(3, start=[1.0, 2.0]),
            "it takes a list of 3 (1,2,3), and a list of 2 is given",
        ),
        (lambda: param(0), "shape (0,) is not a length or a pair of lengths"),
        (lambda: param((1, 2, 3)), "shape (1, 2, 3) is not a length or a pair of lengths"),
        (lambda: param(unit_vector, bounds=(0, 1)), "a unit parameter has no bounds"),
        (lambda: param(rotation_matrix, bounds=(0, 1)), "a rotation parameter has no bounds"),
        (lambda: param(lower(2), start=[[1, 1], [0, 1]]), "must have zeros above its diagonal"),
        (lambda: param(diagonal(3), start=-1.0), "start -1 is outside bounds (0, inf)"),
        (lambda: constant(float("nan"), "V"), "constant nan is not finite"),
    ],
)
def test_a_declaration_that_makes_no_sense_is_refused_in_words(declare, words):
    with pytest.raises(DeclarationError) as refused:
        declare()
    assert words in str(refused.value)


def test_a_parameter_before_the_star_is_refused_by_name():
    with pytest.raises(DeclarationError, match=r"model line: gain comes before the \* and must be"):

        @model
        def line(y=signal("V"), gain=param("V")):
            return Residual(measured=y, predicted=gain)


def test_a_signal_after_the_star_is_refused_by_name():
    with pytest.raises(DeclarationError, match=r"model line: x is a signal: signals come before"):

        @model
        def line(y=signal("V"), *, x=signal("V")):
            return Residual(measured=y, predicted=x)


@pytest.mark.parametrize("default", ["0.28 m", None, True, [1.0]])
def test_a_default_that_is_no_declaration_is_refused_by_name(default):
    with pytest.raises(DeclarationError, match="model line: k must be param") as refused:

        @model
        def line(y=signal("V"), *, k=default):
            return Residual(measured=y, predicted=k)

    assert repr(default) in str(refused.value)


def test_star_arguments_are_refused():
    with pytest.raises(DeclarationError, match="a model takes signals, then"):

        @model
        def line(y=signal("V"), **more):
            return Residual(measured=y, predicted=y)


@pytest.mark.parametrize(
    "declaration", [param("ohmm"), constant(1.0, "ohmm"), param(2, ("V", "ohmm"))]
)
def test_an_unknown_unit_is_refused_by_name(declaration):
    with pytest.raises(UnitError, match="model line: p has unknown unit 'ohmm'"):

        @model
        def line(y=signal("V"), *, p=declaration):
            return Residual(measured=y, predicted=p)


def test_an_unknown_unit_of_a_signal_is_refused_by_name():
    with pytest.raises(UnitError, match="model line: y has unknown unit 'voltage'"):

        @model
        def line(y=signal("voltage"), *, p=param("V")):
            return Residual(measured=y, predicted=p)


def test_a_number_in_the_place_of_a_reading_is_named_with_the_way_out():
    @model
    def known(x=signal("V"), *, a=param("V")):
        return Residual(measured=100.0, predicted=quantity("seen", a + x, "V"))

    with pytest.raises(DeclarationError, match=r"measured=100\.0 is no signal .* implicit="):
        known.traced  # noqa: B018


def test_a_quantity_outside_a_model_is_refused():
    with pytest.raises(DeclarationError, match=r"quantity\('force', …\) belongs in the body"):
        quantity("force", 1.0, "N")


@pytest.mark.parametrize(
    "parts", [{}, {"measured": 1}, {"measured": 1, "predicted": 1, "implicit": 1}]
)
def test_a_residual_is_explicit_or_implicit(parts):
    with pytest.raises(DeclarationError, match="Residual takes measured= and predicted=, or"):
        Residual(**parts)


# -- the vocabulary -------------------------------------------------------------------------------


def value(expression, *pairs):
    """Numbers of an expression at numbers of its symbols."""
    symbols, numbers = zip(*pairs, strict=True)
    return np.array(ca.Function("f", list(symbols), [ca.SX(expression)])(*numbers))


def test_a_polynomial_starts_with_its_constant_term():
    x = ca.SX.sym("x")
    assert value(polynomial([1.0, 2.0, 3.0], x), (x, 2.0)).item() == 1 + 2 * 2 + 3 * 4


def test_the_derivative_of_an_integral_is_the_integrand():
    x, c = ca.SX.sym("x"), ca.SX.sym("c", 4)
    p = polynomial(c, x)
    numbers = ((x, 1.7), (c, [0.3, -2.0, 0.5, 4.0]))
    np.testing.assert_allclose(
        value(der(integral(p, x), x), *numbers), value(p, *numbers), rtol=1e-14
    )


def test_an_integral_begins_at_zero_and_agrees_with_numpy():
    x, c = ca.SX.sym("x"), ca.SX.sym("c", 3)
    coefficients = [1.0, -2.0, 0.75]
    expected = np.polynomial.Polynomial(coefficients).integ()
    for at in (0.0, -1.3, 2.5):
        found = value(integral(polynomial(c, x), x), (x, at), (c, coefficients)).item()
        assert found == pytest.approx(expected(at), abs=1e-14)


def test_only_polynomials_are_integrated():
    x = ca.SX.sym("x")
    with pytest.raises(DeclarationError, match="only polynomials are integrated"):
        integral(ca.sin(x), x)


def test_der_agrees_with_the_derivative_computed_by_hand():
    x, w = ca.SX.sym("x"), ca.SX.sym("w")
    found = value(der(der(ca.sin(w * x), x), x), (x, 0.4), (w, 3.0)).item()
    assert found == pytest.approx(-9 * np.sin(1.2), rel=1e-14)


def test_a_rotation_is_about_x_then_y_then_z_from_the_left():
    def about(axis, angle):
        c, s = np.cos(angle), np.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        R = np.eye(3)
        R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
        return R

    angles = ca.SX.sym("angles", 3)
    numbers = [0.3, -0.7, 1.1]
    expected = about(0, 0.3) @ about(1, -0.7) @ about(2, 1.1)
    np.testing.assert_allclose(value(rotation(angles), (angles, numbers)), expected, atol=1e-15)


# -- charts of curved sets ------------------------------------------------------------------------


@pytest.mark.parametrize("point", [[0, 0, 1], [0, 0, -1], [0.6, 0.0, -0.8], [1, 1, 1]])
def test_the_chart_of_a_direction_stays_on_the_sphere_and_measures_angles(point):
    rng = np.random.default_rng(0)
    reference = unit_vector.reference(np.array(point, dtype=float))
    c = ca.SX.sym("c", 2)
    f = ca.Function("f", [c], [chart("unit", c, ca.SX(ca.DM(reference)))])
    for step in (*rng.standard_normal((5, 2)), [3.0, -4.0]):
        moved = np.array(f(step)).ravel()
        assert np.linalg.norm(moved) == pytest.approx(1.0, abs=1e-14)
        # Stereographic: a coordinate of length d is an angle of 2·arctan(d/2).
        angle = np.arccos(np.clip(moved @ reference[:3], -1, 1))
        assert angle == pytest.approx(2 * np.arctan(np.linalg.norm(step) / 2), abs=1e-7)


def test_the_chart_of_a_rotation_stays_on_so3_and_measures_angles():
    rng = np.random.default_rng(1)
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    start = q * np.linalg.det(q)
    reference = rotation_matrix.reference(start)
    c = ca.SX.sym("c", 3)
    f = ca.Function("f", [c], [chart("rotation", c, ca.SX(ca.DM(reference)))])
    np.testing.assert_allclose(np.array(f([0, 0, 0])), start, atol=1e-14)
    for step in rng.standard_normal((5, 3)):
        moved = np.array(f(step))
        np.testing.assert_allclose(moved @ moved.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(moved) == pytest.approx(1.0)
        # Cayley: a coordinate of length d is a turn of 2·arctan(d/2) about its own direction.
        angle = np.arccos((np.trace(start.T @ moved) - 1) / 2)
        assert angle == pytest.approx(2 * np.arctan(np.linalg.norm(step) / 2), abs=1e-7)
        np.testing.assert_allclose(start.T @ moved @ step, step, atol=1e-13)


@pytest.mark.parametrize("declared", [signal, param])
def test_a_unit_before_how_many_is_said_the_other_way_round(declared):
    with pytest.raises(DeclarationError, match=r"before its unit, as in \w+\(3, 'deg/s'\)"):
        declared("deg/s", 3)
