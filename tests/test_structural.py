"""Structural rank in exact arithmetic: the answers of the literature, and in words."""

from __future__ import annotations

import json
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from casest import (
    DeclarationError,
    UsageError,
    atan,
    atan2,
    attitude,
    cos,
    exp,
    fabs,
    log,
    norm_2,
    signal,
    sin,
    sqrt,
    tan,
    tanh,
)
from casest.cli import run
from casest.declaration.symbols import Signal
from casest.dynamics import Motion, dynamics, measured, state
from casest.dynamics.declare import Dynamics, State
from casest.dynamics.structural import floating, structure
from casest.dynamics.structural.field import PRIME, fraction, inverse, power, residue, root
from casest.dynamics.structural.points import points
from casest.dynamics.structural.program import Inexact, program_of
from casest.dynamics.structural.series import Series
from casest_problems.bias_gravity import bias_gravity, bias_gravity_position


@dynamics
def two_compartments(
    u=signal("1"),
    y=signal("1"),
    *,
    x1=state(),
    x2=state(),
    k1e=state("1/s"),
    k12=state("1/s"),
    k21=state("1/s"),
    b=state("1/s"),
):
    """Villaverde, Evans, Chappell & Banga (2019), IEEE Control Systems Letters 3, 272-277."""
    rates = {"x1": -(k1e + k12) * x1 + k21 * x2 + b * u, "x2": k12 * x1 - k21 * x2}
    return Motion(rates=rates, outputs=(measured(y, x1, intensity=1.0),))


def lotka_volterra(outputs):
    """x' = a x - b x y, y' = -c y + d x y."""

    @dynamics
    def predation(seen=signal(2), *, prey=state(), predator=state(),
                  a=state(), b=state(), c=state(), d=state()):  # fmt: skip
        rates = {"prey": a * prey - b * prey * predator,
                 "predator": -c * predator + d * prey * predator}  # fmt: skip
        either = {"prey": prey, "predator": predator}
        parts = [measured(seen, both(*(either[n] for n in outputs)), intensity=1.0)]
        return Motion(rates=rates, outputs=tuple(parts))

    return predation


def both(*parts):
    from casest import vertcat

    return vertcat(*(parts if len(parts) == 2 else parts * 2))


@dynamics
def lecourtier(u=signal("1"), y=signal("1"), *, x1=state(), x2=state(), x3=state(),
               p1=state(), p2=state(), p3=state(), p4=state()):  # fmt: skip
    """Lecourtier, Lamnabhi-Lagarrigue & Walter (1987), as in StructuralIdentifiability.jl."""
    rates = {"x1": -p1 * x1 + p2 * u, "x2": -p3 * x2 + p4 * u,
             "x3": -(p1 + p3) * x3 + (p4 * x1 + p2 * x2) * u}  # fmt: skip
    return Motion(rates=rates, outputs=(measured(y, x3, intensity=1.0),))


def test_two_compartments_are_identifiable_where_the_input_varies():
    found = structure(two_compartments)
    assert (found.rank, found.undetermined) == (6, ())
    assert found.gap > 1e6


def test_two_compartments_are_not_where_it_is_constant():
    """y'' + (k1e + k12 + k21) y' + k1e k21 y = b k21 u: three numbers for four parameters."""
    found = structure(two_compartments, varying=False)
    assert found.rank == 5
    assert set(found.undetermined) == {"x2", "k1e", "k12", "k21", "b"}
    assert found.gap > 1e6


def test_prey_alone_tells_all_but_the_scale_of_the_predators():
    """Known result (SIAN; Dong et al. 2023): a, c and d are identifiable, b is not."""
    found = structure(lotka_volterra(["prey"]))
    assert found.rank == 5
    assert found.undetermined == ("predator", "b")
    assert found.unobservable == ("only the product of predator and b is seen",)


def test_prey_and_predators_tell_everything():
    assert structure(lotka_volterra(["prey", "predator"])).observable


def test_a_pair_that_is_known_up_to_its_order_is_locally_observable():
    """StructuralIdentifiability.jl: p1 + p3, p1 p3 and p2 p4 are identifiable; p2, p4 are not."""
    found = structure(lecourtier)
    assert found.rank == 6
    assert found.undetermined == ("x1", "x2", "p2", "p4")
    words = "multiplying x1 and p2 by λ and x2 and p4 by 1/λ changes no reading"
    assert found.unobservable == (words,)


