"""The four kinds of effect: on a quantity, a signal, the noise, the sequence of samples."""

from __future__ import annotations

import numpy as np
import pytest
from models.load_cell import curvature, load_cell, warming
from models.wheel import quadratic, wheel

from casest import (
    DeclarationError,
    Residual,
    Run,
    UnitError,
    UsageError,
    effect,
    exp,
    model,
    param,
    quantity,
    signal,
    sin,
)
from casest.correction.inverse import Correction
from casest.estimate.calibrate import attempt
from casest.leastsquares.problem import Problem
from casest.results.find import find_model

N, DT = 400, 0.01
TIME = np.arange(N) * DT


@model
def chain(
    t=signal("s"),
    y=signal("V"),
    x=signal("V"),
    *,
    gain=param(start=1.0),
    bias=param("V"),
):
    """An amplifier driven by x."""
    u = quantity("u", gain * x, "V")
    reading = quantity("reading", bias + u, "V")
    return Residual(measured=y, predicted=reading, corrected=u)


@effect(on="reading", kind="sequence")
def low_pass(value, previous, dt, *, tau=param("s", bounds=(0.0, 10.0))):
    """First order lag, backward Euler."""
    return previous + (value - previous) * dt / (dt + tau)


@effect(on="noise", null={"bend": 0.0})
def outliers(r, *, nu=4.0, bend=param()):
    """Student's t with nu degrees of freedom."""
    return (nu + 1) / (nu + r**2) + bend


@effect(on="noise")
def student(r, *, nu=4.0):
    """Student's t with nu degrees of freedom."""
    return (nu + 1) / (nu + r**2)


@effect(on="t")
def time_delay(t, *, delay=param("s")):
    """The record's clock is late."""
    return t - delay


def run_of(time=TIME, **signals):
    columns = {name: np.asarray(s, float).reshape(len(time), -1) for name, s in signals.items()}
    return Run.raw("r", columns, units={}, time=time)


def drive(t=TIME):
    return np.sin(8 * t) + 0.3 * np.sin(31 * t)


def lagged(x, dt, tau):
    """The same lag as a plain loop, from rest at the first sample."""
    y = np.empty_like(x)
    y[0] = x[0]
    for k in range(1, len(x)):
        y[k] = y[k - 1] + (x[k] - y[k - 1]) * dt / (dt + tau)
    return y


# -- on a quantity --------------------------------------------------------------------------------


def test_an_effect_on_a_quantity_changes_it_by_hand_computation():
    found = load_cell.with_effect(curvature)(
        output=0.0, mass=2.0, zero=0.5, sensitivity=0.1, **{"curvature.k": 1e-3}
    )
    force = 2 * 9.80665
    assert found["force"].item() == pytest.approx(force + 1e-3 * force**2)
    assert found["reading"].item() == pytest.approx(0.5 + 0.1 * (force + 1e-3 * force**2))


def test_an_effect_on_the_angle_changes_the_rates_derived_from_it():
    @effect(on="angle")
    def imbalance(angle, *, size=param("rad")):
        return angle + size * sin(angle)

    t, w, size, r = np.linspace(0, 2, 41), 5.0, 0.1, 0.28
    quiet = wheel.having(offset=0.0, gain=1.0, misalignment=0.0, tilt=0.0, gravity=9.0)
    found = quiet.with_effect(imbalance)(
        t=t, v=np.zeros((41, 3)), speed=[w, 0, 0, 0], **{"imbalance.size": size}
    )
    angle = w * t  # and so angle' = wt + s·sin(wt): its rate is w(1 + s·cos(wt))
    rate = w * (1 + size * np.cos(angle))
    acceleration = -size * w**2 * np.sin(angle)
    expected = np.column_stack([r * rate**2, r * acceleration, np.full(41, 9.0)])
    np.testing.assert_allclose(found["reading"], expected, atol=1e-12)


def test_an_effect_reads_another_column_of_the_record():
    warm = load_cell.with_effect(warming)
    assert [s.name for s in warm.signals] == ["output", "mass", "temperature"]
    found = warm(output=0.0, mass=1.0, temperature=30.0, zero=0.0, **{"warming.drift": 0.2})
    assert found["reading"].item() == pytest.approx(0.1 * 9.80665 + 0.2 * 10.0)


