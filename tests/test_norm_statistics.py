"""Are the printed uncertainties true? A thousand simulated calibrations, and the closed form.

Truth: a simulator that shares no code with casest, and the laws of Student and Fisher.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
import simulators as sim
from scipy import stats

from casest import Run
from casest.estimate.calibrate import attempt
from casest.results.calibration import calibration_result
from casest.results.find import find_model
from casest_problems.norm import (
    burkhard_bias,
    burkhard_diagonal,
    burkhard_full,
    levenberg_marquardt,
    six_positions,
)

POSES = 24
SIGMAS = (1e-3, 3e-3, 1e-2, 2e-2)
MANY = 500  # calibrations of each model: a share of 95 % has a spread of 1 %


def recorded(v):
    return (Run.raw("simulated", {"v": v}, units={"v": "m/s^2"}),)


def norm_model(name, norm=sim.GRAVITY):
    return find_model(name).having(norm=norm)


def flat(model_name, scale, offset):
    """Values in the order of the covariance: the scale's free entries row by row, then offset."""
    if model_name == "norm-diagonal":
        return np.concatenate([np.diag(scale) if scale.ndim == 2 else scale, offset])
    return np.concatenate([scale[np.tril_indices(3)], offset])


@dataclass(frozen=True)
class Outcome:
    """One simulated calibration: error, covariance, whether each 95 % interval holds the truth."""

    trusted: bool
    error: np.ndarray
    covariance: np.ndarray
    covered: np.ndarray
    freedom: int


def printed(found, name):
    """The 95 % interval of every value as it stands in result.json."""
    said = calibration_result(found, model_name=name, data=()).estimate.parameters
    ends = [[np.array(said[p].interval95[k]) for p in ("scale", "offset")] for k in (0, 1)]
    return [flat(name, *end) for end in ends]


def simulated(name, seed, calibrations):
    """Calibrations of many sensors at four noise levels. Solver: trust-region, for speed."""
    rng, outcomes, model = np.random.default_rng(seed), [], norm_model(name)
    for sigma in itertools.islice(itertools.cycle(SIGMAS), calibrations):
        sensor = sim.accelerometer(rng, skew=name == "norm-triangular")
        v = sensor.read(sim.spread_poses(POSES, rng), sigma, rng)
        found = attempt(model, recorded(v), solver="trust-region")
        truth, values = flat(name, sensor.scale, sensor.b), found.values
        low, high = (
            flat(name, *(values[p] + sign * reach[p] for p in ("scale", "offset")))
            for sign, reach in zip((-1, 1), found.interval_reach, strict=True)
        )
        if not outcomes:
            np.testing.assert_allclose((low, high), printed(found, name), rtol=1e-9)
        outcomes.append(
            Outcome(
                found.certificate.trusted,
                flat(name, found.values["scale"], found.values["offset"]) - truth,
                found.covariance,
                (low <= truth) & (truth <= high),
                found.noise.degrees_of_freedom,
            )
        )
    return outcomes


@pytest.fixture(scope="module", params=[30, pytest.param(MANY, marks=pytest.mark.long)])
def calibrations(request):
    """{model: outcomes} of so many calibrations of each."""
    names = ("norm-diagonal", "norm-triangular")
    return {name: simulated(name, m, request.param) for m, name in enumerate(names)}


# -- what is printed about uncertainty -------------------------------------------------------------


def test_a_good_calibration_of_24_poses_is_always_trusted(calibrations):
    refused = [o for outcomes in calibrations.values() for o in outcomes if not o.trusted]
    assert not refused


@pytest.mark.parametrize("name", ["norm-diagonal", "norm-triangular"])
def test_the_95_percent_intervals_hold_the_truth_95_times_in_a_hundred(calibrations, name):
    covered = np.array([o.covered for o in calibrations[name]])
    print(
        f"\n{name}: pooled coverage {100 * covered.mean():.2f} %,",
        "by unknown",
        np.round(100 * covered.mean(axis=0), 1),
    )
    # Of 500 draws the binomial spread is 1 %, of fewer it is larger by the root of their ratio.
    one = 0.01 * np.sqrt(MANY / len(covered))
    assert abs(covered.mean() - 0.95) < 2 * one
    # No single unknown hides behind the others.
    assert np.abs(covered.mean(axis=0) - 0.95).max() < 3 * one


