"""IPOPT (Gauss-Newton and exact) and the trust region end at the same, known optimum."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from casest import (
    Residual,
    Run,
    attitude,
    calibrate,
    exp,
    model,
    param,
    quantity,
    rotation_matrix,
    signal,
    unit_vector,
    vertcat,
)
from casest.estimate.calibrate import attempt
from casest.leastsquares.per_sample import linear
from casest.leastsquares.problem import Problem
from casest.solve.ipopt import ipopt
from casest.solve.trust_region import trust_region

SOLVERS = ("ipopt", "ipopt-exact", "trust-region")

#: NIST StRD Misra1a (lower difficulty), from https://www.itl.nist.gov/div898/strd/nls/
MISRA_Y = [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40,
           75.47, 81.78]  # fmt: skip
MISRA_X = [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1,
           689.1, 760.0]  # fmt: skip
MISRA = {"b1": (2.3894212918e02, 2.7070075241e00), "b2": (5.5015643181e-04, 7.2668688436e-06)}
MISRA_SUM = 1.2455138894e-01


@model
def misra(x=signal(), y=signal(), *, b1=param(start=500.0), b2=param(start=1e-4)):
    """Monomolecular adsorption."""
    return Residual(measured=y, predicted=b1 * (1 - exp(-b2 * x)))


@model
def rosenbrock(x=signal(), y=signal(2), *, a=param(start=-1.2), b=param(start=1.0)):
    """Rosenbrock's valley as a residual: (10 (b - a²), 1 - a)."""
    return Residual(measured=y, predicted=vertcat(10 * (b - a**2), a))


@model
def uneven(x=signal(), y=signal(), *, big=param(start=1.0), small=param(start=1.0)):
    """Two unknowns a million times apart, either way."""
    return Residual(measured=y, predicted=1e-3 * big + small * 1e3 * x)


def as_run(**signals):
    columns = {n: np.asarray(s, float).reshape(len(s), -1) for n, s in signals.items()}
    return Run.raw("r", columns, units={})


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_certified_values_of_nists_misra1a_are_found(solver):
    found = attempt(misra, [as_run(x=MISRA_X, y=MISRA_Y)], solver=solver)
    assert found.certificate.trusted
    for name, (value, std) in MISRA.items():
        assert found.values[name] == pytest.approx(value, rel=1e-9)
        assert found.std[name] == pytest.approx(std, rel=1e-7)
    assert 2 * found.outcomes[0].cost == pytest.approx(MISRA_SUM, rel=1e-9)


@pytest.mark.parametrize("start", [{"b1": 500.0, "b2": 1e-4}, {"b1": 250.0, "b2": 5e-4}])
def test_both_of_nists_starts_lead_there(start):
    found = attempt(misra, [as_run(x=MISRA_X, y=MISRA_Y)], start=start)
    assert found.certificate.trusted
    assert found.values["b1"] == pytest.approx(MISRA["b1"][0], rel=1e-9)


@pytest.mark.parametrize("solver", SOLVERS)
def test_rosenbrocks_valley_ends_at_one_one(solver):
    run = as_run(x=[0.0], y=[[0.0, 1.0]])
    problem = Problem(rosenbrock, (run,))
    method = {
        "ipopt": lambda: ipopt(problem, problem.start()),
        "ipopt-exact": lambda: ipopt(problem, problem.start(), exact=True),
        "trust-region": lambda: trust_region(problem, problem.start()),
    }[solver]
    found = method()
    assert found.claims_success
    np.testing.assert_allclose(found.point.x, [1.0, 1.0], atol=1e-7)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("seed", range(3))
def test_a_linear_problem_is_solved_as_numpy_solves_it(solver, seed):
    @model
    def linear(A=signal(4), y=signal(), *, c=param(4)):
        return Residual(measured=y, predicted=A.T @ c)

    rng = np.random.default_rng(seed)
    A, y = rng.standard_normal((20, 4)), rng.standard_normal(20)
    found = attempt(linear, [as_run(A=A, y=y)], solver=solver)
    expected = np.linalg.lstsq(A, y, rcond=None)[0]
    np.testing.assert_allclose(found.values["c"], expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("solver", SOLVERS)
def test_unknowns_a_million_times_apart_are_both_found(solver):
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, 50)
    y = 1e-3 * 2.5e6 + 3e-3 * 1e3 * x + 0.01 * rng.standard_normal(50)
    found = attempt(uneven, [as_run(x=x, y=y)], solver=solver)
    A = np.column_stack([np.full(50, 1e-3), 1e3 * x])
    expected = np.linalg.lstsq(A, y, rcond=None)[0]
    assert found.certificate.trusted
    np.testing.assert_allclose(found.values["big"], expected[0], rtol=1e-10)
    np.testing.assert_allclose(found.values["small"], expected[1], rtol=1e-10)


