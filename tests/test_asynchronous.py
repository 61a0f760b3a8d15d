"""Logs with clocks of their own in the filter: each reading when it was made, beside a textbook."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from casest import DataError, load_runs, signal
from casest.cli import run as command
from casest.dynamics import Estimator, Motion, dynamics, filtered, measured, state
from casest.dynamics.course import followed
from casest.dynamics.intensities import from_stated, most_likely

Q_BIAS, SIGMA = 1e-5, 0.3


@dynamics
def sledge(
    a=signal("m/s^2"),
    x=signal("m"),
    *,
    position=state("m", std=10.0),
    velocity=state("m/s", std=2.0, intensity=1e-3),
    bias=state("m/s^2", std=0.5, intensity=Q_BIAS),
):
    """On rails: an accelerometer with a bias, a position now and then."""
    rates = {"position": velocity, "velocity": a - bias}
    return Motion(rates=rates, outputs=(measured(x, position, std=SIGMA),))


@dynamics
def driven(
    force=signal("m/s^2", held=True),
    x=signal("m"),
    *,
    position=state("m", std=10.0),
    velocity=state("m/s", std=2.0, intensity=1e-3),
    drag=state("1/s", start=0.2, std=1e-9),
):
    """Pushed by a command that holds until the next; nonlinear by its drag, which is known."""
    rates = {"position": velocity, "velocity": force - drag * velocity}
    return Motion(rates=rates, outputs=(measured(x, position, std=SIGMA),))


def logs(rng, even=False):
    """Times and values of both: an accelerometer at 100 Hz or so, positions at 5 Hz or so."""
    ta = np.arange(0, 12, 0.01) if even else np.cumsum(rng.uniform(0.008, 0.012, 1200))
    tx = np.cumsum(rng.uniform(0.1, 0.3, 58))
    tx = tx[(tx > ta[0]) & (tx < ta[-1])]
    a = 0.8 * np.sin(0.7 * ta) + 0.1 + 0.02 * rng.standard_normal(len(ta))
    x = -0.8 / 0.49 * np.sin(0.7 * tx) + 0.8 / 0.7 * tx + SIGMA * rng.standard_normal(len(tx))
    return ta, a, tx, x


def written(path, head, *columns):
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=head, comments="", fmt="%.17g")
    return path


def pair(folder, ta, a, tx, x, name="a"):
    imu = written(folder / "imu.csv", f"t [s],{name} [m/s^2]", ta, a)
    return f"{imu}+{written(folder / 'gps.csv', 't [s],x [m]', tx, x)}"


def read(path, model):
    (run,) = load_runs(
        [path], model.signals, gaps=["x"], between=model.input_signals, time_zero="column"
    )
    return run


def integrators(h, q_velocity, q_bias):
    """Transition and noise of (position, velocity, bias) over h, by hand."""
    F = np.array([[1, h, -(h**2) / 2], [0, 1, -h], [0, 0, 1]])
    Q = q_velocity * np.array([[h**3 / 3, h**2 / 2, 0], [h**2 / 2, h, 0], [0, 0, 0]])
    Q += q_bias * np.array([
        [h**5 / 20, h**4 / 8, -(h**3) / 6],
        [h**4 / 8, h**3 / 3, -(h**2) / 2],
        [-(h**3) / 6, -(h**2) / 2, h],
    ])  # fmt: skip
    return F, Q


def textbook(ta, a, tx, x, q_velocity):
    """Kalman filter from event to event (Gelb 1974), Joseph's form; smoother by Rauch, Tung and
    Striebel. Between two samples of the accelerometer its reading is a straight line."""
    events = np.unique(np.concatenate([ta, tx]))
    C = np.array([[1.0, 0, 0]])
    m, P = np.zeros(3), np.diag([100.0, 4.0, 0.25])
    after, before, moved = [], [], []
    for k, t in enumerate(events):
        if k:
            h = t - events[k - 1]
            a0, a1 = np.interp([events[k - 1], t], ta, a)
            F, Q = integrators(h, q_velocity, Q_BIAS)
            m = F @ m + [h**2 * (2 * a0 + a1) / 6, h * (a0 + a1) / 2, 0]
            P = F @ P @ F.T + Q
            moved.append(F)
        before.append((m, P))
        for value in x[tx == t]:
            K = P @ C.T / (C @ P @ C.T + SIGMA**2)
            m = m + K[:, 0] * (value - m[0])
            P = (np.eye(3) - K @ C) @ P @ (np.eye(3) - K @ C).T + SIGMA**2 * K @ K.T
        after.append((m, P))
    smooth = [after[-1]]
    for (m, P), (m1, P1), F in zip(after[-2::-1], before[:0:-1], moved[::-1], strict=True):
        G = P @ F.T @ np.linalg.inv(P1)
        later, spread = smooth[-1]
        smooth.append((m + G @ (later - m1), P + G @ (spread - P1) @ G.T))
    return events, after, smooth[::-1]


def same(found, expected):
    x, P = (np.array(part) for part in zip(*expected, strict=True))
    np.testing.assert_allclose(found[0], x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found[1], P, rtol=1e-8, atol=1e-9)


def test_it_is_the_textbook_filter_from_event_to_event(tmp_path):
    ta, a, tx, x = logs(np.random.default_rng(0))
    run = read(pair(tmp_path, ta, a, tx, x), sledge)
    events, after, smooth = textbook(ta, a, tx, x, 1e-3)
    np.testing.assert_allclose(run.time, events, atol=1e-12)
    assert np.count_nonzero(np.isfinite(run.signals["x"])) == len(tx)
    found = filtered(sledge, run)
    same((found.x, found.P), after)
    same((found.smoothed, found.smoothed_P), smooth)
    np.testing.assert_allclose(followed(sledge, run).smoothed, found.smoothed, atol=1e-9)


def test_noise_of_an_input_is_that_of_its_own_clock(tmp_path):
    """σ² of a sample times the 0.01 s between two of it, and not the record's mean step."""
    ta, a, tx, x = logs(np.random.default_rng(1), even=True)
    run = read(pair(tmp_path, ta, a, tx, x), sledge)
    tuned = from_stated(sledge, run, {"a": 0.02, "x": SIGMA}).model
    _, after, _ = textbook(ta, a, tx, x, 0.02**2 * 0.01)
    found = filtered(tuned, run, smooth=False)
    same((found.x, found.P), after)


