"""A vector carried from rest to rest, and how late a gyroscope is read, against SciPy and
quaternions."""

from __future__ import annotations

import numpy as np
import pytest
from imus import an_imu, recorded, waved
from scipy.integrate import solve_ivp

from casest import Run, attempt
from casest.data import at_rest
from casest.leastsquares.on_the_way import means_on_the_way
from casest.results.find import find_model

UNITS = {"a": "m/s^2", "w": "rad/s", "m": "uT"}


def rate(t):
    return np.array([2 * np.sin(3 * t), 1.5 * np.cos(2 * t) + 0.5, 1 - t])


def vector(t):
    return np.array([np.cos(t), 1 + t, np.sin(2 * t)])


def test_the_mean_is_that_of_an_integrator_with_steps_of_its_own():
    def slope(t, state):
        C = state[:9].reshape(3, 3)
        w = rate(t)
        turning = np.cross(np.eye(3), w)  # rows e_i × w: the skew matrix of w
        return np.concatenate([(C @ turning).ravel(), C @ vector(t)])

    found = solve_ivp(slope, (0, 2), [*np.eye(3).ravel(), 0, 0, 0], rtol=1e-11, atol=1e-11)
    exact = found.y[9:, -1] / 2

    def error(n):
        t = np.linspace(0, 2, n)
        both = np.hstack([rate(t).T, vector(t).T])
        return np.abs(
            means_on_the_way(both, both[:, :, None], t, np.array([(0, n - 1)]))[0] - exact
        )

    assert error(401).max() < 2e-5
    assert error(201).max() / error(401).max() == pytest.approx(4, rel=0.05)


def test_slopes_of_the_mean_are_those_of_finite_differences():
    rng = np.random.default_rng(0)
    t, spans = np.linspace(0, 2, 120), np.array([(0, 50), (51, 119)])
    both, slopes = np.hstack([rate(t).T, vector(t).T]), rng.normal(size=(120, 6, 3))
    found = means_on_the_way(both, slopes, t, spans)[1]
    for j in range(3):
        ahead, behind = (
            means_on_the_way(both + e * slopes[:, :, j], slopes[:, :, :0], t, spans)[0]
            for e in (1e-6, -1e-6)
        )
        assert np.abs((ahead - behind) / 2e-6 - found[:, :, j]).max() < 1e-8


@pytest.mark.parametrize(
    ("model", "late", "seed"),
    [
        ("gyro-rests", 0.004, 1),
        pytest.param("gyro-rests", 0.0, 2, marks=pytest.mark.long),
        pytest.param("imu", -0.03, 3, marks=pytest.mark.long),
    ],
)
def test_how_late_the_gyroscope_is_read_is_found(model, late, seed):
    rng = np.random.default_rng(seed)
    imu = an_imu(rng, late=late)
    record = recorded(waved(rng, rests=16), imu, rng)
    declared = find_model(model).freed("gyroscope_delay")
    signals = {s.name: record[s.name] for s in declared.signals}
    run = at_rest(Run.raw("imu", signals, units=UNITS, time=record["t"]), wanders=["w"])
    found = attempt(declared, [run], intervals=False)
    value, std = float(found.values["gyroscope_delay"]), float(found.std["gyroscope_delay"])
    assert std < 2e-4
    assert abs(value - late) < 3 * std
    assert not any("older" in note for note in found.notes)
