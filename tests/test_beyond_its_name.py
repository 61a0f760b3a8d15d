"""What a refit would have to be that is not what the effect's name says; what goes with it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from casest import Residual, Run, close, model, param, quantity, signal
from casest.diagnose.sensor.fits import fitted
from casest.diagnose.sensor.sensor import _less
from casest.diagnose.sensor.unlike import another
from casest.effects import channel_bias, creep, outliers, signal_lag


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_delay_is_no_creep_of_more_than_all_of_the_response(seed):
    """A reading behind a wandering reference by six samples: k = 1.6 imitates that."""
    rng = np.random.default_rng(seed)
    t = np.arange(1500.0)
    knots = rng.normal(0, 1, 340).cumsum()
    given = 10 + np.interp(t, 5.0 * np.arange(340), knots)
    late = 10 + np.interp(t - 6.0, 5.0 * np.arange(340), knots)
    reading = 0.5 + 1.4 * late + rng.normal(0, 0.1, len(t))
    closing = close("linear", {"t": t, "reference": given, "reading": reading})
    names = [e.candidate.label for e in closing.effects]
    assert "signal_lag(reference)" in names
    assert "creep" not in names
    assert closing.after.values["signal_lag(reference).delay"] == pytest.approx(6.0, abs=0.4)


@pytest.mark.long
@pytest.mark.parametrize("held", ["at the end", "throughout"])
def test_a_thermometer_that_is_late_as_a_whole_is_no_creep(held):
    """Heat arrives within 25 s, simulated in steps of a second: of the input that the step ends
    with, which answers half a second early, and of one that goes straight. Before: creep of 98 %.
    """
    rng, tau, steps = np.random.default_rng(5), 25.0, 1 if held == "at the end" else 50
    t = np.arange(1500.0)
    bath = 20 + 15.0 * (t > 100) - 10.0 * (t > 500) + 8 * np.sin(t / 48) * (t > 800)
    bead, keeps = np.full(len(t), 20.0), np.exp(-1 / steps / tau)
    for i in range(1, len(t)):
        bead[i] = bead[i - 1]
        for now in bath[i - 1] + (bath[i] - bath[i - 1]) * (np.arange(steps) + 1) / steps:
            bead[i] = now + (bead[i] - now) * keeps
    reading = 0.5 + 0.98 * bead + rng.normal(0, 0.05, len(t))
    closing = close("linear", {"t": t, "reference": bath, "reading": reading})
    names = {e.candidate.label for e in closing.effects}
    assert names == {"low_pass"} | ({"signal_lag(reference)"} if steps == 1 else set())
    assert closing.after.values["low_pass.tau"] == pytest.approx(tau, abs=0.2)


def staircase(seed: int, beyond: float) -> dict[str, np.ndarray]:
    """A reading of 150 inputs that above 40 answers with so much of its gain."""
    rng = np.random.default_rng(seed)
    given = np.linspace(10, 55, 150)
    response = np.where(given > 40, 40 + beyond * (given - 40), given)
    return {"reference": given, "reading": 0.3 + 1.01 * response + rng.normal(0, 0.05, 150)}


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_gain_that_bends_is_no_saturation(seed):
    """It loses a twentieth of its gain: nothing is cut off, and nothing is compressed."""
    closing = close("linear", staircase(seed, beyond=0.95))
    assert "saturation" not in [e.candidate.label for e in closing.effects]
    assert closing.verdict != "adequate"
    assert "saturation" not in (closing.undecided.names if closing.undecided else ())
    assert any("another effect" in d.reason for d in closing.refused)


@pytest.mark.parametrize("beyond", [0.0, 0.2])
def test_what_is_cut_off_or_compressed_is(beyond):
    closing = close("linear", staircase(1, beyond))
    assert [e.candidate.label for e in closing.effects] == ["saturation"]


def test_a_ramp_that_never_turns_shows_no_play():
    """A wheel that stands still below some command, on a ramp of commands from end to end."""
    rng = np.random.default_rng(4)
    t, command = np.arange(110.0), np.linspace(-540, 550, 110)
    still = (command > -30) & (command < 160)
    reading = np.where(still, 0.0, 15 + 0.97 * command) + rng.normal(0, 3, 110)
    closing = close("linear", {"t": t, "reference": command, "reading": reading})
    assert "hysteresis" not in [e.candidate.label for e in closing.effects]


@model
def line(x=signal("V"), y=signal("V"), *, slope=param(start=1.0), level=param("V")):
    """A reading over its input."""
    return Residual(measured=y, predicted=quantity("reading", level + slope * x, "V"))


def test_with_an_effect_goes_what_acts_on_a_column_that_it_alone_brought():
    """Not what acts on the noise, or on a signal of the model."""
    rng, t = np.random.default_rng(5), np.arange(300) * 0.01
    x, angle = rng.normal(0, 1, 300), np.sin(t)
    signals = {"x": x[:, None], "y": (1 + x + 0.2 * angle)[:, None], "angle": angle[:, None]}
    run = Run.raw("r", signals, units={"x": "V", "y": "V", "angle": "rad"}, time=t)
    bare = line.with_effect(outliers).with_effect(signal_lag, on="x")
    columns = {channel_bias.extras[0].name: "angle"}
    with_column = bare.with_effect(channel_bias, on="reading", columns=columns)
    fit = fitted(with_column.with_effect(signal_lag, on="angle"), (run,), {})
    label = with_column.effects[-1].label
    less = _less(fit, SimpleNamespace(label=label))
    assert [a.label for a in less.model.effects] == [a.label for a in bare.effects]
    assert set(less.values) == {p.name for p in less.model.parameters}


def test_a_creep_that_the_user_declared_is_the_user_s_word():
    model = line.with_effect(creep, on="reading")
    own = model.effects[-1].label
    values = {f"{own}.{n}": np.array([v]) for n, v in {"k": 1.3, "tau": 2.0}.items()}
    label, why = another(model, values, line)
    assert label == own
    assert "k = 1.3, above 0.9" in why
    assert another(model, values, model) == ("", "")
