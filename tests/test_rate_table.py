"""Batista's rate table: gravity's direction unknown, at the bound that the data allow."""

from __future__ import annotations

import numpy as np
import pytest
import simulators as sim
from scipy import stats

from casest import Correction, DataError, Run, attempt, calibrate
from casest.results.find import find_model
from casest_problems.rate_table import rate_table, two_stage

# The sensor of V-A.
INVERSE_SCALE = np.array([[0.990, 0.001, -0.002], [0.020, 1.005, 0.003], [-0.010, -0.004, 1.010]])
BIAS = np.array([0.05, -0.01, 0.04])
QUADRATIC = 1e-4 * np.array([2.5, 1.5, -0.75])
DOWN = np.array([0.01, -0.02, 1.0]) / np.linalg.norm([0.01, -0.02, 1.0])
SIGMA = 0.0013


def on_the_table(rng, n=40, down=DOWN, bias=BIAS, sigma=SIGMA, name="table", **steps):
    t, R = sim.table_steps(n, rng, **steps)
    a, _ = sim.table_readings(R, down, INVERSE_SCALE, QUADRATIC, bias, sigma, rng)
    signals = {"a": a, "attitude": R.reshape(-1, 9)}
    return Run.raw(name, signals, units={"a": "m/s^2", "attitude": None}, time=t)


def test_the_trajectory_is_sampled_at_rest_in_the_middle_of_each_step():
    t, R = sim.table_steps(3, np.random.default_rng(0))
    assert len(t) == 3 * 400
    assert np.all(np.diff(t) > 0)
    assert t[400] - t[0] == pytest.approx(22.0)
    np.testing.assert_array_equal(R[0], R[399])


def test_forty_poses_reach_the_bound_not_the_published_precision():
    """The papers' README: F⁻¹ 2e-6, b′ 1.6e-5 m/s², F2 4e-7, direction 1.1e-6 rad; the published
    spread, below 1e-7 for all of them, is below the bound and cannot be reached."""
    found = calibrate(rate_table, [on_the_table(np.random.default_rng(1))])
    assert np.max(found.std["inverse_scale"]) == pytest.approx(2e-6, rel=0.3)
    assert np.max(found.std["bias"]) == pytest.approx(1.6e-5, rel=0.3)
    assert np.max(found.std["quadratic"]) == pytest.approx(4e-7, rel=0.3)
    assert np.max(found.std["gravity_direction"]) == pytest.approx(1.1e-6, rel=0.3)
    assert np.min(found.std["bias"]) > 1e-7


@pytest.mark.parametrize("tables", [6, pytest.param(30, marks=pytest.mark.long)])
def test_errors_are_as_large_as_the_covariance_says(tables):
    """Tables of 20 poses: the mean of eᵀΣ⁻¹e is that of χ² with as many unknowns."""
    rng, distance = np.random.default_rng(2), []
    for _ in range(tables):
        run = on_the_table(rng, n=20, sampled=0.1)
        found = attempt(rate_table, [run], solver="trust-region")
        assert found.certificate.trusted, found.certificate.reasons
        error = [
            found.values["inverse_scale"] - INVERSE_SCALE,
            found.values["quadratic"] - QUADRATIC,
            found.values["bias"] - BIAS,
        ]
        error = np.concatenate([e.ravel() for e in error])
        order = [i for i, name in enumerate(found.names) if "tangent" not in name]
        covariance = found.covariance[np.ix_(order, order)]
        distance.append(error @ np.linalg.solve(covariance, error))
    low, high = stats.chi2.ppf([0.001, 0.999], 15 * tables)
    assert low < sum(distance) < high


def test_the_two_stages_are_as_good_as_the_optimum_on_their_own_data():
    found = attempt(rate_table, [on_the_table(np.random.default_rng(3), n=20)], solver="two-stage")
    assert found.certificate.trusted, found.certificate.reasons
    assert "standard deviations from the certified" in found.certificate.reasons[0]


