"""Effects with memory and signals that come late, against simulations that share no code."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from casest import (
    DeclarationError,
    Model,
    Residual,
    Run,
    UsageError,
    attitude,
    effect,
    load_runs,
    model,
    param,
    quantity,
    signal,
)
from casest.cli import run as command
from casest.correction.inverse import Correction, invertible
from casest.effects import axis_delay, creep, hysteresis, low_pass, signal_lag
from casest.effects.placing import placed_in, told
from casest.estimate.calibrate import attempt
from casest.leastsquares.problem import Problem
from casest.results.find import find_effects, find_model
from casest.saved.model import saved_model

EXAMPLES = Path(__file__).parent.parent / "examples"


@model
def cell(load=signal("N"), reading=signal("mV"), *, zero=param("mV"), gain=param("mV/N", start=1)):
    """A load cell against a recorded load."""
    force = quantity("force", load, "N")
    predicted = quantity("predicted", zero + gain * force, "mV")
    return Residual(measured=reading, predicted=predicted, corrected=force)


@model
def compass(
    m=signal(3, "uT"),
    attitude=attitude(),
    *,
    earth=param(3, "uT"),
    hard=param(3, "uT"),
):
    """The earth's field seen from the body."""
    field = quantity("field", attitude.T @ earth, "uT")
    return Residual(measured=m, predicted=quantity("reading", field + hard, "uT"), corrected=field)


def with_shipped(declared: Model, added, **more) -> Model:
    return declared.with_effect(placed_in(added, declared), **more)


def run_of(time, **signals) -> Run:
    columns = {name: np.asarray(s, float).reshape(len(time), -1) for name, s in signals.items()}
    return Run.raw("r", columns, units={}, time=np.asarray(time, float))


def steps_of_load(time):
    """Weights put on and taken off, each within a second, held for some minutes."""
    corners = [0, 100, 101, 400, 401, 700, 701, 1000, 1001, 1300, 1301, 2000]
    return np.interp(time, corners, [0, 0, 50, 50, 100, 100, 20, 20, 80, 80, 0, 0])


def behind(time, x, tau, fine=200):
    """A first-order lag by Euler's rule on a grid `fine` times as fine, x straight between."""
    found, state = np.empty(len(time)), x[0]
    found[0] = state
    for k in range(1, len(time)):
        h = (time[k] - time[k - 1]) / fine
        for j in range(fine):
            within = x[k - 1] + (x[k] - x[k - 1]) * (j + 0.5) / fine
            state += h / tau * (within - state)
        found[k] = state
    return found


def difference_quotients(problem, point, step=1e-6):
    def residuals(x):
        return np.concatenate([r.ravel() for r in problem.residuals(type(point)(x, references))])

    references = point.references
    moves = step * np.eye(len(point.x)) * np.maximum(1.0, np.abs(point.x))
    return np.column_stack(
        [(residuals(point.x + h) - residuals(point.x - h)) / (2 * h.sum()) for h in moves]
    )


# -- memory ----------------------------------------------------------------------------------------


def crept(noise=0.01, seed=0, k=0.02, tau=150.0):
    time = np.cumsum(np.random.default_rng(9).uniform(0.7, 1.3, 1600))
    load = steps_of_load(time)
    true = 1.5 + 2.0 * load
    y = true - k * (true - behind(time, true, tau, 20))
    y += noise * np.random.default_rng(seed).standard_normal(len(time))
    return run_of(time, load=load, reading=y)


def test_creep_of_a_load_cell_is_recovered_with_its_time_constant():
    run = crept()
    found = attempt(told(with_shipped(cell, creep), [run]), [run])
    assert found.certificate.trusted
    for name, true in (("zero", 1.5), ("gain", 2.0), ("creep.k", 0.02), ("creep.tau", 150.0)):
        assert abs(found.values[name] - true) < 4 * found.std[name]
    assert found.std["creep.tau"] < 15


def test_a_lagging_thermometer_is_recovered_though_its_input_is_a_column():
    time = np.arange(0, 300, 0.5)
    load = 20 * np.sin(2 * np.pi * time / 40) + 10 * np.sin(2 * np.pi * time / 13)
    y = behind(time, 3.0 + 0.5 * load, tau=4.0)
    y += 0.01 * np.random.default_rng(1).standard_normal(len(time))
    extended = with_shipped(cell, low_pass)
    used = extended.effects[0].effect
    assert (used.kind, used.name, used.typical) == ("sequence", "low_pass", low_pass.typical)
    found = attempt(extended, [run_of(time, load=load, reading=y)])
    assert found.certificate.trusted
    for name, true in (("zero", 3.0), ("gain", 0.5), ("low_pass.tau", 4.0)):
        assert abs(found.values[name] - true) < 4 * found.std[name]


