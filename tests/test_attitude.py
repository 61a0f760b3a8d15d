"""Ren & Liu's attitude and pre-filter, gravity and field at a place, their printed tables."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg
from scipy.spatial.transform import Rotation

from casest.cli import run
from casest.cli.earth import magnetic_field, normal_gravity
from casest.errors import UsageError
from casest_problems.attitude import scalar_kalman, steady_gain, tilt_compensated


def seen_by_the_body(yaw, pitch, roll, dip=1.1):
    """Gravity and field in body axes (x forward, y right, z down) for angles in rad."""
    to_body = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).inv()
    return to_body.apply([0, 0, 9.81]), to_body.apply([np.cos(dip), 0, np.sin(dip)])


def test_angles_are_those_of_the_rotation_with_the_right_signs():
    rng = np.random.default_rng(0)
    yaw, roll = rng.uniform(-3, 3, (2, 50))
    pitch = rng.uniform(-1.3, 1.3, 50)
    found = tilt_compensated(*seen_by_the_body(yaw, pitch, roll))
    np.testing.assert_allclose(found.yaw, yaw, atol=1e-12)
    np.testing.assert_allclose(found.pitch, pitch, atol=1e-12)
    np.testing.assert_allclose(found.roll, roll, atol=1e-12)


def test_a_heading_of_plus_thirty_degrees_is_not_minus_thirty():
    """What the sign printed in (8) would give."""
    found = tilt_compensated(*seen_by_the_body(np.radians([30]), np.zeros(1), np.zeros(1)))
    assert np.degrees(found.yaw[0]) == pytest.approx(30.0)
    east = tilt_compensated(
        *seen_by_the_body(np.radians([30]), np.zeros(1), np.zeros(1)), declination=np.radians(3)
    )
    assert np.degrees(east.yaw[0]) == pytest.approx(33.0)


def test_standard_deviations_of_the_angles_are_those_of_repeated_readings():
    rng = np.random.default_rng(1)
    gravity, field = seen_by_the_body(np.array([0.7]), np.array([0.4]), np.array([-0.6]))
    n, gs, fs = 20_000, 0.05, 0.003
    noisy = tilt_compensated(
        gravity + gs * rng.standard_normal((n, 3)), field + fs * rng.standard_normal((n, 3))
    )
    found = tilt_compensated(gravity, field, gravity_std=gs, field_std=fs)
    for name in ("roll", "pitch", "yaw"):
        seen = np.std(getattr(noisy, name))
        assert getattr(found, f"{name}_std")[0] == pytest.approx(seen, rel=0.03)


@pytest.mark.parametrize(("Q", "R"), [(1e-4, 1.0), (0.1, 2.0), (3.0, 0.5)])
def test_the_filters_gain_tends_to_the_riccati_equations(Q, R):
    one = np.array([[1.0]])
    P = float(linalg.solve_discrete_are(one, one, Q * one, R * one)[0, 0])
    _, gains = scalar_kalman(np.zeros(2000), Q=Q, R=R)
    assert gains[-1] == pytest.approx(P / (P + R), rel=1e-9)
    assert steady_gain(Q, R) == pytest.approx(P / (P + R), rel=1e-12)


def test_the_filter_is_the_least_squares_estimate_of_a_constant_without_process_noise():
    z = np.random.default_rng(2).standard_normal(50) + 3
    filtered, _ = scalar_kalman(z, Q=0.0, R=1.0, P=1e12)
    np.testing.assert_allclose(filtered, np.cumsum(z) / np.arange(1, 51), rtol=1e-9)


# -- Tables III and IV, as printed -----------------------------------------------------------------

YAW = np.arange(0, 361, 45.0)
BEFORE = np.array([20.63, 60.6, 106.69, 158.86, 204.94, 251.07, 293.6, 333.1, 16.28])
AFTER = np.array([23.11, 67.7, 113.32, 158.43, 202.46, 247.53, 292.97, 337.67, 22.54])


def difference(headings):
    return (headings - YAW + 180) % 360 - 180


def test_the_published_yaw_ranges_do_not_follow_from_the_printed_columns():
    """Printed: 22.86 ± 1.08° after, ± 12.26° before; the columns give 0.49 and 5.2."""
    after, before = difference(AFTER), difference(BEFORE)
    assert np.mean(after) == pytest.approx(22.86, abs=0.005)
    assert np.std(after, ddof=1) == pytest.approx(0.36, abs=0.005)
    assert np.ptp(after) / 2 == pytest.approx(0.485, abs=0.001)
    assert np.ptp(before) / 2 == pytest.approx(5.2, abs=0.6)
    assert np.std(before, ddof=1) == pytest.approx(4.09, abs=0.01)


def test_normal_gravity_is_the_ellipsoids_at_equator_and_pole():
    """WGS84 defining report: 9.7803253359 and 9.8321849378 m/s²; free air −3.086e-6 1/s²."""
    assert normal_gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-9)
    assert normal_gravity(90.0, 0.0) == pytest.approx(9.8321849378, abs=1e-9)
    drop = normal_gravity(45.0, 1000.0) - normal_gravity(45.0, 0.0)
    assert drop == pytest.approx(-3.086e-3, rel=1e-3)


def test_the_field_is_that_of_the_world_magnetic_models_test_values():
    """WMM2025 report: 80° N, 0° E, 0 km, 2025.0: D 1.28°, I 83.21°, F 55 178.5 nT."""
    field = magnetic_field(80.0, 0.0, 0.0, 2025.0)
    assert np.degrees(field.declination) == pytest.approx(1.28, abs=0.01)
    assert np.degrees(field.inclination) == pytest.approx(83.21, abs=0.01)
    assert field.strength == pytest.approx(55.1785, abs=0.001)


def test_places_that_do_not_exist_and_years_not_covered_are_refused():
    with pytest.raises(UsageError, match="latitude 95"):
        normal_gravity(95.0, 0.0)
    with pytest.raises(UsageError, match="year 1900"):
        magnetic_field(10.0, 10.0, 0.0, 1900.0)


def test_gravity_of_a_place_can_be_set_on_the_command_line(tmp_path, capsys):
    rng = np.random.default_rng(3)
    d = rng.standard_normal((20, 3))
    v = 9.8062 * d / np.linalg.norm(d, axis=1)[:, None] + 1e-3 * rng.standard_normal((20, 3))
    path = tmp_path / "v.csv"
    rows = "\n".join(",".join(f"{x:.6f}" for x in row) for row in v)
    path.write_text("vx [m/s^2],vy [m/s^2],vz [m/s^2]\n" + rows, encoding="utf-8")
    command = ["calibrate", "norm-diagonal", str(path), "--set"]
    assert run([*command, "norm=gravity(45.46, 120)"]) == 0
    assert "norm = 9.80624" in capsys.readouterr().out
    assert run([*command, "norm=gravity(45.46)"]) == 1
    assert "gravity(latitude, height)" in capsys.readouterr().err
