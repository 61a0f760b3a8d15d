"""What many sensors are refused for: other solutions, bounds, noise that bends with the surface.

A sensor among many must not be believed where one alone would not be.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
import simulators as sim
from scipy.optimize import lsq_linear
from test_batch import NORM, flat, line, recorded

from casest import Residual, Run, attempt, calibrate_many, model, param, signal
from casest.fleet.fit import Bounds, minimise
from casest.fleet.sums import Sensors, Squares
from casest.leastsquares.per_sample import residual_and_jacobian
from casest_problems.norm import closed_form_many


def alone(declared, signals, i, **options):
    own = {name: values[i][:, None] for name, values in signals.items()}
    return attempt(declared, [Run.raw("one", own, units={})], **options)


# -- a second solution -----------------------------------------------------------------------------


@model
def mirrored(x=signal(), z=signal(), y=signal(), *, a=param(start=0.5), b=param(start=1.0)):
    """b and −b give the same readings."""
    return Residual(measured=y, predicted=a * x + b**2 * z)


def nearly_parallel(count, apart, seed, n=40, sigma=0.01):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((count, n))
    z = x + apart * rng.standard_normal((count, n))
    y = 0.7 * x + z + sigma * rng.standard_normal((count, n))
    return {"x": x, "z": z, "y": y}


@pytest.mark.parametrize(
    ("count", "seed", "least"), [(4, 2, 1), pytest.param(60, 1, 4, marks=pytest.mark.long)]
)
def test_a_mirrored_solution_within_reach_is_found(count, seed, least):
    """From six standard deviations along the weakest direction another fit ends at −b."""
    signals = nearly_parallel(count, 0.005, seed)
    found = calibrate_many(mirrored, signals)
    said = [i for i, reasons in enumerate(found.reasons) if re.search("fit.? alike", reasons[0])]
    assert len(said) >= least
    assert not found.trusted[said].any()
    # Where the data hold b away from zero, many are believed.
    assert calibrate_many(mirrored, nearly_parallel(6, 0.05, 2)).trusted.all()


@model
def valley(x=signal(), z=signal(), w=signal(), y=signal(), *,
           a=param(start=0.5), b=param(start=-1.0)):  # fmt: skip
    """The readings' path over b bends back: near −1 lies a false optimum, at 1 the right one."""
    return Residual(measured=y, predicted=a * x + b * z + 1.4 * b**2 * w)


#: Of 4000 records those whose right optimum lies within six standard deviations of the false one;
#: of the first list it is nearer than ten in what the readings show.
NEAR = [197, 198, 338, 360, 448, 519, 543, 615, 671, 707, 907, 930, 1005, 1064, 1088, 1133, 1233]
FAR = [32, 46, 84, 88, 123, 143, 153, 173, 174, 182, 186, 231, 234, 239, 284, 289, 300, 325, 367]


@pytest.mark.parametrize(
    "chosen", [NEAR[:8], *(pytest.param(c, marks=pytest.mark.long) for c in (NEAR[8:], FAR))]
)
def test_a_false_optimum_is_not_believed_where_the_right_one_is_within_reach(chosen):
    rng = np.random.default_rng(0)
    x = rng.standard_normal((4000, 6))
    z = x + 0.05 * rng.standard_normal(x.shape)
    w = 0.05 * rng.standard_normal(x.shape)
    y = 0.7 * x + z + 1.4 * w + 0.003 * rng.standard_normal(x.shape)
    signals = {name: own[chosen] for name, own in {"x": x, "z": z, "w": w, "y": y}.items()}
    found = calibrate_many(valley, signals)
    believed = found.trusted & (found.values["b"] < 0.3)
    assert not believed.any()
    # By NumPy: of all b below 0.3, with the best a, none fits as well as the best above.
    for k in range(len(chosen)):
        own = {name: values[k] for name, values in signals.items()}
        costs = []
        for b in np.linspace(-3, 3, 1201):
            rest = own["y"] - b * own["z"] - 1.4 * b**2 * own["w"]
            rest = rest - own["x"] * (own["x"] @ rest) / (own["x"] @ own["x"])
            costs.append(rest @ rest)
        below = np.linspace(-3, 3, 1201) < 0.3
        assert np.min(np.array(costs)[~below]) < np.min(np.array(costs)[below])