@pytest.mark.parametrize("model", [bias_gravity, bias_gravity_position])
def test_gravity_and_bias_need_a_rate_of_turn_that_varies(model):
    """Batista et al.: observable if and only if the direction of the angular velocity changes."""
    assert structure(model).observable
    held = structure(model, varying=False)
    assert held.rank == model.size - 1
    assert held.unobservable == ("gravity and bias along omega cannot be told apart",)


def test_units_do_not_count():
    """A range to a beacon with numbers of very different size."""

    @dynamics
    def beacon(y=signal("m"), *, place=state(3, "m", std=1e6), speed=state(3, "m/s", std=1e-3)):
        distance = norm_2(place * 1e6)
        return Motion(rates={"place": 1e-3 * speed}, outputs=(measured(y, distance, intensity=1),))

    found = structure(beacon)
    assert found.rank == 3  # length of place, and of speed along and across it
    assert found.gap > 1e3


def test_what_no_reading_depends_on_is_named():
    @dynamics
    def lonely(y=signal("m"), *, x=state("m"), other=state("m")):
        return Motion(rates={}, outputs=(measured(y, x, intensity=1.0),))

    assert structure(lonely).unobservable == ("other changes no reading",)


def test_time_runs_at_its_own_pace():
    """y = x·t: with time the state is seen, though the reading depends on no other input."""

    @dynamics
    def growing(t=signal("s"), y=signal("m"), *, x=state("m/s"), rate=state("m/s^2")):
        out = measured(y, x * t + rate * t**2, intensity=1.0)
        return Motion(rates={}, outputs=(out,))

    assert structure(growing).observable


def test_a_model_without_a_point_that_makes_sense_is_refused():
    @dynamics
    def nowhere(y=signal("m"), *, x=state("m")):
        return Motion(rates={}, outputs=(measured(y, log(-(x**2) - 1), intensity=1.0),))

    with pytest.raises(DeclarationError, match="not finite at 50 random points"):
        structure(nowhere)


# -- exact arithmetic against what is known apart from it ------------------------------------------


def residues(*values):
    return np.array(values, dtype=np.int64)


def test_powers_roots_and_inverses_are_those_of_whole_numbers():
    numbers = [2, 3, 10, 12345678, PRIME - 1]
    assert power(residues(*numbers), 77).tolist() == [pow(n, 77, PRIME) for n in numbers]
    assert inverse(residues(*numbers)).tolist() == [pow(n, -1, PRIME) for n in numbers]
    squares = residues(*[pow(n, 4, PRIME) for n in numbers])
    found, exists = root(squares, 4)
    assert exists.all()
    assert power(found, 4).tolist() == squares.tolist()
    assert not root(residues(PRIME - 1), 2)[1].any()  # -1 is no square where p = 3 (mod 4)
    cubes, exists = root(residues(*numbers), 3)
    assert exists.all()
    assert power(cubes, 3).tolist() == numbers


@pytest.mark.parametrize("number", [Fraction(0), Fraction(7), Fraction(-3, 4), Fraction(999, 1000)])
def test_a_small_fraction_is_read_back_from_its_residue(number):
    assert fraction(residue(number)) == number


def test_a_residue_at_large_is_no_small_fraction():
    assert fraction(123456789) is None


def program(build, states):
    x = ca.SX.sym("x", states)
    rates, reading = build(x)
    told = [ca.densify(ca.vertcat(*rates)), ca.densify(reading), ca.SX(0, 1)]
    return program_of(ca.Function("f", [x, ca.SX(0, 1)], told))


def run_series(build, states, orders):
    """Coefficients (orders, 1 + states) of the reading, the point, and the values of all steps."""
    steps = program(build, states)
    pool = points(steps, states, 0, np.random.default_rng(3))[:1]
    series = Series(steps, pool, np.zeros((1, orders, 0), np.int64))
    found = []
    for _ in range(orders):
        series.forward()
        found.append(series.rows[steps.outputs[1][0], 0, series.order].copy())
    return np.array(found), [int(v) for v in pool.states[0]]


