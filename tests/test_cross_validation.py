"""Held-out data are held out: what predicts a sample has not seen it, and the gate listens."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from casest import Residual, Run, effect, model, param, quantity, signal
from casest.diagnose.loop import close
from casest.diagnose.motion.loop import held_out
from casest.diagnose.selection.cross_validation import check_folds, cross_fitted, folded, gain
from casest.diagnose.selection.state import HELD_OUT
from casest.effects import CATALOGUE
from casest.errors import DataError
from casest.estimate.calibrate import attempt, calibrate
from casest.estimate.held_out import residuals, split
from casest.leastsquares.problem import Problem

HUGE = 1e9
UNITS = {"x": "V", "y": "V"}


@model
def line(x=signal("V"), y=signal("V"), *, slope=param(), level=param("V")):
    return Residual(measured=y, predicted=quantity("reading", level + slope * x, "V"))


def series(rng, n=400, name="series"):
    x = rng.standard_normal((n, 1))
    y = 0.3 + 2 * x + 0.1 * rng.standard_normal((n, 1))
    return Run.raw(name, {"x": x, "y": y}, units=UNITS, time=np.arange(n) * 0.01)


def positions(rng, n=24):
    """Each a mean of fifty readings, a block of its own."""
    run = series(rng, n, "poses")
    return replace(run, block=np.arange(n), count=np.full(n, 50))


def bursts(rng):
    run = series(rng, 300, "bursts")
    return replace(run, block=np.repeat(np.arange(12), 25))


RECORDS = {
    "one series": lambda rng: (series(rng),),
    "two runs": lambda rng: (series(rng, 300, "a"), series(rng, 170, "b")),
    "poses": lambda rng: (positions(rng),),
    "bursts": lambda rng: (bursts(rng),),
    "poses beside a series": lambda rng: (positions(rng), series(rng)),
}


def disturbed(runs, folds, k, value):
    """The same with other readings in fold k."""
    found = []
    for run, fold in zip(runs, folds.of, strict=True):
        y = np.where((fold == k)[:, None], value, run.signals["y"])
        found.append(replace(run, signals={**run.signals, "y": y}))
    return tuple(found)


@pytest.mark.parametrize("kind", RECORDS)
@pytest.mark.parametrize("weighed", [False, True])
def test_what_predicts_a_fold_has_not_seen_it(kind, weighed):
    """Other readings in it, however far off: its predictions do not move by a bit.

    Also where samples are weighed: the weights are those of the fit that has not seen it.
    """
    runs = RECORDS[kind](np.random.default_rng(0))
    declared = line.with_effect(next(e for e in CATALOGUE if e.name == "outliers"))
    declared = declared if weighed else line
    values, folds = {"slope": 2.0, "level": 0.3}, folded(runs)
    usual = cross_fitted(declared, runs, values, folds)
    for k in range(folds.count):
        nothing = cross_fitted(declared, disturbed(runs, folds, k, 0.0), values, folds)
        far = cross_fitted(declared, disturbed(runs, folds, k, HUGE), values, folds)
        for r, fold in enumerate(folds.of):
            own = fold == k
            assert own.any()
            predicted = -nothing[r][own]
            np.testing.assert_array_equal(far[r][own], HUGE - predicted)
            np.testing.assert_array_equal(usual[r][own], runs[r].signals["y"][own] - predicted)
            # The others have seen it, and are far off: the disturbance was one.
            assert np.abs(far[r][~own]).min() > 1e3 or weighed


@pytest.mark.parametrize("kind", RECORDS)
def test_it_is_predicted_by_all_the_others_together(kind):
    """As NumPy's least squares on all other samples predicts it."""
    runs = RECORDS[kind](np.random.default_rng(1))
    folds = folded(runs)
    found = np.concatenate(cross_fitted(line, runs, {"slope": 1.9, "level": 0.0}, folds))[:, 0]
    x, y = (np.concatenate([run.signals[n][:, 0] for run in runs]) for n in "xy")
    of = np.concatenate(folds.of)
    assert set(of) == set(range(folds.count))
    for k in range(folds.count):
        slope, level = np.polyfit(x[of != k], y[of != k], 1)
        expected = (y - level - slope * x)[of == k]
        # a fit ends where a step would lower the squares by a thousandth of σ² = 0.01
        assert np.sum((found[of == k] - expected) ** 2) < 1e-5


