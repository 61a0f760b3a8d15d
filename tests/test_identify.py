"""What the data see: rank, null directions in words, weak ones with what they cost."""

from __future__ import annotations

import numpy as np
import pytest
import simulators as sim

from casest import Residual, Run, constant, cos, exp, model, param, quantity, signal, sin, vertcat
from casest.estimate.calibrate import attempt
from casest.leastsquares.identifiability import identify
from casest.leastsquares.problem import Problem
from casest.results.find import find_model


def as_run(**signals):
    columns = {n: np.asarray(s, float).reshape(len(s), -1) for n, s in signals.items()}
    return Run.raw("r", columns, units={})


@model
def turned(
    angle=signal("rad"),
    v=signal(3, "m/s^2"),
    *,
    offset=param(3, "m/s^2"),
    gain=param(3, start=1.0),
    tilt=constant(0.5, "rad"),
    gravity=constant(9.8, "m/s^2"),
):
    """A triad turned about an axis that is tilted once: z always sees the same."""
    a = vertcat(sin(tilt) * cos(angle), sin(tilt) * sin(angle), cos(tilt)) * gravity
    return Residual(measured=v, predicted=quantity("reading", offset + gain * a, "m/s^2"))


def turned_run(tilt=0.5, sigma=0.01, seed=0, n=40):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, n)
    s, c = 9.8 * np.sin(tilt), 9.8 * np.cos(tilt)
    a = np.column_stack([s * np.cos(angle), s * np.sin(angle), np.full(n, c)])
    return as_run(angle=angle, v=a + sigma * rng.standard_normal((n, 3)))


def test_one_tilt_cannot_tell_offset_and_gain_of_the_constant_axis_apart():
    found = attempt(turned, [turned_run()]).identifiability
    assert (found.rank, found.unknowns) == (5, 6)
    (words,) = found.unobservable
    assert "`gain[2]`" in words
    assert "`offset[2]`" in words
    assert "cannot be told apart" in words
    assert "`offset[0]`" not in words
    # δoffset + δgain·g·cos(tilt) = 0: along it one changes −8.6 times the other
    ratio = float(words.rstrip(")").split()[-1])
    slope = -9.8 * np.cos(0.5)
    assert ratio in (pytest.approx(slope, rel=5e-3), pytest.approx(1 / slope, rel=5e-3))


def test_the_null_space_holds_that_direction_and_no_other():
    problem = Problem(turned, (turned_run(),))
    found = identify(problem, problem.start())
    i, j = problem.names.index("offset[2]"), problem.names.index("gain[2]")
    expected = np.zeros(6)
    expected[i], expected[j] = 9.8 * np.cos(0.5), -1.0
    expected /= np.linalg.norm(expected)
    assert found.null.shape == (6, 1)
    assert abs(found.null[:, 0] @ expected) == pytest.approx(1.0, abs=1e-10)
    assert set(np.flatnonzero(found.touched)) == {i, j}
    np.testing.assert_allclose(problem.jacobian(problem.start()) @ found.null, 0, atol=1e-12)


def test_only_what_the_null_direction_touches_is_undetermined():
    found = attempt(turned, [turned_run()])
    np.testing.assert_array_equal(np.isnan(found.std["gain"]), [False, False, True])
    np.testing.assert_array_equal(np.isnan(found.std["offset"]), [False, False, True])


def test_unknown_tilts_are_determined_from_the_third_on():
    # x and y see gain·sin(tilt), z sees offset + gain·cos(tilt): two tilts leave the size of the
    # sines free, for offset and gain of z fit any two cosines; a third cosine does not follow.
    tilts = [0.5, 1.2, 0.9]
    tilted = turned.having(tilt=param("rad", start=0.5, per="run"))
    runs = tuple(turned_run(tilt, seed=k) for k, tilt in enumerate(tilts))
    two, three = Problem(tilted, runs[:2]), Problem(tilted, runs)
    found = identify(two, two.point({"tilt": tilts[:2]}))
    assert (found.rank, found.unknowns) == (7, 8)
    found = identify(three, three.point({"tilt": tilts}))
    assert (found.rank, found.unknowns) == (9, 9)
    assert found.unobservable == ()


def test_ranks_do_not_depend_on_units():
    @model
    def mixed(x=signal(3), y=signal(), *, a=param(), b=param(), c=param()):
        return Residual(measured=y, predicted=1e-12 * a * x[0] + 1e9 * b * x[1] + c * x[2])

    rng = np.random.default_rng(0)
    problem = Problem(mixed, (as_run(x=rng.standard_normal((20, 3)), y=np.zeros(20)),))
    found = identify(problem, problem.start())
    assert found.rank == 3
    assert found.singular_values.max() / found.singular_values.min() < 10


def test_a_parameter_that_no_residual_contains_is_named_alone():
    @model
    def idle(x=signal(), y=signal(), *, slope=param(), ghost=param()):
        return Residual(measured=y, predicted=slope * x + 0.0 * ghost * x)

    rng = np.random.default_rng(0)
    x = rng.standard_normal(20)
    found = attempt(idle, [as_run(x=x, y=x + 0.1 * rng.standard_normal(20))])
    assert found.identifiability.unobservable == (
        "`ghost` changes no residual: these data do not contain it",
    )
    assert not found.certificate.trusted
    assert np.isnan(found.std["ghost"])
    assert np.isfinite(found.std["slope"])


