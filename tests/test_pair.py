"""Accelerometer and magnetometer together: simulated bodies of known truth, and a measured one.

The simulator (`bodies`) knows nothing of the model.
"""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
import simulators as sim
from bodies import FIELD, NOISE, Body, attitudes
from scipy import stats
from scipy.spatial.transform import Rotation

from casest import DataError, NotTrusted, Run, UsageError, attempt, calibrate, load_runs
from casest.cli import run as command
from casest.estimate.covariance import inverse_normal
from casest.leastsquares.identifiability import identify
from casest.leastsquares.problem import Problem
from casest.results.find import find_model
from casest.solve.trust_region import trust_region
from casest_problems.pair import noise_levels, weighed

PAIR = find_model("norm-pair").having(field=FIELD)


def turned_about(axis, n, rng):
    """Attitudes that differ by turns about one axis of the reference frame only."""
    turns = Rotation.from_rotvec(np.outer(rng.uniform(0, 2 * np.pi, n), axis))
    return turns.as_matrix() @ sim.random_rotation(rng)


def simulated(seed, n=24, noise=NOISE, angle=None):
    rng = np.random.default_rng(seed)
    body = Body(rng, angle)
    return body, body.record(attitudes(n, rng), rng, noise)


def away(found, truth):
    """Errors in standard deviations, every unknown once."""
    z = []
    for k, true in truth.items():
        off, std = np.atleast_1d(found.values[k] - true), np.atleast_1d(found.std[k])
        free = (std > 0) | (off != 0)  # above a diagonal there is nothing to know
        z.append(np.ravel(off[free] / std[free]))
    return np.concatenate(z)


def fitted(run, model=PAIR):
    found = attempt(model, (run,), solver="trust-region")
    assert found.certificate.trusted, found.certificate.reasons
    return found


# -- simulated truth -------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0, 3, 20, 90, 179])
def test_all_22_values_are_those_of_the_simulated_body_however_the_magnetometer_is_mounted(degrees):
    body, run = simulated(degrees, angle=np.radians(degrees))
    found = calibrate(PAIR, (run,))
    assert found.identifiability.rank == 22
    assert found.notes == ()
    z = away(found, body.truth)
    assert z.size == 22
    assert np.max(np.abs(z)) < 4
    assert np.linalg.det(found.values["magnetometer_scale"]) > 0


@pytest.mark.parametrize("dip", [-80, 0, 80])
def test_the_dip_may_be_steep_or_nothing(dip):
    rng = np.random.default_rng(dip + 90)
    body = Body(rng)
    body.dip = np.radians(dip)
    found = fitted(body.record(attitudes(24, rng), rng))
    assert np.max(np.abs(away(found, body.truth))) < 4


def test_noise_free_readings_give_the_body_back():
    body, run = simulated(6, noise=(0.0, 0.0))
    found = attempt(PAIR, (run,), solver="trust-region")
    for name, truth in body.truth.items():
        np.testing.assert_allclose(found.values[name], truth, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("bodies", [50, pytest.param(200, marks=pytest.mark.long)])
def test_the_95_percent_intervals_hold_the_truth_95_times_in_a_hundred(bodies):
    """Bodies of 24 poses; the interval is Student's, of 3·24 − 22 degrees of freedom."""
    quantile, covered = stats.t.ppf(0.975, 50), []
    for seed in range(bodies):
        body, run = simulated(1000 + seed)
        problem = Problem(PAIR, (run,))
        truth = problem.point(body.truth)
        best = trust_region(problem, truth)  # the nearest start; others are tested above
        R = problem.factor(best.point)[0]
        error = best.point.x - truth.x
        std = np.sqrt(2 * best.cost / 50 * np.diag(inverse_normal(R)))
        covered.append(np.abs(error) < quantile * std)
    share = np.mean(covered, axis=0)
    print(f"\npooled coverage {100 * np.mean(share):.2f} %, by unknown {np.round(100 * share, 1)}")
    # The binomial spread of one unknown: 1.5 % of 200 draws.
    spread = np.sqrt(0.95 * 0.05 / bodies)
    assert abs(np.mean(share) - 0.95) < 5 / 3 * spread
    # No unknown hides behind the others.
    assert share.min() > 0.95 - 4 * spread


def test_the_printed_standard_deviations_are_those_whose_intervals_were_counted():
    _, run = simulated(1000)
    found = fitted(run)
    plain = found.noise.sigma**2 * inverse_normal(found.problem.factor(found.point)[0])
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(plain), rtol=1e-9)


