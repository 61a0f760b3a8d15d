"""One least-squares problem from model and runs: layout, derivatives, scope, weights."""

from __future__ import annotations

import numpy as np
import pytest
from models.wheel import wheel

from casest import (
    DataError,
    Residual,
    Run,
    UsageError,
    attitude,
    inf,
    model,
    param,
    quantity,
    rotation_matrix,
    signal,
    sin,
    unit_vector,
)
from casest.estimate.calibrate import attempt
from casest.leastsquares.problem import Point, Problem


@model
def line(
    x=signal("V"),
    y=signal("V"),
    *,
    slope=param(start=1.0),
    level=param("V", per="run"),
    bend=param("1/V", bounds=(-2.0, 2.0)),
):
    """A parabola whose level differs from run to run."""
    return Residual(measured=y, predicted=quantity("reading", level + slope * x + bend * x**2, "V"))


def recorded(levels, *, slope=2.0, bend=0.3, noise=0.01, n=25, seed=0, ids=None):
    rng = np.random.default_rng(seed)
    runs = []
    for k, level in enumerate(levels):
        x = rng.uniform(-1, 1, (n + k, 1))
        y = level + slope * x + bend * x**2 + noise * rng.standard_normal(x.shape)
        runs.append(Run.raw(f"r{k}", {"x": x, "y": y}, units={}))
    return tuple(runs)


