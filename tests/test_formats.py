"""ROS, Kalibr, ArduPilot and PX4: their correction, applied to our readings, gives ours.

Each `of_…` below is that project's own formula, from its source: imu_calib's applyCalib; Kalibr's
IccScaledMisalignedImu; ArduPilot's _rotate_and_correct_accel, _rotate_and_correct_gyro and
correct_field; PX4's calibration::Accelerometer, Gyroscope and Magnetometer::Correct.
"""

from __future__ import annotations

import re

import numpy as np
import pytest

from casest.cli import run as casest
from casest.correction.formats import lower_times_rotation

rng = np.random.default_rng(0)
SCALE = np.array([[1.02, 0, 0], [0.01, 0.98, 0], [-0.02, 0.015, 1.01]])
OWN = '''
from casest import Residual, full, model, param, quantity, signal


@model
def gyro(rate=signal(3, "rad/s"), w=signal(3, "rad/s"), *,
         gain=param(full(3)), bias=param(3, "rad/s")):
    """A gyroscope on a rate table."""
    true = quantity("true", rate, "rad/s")
    return Residual(measured=w, predicted=quantity("read", gain @ true + bias, "rad/s"),
                    corrected=true)


@model
def bias_only(rate=signal(3, "rad/s"), w=signal(3, "rad/s"), *, bias=param(3, "rad/s")):
    """A gyroscope whose offset alone is off."""
    true = quantity("true", rate, "rad/s")
    return Residual(measured=w, predicted=quantity("read", true + bias, "rad/s"), corrected=true)


@model
def beside_a_motor(field=signal(3, "gauss"), m=signal(3, "gauss"), current=signal("A"), *,
                   gain=param(3, start=1.0), bias=param(3, "gauss"),
                   motor=param(3, "gauss/A")):
    """A magnetometer on a drone."""
    true = quantity("true", field, "gauss")
    reading = quantity("read", gain * true + bias + motor * current, "gauss")
    return Residual(measured=m, predicted=reading, corrected=true)
'''


def turned(n, length):
    v = rng.normal(size=(n, 3))
    return length * v / np.linalg.norm(v, axis=1)[:, None]


