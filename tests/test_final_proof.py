"""What the last proof speaks against: the cause at fault goes, not the one that came last."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from casest import Run, attempt
from casest.diagnose.evidence.likelihood import Likelihood
from casest.diagnose.evidence.score import judged
from casest.diagnose.protocol.state import Kept, State
from casest.diagnose.sensor import Sensor
from casest.diagnose.sensor.final import NO_SIZE, certified, left_in
from casest.effects import CATALOGUE
from casest.effects.placing import prepared
from casest_problems.one_channel import linear, polynomial


def record(signals, t, warm):
    run = Run.raw("r", signals, units={"reference": "V", "reading": "V"}, time=t)
    run = replace(run, columns={"warm": warm}, column_units={"warm": "degC"})
    return prepared(linear, [run])


@pytest.fixture(scope="module")
def searched():
    """A search's subject, its fit, causes by name and the estimate, of a line with a square, a
    drift and an offset over temperature; and the same record in which no temperature changes."""
    rng = np.random.default_rng(0)
    t = 0.1 * np.arange(400.0)
    x, warm = rng.uniform(-1, 1, 400), np.sin(0.3 * t)
    y = 0.2 + 1.1 * x + 0.01 * t + 0.3 * x**2 + 0.05 * warm + 0.01 * rng.standard_normal(400)
    signals = {"reference": x[:, None], "reading": y[:, None]}
    sensor = Sensor(linear, record(signals, t, warm), CATALOGUE)
    still = {**sensor.runs[0].signals, "warm": np.zeros((400, 1))}
    cold = Sensor(linear, (replace(sensor.runs[0], signals=still),), CATALOGUE)
    before = attempt(linear, sensor.runs)
    fit = sensor.fitted(before.model, before.values)
    trials = {t.family: t for t in sensor.trials(fit) if not t.what.held}
    return sensor, cold, fit, trials, before


def kept_of(sensor, fit, trial):
    likelihood = Likelihood(sensor.linear(fit))
    return Kept(trial.what, judged([trial], likelihood, likelihood.beside()), {})


def begun(searched, *names):
    """A state in which these causes were added."""
    sensor, _, fit, trials, _ = searched
    kept = tuple(kept_of(sensor, fit, trials[n]) for n in names)
    return State(sensor.refit(fit, [trials[n] for n in names]), kept)


def test_a_cause_goes_that_the_data_do_not_determine_though_another_came_last(searched):
    _, cold, _, _, before = searched
    state = begun(searched, "temperature_bias(warm)", "bias_drift", "quadratic")
    state, after = certified(cold, state, before)
    assert [k.what.label for k in state.kept] == ["bias_drift", "quadratic"]
    assert after.certificate.trusted
    # Of the reference, which the gain multiplies.
    assert after.values["quadratic.k"] == pytest.approx(0.3 / 1.1, abs=0.01)
    ((refused, why),) = [(r.what.label, r.why) for r in state.refused]
    assert refused == "temperature_bias(warm)"
    assert "temperature_bias(warm).k" in why


def test_what_takes_the_place_of_a_cause_does_not_bring_back_another_that_has_gone(searched):
    sensor, _, _, trials, _ = searched
    three = begun(searched, "temperature_bias(warm)", "bias_drift", "quadratic")
    drift = next(k.what for k in three.kept if k.what.label == "bias_drift")
    seen = sensor.instead(three.fit, drift, [trials["cubic"]])
    two = sensor.without(three.fit, three.kept[0].what)
    found = sensor.replaced(two, drift, trials["cubic"].what, seen)
    assert [a.label for a in found.model.effects] == ["quadratic", "cubic"]
    # Where nothing has gone it is the fit that was seen.
    assert sensor.replaced(three.fit, drift, trials["cubic"].what, seen) is seen


def test_what_the_last_fit_makes_nothing_of_is_not_kept(searched):
    """No cube is in the record, whatever had spoken for one."""
    sensor, _, _, _, before = searched
    state = begun(searched, "cubic", "quadratic", "bias_drift")
    assert (
        abs(state.fit.values["cubic.k"])
        < 2 * attempt(state.fit.model, sensor.runs, start=state.fit.values).plain["cubic.k"]
    )
    state, after = certified(sensor, state, before)
    assert [k.what.label for k in state.kept] == ["quadratic", "bias_drift"]
    assert [(r.what.label, r.why) for r in state.refused] == [("cubic", NO_SIZE)]
    assert "cubic.k" not in after.values


def test_with_a_cause_goes_the_lag_of_a_column_that_it_alone_read(searched):
    sensor, _, fit, trials, _ = searched
    lag = next(e for e in CATALOGUE if e.name == "signal_lag")
    model = trials["temperature_bias(warm)"].what.added_to(fit.model)
    model = model.with_effect(lag, on="warm")
    with_lag = sensor.fitted(model, {**fit.values, "temperature_bias(warm).k": np.array(0.05)})
    both = begun(searched, "temperature_bias(warm)")
    late = replace(both.kept[0].what, effect=lag, declared_on="warm", columns=())
    state = State(with_lag, (*both.kept, replace(both.kept[0], what=late)))
    less = sensor.without(with_lag, both.kept[0].what)
    assert less.model.effects == ()
    assert left_in(state, less).kept == ()


@pytest.mark.parametrize("seed", [4, 5, 10])
def test_a_cause_goes_whose_place_a_later_one_has_taken(seed):
    """Two slow columns that go together beside a slow course of unknown cause: as if that were
    white noise each is many standard deviations, by what is printed the first is none."""
    rng, t = np.random.default_rng([7, seed]), 0.1 * np.arange(800.0)
    kicks, slow = 0.01 * rng.standard_normal(800), np.zeros(800)
    for k in range(1, 800):
        slow[k] = np.exp(-1 / 150) * slow[k - 1] + kicks[k]
    x, warm, warmer = rng.uniform(-1, 1, 800), np.sin(0.15 * t), np.sin(0.15 * t + 0.25)
    y = 0.2 + 1.1 * x + 0.2 * warmer + slow + 0.01 * rng.standard_normal(800)
    (run,) = record({"reference": x[:, None], "reading": y[:, None]}, t, warm)
    run = replace(run, columns={"warm": warm, "warmer": warmer}, signals={
        name: v for name, v in run.signals.items() if name in ("reference", "reading", "t")
    })  # fmt: skip
    run = replace(run, column_units={"warm": "degC", "warmer": "degC"})
    sensor = Sensor(linear, prepared(linear, [run]), CATALOGUE)
    before = attempt(linear, sensor.runs)
    fit = sensor.fitted(before.model, before.values)
    trials = {t.family: t for t in sensor.trials(fit) if not t.what.held}
    names = [f"temperature_bias({column})" for column in ("warm", "warmer")]
    both = sensor.refit(fit, [trials[n] for n in names])
    found = attempt(both.model, sensor.runs)
    k = f"{names[0]}.k"
    assert abs(found.values[k]) > 3 * found.plain[k]
    assert abs(found.values[k]) < 2 * found.std[k]
    kept = tuple(kept_of(sensor, fit, trials[n]) for n in names)
    state, after = certified(sensor, State(both, kept), before)
    assert [one.what.label for one in state.kept] == names[1:]
    assert k not in after.values
    ((_, why),) = [(r.what.label, r.why) for r in state.refused]
    assert why == NO_SIZE


def test_a_freed_constant_goes_like_an_effect_where_it_may_be_as_declared():
    """No quartic is in the record, whatever had spoken for one: it stayed, beside a p of another
    fit."""
    rng, x = np.random.default_rng(4), np.linspace(-1, 1, 200)
    y = 0.2 + 1.1 * x + 0.3 * x**2 + 0.01 * rng.standard_normal(200)
    run = Run.raw("r", {"reference": x[:, None], "reading": y[:, None]}, units={})
    sensor = Sensor(polynomial, prepared(polynomial, [run]), CATALOGUE)
    before = attempt(polynomial, sensor.runs)
    fit = sensor.fitted(before.model, before.values)
    trial = next(t for t in sensor.trials(fit) if t.what.freed == "quartic")
    state = State(sensor.refit(fit, [trial]), (kept_of(sensor, fit, trial),))
    state, after = certified(sensor, state, before)
    assert state.kept == ()
    assert [(r.what.label, r.why) for r in state.refused] == [("quartic", NO_SIZE)]
    assert "quartic" not in after.values