def turning_wheel(n, seed, phase):
    """Runs need not obey the model: derivatives hold everywhere."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1.5, n)
    v = 10 * rng.standard_normal((n, 3))
    return Run.raw(f"wheel{phase}", {"t": t[:, None], "v": v}, units={}, time=t)


@model
def mounted(
    a=signal(3),
    R=attitude(),
    *,
    M=param(rotation_matrix),
    up=param(unit_vector, per="run"),
    k=param(start=1.0),
):
    """Curved parameters, one of them per run."""
    return Residual(measured=a, predicted=quantity("reading", k * (M @ R.T @ up) + sin(up)))


def wheel_problem(weighted):
    runs = (turning_wheel(12, 0, 0), turning_wheel(17, 1, 1))
    rng = np.random.default_rng(2)
    weights = tuple(rng.uniform(0.1, 2, (len(r), 3)) for r in runs) if weighted else None
    problem = Problem(wheel, runs, weights)
    values = {
        "offset": [0.1, -0.2, 0.3],
        "gain": [1.1, 0.9, 1.05],
        "misalignment": rng.normal(0, 0.2, (2, 3)),
        "tilt": [0.5, 0.9],
        "phase": [0.2, -1.0],
        "speed": rng.normal([5.0, 0, 0, 0], 1.0, (2, 4)),
    }
    return problem, problem.point(values)


def mounted_problem():
    rng = np.random.default_rng(5)
    runs = []
    for k in range(2):
        q = np.linalg.qr(rng.standard_normal((8, 3, 3)))[0]
        q = q * np.linalg.det(q)[:, None, None]
        signals = {"a": rng.standard_normal((8, 3)), "R": q.reshape(8, 9)}
        runs.append(Run.raw(f"r{k}", signals, units={}))
    problem = Problem(mounted, tuple(runs))
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    up = rng.standard_normal((2, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    point = problem.point({"M": turn * np.linalg.det(turn), "up": up, "k": 1.3})
    # away from the charts' origins, so that their curvature takes part
    return problem, Point(point.x + 0.1 * rng.standard_normal(point.x.size), point.references)


def differences(f, x, h=1e-5):
    """Central differences, (values, n)."""
    columns = [(np.ravel(f(x + e)) - np.ravel(f(x - e))) / (2 * h) for e in h * np.eye(len(x))]
    return np.column_stack(columns)


CASES = {
    "two runs": lambda: wheel_problem(False),
    "weighted": lambda: wheel_problem(True),
    "curved": mounted_problem,
}


@pytest.mark.parametrize("case", CASES)
def test_the_jacobian_agrees_with_finite_differences(case):
    problem, point = CASES[case]()
    numeric = differences(
        lambda x: np.concatenate(
            [r.ravel() for r in problem.residuals(Point(x, point.references))]
        ),
        point.x,
    )
    scale = np.abs(numeric).max()
    np.testing.assert_allclose(problem.jacobian(point), numeric, atol=1e-7 * scale)


@pytest.mark.parametrize("case", CASES)
def test_gradient_and_exact_hessian_agree_with_finite_differences_of_the_cost(case):
    problem, point = CASES[case]()
    gradient = differences(lambda x: problem.cost(Point(x, point.references)), point.x).ravel()
    found = problem.normal(point)
    np.testing.assert_allclose(found.gradient, gradient, atol=1e-7 * np.abs(gradient).max())
    hessian = differences(lambda x: problem.normal(Point(x, point.references)).gradient, point.x)
    np.testing.assert_allclose(problem.hessian(point), hessian, atol=1e-7 * np.abs(hessian).max())


@pytest.mark.parametrize("case", CASES)
def test_cost_gradient_matrix_and_factor_are_those_of_the_whole_weighted_jacobian(case):
    problem, point = CASES[case]()
    r = np.concatenate([r.ravel() for r in problem.residuals(point)])
    J = problem.jacobian(point)
    w = np.ones_like(r)
    if problem.weights is not None:
        w = np.concatenate([w.ravel() for w in problem.weights])
    found = problem.normal(point)
    assert problem.cost(point) == pytest.approx(0.5 * np.sum(w * r**2), rel=1e-13)
    assert found.cost == pytest.approx(0.5 * np.sum(w * r**2), rel=1e-13)
    np.testing.assert_allclose(found.gradient, J.T @ (w * r), rtol=1e-9, atol=1e-9)
    normal = (J * w[:, None]).T @ J
    np.testing.assert_allclose(found.matrix, normal, rtol=1e-9, atol=1e-9 * np.abs(normal).max())
    R, t, rest = problem.factor(point)
    np.testing.assert_allclose(R.T @ R, normal, rtol=1e-9, atol=1e-9 * np.abs(normal).max())
    np.testing.assert_allclose(R.T @ t, J.T @ (w * r), rtol=1e-8, atol=1e-8)
    assert t @ t + rest**2 == pytest.approx(np.sum(w * r**2), rel=1e-12)


def test_the_hessian_of_the_weighted_wheel_is_not_the_gauss_newton_one():
    problem, point = wheel_problem(True)
    found = problem.normal(point).matrix
    assert np.abs(problem.hessian(point) - found).max() > 1e-3 * np.abs(found).max()


# -- layout ---------------------------------------------------------------------------------------


def test_shared_unknowns_come_first_and_then_each_runs_own():
    problem = Problem(line, recorded([0.0, 1.0]))
    assert problem.unknowns == 4
    assert problem.names == ("slope", "bend", "level (r0)", "level (r1)")
    assert problem.units == ("", "1/V", "V", "V")
    assert problem.residual_count == 25 + 26


def test_with_one_run_names_say_nothing_of_runs():
    assert Problem(line, recorded([0.0])).names == ("slope", "bend", "level")


def test_curved_parameters_are_named_by_their_tangents():
    problem, _ = mounted_problem()
    assert problem.names[:4] == ("M (tangent 0)", "M (tangent 1)", "M (tangent 2)", "k")
    assert problem.names[4:] == tuple(f"up (tangent {k}) (r{r})" for r in (0, 1) for k in (0, 1))
    assert problem.units[0] == "rad"
    assert problem.unknowns == 3 + 1 + 2 * 2


def test_values_go_in_and_come_out():
    problem = Problem(line, recorded([0.0, 1.0]))
    values = {"slope": 1.5, "bend": -0.5, "level": [0.25, 0.75]}
    found = problem.values(problem.point(values))
    assert found["slope"] == 1.5
    assert found["bend"] == -0.5
    np.testing.assert_array_equal(found["level"], [0.25, 0.75])


def test_one_value_of_a_per_run_parameter_stands_for_all_runs():
    problem = Problem(line, recorded([0.0, 1.0]))
    np.testing.assert_array_equal(problem.values(problem.point({"level": 3.0}))["level"], [3, 3])


def test_a_point_with_an_unknown_name_is_refused():
    with pytest.raises(UsageError, match="model line has no parameter 'slop'"):
        Problem(line, recorded([0.0])).point({"slop": 1.0})


def test_a_start_outside_the_bounds_is_moved_just_inside():
    problem = Problem(line, recorded([0.0]))
    for asked, bound in ((5.0, 2.0), (-5.0, -2.0), (2.0, 2.0)):
        bend = float(problem.values(problem.point({"bend": asked}))["bend"])
        assert abs(bend) < 2.0
        assert bend == pytest.approx(bound, abs=1e-6)


def test_data_may_tighten_the_declared_bounds_but_not_widen_them():
    tight = line.bounded(lambda model, runs: {"bend": (-0.5, 50.0), "slope": (0.0, inf)})
    lower, upper = Problem(tight, recorded([0.0])).bounds
    names = Problem(tight, recorded([0.0])).names
    k, s = names.index("bend"), names.index("slope")
    assert (lower[k], upper[k]) == (-0.5, 2.0)
    assert (lower[s], upper[s]) == (0.0, inf)


def test_a_start_outside_the_bounds_still_finds_the_optimum():
    runs = recorded([0.5])
    found = attempt(line, runs, start={"bend": 100.0, "slope": -30.0})
    assert found.certificate.trusted
    np.testing.assert_allclose(found.values["bend"], 0.3, atol=0.05)


def test_a_signal_that_a_run_lacks_is_named():
    run = Run.raw("r", {"x": np.ones((3, 1))}, units={}, file="r.csv")
    with pytest.raises(DataError, match=r"r\.csv: no data for signal 'y'; add --columns"):
        _ = Problem(line, (run,)).samples


# -- scope ----------------------------------------------------------------------------------------


def direct(runs):
    """The same parabola by numpy's least squares, levels per run: (slope, bend, levels)."""
    rows, right = [], []
    for k, run in enumerate(runs):
        x = run.signals["x"].ravel()
        level = np.zeros((len(x), len(runs)))
        level[:, k] = 1
        rows.append(np.column_stack([x, x**2, level]))
        right.append(run.signals["y"].ravel())
    A, b = np.vstack(rows), np.concatenate(right)
    solution, squares = np.linalg.lstsq(A, b, rcond=None)[:2]
    covariance = squares[0] / (len(b) - A.shape[1]) * np.linalg.inv(A.T @ A)
    return solution, np.sqrt(np.diag(covariance))