def test_the_two_stages_recover_a_noise_free_table():
    run = on_the_table(np.random.default_rng(4), n=15, sigma=0.0, sampled=0.1)
    found = two_stage(rate_table, [run])
    np.testing.assert_allclose(found["inverse_scale"], INVERSE_SCALE, atol=1e-9)
    np.testing.assert_allclose(found["quadratic"], QUADRATIC, atol=1e-9)
    np.testing.assert_allclose(found["bias"], BIAS, atol=1e-8)
    np.testing.assert_allclose(found["gravity_direction"], DOWN, atol=1e-9)


def test_a_table_that_hangs_upside_down_is_calibrated_all_the_same():
    down = np.array([0.02, 0.01, -1.0])
    found = calibrate(rate_table, [on_the_table(np.random.default_rng(5), n=20, down=down)])
    direction = found.values["gravity_direction"]
    assert direction @ down / np.linalg.norm(down) == pytest.approx(1.0, abs=1e-9)
    assert np.linalg.det(found.values["inverse_scale"]) > 0


def test_with_a_known_direction_the_rest_is_determined_better():
    run = on_the_table(np.random.default_rng(6), n=12)
    free = calibrate(rate_table, [run])
    known = calibrate(rate_table.having(gravity_direction=DOWN), [run])
    assert known.identifiability.unknowns == free.identifiability.unknowns - 2
    assert np.all(known.std["inverse_scale"] <= free.std["inverse_scale"] * 1.01)
    error = np.abs(known.values["inverse_scale"] - INVERSE_SCALE)
    assert np.all(error < 5 * known.std["inverse_scale"])


def test_two_days_share_the_scale_and_have_a_bias_each():
    rng = np.random.default_rng(7)
    other = BIAS + np.array([0.1, -0.2, 0.05])
    runs = [
        on_the_table(rng, n=15, name="monday"),
        on_the_table(rng, n=15, bias=other, name="friday"),
    ]
    found = calibrate(rate_table.scoped("bias", "run"), runs)
    assert found.values["bias"].shape == (2, 3)
    assert found.values["inverse_scale"].shape == (3, 3)
    error = np.abs(found.values["bias"] - [BIAS, other])
    assert np.all(error < 5 * found.std["bias"])


def test_the_closed_form_inverse_gives_the_forces_back():
    rng = np.random.default_rng(8)
    _, R = sim.table_steps(20, rng, sampled=0.1)
    a, force = sim.table_readings(R, DOWN, INVERSE_SCALE, QUADRATIC, BIAS, 0.0, rng)
    run = Run.raw("new", {"a": a}, units={"a": "m/s^2"})
    values = {"inverse_scale": INVERSE_SCALE, "quadratic": QUADRATIC, "bias": BIAS}
    np.testing.assert_allclose(Correction(rate_table)(run, values), force, atol=1e-13)
    linear = {**values, "quadratic": np.zeros(3)}
    np.testing.assert_allclose(
        Correction(rate_table)(run, linear), a @ INVERSE_SCALE.T - BIAS, atol=1e-13
    )


def test_a_reading_beyond_the_parabolas_top_is_refused_with_its_row():
    a = np.array([[0.0, 0.0, 9.8], [-5e3, 0.0, 0.0]])
    run = Run.raw("new", {"a": a}, units={"a": "m/s^2"}, file="new.csv")
    values = {"inverse_scale": INVERSE_SCALE, "quadratic": QUADRATIC, "bias": BIAS}
    with pytest.raises(DataError, match=r"new.csv: row 1: reading .* has no specific_force"):
        Correction(rate_table)(run, values)


@pytest.mark.long
def test_too_few_attitudes_are_refused():
    found = find_model("rate-table")
    with pytest.raises(Exception, match=r"more than one solution|not determined|equations"):
        calibrate(found, [on_the_table(np.random.default_rng(9), n=3, sampled=0.1)])
