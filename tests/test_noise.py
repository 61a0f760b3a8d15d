"""Correlated residuals widen the intervals, white ones do not; unequal noise is robustly told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from casest import Residual, Run, model, param, signal
from casest.estimate.calibrate import attempt
from casest.estimate.correlation import batches, correlation_time
from casest.leastsquares.problem import Problem
from casest.leastsquares.weights import robust_scale
from casest.results.find import find_model


@model
def level(y=signal("V"), *, a=param("V")):
    """A constant: the std of its estimate is the noise of a mean."""
    return Residual(measured=y, predicted=a)


def from_zero(_model, _runs):
    """A start function: around a computed start, unlike a declared one, no others are tried."""
    return {}


def series(y, **more):
    return replace(
        Run.raw("r", {"y": np.reshape(y, (-1, 1))}, units={}, time=np.arange(float(len(y)))), **more
    )


def autoregressive(rho, n, rng):
    """AR(1) of unit variance."""
    e = rng.standard_normal(n)
    y = np.empty(n)
    y[0] = e[0]
    for k in range(1, n):
        y[k] = rho * y[k - 1] + np.sqrt(1 - rho**2) * e[k]
    return y


def fitted(y):
    return attempt(level.starting(from_zero), [series(y)], solver="trust-region")


@pytest.mark.parametrize(
    ("seed", "count", "size"),
    [
        (5, 1200, 0.02),
        pytest.param(18, 3000, 0.1, marks=pytest.mark.long),
        pytest.param(2, 3000, 0.1, marks=pytest.mark.long),
    ],
)
def test_readings_that_are_a_random_walk_are_no_wheel(seed, count, size):
    """Nothing turned: such records were fitted, and believed, before anybody asked."""
    rng, t = np.random.default_rng(seed), np.arange(count) / 100
    v = size * np.cumsum(rng.standard_normal((count, 3)), axis=0)
    run = Run.raw("walk", {"t": t[:, None], "v": v}, units={"t": "s", "v": "m/s^2"}, time=t)
    assert not attempt(find_model("wheel"), [run]).certificate.trusted


def test_white_residuals_leave_the_std_of_a_mean_as_it_is():
    rng = np.random.default_rng(0)
    for _ in range(10):
        y = 1 + rng.standard_normal(400)
        found = fitted(y)
        assert found.correlated_over == 1.0
        assert found.plain["a"] == pytest.approx(np.std(y, ddof=1) / 20, rel=1e-9)
        assert found.std["a"] == pytest.approx(np.std(y, ddof=1) / 20, rel=3e-3)
        assert found.notes == ()


def test_the_std_of_a_mean_of_correlated_noise_is_the_empirical_one():
    rng = np.random.default_rng(1)
    fits = [fitted(1 + autoregressive(0.6, 1500, rng)) for _ in range(80)]
    errors = np.array([float(f.values["a"]) - 1 for f in fits])
    spread = np.array([float(f.std["a"]) for f in fits])
    # The std of the mean of AR(1): √((1 + ρ)/(1 − ρ)) = 2 times that of white noise.
    assert np.mean(spread) * np.sqrt(1500) == pytest.approx(2.0, rel=0.15)
    z = errors / spread
    assert abs(np.var(z) - 1) < 4 * np.sqrt(2 / len(z))


def test_the_correlation_time_of_an_ar1_is_one_plus_rho_over_one_minus_rho():
    rng = np.random.default_rng(2)
    times = []
    for _ in range(20):
        problem = Problem(level, (series(autoregressive(0.6, 3000, rng)),))
        times.append(correlation_time(problem, problem.point({"a": 0.0})))
    assert np.mean(times) == pytest.approx(4.0, rel=0.1)


def test_correlated_residuals_are_noted_in_words():
    found = fitted(autoregressive(0.9, 2000, np.random.default_rng(3)))
    (note,) = found.notes
    assert note.startswith("residuals are correlated over ")
    assert "the 2000 samples count as" in note
    np.testing.assert_array_equal(found.std["a"], found.robust["a"])


def test_the_order_of_averages_is_a_series_too():
    """Means over intervals of a drifting sensor follow each other like any readings."""
    y = autoregressive(0.9, 400, np.random.default_rng(4))
    means = series(y, count=np.full(400, 50))
    found = attempt(level, [means], solver="trust-region").correlated_over
    assert found == fitted(y).correlated_over > 5


def test_few_samples_say_nothing_about_correlation():
    y = autoregressive(0.9, 60, np.random.default_rng(5))
    assert fitted(y).correlated_over == 1.0


def test_batches_hold_consecutive_samples_and_never_span_two_blocks():
    run = series(np.arange(250.0), block=np.repeat([0, 1], 125))
    np.testing.assert_array_equal(batches(run, 50), [0, 50, 100, 125, 175, 225])


def test_the_robust_std_of_a_white_series_is_whites():
    """MacKinnon & White (1985), HC3: for a mean, the root of Σ(r/(1 − 1/n))²/n²."""
    rng = np.random.default_rng(6)
    y = rng.standard_normal(300) * np.repeat([0.1, 3.0], 150)
    found = fitted(y)
    r = y - y.mean()
    expected = np.sqrt(np.sum((r / (1 - 1 / 300)) ** 2)) / 300
    assert float(found.robust["a"]) == pytest.approx(expected, rel=1e-9)


def test_the_robust_std_is_right_where_noise_grows_with_the_signal():
    @model
    def slope_only(x=signal(), y=signal(), *, b=param()):
        return Residual(measured=y, predicted=b * x)

    rng, declared = np.random.default_rng(7), slope_only.starting(from_zero)
    z, plain = [], []
    for _ in range(60):
        x = rng.uniform(-1, 1, 200)
        y = 2 * x + np.abs(x) ** 2 * rng.standard_normal(200)
        signals = {"x": x[:, None], "y": y[:, None]}
        found = attempt(declared, [Run.raw("r", signals, units={})], solver="trust-region")
        z.append((float(found.values["b"]) - 2) / float(found.robust["b"]))
        plain.append((float(found.values["b"]) - 2) / float(found.std["b"]))
    assert abs(np.var(z) - 1) < 4 * np.sqrt(2 / len(z))
    # E[x²·x⁴]/(E[x⁴]E[x²]) = (1/7)/((1/5)(1/3)) = 15/7: the plain variance is too small by it
    assert np.var(plain) == pytest.approx(15 / 7, abs=4 * 15 / 7 * np.sqrt(2 / len(z)))


def test_the_robust_scale_is_the_std_of_gaussian_noise_and_ignores_outliers():
    rng = np.random.default_rng(8)
    r = 0.3 * rng.standard_normal((4000, 2))
    assert robust_scale([r]) == pytest.approx(0.3, rel=0.05)
    r[:100] = 1e6
    assert robust_scale([r]) == pytest.approx(0.3, rel=0.07)