def test_an_intensity_is_that_of_the_sensor_s_own_clock(tmp_path):
    """A variance times the time between two readings says the same as the standard deviation."""
    ta, a, _, _ = logs(np.random.default_rng(1), even=True)
    tx = np.arange(1, 50) * 0.2 + 0.003
    x = np.random.default_rng(2).standard_normal(len(tx))
    run = read(pair(tmp_path, ta, a, tx, x), sledge)
    said = sledge.sensing(x=SIGMA**2 * 0.2)
    np.testing.assert_allclose(filtered(said, run).P, filtered(sledge, run).P, rtol=1e-9)


def test_a_command_holds_until_the_next_one(tmp_path):
    """Exponentials by hand between events, the command constant in each; the filter of a nonlinear
    model follows them by Runge-Kutta."""
    rng = np.random.default_rng(3)
    tf, tx = np.arange(0, 12, 0.31), np.sort(rng.uniform(0.2, 11.4, 60))
    force = rng.choice([-1.0, 0.0, 2.0], len(tf))
    m, events = np.zeros(2), np.unique(np.concatenate([tf, tx]))
    truth = [m]
    for t0, t1 in pairwise(events):
        u = force[np.searchsorted(tf, t0, side="right") - 1]
        decay = np.exp(-0.2 * (t1 - t0))
        gone = (m[1] - u / 0.2) * (1 - decay) / 0.2 + u / 0.2 * (t1 - t0)
        m = np.array([m[0] + gone, u / 0.2 + (m[1] - u / 0.2) * decay])
        truth.append(m)
    x = np.array(truth)[np.isin(events, tx), 0]
    run = read(pair(tmp_path, tf, force, tx, x, "force"), driven)
    known = driven.known_to(position=1e-6, velocity=1e-6)
    found = filtered(known, run).smoothed[:, :2]
    np.testing.assert_allclose(found, np.array(truth)[: len(found)], atol=2e-6)


def test_a_command_that_holds_moves_a_linear_model(tmp_path):
    @dynamics
    def pushed(
        force=signal("m/s^2", held=True),
        x=signal("m"),
        *,
        position=state("m", std=1e-6),
        velocity=state("m/s", std=1e-6),
    ):
        """Without drag."""
        rates = {"position": velocity, "velocity": force}
        return Motion(rates=rates, outputs=(measured(x, position, std=1.0),))

    tf, tx = np.arange(0, 3, 0.5), np.arange(1, 24) * 0.1 + 0.01
    force = np.array([1.0, -1, 2, 0, 0, 3])
    run = read(pair(tmp_path, tf, force, tx, 1e-9 * tx, "force"), pushed)
    speed = np.interp(run.time, tf, np.concatenate([[0], np.cumsum(0.5 * force[:-1])]))
    np.testing.assert_allclose(filtered(pushed, run).x[:, 1], speed, atol=1e-9)
    by_one = Estimator(pushed, 0.1)
    for k, t in enumerate(run.time):
        now = by_one.step({name: own[k] for name, own in run.signals.items()}, t)
    np.testing.assert_allclose(now.x[1], speed[-1], atol=1e-9)


