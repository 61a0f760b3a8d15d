"""Sensors that nobody here built: physics, repetition and other tools' numbers are the truth."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from casest import load_runs
from casest.estimate.calibrate import attempt
from casest.results.find import find_model

UNITS = ("imu0", "imu1", "imu2")
LOWER = np.tril_indices(3)


def model_of(name, norm):
    return find_model(name).having(norm=norm)


def record(shared_data, file, columns, unit, **options):
    (run,) = load_runs(
        shared_data / file,
        find_model("norm-triangular").signals,
        columns={"v": columns},
        units={"v": unit},
        **options,
    )
    return run


def mpu9150(shared_data, unit):
    file = f"mpu9150-mikoff/{unit}.log"
    return record(shared_data, file, ("0", "1", "2"), "m/s^2", rate=100, at_rest=True)


def fitted(run, name="norm-triangular", norm=9.80665):
    found = attempt(model_of(name, norm), (run,))
    assert found.certificate.trusted, found.certificate.reasons
    return found


def disagreement(run, chosen, norm):
    """χ² of the difference between two parts of a record, by their combined covariance."""
    values, covariances = [], []
    for part in (run.take(chosen), run.take(~chosen)):
        found = fitted(part, norm=norm)
        values.append(np.append(found.values["scale"][LOWER], found.values["offset"]))
        covariances.append(found.covariance)
    difference = values[0] - values[1]
    return float(difference @ np.linalg.solve(sum(covariances), difference))


def blocks(run, length):
    """Every other block of a record."""
    return (np.arange(len(run)) // length) % 2 == 0


# -- MPU-9150: three units, hand-held, 22-23 positions each ----------------------------------------


@pytest.mark.parametrize("unit", UNITS)
def test_the_rest_positions_of_the_mpu9150_are_found_and_the_calibration_is_trusted(
    shared_data, unit
):
    run = mpu9150(shared_data, unit)
    assert len(run) in (22, 23)  # as its authors counted
    found = fitted(run)
    # Datasheet (PS-MPU-9150A, 6.2): sensitivity ±3 %, cross-axis ±2 %, zero-g ±80 mg, ±150 mg (z).
    assert np.all(np.abs(np.diag(found.values["scale"]) - 1) < 0.03)
    assert np.all(np.abs(found.values["scale"][np.tril_indices(3, -1)]) < 0.02)
    assert np.all(np.abs(found.values["offset"]) < np.array([0.08, 0.08, 0.15]) * 9.80665)


@pytest.mark.parametrize("unit", UNITS)
def test_the_skew_of_the_mpu9150_is_real(shared_data, unit):
    """Without it the misfit is several times the scatter at rest; with it, no more than that."""
    run = mpu9150(shared_data, unit)
    diagonal, triangular = fitted(run, "norm-diagonal"), fitted(run)
    assert diagonal.noise.residual > 3 * diagonal.noise.repeats
    assert triangular.noise.residual < 1.5 * triangular.noise.repeats
    skew = triangular.values["scale"][2, 0] / triangular.std["scale"][2, 0]
    assert abs(skew) > 5


def test_what_the_mpu9150_calibrations_leave_over_is_what_repeats_show(shared_data):
    """Σ residual²/repeats² over three units is χ² with 3·14 degrees of freedom."""
    found = [fitted(mpu9150(shared_data, unit)) for unit in UNITS]
    freedom = [f.noise.degrees_of_freedom for f in found]
    statistic = sum(
        n * (f.noise.residual / f.noise.repeats) ** 2 for f, n in zip(found, freedom, strict=True)
    )
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], sum(freedom))
    print(
        "\nresidual:",
        [f"{f.noise.residual:.2g}" for f in found],
        "repeats:",
        [f"{f.noise.repeats:.2g}" for f in found],
    )
    assert low < statistic < high


@pytest.mark.parametrize("split", ["interleaved", "halves"])
def test_two_parts_of_each_mpu9150_record_agree_as_well_as_their_uncertainties_say(
    shared_data, split
):
    """Not worse, and over three units not incredibly better either."""
    total = 0.0
    for unit in UNITS:
        run = mpu9150(shared_data, unit)
        index = np.arange(len(run))
        chosen = index % 2 == 0 if split == "interleaved" else index < (len(run) + 1) // 2
        total += disagreement(run, chosen, 9.80665)
    p = stats.chi2.sf(total, 27)
    print(f"\n{split}: chi2 {total:.1f} of 27")
    assert 1e-3 < p < 1 - 1e-3


def test_the_command_line_calibrates_the_mpu9150_as_the_library_does(shared_data, tmp_path, capsys):
    from casest.cli import run

    log = shared_data / "mpu9150-mikoff" / "imu0.log"
    arguments = ["calibrate", "norm-triangular", str(log), "--columns", "v=0,1,2", "--rate", "100"]
    code = run([*arguments, "--at-rest", "--set", "norm=9.80665", "-o", str(tmp_path)])
    assert code == 0, capsys.readouterr().err
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["trusted"] is True
    found = fitted(mpu9150(shared_data, "imu0"))
    for name in ("scale", "offset"):
        printed = result["estimate"]["parameters"][name]
        np.testing.assert_allclose(printed["value"], found.values[name], atol=1e-9)
        np.testing.assert_allclose(printed["std"], found.std[name], rtol=1e-6)
    rows = (tmp_path / "residuals.csv").read_text().splitlines()
    assert len(rows) == 1 + result["samples"][0]["samples"]


# -- ckexplorer: MPU-9250-type accelerometer in g, magnetometer in gauss ---------------------------


def acc_log(shared_data, at_rest):
    return record(shared_data, "ckexplorer/acc_log.csv", ("ax", "ay", "az"), "g", at_rest=at_rest)


def test_the_ckexplorer_accelerometer_is_within_its_datasheet(shared_data):
    """PS-MPU-9250A, 3.2: sensitivity ±3 %, cross-axis ±2 %, zero-g ±60 mg (x, y), ±80 mg (z)."""
    found = fitted(acc_log(shared_data, at_rest=True), norm=1.0)
    assert np.all(np.abs(np.diag(found.values["scale"]) - 1) < 0.03)
    assert np.all(np.abs(found.values["scale"][np.tril_indices(3, -1)]) < 0.02)
    assert np.all(np.abs(found.values["offset"]) < np.array([0.06, 0.06, 0.08]))


def test_raw_rows_and_rest_means_of_the_ckexplorer_accelerometer_give_one_sensor(shared_data):
    raw, rest = (fitted(acc_log(shared_data, at_rest=r), norm=1.0) for r in (False, True))
    for name, free in (("scale", LOWER), ("offset", slice(None))):
        z = (raw.values[name] - rest.values[name])[free]
        # The same record: the spread of the difference is at most the larger one's.
        z = z / np.maximum(raw.std[name], rest.std[name])[free]
        assert np.max(np.abs(z)) < 3


@pytest.mark.parametrize("split", ["blocks", "halves"])
@pytest.mark.parametrize("kind", ["raw", "rest", "magnetometer"])
def test_two_parts_of_the_ckexplorer_records_agree_within_their_combined_uncertainty(
    shared_data, kind, split
):
    if kind == "magnetometer":
        file, columns = "ckexplorer/acc_mag_log.csv", ("mx", "my", "mz")
        run = record(shared_data, file, columns, "gauss")
    else:
        run = acc_log(shared_data, at_rest=kind == "rest")
    length = 20 if kind == "rest" else 500
    chosen = blocks(run, length if split == "blocks" else len(run) // 2)
    total = disagreement(run, chosen, 1.0)
    print(f"\n{kind}, {split}: chi2 {total:.1f} of 9")
    assert stats.chi2.sf(total, 9) > 1e-4


def test_the_ckexplorer_magnetometer_was_on_earth(shared_data):
    """The sphere's radius in gauss, g over the scale: 0.22-0.67 G on the ground."""
    run = record(shared_data, "ckexplorer/acc_mag_log.csv", ("mx", "my", "mz"), "gauss")
    found = fitted(run, norm=1.0)
    field = np.linalg.det(found.values["scale"]) ** (-1 / 3)
    assert 0.22 < field < 0.67


