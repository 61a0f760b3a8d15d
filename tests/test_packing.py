"""Steps of a linear model straight from the signals are those that matrices lead to."""

from __future__ import annotations

import numpy as np
import pytest
from test_course import record

from casest import Run, signal
from casest.dynamics import Motion, dynamics, measured, state
from casest.dynamics.discrete import Packed
from casest.dynamics.filter import discretised
from casest.dynamics.packing import packed
from casest.dynamics.transition import Pace, linearised
from casest_problems.bias_gravity import bias_gravity, bias_gravity_magnitude


@dynamics
def sledge(
    force=signal("m/s^2", held=True),
    gain=signal("1/s"),
    p=signal("m"),
    q=signal("m"),
    *,
    place=state("m", start=0.3),
    speed=state("m/s", start=1.0, intensity=1e-3),
    bias=state("m", start=-0.1, intensity=1e-6),
):
    """Pushed by steps, braked, and read twice, once with an offset that is known at each time."""
    rates = {"place": speed, "speed": force - gain * speed}
    outputs = (
        measured(p, place + bias, intensity=1e-3),
        measured(q, 2 * place + gain, intensity=1e-2),
    )
    return Motion(rates=rates, outputs=outputs)


def pushed(count=200):
    """A record with readings that are missing, one and all."""
    rng = np.random.default_rng(1)
    signals = {
        "force": rng.choice([-1.0, 2.0], (count, 1)),
        "gain": 1 + rng.uniform(0, 1, (count, 1)),
        "p": rng.standard_normal((count, 1)),
        "q": rng.standard_normal((count, 1)),
    }
    signals["p"][20:30] = np.nan
    signals["q"][25:40] = np.nan
    return Run.raw("pushed", signals, units={}, time=0.01 * np.arange(count))


@pytest.mark.parametrize(
    ("model", "run"),
    [
        pytest.param(bias_gravity, record(300), id="turning"),
        pytest.param(sledge, pushed(), id="held, missing"),
        pytest.param(sledge.driven(speed=0.0, bias=0.0), pushed(), id="driven by nothing"),
    ],
)
def test_they_are_those_of_the_matrices(model, run):
    pace = Pace.of(model, run)
    found = packed(model, run, pace)
    expected = Packed.of(discretised(model, linearised(model, run, pace=pace)))
    for name in ("Phi", "forced", "noise", "C", "R", "read"):
        ours, theirs = (getattr(own, name) for own in (found, expected))
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-14, err_msg=name)
    np.testing.assert_array_equal(found.present, expected.present)
    assert found.patterns == expected.patterns


def test_what_asks_for_more_is_left_to_matrices():
    """A gap, a fast motion, noise of inputs, a constraint; what no number holds."""
    run = pushed()
    late = np.asarray(run.time) + 5.0 * (np.arange(200) > 100)
    gap, fast, wild = (pushed() for _ in range(3))
    gap = Run.raw("gap", gap.signals, units={}, time=late)
    fast.signals["gain"][50] = 1e3
    wild.signals["force"][50] = 1e308
    assert packed(sledge, run, Pace.of(sledge, run)) is not None
    for model, own in (
        (sledge, gap),
        (sledge, fast),
        (sledge.sensing(gain=1e-3), run),
        (bias_gravity_magnitude, record(100)),
    ):
        assert packed(model, own, Pace.of(model, own)) is None
    wild.signals["gain"][:] = 10.0
    wild = Run.raw("wild", wild.signals, units={}, time=1e3 * np.asarray(wild.time))
    assert packed(sledge, wild, Pace.of(sledge, wild)) is None