def test_the_series_of_a_geometric_motion_is_the_known_one():
    """ẋ = x² has x = x₀/(1 - x₀·t): coefficients x₀ᵏ⁺¹, with derivatives (k + 1)·x₀ᵏ."""
    found, [x0] = run_series(lambda x: ([x[0] ** 2], x[0]), 1, 8)
    assert found[:, 0].tolist() == [pow(x0, k + 1, PRIME) for k in range(8)]
    assert found[:, 1].tolist() == [(k + 1) * pow(x0, k, PRIME) % PRIME for k in range(8)]


def test_a_quotient_and_a_logarithm_have_the_series_of_their_integral():
    """ẋ = 1: log(x₀ + t) has coefficients (-1)ᵏ⁻¹/(k·x₀ᵏ), and so has the integral of 1/x."""
    found, [x0, _] = run_series(lambda x: ([1, 1 / x[0]], ca.log(x[0]) - x[1]), 2, 6)
    assert not found[1:].any()
    own, [x0] = run_series(lambda x: ([1], ca.log(x[0])), 1, 6)
    wanted = [(-1) ** (k - 1) * pow(k * pow(x0, k, PRIME), -1, PRIME) % PRIME for k in range(1, 6)]
    assert own[1:, 0].tolist() == wanted


@pytest.mark.parametrize(
    "zero",
    [
        lambda a, b: sin(a) ** 2 + cos(a) ** 2 - 1,
        lambda a, b: sin(2 * a) - 2 * sin(a) * cos(a),
        lambda a, b: sin(a / 2) ** 2 - (1 - cos(a)) / 2,
        lambda a, b: cos(a - b) - cos(a) * cos(b) - sin(a) * sin(b),
        lambda a, b: exp(a + b) - exp(a) * exp(b),
        lambda a, b: exp(a / 3) ** 3 - exp(a),
        lambda a, b: a ** (b + 1) - a * a**b,
        lambda a, b: a**0.5 * a**0.25 - a**0.75,
        lambda a, b: sqrt(4 * a) - 2 * sqrt(a),
        lambda a, b: sqrt(a * b) - sqrt(a) * sqrt(b),
        lambda a, b: (a * b) ** (1 / 3) - a ** (1 / 3) * b ** (1 / 3),
        lambda a, b: a**0.25 * sqrt(9 * a) - 3 * (a * a * a) ** 0.25,
        lambda a, b: sqrt(exp(a)) - exp(a / 2),
        lambda a, b: exp(2 * log(a)) - a * a,
        lambda a, b: sin(atan2(a, b)) ** 2 * (a**2 + b**2) - a**2,
        lambda a, b: tanh(a) * (exp(2 * a) + 1) - exp(2 * a) + 1,
        lambda a, b: exp(log(a)) - a,
        lambda a, b: tan(a) * cos(a) - sin(a),
    ],
)
def test_an_identity_hides_what_it_multiplies(zero):
    """In floating point rounding makes a reading of some of these."""

    @dynamics
    def motion(y=signal(), *, a=state(), b=state(), c=state()):
        out = measured(y, a + b**2 + c * zero(a, b), intensity=1.0)
        return Motion(rates={"a": -b, "b": a * b}, outputs=(out,))

    found = structure(motion)
    assert (found.rank, found.undetermined, found.rounded) == (2, ("c",), "")


def moving(rates, reading, *names, inputs=(), seen=1):
    """A model of scalar states and inputs, with a reading of `seen` numbers."""

    def motion(**given):
        x = [given[n] for n in names]
        u = [given[n] for n in inputs]
        return Motion(
            rates=dict(zip(names, rates(*x, *u), strict=False)),
            outputs=(measured(given["y"], ca.SX(reading(*x, *u)), intensity=1.0),),
        )

    signals = (*(Signal(n, 1, "1") for n in inputs), Signal("y", seen, "1"))
    states = tuple(State(n, 1, "1", 0.0, (0.0,), 1.0) for n in names)
    return Dynamics("motion", motion, signals, states, ())