def test_the_field_strength_assumed_changes_the_magnetometers_scale_but_not_its_offset(shared_data):
    run = record(shared_data, "ckexplorer/acc_mag_log.csv", ("mx", "my", "mz"), "gauss")
    unit, field = fitted(run, norm=1.0), fitted(run, norm=0.45)
    np.testing.assert_allclose(field.values["offset"], unit.values["offset"], atol=1e-8)
    np.testing.assert_allclose(field.values["scale"], 0.45 * unit.values["scale"], atol=1e-7)


# -- QMC5883L: a magnetometer in counts, 455 s, turned by hand -------------------------------------


def qmc(shared_data, which):
    file = f"qmc5883l-tomisuarez/{which}_raw_data.csv"
    return record(shared_data, file, ("mx", "my", "mz"), "count")


def published_qmc(shared_data):
    """(AᵀA, centre) of its author: h = A m + b."""
    numbers = np.loadtxt(shared_data / "qmc5883l-tomisuarez" / "ref_paramters_mag.csv")
    A, b = numbers[:9].reshape(3, 3), numbers[9:]
    return A.T @ A, -np.linalg.solve(A, b)


def test_the_qmc5883l_raw_record_agrees_with_its_authors_calibration(shared_data):
    """Both leave about 6 % of the radius unexplained; they agree within a third of that."""
    found = fitted(qmc(shared_data, "noisy"), norm=1.0)
    ellipsoid, centre = published_qmc(shared_data)
    own = found.values["scale"].T @ found.values["scale"]
    ratio = np.sqrt(np.diag(own) / np.diag(ellipsoid))
    assert np.all(np.abs(ratio - 1) < 0.02)
    radius = 1 / np.sqrt(np.diag(ellipsoid))
    assert np.all(np.abs(found.values["offset"] - centre) / radius < 0.02)


