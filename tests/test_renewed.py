"""Logs faster than a sensor in them: what is written again is no reading."""

from __future__ import annotations

import json

import numpy as np
import pytest

from casest import cli, close, load_runs
from casest.effects.lateness import likely_lag
from casest.results.find import find_model

SIGNALS = find_model("linear").signals


def written(path, columns):
    names = list(columns)
    rows = np.stack([columns[n] for n in names], axis=1)
    np.savetxt(path, rows, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    return path


def gyro_beside_encoder(rows=3000, every=3, late=0.02, seed=0):
    """A gyro that is read every few rows of a 100 Hz log, and an encoder that comes late."""
    rng, t = np.random.default_rng(seed), 0.01 * np.arange(rows)

    def rate(s):
        return 2 * np.sin(1.6 * s) + 0.5 * np.sin(9.0 * s + 1)

    gyro = (rate(t) + 0.02 * rng.standard_normal(rows))[np.arange(rows) // every * every]
    encoder = rate(t - late) + 0.02 * rng.standard_normal(rows)
    return {"t": t, "reference": np.round(gyro, 2), "reading": np.round(encoder, 4)}


@pytest.mark.parametrize("every", [2, 3, 5])
def test_rows_that_repeat_a_slower_sensor_are_left_out_and_said(tmp_path, every):
    file = written(tmp_path / "log.csv", gyro_beside_encoder(every=every))
    (run,) = load_runs([file], SIGNALS)
    assert np.all(np.isin(np.diff(run.rows), every * np.arange(1, 30)))
    (said,) = (n for n in run.notes if "written again" in n)
    assert f"repeat reference, which is new every {every} rows" in said


@pytest.mark.long
def test_a_lag_beside_a_slower_sensor_is_found_without_its_image(tmp_path):
    """The steps of the repeats are a line at 100/3 Hz, and noise of the input: the lag was refused
    and a vibration added."""
    file = written(tmp_path / "log.csv", gyro_beside_encoder())
    closing = close("linear", file)
    assert {e.candidate.label for e in closing.effects} <= {"signal_lag(reference)", "low_pass"}
    delays = [float(v) for n, v in closing.after.values.items() if n.endswith(("delay", "tau"))]
    assert sum(delays) == pytest.approx(0.02, abs=0.002)


def test_of_what_stays_the_same_for_long_readings_remain(tmp_path):
    """Sunshine by the hour, in a log of quarters: at night it is zero, and is read all the same."""
    rng, hours = np.random.default_rng(4), np.arange(500)
    sun = np.maximum(np.sin(2 * np.pi * hours / 24), 0) * rng.uniform(0.2, 1, 500)
    columns = {
        "t": 900.0 * np.arange(2000),
        "reference": np.repeat(sun, 4),
        "reading": rng.standard_normal(2000),
    }
    (run,) = load_runs([written(tmp_path / "house.csv", columns)], SIGNALS)
    assert 495 <= len(run) <= 500


def slow_and_rounded(rng):
    """A temperature that stays for any number of rows."""
    return np.round(20 + np.cumsum(0.03 * rng.standard_normal(3000)), 1)


def set_points(rng):
    """Fifty of them, as long as one another."""
    return np.repeat(np.arange(50.0), 60)


def noise(rng):
    return rng.standard_normal(3000)


@pytest.mark.parametrize("drawn", [slow_and_rounded, set_points, noise])
def test_what_is_rounded_or_set_is_left_alone(tmp_path, drawn):
    rng = np.random.default_rng(1)
    columns = {
        "t": 0.01 * np.arange(3000),
        "reference": drawn(rng),
        "reading": rng.standard_normal(3000),
    }
    (run,) = load_runs([written(tmp_path / "log.csv", columns)], SIGNALS)
    assert len(run) == 3000


def two_loops(rng, rounded=False):
    """A logger at 93 Hz of a force plate that is new at 50 Hz: each row once, twice or three times;
    `rounded`: of slow thermometers, by their last decimal, at 0.1 K."""
    t = np.cumsum(rng.uniform(0.009, 0.0125, 3000))
    at = np.floor(50 * t).astype(int)
    course = np.sin(0.06 * np.arange(at[-1] + 1))
    plate = {n: course + 0.1 * rng.standard_normal(course.size) for n in ("reference", "reading")}
    columns = {n: v[at] for n, v in plate.items()}
    more = {f"f{k}": rng.standard_normal(course.size)[at] for k in range(4)}
    if rounded:
        slow = {n: np.cumsum(rng.standard_normal(3000)) / 30 for n in (*columns, *more)}
        columns, more = {}, {n: np.round(v, 1) for n, v in slow.items()}
    return {"t": t, **columns, **more}, np.concatenate([[True], np.diff(at) > 0])


def test_rows_that_repeat_all_of_the_row_before_are_written_again(tmp_path):
    columns, new = two_loops(np.random.default_rng(6))
    (run,) = load_runs([written(tmp_path / "log.csv", columns)], SIGNALS)
    np.testing.assert_array_equal(run.rows, np.flatnonzero(new))
    (said,) = (n for n in run.notes if "written again" in n)
    assert f"{np.sum(~new)} repeat all that is recorded of the row before" in said


def test_a_row_of_which_one_number_is_new_was_read(tmp_path):
    """A plate that is slower than the log, and beside it a reading of another pace; a row's number
    is no reading."""
    rng = np.random.default_rng(6)
    columns, new = two_loops(rng)
    counted = {**columns, "row": np.arange(3000.0)}
    (run,) = load_runs([written(tmp_path / "counted.csv", counted)], SIGNALS)
    np.testing.assert_array_equal(run.rows, np.flatnonzero(new))
    for name in ("reading", "beside"):
        other = {**columns, name: rng.standard_normal(3000)}
        (run,) = load_runs([written(tmp_path / f"{name}.csv", other)], SIGNALS)
        assert len(run) == 3000


def test_columns_that_stay_each_at_times_of_its_own_are_read(tmp_path):
    columns, _ = two_loops(np.random.default_rng(7), rounded=True)
    (run,) = load_runs([written(tmp_path / "log.csv", columns)], SIGNALS)
    assert len(run) == 3000


def test_rows_in_threes_of_a_table_are_repeats(tmp_path):
    columns = gyro_beside_encoder(600)
    del columns["t"]
    (run,) = load_runs([written(tmp_path / "table.csv", columns)], SIGNALS)
    assert len(run) == 600


WHEEL = """
from casest import param, signal
from casest.dynamics import Motion, dynamics, measured, state


@dynamics
def wheel(speed=signal("rad/s"), *, omega=state("rad/s", start=25),
          acceleration=param("rad/s^2", start=60)):
    return Motion(rates={"omega": acceleration}, outputs=(measured(speed, omega),))
"""


@pytest.mark.long
def test_an_output_that_repeats_is_missing_and_its_damping_is_found(tmp_path, capsys):
    """Solved by hand: a/k + (ω₀ − a/k)·exp(−kt). Zeros in the place of what was not read made the
    noise none, and the damping was refused."""
    rng, t = np.random.default_rng(2), 0.01 * np.arange(450)
    speed = 680 + (16 - 680) * np.exp(-0.1 * t) + 2 * rng.standard_normal(450)
    speed = speed[np.arange(450) // 3 * 3]
    file = written(tmp_path / "spin.csv", {"t": t, "speed": np.round(speed, 3)})
    (tmp_path / "wheel.py").write_text(WHEEL)
    command = ["close", str(tmp_path / "wheel.py"), str(file), "-o", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        cli.main(command)
    assert not ended.value.code
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert [e["name"] for e in result["effects"]] == ["linear_damping"]
    k = result["effects"][0]["parameters"]["k"]
    assert k["value"] == pytest.approx(0.1, abs=4 * k["std"])


@pytest.mark.parametrize("late", [-0.0012, 0.0021])
def test_of_a_wave_that_comes_again_and_again_the_nearest_lag_counts(tmp_path, late):
    """100 Hz: a period later all is as alike but for chance, and one of four was taken."""
    rng, t = np.random.default_rng(3), 0.0008 * np.arange(8000)
    columns = {
        "t": t,
        "reference": np.sin(2 * np.pi * 100 * t) + 0.02 * rng.standard_normal(8000),
        "reading": np.sin(2 * np.pi * 100 * (t - late)) + 0.02 * rng.standard_normal(8000),
    }
    runs = load_runs([written(tmp_path / "wave.csv", columns)], SIGNALS)
    found = likely_lag(runs, "reading", "reference", within=True)
    assert abs(found - late) < 0.0008 or abs(found - late - np.copysign(0.005, -late)) < 0.0008


def test_a_row_that_the_end_of_a_log_writes_again_keeps_its_time_in_order(tmp_path):
    """Stamps and all, as a logger that waits does: the other rows have times as they are."""
    rng = np.random.default_rng(4)
    new = np.repeat(np.arange(300), rng.integers(1, 4, 300))  # of a source at half the pace
    t, u, v = 0.01 * np.arange(new.size), rng.uniform(-1, 1, 300)[new], rng.uniform(-1, 1, 300)[new]
    more = {f"f{k}": rng.standard_normal(300)[new] for k in range(4)}
    columns = {"t": t, "reference": u, "reading": v, **more}
    columns = {n: np.concatenate([c, np.repeat(c[-1:], 12)]) for n, c in columns.items()}
    (run,) = load_runs([written(tmp_path / "log.csv", columns)], SIGNALS)
    np.testing.assert_allclose(run.time, t[np.concatenate([[True], np.diff(new) > 0])])
    at = np.flatnonzero(np.diff(new) > 0)[80] + 1  # a reading with the stamp of the row before
    columns["t"][at] = columns["t"][at - 1]
    (run,) = load_runs([written(tmp_path / "twice.csv", columns)], SIGNALS)
    assert run.time is None