NONLINEAR = {
    "pendulum": moving(lambda a, w, g, r: [w, -g / r * sin(a)], lambda a, w, g, r: a, *"awgr"),
    "pendulum seen from afar": moving(
        lambda a, w, g, r: [w, -g / r * sin(a)], lambda a, w, g, r: r * sin(a), *"awgr"
    ),
    "Hill's law": moving(
        lambda x, n, k, v: [v * x**n / (k**n + x**n)], lambda x, n, k, v: x, *"xnkv"
    ),
    "Arrhenius' law": moving(
        lambda c, A, E, T: [-A * exp(-E / (8.314 * T)) * c],
        lambda c, A, E, T: c, *"cAE", inputs="T",
    ),
    "tank": moving(
        lambda h, A, a, k, u: [(k * u - a * sqrt(2 * 9.81 * h)) / A],
        lambda h, A, a, k, u: h, *"hAak", inputs="u",
    ),
    "gas": moving(lambda p, c, n: [-c * p**1.4], lambda p, c, n: n * p**0.5, *"pcn"),
    "bicycle": moving(
        lambda x, q, L, r, v, d: [v * cos(q + atan(tan(d) * r / L)), v * tan(d) / L],
        lambda x, q, L, r, v, d: x, *"xqLr", inputs="vd",
    ),
    "friction": moving(
        lambda v, c, m, e, u: [(u - c * tanh(v / e)) / m],
        lambda v, c, m, e, u: v, *"vcme", inputs="u",
    ),
    "range": moving(lambda a, b, v: [v], lambda a, b, v: ca.hypot(a, b), *"abv"),
    "degrees": moving(lambda a, b: [b], lambda a, b: sin(a * np.pi / 180), *"ab"),
}  # fmt: skip


@pytest.mark.parametrize("varying", [True, False])
@pytest.mark.parametrize("name", NONLINEAR)
def test_functions_that_are_not_rational_have_the_rank_of_floating_point(name, varying):
    model = NONLINEAR[name]
    found, rounded = structure(model, varying=varying), floating.ranked(model, varying, 0)
    assert found.rounded == ""
    assert (found.rank, found.undetermined) == (rounded.rank, rounded.undetermined)


@pytest.mark.parametrize(
    ("reading", "why"),
    [
        (lambda a, b: fabs(a) * b, "fabs has no power series"),
        (lambda a, b: 0.8660254037844386 * a * b, "the constant 0.8660254037844386 is rounded"),
        (lambda a, b: b * sqrt(a * a + 2 * a * b + b * b), "the root of a square"),
        (lambda a, b: sqrt(np.pi * a) + b * sqrt(a), "a constant that is no simple fraction"),
        (lambda a, b: sqrt(2 * a) + b * sqrt(a), "2 has no root of degree 2 modulo the prime"),
        (lambda a, b: log(a) + b * log(a * a), "one logarithm or angle is a combination"),
        (lambda a, b: sin(a) + b * sin(a + np.pi / 2), "exponents differ by constants"),
        (lambda a, b: exp(log(a) / 3) * b, "a fraction of a logarithm"),
        (lambda a, b: exp(a) + b * exp(np.pi * a), "in no simple proportion"),
    ],
)
def test_what_has_no_exact_answer_is_said_with_the_reason(reading, why):
    found = structure(moving(lambda a, b: [-b, a], reading, *"ab"))
    assert why in found.rounded
    assert found.rank == 2
    assert np.isfinite(found.gap)


def test_a_rounded_answer_takes_known_states():
    model = moving(lambda a, b, c: [-fabs(b * c)], lambda a, b, c: a, *"abc")
    assert structure(model).undetermined == ("b", "c")
    found = structure(model, known=["c"])
    assert "fabs" in found.rounded
    assert found.observable


def test_a_model_that_divides_by_nothing_has_no_point():
    steps = program(lambda x: ([1], 1 / (1 - sin(x[0]) ** 2 - cos(x[0]) ** 2)), 1)
    with pytest.raises(Inexact, match="too few points at which nothing is divided by zero"):
        points(steps, 1, 0, np.random.default_rng(0))


def test_a_long_sum_has_an_exponential():
    """Steps by the thousand are followed one after the other."""
    model = moving(
        lambda a, b: [-b],
        lambda a, b: exp(-1e-9 * sum((a * b + k) ** 2 for k in range(800))),
        *"ab",
    )
    assert structure(model).rank == 2


def test_exponents_that_differ_by_a_number_are_in_proportion():
    """exp(a + 1)/exp(a) is e wherever a is: c and d are seen as c·e + d."""
    model = moving(lambda a, c, d: [-a], lambda a, c, d: c * exp(a + 1) + d * exp(a), *"acd")
    found = structure(model)
    assert (found.rank, found.undetermined) == (2, ("c", "d"))