# -- the noise's second order ----------------------------------------------------------------------


def test_the_std_covers_what_noise_adds_to_a_length():
    """‖v‖ of noisy readings is too long by σ²/g: with 2000 poses more than their own spread."""
    v, truth = line(60, 5, poses=2000, sigma=0.4)
    found = calibrate_many(NORM, {"v": v}, start=closed_form_many)
    assert found.trusted.all()
    diagonal = [0, 2, 5]
    away, std = (flat(p["scale"], p["offset"])[:, diagonal] for p in (found.values, found.std))
    away = away - truth[:, diagonal]
    pull = np.mean((away / std) ** 2)
    assert 0.7 < pull < 1.25
    # It is a shift, and the covariance of the noise alone would have hidden it.
    spread = np.std(away, axis=0)
    assert np.mean(np.abs(away.mean(axis=0)) / spread) > 0.5
    for i in (0, 41):
        one = attempt(NORM, recorded(v[i]))
        np.testing.assert_allclose(found.covariance[i], one.covariance, rtol=1e-3,
                                   atol=1e-5 * np.abs(one.covariance).max())  # fmt: skip


def test_noise_that_is_too_large_for_the_surface_is_refused_as_for_one():
    v, _ = line(12, 6, poses=60, sigma=0.9)
    found = calibrate_many(NORM, {"v": v}, start=closed_form_many)
    alike = [attempt(NORM, recorded(own)).certificate.trusted for own in v]
    assert not found.trusted.any()
    assert not any(alike)
    assert all("noise is too large" in reasons[0] for reasons in found.reasons)


# -- bounds ----------------------------------------------------------------------------------------


@model
def capped(x=signal(), y=signal(), *, slope=param(start=0.5, bounds=(0.0, 1.0)), level=param()):
    return Residual(measured=y, predicted=level + slope * x)


def test_at_and_near_a_bound_the_verdict_is_that_of_one_calibration():
    """Slopes from two standard deviations inside the bound to seven beyond."""
    rng = np.random.default_rng(7)
    slope = 1 + 0.05 * np.linspace(-4, 12, 17)[:, None]
    x = np.tile(rng.standard_normal(12), (17, 1))
    noise = rng.standard_normal(12)
    y = slope * x + 0.3 * noise
    found = calibrate_many(capped, {"x": x, "y": y})
    one = [alone(capped, {"x": x, "y": y}, i).certificate.trusted for i in range(17)]
    assert list(found.trusted) == one
    assert 2 < np.sum(one) < 17
    assert np.all(found.values["slope"][found.trusted] <= 1.0)


def test_each_sensor_keeps_to_the_bounds_of_its_own():
    """Value, lower and upper for each: none of them is passed, and what lies beyond is refused."""
    rng = np.random.default_rng(8)
    x = rng.standard_normal((40, 30))
    slope, high = rng.uniform(0.2, 0.8, 40), np.where(np.arange(40) % 2, 0.9, 0.1)
    y = slope[:, None] * x + 0.01 * rng.standard_normal((40, 30))
    start = {"slope": (np.full(40, 0.05), np.zeros(40), high)}
    found = calibrate_many(capped, {"x": x, "y": y}, start=start)
    np.testing.assert_array_equal(found.trusted[1::2], True)
    even = found.values["slope"][::2][found.trusted[::2]]
    assert np.all(even <= 0.1)
    np.testing.assert_allclose(found.values["slope"][1::2], slope[1::2], atol=0.01)
    free = calibrate_many(capped, {"x": x, "y": y})
    assert free.trusted.all()


@model
def held(x=signal(), z=signal(), y=signal(), *,
         a=param(start=0.5, bounds=(0.0, 1.0)), b=param()):  # fmt: skip
    return Residual(measured=y, predicted=a * x + b * z)


