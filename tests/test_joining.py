"""Two files, one run: each with its clock, its gaps and its columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from models.same_body import same_body
from scipy.spatial.transform import Rotation

from casest import DataError, UsageError, load_runs, signal
from casest.cli import run as command
from casest.declaration.symbols import attitude, named
from casest.effects import signal_lag
from casest.effects.lateness import likely_lag
from casest.effects.placing import told
from casest.estimate.calibrate import attempt
from casest.leastsquares.problem import Problem
from casest.solve.trust_region import trust_region

W, X = named(signal(3, "rad/s"), "w"), named(signal("V"), "x")
MODEL = str(Path(__file__).parent / "models" / "same_body.py")


def spin(time):
    """Bursts of turning about all axes, none alike, rad/s."""
    envelope = np.exp(-(((time - 12) / 3) ** 2)) + 0.6 * np.exp(-(((time - 25) / 2) ** 2))
    axes = [3 * np.sin(5.1 * time), 2 * np.cos(3.7 * time), 2.5 * np.sin(4.3 * time + 1)]
    return np.transpose(envelope * axes)


def written(path, head, *columns):
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=head, comments="", fmt="%.14g")
    return path


def two(tmp_path, lag=0.8, noise=0.002, begin=0.0):
    """a.csv, and b.csv whose instrument stands askew; what b says at t, a says at t + lag."""
    rng = np.random.default_rng(0)
    ta = np.cumsum(rng.uniform(0.027, 0.033, 1200))
    tb = np.arange(0.5, 34, 0.024)
    turn = Rotation.from_euler("ZYX", [2.0, 0.5, -1.0]).as_matrix()
    a = spin(ta - lag) @ turn.T + [0.01, -0.02, 0.03] + noise * rng.standard_normal((1200, 3))
    written(tmp_path / "a.csv", "t,wx [rad/s],wy [rad/s],wz [rad/s]", ta, a)
    b = spin(tb) + noise * rng.standard_normal((len(tb), 3))
    written(tmp_path / "b.csv", "t,ox [rad/s],oy [rad/s],oz [rad/s]", tb + begin, b)
    return f"{tmp_path / 'a.csv'}+{tmp_path / 'b.csv'}", turn


def read(path, *signals, **more):
    (found,) = load_runs([path], {s.name: s for s in signals}, **more)
    return found


@pytest.mark.long
@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_the_lag_between_two_files_is_found_with_the_turn_between_their_axes(tmp_path, begin):
    """Also where one clock counts from 1970: then each file's start is taken as one moment."""
    pair, turn = two(tmp_path, begin=begin)
    runs = load_runs([pair], same_body.signals, columns={"other": "o"})
    extended = told(same_body.with_effect(signal_lag, on="other"), runs)
    found = attempt(extended, runs)
    shift = 0.0
    if begin:  # b's first sample is a's, which it was not: 0.5 s of the lag are that
        shift = 0.5 - float(np.genfromtxt(tmp_path / "a.csv", delimiter=",", skip_header=1)[0, 0])
        assert any("the clocks have no time in common" in note for note in runs[0].notes)
    assert found.certificate.trusted
    delay, std = (part["signal_lag(other).delay"] for part in (found.values, found.std))
    assert abs(delay - 0.8 - shift) < 4 * std
    assert std < 5e-4
    np.testing.assert_allclose(found.values["turn"], turn, atol=2e-3)


def test_lag_and_turn_between_two_files_are_where_one_descent_ends(tmp_path):
    """Without the certificate's search."""
    pair, turn = two(tmp_path)
    runs = load_runs([pair], same_body.signals, columns={"other": "o"})
    problem = Problem(told(same_body.with_effect(signal_lag, on="other"), runs), tuple(runs))
    values = problem.values(trust_region(problem, problem.start()).point)
    # Four standard deviations are 2.5e-4.
    assert values["signal_lag(other).delay"] == pytest.approx(0.8, abs=2.5e-4)
    np.testing.assert_allclose(values["turn"], turn, atol=2e-3)


def test_a_lag_between_files_begins_where_both_move_together(tmp_path):
    pair, _ = two(tmp_path)
    runs = load_runs([pair], same_body.signals, columns={"other": "o"})
    assert likely_lag(runs, "w", "other") == pytest.approx(0.8, abs=0.02)