def test_an_attitude_is_a_rotation_and_not_any_matrix():
    """‖R·a‖ = ‖a‖: an attitude, turning as it may, says no more of a vector than its length."""

    @dynamics
    def length(R=attitude(), y=signal(), *, a=state(3)):
        return Motion(rates={}, outputs=(measured(y, norm_2(R @ a), intensity=1.0),))

    assert structure(length).rank == 1


# -- published answers -----------------------------------------------------------------------------


@dynamics
def treatment(y=signal(2), *, S=state(), In=state(), Tr=state(), N=state(),
              b=state(), d=state(), a=state(), g=state(), nu=state()):  # fmt: skip
    """Tunçer & Le (2018), as in StructuralIdentifiability.jl."""
    infected = b * S * In / N + d * b * S * Tr / N
    rates = {"S": -infected, "In": infected - (a + g) * In, "Tr": g * In - nu * Tr}
    return Motion(rates=rates, outputs=(measured(y, both(Tr, N), intensity=1.0),))


def test_combinations_that_are_determined_are_found():
    """StructuralIdentifiability.jl: nu, a + g, d·g, b/g and S·g, In·g are identifiable."""
    found = structure(treatment)
    assert set(found.combinations) == {"a + g", "d*g", "b/g", "S*g", "In*g"}
    assert found.more == 0
    assert found.determines(lambda b, d: b * d)
    assert found.determines(lambda a, g, b, d: (a + g) / (b * d))
    assert not found.determines(lambda a, g: a - g)
    assert not found.determines(lambda S: S)


def test_the_unordered_pair_of_rates_is_determined():
    found = structure(lecourtier)
    assert set(found.combinations) == {"x2/p4", "x1*p4", "p2*p4"}
    assert found.determines(lambda p1, p3: p1 * p3)


def test_polynomials_are_found_too():
    """StructuralIdentifiability.jl: a01·a12 and a01 + a12 + a21 are identifiable."""
    model = moving(
        lambda x0, x1, a01, a21, a12: [-(a01 + a21) * x0 + a12 * x1, a21 * x0 - a12 * x1],
        lambda x0, x1, a01, a21, a12: x0, "x0", "x1", "a01", "a21", "a12",
    )  # fmt: skip
    found = structure(model)
    assert found.combinations == ("a01 + a21 + a12", "a01*a12", "x1*a12 + x0*a12")
    for words in found.combinations:
        names = ["x0", "x1", "a01", "a21", "a12"]
        assert found.determines(eval(f"lambda {', '.join(names)}: {words}"))


def test_the_order_of_a_product_of_powers_is_seen_as_one():
    """Three scalings of NFκB's states and parameters: 27 of 30 are left."""
    found = structure(NFKB)
    assert (found.rank, found.more, len(found.combinations)) == (27, 0, 16)
    scaled = {"x7": 2.0, "k6": 2.0, "k8": 0.5}
    assert any(all(name in words for name in scaled) for words in found.unobservable)
    changes_no_reading(NFKB, scaled)
    changes_no_reading(NFKB, dict.fromkeys(["x1", "x2", "x3", "x4", "x8", "k8", "k11"], 2.0)
                       | dict.fromkeys(["s1", "s3", "s4", "rhovol"], 0.5))  # fmt: skip


def changes_no_reading(model, scaled):
    """Readings as they were, and rates scaled as the states are, after unknowns are scaled."""
    rng = np.random.default_rng(0)
    t = model.traced
    function = ca.Function("f", [t.x, *t.symbols.values()], [t.f, t.h])
    factors = np.array([scaled.get(name, 1.0) for name in model.names])
    x, inputs = rng.uniform(0.5, 1.5, model.size), rng.uniform(0.5, 1.5, len(t.symbols))
    (f, h), (fs, hs) = function(x, *inputs), function(factors * x, *inputs)
    np.testing.assert_allclose(np.asarray(fs), factors[:, None] * np.asarray(f), rtol=1e-12)
    np.testing.assert_allclose(np.asarray(hs), np.asarray(h), rtol=1e-12)


