"""Is it the right valley? What rows say without a model, and what a search finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import valleys
from valleys import sine, sine_and_level, step, wrapped

from casest import (
    NotTrusted,
    Residual,
    Run,
    attempt,
    calibrate,
    exp,
    fabs,
    model,
    param,
    signal,
)
from casest.effects import signal_lag
from casest.estimate.calibrate import _estimate
from casest.estimate.certificate import Certificate
from casest.estimate.evidence import Evidence, judged
from casest.estimate.valley import searchable
from casest.leastsquares.many_points import normals, separable
from casest.leastsquares.neighbours import Scatter, scatter
from casest.leastsquares.problem import Problem
from casest.solve.aliases import periods
from casest.solve.global_search import Search
from casest.solve.outcome import Outcome
from casest.solve.reach import reach


def as_run(**signals):
    columns = {n: np.asarray(s, float).reshape(len(s), -1) for n, s in signals.items()}
    return Run.raw("r", columns, units={}, file="r.csv")


#: On no level of its own.
peak = valleys.peak.having(level=0.0)


def sine_run(w=9.0, p=0.5, n=80, noise=0.05, seed=0, even=True, shuffled=False, unit=1.0):
    rng = np.random.default_rng(seed)
    x = np.linspace(0, 10, n) if even else np.sort(rng.uniform(0, 10, n))
    x = rng.permutation(x) if shuffled else x
    return as_run(x=unit * x, y=np.sin(w * x + p) + noise * rng.standard_normal(n))


def test_a_search_looks_at_the_function_that_is_fitted():
    """Else it finds valleys of another one: of many points at once no lag was followed, and a model
    with one was searched all the same."""
    rng = np.random.default_rng(3)
    t = np.arange(0, 20, 0.05)
    course = np.cumsum(rng.standard_normal(len(t))) * 0.2
    late = np.interp(t - 0.3, t, course)
    run = replace(as_run(x=course, y=np.sin(2 * late + 0.4)), time=t)
    delayed = sine.with_effect(signal_lag, on="x")
    for one in (sine, delayed):
        problem = Problem(one, (run,))
        x = np.array([2.0, 0.4, 0.3][: problem.unknowns])
        (many,) = normals(problem, problem.start().references, x[None], np.arange(len(x)))
        right = many.cost[0] == pytest.approx(problem.cost(replace(problem.start(), x=x)))
        assert right == searchable(one)


# -- the scatter of neighbours ---------------------------------------------------------------------


def noise_of(declared, run, values):
    problem = Problem(declared, (run,))
    return scatter(problem, problem.point(values))


@pytest.mark.parametrize("shuffled", [False, True])
def test_neighbours_tell_the_noise_whatever_the_model_and_the_order_of_rows(shuffled):
    run = sine_run(w=3.0, n=500, noise=0.05, shuffled=shuffled)
    for values in ({"w": 3.0, "p": 0.5}, {"w": 0.1, "p": 0.0}):
        found = noise_of(sine, run, values)
        # the standard error of 500 pseudo-residuals' deviation is 4.4 %
        assert np.sqrt(found.neighbours) == pytest.approx(0.05, rel=0.15)


def test_a_slope_is_no_noise():
    @model
    def line(x=signal(), y=signal(), *, a=param(start=1.0)):
        return Residual(measured=y, predicted=exp(a) * x)

    rng = np.random.default_rng(0)
    x = rng.uniform(0, 1, 300)
    found = noise_of(line, as_run(x=x, y=1e4 * x + 0.1 * rng.standard_normal(300)), {"a": 1.0})
    assert np.sqrt(found.neighbours) == pytest.approx(0.1, rel=0.15)


def test_in_two_inputs_neighbours_are_near_in_both_and_a_column_that_is_not_read_is_none():
    @model
    def plane(x=signal(), z=signal(), other=signal(), y=signal(), *, a=param(start=1.0), b=param()):
        return Residual(measured=y, predicted=exp(a) * x + b * z)

    rng = np.random.default_rng(1)
    x, z = rng.uniform(0, 1, (2, 600))
    y = 300 * x - 200 * z + 5 * np.sin(4 * x) * z + 0.1 * rng.standard_normal(600)
    run = as_run(x=x, z=z, other=1e6 * rng.standard_normal(600), y=y)
    found = noise_of(plane, run, {"a": 1.0, "b": 0.0})
    assert np.sqrt(found.neighbours) == pytest.approx(0.1, rel=0.15)


def test_noise_alone_is_called_a_misfit_no_more_often_than_stated():
    low = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        x = rng.uniform(0, 10, 40)
        run = as_run(x=x, y=np.sin(0.3 * x) + 0.1 * rng.standard_normal(40))
        low += noise_of(sine, run, {"w": 0.3, "p": 0.0}).p_value() < 0.01
    assert low <= 8  # of 300 at a level of 0.01: more than 8 once in 200


def test_what_neighbours_cannot_resolve_is_not_called_resolved():
    few = noise_of(sine, sine_run(w=9.0, n=32), {"w": 1.0, "p": 0.0})  # 2.9 rad from row to row
    many = noise_of(sine, sine_run(w=9.0, n=400), {"w": 1.0, "p": 0.0})
    assert few.resolved < 0.1
    assert many.resolved > 0.9


# -- what is searched ------------------------------------------------------------------------------


def test_unknowns_that_enter_linearly_are_projected_out():
    assert separable(sine_and_level) == (0, 3)
    assert separable(sine) == ()
    assert separable(peak) == (0,)


def test_a_slope_of_one_is_no_line_where_an_angle_is_wrapped_or_bent():
    @model
    def corner(x=signal(), y=signal(), *, a=param(start=1.0), c=param()):
        return Residual(measured=y, predicted=a * fabs(x - c))

    assert separable(wrapped) == ()
    assert separable(corner) == (0,)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_the_reach_of_a_frequency_ends_where_rows_cannot_follow_in_any_unit(unit):
    problem = Problem(sine, (sine_run(n=101, unit=unit),))
    pieces = reach(problem, problem.start(), [0])[0]
    fastest = np.pi / (0.1 * unit)
    assert fastest <= max(p.high for p in pieces) <= 3 * fastest


def test_the_reach_keeps_bounds_and_covers_the_places_that_the_data_span():
    run = as_run(x=np.linspace(100, 120, 50), y=np.zeros(50))
    bounded = peak.having(place=param(start=110.0, bounds=(105.0, 200.0)))
    problem = Problem(bounded, (run,))
    pieces = reach(problem, problem.start(), [1, 2])
    values = np.concatenate([p.at(np.linspace(0, 1, 50)) for p in pieces[1]])
    assert values.min() >= 105.0
    assert values.max() <= 200.0
    assert np.abs(values[:, None] - np.linspace(105, 120, 16)).min(axis=0).max() < 1.0
    assert all(p.low > 0 and p.sign > 0 for p in pieces[2])


# -- whole fits ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("w", "shuffled"),
    [(9.3, True)]
    + [
        pytest.param(*far, marks=pytest.mark.long)
        for far in [(4.7, False), (4.7, True), (9.3, False), (14.1, True), (14.1, False)]
    ],
)
def test_a_far_frequency_is_found_whatever_the_order_of_rows(w, shuffled):
    found = attempt(sine, [sine_run(w=w, shuffled=shuffled, seed=3)])
    assert found.certificate.trusted, found.certificate.reasons
    assert abs(float(found.values["w"]) - w) < 5 * float(found.std["w"])
    assert "no lower valley in a search over what the data span" in found.certificate.reasons[-1]


def test_a_peak_far_from_the_start_is_found():
    rng = np.random.default_rng(0)
    x = np.linspace(0, 10, 120)
    y = 2 * np.exp(-0.5 * ((x - 8) / 0.3) ** 2) + 0.05 * rng.standard_normal(120)
    found = attempt(peak, [as_run(x=x, y=y)])
    assert found.certificate.trusted, found.certificate.reasons
    assert float(found.values["place"]) == pytest.approx(8.0, abs=0.05)


@pytest.mark.long
def test_the_same_data_give_the_same_answer():
    first, second = (attempt(sine, [sine_run()]) for _ in range(2))
    np.testing.assert_array_equal(first.point.x, second.point.x)
    assert first.certificate.reasons == second.certificate.reasons


def test_where_neighbours_vouch_for_the_fit_or_the_start_is_computed_nothing_is_searched():
    near = sine.having(w=param(start=3.0))
    vouched = attempt(near, [sine_run(w=3.0, n=200)])
    assert vouched.evidence.search is None
    assert vouched.evidence.vouched
    computed = sine.starting(lambda model, runs: {"w": 9.0, "p": 0.5})
    assert attempt(computed, [sine_run()]).evidence is None


def test_noise_is_no_sine():
    rng = np.random.default_rng(4)
    run = as_run(x=np.linspace(0, 10, 80), y=rng.standard_normal(80))
    with pytest.raises(NotTrusted, match=r"no better than chance: .* valleys were seen"):
        calibrate(sine_and_level, [run])


@pytest.mark.long
def test_a_misfit_that_is_left_after_a_search_is_remarked():
    """Two sines where the model has one: its optimum is right, and the model is not."""
    x = np.linspace(0, 10, 200)
    rng = np.random.default_rng(0)
    y = np.sin(3 * x) + 0.5 * np.sin(7 * x) + 0.05 * rng.standard_normal(200)
    found = attempt(sine_and_level, [as_run(x=x, y=y)])
    assert found.certificate.trusted, found.certificate.reasons
    assert float(found.values["w"]) == pytest.approx(3.0, abs=0.1)
    assert any("times what rows with nearly the same inputs differ by" in n for n in found.notes)


def test_a_solution_under_other_names_is_no_second_one():
    """sin(wx + p) with −w and π − p: the one most like the start is given."""
    found = attempt(sine_and_level, [sine_run(w=3.0, p=2.0, n=200, even=False)])
    assert found.certificate.trusted, found.certificate.reasons
    assert float(found.values["w"]) > 0
    assert abs(float(found.values["p"])) <= np.pi


# -- aliases ---------------------------------------------------------------------------------------


@pytest.mark.long
def test_rates_that_even_rows_cannot_tell_apart_are_named_unless_bounds_leave_them_out():
    run = sine_run(w=5.0, n=81)
    found = attempt(sine, [run])
    assert found.certificate.trusted
    named = next(n for n in found.notes if n.startswith("evenly spaced rows"))
    assert f"`w` ± {2 * np.pi / 0.125:.6g}" in named
    bounded = attempt(sine.having(w=param(start=1.0, bounds=(0.0, 20.0))), [run])
    assert not any(n.startswith("evenly spaced rows") for n in bounded.notes)


@pytest.mark.long
def test_of_rates_that_fit_alike_the_slowest_is_given_unless_a_start_says_otherwise():
    run = sine_run(w=5.0, n=81)
    declared = attempt(sine.having(w=param(start=55.0)), [run])
    assert abs(float(declared.values["w"])) == pytest.approx(5.0, abs=0.02)
    stated = attempt(sine, [run], start={"w": 5 + 2 * np.pi / 0.125})
    assert float(stated.values["w"]) == pytest.approx(5 + 2 * np.pi / 0.125, abs=0.02)


def test_rows_at_random_have_no_alias():
    for even, known in ((True, {0: 2 * np.pi / 0.125}), (False, {})):
        problem = Problem(sine, (sine_run(n=81, even=even),))
        assert periods(problem, problem.start()) == pytest.approx(known, rel=1e-9)


# -- what is refused, in words ---------------------------------------------------------------------


def believed():
    return Certificate(True, ("a", "b", "c", "d"), 0.0, 0.0, 1.0, 2, 0, (1.0, 1.0), ())


def a_search(arrived=0, rivals=(), x=1.0):
    problem = Problem(sine, (sine_run(),))
    end = Outcome("s", problem.point({"w": x}), 1.0, 1, 1, True, "converged", 0.0)
    return problem, Search(end, 512, 100, arrived, 40, 2, tuple(rivals))


def refusal(scatter, search, problem):
    found = judged(problem, believed(), Evidence(scatter, search))
    assert not found.trusted
    return found.reasons[0]


def test_a_course_that_is_left_and_a_rare_valley_are_refused_with_both_shares():
    problem, search = a_search(arrived=2)
    left = Scatter(0.01, 0.8, 1.0, 0.01, (78.0, 40.0))
    text = refusal(left, search, problem)
    assert text.startswith("it explains 20 % of the readings' variance, of which rows with nearly")
    assert "the same inputs share 99 %" in text
    assert "--start" in text


def test_a_search_goes_on_beside_a_misfit_unless_most_of_its_starts_end_in_one_valley():
    """Else a larger one, that is refused nothing either, looks for what is smaller still."""
    left = Scatter(0.2, 0.8, 1.0, 0.01, (78.0, 40.0))
    for arrived, enough in ((20, False), (49, False), (50, True)):
        _, search = a_search(arrived=arrived)
        assert Evidence(left, search).settled == enough


def test_without_neighbours_a_valley_that_was_found_once_is_refused():
    problem, search = a_search(arrived=1)
    text = refusal(None, search, problem)
    assert text.startswith("100 starts over what the data span ended in 40 places, 1 of them here")
    assert "--start" in text


def test_two_valleys_that_the_data_hardly_tell_apart_are_refused_with_both_values():
    _, other = a_search(x=7.0)
    problem, search = a_search(arrived=50, rivals=[other.outcome])
    text = refusal(Scatter(0.5, 0.5, 1.0, 0.5, (78.0, 40.0)), search, problem)
    assert text.startswith("two valleys fit nearly alike: `w` = 1 and 7; give bounds")


def step_run():
    rng = np.random.default_rng(0)
    x = np.linspace(0, 10, 80)
    return as_run(x=x, y=1 - 2 / (1 + np.exp(-(x - 5) / 0.3)) + 0.1 * rng.standard_normal(80))


def test_a_way_that_ends_where_a_derivative_overflows_is_one_of_many():
    """From a place far below all rows the width goes to zero, where exp(∞) is no slope."""
    found = attempt(step, [step_run()])
    assert found.certificate.trusted, found.certificate.reasons
    assert float(found.values["place"]) == pytest.approx(5.0, abs=0.2)


def test_a_derivative_that_overflows_at_the_best_point_is_refused_for_that_reason():
    problem = Problem(step, (step_run(),))
    values = {"level": 0.0, "height": 1.0, "place": -20.0, "width": 0.0}
    point = replace(problem.start(), x=np.array(list(values.values())))
    best = Outcome("claimed", point, problem.cost(point), 1, 1, True, "Solve_Succeeded", 0.0)
    with np.errstate(all="ignore"):
        found = _estimate(problem, best, (best,), 0.0)
    assert not found.certificate.trusted
    assert found.certificate.reasons[0].startswith("a derivative of the residual is not finite")
    assert "--start" in found.certificate.reasons[0]