@pytest.mark.parametrize("kind", RECORDS)
def test_a_pose_a_burst_and_a_stretch_are_held_out_whole(kind):
    runs = RECORDS[kind](np.random.default_rng(2))
    folds = folded(runs)
    for run, fold, first in zip(runs, folds.of, folds.batches, strict=True):
        batch = np.searchsorted(first, np.arange(len(run)), side="right") - 1
        for number in range(batch[-1] + 1):
            assert len(set(fold[batch == number])) == 1
            assert len(set(run.block[batch == number])) == 1
        blocks = len(set(run.block))
        if blocks > 1:
            for block in range(blocks):
                assert len(set(fold[run.block == block])) == 1
        else:
            assert np.diff(first).min() >= len(run) // 40


def test_stretches_are_ten_correlation_times_long():
    """Else neighbours of what is held out tell its noise."""
    runs = (series(np.random.default_rng(3), 4000),)
    (white,), (alike,) = folded(runs).batches, folded(runs, correlated_over=25.0).batches
    assert np.diff(white).min() == 100
    assert np.diff(alike).min() >= 250


# -- a record of its own ---------------------------------------------------------------------------


@model
def own_level(x=signal("V"), y=signal("V"), *, slope=param(), level=param("V", per="run")):
    return Residual(measured=y, predicted=level + slope * x)


def test_of_a_record_of_its_own_the_scored_half_is_unseen():
    """Its own parameters come from the other half: whatever the scored readings are."""
    rng = np.random.default_rng(4)
    run = series(rng)
    fitted, scored = split(run, (own_level,))
    assert not set(fitted.rows) & set(scored.rows)
    assert sorted([*fitted.rows, *scored.rows]) == list(range(len(run)))
    values = {"slope": np.array(2.0), "level": np.array(7.0)}
    far, near = (
        residuals(own_level, values, fitted, replace(scored, signals={**scored.signals, "y": y}))
        for y in (np.full((len(scored), 1), HUGE), np.zeros((len(scored), 1)))
    )
    np.testing.assert_array_equal(far, HUGE + near)
    level = np.mean(fitted.signals["y"] - 2 * fitted.signals["x"])
    np.testing.assert_allclose(-near, level + 2 * scored.signals["x"], atol=1e-9)


def test_without_parameters_of_its_own_all_of_a_record_is_scored():
    run = series(np.random.default_rng(5))
    assert split(run, (line,)) == (None, run)


# -- in motion -------------------------------------------------------------------------------------


def test_numbers_that_foretell_a_block_of_a_flight_have_not_seen_it():
    """As NumPy's least squares on the whitened innovations of all other blocks has them."""
    rng = np.random.default_rng(8)
    z, H = rng.standard_normal((200, 2)), rng.standard_normal((200, 2, 3))
    L = np.linalg.cholesky(np.array([[2.0, 0.3], [0.3, 0.5]])) * np.ones((200, 1, 1))
    folds = np.arange(200) // 10 % 4

    def foretold(z, nu):
        answers = SimpleNamespace(H=H, z=z, L=L)
        fit = SimpleNamespace(found=SimpleNamespace(innovations=nu), answers=answers)
        return held_out(fit, folds)

    nothing = np.zeros((200, 2))
    usual = foretold(z, nothing)
    for fold in range(4):
        own = folds == fold
        far = foretold(np.where(own[:, None], HUGE, z), nothing)
        np.testing.assert_array_equal(far[own], usual[own])
        numbers = np.linalg.lstsq(H[~own].reshape(-1, 3), z[~own].ravel())[0]
        expected = -np.einsum("kij,kjl,l->ki", L[own], H[own], numbers)
        np.testing.assert_allclose(usual[own], expected, atol=1e-12)


# -- the gate --------------------------------------------------------------------------------------


@effect(on="reading")
def switched(y, switch=signal("1"), *, k=param("V")):
    return y + k * switch


def switched_record(seed, in_folds, idle=(), size=0.05):
    """A switch that moves the readings: closed in every second stretch of those folds.

    In the `idle` stretches it is closed as well, and moves nothing.
    """
    rng = np.random.default_rng(seed)
    run = series(rng, 1200)
    (fold,), (first,) = folded((run,)).of, folded((run,)).batches
    batch = np.searchsorted(first, np.arange(len(run)), side="right") - 1
    closed = (np.isin(fold, in_folds) & (batch % 2 == 0)).astype(float)
    y = run.signals["y"] + size * closed[:, None]
    closed[np.isin(batch, idle)] = 1.0
    return replace(run, signals={**run.signals, "y": y}, columns={"switch": closed},
                   column_units={"switch": "1"})  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_what_held_out_data_cannot_confirm_is_not_added(seed):
    """Half a σ in a hundred samples and more: beyond doubt by any test of the fit itself.

    But the switch is closed in one fold alone: no fit that has not seen it could foretell anything.
    """
    run = switched_record(seed, [0])
    closing = close(line, [run], catalogue=[switched])
    assert closing.effects == ()
    (said,) = [r.reason for r in closing.refused if r.name.startswith("switched")]
    assert said == "too small to matter here: held-out data do not confirm it"
    x, y, s = run.signals["x"], run.signals["y"], run.columns["switch"][:, None]
    columns = np.hstack([x, np.ones_like(x), s])
    found, rest, *_ = np.linalg.lstsq(columns, y, rcond=None)
    std = np.sqrt(rest[0] / (len(x) - 3) * np.linalg.inv(columns.T @ columns)[2, 2])
    assert found[2, 0] / std > 4


