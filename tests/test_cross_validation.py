"""Held-out data are held out: what predicts a sample has not seen it, and the gate listens."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import simulators as sim
from scipy.stats import norm

from casest import Residual, Run, effect, model, param, quantity, signal
from casest.diagnose.cross_validation import cross_fitted, determined, folded
from casest.diagnose.evidence.held_out import fall, fall_between_causes, foretold
from casest.diagnose.evidence.linear import Linear, parts_of
from casest.diagnose.levels import LEVELS
from casest.diagnose.loop import close
from casest.diagnose.motion.loop import held_out
from casest.diagnose.protocol import holds_out
from casest.effects import CATALOGUE, channel_bias
from casest.errors import DataError
from casest.estimate.calibrate import attempt, calibrate
from casest.estimate.held_out import residuals, split
from casest.leastsquares.problem import Problem
from casest_problems.norm import norm_triangular

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


def switched_record(seed, stretches, idle=(), size=0.05):
    """A switch that moves the readings: closed in those tenths of the record.

    In the `idle` tenths it is closed as well, and moves nothing.
    """
    rng = np.random.default_rng(seed)
    run = series(rng, 1200)
    tenth = np.arange(1200) // 120
    # By turns open and closed for ten samples, so that no course in time is like it.
    turns = np.arange(1200) // 10 % 2 == 0
    moves = (np.isin(tenth, stretches) & turns).astype(float)
    y = run.signals["y"] + size * moves[:, None]
    closed = moves + (np.isin(tenth, idle) & turns)
    return replace(run, signals={**run.signals, "y": y}, columns={"switch": closed},
                   column_units={"switch": "1"})  # fmt: skip


def away_from_nothing(run):
    """The switch's effect in its own standard deviations, by NumPy's least squares."""
    x, y, s = run.signals["x"], run.signals["y"], run.columns["switch"][:, None]
    columns = np.hstack([x, np.ones_like(x), s])
    found, rest, *_ = np.linalg.lstsq(columns, y, rcond=None)
    return found[2, 0] / np.sqrt(rest[0] / (len(x) - 3) * np.linalg.inv(columns.T @ columns)[2, 2])


def names(closing):
    return [f.candidate.name for f in closing.effects]


def refusals(closing):
    return {r.reason for r in closing.refused if r.name.startswith(("channel", "switched"))}


#: In the first a fit that has not seen that tenth knows nothing of the switch; in the second each
#: stretch speaks against what the rest foretells of it.
SEEN_IN_ONE_PLACE = {
    "closed in one tenth": {"stretches": [4], "size": 0.1},
    "idle in two others": {"stretches": [4], "idle": (7, 8), "size": 0.2},
}


ASKED = [
    *(("closed in one tenth", seed) for seed in range(4)),
    *(("idle in two others", seed) for seed in range(3)),
]


@pytest.mark.parametrize(("where", "seed"), ASKED)
def test_what_held_out_stretches_do_not_confirm_is_not_added(where, seed):
    """Beyond doubt by any test of the fit itself, five standard deviations and more."""
    run = switched_record(seed, **SEEN_IN_ONE_PLACE[where])
    assert away_from_nothing(run) > 5
    closing = close(line, [run], catalogue=[channel_bias])
    assert names(closing) == []
    assert refusals(closing) == {"held-out data do not confirm it"}


@pytest.mark.parametrize("seed", range(3))
def test_the_same_in_all_stretches_is_added(seed):
    closing = close(line, [switched_record(seed, range(10))], catalogue=[channel_bias])
    assert names(closing) == ["channel_bias"]


@pytest.mark.parametrize("seed", range(3))
def test_what_a_user_declares_is_judged_by_its_own_test(seed):
    """It was thought of before the data were seen: though it shows in one place alone."""
    run = switched_record(seed, **SEEN_IN_ONE_PLACE["closed in one tenth"])
    assert names(close(line, [run], catalogue=[switched])) == ["switched"]
    nothing = switched_record(seed, range(10), size=0.0)
    closing = close(line, [nothing], catalogue=[switched])
    assert names(closing) == []
    (said,) = refusals(closing)
    assert said.startswith("no more of it than noise like what is left")


@pytest.mark.parametrize("records", [60, pytest.param(400, marks=pytest.mark.long)])
def test_a_cause_of_nothing_passes_the_gate_as_rarely_as_its_level_says(records):
    """A column of noise in records that lack nothing: one-sided 5 % by its level, and a fit to
    noise predicts worse; stretches and regions ask as well."""
    rng, passed, ratios = np.random.default_rng(6), 0, []
    for _ in range(records):
        linear = problem_of(rng, rng.standard_normal((400, 1)))
        column = rng.standard_normal((400, 1, 1))
        seen = {k: fall(linear, [column], parts) for k, parts in linear.parts.each.items()}
        passed += holds_out(seen, linear)
        ratios.append(seen["pieces"].ratio)
    assert passed <= 5 / 400 * records
    assert np.mean(ratios) > 1


@pytest.mark.parametrize("records", [160, pytest.param(1000, marks=pytest.mark.long)])
def test_noise_that_is_alike_within_a_piece_passes_the_gate_no_more_often(records):
    """Half of the variance common to each piece of ten, and a column that is constant in each: what
    is gained is as uncertain as the pieces are few."""
    rng, passed = np.random.default_rng(9), 0
    for _ in range(records):
        common, column = np.repeat(rng.standard_normal((2, 40)), 10, axis=1)
        linear = problem_of(rng, ((rng.standard_normal(400) + common) / np.sqrt(2))[:, None])
        seen = fall(linear, [column[:, None, None]], linear.parts.pieces)
        passed += seen.t > LEVELS.confirmed
    assert passed <= 25 / 1000 * records


def test_one_wild_reading_neither_makes_nor_breaks_a_cause():
    """A thousand σ off, in a record where a column explains half of the variance, and in one where
    it explains nothing."""
    rng = np.random.default_rng(10)
    column = rng.standard_normal((400, 1))
    for size in (0.0, 1.0):
        noise = rng.standard_normal((400, 1)) + size * column
        plain = problem_of(rng, noise)
        wild = noise.copy()
        wild[123] += 1000
        far = replace(plain, residual=wild)
        before, after = (fall(p, [column[:, :, None]], p.parts.stretches) for p in (plain, far))
        assert after.ratio == pytest.approx(before.ratio, abs=0.05)
        assert (after.t > LEVELS.confirmed) == (before.t > LEVELS.confirmed) == bool(size)


# -- one cause or another --------------------------------------------------------------------------


def of_two_causes(rng, few, told, middle, series):
    """Errors of two causes: of `few` rows at the end they foretell what differs by λ = `told`.

    The second is right, or the truth lies in the middle between them.
    """
    n = 24 + few
    apart = np.zeros((n, 1))
    apart[24:] = np.sqrt(told / few)
    noise = rng.standard_normal((n, 1))
    linear = problem_of(rng, noise)
    if not series:
        linear = replace(linear, spans=())
    a = noise - 0.5 * apart if middle else noise
    return linear, a + apart, a


@pytest.mark.long
@pytest.mark.parametrize("few", [3, 12])
def test_poses_that_were_measured_last_tell_two_causes_apart(few):
    """As often as squares whose difference is normal, N(λ, 4λ), are two errors apart, or less:
    the errors of few rows count as what they are by chance, if that is more."""
    rng, told = np.random.default_rng(few), 45.0

    def far(middle):
        ways = (of_two_causes(rng, few, told, middle, series=False) for _ in range(800))
        return np.mean([fall_between_causes(*way).t >= LEVELS.apart for way in ways])

    power = norm.cdf((told - LEVELS.apart * 2 * np.sqrt(told)) / (2 * np.sqrt(told)))
    assert power - 0.08 < far(middle=False) < power + 0.02
    assert far(middle=True) < 0.03


def test_one_stretch_of_a_series_tells_no_two_causes_apart():
    """What it leaves may be more that is missing: there a single stretch is one reading (Vuong)."""
    rng = np.random.default_rng(1)
    found = [
        fall_between_causes(*of_two_causes(rng, 3, 45.0, False, series=True)).t for _ in range(100)
    ]
    assert max(found) < 2


# -- whole stretches and regions -------------------------------------------------------------------


def problem_of(rng, residual, declared=None):
    """A linear problem whose sensor met a random course, with two declared columns or those."""
    n = len(residual)
    if declared is None:
        declared = np.stack([np.ones((n, 1)), rng.standard_normal((n, 1))], axis=2)
    met = np.cumsum(rng.standard_normal((n, 2)), axis=0)
    number = np.zeros(n, dtype=int)
    return Linear(residual, declared, (slice(0, n),), parts_of(number, number, met))


@pytest.mark.parametrize("n", [30, 400])
@pytest.mark.parametrize("kind", ["pieces", "stretches", "regions"])
def test_every_part_is_foretold_by_least_squares_on_all_the_others(kind, n):
    """A fit for each part that has never seen it, by NumPy, on two axes."""
    rng = np.random.default_rng(n)
    X, G = rng.standard_normal((n, 2, 3)), rng.standard_normal((n, 2, 2))
    y = G @ [0.5, -0.3] + 0.3 * rng.uniform(-1, 1, (n, 2))
    linear = problem_of(rng, y, X)
    parts = linear.parts.each[kind]
    assert len(np.unique(parts)) >= 3
    for columns, A in (([], X), ([G], np.concatenate([X, G], axis=2))):
        found = foretold(linear, columns, parts)
        for k in np.unique(parts):
            rest = parts != k
            numbers = np.linalg.lstsq(A[rest].reshape(-1, A.shape[2]), y[rest].ravel())[0]
            expected = y[~rest] - A[~rest] @ numbers
            np.testing.assert_allclose(found[~rest], expected, atol=1e-9)


def test_what_the_rest_knows_nothing_of_moves_no_prediction():
    """A switch that is closed in one stretch alone."""
    rng = np.random.default_rng(14)
    noise, switch = rng.standard_normal((400, 1)), np.zeros((400, 1, 1))
    switch[160:200] = 1
    X = np.stack([np.ones((400, 1)), rng.standard_normal((400, 1))], axis=2)
    left = (noise + 3 * switch[:, :, 0])[:, 0]
    left -= X[:, 0] @ np.linalg.lstsq(X[:, 0], left)[0]
    linear = problem_of(rng, left[:, None], X)
    beyond = switch - X @ np.linalg.lstsq(X[:, 0], switch[:, 0])[0]  # as causes are judged
    parts = linear.parts.stretches
    with_it, without = foretold(linear, [beyond], parts), foretold(linear, [], parts)
    np.testing.assert_allclose(with_it[parts == 4], without[parts == 4], atol=1e-6)


def test_stretches_follow_each_other_and_regions_are_places():
    """A walk in a plane: a stretch is one span of rows, and no row is nearer to the middle of
    another region than to its own."""
    rng = np.random.default_rng(11)
    met = np.cumsum(rng.standard_normal((1200, 2)), axis=0)
    number = np.zeros(1200, dtype=int)
    parts = parts_of(number, number, met)
    assert np.all(np.diff(parts.stretches) >= 0)
    assert set(np.bincount(parts.stretches)) == {120}
    assert np.all(np.bincount(parts.pieces) == 240)
    assert np.count_nonzero(np.diff(parts.pieces)) == 39
    own = np.unique(parts.regions, return_inverse=True)[1]
    middles = np.array([met[own == k].mean(axis=0) for k in range(own.max() + 1)])
    away = np.linalg.norm(met[:, None] - middles, axis=2)
    assert len(middles) == 10
    # k-means has nearly ended.
    assert np.mean(away[np.arange(1200), own] <= away.min(axis=1) + 1e-9) > 0.97


def test_rows_of_one_pose_are_held_out_together():
    """Forty poses of ten readings: in pieces, in stretches, and in regions."""
    rng = np.random.default_rng(12)
    pose = np.repeat(np.arange(40), 10)
    parts = parts_of(pose, np.zeros(400, dtype=int), rng.standard_normal((40, 3))[pose])
    for found in parts.each.values():
        assert np.all(np.ptp(found.reshape(40, 10), axis=1) == 0)


def test_every_run_is_held_out_a_part_at_a_time():
    """Also a short one: what belongs to a run alone is foretold by the rest of it."""
    rng = np.random.default_rng(13)
    runs = np.repeat([0, 1], [1000, 200])
    parts = parts_of(np.zeros(1200, dtype=int), runs, rng.standard_normal((1200, 1)))
    for found in (parts.pieces, parts.stretches):
        for run in (0, 1):
            assert len(np.unique(found[runs == run])) >= 5


def test_a_pose_that_alone_determines_something_is_never_held_out():
    """A slope that one pose alone shows: without it nothing is known of it. The others are held
    out one by one."""
    rng = np.random.default_rng(7)
    run = positions(rng)
    x = np.zeros((24, 1))
    x[::4] = 1e-3 * rng.standard_normal((6, 1))
    x[5] = 100.0
    run = replace(run, signals={"x": x, "y": 2 * x + 0.1 * rng.standard_normal((24, 1))})
    before = calibrate(line, [run])
    folds = determined(before, (run,))
    assert folds.of[0].tolist() == [-1 if k == 5 else k for k in range(24)]
    (foretold_,) = cross_fitted(line, (run,), before.values, folds)
    assert np.flatnonzero(np.isnan(foretold_[:, 0])).tolist() == [5]
    even = positions(rng)
    assert determined(attempt(line, [even]), (even,)).count == LEVELS.refits
    assert Problem(line, (even,)).residual_count == 24


def test_poses_of_which_most_determine_something_alone_are_refused():
    """Nine positions for nine unknowns: without one of them there are too few equations."""
    rng = np.random.default_rng(8)
    v = sim.accelerometer(rng).read(sim.spread_poses(9, rng), 5e-3, rng)
    run = Run.raw("poses", {"v": v}, units={"v": "m/s^2"})
    before = attempt(norm_triangular.having(norm=sim.GRAVITY), [run])
    with pytest.raises(DataError, match="too few equations; record more orientations"):
        determined(before, (run,))


def test_what_nothing_foretells_is_no_part_of_an_error_and_a_dash_on_the_page():
    from casest.diagnose.cross_validation import rms
    from casest.report.html.numbers import alike

    assert rms([np.array([[3.0, np.nan], [np.nan, 4.0]])]) == pytest.approx(np.sqrt(12.5))
    assert np.isnan(rms([np.full((2, 1), np.nan)]))
    assert alike([1.5, None]) == ["1.5000", "–"]
