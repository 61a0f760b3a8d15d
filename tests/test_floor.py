"""The lower end of a range: readings that stop there, and a response that only bends towards it."""

from __future__ import annotations

import numpy as np
import pytest

from casest import close


def written(path, columns):
    table = np.stack(list(columns.values()), axis=1)
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    return path


def carried_to_and_fro(rng, rows=1500):
    t = 0.02 * np.arange(rows)
    return t, 4 * np.sin(0.9 * t + rng.uniform(0, 6)) + np.sin(2.3 * t)


@pytest.mark.parametrize(
    ("end", "seed"),
    [
        (-2.0, 2),
        *(pytest.param(-2.0, seed, marks=pytest.mark.long) for seed in (0, 1, 3)),
        *(pytest.param(1.0, seed, marks=pytest.mark.long) for seed in range(4)),
    ],
)
def test_readings_that_stop_at_a_lower_end_are_seen_to(tmp_path, seed, end):
    """A distance meter that sees no nearer: with the gain as it is above."""
    rng = np.random.default_rng(seed)
    t, x = carried_to_and_fro(rng)
    y = np.maximum(2 + 0.9 * x, 2 + 0.9 * end) + 0.05 * rng.standard_normal(len(t))
    closing = close("linear", written(tmp_path / "a.csv", {"t": t, "reference": x, "reading": y}))
    assert [e.candidate.label for e in closing.effects] == ["floor"]
    assert closing.verdict == "extended"
    assert closing.after.values["floor.level"] == pytest.approx(2 + 0.9 * end, abs=0.03)
    assert closing.after.values["gain"] == pytest.approx(0.9, abs=0.01)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_a_bend_is_no_lower_end(tmp_path, seed):
    rng = np.random.default_rng(100 + seed)
    t, x = carried_to_and_fro(rng)
    y = 2 + 0.9 * x + 0.03 * x**2 + 0.05 * rng.standard_normal(len(t))
    closing = close("linear", written(tmp_path / "a.csv", {"t": t, "reference": x, "reading": y}))
    assert "floor" not in [e.candidate.label for e in closing.effects]


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2, 3))]
)
def test_inputs_of_one_sign_do_not_tell_it_from_a_dead_band(tmp_path, seed):
    """What begins at a threshold of the input, or the reading's own lower end: one is not claimed
    without the other."""
    rng = np.random.default_rng(200 + seed)
    x = np.linspace(0, 10, 21)
    y = np.maximum(1 + 0.5 * x, 2.6) + 0.01 * rng.standard_normal(21)
    closing = close("linear", written(tmp_path / "a.csv", {"reference": x, "reading": y}))
    named = set(closing.undecided.names if closing.undecided else ())
    for found in closing.effects:
        named |= {found.candidate.label, *found.indistinguishable_from}
    assert {"floor", "dead_band"} <= named