def test_the_three_residuals_are_equally_noisy_and_independent():
    """At the truth, whatever the units of the sensors: 6000 poses."""
    rng = np.random.default_rng(3)
    body = Body(rng)
    for noise in ((0.002, 0.2), (0.1, 0.02)):
        run = body.record(attitudes(6000, rng), rng, noise)
        model = PAIR.having(accelerometer_noise=noise[0], magnetometer_noise=noise[1])
        problem = Problem(model, (run,))
        (residuals,) = problem.residuals(problem.point(body.truth))
        np.testing.assert_allclose(np.std(residuals, axis=0), noise[0], rtol=0.04)
        between = np.corrcoef(residuals.T)[np.triu_indices(3, 1)]
        assert np.max(np.abs(between)) < 4 / np.sqrt(6000)


def test_only_the_ratio_of_the_noises_matters():
    _, run = simulated(4)
    one = fitted(run, PAIR.having(accelerometer_noise=0.02, magnetometer_noise=0.3))
    ten = fitted(run, PAIR.having(accelerometer_noise=0.2, magnetometer_noise=3.0))
    np.testing.assert_allclose(ten.point.x, one.point.x, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(ten.covariance, one.covariance, rtol=1e-4, atol=1e-12)


def test_turning_the_magnetometer_in_its_housing_turns_its_scale_and_nothing_else():
    _, run = simulated(5)
    Q = sim.random_rotation(np.random.default_rng(0))
    turned = Run.raw(
        "turned",
        {"a": run.signals["a"], "m": run.signals["m"] @ Q.T},
        units={"a": "m/s^2", "m": "uT"},
    )
    first, second = fitted(run), fitted(turned)
    np.testing.assert_allclose(second.values["dip"], first.values["dip"], atol=1e-7)
    for name, expected in (
        ("accelerometer_scale", first.values["accelerometer_scale"]),
        ("magnetometer_scale", first.values["magnetometer_scale"] @ Q.T),
        ("magnetometer_offset", Q @ first.values["magnetometer_offset"]),
    ):
        np.testing.assert_allclose(second.values[name], expected, atol=1e-5)


# -- against sensors calibrated apart --------------------------------------------------------------


def apart(run, accelerometer_norm=sim.GRAVITY, field=FIELD):
    """Both sensors by norm-triangular: (values, std) each."""
    found = []
    for name, norm in (("a", accelerometer_norm), ("m", field)):
        own = Run.raw(name, {"v": run.signals[name]}, units={"v": run.units[name]})
        found.append(attempt(find_model("norm-triangular").having(norm=norm), (own,)))
    return found


def corrected(run, A, o, S, p):
    return (run.signals["a"] - o) @ A.T, (run.signals["m"] - p) @ S.T


def joint_values(found):
    names = ("accelerometer_scale", "accelerometer_offset")
    return [found.values[n] for n in (*names, "magnetometer_scale", "magnetometer_offset")]


def dips(force, flux):
    """Angle of the field below the horizontal in each pose, degrees."""
    sine = np.sum(force * flux, axis=1) / np.linalg.norm(force, axis=1)
    return -np.degrees(np.arcsin(sine / np.linalg.norm(flux, axis=1)))


def headings(force, flux, R):
    """Error of magnetic north in each pose, degrees: its horizontal part turned back by R."""
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    level = flux - np.sum(flux * up, axis=1, keepdims=True) * up
    north = np.einsum("nij,nj->ni", R, level)
    return np.degrees(np.arctan2(north[:, 1], north[:, 0]))


@cache
def scatters():
    """Scatter of dip and heading over 300 fresh noise-free poses, median over bodies, degrees."""
    rows = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        body = Body(rng, angle=np.radians(5))
        body.dip = np.radians(60)
        run = body.record(attitudes(24, rng), rng)
        fresh = attitudes(300, rng)
        test = body.record(fresh, rng, noise=(0.0, 0.0))
        (a, m), joint = apart(run), fitted(run)
        separate = [a.values["scale"], a.values["offset"], m.values["scale"], m.values["offset"]]
        row = []
        for values in (separate, joint_values(joint)):
            force, flux = corrected(test, *values)
            row += [np.std(dips(force, flux)), np.std(headings(force, flux, fresh))]
        rows.append(row)
    return np.median(rows, axis=0)


def test_dip_and_heading_scatter_ten_times_less_than_from_sensors_calibrated_apart():
    """A magnetometer mounted 5° askew, soft iron of 15 %, field 60° steep."""
    dip_apart, heading_apart, dip_joint, heading_joint = scatters()
    print(
        f"\nscatter of dip {dip_apart:.2f}° apart, {dip_joint:.3f}° together; "
        f"of heading {heading_apart:.2f}° apart, {heading_joint:.3f}° together"
    )
    assert dip_joint < dip_apart / 10
    assert heading_joint < heading_apart / 10


def agreement(joint, alone):
    """Differences in standard deviations of what both determine: scale, offset; SᵀS of the field.

    Data are shared: the spread of a difference is at most the larger of the two.
    """
    (a, m), v = alone, joint.values
    lower = np.tril_indices(3)
    z = [
        (v["accelerometer_scale"] - a.values["scale"])[lower]
        / np.maximum(joint.std["accelerometer_scale"], a.std["scale"])[lower],
    ]
    for prefix, own in (("accelerometer", a), ("magnetometer", m)):
        std = np.maximum(joint.std[f"{prefix}_offset"], own.std["offset"])
        z.append((v[f"{prefix}_offset"] - own.values["offset"]) / std)
    # the same ellipsoid, lower triangular
    r = np.linalg.qr(v["magnetometer_scale"][:, ::-1], mode="r")
    triangular = np.abs(np.diag(r))[::-1, None] / np.diag(r)[::-1, None] * r[::-1, ::-1]
    z.append((triangular - m.values["scale"])[lower] / m.std["scale"][lower])
    return np.concatenate(z)


def test_the_pair_agrees_with_the_single_sensors_on_the_same_poses_and_is_surer():
    for seed in range(5):
        _, run = simulated(seed)
        joint, alone = fitted(run), apart(run)
        assert np.max(np.abs(agreement(joint, alone))) < 3
        for k, sensor in enumerate(("accelerometer", "magnetometer")):
            # per unit of noise, which each fit estimates anew
            together = joint.std[f"{sensor}_offset"] / (joint.noise.sigma * NOISE[k] / NOISE[0])
            assert np.all(together < alone[k].std["offset"] / alone[k].noise.sigma)


# -- what poses do not show ------------------------------------------------------------------------


@pytest.mark.parametrize(("poses", "rank"), [(6, 18), (7, 21), (8, 22), (9, 22)])
def test_eight_poses_determine_all_unknowns(poses, rank):
    body, run = simulated(poses, n=poses, noise=(0.0, 0.0))
    problem = Problem(PAIR, (run,))
    assert identify(problem, problem.point(body.truth)).rank == rank


def test_fewer_than_ten_poses_are_refused_with_the_way_out():
    _, run = simulated(7, n=9)
    with pytest.raises(DataError, match=r"9 poses are too few for norm-pair.*10 or more.*--fix"):
        attempt(PAIR, (run,))


@pytest.mark.parametrize("axis", ["horizontal", pytest.param("vertical", marks=pytest.mark.long)])
def test_turning_about_one_axis_only_is_refused_and_said(axis):
    rng = np.random.default_rng(1)
    R = turned_about([0, 0, 1] if axis == "vertical" else [0, 1, 0], 30, rng)
    run = Body(rng).record(R, rng)
    found = attempt(PAIR, (run,), solver="trust-region", intervals=False)
    assert not found.certificate.trusted
    said = " ".join(found.notes)
    assert "accelerometer lie close to a plane, a line or a point" in said
    assert "turning about one axis, such as the vertical, is not enough" in said


def test_a_field_along_the_vertical_is_refused():
    rng = np.random.default_rng(8)
    body = Body(rng)
    run = body.record(attitudes(24, rng), rng, dip=np.radians(89.7))
    found = attempt(PAIR, (run,), solver="trust-region")
    assert not found.certificate.trusted
    assert "`dip` ended on its bound" in found.certificate.reasons[0]


def test_scales_of_the_laboratory_leave_offsets_and_dip_to_four_poses_in_the_field():
    rng = np.random.default_rng(9)
    body = Body(rng)
    held = {k: v for k, v in body.truth.items() if k.endswith("scale")}
    found = fitted(body.record(attitudes(4, rng), rng), PAIR.having(**held))
    free = {k: v for k, v in body.truth.items() if k not in held}
    assert found.identifiability.rank == 7
    assert np.max(np.abs(away(found, free))) < 4


def test_a_length_or_noise_that_is_not_positive_is_refused():
    _, run = simulated(16)
    for name in ("gravity", "field", "accelerometer_noise", "magnetometer_noise"):
        said = rf"{name} = 0: it must be positive; model\.having\({name}=…"
        with pytest.raises(UsageError, match=said):
            attempt(PAIR.having(**{name: 0.0}), (run,))


# -- what is remarked ------------------------------------------------------------------------------


def test_of_two_mirrored_solutions_the_right_handed_one_is_given():
    body, run = simulated(10)
    mirrored = {**body.truth, "dip": -body.truth["dip"]}
    mirrored["magnetometer_scale"] = -mirrored["magnetometer_scale"]
    found = attempt(PAIR, (run,), start=mirrored, solver="trust-region")
    assert np.max(np.abs(away(found, body.truth))) < 4


def test_a_known_dip_of_the_other_sign_shows_a_mirrored_sensor():
    """Someone logs gravity in place of the specific force: every a has the wrong sign."""
    body, run = simulated(11)
    wrong = Run.raw(
        "wrong",
        {"a": -run.signals["a"], "m": run.signals["m"]},
        units={"a": "m/s^2", "m": "uT"},
    )
    said = fitted(wrong, PAIR.having(dip=body.dip)).notes
    assert "the magnetometer is mirrored against the accelerometer" in said[0]
    assert fitted(run, PAIR.having(dip=body.dip)).notes == ()


def test_a_wrong_ratio_of_noises_is_said_with_the_right_one():
    _, run = simulated(12, n=60, noise=(0.02, 1.5))
    (said,) = fitted(run).notes
    assert "one sensor counts too much" in said
    options = dict(part.split("=") for part in said.split() if "=" in part)
    assert float(options["accelerometer_noise"]) == pytest.approx(0.02, rel=0.25)
    assert float(options["magnetometer_noise"]) == pytest.approx(1.5, rel=0.25)
    assert fitted(run, weighed(PAIR, (run,))).notes == ()


def test_the_noise_of_each_sensor_is_found_from_its_own_misfit_or_not_at_all():
    _, run = simulated(13, n=100, noise=(0.05, 0.2))
    assert noise_levels(PAIR, (run,)) == pytest.approx((0.05, 0.2), rel=0.2)
    with pytest.raises(NotTrusted, match="12 poses do not show the noise of the accelerometer"):
        noise_levels(PAIR, (run.take(np.arange(12)),))


def test_a_field_that_differs_from_pose_to_pose_is_said():
    rng = np.random.default_rng(14)
    body = Body(rng)
    R = attitudes(40, rng)
    tilted = Rotation.from_rotvec(np.radians(2) * rng.standard_normal((40, 3))).as_matrix()
    run, moved = body.record(R, rng), body.record(tilted @ R, rng)
    disturbed = Run.raw(
        "iron",
        {"a": run.signals["a"], "m": moved.signals["m"]},
        units={"a": "m/s^2", "m": "uT"},
    )
    said = " ".join(attempt(PAIR, (disturbed,), solver="trust-region").notes)
    assert "the angle between gravity and field scatters" in said
    assert "iron nearby" in said


def test_readings_in_another_unit_than_the_field_are_said():
    _, run = simulated(15)
    gauss = Run.raw(
        "gauss",
        {"a": run.signals["a"], "m": run.signals["m"] / 100},
        units={"a": "m/s^2", "m": None},
    )
    said = " ".join(attempt(PAIR, (gauss,), solver="trust-region").notes)
    assert "times the field (48): is one of the two in another unit?" in said
    assert "--unit m=…" in said


# -- a measured record, and the command line -------------------------------------------------------

COLUMNS = [
    "--columns",
    "a=ax,ay,az",
    "--columns",
    "m=mx,my,mz",
    "--unit",
    "a=g",
    "--unit",
    "m=gauss",
]


@pytest.fixture(scope="module")
def ckexplorer(shared_data):
    """12 000 readings of a unit turned by hand, never at rest: half of the blocks fitted.

    (pair, both sensors apart, the other half); the noises as the sensors show them themselves.
    """
    (run,) = load_runs(
        shared_data / "ckexplorer/acc_mag_log.csv",
        PAIR.signals,
        columns={"a": ("ax", "ay", "az"), "m": ("mx", "my", "mz")},
        units={"a": "g", "m": "gauss"},
    )
    fit = (np.arange(len(run)) // 500) % 2 == 0
    chosen = run.take(fit)
    joint = fitted(chosen, weighed(PAIR, (chosen,)))
    return joint, apart(chosen), run.take(~fit)


def test_the_measured_pair_is_calibrated_by_the_command_line(shared_data, tmp_path, capsys):
    file = str(shared_data / "ckexplorer/acc_mag_log.csv")
    noises = ["--set", "accelerometer_noise=0.43", "--set", "magnetometer_noise=0.39"]
    assert command(["calibrate", "norm-pair", file, *COLUMNS, *noises, "-o", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert result["trusted"] is True
    scale = np.array(result["estimate"]["parameters"]["magnetometer_scale"]["value"])
    u, size, vt = np.linalg.svd(scale)
    # Both sensors sit in one package, axes parallel: the frames differ by a few degrees at most.
    assert np.degrees(Rotation.from_matrix(u @ vt).magnitude()) < 5
    assert np.ptp(size) / np.mean(size) < 0.15
    capsys.readouterr()
    assert command(["apply", str(tmp_path), file, *COLUMNS, "-o", str(tmp_path / "c.csv")]) == 0
    lines = (tmp_path / "c.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0].endswith(",".join(f"corrected_{k}" for k in range(6)))
    values = np.array([[float(x) for x in line.split(",")[-6:]] for line in lines[1:]])
    assert np.median(np.linalg.norm(values[:, :3], axis=1)) == pytest.approx(9.80665, rel=0.01)
    assert np.median(np.linalg.norm(values[:, 3:], axis=1)) == pytest.approx(50, rel=0.01)


def test_on_the_measured_record_pair_and_single_sensors_agree(ckexplorer):
    joint, alone, _ = ckexplorer
    z = agreement(joint, alone)
    print("\ndifferences in standard deviations:", np.round(z, 1))
    # One in a hundred such records has a larger one among its differences.
    assert np.max(np.abs(z)) < stats.norm.isf(0.005 / len(z))


def test_on_held_out_blocks_of_the_measured_record_the_dip_scatters_less(ckexplorer):
    """Median-based: the hand accelerates too. No part of it was fitted."""
    joint, (a, m), held_out = ckexplorer
    separate = [a.values["scale"], a.values["offset"], m.values["scale"], m.values["offset"]]
    scatter = [
        stats.median_abs_deviation(dips(*corrected(held_out, *values)), scale="normal")
        for values in (separate, joint_values(joint))
    ]
    print(f"\ndip scatters by {scatter[0]:.2f}° apart, {scatter[1]:.2f}° together")
    assert scatter[1] < 0.95 * scatter[0]