NFKB = moving(
    lambda x1, x2, x3, x4, x5, x6, x7, x8, x9, x10, s1, s2, s3, s4, k0, k1, k1p, k2, k3, k4, k5,
           k6, k7, k8, k9, k10, k11, rhovol, cyt, nuc, u: [
        k11 * x10 - (k1 * u / (1 + k0 * u) + k1p) * x1,
        (k1 * u / (1 + k0 * u) + k1p) * x1 - k2 * x2, k2 * x2 - k3 * x3, k2 * x2 - k4 * x4,
        k3 * rhovol * x3 - k5 * x5, k5 * x5 - k10 * x9 * x6, k6 * x6 - k7 * x7, k8 * x7 - k9 * x8,
        k9 * rhovol * x8 - k10 * x9 * x6, k10 * x9 * x6 - k11 * rhovol * x10,
    ],
    lambda x1, x2, x3, x4, x5, x6, x7, x8, x9, x10, s1, s2, s3, s4, *rest: ca.vertcat(
        s1 * (x1 + x2 + x3) + rest[-3], s2 * (x10 + x5 + x6) + rest[-2], s3 * (x2 + x3),
        s4 * (x2 + x4),
    ),
    *[f"x{i}" for i in range(1, 11)], "s1", "s2", "s3", "s4", "k0", "k1", "k1p",
    *[f"k{i}" for i in range(2, 12)], "rhovol", "cyt", "nuc", inputs="u", seen=4,
)  # fmt: skip


def goodwin():
    return moving(
        lambda x1, x2, x3, x4, b, c, alpha, beta, gama, delta, sigma: [
            -b * x1 + 1 / (c + x4), alpha * x1 - beta * x2, gama * x2 - delta * x3,
            sigma * x4 * (gama * x2 - delta * x3) / x3,
        ],
        lambda x1, *rest: x1,
        "x1", "x2", "x3", "x4", "b", "c", "alpha", "beta", "gama", "delta", "sigma",
    )  # fmt: skip


def test_what_is_known_at_the_beginning_need_not_be_seen():
    """StructuralIdentifiability.jl with known_ic: all are then identifiable, locally at least."""
    assert structure(goodwin()).undetermined == ("x2", "x3", "alpha", "gama")
    assert structure(goodwin(), known=["x2", "x3"]).observable
    assert structure(lotka_volterra(["prey"]), known=["predator"]).observable


def test_known_initial_states_do_not_show_what_nothing_depends_on():
    """StructuralIdentifiability.jl with known_ic: c is not identifiable, b is locally."""
    model = moving(
        lambda x1, x2, x3, a, b, c: [a + x2 + x3, b**2 + c, -c],
        lambda x1, *rest: x1, "x1", "x2", "x3", "a", "b", "c",
    )  # fmt: skip
    assert structure(model, known=["x2", "x3"]).undetermined == ("c",)


HIV = moving(
    lambda Tu, Ti, V, lam, rho, N, delta, c, eta: [
        lam - rho * Tu - eta * Tu * V, eta * Tu * V - delta * Ti, N * delta * Ti - c * V],
    lambda Tu, Ti, V, *rest: ca.vertcat(V, Tu + Ti),
    "Tu", "Ti", "V", "lam", "rho", "N", "delta", "c", inputs=["eta"], seen=2,
)  # fmt: skip


def test_an_input_that_nobody_measured_hides_what_it_can_make_up_for():
    """Martinelli (arXiv:2304.14288): with an unknown eta(t), delta, N and eta are not identifiable,
    which Miao, Xia, Perelson & Wu (2011) had believed."""
    assert structure(HIV).observable
    found = structure(HIV, unmeasured=["eta"])
    assert found.undetermined == ("Tu", "Ti", "N", "delta", "eta")
    assert found.rank == 7
    assert found.unobservable[0].endswith("while eta is free")
    assert found.inputs == ()


def test_a_force_that_nobody_measured_is_found_from_a_position():
    """ẍ = w is strongly observable: position tells speed, and w (Hautus 1983)."""
    model = moving(lambda x, v, w: [v, w], lambda x, v, w: x, "x", "v", inputs="w")
    found = structure(model, unmeasured=["w"])
    assert found.observable
    assert found.undetermined == ()