def test_interleaved_parts_of_the_qmc5883l_record_agree_within_their_uncertainty(shared_data):
    run = qmc(shared_data, "noisy")
    assert stats.chi2.sf(disagreement(run, blocks(run, 500), 1.0), 9) > 1e-4


@pytest.mark.parametrize("which", ["noisy", "filtered"])
def test_neighbouring_samples_of_the_qmc5883l_do_not_count_as_independent(shared_data, which):
    """Std from 22 700 samples would be a count; two halves differ by more than that."""
    run = qmc(shared_data, which)
    found = fitted(run, norm=1.0)
    independent = found.noise.residual * np.sqrt(3 / len(run))
    assert np.all(found.std["offset"] > 1.5 * independent)
    first, last = (fitted(run.take(s), norm=1.0) for s in (slice(0, 11371), slice(11371, None)))
    z = (first.values["offset"] - last.values["offset"]) / np.hypot(
        first.std["offset"], last.std["offset"]
    )
    print(f"\n{which}: offset of the halves differs by", np.round(z, 1), "standard deviations")
    assert np.max(np.abs(z)) < 5


# -- MPU-6050: ten positions -----------------------------------------------------------------------


def test_ten_positions_of_the_mpu6050_are_refused_and_the_weak_direction_is_named(shared_data):
    """One redundant pose, none with x and y both tilted: `scale[1,0]` hangs on `offset[0]`."""
    file = "mpu6050-tomisuarez/example_data_calibration.csv"
    run = record(shared_data, file, ("ax", "ay", "az"), "count", at_rest=True)
    assert len(run) == 10  # ref_static_intervals.csv
    found = attempt(model_of("norm-triangular", 9.80665), (run,))
    assert not found.certificate.trusted
    assert found.weak
    assert "scale[1,0]" in found.weak[0].words
    assert "offset[0]" in found.weak[0].words