def cycled(half=3.0, noise=0.05, load_noise=0.0, seed=2):
    """Up and down again, three times, lower each time; the reading lags by `half`."""
    corners = np.array([0, 100, 0, 80, 10, 60, 0.0])
    load = np.interp(np.arange(1201), 200 * np.arange(7), corners)
    way = np.repeat([1, -1, 1, -1, 1, -1], 200)
    rng = np.random.default_rng(seed)
    y = 1.5 + 2.0 * load - half * np.r_[way[0], way] + noise * rng.standard_normal(1201)
    return run_of(np.arange(1201.0), load=load + load_noise * rng.standard_normal(1201), reading=y)


def test_the_loop_of_a_cycled_cell_is_as_wide_as_it_was_made():
    run = cycled()
    found = attempt(with_shipped(cell, hysteresis), [run])
    assert found.values["hysteresis.k"] == pytest.approx(3.0, abs=0.01)
    assert found.values["gain"] == pytest.approx(2.0, abs=0.001)
    plain = attempt(cell, [run])
    after, before = (np.std(e.problem.residuals(e.point)[0]) for e in (found, plain))
    assert after < before / 25


def test_noise_in_the_recorded_load_does_not_turn_the_loop_round():
    """The load's own noise turns it round at hundreds of samples."""
    run = cycled(load_noise=0.3)
    assert np.count_nonzero(np.diff(np.sign(np.diff(run.signals["load"][:, 0])))) > 400
    found = attempt(with_shipped(cell, hysteresis), [run])
    assert found.values["hysteresis.k"] == pytest.approx(3.0, rel=0.05)
    assert found.values["gain"] == pytest.approx(2.0, abs=0.006)
    assert np.std(found.problem.residuals(found.point)[0]) < 1.25 * 2.0 * 0.3


@pytest.mark.long
def test_backlash_is_a_loop_that_turns_over_its_whole_width():
    run = cycled(half=0.0, noise=0.0)
    middle, play = 1.5, []
    for x in 1.5 + 2.0 * run.signals["load"][:, 0]:
        middle = min(max(middle, x - 3.0), x + 3.0)
        play.append(middle)
    y = np.array(play) + 0.05 * np.random.default_rng(6).standard_normal(len(run))
    found = attempt(
        with_shipped(cell, hysteresis), [run_of(run.time, load=run.signals["load"], reading=y)]
    )
    assert found.values["hysteresis.k"] == pytest.approx(3.0, abs=0.01)
    assert found.values["hysteresis.turn"] == pytest.approx(6.0 / 200.0, rel=0.02)
    assert np.std(found.problem.residuals(found.point)[0]) < 0.055


@pytest.mark.parametrize(
    ("added", "on", "at"),
    [
        (creep, "output", {"creep.k": 0.05, "creep.tau": 30.0}),
        (creep, "output", {"creep.k": 0.0, "creep.tau": 30.0}),
        (creep, "force", {"creep@force.k": 0.05, "creep@force.tau": 30.0}),
        (low_pass, "output", {"low_pass.tau": 2.0}),
        (low_pass, "output", {"low_pass.tau": 0.0}),
        (low_pass, "force", {"low_pass@force.tau": -0.1}),
        (hysteresis, "output", {"hysteresis.k": 1.0, "hysteresis.turn": 0.1}),
        (hysteresis, "output", {"hysteresis.k": 0.0}),
    ],
)
def test_slopes_are_difference_quotients_also_where_the_effect_vanishes(added, on, at):
    time = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 300))
    load = 50 + 30 * np.sin(time / 9) + 11 * np.cos(time / 3)
    place = {} if on == "output" else {"on": on}
    extended = with_shipped(cell, added, **place)
    problem = Problem(extended, (run_of(time, load=load, reading=2 * load),))
    point = problem.point({"zero": 1.0, "gain": 1.9, **at})
    numeric = difference_quotients(problem, point)
    np.testing.assert_allclose(problem.jacobian(point), numeric, rtol=1e-6, atol=2e-7)
    assert np.abs(numeric[:, 2]).max() > 0.1  # the size of the effect, behind zero and gain