def test_one_file_with_empty_cells_says_the_same(tmp_path):
    ta, a, tx, x = logs(np.random.default_rng(4))
    two = read(pair(tmp_path, ta, a, tx, x), sledge)
    rows = sorted([(t, str(v), "") for t, v in zip(ta, a, strict=True)]
                  + [(t, "", str(v)) for t, v in zip(tx, x, strict=True)])  # fmt: skip
    text = "".join(f"{t},{v},{w}\n" for t, v, w in rows)
    (tmp_path / "one.csv").write_text("t [s],a [m/s^2],x [m]\n" + text)
    one = read(tmp_path / "one.csv", sledge)
    np.testing.assert_allclose(filtered(sledge, one).x, filtered(sledge, two).x, atol=1e-12)


def test_positions_alone_of_two_receivers(tmp_path):
    """No input: nothing is dropped, whichever clock begins first."""

    @dynamics
    def drifting(x=signal("m"), y=signal("m"), *, position=state("m", std=10.0, intensity=0.1)):
        """Two receivers of one position."""
        outputs = (measured(x, position, std=0.5), measured(y, position, std=2.0))
        return Motion(rates={}, outputs=outputs)

    one = written(tmp_path / "x.csv", "t [s],x [m]", [0.0, 1, 2], [1.0, 2, 3])
    two = written(tmp_path / "y.csv", "t [s],y [m]", [0.5, 1, 3], [1.0, 4, 2])
    (run,) = load_runs([f"{one}+{two}"], drifting.signals, gaps=["x", "y"], between=[])
    np.testing.assert_allclose(run.time, [0, 0.5, 1, 2, 3])
    weight, mean = 0.01, 0.0
    for k, h in enumerate(np.diff(run.time, prepend=0.0)):
        weight = 1 / (1 / weight + 0.1 * h)
        for name, std in (("x", 0.5), ("y", 2.0)):
            if np.isfinite(value := run.signals[name][k, 0]):
                mean = (weight * mean + value / std**2) / (weight + 1 / std**2)
                weight += 1 / std**2
    found = filtered(drifting, run)
    np.testing.assert_allclose([found.x[-1, 0], found.P[-1, 0, 0]], [mean, 1 / weight], rtol=1e-9)


def test_stamps_alike_up_to_rounding_are_one_instant(tmp_path):
    ta = np.arange(0, 5, 0.01)
    tx = ta[20:-1:20] + 1e-7
    run = read(pair(tmp_path, ta, np.sin(ta), tx, tx), sledge)
    np.testing.assert_array_equal(run.time, ta)
    assert any("24 time stamps less than 1e-05 s from another" in note for note in run.notes)


def test_readings_outside_what_the_inputs_saw_are_dropped_and_said(tmp_path):
    ta, tx = np.arange(1, 4, 0.01), np.arange(0, 6, 0.5) + 0.003
    run = read(pair(tmp_path, ta, np.sin(ta), tx, tx), sledge)
    assert (run.time[0], run.time[-1]) == (ta[0], ta[-1])
    assert any("6 of 312 samples dropped: before the first" in note for note in run.notes)


def test_a_gap_of_the_input_is_one_though_positions_go_on(tmp_path):
    ta, a, tx, x = logs(np.random.default_rng(5), even=True)
    whole = (ta < 5) | (ta > 6.5)
    run = read(pair(tmp_path, ta[whole], a[whole], tx, x), sledge)
    std = filtered(sledge, run, smooth=False).std[:, 1]
    assert std[run.time <= ta[whole][499]][-1] < 0.5
    assert std[run.time > 6.5][0] > 2.0


@pytest.mark.parametrize(("scale", "head", "words"), [
    (1000.0, "t,x [m]", "seems to count ms: say --unit gps.t=ms, or --unit gps.t=s if it does not"),
    (1e6, "t,x [m]", "seems to count us: say --unit gps.t=us"),
    (1e9, "t,x [m]", "seems to count ns"),
])  # fmt: skip
def test_clocks_in_different_units(tmp_path, scale, head, words):
    ta, a, tx, x = logs(np.random.default_rng(6))
    path = pair(tmp_path, ta, a, tx, x)
    written(tmp_path / "gps.csv", head, scale * tx, x)
    with pytest.raises(DataError, match=words):
        read(path, sledge)
    unit = {1000.0: "ms", 1e6: "us", 1e9: "ns"}[scale]
    (run,) = load_runs(
        [path], sledge.signals, gaps=["x"], between=["a"], units={"gps.t": unit}
    )  # fmt: skip
    assert np.count_nonzero(np.isfinite(run.signals["x"])) == len(tx)