def test_the_mpu6050_positions_are_those_that_its_author_averaged(shared_data):
    """Calibrated with the author's own numbers, our ten means are his, to his shortest rest.

    His intervals are as short as two samples, and the noise is 0.05 m/s² per sample.
    """
    file = "mpu6050-tomisuarez/example_data_calibration.csv"
    run = record(shared_data, file, ("ax", "ay", "az"), "count", at_rest=True)
    folder = shared_data / "mpu6050-tomisuarez"
    published = np.loadtxt(folder / "ref_params_acc.csv")
    averages = np.loadtxt(folder / "ref_calibrated_accel_avg_data.csv", delimiter=",")
    own = (run.signals["v"] + published[6:]) * published[3:6]
    assert np.max(np.abs(own - averages)) < 0.1


def test_the_published_mpu6050_parameters_lie_inside_the_intervals_of_ours(shared_data):
    """Refused or not, std must cover the difference: a = K(v + b), 3 scales and 3 biases."""
    file = "mpu6050-tomisuarez/example_data_calibration.csv"
    run = record(shared_data, file, ("ax", "ay", "az"), "count", at_rest=True)
    found = attempt(model_of("norm-triangular", 9.80665), (run,))
    published = np.loadtxt(shared_data / "mpu6050-tomisuarez" / "ref_params_acc.csv")
    z = (found.values["offset"] + published[6:]) / found.std["offset"]
    assert np.max(np.abs(z)) < 2
    z = (np.diag(found.values["scale"]) - published[3:6]) / np.diag(found.std["scale"])
    assert np.max(np.abs(z)) < 2


# -- NilsPod: a Ferraris session, calibrated by imucal ---------------------------------------------


def ferraris(shared_data):
    file, columns = "imucal/example_ferraris_session.csv", ("acc_x", "acc_y", "acc_z")
    return record(shared_data, file, columns, "m/s^2", rate=102.4, at_rest=True)


def test_imucals_gain_and_bias_of_the_ferraris_session_lie_within_three_std_of_ours(shared_data):
    """Where the models coincide: K_a = 1/scale and b_a = offset (SOURCE.md), g = 9.81."""
    found = fitted(ferraris(shared_data), "norm-diagonal", norm=9.81)
    gain = 1 / found.values["scale"]
    gain_std = found.std["scale"] * gain**2
    assert np.max(np.abs(gain - [0.99675, 1.00244, 1.02340]) / gain_std) < 3
    assert (
        np.max(np.abs(found.values["offset"] - [0.5371, -0.6162, 0.3989]) / found.std["offset"]) < 3
    )


def test_imucals_example_calibration_of_the_raw_counts_lies_within_three_std_of_ours(shared_data):
    """`example_cal.json`: K_a in counts per m/s² and b_a in counts, of another tool's method."""
    runs = record(
        shared_data,
        "imucal/annotated_session.csv",
        ("acc_x", "acc_y", "acc_z"),
        "count",
        rate=102.4,
        at_rest=True,
    )
    published = json.loads((shared_data / "imucal/example_cal.json").read_text(encoding="utf-8"))
    found = fitted(runs, "norm-diagonal", norm=9.81)
    scale = 1 / np.diag(np.array(published["K_a"]))
    assert np.max(np.abs(found.values["scale"] - scale) / found.std["scale"]) < 3
    assert np.max(np.abs(found.values["offset"] - published["b_a"]) / found.std["offset"]) < 3


@pytest.mark.long
def test_six_orientations_of_a_ferraris_session_do_not_determine_nine_unknowns(shared_data):
    """Thirteen rests, but six directions: a skew model must be refused, not solved."""
    found = attempt(model_of("norm-triangular", 9.81), (ferraris(shared_data),))
    assert not found.certificate.trusted
    assert "determine" in " ".join(found.certificate.reasons)