def table(path, names, unit, columns, more=""):
    header = ",".join(f"{n} [{unit}]" for n in names) + more
    np.savetxt(path, columns, delimiter=",", header=header, comments="", fmt="%.12g")
    return str(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Results of an accelerometer in g, a magnetometer in uT, two gyroscopes, one with a motor."""
    folder = tmp_path_factory.mktemp("formats")
    force = turned(40, 1.0)
    axes = force / [1.02, 0.98, 1.01] + [0.03, -0.02, 0.05]
    noise = 1e-4 * rng.normal(size=(40, 3))
    g = table(folder / "acc.csv", ("vx", "vy", "vz"), "g", axes + noise)
    known = ["--set", "norm=9.80665 m/s^2"]
    assert casest(["calibrate", "norm-diagonal", g, *known, "-o", str(folder / "acc")]) == 0
    assert casest(["calibrate", "norm-triangular", g, *known, "-o", str(folder / "skew")]) == 0
    flux = np.linalg.solve(SCALE, turned(60, 48.0).T).T + np.array([12.0, -7.0, 30.0])
    noise = 0.05 * rng.normal(size=(60, 3))
    m = table(folder / "mag.csv", ("vx", "vy", "vz"), "uT", flux + noise)
    known = ["--set", "norm=0.48 gauss"]
    assert casest(["calibrate", "norm-triangular", m, *known, "-o", str(folder / "mag")]) == 0
    (folder / "own.py").write_text(OWN)
    rate = rng.uniform(-2, 2, (50, 3))
    tilt = np.array([[1, 0.02, -0.03], [-0.02, 1, 0.01], [0.03, -0.01, 1]]) @ np.diag([1.1, 0.9, 1])
    for name, matrix in (("gyro", tilt), ("bias_only", np.eye(3))):
        w = rate @ matrix.T + [0.01, -0.02, 0.03] + 1e-4 * rng.normal(size=rate.shape)
        names = ("rate_x", "rate_y", "rate_z", "wx", "wy", "wz")
        file = table(folder / f"{name}.csv", names, "rad/s", np.hstack([rate, w]))
        words = ["calibrate", f"{folder / 'own.py'}:{name}", file, "-o", str(folder / name)]
        assert casest(words) == 0
    field, current = turned(50, 0.48), rng.uniform(0, 30, 50)
    m = field * [1.05, 0.97, 1.01] + [0.1, -0.05, 0.2]
    m = m + current[:, None] * [1e-3, -2e-3, 5e-4] + 1e-4 * rng.normal(size=(50, 3))
    names = ("field_x", "field_y", "field_z", "mx", "my", "mz")
    columns = np.column_stack([field, m, current])
    file = table(folder / "motor.csv", names, "gauss", columns, ",current [A]")
    words = ["calibrate", f"{folder / 'own.py'}:beside_a_motor", file]
    assert casest([*words, "-o", str(folder / "motor")]) == 0
    return folder


def ours(folder, result, record, capsys, *words):
    capsys.readouterr()
    assert casest(["apply", str(folder / result), str(folder / record), *words]) == 0
    out = capsys.readouterr().out.splitlines()
    return np.genfromtxt(out, delimiter=",", skip_header=1)[:, -3:], out[0]


def exported(folder, result, to, name):
    file = folder / name
    assert casest(["export", str(folder / result), "--to", to, "-o", str(file)]) == 0
    return file


def given(file):
    """Parameters of a file as their ground stations read them: a name and a number."""
    return {
        n: float(v)
        for n, v in re.findall(r"([A-Z][A-Z0-9_]+)[,\t]([-+.\deE]+)", file.read_text())
    }  # fmt: skip


def vector(p, name):
    return np.array([p[name.format(a)] for a in "XYZ"])


def record(folder, name, factor):
    return factor * np.genfromtxt(folder / name, delimiter=",", skip_header=1)


def of_ardupilot_accel(p, accel):
    return (accel - vector(p, "INS_ACCOFFS_{}")) * vector(p, "INS_ACCSCAL_{}")


def of_ardupilot_compass(p, mag, current):
    """correct_field, in milligauss."""
    mag = mag + vector(p, "COMPASS_OFS_{}")
    dx, dy, dz = vector(p, "COMPASS_DIA_{}")
    ox, oy, oz = vector(p, "COMPASS_ODI_{}")
    mag = mag @ np.array([[dx, ox, oy], [ox, dy, oz], [oy, oz, dz]]).T
    if "COMPASS_MOT_X" in p:
        mag = mag + current[:, None] * vector(p, "COMPASS_MOT_{}")
    return mag


def of_px4_accel(p, accel):
    return (accel - vector(p, "CAL_ACC0_{}OFF")) * vector(p, "CAL_ACC0_{}SCALE")


def of_px4_mag(p, data, kiloampere):
    """Magnetometer::Correct, in gauss; set_offdiagonal gives (0,1), (0,2), (1,2)."""
    scale = np.diag(vector(p, "CAL_MAG0_{}SCALE"))
    off = vector(p, "CAL_MAG0_{}ODIAG")
    for k, (i, j) in enumerate([(0, 1), (0, 2), (1, 2)]):
        scale[i, j] = scale[j, i] = off[k]
    if "CAL_MAG0_XCOMP" in p:
        data = data + kiloampere[:, None] * vector(p, "CAL_MAG0_{}COMP")
    return (data - vector(p, "CAL_MAG0_{}OFF")) @ scale.T


def test_accelerometers_of_autopilots_give_our_corrections(folder, capsys):
    expected, header = ours(folder, "acc", "acc.csv", capsys)
    assert "[m/s^2]" in header
    raw = record(folder, "acc.csv", 9.80665)
    p = given(exported(folder, "acc", "ardupilot", "acc.param"))
    np.testing.assert_allclose(of_ardupilot_accel(p, raw), expected, atol=1e-6)
    p = given(exported(folder, "acc", "px4", "acc.params"))
    np.testing.assert_allclose(of_px4_accel(p, raw), expected, atol=1e-6)


def test_imu_calib_gives_our_corrections_axes_included(folder, capsys):
    """applyCalib: SM·raw − bias."""
    expected, _ = ours(folder, "skew", "acc.csv", capsys)
    text = exported(folder, "skew", "ros", "imu_calib.yaml").read_text()
    numbers = {k: np.fromstring(v, sep=",") for k, v in re.findall(r"(\w+): \[(.*)\]", text)}
    raw = record(folder, "acc.csv", 9.80665)
    found = raw @ numbers["SM"].reshape(3, 3).T - numbers["bias"]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_compass_of_autopilots_gives_our_corrections_but_for_a_turn(folder, capsys):
    """Their matrix is symmetric, ours lower triangular: a norm tells them apart by nothing."""
    expected, _ = ours(folder, "mag", "mag.csv", capsys)
    expected = expected * 1.0  # gauss
    p = given(exported(folder, "mag", "ardupilot", "mag.param"))
    told = capsys.readouterr().err
    found = of_ardupilot_compass(p, record(folder, "mag.csv", 10.0), None) / 1e3
    turn, rest = np.linalg.lstsq(expected, found)[:2]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    assert np.max(rest) < 1e-10
    angle = np.degrees(np.arccos((np.trace(turn) - 1) / 2))
    assert f"turned by {angle:.2g} degrees" in told
    p = given(exported(folder, "mag", "px4", "mag.params"))
    again = of_px4_mag(p, record(folder, "mag.csv", 0.01), None)
    np.testing.assert_allclose(again, found, atol=1e-6)


def test_what_a_motor_adds_is_taken_away_with_its_current(folder, capsys):
    expected, _ = ours(folder, "motor", "motor.csv", capsys)
    data = record(folder, "motor.csv", 1.0)
    m, current = data[:, 3:6], data[:, 6]
    p = given(exported(folder, "motor", "ardupilot", "motor.param"))
    assert p["COMPASS_MOTCT"] == 2
    found = of_ardupilot_compass(p, 1e3 * m, current) / 1e3
    np.testing.assert_allclose(found, expected, atol=1e-6)
    p = given(exported(folder, "motor", "px4", "motor.params"))
    found = of_px4_mag(p, m, current / 1e3)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_gyroscopes_of_autopilots_have_an_offset_and_no_more(folder, capsys):
    expected, _ = ours(folder, "bias_only", "bias_only.csv", capsys)
    raw = record(folder, "bias_only.csv", 1.0)[:, 3:]
    p = given(exported(folder, "bias_only", "ardupilot", "gyro.param"))
    np.testing.assert_allclose(raw - vector(p, "INS_GYROFFS_{}"), expected, atol=1e-7)
    p = given(exported(folder, "bias_only", "px4", "gyro.params"))
    np.testing.assert_allclose(raw - vector(p, "CAL_GYRO0_{}OFF"), expected, atol=1e-7)
    for to in ("ardupilot", "px4"):
        assert casest(["export", str(folder / "gyro"), "--to", to]) == 1
        assert "offset of a gyroscope alone" in capsys.readouterr().err


def test_kalibr_predicts_the_readings_from_our_corrections(folder, capsys):
    """reading = M·C_gyro_i·rate + b, reading = M·force + b."""
    from ruamel.yaml import YAML

    rate, _ = ours(folder, "gyro", "gyro.csv", capsys)
    own = YAML(typ="safe").load(exported(folder, "gyro", "kalibr", "gyro.yaml").read_text())
    part = {k: np.array(v, float) for k, v in own["imu0"]["gyroscopes"].items()}
    C = part["C_gyro_i"]
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(C) > 0
    assert np.all(np.triu(part["M"], 1) == 0)
    raw = record(folder, "gyro.csv", 1.0)[:, 3:]
    np.testing.assert_allclose(rate @ (part["M"] @ C).T + part["bias"], raw, atol=1e-7)
    force, _ = ours(folder, "skew", "acc.csv", capsys)
    own = YAML(typ="safe").load(exported(folder, "skew", "kalibr", "acc.yaml").read_text())
    part = own["imu0"]["accelerometers"]
    found = force @ np.array(part["M"]).T + part["bias"]
    np.testing.assert_allclose(found, record(folder, "acc.csv", 9.80665), atol=1e-6)


@pytest.mark.parametrize(
    ("result", "to", "name", "data"),
    [
        ("acc", "ardupilot", "a.param", "acc.csv"),
        ("acc", "px4", "a.params", "acc.csv"),
        ("skew", "ros", "a.yaml", "acc.csv"),
        ("skew", "kalibr", "k.yaml", "acc.csv"),
    ],
)
def test_apply_takes_their_files_as_it_takes_a_result(folder, capsys, result, to, name, data):
    expected, _ = ours(folder, result, data, capsys)
    exported(folder, result, to, name)
    found, header = ours(folder, name, data, capsys)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert "[m/s^2]" in header


def test_apply_takes_the_parameters_of_a_whole_autopilot(folder, capsys):
    """Names and numbers in either form; the columns say which of the sensors is meant."""
    file = folder / "whole.param"
    text = [exported(folder, r, "ardupilot", f"{r}.param").read_text() for r in ("acc", "mag")]
    file.write_text("".join(text).replace(",", " ") + "ARMING_CHECK 1\n")
    words = ["--columns", "a=vx,vy,vz"]
    found, _ = ours(folder, "whole.param", "acc.csv", capsys, *words)
    np.testing.assert_allclose(found, ours(folder, "acc", "acc.csv", capsys)[0], atol=1e-6)
    assert casest(["apply", str(file), str(folder / "acc.csv")]) == 1
    assert "--columns a=" in capsys.readouterr().err


def refused(capsys, *words):
    assert casest([str(w) for w in words]) == 1
    return " ".join(capsys.readouterr().err.split())


def test_what_a_format_cannot_hold_is_refused_in_one_sentence(folder, capsys):
    export = ("export", folder / "skew", "--to")
    assert "axis by axis" in refused(capsys, *export, "ardupilot")
    assert "axis by axis" in refused(capsys, *export, "px4")
    assert "one accelerometer" in refused(capsys, "export", folder / "mag", "--to", "ros")
    assert "no magnetometer" in refused(capsys, "export", folder / "mag", "--to", "kalibr")
    words = ("export", folder / "acc", "--to", "px4", "--sensor", "gyroscope")
    assert "the result has accelerometer" in refused(capsys, *words)
    words = ("export", folder / "acc", "--to", "c", "--sensor", "gyroscope")
    assert "--sensor is for" in refused(capsys, *words)
    x = np.linspace(0, 10, 12)
    table(folder / "line.csv", ("reference", "reading"), "V", np.column_stack([x, 2 * x + x % 3]))
    assert casest(["calibrate", "linear", str(folder / "line.csv"), "-o", str(folder / "l")]) == 0
    capsys.readouterr()
    assert "is for sensors of three axes" in refused(capsys, "export", folder / "l", "--to", "px4")


def test_damaged_files_are_refused_by_their_key(folder, capsys):
    data = folder / "acc.csv"

    def said(name, text):
        (folder / name).write_text(text)
        return refused(capsys, "apply", folder / name, data)

    assert "no INS_ACCOFFS_Y" in said("b.param", "INS_ACCOFFS_X,1\n")
    assert "corrects no sensor" in said("c.param", "ARMING_CHECK,1\n")
    assert "corrects no sensor" in said("d.yaml", "a: 1\n")
    assert "SM is not 3x3 numbers" in said("e.yaml", "SM: [1, 2]\nbias: [0, 0, 0]\n")
    assert "is no YAML" in said("f.yaml", "SM: [1, 2\n")
    assert "is no correction" in said("g.yaml", f"SM: {[1] * 9}\nbias: [0, 0, 0]\n")
    kalibr = f"imu0: {{gyroscopes: {{M: {np.eye(3).tolist()}, A: {np.ones((3, 3)).tolist()}}}}}\n"
    assert "answers to acceleration" in said("h.yaml", kalibr)


def test_any_matrix_of_positive_determinant_is_lower_times_a_rotation():
    for _ in range(20):
        matrix = rng.normal(size=(3, 3))
        matrix *= np.sign(np.linalg.det(matrix))
        L, C = lower_times_rotation(matrix)
        np.testing.assert_allclose(L @ C, matrix, atol=1e-12)
        assert np.all(np.diag(L) > 0)
        assert np.linalg.det(C) == pytest.approx(1)