def test_at_its_null_an_effect_with_memory_changes_nothing():
    run = crept()
    plain = Problem(cell, (run,))
    without = plain.residuals(plain.point({"zero": 1.0, "gain": 2.0}))[0]
    for added in (creep, low_pass, hysteresis):
        problem = Problem(with_shipped(cell, added), (run,))
        found = problem.residuals(problem.point({"zero": 1.0, "gain": 2.0}))[0]
        np.testing.assert_allclose(found, without, atol=1e-12)


def test_a_memory_is_that_of_a_plain_loop_in_three_axes_with_another_signal():
    @model
    def three(v=signal(3, "V"), x=signal(3, "V"), *, gain=param(3, start=1.0)):
        return Residual(measured=v, predicted=quantity("reading", gain * x, "V"))

    @effect(on="reading", kind="sequence", memory={"fast": "y", "worst": 0})
    def worn(y, fast, worst, dt, heat=signal(), *, k=param(3), c=param()):
        fast = fast + 0.3 * dt * (y - fast)
        worst = 0.9 * worst + c * heat * fast
        return y + k * worst, fast, worst

    rng = np.random.default_rng(3)
    time, x, heat = np.arange(40) * 0.5, rng.standard_normal((40, 3)), rng.standard_normal(40)
    gain, k, c = np.array([1.0, 2.0, -1.0]), np.array([0.1, 0.2, 0.3]), 0.7
    fast, worst, expected = gain * x[0], np.zeros(3), []
    for row, warm in zip(x, heat, strict=True):
        fast = fast + 0.3 * 0.5 * (gain * row - fast)
        worst = 0.9 * worst + c * warm * fast
        expected.append(gain * row + k * worst)
    run = run_of(time, v=np.zeros((40, 3)), x=x, heat=heat)
    problem = Problem(three.with_effect(worn), (run,))
    point = problem.point({"gain": gain, "worn.k": k, "worn.c": c})
    np.testing.assert_allclose(problem.residuals(point)[0], -np.array(expected), atol=1e-12)
    numeric = difference_quotients(problem, point)
    np.testing.assert_allclose(problem.jacobian(point), numeric, atol=1e-7)


def test_an_effect_with_memory_stands_beside_ordinary_ones_in_their_order():
    @effect(on="predicted")
    def bent(y, *, q=param("1/mV")):
        return y + q * y**2

    time = np.arange(60.0)
    load = np.abs(30 * np.sin(time / 7))
    at = {"zero": 0.5, "gain": 1.0, "bent.q": 0.01, "low_pass.tau": 3.0}
    slow = behind(time, 0.5 + load, 3.0, 2000)
    run = run_of(time, load=load, reading=slow + 0.01 * slow**2)
    first = Problem(with_shipped(cell, low_pass).with_effect(bent), (run,))
    assert np.abs(first.residuals(first.point(at))[0]).max() < 2e-3
    other = Problem(with_shipped(cell.with_effect(bent), low_pass), (run,))
    assert np.abs(other.residuals(other.point(at))[0]).max() > 0.1


def test_samples_taken_from_a_record_remember_what_came_before_them():
    """A stretch that is held out is predicted with the creep and the lag that lead into it."""
    run = crept(noise=0.0)
    part = run.take(np.arange(500, 600)).take(slice(None, None, 2))
    extended = with_shipped(cell, creep).with_effect(signal_lag, on="load")
    at = {"zero": 1.0, "gain": 1.9, "creep.k": 0.1, "creep.tau": 200.0}
    both = [Problem(extended, (r,)) for r in (run, part)]
    points = [p.point({**at, "signal_lag(load).delay": 1.7}) for p in both]
    whole, own = (p.residuals(x)[0] for p, x in zip(both, points, strict=True))
    np.testing.assert_allclose(own, whole[500:600:2], atol=1e-12)
    slopes = both[0].jacobian(points[0])[500:600:2]
    np.testing.assert_allclose(both[1].jacobian(points[1]), slopes, atol=1e-12)