def test_parameters_that_the_record_never_excites_are_named_alone():
    @model
    def triad(x=signal(3), y=signal(), *, s=param(3)):
        return Residual(measured=y, predicted=s.T @ x)

    rng = np.random.default_rng(0)
    x = rng.standard_normal((20, 3)) * [1, 0, 1]
    found = attempt(triad, [as_run(x=x, y=x @ [1, 2, 3] + 0.1 * rng.standard_normal(20))])
    assert found.identifiability.unobservable == (
        "`s[1]` changes no residual: these data do not contain it",
    )


def test_several_null_directions_are_told_apart_by_few_names_each():
    @model
    def pairs(x=signal(2), y=signal(2), *, a=param(2), b=param(2)):
        return Residual(measured=y, predicted=(a + b) * x)

    rng = np.random.default_rng(0)
    x = rng.standard_normal((20, 2))
    found = attempt(pairs, [as_run(x=x, y=x + 0.1 * rng.standard_normal((20, 2)))])
    named = sorted(
        tuple(sorted(n for n in ("`a[0]`", "`a[1]`", "`b[0]`", "`b[1]`") if n in words))
        for words in found.identifiability.unobservable
    )
    assert named == [("`a[0]`", "`b[0]`"), ("`a[1]`", "`b[1]`")]


def test_the_three_null_directions_of_the_full_scale_are_rotations_of_the_sensor_frame():
    rng = np.random.default_rng(0)
    sensor = sim.accelerometer(rng)
    v = sensor.read(sim.sphere(30, rng), 5e-3, rng)
    declared = find_model("norm-full").having(norm=sim.GRAVITY)
    found = attempt(declared, [as_run(v=v)])
    assert (found.identifiability.rank, found.identifiability.unknowns) == (9, 12)
    assert len(found.identifiability.unobservable) == 3
    for axis, words in zip("xyz", found.identifiability.unobservable, strict=True):
        assert words.startswith(f"a rotation of the sensor frame about {axis}:")
        assert "`scale`" in words
    assert not found.certificate.trusted
    assert np.all(np.isnan(found.std["scale"]))
    assert np.all(np.isfinite(found.std["offset"]))


def test_a_rotation_from_the_left_changes_no_residual_of_the_full_scale():
    rng = np.random.default_rng(1)
    problem = Problem(
        find_model("norm-full").having(norm=sim.GRAVITY),
        (as_run(v=sim.GRAVITY * sim.sphere(20, rng)),),
    )
    S, o = np.eye(3) + 0.1 * rng.standard_normal((3, 3)), rng.standard_normal(3)
    turned_scale = sim.random_rotation(rng) @ S
    lower = problem.bounds[0]
    a = problem.point({"scale": S, "offset": o})
    b = type(a)(np.where(lower == 0, a.x, a.x), a.references)
    b.x[[problem.names.index(f"scale[{i},{j}]") for i in range(3) for j in range(3)]] = (
        turned_scale.ravel()
    )
    np.testing.assert_allclose(problem.residuals(a)[0], problem.residuals(b)[0], atol=1e-12)


def test_a_weak_direction_is_named_with_its_inflation_and_standard_deviation():
    @model
    def straight(x=signal("s"), y=signal("V"), *, slope=param("V/s"), level=param("V")):
        return Residual(measured=y, predicted=level + slope * x)

    rng = np.random.default_rng(0)
    x = 10 + 0.2 * rng.standard_normal(50)  # far from zero: level and slope are one
    run = as_run(x=x, y=3 + 2 * x + 0.1 * rng.standard_normal(50))
    found = attempt(straight, [run])
    (weak,) = found.weak
    A = np.column_stack([x, np.ones(50)])
    norms = np.linalg.norm(A, axis=0)
    singular = np.linalg.svd(A / norms, compute_uv=False)
    assert weak.inflation == pytest.approx(1 / singular[-1], rel=1e-9)
    assert "slope" in weak.words
    assert "level" in weak.words
    # that direction carries all but a hundredth of the level's own uncertainty
    level = float(found.plain["level"])
    slope = float(found.plain["slope"])
    assert weak.std == pytest.approx(level if weak.unit == "V" else slope, rel=0.01)
    covariance = found.noise.sigma**2 * np.linalg.inv(A.T @ A)
    assert slope == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-7)
    assert level == pytest.approx(np.sqrt(covariance[1, 1]), rel=1e-7)


def test_orthogonal_parameters_are_not_called_weak():
    @model
    def straight(x=signal(), y=signal(), *, slope=param(), level=param()):
        return Residual(measured=y, predicted=level + slope * x)

    x = np.linspace(-1, 1, 30)
    rng = np.random.default_rng(0)
    assert attempt(straight, [as_run(x=x, y=x + 0.1 * rng.standard_normal(30))]).weak == ()


def test_a_parameter_that_only_the_best_fit_does_without_is_said_so():
    """Readings below zero of a model that has none: its size ends at nothing, and its rate with it;
    that the data do not contain these would be wrong."""

    @model
    def fading(x=signal(), y=signal(), *, size=param(start=1.0, bounds=(0, None)), rate=param()):
        return Residual(measured=y, predicted=size * exp(-rate * x))

    rng, x = np.random.default_rng(0), np.linspace(0, 2, 40)
    found = attempt(fading, [as_run(x=x, y=-1 + 0.1 * rng.standard_normal(40))])
    assert not found.certificate.trusted
    (words,) = [w for w in found.identifiability.unobservable if "`rate`" in w]
    assert words.startswith("`rate` changes no residual at the best fit, though it does where")