def test_two_files_of_one_name_are_told_apart(tmp_path):
    ta, a, tx, x = logs(np.random.default_rng(6))
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    imu = written(tmp_path / "one" / "log.csv", "t [s],a [m/s^2]", ta, a)
    path = f"{imu}+{written(tmp_path / 'two' / 'log.csv', 't,x [m]', 1000 * tx, x)}"
    with pytest.raises(DataError, match=r"--unit log#2\.t=ms"):
        read(path, sledge)
    (run,) = load_runs(
        [path], sledge.signals, gaps=["x"], between=["a"], units={"log#2.t": "ms"}
    )  # fmt: skip
    assert np.isfinite(run.signals["x"]).sum() == len(tx)


def test_clocks_with_no_time_in_common(tmp_path):
    ta, a, tx, x = logs(np.random.default_rng(7))
    path = pair(tmp_path, ta, a, tx + 1.7e9, x)
    with pytest.raises(DataError, match="no time that all files recorded") as error:
        read(path, sledge)
    assert "--scale gps.t=+SECONDS" in str(error.value)
    (run,) = load_runs(
        [path], sledge.signals, gaps=["x"], between=["a"], scales={"gps.t": "-1700000000"},
        units={"gps.t": "s"},
    )  # fmt: skip
    assert np.isfinite(run.signals["x"]).sum() == len(tx)


def test_a_column_in_both_files_is_asked_for(tmp_path):
    ta, a, tx, x = logs(np.random.default_rng(8))
    path = pair(tmp_path, ta, a, tx, x)
    written(tmp_path / "gps.csv", "t [s],x [m],a [m/s^2]", tx, x, x)
    with pytest.raises(DataError, match=r"both have signal a: say --columns a=imu\.a or"):
        read(path, sledge)


def test_an_input_with_one_sample(tmp_path):
    path = pair(tmp_path, [1.0], [0.0], np.arange(3.0), np.arange(3.0))
    with pytest.raises(DataError, match="an input has 1 samples: a motion needs two at least"):
        read(path, sledge)


def test_a_reading_that_the_model_computes_from_is_not_made_up(tmp_path):
    @dynamics
    def damped(a=signal("m/s^2"), x=signal("m"), *, velocity=state("m/s")):
        """Its position is read, and pulls it back too."""
        rate = a - 0.1 * x / 1.0
        return Motion(rates={"velocity": rate}, outputs=(measured(x, velocity, std=0.1),))

    ta, a, tx, x = logs(np.random.default_rng(9))
    with pytest.raises(DataError, match="x is a reading from which the model computes something"):
        load_runs([pair(tmp_path, ta, a, tx, x)], damped.signals, between=["a"])


MODEL = """
from casest import signal
from casest.dynamics import Motion, dynamics, measured, state

@dynamics
def sledge(a=signal("m/s^2"), x=signal("m"), *, position=state("m", std=10.0),
           velocity=state("m/s", std=2.0, intensity=1e-3),
           bias=state("m/s^2", std=0.5, intensity=1e-5)):
    rates = {"position": velocity, "velocity": a - bias}
    return Motion(rates=rates, outputs=(measured(x, position, std=0.3),))
"""


def test_the_command_line_takes_both_files(tmp_path, capsys):
    ta, a, tx, x = logs(np.random.default_rng(10))
    path = pair(tmp_path, ta, a, tx, x)
    (tmp_path / "sledge.py").write_text(MODEL)
    out = tmp_path / "out"
    assert command(["filter", str(tmp_path / "sledge.py"), path, "-o", str(out)]) == 0
    assert "every reading at its own time" in " ".join(capsys.readouterr().out.split())
    table = np.genfromtxt(out / "states.csv", delimiter=",", skip_header=1)
    _, after, smooth = textbook(ta, a, tx, x, 1e-3)
    np.testing.assert_allclose(table[:, 1:4], [m for m, _ in after], atol=1e-9)
    np.testing.assert_allclose(table[:, 7:10], [m for m, _ in smooth], atol=1e-9)
    assert command(["observe", str(tmp_path / "sledge.py"), path]) == 0
    assert "rank 3 of 3" in capsys.readouterr().out
    assert command(["close", str(tmp_path / "sledge.py"), path]) == 1
    assert "close looks for its causes sample by sample" in capsys.readouterr().err


def test_likely_intensities_are_those_of_each_clock(tmp_path):
    """The reading's is its variance times the time between two of them."""
    rng = np.random.default_rng(11)
    tx = np.arange(0.005, 300, 0.2)
    ta = np.arange(0, 300.5, 0.05)
    x = -0.8 / 0.49 * np.sin(0.7 * tx) + SIGMA * rng.standard_normal(len(tx))
    run = read(pair(tmp_path, ta, 0.8 * np.sin(0.7 * ta), tx, x), sledge)
    tuned = most_likely(sledge, run)
    share = tuned.spread["x"]
    assert share < 0.1
    assert abs(np.log(tuned.model.sensors["x"] / (SIGMA**2 * 0.2))) < 3 * share
