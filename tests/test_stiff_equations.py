"""Stiff equations: the fast part dies away a million times faster than the record lasts.

Readings are made by SciPy's Radau, which shares nothing with what fits them.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import curve_fit

from casest import Run, attempt, param, signal, vertcat
from casest.dynamics import Motion, dynamics, measured, state
from casest.leastsquares.flow import GivenUp, for_seconds
from casest.leastsquares.problem import Problem

#: Robertson's reaction (1966), as published: 1/s.
PUBLISHED = (0.04, 3e7, 1e4)


@dynamics
def robertson(
    a=signal(),
    b=signal(),
    c=signal(),
    *,
    y=state(3, start=[1, 0, 0], known=True),
    k1=param("1/s", start=0.1, bounds=(0, None)),
    k2=param("1/s", start=1e7, bounds=(0, None)),
    k3=param("1/s", start=3e4, bounds=(0, None)),
):
    """An autocatalytic reaction of three substances."""
    made, used = k1 * y[0] - k3 * y[1] * y[2], k2 * y[1] ** 2
    outputs = (
        measured(a, y[0], std=0.01),
        measured(b, y[1], std=1e-7),
        measured(c, y[2], std=0.01),
    )
    return Motion(rates={"y": vertcat(-made, made - used, used)}, outputs=outputs)


def reaction(_, y):
    k1, k2, k3 = PUBLISHED
    made, used = k1 * y[0] - k3 * y[1] * y[2], k2 * y[1] ** 2
    return -made, made - used, used


@pytest.mark.long
def test_robertsons_rate_constants_are_found_from_starts_three_times_off():
    t = np.concatenate([[0], np.logspace(-1, 5, 13)])
    made = solve_ivp(reaction, (0, t[-1]), (1, 0, 0), "Radau", t, rtol=1e-11, atol=1e-15).y.T
    noise = np.random.default_rng(1).standard_normal(made.shape) * [0.01, 1e-7, 0.01]
    read = {name: (made + noise)[:, [i]] for i, name in enumerate("abc")}
    run = Run.raw("reaction", read, units={}, time=t)
    found = attempt(robertson.calibration, [run], intervals=False)
    assert found.certificate.trusted, found.certificate.reasons
    for name, truth in zip(("k1", "k2", "k3"), PUBLISHED, strict=True):
        assert abs(found.values[name] - truth) < 4 * found.std[name]
        assert found.std[name] < 0.1 * truth


@dynamics
def relaxing(
    x=signal(), v=signal(), *, z=state(2, start=[2, 0], known=True), mu=param(start=1000.0)
):
    """Van der Pol's oscillator."""
    rates = vertcat(z[1], mu * (1 - z[0] ** 2) * z[1] - z[0])
    outputs = measured(x, z[0], std=1.0), measured(v, z[1], std=1e-3)
    return Motion(rates={"z": rates}, outputs=outputs)


def test_van_der_pols_oscillator_is_followed_through_its_jumps():
    """mu = 1000 up to t = 2000: the reference of the Test Set for IVP Solvers (Mazzia & Magherini),
    there in units of mu; slopes against differences of states that are followed without them."""
    t = np.linspace(0, 2000, 21)
    nothing = np.zeros((len(t), 1))
    run = Run.raw("oscillator", {"x": nothing, "v": nothing}, units={}, time=t)
    problem = Problem(relaxing.calibration, (run,))

    def followed(mu):
        return -problem.residuals(problem.point({"mu": mu}))[0]

    known = 1.706167732170469, -0.8928097010248125
    np.testing.assert_allclose(followed(1000)[-1], known, rtol=1e-7)
    slope = -problem.jacobian(problem.point({"mu": 1000})).reshape(len(t), 2)
    differences = (followed(1000.1) - followed(999.9)) / 0.2
    np.testing.assert_allclose(slope, differences, atol=5e-4 * np.abs(slope).max())


def test_a_search_that_takes_too_long_is_given_up_and_the_best_point_kept(monkeypatch):
    """One exponential, in too few rows to vouch for it: the fit is that of SciPy, and refused."""
    t = np.array([0, 0.3, 0.7, 1.2, 2, 3, 4.5, 6.0])
    read = np.exp(-0.5 * t) + 0.01 * np.random.default_rng(0).standard_normal(t.size)
    run = Run.raw("decay", {"x": read[:, None]}, units={}, time=t)
    assert attempt(decaying.calibration, [run]).certificate.trusted
    monkeypatch.setattr("casest.estimate.valley.allowed", lambda outcomes, least: 0.0)
    found = attempt(decaying.calibration, [run])
    assert not found.certificate.trusted
    assert "0 of its starts could be followed in its time" in found.certificate.reasons[0]
    best = curve_fit(lambda s, k: np.exp(-k * s), t, read, 0.4)[0]
    assert found.values["k"] == pytest.approx(best[0], rel=1e-6)


@dynamics
def decaying(
    x=signal(), *, z=state(start=1, known=True), k=param("1/s", start=0.4, bounds=(0, None))
):
    """What decays by itself."""
    return Motion(rates={"z": -k * z}, outputs=(measured(x, z),))


def test_equations_are_followed_no_longer_than_is_allowed():
    t = np.linspace(0, 20, 21)
    nothing = np.zeros((len(t), 1))
    run = Run.raw("oscillator", {"x": nothing, "v": nothing}, units={}, time=t)
    problem = Problem(relaxing.calibration, (run,))
    with for_seconds(0.0), pytest.raises(GivenUp):
        problem.cost(problem.point({"mu": 5}))
    assert np.isfinite(problem.cost(problem.point({"mu": 5})))


@dynamics
def seen(
    x=signal(), *, z=state(2, start=[2, 0], known=True), mu=param(start=800, bounds=(0, None))
):
    """The same oscillator, of which the angle alone is read."""
    return Motion(
        rates={"z": vertcat(z[1], mu * (1 - z[0] ** 2) * z[1] - z[0])}, outputs=(measured(x, z[0]),)
    )


@pytest.mark.long
def test_van_der_pols_oscillator_is_fitted_over_two_jumps():
    t = np.linspace(0, 2000, 101)
    made = solve_ivp(
        lambda _, z: (z[1], 1000 * (1 - z[0] ** 2) * z[1] - z[0]), (0, 2000), (2, 0), "Radau", t,
        rtol=1e-9, atol=1e-12,
    ).y[0]  # fmt: skip
    read = made + 0.02 * np.random.default_rng(0).standard_normal(t.size)
    found = attempt(
        seen.calibration, [Run.raw("oscillator", {"x": read[:, None]}, units={}, time=t)]
    )
    assert found.certificate.trusted, found.certificate.reasons
    assert abs(found.values["mu"] - 1000) < 4 * found.std["mu"]
    assert found.std["mu"] < 2