def test_the_column_that_an_effect_reads_may_have_another_name():
    warm = load_cell.with_effect(warming, columns={"temperature": "housing"})
    assert [s.name for s in warm.signals] == ["output", "mass", "housing"]
    assert [p.name for p in warm.parameters][-1] == "warming(housing).drift"
    rng = np.random.default_rng(0)
    mass, housing = rng.uniform(0, 5, 40), rng.uniform(10, 40, 40)
    output = 0.3 + 0.1 * 9.80665 * mass + 0.02 * (housing - 20)
    found = attempt(warm, [run_of(np.arange(40.0), output=output, mass=mass, housing=housing)])
    assert found.values["warming(housing).drift"] == pytest.approx(0.02, abs=1e-10)


def test_two_effects_on_one_quantity_act_in_the_order_of_their_addition():
    @effect(on="force")
    def doubling(force, *, m=param()):
        return force * (1 + m)

    both = load_cell.with_effect(curvature).with_effect(doubling)
    numbers = {"curvature.k": 1e-3, "doubling.m": 1.0, "zero": 0.0, "sensitivity": 1.0}
    force = 2 * 9.80665
    found = both(output=0.0, mass=2.0, **numbers)["reading"].item()
    assert found == pytest.approx(2 * (force + 1e-3 * force**2))


def test_two_effects_at_once_are_both_recovered():
    both = load_cell.with_effect(curvature).with_effect(warming)
    rng = np.random.default_rng(1)
    mass, temperature = rng.uniform(0, 5, 60), rng.uniform(10, 40, 60)
    force = 9.80665 * mass
    output = 0.3 + 0.1 * (force + 2e-3 * force**2) + 0.02 * (temperature - 20)
    run = run_of(np.arange(60.0), output=output, mass=mass, temperature=temperature)
    found = attempt(both, [run])
    assert found.values["curvature.k"] == pytest.approx(2e-3, rel=1e-8)
    assert found.values["warming.drift"] == pytest.approx(0.02, rel=1e-8)


def test_an_effect_starts_at_its_null_value_and_changes_nothing_there():
    v = np.zeros((5, 3))
    t = np.linspace(0, 1, 5)
    bent = wheel.with_effect(quadratic)
    np.testing.assert_array_equal(bent["quadratic.k"].start_value(), np.zeros(3))
    np.testing.assert_allclose(bent(t=t, v=v)["reading"], wheel(t=t, v=v)["reading"], atol=1e-14)


@pytest.mark.parametrize("word", ["null", "typical", "profile", "plain"])
def test_a_size_given_for_no_parameter_is_named(word):
    with pytest.raises(DeclarationError, match=f"{word}= names 'kk', .* it has k"):

        @effect(on="reading", **{word: {"kk": 1.0}})
        def bent(y, *, k=param("1")):
            return y + k * y


def test_a_null_value_other_than_zero_is_stated_and_used_as_start():
    @effect(on="reading", null={"factor": 1.0})
    def stretch(reading, *, factor=param()):
        return factor * reading

    assert chain.with_effect(stretch)["stretch.factor"].start_value() == 1.0


def test_an_effect_that_does_not_vanish_at_its_null_value_is_refused():
    @effect(on="reading")
    def stretch(reading, *, factor=param()):
        return factor * reading

    with pytest.raises(DeclarationError) as refused:
        chain.with_effect(stretch)
    text = str(refused.value)
    assert "effect stretch is not null at factor = 0" in text
    assert "null={…}" in text


def test_an_effect_on_what_the_model_does_not_have_is_not_applicable():
    with pytest.raises(UsageError) as refused:
        chain.with_effect(quadratic)
    text = str(refused.value)
    assert "effect quadratic is not applicable to model chain" in text
    assert "'specific_force'" in text
    assert "u, reading" in text


def test_an_effect_may_be_put_on_another_quantity_by_name():
    moved = chain.with_effect(curvature, on="u")
    assert [p.name for p in moved.parameters][-1] == "curvature@u.k"


def test_the_same_effect_twice_is_refused():
    with pytest.raises(UsageError, match="already has the effect quadratic"):
        wheel.with_effect(quadratic).with_effect(quadratic)


def test_an_undeclared_name_in_an_effect_is_refused_with_effect_and_name():
    @effect(on="reading")
    def typo(reading, *, k=param()):
        return reading + kk * reading  # noqa: F821

    with pytest.raises(DeclarationError) as refused:
        chain.with_effect(typo)
    assert "typo" in str(refused.value)
    assert "'kk'" in str(refused.value)


def test_an_effect_that_changes_the_shape_of_its_quantity_is_refused_by_name():
    @effect(on="reading")
    def threefold(reading, *, k=param(3)):
        return reading + k

    with pytest.raises(DeclarationError, match="threefold"):
        _ = chain.with_effect(threefold).traced