def test_shared_and_per_run_parameters_together_are_one_linear_regression():
    runs = recorded([0.5, -1.0, 2.0])
    found = attempt(line, runs)
    solution, std = direct(runs)
    estimate = [found.values["slope"], found.values["bend"], *found.values["level"]]
    spread = [found.plain["slope"], found.plain["bend"], *found.plain["level"]]
    np.testing.assert_allclose(estimate, solution, rtol=1e-9)
    np.testing.assert_allclose(spread, std, rtol=1e-8)


def test_with_everything_per_run_a_joint_fit_equals_separate_fits():
    runs = recorded([0.5, -1.0])
    apart = line.scoped("slope", "run").scoped("bend", "run")
    joint = attempt(apart, runs)
    for k, run in enumerate(runs):
        alone = attempt(line, (run,))
        for name in ("slope", "bend", "level"):
            assert joint.values[name][k] == pytest.approx(float(alone.values[name]), rel=1e-9)


def test_with_everything_shared_the_fit_equals_that_of_the_pooled_record():
    runs = recorded([0.5, 0.5])
    shared = line.scoped("level", "all")
    pooled = {n: np.vstack([r.signals[n] for r in runs]) for n in ("x", "y")}
    joint, whole = attempt(shared, runs), attempt(line, (Run.raw("p", pooled, units={}),))
    for name in ("slope", "bend", "level"):
        assert float(joint.values[name]) == pytest.approx(float(whole.values[name]), rel=1e-9)
        assert float(joint.std[name]) == pytest.approx(float(whole.std[name]), rel=1e-9)


# -- weights --------------------------------------------------------------------------------------


def test_a_weight_counts_like_that_many_equal_samples():
    run = recorded([0.5])[0]
    twice = Run.raw("r", {n: np.vstack([s, s[:10]]) for n, s in run.signals.items()}, units={})
    weights = np.ones((25, 1))
    weights[:10] = 2.0
    weighted, plain = Problem(line, (run,), (weights,)), Problem(line, (twice,))
    point = plain.point({"slope": 1.0, "bend": 0.1, "level": 0.2})
    assert weighted.cost(point) == pytest.approx(plain.cost(point), rel=1e-14)
    np.testing.assert_allclose(weighted.normal(point).matrix, plain.normal(point).matrix)
    np.testing.assert_allclose(weighted.hessian(point), plain.hessian(point))