@pytest.mark.parametrize("solver", SOLVERS)
def test_no_solver_leaves_the_bounds_on_its_way_or_at_its_end(solver):
    seen = []

    class Watched(Problem):
        def cost(self, point):
            seen.append(point.x.copy())
            return super().cost(point)

        def normal(self, point):
            seen.append(point.x.copy())
            return super().normal(point)

        def factor(self, point):
            seen.append(point.x.copy())
            return super().factor(point)

    @model
    def decay(x=signal(), y=signal(), *, a=param(start=1.0), k=param(start=1.0, bounds=(0.5, 2))):
        return Residual(measured=y, predicted=a * exp(-k * x))

    x = np.linspace(0, 3, 20)
    problem = Watched(decay, (as_run(x=x, y=2 * np.exp(-5 * x)),))  # asks for k = 5
    start = problem.start()
    if solver == "trust-region":
        found = trust_region(problem, start)
    else:
        found = ipopt(problem, start, exact=solver == "ipopt-exact")
    rates = np.array(seen)[:, 1]
    assert len(rates) > 3
    assert rates.min() >= 0.5
    assert rates.max() <= 2.0
    assert found.point.x[1] == pytest.approx(2.0, abs=1e-4)


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_estimate_on_its_bound_is_refused_with_its_name(solver):
    @model
    def level(x=signal(), y=signal(), *, a=param(start=0.5, bounds=(0.0, 1.0)), b=param()):
        return Residual(measured=y, predicted=a * x + b)

    rng = np.random.default_rng(0)
    x = np.linspace(0, 1, 20)
    run = as_run(x=x, y=2 * x + 0.01 * rng.standard_normal(20))
    found = attempt(level, [run], solver=solver)
    assert not found.certificate.trusted
    assert "`a` ended on its bound (0, 1)" in found.certificate.reasons[0]
    assert [b.name for b in found.certificate.at_bound] == ["a"]


def test_ipopt_that_returns_its_start_is_not_believed():
    problem = Problem(misra, (as_run(x=MISRA_X, y=MISRA_Y),))
    start = problem.start()
    found = ipopt(problem, start, options={"linear_solver": "ma57"})  # HSL is not there
    assert not found.claims_success
    np.testing.assert_allclose(found.point.x, start.x)


def test_an_estimate_does_not_depend_on_what_ipopt_says(monkeypatch):
    """IPOPT stopped at once, and claiming success: polish and second way still find the optimum."""
    from dataclasses import replace

    from casest.solve import strategy

    def idle(problem, start, *, exact=False, options=None, patience=0):
        found = ipopt(problem, start, exact=exact, options={"max_iter": 0})
        return replace(found, claims_success=True, status="Solve_Succeeded")

    monkeypatch.setattr(strategy, "ipopt", idle)
    found = attempt(misra, [as_run(x=MISRA_X, y=MISRA_Y)])
    assert found.certificate.trusted
    assert found.values["b1"] == pytest.approx(MISRA["b1"][0], rel=1e-9)


def test_equal_seeds_give_equal_estimates():
    run = as_run(x=MISRA_X, y=MISRA_Y)
    a, b = attempt(misra, [run], seed=3), attempt(misra, [run], seed=3)
    assert {n: float(v) for n, v in a.values.items()} == {n: float(v) for n, v in b.values.items()}


# -- unknowns on curved sets ----------------------------------------------------------------------


def as_declared(_model, _runs):
    """A start function: around a computed start, unlike a declared one, no others are tried."""
    return {}