def test_an_effects_parameter_in_an_unknown_unit_is_refused():
    @effect(on="reading")
    def shifted(reading, *, k=param("voltage")):
        return reading + k

    with pytest.raises(UnitError, match="effect shifted: k has unknown unit 'voltage'"):
        chain.with_effect(shifted)


def test_an_effect_needs_something_to_act_on():
    with pytest.raises(DeclarationError, match="effect nothing: its first argument is what"):

        @effect(on="reading")
        def nothing(*, k=param()):
            return k


def test_an_effects_own_arguments_must_be_declared():
    with pytest.raises(DeclarationError, match="effect odd: k must be param"):

        @effect(on="reading")
        def odd(reading, *, k="1"):
            return reading


# -- on a signal ----------------------------------------------------------------------------------


def test_a_delay_shifts_the_readings_and_the_derivatives_with_them():
    t, delay = np.linspace(0.2, 2, 37), 0.05
    late = wheel.with_effect(time_delay)
    numbers = {"speed": [5.0, 1.0, 0.0, 0.0], "phase": 0.3}
    v = np.zeros((37, 3))
    found = late(t=t, v=v, **numbers, **{"time_delay.delay": delay})["reading"]
    expected = wheel(t=t - delay, v=v, **numbers)["reading"]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_delay_of_a_known_drive_is_recovered():
    @model
    def oscillation(t=signal("s"), y=signal("V"), *, size=param("V", start=1.0)):
        return Residual(measured=y, predicted=quantity("reading", size * sin(7 * t), "V"))

    rng = np.random.default_rng(0)
    y = 1.3 * np.sin(7 * (TIME - 0.02)) + 0.01 * rng.standard_normal(N)
    found = attempt(oscillation.with_effect(time_delay), [run_of(t=TIME, y=y)])
    error = found.values["time_delay.delay"] - 0.02
    assert abs(error) < 4 * found.std["time_delay.delay"]
    # ∂y/∂delay = −7·1.3·cos(…): σ/(9.1·√(N/2))
    assert found.std["time_delay.delay"] == pytest.approx(0.01 / (9.1 * np.sqrt(N / 2)), rel=0.1)


def test_an_effect_on_the_measured_signal_changes_the_residual_only():
    @effect(on="y")
    def creep(y, *, k=param("1/V")):
        return y + k * y**2

    found = chain.with_effect(creep)(t=0.0, y=2.0, x=1.0, gain=1.0, **{"creep.k": 0.1})
    assert found["predicted"].item() == 1.0
    assert found["residual"].item() == pytest.approx(2.0 + 0.4 - 1.0)


def test_two_effects_on_one_signal_act_in_the_order_of_their_addition():
    @effect(on="x")
    def shift(x, *, k=param("V")):
        return x + k

    @effect(on="x")
    def stretch(x, *, m=param()):
        return x * (1 + m)

    both = chain.with_effect(shift).with_effect(stretch)
    found = both(t=0.0, y=0.0, x=2.0, gain=1.0, **{"shift.k": 1.0, "stretch.m": 1.0})
    assert found["predicted"].item() == (2.0 + 1.0) * 2


def test_where_all_readings_cannot_be_late_it_is_said_what_can_be():
    with pytest.raises(UsageError, match=r"late: signal_lag\(reference\)$"):
        find_model("linear").with_effect(time_delay)


def test_a_signal_effect_on_a_signal_that_the_body_does_not_use_is_not_applicable():
    with pytest.raises(UsageError, match="not applicable"):
        chain.with_effect(time_delay)


# -- on the noise ---------------------------------------------------------------------------------


TRUE_LINE = (("gain", 2.0), ("bias", 0.5))


def line_fit(effects, noise, seed):
    rng = np.random.default_rng(seed)
    x = np.linspace(-1, 1, 80)
    y = 0.5 + 2.0 * x + noise(rng, 80)
    # A start that is computed: no others around it are tried.
    declared = chain.starting(lambda declared, runs: {})
    for added in effects:
        declared = declared.with_effect(added)
    run = run_of(np.arange(80.0), t=np.arange(80.0), y=y, x=x)
    return attempt(declared, [run], solver="trust-region")


def contaminated(rng, n):
    noise = 0.1 * rng.standard_normal(n)
    noise[rng.choice(n, 8, replace=False)] += 5.0
    return noise