def test_estimates_are_unbiased_and_their_covariance_is_right(calibrations):
    """Jointly over both models: eᵀΣ⁻¹e/n follows F(n, ν); whitened errors have mean zero."""
    probabilities, mean_statistic, mean_freedom = [], 0.0, 0
    for name, outcomes in calibrations.items():
        whitened = np.array(
            [np.linalg.solve(np.linalg.cholesky(o.covariance), o.error) for o in outcomes]
        )
        n, nu = whitened.shape[1], outcomes[0].freedom
        assert (n, nu) == {"norm-diagonal": (6, 18), "norm-triangular": (9, 15)}[name]
        ratio = np.sum(whitened**2, axis=1) / n
        law = stats.f(n, nu)
        standard_error = law.std() / np.sqrt(len(ratio))
        z = whitened / np.sqrt(nu / (nu - 2))
        print(
            f"\n{name}: mean of eᵀΣ⁻¹e/n {ratio.mean():.4f}, expected {law.mean():.4f} ± "
            f"{standard_error:.4f}; pooled z-scores: mean {z.mean():+.4f}, std {z.std():.4f}"
        )
        assert abs(ratio.mean() - law.mean()) < 4 * standard_error
        probabilities.append(law.cdf(ratio))
        mean_statistic += len(z) * np.sum(z.mean(axis=0) ** 2)
        mean_freedom += n
    uniform = stats.kstest(np.concatenate(probabilities), "uniform").pvalue
    unbiased = stats.chi2.sf(mean_statistic, mean_freedom)
    print(
        f"Kolmogorov-Smirnov against F: p = {uniform:.3f}; mean error zero: "
        f"chi2 = {mean_statistic:.1f} of {mean_freedom}, p = {unbiased:.3f}"
    )
    assert uniform > 1e-3
    assert unbiased > 1e-3


@pytest.mark.long
def test_the_std_is_right_when_noise_differs_between_poses_and_the_plain_one_is_not():
    """Six times the noise where x points along gravity: 150 calibrations of 200 poses each."""
    rng, model = np.random.default_rng(7), norm_model("norm-diagonal")
    plain, robust = [], []
    for _ in range(150):
        sensor = sim.accelerometer(rng, skew=False)
        directions = sim.sphere(200, rng)
        sigma = np.where(np.abs(directions[:, 0]) > 0.8, 1.2e-2, 2e-3)
        found = attempt(model, recorded(sensor.read(directions, sigma, rng)), solver="trust-region")
        error = found.values["scale"][0] - sensor.scale[0, 0]
        plain.append(error / found.plain["scale"][0])
        robust.append(error / found.std["scale"][0])
    # The root mean square of 150 z-scores of the right std is 1 ± 0.058.
    rms_plain, rms_robust = (float(np.sqrt(np.mean(np.square(z)))) for z in (plain, robust))
    print(f"\nrms z-score of scale[0]: plain {rms_plain:.2f}, robust {rms_robust:.2f}")
    assert 0.83 < rms_robust < 1.17
    assert rms_plain > 1.3


# -- the closed form (Burkhard et al.) -------------------------------------------------------------


@pytest.mark.parametrize("sigma", [1e-7, 1e-6, 1e-5, 1e-4, 1e-3])
def test_the_closed_form_is_within_a_fiftieth_std_of_the_optimum_on_burkhards_sensor(sigma):
    """Burkhard's Figure 1(a): 24 poses, full LLS as good as full NLLS."""
    rng, model = np.random.default_rng(11), norm_model("norm-triangular", norm=9.8055)
    worst = 0.0
    for _ in range(5):
        v = sim.adis16475(rng).read(sim.spread_poses(24, rng), sigma, rng)
        optimum = attempt(model, recorded(v), solver="trust-region")
        assert optimum.certificate.trusted, optimum.certificate.reasons
        A, b = burkhard_full(v, 9.8055)
        std = np.sqrt(np.diag(optimum.covariance))
        gap = flat("norm-triangular", A, b) - flat(
            "norm-triangular", optimum.values["scale"], optimum.values["offset"]
        )
        worst = max(worst, float(np.max(np.abs(gap) / std)))
    print(f"\nsigma {sigma:g}: closed form at most {worst:.2g} std from the optimum")
    assert worst < 0.02


def test_the_full_closed_form_recovers_a_noise_free_sensor_to_ten_digits():
    rng = np.random.default_rng(3)
    for make in (sim.accelerometer, sim.adis16475, sim.magnetometer):
        sensor = make(rng)
        A, b = burkhard_full(sensor.read(sim.spread_poses(24, rng), 0.0, rng), sensor.norm)
        np.testing.assert_allclose(A @ sensor.M, np.eye(3), atol=1e-10)
        np.testing.assert_allclose(b, sensor.b, rtol=1e-10, atol=1e-10 * np.abs(sensor.b).max())