def test_samples_whose_input_was_changed_stand_alone():
    run = crept(noise=0.0).take(slice(500, 600))
    changed = run_of(run.time, load=run.signals["load"] + 1.0, reading=run.signals["reading"])
    shifted = replace(run, signals={**run.signals, "load": run.signals["load"] + 1.0})
    at = {"zero": 1.0, "gain": 1.9, "creep.k": 0.1, "creep.tau": 200.0}
    found = []
    for r in (changed, shifted):
        problem = Problem(with_shipped(cell, creep), (r,))
        found.append(problem.residuals(problem.point(at))[0])
    np.testing.assert_allclose(*found, atol=1e-12)


def test_a_norm_refuses_memory_and_lags_with_the_reason():
    norm = find_model("norm-diagonal")
    for added in (creep, low_pass, hysteresis):
        with pytest.raises(UsageError, match="this model's residual is no reading"):
            with_shipped(norm, added)
    with pytest.raises(UsageError, match="its residual is no signal that could come late"):
        norm.with_effect(signal_lag, on="v")


def test_what_needs_a_rate_refuses_a_quantity_with_memory():
    wheel = find_model("wheel")
    with pytest.raises(UsageError, match="how fast angle changes is unknown once creep@angle"):
        wheel.with_effect(creep, on="angle")
    with pytest.raises(UsageError, match="how fast reading changes is unknown once creep acts"):
        with_shipped(with_shipped(wheel, creep), axis_delay)


def test_a_declaration_of_memory_that_makes_no_sense_is_refused():
    def declared(memory, kind="sequence", function=lambda y, kept, *, k=param(): (y, kept)):
        return effect(on="output", kind=kind, memory=memory)(function)

    with pytest.raises(DeclarationError, match="names 'other': give it as an argument behind 'y'"):
        declared({"other": 0.0})
    with pytest.raises(DeclarationError, match="kept begins from 'x': give 'y'"):
        declared({"kept": "x"})
    with pytest.raises(DeclarationError, match="memory= is for kind="):
        declared({"kept": 0.0}, kind=None)
    with pytest.raises(DeclarationError, match="it returns the result and then what is kept"):
        with_shipped(cell, declared({"kept": 0}, function=lambda y, kept, *, k=param(): y + k))
    with pytest.raises(DeclarationError, match="takes the time of a sample and nothing else"):
        effect(on="load", kind="time")(lambda t, warm, *, d=param("s"): t - d)


# -- signals that come late ------------------------------------------------------------------------


def tumbling(time):
    """A smooth motion about all axes, as rotations body to reference."""
    yaw, pitch, roll = 2 * np.sin(0.9 * time), 0.8 * np.sin(1.7 * time), 1.2 * np.cos(1.1 * time)
    return Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()


EARTH, HARD = np.array([20.0, 3.0, -45.0]), np.array([5.0, -2.0, 8.0])


def late(delay, noise=0.1, rate=50.0, seconds=40.0, seed=4):
    time = np.arange(0, seconds, 1 / rate)
    m = np.einsum("nij,i->nj", tumbling(time - delay), EARTH) + HARD
    m += noise * np.random.default_rng(seed).standard_normal(m.shape)
    return run_of(time, m=m, attitude=tumbling(time).reshape(-1, 9))


@pytest.mark.parametrize("delay", [pytest.param(0.013, marks=pytest.mark.long), -0.027, 0.05])
def test_a_lag_of_the_attitude_is_found_whichever_sign_it_has(delay):
    found = attempt(compass.with_effect(signal_lag, on="attitude"), [late(delay)])
    assert found.certificate.trusted
    assert found.std["signal_lag(attitude).delay"] < 1e-4
    assert found.values["signal_lag(attitude).delay"] == pytest.approx(delay, abs=4e-4)
    np.testing.assert_allclose(found.values["earth"], EARTH, atol=0.05)


def test_a_lag_of_many_samples_is_found_though_the_start_of_the_record_is_lost():
    """17 samples: of the first ones nobody knows the attitude, and they say nothing."""
    runs = [late(0.33)]
    found = attempt(told(compass.with_effect(signal_lag, on="attitude"), runs), runs)
    assert 13 <= len(runs[0]) - found.problem.residual_count / 3 <= 20
    assert found.std["signal_lag(attitude).delay"] < 1e-4
    assert found.values["signal_lag(attitude).delay"] == pytest.approx(0.33, abs=4e-4)
    np.testing.assert_allclose(found.values["earth"], EARTH, atol=0.05)
    np.testing.assert_allclose(found.values["hard"], HARD, atol=0.05)


