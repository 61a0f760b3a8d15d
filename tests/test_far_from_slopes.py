"""What slopes at nothing say little of, and what a few rows of a long record say too much of."""

from __future__ import annotations

import numpy as np
import pytest

from casest import close


def bath(seed, rows=1500, tau=200.0, step=5.0):
    """A thermometer put from air into a bath that warms slowly, late by minutes, at one moment
    alone: by exact steps of the first-order law between readings of a held bath."""
    rng, t = np.random.default_rng([20261129, seed]), step * np.arange(rows)
    met = np.where(t < 60, 23.0, 70.0) + 25 * np.clip((t - 60) / 7000, 0, 1) + 0.5 * np.sin(t / 900)
    late, share = np.full(rows, met[0]), np.exp(-step / tau)
    for k in range(1, rows):
        # In between the bath goes straight.
        slope = (met[k] - met[k - 1]) / step
        late[k] = met[k] - slope * tau + share * (late[k - 1] - met[k - 1] + slope * tau)
    return {
        "t": t,
        "reference": met + rng.normal(0, 0.02, rows),
        "reading": 5 + 0.7 * late + rng.normal(0, 0.05, rows),
    }


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
def test_a_lag_of_many_samples_that_one_jump_shows_is_found(seed):
    """Before, cubic, or only "unexplained": the slope of a lag of nothing is the jump's own."""
    closing = close("linear", bath(seed))
    assert [e.candidate.label for e in closing.effects] == ["low_pass"]
    assert closing.after.values["low_pass.tau"] == pytest.approx(200, rel=0.02)
    assert closing.after.values["gain"] == pytest.approx(0.7, rel=0.01)


def dyno(seed, rows=340):
    """Torque on current at ten levels each, and two rows of a fault at the end, which a column that
    has no influence shows as well."""
    rng = np.random.default_rng([20261130, seed])
    current = np.repeat(rng.uniform(0, 40, rows // 10), 10) + 0.1 * rng.standard_normal(rows)
    load = np.repeat(rng.uniform(0, 10, rows // 10), 10) + rng.standard_normal(rows)
    torque = 20 + 29 * current + 20 * rng.standard_normal(rows)
    current[-2:], load[-2:], torque[-2:] = -2, (61, 58), (1154, 1075)
    return {"reference": current, "reading": torque, "load": load}


@pytest.mark.parametrize(
    "seed", [2, *(pytest.param(seed, marks=pytest.mark.long) for seed in (0, 4))]
)
def test_what_two_rows_of_a_fault_show_is_no_influence(seed):
    closing = close("linear", dyno(seed), rate=10.0)
    assert [e.candidate.label for e in closing.effects] == ["outliers"]
    assert closing.after.values["offset"] == pytest.approx(20, abs=8)
    assert closing.after.values["gain"] == pytest.approx(29, abs=0.3)