def test_students_weights_give_an_estimate_that_outliers_do_not_move():
    plain, robust = line_fit([], contaminated, 3), line_fit([student], contaminated, 3)
    assert abs(plain.values["bias"] - 0.5) > 0.3  # 8 of 80 shifted by 5: half a volt
    assert abs(robust.values["bias"] - 0.5) < 0.05


def test_the_fixed_point_of_students_weights_solves_the_weighted_equations():
    found = line_fit([student], contaminated, 5)
    run = found.problem.runs[0]
    r = (run.signals["y"] - found.values["bias"] - found.values["gain"] * run.signals["x"]).ravel()
    scale = np.median(np.abs(r)) / 0.6745
    w = 5 / (4 + (r / scale) ** 2)
    for column in (np.ones(80), run.signals["x"].ravel()):
        assert abs(np.sum(w * r * column)) < 1e-4 * np.sum(w * np.abs(r))


def gaussian(rng, n):
    return 0.1 * rng.standard_normal(n)


@pytest.mark.parametrize("records", [12, pytest.param(40, marks=pytest.mark.long)])
def test_the_printed_std_under_students_weights_is_the_empirical_one_for_gaussian_noise(records):
    fits = [line_fit([student], gaussian, seed) for seed in range(records)]
    z = np.array([[f.values[p] - true, f.std[p]] for f in fits for p, true in TRUE_LINE])
    ratio = np.sqrt(np.mean((z[:, 0] / z[:, 1]) ** 2))
    assert abs(ratio - 1) < 4 / np.sqrt(2 * len(z))  # χ² with two degrees of freedom a record


def test_an_effect_on_the_noise_must_weigh_one_at_its_null_value():
    with pytest.raises(DeclarationError, match="effect outliers is not null at bend = 0"):
        chain.with_effect(outliers)


# -- on the sequence of samples -------------------------------------------------------------------


def filtered_run(tau=0.05, noise=1e-3, seed=0, n=N):
    rng = np.random.default_rng(seed)
    t = np.arange(n) * DT
    y = lagged(0.1 + 1.2 * drive(t), DT, tau) + noise * rng.standard_normal(n)
    return run_of(t, t=t, y=y, x=drive(t))


def test_a_low_pass_is_recovered_from_an_independently_filtered_record():
    found = attempt(chain.with_effect(low_pass), [filtered_run()])
    assert found.certificate.trusted
    for name, true in (("gain", 1.2), ("bias", 0.1), ("low_pass.tau", 0.05)):
        assert abs(found.values[name] - true) < 4 * found.std[name]
        assert found.std[name] < 1e-3


def test_the_jacobian_of_a_sequence_agrees_with_finite_differences():
    problem = Problem(chain.with_effect(low_pass), (filtered_run(n=700),))  # more than one chunk
    point = problem.point({"gain": 1.1, "bias": 0.2, "low_pass.tau": 0.04})

    def residuals(x):
        return problem.residuals(type(point)(x, point.references))[0].ravel()

    steps = 1e-6 * np.eye(3)
    numeric = np.column_stack(
        [(residuals(point.x + h) - residuals(point.x - h)) / 2e-6 for h in steps]
    )
    np.testing.assert_allclose(problem.jacobian(point), numeric, atol=1e-8)
    gradient = numeric.T @ residuals(point.x)
    np.testing.assert_allclose(problem.normal(point).gradient, gradient, rtol=1e-6)


def test_the_residual_of_a_sequence_is_that_of_a_plain_loop():
    run = filtered_run(n=700, noise=0.0)
    problem = Problem(chain.with_effect(low_pass), (run,))
    point = problem.point({"gain": 1.2, "bias": 0.1, "low_pass.tau": 0.05})
    np.testing.assert_allclose(problem.residuals(point)[0], 0, atol=1e-13)


def test_a_gap_in_time_starts_the_sequence_anew():
    from dataclasses import replace

    whole = filtered_run(n=200, noise=0.0)
    t = np.concatenate([whole.time[:100], whole.time[100:] + 5.0])
    x = whole.signals["x"].ravel()
    parts = [lagged(0.1 + 1.2 * part, DT, 0.05) for part in (x[:100], x[100:])]
    signals = {"t": t[:, None], "y": np.concatenate(parts)[:, None], "x": x[:, None]}
    run = replace(whole, signals=signals, time=t, block=np.repeat([0, 1], 100))
    problem = Problem(chain.with_effect(low_pass), (run,))
    point = problem.point({"gain": 1.2, "bias": 0.1, "low_pass.tau": 0.05})
    np.testing.assert_allclose(problem.residuals(point)[0], 0, atol=1e-13)