@pytest.mark.parametrize("delay", [0.0, 0.013, 0.33])
def test_slopes_of_a_lag_are_difference_quotients(delay):
    problem = Problem(compass.with_effect(signal_lag, on="attitude"), (late(0.1),))
    at = {"earth": EARTH, "hard": HARD, "signal_lag(attitude).delay": delay}
    point = problem.point(at)
    # At the ends the record is held, and the slope has two sides there.
    inner = slice(3 * 30, -3 * 30)
    numeric = difference_quotients(problem, point)[inner]
    np.testing.assert_allclose(problem.jacobian(point)[inner], numeric, atol=2e-5)
    assert np.abs(numeric[:, -1]).max() > 10


def test_between_its_samples_a_rotation_stays_one_and_is_where_the_body_was():
    time = np.arange(0, 10, 0.05)
    problem = Problem(compass.with_effect(signal_lag, on="attitude"), (late(0.0, 0.0, 20.0, 10.0),))
    at = {"earth": EARTH, "hard": 0 * HARD, "signal_lag(attitude).delay": 0.0237}
    seen = problem.runs[0].signals["m"] - problem.residuals(problem.point(at))[0]
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), np.linalg.norm(EARTH), rtol=1e-12)
    true = np.einsum("nij,i->nj", tumbling(time - 0.0237), EARTH)
    assert np.abs(seen - true)[5:-5].max() < 0.01


def test_a_gap_is_not_bridged_by_a_late_signal():
    time = np.r_[np.arange(50) * 0.1, 60 + np.arange(50) * 0.1]
    load = np.r_[np.linspace(0, 5, 50), np.linspace(40, 45, 50)]
    problem = Problem(
        cell.with_effect(signal_lag, on="load"), (run_of(time, load=load, reading=load),)
    )
    at = {"zero": 0.0, "gain": 1.0, "signal_lag(load).delay": 0.3}
    seen = load - problem.residuals(problem.point(at))[0][:, 0]
    # Each part goes straight on for three samples beyond its first, as the load did.
    np.testing.assert_allclose(seen[:50], load[:50] - 3 * 5 / 49, atol=1e-9)
    np.testing.assert_allclose(seen[50:], load[50:] - 3 * 5 / 49, atol=1e-9)
    held = load - problem.residuals(problem.point({**at, "signal_lag(load).delay": 1.0}))[0][:, 0]
    np.testing.assert_allclose(held[50:58], 40 - 3 * 5 / 49, atol=1e-9)
    np.testing.assert_allclose(held[60:], load[60:] - 10 * 5 / 49, atol=1e-9)


def test_a_column_that_an_effect_reads_may_come_late_too():
    @effect(on="predicted")
    def pull(y, current=signal(), *, c=param()):
        return y + c * current

    time = np.arange(0, 60, 0.1)
    load, current = 10 * np.sin(0.3 * time), lambda t: 5 * np.sin(0.8 * t) ** 3
    y = 2.0 * load + 0.4 * current(time - 0.25)
    run = run_of(time, load=load, reading=y, current=current(time)).take(slice(5, None))
    found = attempt(cell.with_effect(pull).with_effect(signal_lag, on="current"), [run])
    assert found.values["signal_lag(current).delay"] == pytest.approx(0.25, abs=1e-3)
    assert found.values["pull.c"] == pytest.approx(0.4, abs=1e-3)
    assert invertible(found.model)[1] == ("signal_lag(current)",)


def test_a_lag_and_a_memory_act_both():
    time = np.arange(0, 100, 0.25)
    load = lambda t: 20 * np.sin(t / 3) + 8 * np.cos(t)  # noqa: E731
    y = behind(time, 1.0 + 2.0 * load(time - 0.6), tau=2.0)
    extended = with_shipped(cell, low_pass).with_effect(signal_lag, on="load")
    run = run_of(time, load=load(time), reading=y)
    problem = Problem(extended, (run,))
    point = problem.point({"gain": 1.8, "low_pass.tau": 1.0, "signal_lag(load).delay": 0.1})
    np.testing.assert_allclose(
        problem.jacobian(point)[9:-9], difference_quotients(problem, point)[9:-9], atol=2e-5
    )
    assert (
        np.abs(
            problem.residuals(
                problem.point(
                    {"zero": 1.0, "gain": 2.0, "low_pass.tau": 2.0, "signal_lag(load).delay": 0.6}
                )
            )[0][120:]
        ).max()
        < 0.02
    )


