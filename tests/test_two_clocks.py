"""A lag between two instruments, the reference the noisier one: it is found from what it takes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from casest import close
from casest.data.bind import load_runs
from casest.effects.lateness import likely_lag
from casest.results.find import find_model

ROWS, STEP = 2000, 0.02


def smooth(rng):
    """A motion of a few seconds (ROWS + 400,), of size one or so."""
    return 10 * lfilter(*butter(2, 0.02), rng.standard_normal(ROWS + 800))[400:]


def record(seed, late, noise):
    """A quiet reading that is so many rows late behind a reference with noise."""
    rng = np.random.default_rng(seed)
    u = smooth(rng)
    reference = u[200 : 200 + ROWS] + noise * rng.standard_normal(ROWS)
    reading = 0.1 + u[200 - late : 200 - late + ROWS] + 0.002 * rng.standard_normal(ROWS)
    return {"t": STEP * np.arange(ROWS), "reference": reference, "reading": reading}


@pytest.mark.long
@pytest.mark.parametrize("late", [15, -40])
def test_a_lag_behind_a_noisy_reference_is_found(late):
    """What it leaves is noise; without it the gain is off by a third, and the residual as smooth as
    the reading is."""
    for seed in range(3):
        closing = close("linear", record(seed, late, 0.02))
        names = [e.candidate.name for e in closing.effects if e.candidate.name != "outliers"]
        assert names == ["signal_lag"]
        values = closing.after.values
        assert values["signal_lag(reference).delay"] == pytest.approx(STEP * late, abs=0.002)
        assert values["gain"] == pytest.approx(1, abs=0.005)
        assert closing.before.values["gain"] < 0.8


def lag_of(folder, given):
    file = folder / "two.csv"
    rows = np.column_stack([given[name] for name in ("t", "reference", "reading")])
    np.savetxt(file, rows, delimiter=",", header="t,reference,reading", comments="")
    runs = load_runs([str(file)], find_model("linear").signals)
    return likely_lag(runs, "reading", "reference", within=True)


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.1])
def test_the_pace_at_which_two_signals_go_together_is_looked_for(tmp_path, noise):
    """From row to row a noisy signal is lively by its noise."""
    assert lag_of(tmp_path, record(5, 15, noise)) == pytest.approx(0.3, abs=STEP)


@pytest.mark.long
def test_two_signals_that_have_nothing_to_do_with_each_other_have_no_lag(tmp_path):
    found = []
    for seed in range(40):
        one, other = record(seed, 0, 0.02), record(1000 + seed, 0, 0.02)
        found.append(lag_of(tmp_path, {**one, "reading": other["reading"]}))
    assert np.count_nonzero(found) <= 2
