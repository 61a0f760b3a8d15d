"""Effects with memory and signals that come late, against simulations that share no code."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from casest import (
    DeclarationError,
    Model,
    Residual,
    Run,
    UsageError,
    attitude,
    effect,
    model,
    param,
    quantity,
    signal,
)
from casest.correction.inverse import Correction, invertible
from casest.effects import axis_delay, creep, hysteresis, low_pass, signal_lag
from casest.effects.placing import placed_in, told
from casest.estimate.calibrate import attempt
from casest.leastsquares.problem import Problem
from casest.results.find import find_model


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
    assert extended.effects[0].kind == "sequence"
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


@pytest.mark.parametrize("load_noise", [0.0, 0.3])
def test_the_loop_of_a_cycled_cell_is_as_wide_as_it_was_made(load_noise):
    """Also where noise in the recorded load turns it round at nearly every sample.

    It was made to turn at once, and the effect turns over 2 % of the span: that much of the width
    is what the gain may be off by.
    """
    run = cycled(load_noise=load_noise)
    turns = np.diff(np.sign(np.diff(run.signals["load"][:, 0])))
    assert (np.count_nonzero(turns) > 200) == (load_noise > 0)
    extended = with_shipped(cell, hysteresis)
    found = attempt(extended, [run])
    assert found.values["hysteresis.k"] == pytest.approx(3.0, rel=0.04)
    assert found.values["gain"] == pytest.approx(2.0, abs=0.02 * 2 * 3.0 / 100 * 5)
    plain = attempt(cell, [run])
    after, before = (np.std(e.problem.residuals(e.point)[0]) for e in (found, plain))
    assert after < before / 3


@pytest.mark.parametrize(
    ("added", "on", "at"),
    [
        (creep, "output", {"creep.k": 0.05, "creep.tau": 30.0}),
        (creep, "output", {"creep.k": 0.0, "creep.tau": 30.0}),
        (creep, "force", {"creep@force.k": 0.05, "creep@force.tau": 30.0}),
        (low_pass, "output", {"low_pass.tau": 2.0}),
        (low_pass, "output", {"low_pass.tau": 0.0}),
        (low_pass, "force", {"low_pass@force.tau": -0.1}),
        (hysteresis, "output", {"hysteresis.k": 1.0}),
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
    assert np.abs(numeric[:, -1 if "tau" not in extended.parameters[-1].name else -2]).max() > 0.1


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


@pytest.mark.parametrize("delay", [0.013, -0.027, 0.33])
def test_a_lag_of_the_attitude_is_found_also_over_many_samples(delay):
    run = late(delay)
    # Before the record begins nobody knows the attitude: those samples are left out.
    run = run.take(slice(20, -20)) if abs(delay) < 0.1 else run
    found = attempt(compass.with_effect(signal_lag, on="attitude"), [run])
    if abs(delay) > 0.1:  # the record's first third of a second is held, and wrong
        assert found.values["signal_lag(attitude).delay"] == pytest.approx(delay, abs=3e-3)
        return
    assert found.certificate.trusted
    assert abs(found.values["signal_lag(attitude).delay"] - delay) < 4 * 1e-4
    assert found.std["signal_lag(attitude).delay"] < 1e-4
    np.testing.assert_allclose(found.values["earth"], EARTH, atol=0.05)


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
    # What the load was 0.3 s before, and in each part nothing before its first sample.
    slope = 5 / 49
    np.testing.assert_allclose(seen[:50], np.maximum(load[:50] - 3 * slope, 0), atol=1e-9)
    np.testing.assert_allclose(seen[50:], np.maximum(load[50:] - 3 * slope, 40), atol=1e-9)


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