@pytest.mark.parametrize(
    ("on", "why"),
    [
        ("t", "t is the time of its samples: it has attitude"),
        ("m", "m is what it measures: it has attitude"),
        ("current", "it has no 'current': it has attitude"),
        (None, "say of which signal: it has attitude"),
    ],
)
def test_a_lag_is_of_a_signal_of_another_instrument(on, why):
    with pytest.raises(UsageError) as refused:
        compass.with_effect(signal_lag, on=on)
    assert why in str(refused.value)


def test_readings_are_corrected_without_the_attitude_that_came_late():
    run = late(0.1, noise=0.0)
    values = {"earth": EARTH, "hard": HARD, "signal_lag(attitude).delay": 0.1}
    found = Correction(compass.with_effect(signal_lag, on="attitude"))(run, values)
    np.testing.assert_allclose(found, run.signals["m"] - HARD, atol=1e-12)


# -- measured, and on the command line -------------------------------------------------------------


def lag_by_hand(file, quaternion):
    """Lag and rms of "field in the body and hard iron", attitude by slerp, on a grid of lags."""
    table = np.genfromtxt(file, delimiter=",", skip_header=1)
    time, m = table[:, 0], table[:, 1:4]
    if quaternion:
        turned = Rotation.from_quat(table[:, [5, 6, 7, 4]])
    else:
        turned = Rotation.from_euler("ZYX", np.deg2rad(table[:, [6, 5, 4]]))
    path = Slerp(time, turned)
    inner = (time > time[0] + 0.2) & (time < time[-1] - 0.2)
    lags = np.arange(-0.02, 0.08, 0.005)
    squares = []
    for lag in lags:
        R = path(time[inner] - lag).as_matrix()
        columns = np.concatenate([R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1))], axis=2)
        squares.append(np.linalg.lstsq(columns.reshape(-1, 6), m[inner].ravel())[1][0])
    near = slice(max(int(np.argmin(squares)) - 3, 0), int(np.argmin(squares)) + 4)
    a, b, _ = np.polyfit(lags[near], np.array(squares)[near], 2)
    return -b / (2 * a)


@pytest.mark.parametrize(
    ("file", "quaternion", "within"),
    [
        ("broad/mag26.csv", True, 0.3e-3),
        ("ardupilot-log171/MAG_all.csv", False, 4e-3),
        pytest.param("ardupilot-log171/MAG2_all.csv", False, 4e-3, marks=pytest.mark.long),
        pytest.param("ardupilot-log171/MAG3_all.csv", False, 4e-3, marks=pytest.mark.long),
    ],
)
def test_the_lag_of_a_logged_attitude_is_what_slerp_and_a_grid_find(
    shared_data, file, quaternion, within
):
    declared = find_model(str(EXAMPLES / "compass.py"))
    runs = load_runs([shared_data / file], declared.signals)
    found = attempt(declared.with_effect(signal_lag, on="attitude"), runs)
    assert found.certificate.trusted
    by_hand = lag_by_hand(shared_data / file, quaternion)
    assert found.values["signal_lag(attitude).delay"] == pytest.approx(by_hand, abs=within)


@pytest.mark.long
def test_a_lag_and_soft_iron_together_take_what_the_record_supports(shared_data):
    """SOURCE.md: 15 ms, and 1.36 to 0.87 uT held out by a fit of its own."""
    declared = find_model(str(EXAMPLES / "compass.py"))
    (iron,) = find_effects(str(EXAMPLES / "compass.py:soft_iron"))
    runs = load_runs([shared_data / "broad/mag26.csv"], declared.signals)
    rms = []
    for tried in (declared, declared.with_effect(iron).with_effect(signal_lag, on="attitude")):
        found = attempt(tried, runs)
        rms.append(np.sqrt(np.mean(found.problem.residuals(found.point)[0] ** 2)))
    assert found.values["signal_lag(attitude).delay"] == pytest.approx(0.015, abs=1e-3)
    np.testing.assert_allclose(rms, [1.36, 0.87], atol=0.05)


