"""Printed standard deviations where noise is not what the textbook has: outliers, colour, unequal.

By simulation, against the spread of the estimates themselves.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal as signal_processing
from scipy import stats

from casest import Residual, Run, calibrate_many, model, param, signal
from casest.effects import CATALOGUE
from casest.estimate.calibrate import attempt
from casest.estimate.covariance import sandwich
from casest.leastsquares.problem import Problem
from casest.leastsquares.weights import variance_factor, weights

TRUTH, NAMES = np.array([2.0, 1.0]), ("slope", "level")
OUTLIERS = next(e for e in CATALOGUE if e.name == "outliers")


@model
def line(x=signal(), y=signal(), *, slope=param(), level=param()):
    return Residual(measured=y, predicted=level + slope * x)


@model
def three(v=signal(3), *, level=param(3)):
    return Residual(measured=v, predicted=level)


@model
def one(w=signal(), *, level=param()):
    return Residual(measured=w, predicted=level)


def fits(count, noise, n, seed=0):
    """Errors (count, 2) of lines in time, their printed std, and the estimates themselves."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        x = rng.uniform(-1, 1, (n, 1))
        y = 1 + 2 * x + noise(rng, x)
        run = Run.raw("r", {"x": x, "y": y}, units={}, time=np.arange(n) * 0.01)
        found.append(attempt(line, [run], solver="trust-region"))
    values, std = (
        np.array([[p["slope"], p["level"]] for p in parts])
        for parts in ([f.values for f in found], [f.std for f in found])
    )
    return values - TRUTH, std, found


def coverage(error, std, quantile):
    return float(np.mean(np.abs(error) <= quantile * std))


def contaminated(rng, x):
    """One reading in twenty is eight times as far off."""
    far = rng.random(x.shape) < 0.05
    return 0.1 * rng.standard_normal(x.shape) * np.where(far, 8.0, 1.0)


def normal(rng, x):
    return 0.1 * rng.standard_normal(x.shape)


def reweighted(count, noise, n=60):
    """Lines fitted with the weights of `outliers`, by NumPy: errors (count, 2), std, and errors and
    std of least squares."""
    rng, declared, found = np.random.default_rng(0), line.with_effect(OUTLIERS), []
    curve = weight_of_residuals(declared)
    for _ in range(count):
        x = rng.uniform(-1, 1, (n, 1))
        y = 1 + 2 * x + noise(rng, x)
        problem = Problem(declared, (Run.raw("r", {"x": x, "y": y}, units={}),))
        X, plain = np.c_[x, np.ones(n)], np.linalg.lstsq(np.c_[x, np.ones(n)], y[:, 0])[0]
        at = plain
        for _ in range(25):
            r = np.abs(y[:, 0] - X @ at)
            root = np.sqrt(np.interp(r / np.median(r) * 0.6745, *curve))
            at = np.linalg.lstsq(root[:, None] * X, root * y[:, 0])[0]
        unit = np.diag(np.linalg.inv(X.T @ X))
        own = variance_factor(problem, at_values(problem, at))
        left = np.sum((y[:, 0] - X @ plain) ** 2) / (n - 2)
        found.append((at - TRUTH, np.sqrt(own * unit), plain - TRUTH, np.sqrt(left * unit)))
    return np.array(found).transpose(1, 0, 2)


def weight_of_residuals(declared):
    """Residuals in robust standard deviations and what they weigh, both (4001,)."""
    r = np.linspace(0, 1, 4001) ** 6  # half of them small: up to 43 standard deviations
    run = Run.raw("r", {"x": 0 * r[:, None], "y": r[:, None]}, units={})
    problem = Problem(declared, (run,))
    return r / np.median(r) * 0.6745, weights(problem, problem.point({}))[0][:, 0]


def at_values(problem, values):
    return problem.point({"slope": values[0], "level": values[1]})


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.long
def test_hubers_std_is_that_of_the_estimates_under_contamination():
    """400 lines with outliers that count less: neither too narrow nor too wide."""
    error, std, plain, _ = reweighted(400, contaminated)
    assert rms(error / std) == pytest.approx(1, abs=0.09)  # known to 2.5 %
    assert 0.93 < coverage(error, std, 2.0) < 0.97
    assert rms(plain) > 1.25 * rms(error)  # of least squares


def test_hubers_std_without_contamination_says_what_the_weights_cost():
    error, std, plain, own = reweighted(200, normal)
    assert 1.0 < np.mean(std) / np.mean(own) < 1.15
    assert np.mean(std) / np.mean(own) == pytest.approx(rms(error) / rms(plain), abs=0.05)


def test_hubers_std_is_the_one_that_is_printed():
    rng = np.random.default_rng(1)
    x = rng.uniform(-1, 1, (60, 1))
    run = Run.raw("r", {"x": x, "y": 1 + 2 * x + contaminated(rng, x)}, units={})
    found = attempt(line.with_effect(OUTLIERS), [run], solver="trust-region")
    X = np.c_[x, np.ones(60)]
    factor = variance_factor(found.problem, found.point)
    expected = np.sqrt(factor * np.diag(np.linalg.inv(X.T @ X)))
    np.testing.assert_allclose([found.std["slope"], found.std["level"]], expected, rtol=1e-9)