def test_columns_of_the_second_file_are_told_at_the_times_of_the_first(tmp_path):
    ta, tb = np.arange(0, 10, 0.1), np.arange(2.03, 8, 0.07)
    course = lambda t: np.sin(1.3 * t)  # noqa: E731
    written(tmp_path / "a.csv", "t,wx [rad/s],wy [rad/s],wz [rad/s],note", ta, spin(ta), ta)
    written(tmp_path / "b.csv", "t,x [V],note", tb, course(tb), 3 * tb)
    run = read(f"{tmp_path / 'a.csv'}+{tmp_path / 'b.csv'}", W, X, time_zero="column")
    kept = (ta >= tb[0]) & (ta <= tb[-1])
    np.testing.assert_allclose(run.time, ta[kept], atol=1e-9)
    assert list(run.rows) == list(np.flatnonzero(kept))
    np.testing.assert_allclose(run.signals["x"][:, 0], course(ta[kept]), atol=1e-5)
    np.testing.assert_allclose(run.columns["b.note"], 3 * ta[kept], atol=1e-6)
    np.testing.assert_allclose(run.columns["note"], ta[kept], atol=1e-6)
    assert set(run.elsewhere) == {"x", "b.note"}
    assert run.elsewhere["x"].file == str(tmp_path / "b.csv")
    assert run.units["x"] == "V"
    lost = np.count_nonzero(~kept)
    assert f"{lost} of 100 samples dropped: not all files recorded then" in run.notes
    assert run.file == f"{tmp_path / 'a.csv'}+{tmp_path / 'b.csv'}"


def test_a_rotation_of_the_second_file_goes_the_short_way_round(tmp_path):
    ta, tb = np.arange(0.5, 5, 0.1), np.arange(0, 6, 0.25)
    yaw = np.rad2deg(np.angle(np.exp(1j * 1.5 * tb)))  # from 180 to −180 on the way
    written(tmp_path / "a.csv", "t,x [V]", ta, np.sin(ta))
    head = "t,roll [deg],pitch [deg],yaw [deg]"
    written(tmp_path / "b.csv", head, tb, 0 * tb, 0 * tb, yaw)
    turned = named(attitude(), "attitude")
    run = read(f"{tmp_path / 'a.csv'}+{tmp_path / 'b.csv'}", X, turned, time_zero="column")
    true = Rotation.from_euler("Z", 1.5 * ta[:, None]).as_matrix().reshape(-1, 9)
    np.testing.assert_allclose(run.signals["attitude"], true, atol=1e-3)


def test_a_gap_in_the_second_file_is_not_bridged(tmp_path):
    ta = np.arange(0, 10, 0.1)
    tb = np.r_[np.arange(0, 4, 0.05), np.arange(6, 10.2, 0.05)]
    written(tmp_path / "a.csv", "t,wx [rad/s],wy [rad/s],wz [rad/s]", ta, spin(ta) + ta[:, None])
    written(tmp_path / "b.csv", "t,x [V]", tb, np.sin(tb))
    run = read(f"{tmp_path / 'a.csv'}+{tmp_path / 'b.csv'}", W, X)
    kept = (ta <= 3.95) | (ta > 5.99)
    np.testing.assert_allclose(run.time, ta[kept], atol=1e-9)
    assert np.flatnonzero(np.diff(run.block)).tolist() == [39]
    np.testing.assert_allclose(run.signals["x"][:, 0], np.sin(ta[kept]), atol=1e-5)


def test_what_both_files_have_is_asked_for_by_the_file(tmp_path):
    for name in ("a", "b"):
        written(tmp_path / f"{name}.csv", "t,wx [rad/s],wy [rad/s],wz [rad/s]", np.arange(9), *(
            np.random.default_rng(k).standard_normal(9) for k in range(3)
        ))  # fmt: skip
    pair = f"{tmp_path / 'a.csv'}+{tmp_path / 'b.csv'}"
    other = named(signal(3, "rad/s"), "other")
    with pytest.raises(DataError) as refused:
        read(pair, W)
    assert "both have signal w: say --columns w=a.wx,a.wy,a.wz or --columns w=b.wx" in str(
        refused.value
    )
    run = read(pair, W, other, columns={"w": "a.w", "other": ("b.wx", "b.2", "b.3")})
    np.testing.assert_allclose(run.signals["w"], run.signals["other"], atol=1e-9)
    assert set(run.elsewhere) == {"other"}
    with pytest.raises(DataError, match=r"w=a\.wx,b\.wy,b\.wz names columns of two files"):
        read(pair, W, columns={"w": "a.wx,b.wy,b.wz"})


def test_files_without_a_time_in_common_or_any_are_refused(tmp_path):
    nine = np.arange(9.0)
    a = written(tmp_path / "a.csv", "t,x [V]", nine, np.sin(nine))
    b = written(tmp_path / "b.csv", "n,wx [rad/s],wy [rad/s],wz [rad/s]", nine[::-1], *[nine] * 3)
    with pytest.raises(DataError, match=r"b\.csv: no time column: .* --columns t=b\.NAME"):
        read(f"{a}+{b}", X, W)
    late = np.r_[nine[:2] - 8, nine[:2] + 20]
    c = written(tmp_path / "c.csv", "t,wx [rad/s],wy [rad/s],wz [rad/s]", late, *[late] * 3)
    with pytest.raises(DataError, match="no time that all files recorded"):
        read(f"{a}+{c}", X, W)
    d = written(tmp_path / "d.csv", "t,run,q", nine, nine > 4, nine)
    with pytest.raises(DataError, match="holds 2 runs, and files joined by"):
        read(f"{a}+{d}", X)
    with pytest.raises(DataError, match=r"a\.csv: no columns .*c\.csv: no columns|no column"):
        read(f"{a}+{c}", named(signal("K"), "warmth"))


