"""Declared units are followed through a model's expressions."""

from __future__ import annotations

from dataclasses import replace

import pytest

from casest import (
    Residual,
    UnitError,
    check_units,
    constant,
    cos,
    effect,
    exp,
    integral,
    model,
    param,
    pi,
    polynomial,
    quantity,
    signal,
)
from casest_problems import norm


@model
def pendulum(
    t=signal("s"),
    x=signal("m"),
    *,
    length=param("m", start=1.0),
    amplitude=param("rad", start=0.1),
    rate=param(2, ("rad/s", "rad/s^2")),
    gravity=constant(9.81, "m/s^2"),
):
    """A bob whose frequency drifts."""
    angle = quantity("angle", amplitude * cos(integral(polynomial(rate, t), t)), "rad")
    return Residual(measured=x, predicted=quantity("place", length * angle, "m"))


@effect(on="place")
def stretch(place, *, k=param("1/[place]")):
    """A relative stretch that grows with the distance."""
    return place + k * place**2


def altered(name, declaration):
    """The pendulum with one symbol declared otherwise, unchecked."""
    declared = tuple(
        replace(declaration, name=name) if s.name == name else s for s in pendulum.declared
    )
    return replace(pendulum, declared=declared)


@pytest.mark.parametrize("fine", [pendulum, pendulum.with_effect(stretch)])
def test_units_that_fit_are_accepted(fine):
    check_units(fine)
    assert fine.quantities["place"].unit == "m"


@pytest.mark.parametrize("name", ["norm_diagonal", "norm_triangular", "norm_full"])
def test_units_of_the_shipped_models_fit(name):
    shipped = getattr(norm, name)
    check_units(shipped)
    assert shipped["offset"].unit == "[v]"


@pytest.mark.parametrize(
    ("name", "declaration", "words"),
    [
        ("length", param("s", start=1.0), "quantity place"),
        ("length", param("cm", start=100.0), "0.01 m"),
        ("amplitude", param("deg", start=5.0), "0.01745"),
        ("rate", param(2, ("rad/s", "rad/s")), "rate"),
        ("rate", param(2, ("Hz", "Hz/s")), None),
        ("rate", param(2, ("deg/s", "deg/s^2")), "argument of cos"),
    ],
)
def test_a_unit_that_does_not_fit_is_named(name, declaration, words):
    wrong = altered(name, declaration)
    if words is None:  # 1/s times s is a pure number: an angle in turns cannot be told from rad
        check_units(wrong)
        assert wrong["rate"].units == ("Hz", "Hz/s")
    else:
        with pytest.raises(UnitError, match=words):
            check_units(wrong)


def test_a_reading_in_another_unit_than_its_prediction_is_refused():
    with pytest.raises(UnitError, match=r"prediction of x \[V\]"):
        check_units(altered("x", signal("V")))


def test_a_plain_number_may_be_added_and_a_conversion_factor_multiplied():
    @model
    def thermometer(v=signal("V"), *, slope=param("V/K"), angle=param("deg")):
        """Volts per kelvin times a number: the result is in V/K, not in V."""
        return Residual(measured=v, predicted=slope * (angle * (pi / 180) + 273.15))

    @model
    def wrong(v=signal("V"), *, slope=param("V"), time=param("s")):
        """An exponent that has a dimension."""
        return Residual(measured=v, predicted=slope * exp(-time * 2))

    with pytest.raises(UnitError, match=r"prediction of v \[V\].*slope \[V/K\]"):
        check_units(thermometer)
    with pytest.raises(UnitError, match="argument of exp"):
        check_units(wrong)


def test_a_unit_in_brackets_is_that_of_the_symbol_it_names():
    @model
    def ratio(u=signal(1), w=signal(1), *, gain=param("[w]/[u]")):
        """Readings in any units."""
        return Residual(measured=w, predicted=gain * u)

    @model
    def wrong(u=signal(1), w=signal(1), *, gain=param("[u]/[w]")):
        """The same, upside down."""
        return Residual(measured=w, predicted=gain * u)

    check_units(ratio)
    with pytest.raises(UnitError, match=r"\[u\]"):
        check_units(wrong)


def test_powers_of_a_unit_that_only_data_state_are_followed():
    def bent(unit):
        @model
        def ratio(u=signal(1), w=signal(1), *, k=param(unit)):
            return Residual(measured=w, predicted=k * u**3)

        return ratio

    check_units(bent("[w]/[u]^3"))
    check_units(bent("[w]/([u])^2/[u]"))
    with pytest.raises(UnitError, match=r"\[u\]\^"):
        check_units(bent("[w]/[u]^2"))


def test_a_unit_in_brackets_may_be_that_of_a_quantity():
    def lever(unit):
        @model
        def arm(x=signal("mm"), v=signal("V"), *, k=param(unit)):
            path = quantity("path", 2 * x, "mm")
            return Residual(measured=v, predicted=k * path)

        return arm

    check_units(lever("V/[path]"))
    with pytest.raises(UnitError, match="prediction of v"):
        check_units(lever("V*[path]"))


def test_of_a_signal_without_a_unit_it_is_said_which_unit_an_unknown_has():
    @model
    def focus(distance=signal("mm"), position=signal(), *, base=param(), k=param("mm")):
        return Residual(measured=position, predicted=base + k / distance)

    with pytest.raises(UnitError, match=r'like param\("\[position\]"\) \(\[position\] is the unit'):
        check_units(focus)


def test_what_multiplies_a_signal_without_a_unit_is_told_its_own():
    def battery(unit):
        @model
        def sagging(pwm=signal(), v=signal("V"), *, emf=param("V"), drop=param(unit)):
            return Residual(measured=v, predicted=quantity("p", emf - drop * pwm, "V"))

        return sagging

    with pytest.raises(UnitError, match=r'V \(from emf.*against V·\[pwm\].*param\("V/\[pwm\]"\)'):
        check_units(battery("V"))
    check_units(battery("V/[pwm]"))