def unequal(rng, x):
    """Ten times as noisy at the ends as in the middle."""
    return 0.1 * rng.standard_normal(x.shape) * (0.1 + np.abs(x))


def test_the_robust_std_is_right_in_few_rows_of_unequal_noise():
    """HC3 in 16 rows: on the safe side, where the plain one and the sandwich without leverage are
    too narrow."""
    rng, errors, robust, plain = np.random.default_rng(2), [], [], []
    for _ in range(1000):
        x = rng.uniform(-1, 1, (16, 1))
        y = 1 + 2 * x + unequal(rng, x)
        problem = Problem(line, (Run.raw("r", {"x": x, "y": y}, units={}),))
        X = np.c_[x, np.ones(16)]
        values = np.linalg.lstsq(X, y[:, 0])[0]
        point = at_values(problem, values)
        spread = sandwich(problem, point, problem.factor(point)[0], 1.0)
        errors.append(values[0] - 2)
        robust.append(np.sqrt(spread[0, 0]))
        left = np.sum((y[:, 0] - X @ values) ** 2) / 14
        plain.append(np.sqrt(left * np.linalg.inv(X.T @ X)[0, 0]))
    assert 1.0 < rms(robust) / rms(errors) < 1.25
    assert rms(plain) / rms(errors) < 0.85


def of_colour(share):
    def noise(rng, x):
        white = rng.standard_normal(len(x) + 200)
        found = np.empty_like(white)
        found[0] = white[0]
        for k in range(1, len(white)):
            found[k] = share * found[k - 1] + white[k]
        return 0.1 * found[200:, None]

    return noise


@pytest.mark.long
def test_correlated_noise_widens_the_std_as_much_as_it_spreads_the_estimates():
    """AR(1) of 0.8: a level is known nine times less well than from as many white readings."""
    error, std, found = fits(180, of_colour(0.8), 800)
    for own in (error / std).T:  # of the slope too, over an input that is white
        assert 0.85 < rms(own) < 1.15
    over = np.mean([f.correlated_over for f in found])
    assert over == pytest.approx((1 + 0.8) / (1 - 0.8), rel=0.12)


@pytest.mark.long
def test_correlated_noise_in_few_batches_widens_it_too():
    error, std, found = fits(180, of_colour(0.8), 240)
    assert np.median([240 / (10 * f.correlated_over) for f in found]) < 30
    for own in (error / std).T:
        assert 0.85 < rms(own) < 1.15


def remembered(memory, share, spikes=0.0):
    """Noise of which a share is forgotten as exp(−k/memory), with spikes of thirty times its size
    in so many rows."""

    def noise(rng, x):
        n, kept = len(x), np.exp(-1 / memory)
        kicks = rng.standard_normal(n) * np.sqrt(1 - kept**2)
        kicks[0] = rng.standard_normal()
        slow = signal_processing.lfilter([1], [1, -kept], kicks)
        both = np.sqrt(share) * slow + np.sqrt(1 - share) * rng.standard_normal(n)
        return 0.1 * (both + 30 * (rng.random(n) < spikes))[:, None]

    return noise


def held(declared, noise, n, count=60):
    """Share of the 95 % intervals (2,) that hold slope and level of a slow input, and the rms of
    errors in printed standard deviations."""
    rng, inside, scores = np.random.default_rng(7), [], []
    t = np.arange(n)
    x = np.sin(2 * np.pi * 2.5 * t / n + 0.3) + 0.3 * np.sin(2 * np.pi * t / 23)
    for _ in range(count):
        y = 1 + 2 * x + noise(rng, x)[:, 0]
        run = Run.raw("r", {"x": x[:, None], "y": y[:, None]}, units={}, time=t * 0.01)
        found = attempt(declared, [run], solver="trust-region")
        low, high = found.interval_reach
        error = np.array([found.values[k] - v for k, v in zip(NAMES, TRUTH, strict=True)])
        inside.append([-high[k] <= e <= low[k] for k, e in zip(NAMES, error, strict=True)])
        scores.append(error / [found.std[k] for k in NAMES])
    return np.mean(inside, axis=0), np.sqrt(np.mean(np.square(scores), axis=0))


@pytest.mark.long
@pytest.mark.parametrize("spikes", [0.0, 0.01])
@pytest.mark.parametrize(("n", "memory"), [(200, 50), (1000, 50)])
def test_a_record_of_few_memories_of_its_noise_says_so(n, memory, spikes):
    """Four memories, and twenty: σ²(JᵀJ)⁻¹ times their correlation held 0.67 and 0.89 of levels."""
    declared = line.with_effect(OUTLIERS) if spikes else line
    inside, _ = held(declared, remembered(memory, 0.6, spikes), n)
    assert np.all(inside >= 0.88)  # 1 in 100 below that, of 60


