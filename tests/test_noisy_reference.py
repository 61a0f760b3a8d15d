"""A reference with noise where it moves: whatever averages its rows foretells the reading better.

A public log of a motor's velocity beside the rate of its position, of which stamps are stale now
and then, was a creep of 0.81 over one row (studies/strangers.md): at rest it has no noise, and its
calm rows told that it had none at all.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from casest import close

STEP, TAU = 0.004, 0.05
LONG = pytest.mark.long


def moved(rng, width, count=6000):
    """True rates, quick over `width` rows in half of the record and zero in the other, and those
    of positions that were read up to a row late in one row of ten."""
    rate = 5 * gaussian_filter1d(rng.standard_normal(count), width)
    rate *= np.sqrt(2 * np.sqrt(np.pi) * width)
    rate *= gaussian_filter1d(((np.arange(count) // 400) % 2 == 0).astype(float), 10)
    late = np.where(rng.uniform(size=count) < 0.1, 1.0, 0.05) * rng.uniform(size=count)
    positions = np.cumsum(rate) * STEP - late * STEP * rate
    return rate, np.gradient(positions, STEP)


def logged(path, rng, reference, response):
    reading = response + 0.02 * rng.standard_normal(len(response))
    table = np.column_stack([STEP * np.arange(len(reading)), reference, reading])
    np.savetxt(path, table, delimiter=",", header="t [s],reference,reading", comments="")
    return path


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "width"),
    [(3, 25), *(pytest.param(*case, marks=LONG) for case in ((0, 12), (1, 6), (2, 6)))],
)
def test_its_noise_is_no_cause(tmp_path, seed, width):
    """Nor a bend: what is far out of a reference is noise sooner than motion."""
    rng = np.random.default_rng(seed)
    rate, reference = moved(rng, width)
    noise = np.var(reference - rate)
    found = close("linear", logged(tmp_path / "log.csv", rng, reference, rate))
    assert not found.effects
    # It is said how much of what is left is that noise: nearly all, but for the reading's 0.02.
    assert 0.6 < found.averaged <= 1
    assert np.mean(np.concatenate(found.after_held_out) ** 2) > 0.8 * noise


@pytest.mark.long
@pytest.mark.parametrize(("seed", "width"), [(4, 12), (5, 25)])
def test_a_memory_beside_that_noise_is_found(tmp_path, seed, width):
    rng = np.random.default_rng(seed)
    rate, reference = moved(rng, width)
    slow, state = np.empty_like(rate), 0.0
    for k, value in enumerate(np.repeat(rate, 20)):  # Euler's steps, twenty a row
        state += (value - state) * STEP / 20 / TAU
        slow[k // 20] = state
    found = close("linear", logged(tmp_path / "log.csv", rng, reference, slow))
    named = {name for e in found.effects for name in (e.candidate.label, *e.indistinguishable_from)}
    assert "low_pass" in named
    assert len(found.effects) == 1


@pytest.mark.long
def test_gains_of_axes_are_no_noise_of_the_reference(tmp_path):
    """In waves of one pitch what each differs by from its neighbours is the wave once more."""
    rng = np.random.default_rng(6)
    t = 0.02 * np.arange(2000)
    u = np.stack([np.sin(9 * t), np.sin(9 * t + 1), np.sin(9 * t + 2)], axis=1)
    v = u * [1.02, 0.99, 0.99] + 0.003 * rng.standard_normal(u.shape)
    path, model = tmp_path / "waves.csv", tmp_path / "three.py"
    head = "t [s],u_x,u_y,u_z,v_x,v_y,v_z"
    np.savetxt(path, np.column_stack([t, u, v]), delimiter=",", header=head, comments="")
    model.write_text(
        "from casest import Residual, model, param, quantity, signal\n\n\n"
        "@model\n"
        'def three(u=signal(3, "uT"), v=signal(3, "uT"), *, gain=param(start=1.0)):\n'
        '    true = quantity("true", u)\n'
        "    return Residual(measured=v, predicted=gain * true, corrected=true)\n",
        encoding="utf-8",
    )
    found = close(str(model), path)
    assert found.averaged < 0.5
    named = {name for e in found.effects for name in (e.candidate.label, *e.indistinguishable_from)}
    assert named & {"axis_gain", "soft_iron", "gain_matrix"}


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_command_that_is_never_still_has_no_noise_that_a_motor_averages(seed):
    """A controller's output and a motor's speed, 50 ms behind: all of what the low pass explains
    was said to be noise of the command (p = 1), which is none: rows after a reading tell nothing
    of it."""
    rng, n, fine = np.random.default_rng([50, seed]), 3000, 10
    slow = lfilter([1], [1, -0.98], rng.standard_normal(n))
    command = 0.5 + 0.02 * slow + 0.05 * lfilter([1], [1, -0.3], rng.standard_normal(n))
    held, share = np.repeat(command, fine), np.exp(-0.01 / fine / 0.05)
    speed = lfilter([1 - share], [1, -share], held, zi=[share * held[0]])[0][::fine]
    speed = 300 + 900 * speed + 3 * rng.standard_normal(n)
    found = close("linear", {"t": 0.01 * np.arange(n), "reference": command, "reading": speed})
    assert "low_pass" in {e.candidate.label for e in found.effects}
    assert found.after.values["low_pass.tau"] == pytest.approx(0.05, rel=0.05)
    assert found.after.values["gain"] == pytest.approx(900, rel=0.01)  # 700 without