def test_two_files_whose_times_have_other_names(tmp_path):
    """As MATLAB's matrices: nothing in either is called a time."""
    files, _ = two(tmp_path)
    plain = load_runs([files], (W,), columns={"w": ("wx", "wy", "wz")})
    for name in ("a", "b"):
        text = (tmp_path / f"{name}.csv").read_text()
        (tmp_path / f"{name}.csv").write_text(f"stamp{text[1:]}")
    for time in (("stamp", "b.stamp"), ("0", "b.stamp")):
        runs = load_runs([files], (W,), columns={"w": ("wx", "wy", "wz"), "t": time})
        np.testing.assert_array_equal(runs[0].time, plain[0].time)
        assert {"ox", "oy", "oz"} <= {*runs[0].elsewhere}
        for name, series in runs[0].elsewhere.items():
            np.testing.assert_array_equal(series.time, plain[0].elsewhere[name].time)
    with pytest.raises(DataError, match=r"t=b\.NAME, or both as t=NAME,b\.NAME; it has stamp, ox"):
        load_runs([files], (W,), columns={"w": ("wx", "wy", "wz"), "t": ("0",)})


def test_one_rate_for_two_clocks_is_refused(tmp_path):
    pair, _ = two(tmp_path)
    with pytest.raises(UsageError, match="--rate 50: files joined by"):
        read(pair, W, rate=50)


def test_a_signal_of_the_second_file_keeps_its_name_beside_a_column_of_the_first(tmp_path):
    nine = np.arange(9.0)
    a = written(tmp_path / "a.csv", "t,v [V],x", nine, np.cos(nine), 7 * nine)
    b = written(tmp_path / "b.csv", "t,y [V]", nine, np.sin(nine))
    run = read(f"{a}+{b}", named(signal("V"), "v"), X, columns={"x": "b.y"})
    np.testing.assert_allclose(run.signals["x"][:, 0], np.sin(nine), atol=1e-9)
    np.testing.assert_allclose(run.columns["x"], 7 * nine)


def test_a_file_with_a_plus_in_its_name_is_one(tmp_path):
    a = written(tmp_path / "a+b.csv", "t,x [V]", np.arange(9.0), np.sin(np.arange(9.0)))
    assert read(str(a), X).name == "a+b"


@pytest.mark.long
def test_two_instruments_on_one_body_are_brought_together_on_the_command_line(tmp_path, capsys):
    pair, _ = two(tmp_path)
    asked = ["--columns", "other=o", "--effects", "signal_lag(other)", "-o", str(tmp_path / "out")]
    assert command(["calibrate", MODEL, pair, *asked]) == 0
    said = capsys.readouterr().out
    assert "same-body on a.csv+b.csv" in said
    assert "signal_lag(other).delay" in said


# -- measured --------------------------------------------------------------------------------------


def measured(shared_data, first, second, **columns):
    pair = f"{shared_data / first}+{shared_data / second}"
    units = {"w": columns.pop("unit", "rad/s"), "other": "rad/s"}
    runs = load_runs([pair], same_body.signals, columns=columns, units=units)
    found = attempt(told(same_body.with_effect(signal_lag, on="other"), runs), runs)
    assert found.certificate.trusted
    return found, found.values["signal_lag(other).delay"]


@pytest.mark.long
def test_two_gyroscopes_of_twistnsync_differ_by_the_published_lag(shared_data):
    """Published 0.32668 s; SOURCE.md: 0.3267 ± 0.0003."""
    _, delay = measured(
        shared_data, "twistnsync/twist_mcu.csv", "twistnsync/twist_phone.csv",
        w="twist_mcu.gyro", other="twist_phone.gyro",
    )  # fmt: skip
    assert delay == pytest.approx(0.3267, abs=3e-4)


@pytest.mark.long
def test_a_swing_seen_by_two_instruments_differs_by_its_lag(shared_data):
    """SOURCE.md: 3.58 ± 0.02 s (gyro 3.590), and a residual of 0.852 rad/s without it."""
    found, delay = measured(
        shared_data, "swing-project/lag_bno055.csv", "swing-project/lag_iphone.csv",
        w="lag_bno055.gyro", other="lag_iphone.gyro", t="lag_iphone.t_gyro_s", unit="deg/s",
    )  # fmt: skip
    assert delay == pytest.approx(3.59, abs=0.02)
    rms = np.sqrt(np.mean(found.problem.residuals(found.point)[0] ** 2))
    assert rms < 0.12
