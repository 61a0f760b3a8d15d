"""What a column is by its values and its unit: two values bend nothing, seconds are not warm."""

from __future__ import annotations

import numpy as np
import pytest

from casest import close, load_runs
from casest.diagnose.candidates.candidates import channels_of
from casest.effects.placing import prepared
from casest_problems.one_channel import linear, polynomial


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_a_column_of_two_values_has_no_curve(seed):
    """A gap sensor, up and down: the curve over the direction was the rival of its offset."""
    rng, gaps = np.random.default_rng([88, seed]), np.repeat(np.arange(1, 9.0), 5)
    x, down = np.r_[gaps, gaps[::-1]], np.repeat([0.0, 1.0], 40)
    y = 1273 - 77 * x + 2.1 * x**2 - 19 * down + 3 * np.sin(2.1 * x)
    y += 5 * rng.standard_normal(80)
    found = close(polynomial, {"reference": x, "reading": y, "direction": down})
    (cause,) = found.effects
    assert cause.candidate.label == "channel_bias(direction)"
    assert not any("curve" in name for name in cause.indistinguishable_from)
    why = {s.name: s.reason for s in found.skipped}
    assert "two values" in why["channel_curve(direction)"]


@pytest.mark.parametrize(
    ("head", "warm"),
    [("tempo [s]", False), ("tempo", True), ("temp [degC]", True), ("board [K]", True)],
)
def test_a_unit_says_what_is_no_temperature(tmp_path, head, warm):
    rows = np.c_[np.arange(20.0), 2 * np.arange(20.0) % 7, np.arange(20.0) ** 2 % 11]
    path = tmp_path / "r.csv"
    np.savetxt(path, rows, delimiter=",", header=f"reference,reading,{head}", comments="")
    runs = prepared(linear, load_runs([str(path)], linear.signals))
    assert channels_of(linear, runs)[0] == {head.partition(" ")[0]: warm}


def test_two_rows_at_each_end_of_a_table_are_an_end_of_the_range():
    """A servo's speed over its pulse: with two rows beyond each end, no level was looked for."""
    rng, pulse = np.random.default_rng(3), np.r_[-1.6, -1.4, np.linspace(-1, 1, 17), 1.4, 1.6]
    speed = np.clip(1.2 * pulse, -1.25, 1.25) + 0.01 * rng.standard_normal(21)
    found = close(linear, {"reference": pulse, "reading": speed})
    assert [e.candidate.label for e in found.effects] == ["saturation"]
    assert found.after.values["saturation.level"] == pytest.approx(1.25, abs=0.02)
    assert found.after.values["gain"] == pytest.approx(1.2, abs=0.02)
