"""What is believed and what is not: the certificate judges the point, not the way to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from casest import (
    DataError,
    NotTrusted,
    Residual,
    Run,
    UsageError,
    calibrate,
    exp,
    inf,
    log,
    model,
    param,
    rotation_matrix,
    signal,
    sin,
    unit_vector,
    vertcat,
)
from casest.estimate.calibrate import attempt
from casest.estimate.certificate import certify
from casest.leastsquares.identifiability import identify
from casest.leastsquares.problem import Problem
from casest.solve.outcome import Outcome
from casest.solve.trust_region import trust_region


def as_run(**signals):
    columns = {n: np.asarray(s, float).reshape(len(s), -1) for n, s in signals.items()}
    return Run.raw("r", columns, units={}, file="r.csv")


def judged(problem, values, others=()):
    """Certificate of a point that some solver is supposed to have returned."""
    point = problem.point(values)
    factor = problem.factor(point)
    best = Outcome("claimed", point, problem.cost(point), 1, 1, True, "Solve_Succeeded", 0.0)
    dof = max(problem.residual_count - problem.unknowns, 1)
    sigma = float(np.sqrt(2 * best.cost / dof))
    return certify(problem, best, others, identify(problem, point), factor, sigma)


@model
def well(x=signal(), y=signal(2), *, a=param(start=1.0)):
    """Residual (a² − 1, 0.1): minima at ±1, a maximum of the cost at 0."""
    return Residual(measured=y, predicted=vertcat(a**2, 0 * a))


@model
def saddle(x=signal(), y=signal(2), *, a=param(start=1.0), b=param(start=0.0)):
    """Residual (b + 0.1ab, a² − 1): at a = 0, b = 0 the cost falls along a and rises along b."""
    return Residual(measured=y, predicted=vertcat(b + 0.1 * a * b, a**2 + 0.5 * a))


@model
def wave(x=signal(), y=signal(), *, w=param(start=1.0)):
    """The frequency of a sine: a cost with many local minima."""
    return Residual(measured=y, predicted=sin(w * x))


@model
def decay(x=signal(), y=signal(), *, a=param(start=1.0), k=param(start=1.0)):
    return Residual(measured=y, predicted=a * exp(-k * x))


@model
def straight(x=signal(), y=signal(), *, slope=param(), level=param()):
    return Residual(measured=y, predicted=level + slope * x)


# -- points that are no optimum -------------------------------------------------------------------


def test_a_point_on_the_slope_is_not_certified_whatever_the_solver_claims():
    rng = np.random.default_rng(0)
    x = np.linspace(0, 1, 30)
    problem = Problem(straight, (as_run(x=x, y=x + 0.1 * rng.standard_normal(30)),))
    found = judged(problem, {"slope": 1.5, "level": 0.0})
    assert not found.trusted
    assert "not a stationary point" in found.reasons[0]
    assert found.step > 1


def test_a_maximum_of_the_cost_is_not_certified():
    # ½(a² − 1)²: at 1e-9 the slope is nil and the curvature is −2
    problem = Problem(well, (as_run(x=[0.0], y=[[1.0, 0.1]]),))
    assert problem.hessian(problem.point({"a": 1e-9}))[0, 0] == pytest.approx(-2, abs=1e-6)
    found = judged(problem, {"a": 1e-9})
    assert not found.trusted


def test_a_saddle_is_not_certified():
    @model
    def pass_between(x=signal(), y=signal(2), *, a=param(start=1.0), b=param()):
        return Residual(measured=y, predicted=vertcat(b + a, a**2))

    # r = (−b − a, 4 − a²): near a = 0 the cost 8 − 4a² + ½(a + b)² + … falls along a = −b
    problem = Problem(pass_between, (as_run(x=[0.0], y=[[0.0, 4.0]]),))
    eigenvalues = np.linalg.eigvalsh(problem.hessian(problem.point({"a": 1e-9, "b": -1e-9})))
    assert eigenvalues[0] < 0 < eigenvalues[1]
    assert not judged(problem, {"a": 1e-9, "b": -1e-9}).trusted


def test_from_a_start_on_a_maximum_the_minimum_is_found_or_nothing_is_claimed():
    rng = np.random.default_rng(1)
    y = np.column_stack([1 + 0.01 * rng.standard_normal(20), 0.01 * rng.standard_normal(20)])
    found = attempt(well, [as_run(x=np.zeros(20), y=y)], start={"a": 0.0})
    if found.certificate.trusted:
        assert abs(float(found.values["a"])) == pytest.approx(1.0, abs=0.02)


def test_negative_curvature_is_named():
    problem = Problem(wave, (wave_run(),))
    # the top of the cost between two local minima, to the last digit
    from scipy.optimize import minimize_scalar

    top = minimize_scalar(
        lambda w: -problem.cost(problem.point({"w": w})), bounds=(2.2, 2.9), method="bounded",
        options={"xatol": 1e-13},
    ).x  # fmt: skip
    point = problem.point({"w": top})
    assert problem.hessian(point)[0, 0] < 0
    assert not judged(problem, {"w": top}).trusted


def wave_run(w=3.0, n=60, noise=0.05, seed=2):
    rng = np.random.default_rng(seed)
    x = np.linspace(0, 6, n)
    return as_run(x=x, y=np.sin(w * x) + noise * rng.standard_normal(n))


def test_a_local_minimum_is_left_for_a_lower_one_that_the_automatic_start_finds():
    run = wave_run()
    problem = Problem(wave, (run,))
    local = trust_region(problem, problem.point({"w": 1.0}))
    best = trust_region(problem, problem.point({"w": 2.9}))
    assert local.cost > 10 * best.cost  # the valley at 1 is a wrong one
    clever = wave.starting(lambda model, runs: {"w": 2.8})
    found = attempt(clever, [run], start={"w": 1.0})
    assert found.certificate.trusted
    assert found.values["w"] == pytest.approx(3.0, abs=0.01)


def test_agreement_counts_the_other_ways_that_ended_at_the_same_cost():
    found = attempt(decay, [decay_run()])
    assert found.certificate.starts >= 1
    assert found.certificate.agreeing == found.certificate.starts


def decay_run(noise=0.01, seed=0, n=40):
    rng = np.random.default_rng(seed)
    x = np.linspace(0, 3, n)
    return as_run(x=x, y=2 * np.exp(-1.5 * x) + noise * rng.standard_normal(n))


# -- nothing finite -------------------------------------------------------------------------------


def test_a_residual_that_is_nowhere_a_number_is_refused_for_that_reason():
    @model
    def impossible(x=signal(), y=signal(), *, a=param(), b=param()):
        return Residual(measured=y, predicted=log(-1 - a**2) + b * x)

    found = attempt(impossible, [as_run(x=np.arange(5.0), y=np.arange(5.0) ** 2)])
    assert not found.certificate.trusted
    assert "not finite at the start values in 5 of 5 rows" in found.certificate.reasons[0]
    assert "--start" in found.certificate.reasons[0]


# -- bounds ---------------------------------------------------------------------------------------


def test_a_parameter_on_its_bound_is_named_with_the_bound():
    bounded = decay.having(k=param(start=0.5, bounds=(0.0, 1.0)))
    found = attempt(bounded, [decay_run()])
    assert not found.certificate.trusted
    assert [b.name for b in found.certificate.at_bound] == ["k"]
    assert "`k` ended on its bound (0, 1)" in found.certificate.reasons[0]


def test_a_bound_that_is_not_reached_changes_nothing():
    bounded = decay.having(k=param(start=0.5, bounds=(0.0, 10.0)))
    free, held = attempt(decay, [decay_run()]), attempt(bounded, [decay_run()])
    assert held.certificate.trusted
    assert float(held.values["k"]) == pytest.approx(float(free.values["k"]), rel=1e-9)


# -- perfect data ---------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["ipopt", "ipopt-exact", "trust-region"])
def test_noise_free_data_are_accepted_and_give_the_truth(solver):
    found = attempt(decay, [decay_run(noise=0.0)], solver=solver)
    assert found.certificate.trusted, found.certificate.reasons
    assert found.values["a"] == pytest.approx(2.0, rel=1e-12)
    assert found.values["k"] == pytest.approx(1.5, rel=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_a_straight_line_without_noise_is_never_refused(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 40))
    x = rng.uniform(-1, 1, n) * 10 ** rng.uniform(-3, 3)
    slope, level = rng.standard_normal(2) * 10 ** rng.uniform(-3, 3, 2)
    found = attempt(straight, [as_run(x=x, y=level + slope * x)], solver="trust-region")
    assert found.certificate.trusted, found.certificate.reasons
    assert float(found.values["slope"]) == pytest.approx(slope, rel=1e-11)


def test_a_residual_of_exactly_zero_is_accepted():
    x = np.arange(8.0)
    found = attempt(straight, [as_run(x=x, y=1 + 2 * x)])
    assert found.certificate.trusted, found.certificate.reasons
    assert float(found.values["slope"]) == pytest.approx(2.0, abs=1e-13)
    assert float(found.std["slope"]) < 1e-13


@model
def mount(a=signal(3), d=signal(3), *, M=param(rotation_matrix)):
    return Residual(measured=a, predicted=M @ d)


@model
def compass(a=signal(), d=signal(3), *, up=param(unit_vector)):
    return Residual(measured=a, predicted=d.T @ up)


@pytest.mark.parametrize(
    "degrees", [0.0, *(pytest.param(d, marks=pytest.mark.long) for d in (40, 130))]
)
def test_noise_free_directions_and_rotations_are_accepted(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    M = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    d = np.random.default_rng(0).standard_normal((12, 3))
    turned = attempt(mount, [as_run(a=d @ M.T, d=d)])
    assert turned.certificate.trusted, turned.certificate.reasons
    np.testing.assert_allclose(turned.values["M"], M, atol=1e-12)
    pointed = attempt(compass, [as_run(a=d @ M[:, 2], d=d)])
    assert pointed.certificate.trusted, pointed.certificate.reasons
    np.testing.assert_allclose(pointed.values["up"], M[:, 2], atol=1e-12)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1e3, 1e9])
def test_the_judgement_does_not_depend_on_the_unit_of_the_readings(size):
    run = decay_run()
    scaled = as_run(x=run.signals["x"], y=size * run.signals["y"])
    found = attempt(decay, [scaled], start={"a": size, "k": 1.0})
    plain = attempt(decay, [run])
    assert found.certificate.trusted, found.certificate.reasons
    assert float(found.values["a"]) == pytest.approx(size * float(plain.values["a"]), rel=1e-8)
    assert float(found.std["a"]) == pytest.approx(size * float(plain.std["a"]), rel=1e-6)


# -- what the data do not determine ---------------------------------------------------------------


def test_an_exact_null_direction_is_refused_in_words():
    @model
    def twice(x=signal(), y=signal(), *, slope=param(), first=param(), second=param()):
        return Residual(measured=y, predicted=slope * x + first + second)

    rng = np.random.default_rng(0)
    x = np.linspace(0, 1, 20)
    run = as_run(x=x, y=x + 0.1 * rng.standard_normal(20))
    with pytest.raises(NotTrusted) as refused:
        calibrate(twice, [run])
    text = str(refused.value)
    assert "not determined: `" in text
    assert "`first`" in text
    assert "`second`" in text
    assert "cannot be told apart" in text
    assert "goes with" in text
    assert " -1)" in text
    found = refused.value.estimate
    assert np.isnan(found.std["first"])
    assert np.isnan(found.std["second"])
    A = np.column_stack([x, np.ones(20)])
    solution, squares = np.linalg.lstsq(A, run.signals["y"].ravel(), rcond=None)[:2]
    assert float(found.values["slope"]) == pytest.approx(solution[0], rel=1e-9)
    std = np.sqrt(squares[0] / 18 * np.linalg.inv(A.T @ A)[0, 0])
    assert float(found.std["slope"]) == pytest.approx(std, rel=1e-8)


def test_a_direction_that_is_null_for_all_practical_purposes_is_refused():
    @model
    def nearly(x=signal(), z=signal(), y=signal(), *, a=param(), b=param()):
        return Residual(measured=y, predicted=a * x + b * z)

    rng = np.random.default_rng(0)
    x = rng.standard_normal(50)
    run = as_run(x=x, z=x + 1e-6 * rng.standard_normal(50), y=x + 0.1 * rng.standard_normal(50))
    found = attempt(nearly, [run])
    assert not found.certificate.trusted
    assert found.certificate.reasons[0].startswith("practically not determined: ")
    assert "`a`" in found.certificate.reasons[0]
    assert "`b`" in found.certificate.reasons[0]


def test_as_many_equations_as_unknowns_are_no_evidence():
    run = as_run(x=[0.0, 1.0], y=[1.0, 3.0])
    found = attempt(straight, [run])
    assert not found.certificate.trusted
    assert found.certificate.reasons[0].startswith(
        "no redundancy: 2 equations for 2 unknowns fit whatever the noise is"
    )


def test_fewer_equations_than_unknowns_are_refused_as_data():
    with pytest.raises(DataError) as refused:
        attempt(straight, [as_run(x=[0.0], y=[1.0])])
    text = str(refused.value)
    assert text.startswith("r.csv: 1 rows give 1 equations for the 2 unknowns of straight")
    assert "--fix name=value" in text


def test_a_model_with_nothing_unknown_is_refused():
    fixed = straight.having(slope=1.0, level=0.0)
    with pytest.raises(UsageError, match="nothing left to estimate; --free something"):
        attempt(fixed, [as_run(x=[0.0, 1.0], y=[1.0, 3.0])])


def test_two_valleys_that_fit_alike_are_refused_with_both_values():
    @model
    def square(x=signal(), y=signal(), *, a=param(start=0.3)):
        return Residual(measured=y, predicted=a**2 * x)

    rng = np.random.default_rng(0)
    x = np.linspace(1, 2, 30)
    run = as_run(x=x, y=4 * x + 0.01 * rng.standard_normal(30))
    mirrored = square.starting(lambda model, runs: {"a": -0.3})
    found = attempt(mirrored, [run], start={"a": 0.3})
    assert not found.certificate.trusted
    text = found.certificate.reasons[0]
    assert text.startswith("two solutions fit alike: `a` = ")
    values = sorted(float(w.strip(";")) for w in text.split() if w.strip(";")[-1:].isdigit())
    np.testing.assert_allclose(values, [-2.0, 2.0], atol=0.01)


def test_intervals_that_do_not_describe_the_cost_are_refused():
    # three points on the flat part of a saturating curve: k is anything above some value
    @model
    def saturating(x=signal(), y=signal(), *, k=param(start=1.0, bounds=(0.0, inf))):
        return Residual(measured=y, predicted=1 - exp(-k * x))

    run = as_run(x=[1.0, 2.0, 3.0], y=[0.93, 1.05, 0.99])
    found = attempt(saturating, [run])
    assert not found.certificate.trusted
    assert "too uncertain" in found.certificate.reasons[0]


def test_starts_that_end_in_worse_minima_are_told_from_those_that_agree():
    """A step response of 2 % that is slow beside its record: from some starts it is lost."""

    @model
    def creeping(
        t=signal("s"),
        y=signal("mV"),
        *,
        size=param("mV", start=1.0),
        creep=param(start=0.01),
        tau=param("s", start=60, bounds=(1, 1e5)),
    ):
        return Residual(measured=y, predicted=size * (1 + creep * (1 - exp(-t / tau))))

    rng, t = np.random.default_rng(1), np.arange(0, 600, 2.0)
    y = 5 * (1 + 0.02 * (1 - np.exp(-t / 80))) + 1e-3 * rng.standard_normal(t.size)
    record = {"t": t[:, None], "y": y[:, None]}
    found = attempt(creeping, [Run.raw("r", record, units={"t": "s", "y": "mV"}, time=t)])
    assert found.certificate.trusted
    assert abs(found.values["tau"] - 80) < 5 * found.std["tau"]
    assert found.certificate.agreeing < found.certificate.starts
    assert found.certificate.reasons[2].endswith("; the others end higher")


def test_the_reasons_for_belief_are_figures():
    reasons = attempt(decay, [decay_run()]).certificate.reasons
    assert len(reasons) == 4
    assert reasons[0].startswith("stationary: the step left is")
    assert reasons[1].startswith("a minimum: exact curvature at least")
    assert reasons[2].startswith("the same optimum from another start or algorithm:")
    assert reasons[3].startswith("intervals describe the cost two standard deviations away")


def test_for_a_linear_model_curvature_and_shape_are_exactly_one():
    rng = np.random.default_rng(0)
    x = np.linspace(0, 1, 30)
    found = attempt(straight, [as_run(x=x, y=x + 0.1 * rng.standard_normal(30))]).certificate
    assert found.curvature == pytest.approx(1.0, abs=1e-9)
    assert found.shape == (pytest.approx(1.0, abs=1e-6), pytest.approx(1.0, abs=1e-6))


def test_calibrate_returns_what_is_trusted_and_raises_what_is_not():
    assert calibrate(decay, [decay_run()]).certificate.trusted
    run = as_run(x=[0.0, 1.0], y=[1.0, 3.0])
    with pytest.raises(NotTrusted, match="no trustworthy estimate: no redundancy") as refused:
        calibrate(straight, [run])
    assert refused.value.exit_code == 2
    assert refused.value.estimate.names == ("slope", "level")


def test_an_unknown_solver_is_refused_with_those_there_are():
    with pytest.raises(UsageError) as refused:
        attempt(decay, [decay_run()], solver="newton")
    assert "unknown solver 'newton' for decay" in str(refused.value)
    assert "ipopt, ipopt-exact, trust-region" in str(refused.value)


# -- noise ----------------------------------------------------------------------------------------


def test_the_noise_is_the_root_of_the_squares_over_the_degrees_of_freedom():
    rng = np.random.default_rng(0)
    x = np.linspace(0, 1, 30)
    y = x + 0.1 * rng.standard_normal(30)
    found = attempt(straight, [as_run(x=x, y=y)])
    squares = np.polyfit(x, y, 1, full=True)[1][0]
    assert found.noise.sigma == pytest.approx(np.sqrt(squares / 28), rel=1e-9)
    assert found.noise.degrees_of_freedom == 28
    assert found.rmse == pytest.approx(np.sqrt(squares / 30), rel=1e-9)
    assert found.noise.repeats is None


def test_with_little_freedom_the_scatter_within_rest_counts_when_it_is_larger():
    x, y = np.arange(4.0), np.array([0.001, 0.999, 1.999, 3.001])
    plain = as_run(x=x, y=y)
    rested = replace(plain, spread={"y": np.full((4, 1), 0.05)})
    found = attempt(straight, [rested])
    assert found.noise.repeats == pytest.approx(0.05, rel=1e-12)
    assert found.noise.sigma == pytest.approx(0.05, rel=1e-12)
    assert attempt(straight, [plain]).noise.sigma == pytest.approx(np.sqrt(2e-6), rel=1e-6)


@pytest.mark.parametrize("norm", [5e-5, 1.0, 5e4])
def test_a_scale_of_any_size_is_not_taken_for_one_on_its_bound_at_zero(norm):
    """Counts calibrated to tesla: a scale of 5e-8 is as far from zero as one of 5."""
    from casest.results.find import find_model

    rng = np.random.default_rng(1)
    d = rng.standard_normal((30, 3))
    v = 1000 * d / np.linalg.norm(d, axis=1)[:, None] + 20 + rng.standard_normal((30, 3))
    run = Run.raw("counts", {"v": v}, units={"v": "count"})
    found = attempt(find_model("norm-triangular").having(norm=norm), [run])
    assert found.certificate.trusted, found.certificate.reasons
    assert found.values["scale"][0, 0] == pytest.approx(norm / 1000, rel=0.01)


@model
def peak(
    x=signal("1"),
    y=signal("1"),
    *,
    level=param(start=0.0),
    height=param(start=5.0),
    place=param("1", start=7.0),
    width=param("1", start=1.0, bounds=(0.1, 10.0)),
):
    return Residual(measured=y, predicted=level + height * exp(-(((x - place) / width) ** 2)))


@pytest.mark.long
def test_one_of_several_valleys_that_leaves_a_course_is_refused_until_a_start_says_which():
    """Two peaks where the model has one: either is a minimum."""
    x = np.arange(200) * 0.1
    y = 10 * np.exp(-((x - 5) ** 2)) + 8 * np.exp(-((x - 13) ** 2))
    y = y + 0.1 * np.random.default_rng(0).standard_normal(200)
    run = Run.raw("peak", {"x": x[:, None], "y": y[:, None]}, units={})
    refused = attempt(peak, [run]).certificate
    assert not refused.trusted
    assert "there may be a better one, or the model lacks something" in refused.reasons[0]
    stated = attempt(peak, [run], start={"place": 5.2})
    assert stated.certificate.trusted
    assert abs(float(stated.values["place"]) - 5) < 0.2
