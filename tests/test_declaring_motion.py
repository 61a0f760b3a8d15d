"""What a declaration of an estimator in motion may say: units, outputs."""

from __future__ import annotations

import pytest

from casest import DeclarationError, UnitError, constant, signal
from casest.cli import run
from casest.dynamics import Motion, check_units, constraint, dynamics, measured, state
from casest_problems import bias_gravity


def cart(position="m", speed="m/s", stiffness="1/s^2", place="m", plain=None):
    """A mass on a spring, with units that may be wrong."""

    @dynamics
    def cart(
        push=signal("m/s^2"),
        y=signal(place) if place else signal(),
        *,
        x=state(position),
        v=state(speed),
        k=constant(2.0, stiffness),
    ):
        force = push - (k if plain is None else plain) * x
        return Motion(rates={"x": v, "v": force}, outputs=(measured(y, x, intensity=1.0),))

    return cart


# -- units -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["bias_gravity", "bias_gravity_magnitude", "bias_gravity_position"]
)
def test_units_of_the_shipped_estimators_fit(name):
    check_units(getattr(bias_gravity, name))


@pytest.mark.parametrize(
    ("units", "words"),
    [
        ({"stiffness": "1/s"}, r"dynamics cart: .*push \[m/s\^2\].*against.*k \[1/s\], x \[m\]"),
        ({"plain": 2.0}, r"push \[m/s\^2\]\) against m \(from x \[m\]\)"),
        ({"speed": "m/min"}, r"the rate of x \[m\]: units do not fit: .*60 to 1"),
        ({"speed": "m"}, r"the rate of x \[m\]: units do not fit: m \(from v"),
        ({"place": "cm"}, r"the prediction of y \[cm\]: units do not fit: .*100 to 1"),
    ],
)
def test_units_that_do_not_fit_are_refused_by_name(units, words):
    check_units(cart())
    with pytest.raises(UnitError, match=words):
        check_units(cart(**units))


def test_a_signal_of_any_unit_fits():
    check_units(cart(place=None))


def test_where_nothing_has_a_unit_there_is_none_to_check():
    @dynamics
    def prey(y=signal(), *, n=state(start=1.0), k=state()):
        return Motion(rates={"n": k * n}, outputs=measured(y, n, intensity=1.0))

    check_units(prey)


def test_the_command_line_refuses_them_too(tmp_path, capsys):
    (tmp_path / "wrong.py").write_text(
        "from casest import signal\n"
        "from casest.dynamics import Motion, dynamics, measured, state\n\n\n"
        "@dynamics\n"
        "def wrong(a=signal('m/s^2'), y=signal('m'), *, x=state('m'), v=state('m/s')):\n"
        "    rates = {'x': v, 'v': a + v}\n"
        "    return Motion(rates=rates, outputs=(measured(y, x, intensity=1.0),))\n",
        encoding="utf-8",
    )
    assert run(["observe", str(tmp_path / "wrong.py")]) == 1
    said = capsys.readouterr().err
    assert "dynamics wrong: units do not fit" in said
    assert said.count("\n") == 1


# -- outputs ---------------------------------------------------------------------------------------


def falling(outputs, constraints=()):
    @dynamics
    def falling(y=signal("m"), *, x=state("m")):
        return Motion(rates={}, outputs=outputs(y, x), constraints=constraints)

    return falling


def test_one_output_needs_no_comma():
    model = falling(lambda y, x: measured(y, x, intensity=1.0))
    assert model.measured_signals == ("y",)


def test_what_is_no_output_is_refused():
    with pytest.raises(DeclarationError, match=r"Motion: outputs= takes measured\(…\), …, not"):
        _ = falling(lambda y, x: (y, x)).traced
    wrong = falling(lambda y, x: measured(y, x, intensity=1.0), constraints=3.0)
    with pytest.raises(DeclarationError, match=r"constraints= takes constraint\(…\), …, not 3"):
        _ = wrong.traced


def test_one_constraint_needs_no_comma():
    @dynamics
    def known(y=signal("m"), *, x=state("m")):
        seen = measured(y, x, intensity=1.0)
        return Motion(rates={}, outputs=seen, constraints=constraint(x, 2.0))

    assert known.traced.g.numel() == 1