def rotations(n, rng):
    q, r = np.linalg.qr(rng.standard_normal((n, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None, :]
    return q * np.linalg.det(q)[:, None, None]


@model
def table(a=signal(3, "m/s^2"), R=attitude(), *, bias=param(3, "m/s^2"), up=param(unit_vector)):
    """A triad on a table that hangs in some direction."""
    return Residual(measured=a, predicted=quantity("reading", bias + 9.81 * R.T @ up, "m/s^2"))


def table_run(up, rng, sigma=0.01, n=20):
    R = rotations(n, rng)
    a = 9.81 * np.einsum("nji,j->ni", R, up) + [0.1, 0.2, -0.3]
    return as_run(a=a + sigma * rng.standard_normal((n, 3)), R=R.reshape(n, 9))


DIRECTIONS = {
    "start": [0, 0, 1],
    "equator": [1, 0, 0],
    "120 degrees away": [np.sqrt(0.75), 0, -0.5],
    "170 degrees away": [np.sin(np.radians(170)), 0, np.cos(np.radians(170))],
    "opposite": [0, 0, -1],
}


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("where", DIRECTIONS)
def test_a_direction_is_found_wherever_it_points(where, solver):
    up = np.array(DIRECTIONS[where], dtype=float)
    found = attempt(table, [table_run(up, np.random.default_rng(3))], solver=solver)
    assert found.certificate.trusted
    assert found.problem.unknowns == 5
    assert np.linalg.norm(found.values["up"]) == pytest.approx(1.0, abs=1e-12)
    # 20 readings of 9.81 with noise 0.01: a tangent is known to 0.01/9.81/√20
    assert np.linalg.norm(found.values["up"] - up) < 4 * np.sqrt(2) * 0.01 / 9.81 / np.sqrt(20)


@pytest.mark.parametrize(
    "where", [pytest.param(w, marks=pytest.mark.long) for w in ("start", "120 degrees away")]
)
def test_the_covariance_of_a_direction_is_that_of_repeated_fits(where):
    rng, declared = np.random.default_rng(8), table.starting(as_declared)
    up = np.array(DIRECTIONS[where], dtype=float)
    z, tangent = [], np.linalg.svd(up[None, :])[2][1:]
    for _ in range(40):
        found = attempt(declared, [table_run(up, rng)], solver="trust-region")
        error = found.values["up"] - up
        own = found.problem.point({"up": found.values["up"]}).references
        basis = own[3:9].reshape(2, 3)
        slots = [i for i, n in enumerate(found.names) if n.startswith("up")]
        covariance = basis.T @ found.covariance[np.ix_(slots, slots)] @ basis
        z += list((tangent @ error) / np.sqrt(np.diag(tangent @ covariance @ tangent.T)))
    assert abs(np.mean(z)) < 4 / np.sqrt(len(z))
    assert abs(np.var(z) - 1) < 4 * np.sqrt(2 / len(z))


@model
def mount(a=signal(3), d=signal(3), *, M=param(rotation_matrix)):
    """How a sensor's axes lie in another frame, from vectors known in both."""
    return Residual(measured=a, predicted=quantity("reading", M @ d))


def kabsch(a, d):
    """The rotation that takes d to a best in the sense of least squares (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(a.T @ d)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("angle", [0.0, 90.0, 150.0, 179.0, 180.0])
def test_a_rotation_is_the_one_of_kabsch_however_far_from_the_start(angle, solver):
    rng = np.random.default_rng(1)
    axis = np.array([2.0, -1.0, 2.0]) / 3
    K = np.cross(np.eye(3), axis) * -1
    a = np.radians(angle)
    M = np.eye(3) + np.sin(a) * K + (1 - np.cos(a)) * K @ K  # Rodrigues
    d = rng.standard_normal((20, 3))
    run = as_run(a=d @ M.T + 0.01 * rng.standard_normal((20, 3)), d=d)
    found = attempt(mount, [run], solver=solver)
    assert found.certificate.trusted
    assert found.problem.unknowns == 3
    np.testing.assert_allclose(found.values["M"], kabsch(run.signals["a"], d), atol=1e-8)


def test_the_covariance_of_a_rotation_is_that_of_repeated_fits():
    rng, declared = np.random.default_rng(4), mount.starting(as_declared)
    M, z = rotations(1, rng)[0], []
    for _ in range(25):
        d = rng.standard_normal((20, 3))
        run = as_run(a=d @ M.T + 0.01 * rng.standard_normal((20, 3)), d=d)
        found = attempt(declared, [run], solver="trust-region", intervals=False)
        error = found.values["M"].T @ M  # small turn in the chart's own frame
        turn = np.array([error[2, 1], error[0, 2], error[1, 0]])
        z.append(turn @ np.linalg.solve(found.covariance, turn))
    # χ² with three degrees of freedom each
    assert abs(np.mean(z) - 3) < 4 * np.sqrt(6 / len(z))


def test_the_std_of_a_rotations_entries_is_that_of_its_chart():
    rng = np.random.default_rng(6)
    M = rotations(1, rng)[0]
    d = rng.standard_normal((20, 3))
    run = as_run(a=d @ M.T + 0.01 * rng.standard_normal((20, 3)), d=d)
    found = attempt(mount, [run])
    E = np.zeros((3, 3, 3))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        E[k, j, i], E[k, i, j] = 1.0, -1.0
    slopes = np.array([found.values["M"] @ E[k] for k in range(3)])  # ∂(M·C(δ))/∂δ_k
    variance = np.einsum("kij,kl,lij->ij", slopes, found.covariance, slopes)
    np.testing.assert_allclose(found.std["M"], np.sqrt(variance), rtol=1e-6)


@model
def straight(x=signal("m"), y=signal("V"), *, zero=param("V"), slope=param("V/m")):
    return Residual(measured=y, predicted=zero + slope * x)


@model
def scaled(x=signal("m"), y=signal("V"), *, at=param("m"), slope=param("V/m", start=1.0)):
    return Residual(measured=y, predicted=slope * (x - at))


@model
def upright(v=signal(3, "g"), *, down=param(unit_vector)):
    return Residual(measured=v, predicted=down)


def test_what_is_linear_has_one_valley_and_no_other_is_looked_for():
    assert [linear(m) for m in (straight, scaled, upright)] == [True, False, False]
    rng = np.random.default_rng(0)
    x = rng.uniform(0, 1, (40, 1))
    y = 2 + 3 * x + 0.01 * rng.standard_normal((40, 1))
    run = Run.raw("r", {"x": x, "y": y}, units={"x": "m", "y": "V"})
    plain, curved = (calibrate(m, [run]) for m in (straight, scaled))
    assert len(plain.outcomes) < len(curved.outcomes)
    expected = np.polynomial.polynomial.polyfit(x[:, 0], y[:, 0], 1)
    found = [float(plain.values[n]) for n in ("zero", "slope")]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


class Luring:
    """A problem whose cost is seen too low where a search begins: as much as integration errs."""

    def __init__(self, problem, start):
        self._problem, self._start = problem, start

    def __getattr__(self, name):
        return getattr(self._problem, name)

    def cost(self, point):
        low = np.array_equal(point.x, self._start.x)
        return self._problem.cost(point) * (1 - 4e-9 * low)

    def normal(self, point):
        return self._problem.normal(point)._replace(cost=self.cost(point))

    def factor(self, point):
        R, t, _ = self._problem.factor(point)
        return R, t, float(np.sqrt(max(2 * self.cost(point) - t @ t, 0.0)))


def test_a_cost_that_is_low_by_its_error_alone_holds_no_search_back_from_where_slopes_end():
    rng = np.random.default_rng(0)
    x = rng.uniform(0, 1, (40, 1))
    y = 2 + 3 * x + 0.01 * rng.standard_normal((40, 1))
    problem = Problem(straight, (Run.raw("r", {"x": x, "y": y}, units={"x": "m", "y": "V"}),))
    zero, slope = np.polynomial.polynomial.polyfit(x[:, 0], y[:, 0], 1)
    begun = problem.point({"zero": zero + 2e-7, "slope": slope})  # 1e-4 standard deviations away
    end = trust_region(Luring(problem, begun), begun, damping=1e-7)
    np.testing.assert_allclose(
        end.point.x, problem.point({"zero": zero, "slope": slope}).x, rtol=1e-10
    )


@model
def decays(t=signal(), y=signal(), *, size=param(3, start=[0.5, 0.7, 1.0]),
           rate=param(3, start=[0.7, 4.2, 6.2], bounds=(0, None))):  # fmt: skip
    return Residual(measured=y, predicted=size.T @ exp(-rate * t))


def test_ipopt_ends_at_the_optimum_also_where_the_cost_falls_ten_million_times():
    """Lanczos' three exponentials (1956), in four decimals; SciPy says where the least cost is."""
    t = np.arange(24) / 20
    y = np.round(np.exp(-np.outer(t, [1, 3, 5])) @ [0.0951, 0.8607, 1.5576], 4)
    problem = Problem(decays, (as_run(t=t, y=y),))
    found = ipopt(problem, problem.start(), exact=True)
    assert found.claims_success

    def residual(x):
        return np.exp(-np.outer(t, x[3:])) @ x[:3] - y

    best = least_squares(
        residual, [0.1, 0.9, 1.6, 1, 3, 5], "3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    assert best.cost < 1e-7 * problem.cost(problem.start())
    # A hundredth of a standard deviation.
    assert found.cost - best.cost < 0.5e-4 * 2 * best.cost / (len(t) - 6)
