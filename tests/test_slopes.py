"""Slopes of a residual in what a candidate would add, against differences of residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from casest import Residual, Run, model, param, quantity, signal
from casest.diagnose.candidates.candidates import Candidate, candidates
from casest.diagnose.candidates.grid import FROM_NOTHING
from casest.diagnose.candidates.slopes import rows_of, slopes
from casest.effects import CATALOGUE
from casest.effects.placing import prepared
from casest.leastsquares.problem import Problem


@model
def cell(force=signal("N"), v=signal(2, "mV"), *, zero=param(2, "mV"), gain=param(2, "mV/N")):
    """Two bridges on one load, recorded beside a temperature."""
    load = quantity("load", force, "N")
    return Residual(measured=v, predicted=quantity("reading", zero + gain * load, "mV"))


def recorded(name, count, seed):
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(count)
    force = 20 * np.sin(0.31 * t) + rng.uniform(-5, 5)
    v = np.array([0.3, -0.2]) + 0.5 * force[:, None] + 0.01 * rng.standard_normal((count, 2))
    signals = {"force": force[:, None], "v": v}
    run = Run.raw(name, signals, units={"force": "N", "v": "mV"}, time=t)
    return replace(run, columns={"case": 30 + rng.standard_normal(count).cumsum()},
                   column_units={"case": "degC"})  # fmt: skip


#: One value of what is searched over; others are held at what they are told.
HELD = {
    "time": 6.0, "level": 12.0, "floor": 3.0, "frequency": 2.3, "timescale": 1.7, "share": 0.05,
    "onset": 5.0,
}  # fmt: skip
VALUES = {"zero": np.array([0.31, -0.19]), "gain": np.array([0.49, 0.52])}


def found_on(runs):
    listed, _ = candidates(cell, runs, CATALOGUE)
    for candidate in listed:
        profile = dict(candidate.effect.profile) if candidate.effect else {}
        if "lag" in profile.values():
            continue  # searched by secants: at no lag at all the slope is another
        if set(profile.values()) <= FROM_NOTHING:
            profile = {}  # by secants as well, but for the slope at nothing
        moments = iter((4.0, 11.0))
        held = {n: next(moments) if k == "time" else HELD[k] for n, k in profile.items()}
        yield replace(candidate, held=tuple(held.items()))


@pytest.fixture(scope="module")
def runs():
    return prepared(cell, [recorded("a", 150, 1), recorded("b", 90, 2)])


def by_differences(candidate: Candidate, runs, size):
    """Central differences (N, m, k) of the residual in each of its numbers, from null; of what is
    nothing at its lower bound those upwards.

    Shared numbers first, then those of the first run, and so on.
    """
    wide = Problem(candidate.traced_on(cell), runs)
    held = {f"{candidate.label}.{n}": np.array(x) for n, x in candidate.held}
    start = {**wide.values(wide.start()), **VALUES, **held}
    columns = []
    for number, p in enumerate(candidate.parameters(candidate.traced_on(cell))):
        null = np.asarray(start[p.name], float)
        for k in np.ndindex(null.shape):
            step = np.zeros(null.shape)
            step[k] = size
            back = 0.0 if p.lower[0] > null[k] - size else 1.0
            up, down = (
                np.concatenate(wide.residuals(wide.point({**start, p.name: null + s})))
                for s in (step, -back * step)
            )
            run = k[0] if p.scope == "run" else -1
            columns.append((run, number, k, (up - down) / ((1 + back) * size)))
    columns.sort(key=lambda column: column[:3])
    return np.stack([difference for *_, difference in columns], axis=2)


def test_the_slopes_of_every_candidate_are_those_of_the_residual(runs):
    """All of the catalogue that applies, also what acts on the sequence of samples.

    What that began from is no evidence: the first row of a run is given the slopes of the second.
    """
    problem = Problem(cell, runs)
    point, listed = problem.point(VALUES), list(found_on(runs))
    seen, wrong = set(), []
    with np.errstate(all="ignore"):
        for candidate, columns in slopes(problem, point, listed, rows_of(runs, 10**6)):
            expected = by_differences(candidate, runs, 1e-6)
            if candidate.effect is not None and candidate.effect.kind == "sequence":
                for first in (0, 150):
                    expected[first] = expected[first + 1]
            away = np.abs(columns - expected).max() / (np.abs(expected).max() + 1e-9)
            wrong += [(candidate.label, away)] if not away < 1e-4 else []
            seen.add(candidate.name)
    assert wrong == []
    assert len(seen) > 12


def test_of_a_long_record_evenly_chosen_rows_are_looked_at(runs):
    problem = Problem(cell, runs)
    point, listed = problem.point(VALUES), list(found_on(runs))[:3]
    rows = rows_of(runs, 60)
    assert [len(r) for r in rows] == [38, 23]
    places = np.concatenate([rows[0], 150 + rows[1]])
    whole = dict(slopes(problem, point, listed, rows_of(runs, 10**6)))
    for candidate, columns in slopes(problem, point, listed, rows):
        np.testing.assert_allclose(columns, whole[candidate][places], rtol=1e-12)