def test_the_diagonal_closed_form_recovers_a_noise_free_sensor_to_ten_digits_from_six_poses():
    rng = np.random.default_rng(4)
    sensor = sim.accelerometer(rng, skew=False)
    A, b = burkhard_diagonal(sensor.read(sim.sphere(6, rng), 0.0, rng), sensor.norm)
    np.testing.assert_allclose(A @ sensor.M, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(b, sensor.b, atol=1e-10)


def test_the_full_method_reaches_rank_nine_with_nine_poses():
    """Papers' README, 9: nine poses give an answer (the tenth is the first check)."""
    rng = np.random.default_rng(5)
    sensor = sim.accelerometer(rng)
    A, b = burkhard_full(sensor.read(sim.spread_poses(9, rng), 0.0, rng), sensor.norm)
    np.testing.assert_allclose(A @ sensor.M, np.eye(3), atol=1e-8)
    np.testing.assert_allclose(b, sensor.b, atol=1e-8)


def test_the_closed_form_bias_does_not_depend_on_gravity_at_all():
    """Eq. (4): neither g nor λ enters the bias; and a wrong g only scales A."""
    rng = np.random.default_rng(6)
    v = sim.accelerometer(rng).read(sim.spread_poses(24, rng), 1e-2, rng)
    A, b = burkhard_full(v, 9.80665)
    for g in (1e-3, 1.0, 9.0, 1e4):
        other_A, other_b = burkhard_full(v, g)
        assert np.array_equal(other_b, b)
        np.testing.assert_allclose(other_A, A * g / 9.80665, rtol=1e-12)


@pytest.mark.parametrize("solver", ["bias-only", "closed-form"])
def test_the_estimators_offset_does_not_depend_on_the_declared_norm(solver):
    rng = np.random.default_rng(8)
    sensor = sim.Sensor(np.eye(3), rng.uniform(-0.3, 0.3, 3), sim.GRAVITY)
    run = recorded(sensor.read(sim.spread_poses(24, rng), 1e-4, rng))
    offsets = []
    for norm in (9.80665, 9.5, 1.0):
        model = norm_model("norm-diagonal", norm).having(scale=np.full(3, norm / 9.80665))
        full = norm_model("norm-diagonal", norm)
        offsets.append(attempt(full, run, solver=solver).values["offset"])
        # scale known: what is left to estimate is the offset alone, and (7) gives it
        if solver == "closed-form":
            offsets.append(attempt(model, run, solver=solver).values["offset"])
    # full and bias-only closed forms are different estimators: compare each with itself
    step = 2 if solver == "closed-form" else 1
    for first in range(step):
        same = offsets[first::step]
        np.testing.assert_allclose(same, np.broadcast_to(same[0], np.shape(same)), rtol=1e-12)


def test_the_bias_only_form_recovers_bias_and_radius_of_a_sphere():
    """Eq. (7): ‖z‖² = 2 zᵀb + (g² − ‖b‖²), from four poses on."""
    rng = np.random.default_rng(9)
    sensor = sim.Sensor(np.eye(3), np.array([0.4, -0.2, 1.3]), 9.7)
    for poses in (4, 24):
        b, radius = burkhard_bias(sensor.read(sim.spread_poses(poses, rng), 0.0, rng))
        np.testing.assert_allclose(b, sensor.b, atol=1e-12)
        np.testing.assert_allclose(radius, 9.7, rtol=1e-12)


def test_the_null_vector_of_the_closed_form_obeys_the_printed_relations():
    """Papers' README, 6: zᵀSz − 2zᵀr + d = 0 with S = AᵀA, r = S b, d = bᵀSb − g²."""
    rng = np.random.default_rng(10)
    sensor = sim.accelerometer(rng)
    z = sensor.read(sim.spread_poses(24, rng), 0.0, rng)
    A, b = burkhard_full(z, sensor.norm)
    S, r = A.T @ A, A.T @ A @ b
    quadric = np.einsum("ni,ij,nj->n", z, S, z) - 2 * z @ r + b @ S @ b - sensor.norm**2
    assert np.abs(quadric).max() < 1e-9 * sensor.norm**2
    assert np.array_equal(A, np.tril(A))
    assert np.all(np.diag(A) > 0)


# -- Ren & Liu -------------------------------------------------------------------------------------


def test_six_positions_give_the_hand_computed_scale_and_offset():
    """x reads +10.3 up and −9.7 down: offset 0.3, half range 10.0, scale 9.8/10.0; and so on."""
    v = np.array(
        [
            [10.3, -0.1, 0.05],
            [-9.7, -0.1, 0.05],
            [0.3, 9.7, 0.05],
            [0.3, -9.9, 0.05],
            [0.3, -0.1, 9.65],
            [0.3, -0.1, -9.55],
        ]
    )
    scale, offset = six_positions(v, 9.8)
    np.testing.assert_allclose(scale, [0.98, 1.0, 9.8 / 9.6], rtol=1e-14)
    np.testing.assert_allclose(offset, [0.3, -0.1, 0.05], rtol=1e-13)


@pytest.mark.parametrize("sigma", [0.0, 1e-2])
def test_ren_and_lius_iteration_ends_where_scipy_minimises_their_objective(sigma):
    """Objective (10)-(11) written here from the paper, minimised by MINPACK from the same start."""
    from scipy.optimize import least_squares

    rng = np.random.default_rng(12)
    sensor = sim.accelerometer(rng, skew=False)
    v = sensor.read(sim.spread_poses(32, rng), sigma, rng)

    def error(x):  # x = (O, S), eq. (14)
        return np.sum((x[3:] * (v - x[:3])) ** 2, axis=1) - sensor.norm**2

    start = np.concatenate([np.zeros(3), np.ones(3)])
    reference = least_squares(error, start, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    A, o, _ = levenberg_marquardt(
        v, sensor.norm, np.eye(3), np.zeros(3), np.eye(3, dtype=bool), squared=True
    )
    np.testing.assert_allclose(np.diag(A), reference[3:], rtol=1e-8)
    np.testing.assert_allclose(o, reference[:3], atol=1e-7)
