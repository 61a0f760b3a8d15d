"""`misfit`: is a sensor's largest residual larger than noise makes it?"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student

from casest import calibrate_many, model, param, signal
from casest.declaration.physics import Residual
from casest.fleet.outlying import LEFT, both_tails


def shares(t, freedom):
    return freedom / (freedom + t**2)


def at_least(freedom):
    """The t from which on a largest of ν + 3 residuals is less probable than not."""
    return norm.isf(0.5 / (freedom + 3))


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 8, 14, 15, 31, 60, 99, 100, 101, 500, 5000])
def test_tails_are_students(freedom):
    """SciPy's own, from where the bound says anything to a reading that the fit follows."""
    t = np.geomspace(at_least(freedom), np.sqrt(freedom / LEFT), 64)
    found = both_tails(shares(t, freedom), np.full(64, float(freedom)))
    # Beyond: SciPy loses digits of tails near the smallest of numbers.
    exact = 2 * student.sf(t, freedom)
    told = exact > 1e-290
    assert told.sum() > 5
    np.testing.assert_allclose(found[told], exact[told], rtol=1e-12)
    assert (found[~told] < 1e-280).all()


def test_a_residual_that_is_none_is_no_outlying_one():
    """Beside as many as three for each degree of freedom the bound is above one."""
    freedom = np.arange(1.0, 301.0)
    for t in (0.0, 1e-9, 0.1, 0.5, 0.9):
        below = t * at_least(freedom)
        assert ((freedom + 3) * both_tails(shares(below, freedom), freedom) > 1).all()


def test_tails_have_the_bits_that_they_have_among_others():
    rng = np.random.default_rng(0)
    share, freedom = rng.uniform(0.1, 0.8, 640), rng.integers(1, 130, 640).astype(float)
    mixed = both_tails(share, freedom)
    for ν in (1.0, 14.0, 127.0):
        alone = both_tails(share, np.full(640, ν))
        assert np.array_equal(mixed[freedom == ν], alone[freedom == ν])


@model
def three(v=signal(3), w=signal(3), *, gain=param(3), offset=param(3)):
    return Residual(measured=v, predicted=gain * w + offset)


def test_of_residuals_that_depend_on_some_unknowns_each_has_its_own_leverage():
    """Three residuals of a sample on two unknowns each: the hat matrix of all of them, written out.

    The two samples with the largest residuals are looked at, and the chance is never too small.
    """
    rng = np.random.default_rng(3)
    w = rng.standard_normal((60, 8, 3)) * np.array([1.0, 10.0, 0.1])
    v = 1.1 * w + 0.3 + 0.01 * rng.standard_normal(w.shape)
    v[7, 2, 1] += 0.1
    found = calibrate_many(three, {"v": v, "w": w}, misfit=True)
    exact = []
    for own, read in zip(w, v, strict=True):
        J = np.zeros((24, 6))
        for axis in range(3):
            J[axis::3, axis], J[axis::3, 3 + axis] = own[:, axis], 1.0
        hat = J @ np.linalg.pinv(J)
        r = read.ravel() - hat @ read.ravel()
        left = r @ r - r**2 / (1 - np.diag(hat))
        t = np.abs(r) / np.sqrt(left / 17 * (1 - np.diag(hat)))
        exact.append(min(1.0, 24 * 2 * student.sf(t.max(), 17)))
    assert (found.misfit > np.array(exact) * (1 - 1e-9)).all()
    assert np.mean(found.misfit < np.array(exact) * (1 + 1e-9)) > 0.8
    assert found.misfit[7] < 1e-4


def test_sensors_of_unequal_records_have_the_misfit_that_they_have_alone():
    """To the bit; what follows a sensor's own samples is not looked at."""
    rng = np.random.default_rng(4)
    w = rng.standard_normal((50, 40, 3))
    v = 1.1 * w + 0.3 + 0.01 * rng.standard_normal(w.shape)
    counts = rng.integers(3, 41, 50)
    for i, n in enumerate(counts):
        v[i, n:] = 1e3
    together = calibrate_many(three, {"v": v, "w": w}, counts=counts, misfit=True)
    plain = calibrate_many(three, {"v": v, "w": w}, counts=counts)
    assert np.array_equal(together.covariance, plain.covariance, equal_nan=True)
    for i in (0, 13, 49, int(np.argmin(counts))):
        alone = calibrate_many(
            three, {"v": v[i : i + 1], "w": w[i : i + 1]}, counts=counts[i : i + 1], misfit=True
        )
        assert np.array_equal(alone.misfit, together.misfit[i : i + 1], equal_nan=True)