def ring(n):
    """A directed circle of compartments whose rates depend on a constant, as in
    StructuralIdentifiability.jl's tests of several experiments."""
    names = [f"x{i}" for i in range(n)]
    rates = [f"{c}{i}" for c in "ab" for i in range(n + 1)]

    def motion(*v):
        x, a, b, u = v[:n], v[n : 2 * n + 1], v[2 * n + 1 : 3 * n + 2], v[-1]
        flows = [(a[i] + b[i] * u) * x[i] for i in range(n)]
        sink = (a[n] + b[n] * u) * x[0]
        return [flows[i - 1] - flows[i] - (sink if i == 0 else 0) for i in range(n)]

    return moving(motion, lambda *v: v[0], *names, *rates, inputs="u")


def test_three_experiments_determine_the_rates_of_a_ring():
    def lost(count):
        found = structure(ring(3), varying=False, experiments=count)
        return {n for n in found.undetermined if n[0] in "ab"}

    assert lost(2)
    assert lost(3) == set()


def test_constants_that_differ_between_experiments_are_named():
    """Ovchinnikov, Pillay, Pogudin & Scanlon (arXiv:2011.10868), example 7.7: x0 is another one in
    each, and two experiments are enough."""
    model = moving(
        lambda x1, x0, a, b: [x0 * x1 + a * x0 + b], lambda x1, *rest: x1, "x1", "x0", "a", "b"
    )
    assert structure(model, experiments=1).undetermined == ("a", "b")
    assert structure(model, experiments=2).undetermined == ("a", "b")
    assert structure(model, experiments=2, per_run=["x0"]).observable


# -- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({"known": ["z"]}, "has no state 'z'; it has prey"),
        ({"per_run": ["z"]}, "has no state 'z'; it has prey"),
        ({"unmeasured": ["seen"]}, "predation has no input 'seen'; it has none"),
        ({"experiments": 0}, "predation: experiments=0: there must be one at least"),
    ],
)
def test_a_question_about_what_is_not_there_is_refused(asked, why):
    with pytest.raises(UsageError, match=why):
        structure(lotka_volterra(["prey"]), **asked)


def test_only_an_exact_answer_takes_inputs_that_are_not_measured():
    model = moving(lambda a, b, w: [w - fabs(b)], lambda a, b, w: a, *"ab", inputs="w")
    with pytest.raises(UsageError, match="asks for exact arithmetic, and fabs has no power"):
        structure(model, unmeasured=["w"])
    with pytest.raises(UsageError, match="motion: not known exactly: fabs has no power series"):
        structure(model).determines(lambda a: a)


def test_a_function_of_what_is_not_there_is_refused():
    found = structure(treatment)
    with pytest.raises(UsageError, match="treatment has no state 'q'; it has S, In, Tr, N"):
        found.determines(lambda q: q)
    with pytest.raises(UsageError, match="treatment: the function is not exact: fabs has no power"):
        found.determines(lambda S: fabs(S))


# -- through the command line ----------------------------------------------------------------------


PREDATION = """
from casest import signal
from casest.dynamics import Motion, dynamics, measured, state

@dynamics
def predation(y=signal(), *, prey=state(), predator=state(), a=state(), b=state(), c=state(), d=state()):
    rates = {"prey": a * prey - b * prey * predator, "predator": -c * predator + d * prey * predator}
    return Motion(rates=rates, outputs=(measured(y, prey, intensity=1.0),))
"""  # noqa: E501


@pytest.fixture
def told(capsys):
    def call(*words):
        assert run(["observe", *words]) == 0
        return capsys.readouterr().out

    return call


def test_without_data_observe_says_the_structural_rank(told, tmp_path):
    (tmp_path / "lv.py").write_text(PREDATION, encoding="utf-8")
    said = told(str(tmp_path / "lv.py"))
    assert "predation: structural rank 5 of 6" in said
    assert "only the product of predator and b is seen" in said
    assert "not determined by any record: predator, b" in said


def test_what_constant_inputs_hide_is_said(told, tmp_path):
    said = told("bias-gravity", "-o", str(tmp_path))
    assert "structural rank 9 of 9" in said
    assert "with a and omega held constant: rank 8 of 9" in said
    assert "gravity and bias along omega cannot be told apart" in said
    assert (
        json.loads((tmp_path / "observe.json").read_text("utf-8"))["constant_inputs"]["rank"] == 8
    )
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "suitable data determine all 9 unknowns" in page
    assert "With constant inputs" in page