@pytest.mark.long
def test_a_lag_that_begins_in_a_wrong_valley_is_found_beside_a_memory():
    """What creeps looks alike 2 s later; a fit from there left 75 times the noise, trusted."""
    run = late(0.05, seconds=20.0, rate=10.0)
    true = np.einsum("nij,i->nj", tumbling(run.time - 0.05), EARTH)
    slow = np.transpose([behind(run.time, axis, 2.0, 20) for axis in true.T])
    run.signals["m"][:] -= 0.3 * (true - slow)
    extended = compass.with_effect(signal_lag, on="attitude")
    extended = extended.with_effect(replace(creep, on="reading"))
    found = attempt(told(extended, [run]), [run])
    assert found.certificate.trusted
    assert found.values["signal_lag(attitude).delay"] == pytest.approx(0.05, abs=2e-3)
    sizes = next(v for n, v in found.values.items() if n.startswith("creep") and n.endswith(".k"))
    np.testing.assert_allclose(sizes, 0.3, atol=0.005)


def test_a_saved_result_with_a_lag_and_a_memory_is_read_and_applied_again(tmp_path, capsys):
    run = late(0.05, rate=10.0)
    true = np.einsum("nij,i->nj", tumbling(run.time - 0.05), EARTH)
    slow = np.transpose([behind(run.time, axis, 5.0, 20) for axis in true.T])
    run.signals["m"][:] -= 0.3 * (true - slow)
    head = "t [s],mx [uT],my [uT],mz [uT]," + ",".join(f"attitude{i}" for i in range(9))
    table = np.column_stack([run.time, run.signals["m"], run.signals["attitude"]])
    record = tmp_path / "waved.csv"
    np.savetxt(record, table, delimiter=",", header=head, comments="")
    asked = ["--effects", "signal_lag(attitude)", "--effects", "creep"]
    code = command(
        ["calibrate", str(EXAMPLES / "compass.py"), str(record), *asked, "-o", str(tmp_path / "o")]
    )
    assert code == 0
    saved = json.loads((tmp_path / "o" / "result.json").read_text(encoding="utf-8"))
    assert [(e["name"], e["on"]) for e in saved["effects"]] == [
        ("signal_lag", "attitude"), ("creep", "reading")
    ]  # fmt: skip
    again, values = saved_model(saved)
    assert [e.label for e in again.effects] == ["signal_lag(attitude)", "creep"]
    assert values["signal_lag(attitude).delay"] == pytest.approx(0.05, abs=1e-3)
    corrected = tmp_path / "corrected.csv"
    assert command(["apply", str(tmp_path / "o"), str(record), "-o", str(corrected)]) == 0
    assert "carry the course of one record to another: creep" in (capsys.readouterr().err)
    field = np.genfromtxt(corrected, delimiter=",", names=True)
    hard = np.array(saved["estimate"]["parameters"]["hard"]["value"])
    expected = table[:, 1:4] - hard
    found = np.column_stack([field[n] for n in field.dtype.names if n.startswith("field")])
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_lag_on_the_command_line_needs_its_signal(capsys):
    assert command(["calibrate", "norm-diagonal", "x.csv", "--effects", "signal_lag"]) == 1
    assert "--effects 'signal_lag(SIGNAL)'" in capsys.readouterr().err


def test_a_simulated_record_has_the_memory_and_the_lag_that_were_asked_for(tmp_path):
    time = np.arange(0, 30, 0.1)
    mass = 2 + np.sin(time)
    given = tmp_path / "mass.csv"
    table = np.column_stack([time, mass])
    np.savetxt(given, table, delimiter=",", header="t [s],mass [kg]", comments="")
    cell = str(Path(__file__).parent / "models" / "load_cell.py:load_cell")
    asked = ["--effect", "low_pass", "--effect", "signal_lag(mass)", "--noise", "0"]
    sizes = ["low_pass.tau=2", "signal_lag(mass).delay=0.5", "zero=0", "sensitivity=1"]
    values = [word for size in sizes for word in ("--value", size)]
    code = command(
        ["simulate", cell, "--input", str(given), *asked, *values, "-o", str(tmp_path / "sim")]
    )
    assert code == 0
    record = np.genfromtxt(tmp_path / "sim" / "record.csv", delimiter=",", names=True)
    (reading,) = (record[n] for n in record.dtype.names if n.startswith("output"))
    late = 9.80665 * (2 + np.sin(time - 0.5))
    assert np.abs(reading - behind(time, late, 2.0))[150:].max() < 0.02
    assert np.abs(reading - 9.80665 * mass)[150:].max() > 5