@pytest.mark.parametrize("seed", range(1, 5))
def test_what_held_out_data_deny_is_not_added(seed):
    """It moves the readings by two σ in the stretches of one fold, and in two others it does
    nothing: significant, and each fold speaks against what the rest foretells of it."""
    (fold,), (first,) = folded_parts(seed)
    others = [int(b) for b in np.flatnonzero(fold[first] != 0)[:2]]
    closing = close(line, [switched_record(seed, [0], others, 0.2)], catalogue=[switched])
    assert closing.effects == ()
    said = {r.reason for r in closing.refused if r.name.startswith("switched")}
    assert said == {"too small to matter here: held-out data do not confirm it"}


def folded_parts(seed):
    folds = folded((series(np.random.default_rng(seed), 1200),))
    return folds.of, folds.batches


@pytest.mark.parametrize("seed", range(3))
def test_the_same_in_all_folds_is_added(seed):
    closing = close(line, [switched_record(seed, [0, 1, 2, 3])], catalogue=[switched])
    assert [f.candidate.name for f in closing.effects] == ["switched"]


def test_a_cause_of_nothing_passes_the_gate_as_rarely_as_its_level_says():
    """A column of noise: its gain beyond 1.64 standard errors, in records that lack nothing.

    One-sided 5 % by that number; held out it is far less, since a fit to noise predicts worse: less
    than one in a thousand. The fits by NumPy, since 2000 of them are wanted.
    """
    rng, passed, sums = np.random.default_rng(6), 0, []
    run = series(rng, 400)
    folds = folded((run,))
    of = folds.of[0]
    for _ in range(2000):
        noise, column = rng.standard_normal((2, 400))
        columns = np.c_[run.signals["x"][:, 0], np.ones(400), column]
        before, after = np.empty((2, 400, 1))
        for k in range(folds.count):
            for found, width in ((before, 2), (after, 3)):
                own = columns[:, :width]
                x = np.linalg.lstsq(own[of != k], noise[of != k], rcond=None)[0]
                found[of == k, 0] = (noise - own @ x)[of == k]
        gained, error = gain([before], [after], folds, 1.0)
        passed += gained > HELD_OUT * error
        sums.append(gained)
    assert 1 <= passed <= 8
    assert np.mean(sums) < 0


def test_noise_that_is_alike_within_a_stretch_passes_the_gate_no_more_often():
    """Half of the variance common to each stretch, and a column that is constant in each: what is
    gained is as uncertain as the stretches are few."""
    rng, passed = np.random.default_rng(9), 0
    folds = folded((series(rng, 400),))
    (of,), (first,) = folds.of, folds.batches
    batch = np.searchsorted(first, np.arange(400), side="right") - 1
    for _ in range(1500):
        common, column = rng.standard_normal((2, batch[-1] + 1))[:, batch]
        noise = (rng.standard_normal(400) + common) / np.sqrt(2)
        before, after = noise.copy(), np.empty(400)
        for k in range(folds.count):
            seen = of != k
            slope = column[seen] @ noise[seen] / (column[seen] @ column[seen])
            after[~seen] = (noise - slope * column)[~seen]
        gained, error = gain([before[:, None]], [after[:, None]], folds, 1.0)
        passed += gained > HELD_OUT * error
    assert passed <= 15


def test_what_a_fit_to_the_rest_cannot_foretell_is_refused():
    """A slope that one pose alone shows: without it nothing is known of what is held out."""
    rng = np.random.default_rng(7)
    run = positions(rng)
    x = np.zeros((24, 1))
    x[::4] = 1e-3 * rng.standard_normal((6, 1))
    x[5] = 100.0
    run = replace(run, signals={"x": x, "y": 2 * x + 0.1 * rng.standard_normal((24, 1))})
    before = calibrate(line, [run])
    with pytest.raises(DataError, match="without one part in 4 of the record"):
        check_folds(before, (run,), folded((run,)))
    even = positions(rng)
    assert check_folds(attempt(line, [even]), (even,), folded((even,))) is None
    assert Problem(line, (even,)).residual_count == 24