def test_an_effect_on_the_sequence_reads_another_column():
    @effect(on="reading", kind="sequence")
    def warm_lag(value, previous, dt, temperature=signal(), *, tau=param("s"), c=param()):
        return previous + (value - previous) * dt / (dt + tau * (1 + c * temperature))

    x, warm = drive(), 5 * np.sin(TIME)
    y = np.empty(N)
    y[0] = x[0]
    for k in range(1, N):
        y[k] = y[k - 1] + (x[k] - y[k - 1]) * DT / (DT + 0.05 * (1 + 0.1 * warm[k]))
    run = run_of(t=TIME, y=y, x=x, temperature=warm)
    found = attempt(chain.with_effect(warm_lag), [run], start={"warm_lag.tau": 0.03})
    assert found.values["warm_lag.tau"] == pytest.approx(0.05, rel=1e-6)
    assert found.values["warm_lag.c"] == pytest.approx(0.1, rel=1e-6)


def test_a_sequence_and_a_changed_reading_act_both():
    @effect(on="y")
    def creep(y, *, k=param("1/V")):
        return y + k * y**2

    run = filtered_run()
    problem = Problem(chain.with_effect(low_pass).with_effect(creep), (run,))
    at = {"gain": 1.2, "bias": 0.1, "low_pass.tau": 0.05}
    without = problem.residuals(problem.point({**at, "creep.k": 0.0}))[0]
    present = problem.residuals(problem.point({**at, "creep.k": 0.3}))[0]
    np.testing.assert_allclose(present - without, 0.3 * run.signals["y"] ** 2, atol=1e-12)


def test_a_model_with_a_sequence_is_evaluated_with_it_or_refuses():
    run = filtered_run(noise=0.0)
    numbers = {"gain": 1.2, "bias": 0.1, "low_pass.tau": 0.05}
    try:
        found = chain.with_effect(low_pass)(**run.signals, **numbers)
    except UsageError:
        return
    np.testing.assert_allclose(found["residual"], 0, atol=1e-12)


def test_correcting_a_sequence_undoes_it_or_refuses():
    run = filtered_run(noise=0.0)
    numbers = {"gain": 1.2, "bias": 0.1, "low_pass.tau": 0.05}
    try:
        found = Correction(chain.with_effect(low_pass))(run, numbers)
    except UsageError:
        return
    np.testing.assert_allclose(found, 1.2 * run.signals["x"], atol=1e-9)


def test_a_second_effect_on_the_sequence_acts_on_what_the_first_gives():
    @effect(on="reading", kind="sequence")
    def slow(value, previous, dt, *, tau=param("s", bounds=(0.0, 10.0))):
        return previous + (value - previous) * dt / (dt + tau)

    twice = lagged(lagged(0.1 + 1.2 * drive(), DT, 0.05), DT, 0.2)
    problem = Problem(
        chain.with_effect(low_pass).with_effect(slow), (run_of(t=TIME, y=twice, x=drive()),)
    )
    at = {"gain": 1.2, "bias": 0.1, "low_pass.tau": 0.05, "slow.tau": 0.2}
    np.testing.assert_allclose(problem.residuals(problem.point(at))[0], 0, atol=1e-13)


def test_a_sequence_may_act_before_the_prediction():
    y = 0.1 + np.exp(lagged(1.2 * drive(), DT, 0.05))

    @model
    def bent(y=signal("V"), x=signal("V"), *, gain=param(start=1.0), bias=param("V")):
        u = quantity("u", gain * x, "V")
        return Residual(measured=y, predicted=bias + exp(u), corrected=u)

    problem = Problem(bent.with_effect(low_pass, on="u"), (run_of(y=y, x=drive()),))
    at = {"gain": 1.2, "bias": 0.1, "low_pass@u.tau": 0.05}
    np.testing.assert_allclose(problem.residuals(problem.point(at))[0], 0, atol=1e-13)


def test_a_sequence_without_time_asks_for_it():
    from casest import DataError

    @model
    def timeless(y=signal("V"), x=signal("V"), *, gain=param(start=1.0)):
        return Residual(measured=y, predicted=quantity("reading", gain * x, "V"))

    run = Run.raw("r", {"y": drive()[:, None], "x": drive()[:, None]}, units={})
    with pytest.raises(DataError, match="give a time column or --rate"):
        attempt(timeless.with_effect(low_pass), [run])
