"""A command that is held to its last digit has no noise of its own."""

from __future__ import annotations

import numpy as np
import pytest

from casest import calibrate, close
from casest.diagnose.noise.of_inputs import most_where_held, noise_of_inputs

TAU, GAIN = 0.26, 1.6


def driven(rng, path, rows=340):
    """A robot's speed behind a joystick at 20 Hz, at a new place in two rows of five; between
    two stamps it is a line. Beside it noise with a memory of four rows."""
    new = np.concatenate([[True], rng.uniform(size=rows - 1) < 0.4])
    places = np.clip(0.45 * rng.standard_normal(rows), -1, 1)
    command = np.round(places[np.maximum.accumulate(np.where(new, np.arange(rows), 0))], 6)
    speed, noise, seen = 0.0, 0.0, np.empty(rows)
    for k in range(rows):
        for u in np.linspace(command[max(k - 1, 0)], command[k], 100):
            speed += (GAIN * u - speed) * 0.0005 / TAU
        noise = 0.8 * noise + 0.6 * 0.05 * rng.standard_normal()
        seen[k] = speed + noise
    np.savetxt(path, np.column_stack([0.05 * np.arange(rows), command, seen]), delimiter=",",
               header="t [s],reference,reading", comments="", fmt="%.6f")  # fmt: skip
    return path


def test_a_command_is_under_no_suspicion_of_noise(tmp_path):
    """Its jumps were, and what follows them slowly was refused as what makes noise less."""
    found = calibrate("linear", driven(np.random.default_rng(0), tmp_path / "log.csv"))
    problem, point = found.problem, found.point
    residual = np.concatenate(problem.residuals(point))
    ((name, size),) = noise_of_inputs(problem, point, residual, [slice(0, len(residual))])
    assert name == "reference"
    assert size < 1e-4
    # Its third differences alone would allow for as much as it moves.
    moved = np.diff(problem.runs[0].signals["reference"], 3, axis=0)
    assert np.median(np.abs(moved)) > 0.1


@pytest.mark.long
def test_what_follows_a_command_slowly_is_found(tmp_path):
    found = close("linear", driven(np.random.default_rng(0), tmp_path / "log.csv"))
    (effect,) = found.effects
    assert {effect.candidate.label, *effect.indistinguishable_from} >= {"low_pass"}
    assert float(found.after.values["gain"]) == pytest.approx(GAIN, rel=0.1)


@pytest.mark.parametrize(("noise", "step"), [(0.1, 0.3), (0.2, 0.5), (1.0, 2.5)])
def test_noise_of_what_repeats_is_less_than_is_said(noise, step):
    """A slow course with noise, rounded so that half of the rows repeat the one before."""
    rng = np.random.default_rng(5)
    course = 3 * np.sin(0.01 * np.arange(4000)) + noise * rng.standard_normal(4000)
    x = step * np.round(course / step)
    most = most_where_held(x[:, None])
    assert noise <= most <= step
    assert np.isinf(most_where_held(x[:, None] + rng.uniform(0, 1e-6, (4000, 1))))