@pytest.mark.long
def test_axes_with_noise_of_their_own_have_the_std_that_each_has_alone():
    """In a long record the likeliest colours of an axis leave others no chance at all, and of an
    unknown of another axis it says nothing: its std was printed as 0."""
    rng, n = np.random.default_rng(4), 6000
    colour = signal_processing.lfilter([1], [1, -0.96], rng.standard_normal((40, n, 3)), axis=1)
    z = []
    for v in 0.01 * colour * [1.0, 3.0, 1.0] + [5.0, -1.0, 0.2]:
        time = np.arange(n) * 0.02
        run = Run.raw("r", {"v": v}, units={}, time=time)
        found = attempt(three, [run], solver="trust-region")
        z.append((found.values["level"] - [5.0, -1.0, 0.2]) / found.std["level"])
    for k in range(3):
        run = Run.raw("r", {"w": v[:, k : k + 1]}, units={}, time=time)
        alone = attempt(one, [run], solver="trust-region")
        assert found.std["level"][k] == pytest.approx(alone.std["level"], rel=0.1)
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1, abs=0.2)  # 120 of them: ± 0.065


@pytest.mark.parametrize(("rows", "time"), [(90, None), (90, 0.1), (300, None)])
def test_a_table_whose_neighbours_are_alike_has_the_std_of_a_series(rows, time):
    """A list in the order in which it was read, without a time, or a short series; what is printed
    is `robust`. Of 90 rows the intervals held a half."""
    rng, inside, wider = np.random.default_rng(9), [], 0
    stamps = None if time is None else time * np.arange(rows)
    for _ in range(60):
        x = np.sin(2 * np.pi * 2.5 * np.arange(rows) / rows)[:, None]
        y = 1 + 2 * x + remembered(8, 0.8)(rng, x)
        table = Run.raw("table", {"x": x, "y": y}, units={}, time=stamps)
        found = attempt(line, [table], solver="trust-region")
        low, high = found.interval_reach
        error = {k: found.values[k] - v for k, v in zip(NAMES, TRUTH, strict=True)}
        inside.append([-high[k] <= error[k] <= low[k] for k in NAMES])
        assert found.std["slope"] == found.robust["slope"]
        wider += found.robust["slope"] > found.plain["slope"]
    assert wider >= 0.9 * 60
    assert np.all(np.mean(inside, axis=0) >= 0.88)


@pytest.mark.long
def test_outliers_take_nothing_from_what_correlation_adds():
    """Huber's variance alone is that of independent residuals, here 1 : 50."""
    inside, scores = held(line.with_effect(OUTLIERS), remembered(50, 0.6, 0.01), 4000)
    assert np.all(inside >= 0.86)
    assert np.all((scores > 0.75) & (scores < 1.3))


@pytest.mark.long
def test_white_noise_in_time_is_hardly_ever_taken_for_coloured():
    """One series in a hundred gets past by the level that is asked of neighbours."""
    found = fits(300, normal, 150, seed=1)[2]
    assert np.sum([f.correlated_over > 1 for f in found]) <= 9  # 3 expected, 1 in 1000 above 9


@model
def beginning(x=signal(), z=signal(), y=signal(), *, slope=param(), start=param()):
    """A line, and what the first readings tell alone."""
    return Residual(measured=y, predicted=slope * x + start * z)


def test_what_a_few_readings_tell_has_the_spread_of_the_noise_of_all():
    """As where a trajectory begins: two readings say nothing of their own noise. 2000 records, by
    the formulas of linear regression; those of the sandwich hold the start in 97.4 %."""
    rng, n = np.random.default_rng(1), 40
    x, z = np.linspace(0, 1, n), np.exp(-np.arange(n) / 0.4)
    y = 2 * x + 3 * z + 0.1 * rng.standard_normal((2000, n))
    found = calibrate_many(beginning, {"x": x + 0 * y, "z": z + 0 * y, "y": y})
    reach = stats.t.ppf(0.975, n - 2)
    for name, truth in (("slope", 2), ("start", 3)):
        held = np.abs(found.values[name] - truth) <= reach * found.std[name]
        assert 0.935 < held.mean() < 0.965  # three standard deviations of such a share
    # Equal noise: σ²(XᵀX)⁻¹, of one record by NumPy, in both ways of calibrating.
    X = np.stack([x, z], axis=1)
    left = y[0] - X @ np.linalg.lstsq(X, y[0])[0]
    std = np.sqrt(left @ left / (n - 2) * np.linalg.inv(X.T @ X)[1, 1])
    signals = {"x": x[:, None], "z": z[:, None], "y": y[0][:, None]}
    one = attempt(beginning, [Run.raw("one", signals, units={})])
    np.testing.assert_allclose([found.std["start"][0], one.std["start"]], std, rtol=1e-8)