def test_beside_an_unknown_that_stays_on_its_bound_the_others_are_fitted():
    """Two correlated columns, and a start from which the first step leaves the bound and comes
    back: the fit is that of NumPy."""
    rng = np.random.default_rng(9)
    x = rng.standard_normal((20, 25))
    z = 0.9 * x + 0.4 * rng.standard_normal((20, 25))
    y = 0.97 * x - 2 * z + 0.01 * rng.standard_normal((20, 25))
    start = {"a": np.full(20, 0.99), "b": np.full(20, 40.0)}
    found = calibrate_many(held, {"x": x, "z": z, "y": y}, start=start)
    for i in range(20):
        a, b = np.linalg.lstsq(np.c_[x[i], z[i]], y[i])[0]
        if found.trusted[i]:
            assert abs(found.values["a"][i] - a) < 1e-5 * found.std["a"][i]
            assert abs(found.values["b"][i] - b) < 1e-5 * found.std["b"][i]
    assert found.trusted.mean() > 0.8


def test_with_unknowns_on_their_bounds_the_others_go_where_scipy_has_them():
    """Linear least squares within bounds: a third of the slopes lie beyond."""
    rng = np.random.default_rng(13)
    x, z, noise = rng.standard_normal((3, 40, 25))
    z = 0.8 * x + 0.6 * z
    y = rng.uniform(0.5, 1.3, (40, 1)) * x - 2 * z + 0.3 * noise
    squares = Squares(residual_and_jacobian(held))
    samples = np.ascontiguousarray(np.array([x, z, y]).transpose(0, 2, 1))
    limits = [np.tile(np.array(part)[:, None], 40) for part in ([0.0, -np.inf], [1.0, np.inf])]
    begin = np.tile([[0.5], [0.0]], 40)
    found = minimise(squares, Sensors(samples, None), begin, Bounds(*limits), near=False)
    for i in range(40):
        expected = lsq_linear(np.c_[x[i], z[i]], y[i], ([0, -np.inf], [1, np.inf]), tol=1e-14).x
        np.testing.assert_allclose(found.x[:, i], expected, atol=1e-6)
    assert 5 < np.sum(found.x[0] > 1 - 1e-9) < 35


# -- what else one alone would be asked ------------------------------------------------------------


def test_as_many_readings_as_unknowns_are_no_evidence():
    x = np.array([[0.0, 1.0], [2.0, 5.0]])
    found = calibrate_many(capped.having(slope=0.5), {"x": x[:, :1], "y": x[:, 1:]})
    assert not found.trusted.any()
    assert all("no redundancy" in reasons[0] for reasons in found.reasons)


def test_sigma_is_unbiased_in_few_readings():
    """Σr²/(N − n): with 12 poses and nine unknowns, four times what is divided by N."""
    v, _ = line(400, 10, poses=14)
    found = calibrate_many(NORM, {"v": v}, start=closed_form_many)
    kept = found.trusted
    assert kept.mean() > 0.5
    assert np.mean(found.sigma[kept] ** 2) == pytest.approx(1e-4, rel=0.25)


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_alike_neighbours_are_a_time_series_and_independent_ones_are_not(share):
    """200 records of 150 readings: none refused that is white, nearly all that are AR(1)."""
    rng = np.random.default_rng(11)
    x, noise = rng.standard_normal((2, 200, 150))
    for k in range(1, 150):
        noise[:, k] += share * noise[:, k - 1]
    found = calibrate_many(capped, {"x": x, "y": 0.5 * x + 0.1 * noise})
    assert found.trusted.mean() == pytest.approx(1.0 if share == 0 else 0.02, abs=0.02)


@pytest.mark.long
def test_flat_directions_are_measured_and_not_believed():
    """Readings of a cap: the cost over two standard deviations is no parabola for many of them."""
    rng = np.random.default_rng(12)
    v = np.array([
        sim.accelerometer(rng).read(sim.cap(24, rng, np.radians(a)), 0.02, rng)
        for a in np.linspace(20, 90, 16)
    ])  # fmt: skip
    found = calibrate_many(NORM, {"v": v}, start=closed_form_many)
    one = [attempt(NORM, recorded(own), solver="trust-region").certificate.trusted for own in v]
    assert not np.any(found.trusted & ~np.array(one))
    assert 2 < found.trusted.sum() < 15