def test_a_record_that_hides_something_says_whether_another_would_not(told, tmp_path):
    t = np.arange(0, 5, 0.05)
    rng = np.random.default_rng(0)
    turn = np.c_[0 * t, 0 * t, 0.3 + 0.1 * np.sin(t)]
    table = np.c_[t, rng.standard_normal((len(t), 3)), turn, rng.standard_normal((len(t), 3))]
    names = ["t [s]", *(f"a{c} [m/s^2]" for c in "xyz"), *(f"omega_{c} [rad/s]" for c in "xyz")]
    head = ",".join([*names, *(f"v{c} [m/s]" for c in "xyz")])
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header=head, comments="")
    said = told("bias-gravity", str(tmp_path / "r.csv"))
    assert "rank 8 of 9" in said
    assert "another motion could show more: the structural rank is 9" in said


def test_a_calibration_needs_data(capsys):
    assert run(["observe", "wheel"]) == 1
    said = capsys.readouterr().err
    assert said == "casest: wheel: what can be seen depends on the record: give DATA\n"


def test_without_data_observe_says_what_is_determined_all_the_same(told, tmp_path):
    (tmp_path / "lv.py").write_text(POND, encoding="utf-8")
    said = " ".join(told(str(tmp_path / "lv.py"), "-o", str(tmp_path)).split())
    assert "determined all the same: lost + caught" in said
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "Determined all the same" in page
    kept = json.loads((tmp_path / "observe.json").read_text("utf-8"))["structural"]
    assert (kept["combinations"], kept["more"]) == (["lost + caught"], 0)
    assert kept["gap"] is None


POND = """
from casest import signal
from casest.dynamics import Motion, dynamics, measured, state

@dynamics
def pond(rain=signal(), y=signal(), *, fish=state(), seen=state(), lost=state(), caught=state()):
    rates = {"fish": -(lost + caught) * fish}
    return Motion(rates=rates, outputs=(measured(y, seen * fish, intensity=1.0),))
"""


FORCES = """
from casest import fabs, signal
from casest.dynamics import Motion, dynamics, measured, state

@dynamics
def force(w=signal(), y=signal(), *, x=state(), v=state(), m=state()):
    return Motion(rates={"x": v, "v": w / m}, outputs=(measured(y, x, intensity=1.0),))

@dynamics
def pushes(w=signal(), v=signal(), y=signal(), *, x=state()):
    return Motion(rates={"x": w + v}, outputs=(measured(y, x, intensity=1.0),))

@dynamics
def corner(y=signal(), *, x=state(), v=state()):
    return Motion(rates={"x": fabs(v)}, outputs=(measured(y, x, intensity=1.0),))
"""


def test_observe_takes_what_is_known_not_measured_and_repeated(told, tmp_path):
    (tmp_path / "m.py").write_text(FORCES, encoding="utf-8")
    force = str(tmp_path / "m.py") + ":force"
    assert "structural rank 3 of 3" in told(force)
    said = told(force, "--unmeasured", "w")
    assert "rank 2 of 3" in said
    assert "m changes no reading while w is free" in said
    assert "not determined by any record: m, w" in said
    assert "rank 3 of 3" in told(force, "--unmeasured", "w", "--known", "m")
    assert "structural rank 5 of 5" in told(force, "--experiments", "2")
    said = told(str(tmp_path / "m.py") + ":pushes", "--unmeasured", "w", "--unmeasured", "v")
    assert "suitable data determine every state and parameter" in said
    assert "not determined by any record: w, v" in said


def test_no_experiment_is_refused_at_the_prompt(capsys, tmp_path):
    (tmp_path / "m.py").write_text(FORCES, encoding="utf-8")
    assert run(["observe", f"{tmp_path / 'm.py'}:force", "--experiments", "0"]) == 1
    assert "experiments=0: there must be one at least" in capsys.readouterr().err


def test_observe_says_why_a_rank_is_not_exact(told, tmp_path):
    (tmp_path / "m.py").write_text(FORCES, encoding="utf-8")
    said = " ".join(told(str(tmp_path / "m.py") + ":corner").split())
    assert "note: not in exact arithmetic: fabs has no power series" in said


def test_a_record_has_no_say_in_what_is_known_beforehand(capsys, tmp_path):
    assert run(["observe", "bias-gravity", str(tmp_path / "r.csv"), "--known", "bias"]) == 1
    said = capsys.readouterr().err
    assert "--known is a question about an estimator in motion without DATA" in said
