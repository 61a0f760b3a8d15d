"""Records in motion that are not as they should be, through the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from casest.cli import run

STEP = 0.02
HEAD = ["t [s]", *(f"a{c} [m/s^2]" for c in "xyz"), *(f"omega_{c}" for c in "xyz"),
        *(f"v{c} [m/s]" for c in "xyz")]  # fmt: skip


def record(path, count=500, unit="rad/s", times=None, hole=None, factor=1.0, unread=()):
    """A turning body, written as a user's file; hole: rows without an angular rate, `unread`:
    (row, axis) without a velocity."""
    t = np.arange(count) * STEP if times is None else times
    omega = factor * np.c_[0.5 * np.sin(0.6 * t), 0.4 * np.cos(0.42 * t), 0.3 * np.sin(0.2 * t + 1)]
    rng = np.random.default_rng(1)
    a = np.array([0, 0, -9.8]) + 0.01 * rng.standard_normal((len(t), 3))
    v = 0.01 * rng.standard_normal((len(t), 3))
    head = [h + f" [{unit}]" if h.startswith("omega") and unit else h for h in HEAD]
    lines = [",".join(head)]
    for k in range(len(t)):
        rates = ["" if hole and k in hole else f"{w:.12g}" for w in omega[k]]
        speeds = ["" if (k, i) in unread else str(v[k, i]) for i in range(3)]
        lines.append(",".join([f"{t[k]:.6f}", *map(str, a[k]), *rates, *speeds]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return str(path)


@pytest.fixture
def refused(tmp_path, capsys):
    def call(command, file, *more):
        out = tmp_path / "out"
        assert run([command, "bias-gravity", file, *more, "-o", str(out)]) == 1
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith("casest: ")
        assert printed.err.count("\n") == 1, printed.err
        assert not out.exists() or not list(out.iterdir())
        return printed.err

    return call


@pytest.fixture
def told(capsys):
    def call(command, file, *more):
        assert run([command, "bias-gravity", file, *more, "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    return call


@pytest.mark.parametrize(("to", "what"), [(49, "repeats"), (40, "goes backward")])
def test_time_that_does_not_go_on(refused, tmp_path, to, what):
    times = np.arange(500) * STEP
    times[50] = times[to]
    said = refused("filter", record(tmp_path / "r.csv", times=times))
    assert "row 50" in said
    assert what in said


def test_a_gap_is_said_with_its_length_and_place(told, tmp_path):
    times = np.arange(500) * STEP
    times[250:] += 3
    for command in ("filter", "observe"):
        notes = " ".join(told(command, record(tmp_path / "r.csv", times=times))["notes"])
        assert "1 gap in time, the longest of 3.02 s after row 249" in notes


def test_rates_in_degrees_are_converted(told, tmp_path):
    radians = told("filter", record(tmp_path / "r.csv"))
    degrees = told("filter", record(tmp_path / "d.csv", unit="deg/s", factor=180 / np.pi))
    for name, found in radians["states"].items():
        np.testing.assert_allclose(degrees["states"][name]["value"], found["value"], atol=1e-9)


def test_rates_without_a_unit_are_said(told, tmp_path):
    notes = " ".join(told("filter", record(tmp_path / "r.csv", unit=None))["notes"])
    assert "omega" in notes
    assert "rad/s" in notes


def test_a_rate_that_is_missing_for_a_while_is_a_gap(told, tmp_path):
    content = told("filter", record(tmp_path / "r.csv", hole=range(100, 150)))
    notes = " ".join(content["notes"])
    assert "omega: 50 of 500 readings are missing" in notes
    assert "1 gap in omega, the longest of 1.02 s after row 99" in notes


def test_empty_velocity_cells_are_readings_that_are_missing(told, tmp_path):
    """A whole stretch without, and one axis alone: what is there is used, and it is said."""
    unread = {(k, i) for k in range(100, 150) for i in range(3)} | {(200, 1)}
    for command in ("filter", "observe"):
        content = told(command, record(tmp_path / "r.csv", unread=unread))
        notes = " ".join(content["notes"])
        assert "v: 51 of 500 readings are missing, whole or in part, the first in row 100" in notes
    content = told("filter", record(tmp_path / "r.csv", unread=unread))
    assert content["innovations"]["missing_readings"] == 51
    assert all(np.isfinite(s["value"]).all() for s in content["states"].values())


def test_a_velocity_that_is_never_read(refused, tmp_path):
    unread = {(k, i) for k in range(500) for i in range(3)}
    said = refused("filter", record(tmp_path / "r.csv", unread=unread))
    assert "signal v has no reading in 500 rows" in said


def test_a_velocity_cell_that_holds_something_else(refused, tmp_path):
    file = record(tmp_path / "r.csv")
    text = (tmp_path / "r.csv").read_text("utf-8").splitlines()
    text[31] = text[31].rpartition(",")[0] + ",overflow"
    (tmp_path / "r.csv").write_text("\n".join(text) + "\n", encoding="utf-8")
    assert "column vz row 30 holds 'overflow'" in refused("filter", file)


@pytest.mark.parametrize("std", ["-1", "0", "nan", "inf"])
def test_what_is_no_standard_deviation(refused, tmp_path, std):
    said = refused("filter", record(tmp_path / "r.csv"), "--std", f"bias={std}")
    assert "bias: the std" in said
    assert "not positive definite" in said


@pytest.mark.parametrize("intensity", ["-1e-3", "nan"])
def test_what_is_no_intensity(refused, tmp_path, intensity):
    said = refused("filter", record(tmp_path / "r.csv"), "--intensity", f"bias={intensity}")
    assert "bias: the intensity" in said
    assert "not negative" in said


def test_a_measurement_without_noise(capsys, tmp_path):
    model = tmp_path / "sure.py"
    model.write_text(
        "from casest import signal\n"
        "from casest.dynamics import Motion, dynamics, measured, state\n\n\n"
        "@dynamics\n"
        "def sure(y=signal('m'), *, x=state('m')):\n"
        "    return Motion(rates={}, outputs=(measured(y, x, intensity=0.0),))\n",
        encoding="utf-8",
    )
    (tmp_path / "r.csv").write_text("t [s],y [m]\n0,1\n1,2\n2,1\n", encoding="utf-8")
    assert run(["filter", str(model), str(tmp_path / "r.csv")]) == 1
    said = capsys.readouterr().err
    assert "noise intensity must be positive, not 0" in said
    assert said.count("\n") == 1


def test_a_trajectory_that_is_too_short(told, tmp_path):
    content = told("observe", record(tmp_path / "r.csv", count=3))
    assert content["rank"] < 9
    assert "too short for the question: 3 samples over 0.04 s" in " ".join(content["notes"])


@pytest.mark.parametrize("window", ["-1", "0", "0.001", "nan"])
def test_a_window_that_holds_nothing(refused, tmp_path, window):
    said = refused("observe", record(tmp_path / "r.csv"), "--window", window)
    assert f"--window {float(window):g} s: a window must hold two steps of 0.02 s" in said
