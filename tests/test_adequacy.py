"""A misfit is told from noise of any colour, tails and inequality; outliers from heavy tails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from casest import Residual, Run, attempt, close, model, param, quantity, signal
from casest.diagnose.cross_validation import folded
from casest.diagnose.misfit.findings import findings
from casest.diagnose.misfit.left import Misfit, doubts, left_over
from casest.diagnose.misfit.pure_error import pure_error
from casest.diagnose.misfit.structure import more_than_its_colour_does
from casest.diagnose.misfit.variables import Variable
from casest.diagnose.noise.noise_model import equal_noise, lag_one, noise_model
from casest.diagnose.noise.spectral_line import strongest_line
from casest.diagnose.noise.tails import outlier_share, outliers_p_value, tails
from casest.effects.placing import prepared
from casest.estimate.correlation import correlation_time
from casest.leastsquares.problem import Problem
from casest.solve.trust_region import trust_region
from casest_problems.one_channel import linear


@model
def channels(x=signal("V"), y=signal(2, "V"), *, a=param(2, "V"), b=param(2)):
    """Two channels, each a line."""
    return Residual(measured=y, predicted=quantity("level", a + b * x, "V"))


@model
def encoder(angle=signal("rad"), y=signal("V"), *, a=param("V"), b=param("V/rad")):
    """A potentiometer that goes round many times."""
    turned = quantity("turned", angle, "rad")
    return Residual(measured=y, predicted=a + b * turned)


def white(n, rng, blocks):
    return rng.standard_normal((n, 2))


def autoregressive(n, rng, blocks):
    """AR(1) of unit variance, ρ = 0.6."""
    e = rng.standard_normal((n, 2))
    for k in range(1, n):
        e[k] = 0.6 * e[k - 1] + 0.8 * e[k]
    return e


def heavy(n, rng, blocks):
    return rng.standard_t(4, (n, 2))


def shaking(n, rng, blocks):
    """The table shakes at some positions, three times as much as at rest."""
    return (
        rng.standard_normal((n, 2))
        * np.where(rng.random(blocks.max() + 1) < 0.2, 3, 1)[blocks, None]
    )


def with_outliers(n, rng, blocks):
    """One reading in 200 is off by 10 to 20 σ."""
    e = rng.standard_normal((n, 2))
    bad = rng.random((n, 2)) < 0.005
    e[bad] += rng.choice([-1, 1], bad.sum()) * rng.uniform(10, 20, bad.sum())
    return e


NOISE = {
    "white": white, "AR(1)": autoregressive, "t4": heavy, "shaking": shaking, "outliers":
    with_outliers,
}  # fmt: skip


def record(noise, seed, n=480, positions=24, misfit=lambda **_: 0.0, quantised=False):
    """A record of a line in x held at `positions` (0: x goes up and down), and two columns."""
    rng = np.random.default_rng([seed, n, positions])
    blocks = np.arange(n) * (positions or 24) // n
    x = rng.uniform(-1, 1, positions)[blocks] if positions else np.sin(0.05 * np.arange(n))
    t = 0.01 * np.arange(n)
    warm = 20 + 5 * np.sin(0.9 * t) + 0.05 * rng.standard_normal(n)
    y = 1 + 2 * x[:, None] + noise(n, rng, blocks)
    y = y + np.reshape(misfit(x=x, t=t, warm=warm, blocks=blocks), (-1, 1))
    run = Run.raw("r", {"x": x[:, None], "y": np.round(y) if quantised else y}, units={}, time=t)
    columns = {"temp": warm, "humidity": rng.standard_normal(n)}
    return replace(
        run, columns=columns, column_units={}, block=blocks if positions else run.block
    )  # fmt: skip


def judged(run, declared=channels) -> Misfit:
    runs = prepared(declared, [run])
    problem = Problem(declared, runs)
    point = trust_region(problem, problem.start()).point
    correlated = correlation_time(problem, point)
    batches = folded(runs, correlated).batches
    return left_over(problem, point, batches, problem.residuals(point), correlated)


# -- no misfit -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("seeds", "most"), [(3, 2), pytest.param(12, 4, marks=pytest.mark.long)])
def test_noise_of_any_kind_is_no_misfit(seeds, most):
    worlds = [
        (name, positions, judged(record(noise, seed, positions=positions)))
        for name, noise in NOISE.items()
        for positions in (0, 24)
        for seed in range(seeds)
    ]
    alarms = [(name, positions, f.where) for name, positions, f in worlds if f.significant]
    # At one in a hundred 1.2 of 120 are expected; more than four come once in 130 tries, and more
    # than two of 30 once in 300.
    assert len(alarms) <= most, alarms


def test_readings_rounded_to_one_sigma_are_no_misfit_and_the_step_is_found():
    found = [judged(record(white, seed, quantised=True)) for seed in range(8)]
    assert sum(f.significant for f in found) <= 1
    assert all(f.noise["quantisation_step"] == 1.0 for f in found)


# -- misfits ---------------------------------------------------------------------------------------


def wave(warm, **_):
    return 0.5 * np.cos(0.7 * (warm - 20))


def test_a_wave_in_a_column_is_a_misfit():
    for seed in range(3):
        assert judged(record(white, seed, n=1200, positions=0, misfit=wave)).significant


def test_a_wave_in_a_column_names_the_column():
    """Two of its swings: another slow course might go with it for as long."""
    found = judged(record(white, 0, n=1200, positions=0, misfit=wave))
    assert "of unknown cause: temp goes with it, as slow courses may by chance" in found.where


def smooth(rng, n, over):
    """A smooth random course (n,) of variance 1."""
    window = np.exp(-0.5 * (np.arange(-4 * over, 4 * over + 1) / over) ** 2)
    course = np.convolve(rng.standard_normal(n + 8 * over), window, "same")[4 * over : 4 * over + n]
    return (course - course.mean()) / course.std()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("answers", [True, False])
def test_a_slow_residual_follows_a_column_where_it_answers_to_its_values(seed, answers):
    """Beside a slow course of its own. Before, every slow residual followed every slow column."""
    rng, n = np.random.default_rng([2, seed]), 1500
    run = record(white, seed, n=n, positions=0)
    warm = 20 + 5 * smooth(rng, n, 12 if answers else 120)
    misfit = smooth(rng, n, 60) + (2 * np.sin(warm) if answers else 0.0)
    y = run.signals["y"] + misfit[:, None]
    run = replace(run, signals={**run.signals, "y": y}, columns={"temp": warm})
    found = judged(run)
    assert found.significant
    assert ("of it follows temp" in found.where) is answers


def up_and_down(seed, bend, wide=None):
    """Doubts of a line over an input that goes slowly up and down (or wanders, `wide` samples) in a
    running mean of ten, or in AR(1) noise; `bend` of the variance is a square."""
    rng, n = np.random.default_rng(seed), 2000
    turns = np.arange(n) / n * rng.uniform(1, 9) + rng.random()
    x = np.sin(2 * np.pi * turns)
    if wide is not None:
        x = gaussian_filter1d(rng.standard_normal(n), wide) * np.sqrt(2 * np.sqrt(np.pi) * wide)
    mean, auto = (np.ones(10), [1.0]), ([1.0], [1.0, -0.6])
    e = lfilter(*(mean if seed % 2 else auto), rng.standard_normal(n + 500))[500:]
    square = x**2 - np.polyval(np.polyfit(x, x**2, 1), x)
    y = 2 * x + np.sqrt(1 - bend) * e / e.std() + np.sqrt(bend) * square / square.std()
    signals = {"reference": x[:, None], "reading": y[:, None]}
    units = {"reference": None, "reading": None}
    return doubts(attempt(linear, [Run.raw("r", signals, units=units, time=0.01 * np.arange(n))]))


def test_noise_with_a_short_memory_does_not_follow_a_slow_input():
    """Rows near in a slow input are near in time: 4 to 9 of 20 were said to follow it."""
    said = [bool(up_and_down(seed, 0.0)) for seed in range(40)]
    assert sum(said) <= 2


def test_an_axis_without_a_residual_follows_nothing():
    rng = np.random.default_rng(1)
    x = np.sin(np.linspace(0, 20, 1000))
    r = np.column_stack([lfilter([1.0], [1.0, -0.6], rng.standard_normal(1000)), np.zeros(1000)])
    column = Variable("level", (x,))
    assert not more_than_its_colour_does([r], column, 4.0)
    assert not more_than_its_colour_does([0 * r], column, 4.0)
    assert more_than_its_colour_does([r + x[:, None] ** 2 * [[2, 0]]], column, 4.0)


def test_beside_such_noise_a_bend_is_seen():
    told = [bool(up_and_down(seed, 0.12, wide=2)) for seed in range(12)]
    assert sum(told) >= 11
    told = [bool(up_and_down(seed, 0.25)) for seed in range(12)]
    assert sum(told) >= 11


def test_the_share_of_a_wave_is_the_one_that_it_has():
    """Its variance, 0.5²/2 less its mean, over that of everything."""
    for seed in range(3):
        found = judged(record(white, seed, n=1200, positions=0, misfit=wave))
        assert found.fraction == pytest.approx(0.11, abs=0.04)


def test_a_dependence_on_the_angle_names_it_though_it_goes_round():
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 80, 1500)
    y = 1 + 0.1 * angle + 0.3 * np.cos(2 * angle) + rng.standard_normal(1500)
    run = Run.raw("r", {"angle": angle[:, None], "y": y[:, None]}, units={})
    found = judged(run, encoder)
    assert found.significant
    assert "of it follows angle" in found.where  # `turned` is what the user gave, as it is


def test_positions_that_are_off_by_more_than_their_repeats_scatter_are_a_misfit():
    def off(blocks, **_):
        return np.random.default_rng(5).normal(0, 1.0, 24)[blocks]

    found = judged(record(white, 1, misfit=off))
    assert found.significant
    assert found.where.startswith("between positions: the residual is ")
    # Variance 1 within positions, about 1 between them.
    assert found.fraction == pytest.approx(0.5, abs=0.2)


@model
def one_channel(x=signal("V"), y=signal("V"), *, a=param("V"), b=param()):
    """A line."""
    return Residual(measured=y, predicted=a + b * x)


def lack_of_fit(rng, jitter, bend=0.0, *, rows=20, timed=True):
    """Twelve levels one above the other, read back with noise of their own: the test's p-value.

    `bend` is that of the levels beside a line, in standard errors of a level's mean.
    """
    level = np.linspace(-1, 1, 12)
    bent = level**2 - np.mean(level**2)
    beside = bend / np.sqrt(rows) * bent / bent.std()
    x = 1000 * np.repeat(level, rows)
    y = x + np.repeat(beside, rows) + rng.standard_normal(len(x))
    signals = {"x": (x + jitter(rng, len(x)))[:, None], "y": y[:, None]}
    run = Run.raw("r", signals, units={}, time=0.1 * np.arange(len(x)) if timed else None)
    problem = Problem(one_channel, prepared(one_channel, [run]))
    point = trust_region(problem, problem.start()).point
    found = pure_error(problem, point, problem.residuals(point), problem.unknowns)
    return found.p_value


JITTER = {
    "exact": lambda rng, n: 0.0,
    "small": lambda rng, n: 0.1 * rng.standard_normal(n),
    "as large as the noise": lambda rng, n: rng.standard_normal(n),
    "AR(1)": lambda rng, n: 0.7 * autoregressive(n, rng, None)[:, 0],
}


@pytest.mark.parametrize("jitter", JITTER.values(), ids=JITTER)
def test_levels_that_are_read_back_do_not_lack_fit(jitter):
    rng = np.random.default_rng(1)
    p = np.array([lack_of_fit(rng, jitter) for _ in range(40)])
    assert np.sum(p < 0.01) <= 3  # 0.4 are expected; four come once in a thousand tries


@pytest.mark.parametrize(("bend", "timed"), [(3, False), (10, True), (10, False)])
def test_a_bend_over_levels_that_follow_each_other_is_a_lack_of_fit(bend, timed):
    """It looks like a slow walk too, and neither is noise."""
    rng = np.random.default_rng(2)
    p = [lack_of_fit(rng, JITTER["small"], bend, timed=timed) for _ in range(10)]
    assert np.sum(np.array(p) < 0.001) >= 9


def swept(rng, sizes, bend=0.0, sweeps=3):
    """Eleven levels, up and up again, of the noise that each has: the test's p-value."""
    level = np.linspace(-1, 1, 11)
    x = np.tile(level, sweeps)
    y = x + bend * x**2 + np.tile(sizes, sweeps) * rng.standard_normal(len(x))
    run = Run.raw("r", {"x": x[:, None], "y": y[:, None]}, units={})
    problem = Problem(one_channel, prepared(one_channel, [run]))
    point = trust_region(problem, problem.start()).point
    found = pure_error(problem, point, problem.residuals(point), problem.unknowns)
    return None if found is None else found.p_value


SIZES = {"one": np.ones(11), "from a hundredth to one": np.geomspace(0.01, 1, 11)}


@pytest.mark.long
@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES)
def test_repeats_in_several_sweeps_do_not_lack_fit_whatever_their_sizes(sizes):
    rng = np.random.default_rng(3)
    p = np.array([swept(rng, sizes) for _ in range(400)])
    assert np.sum(p < 0.01) <= 11  # 4 are expected; twelve come once in a thousand tries


def test_a_level_at_a_full_scale_says_nothing_of_the_noise():
    """There both instruments stand still; what others scatter is none of its misfit's size."""
    rng, p = np.random.default_rng(6), []
    for _ in range(40):
        x = np.repeat(np.linspace(-1, 1, 12), 20)
        y = x + rng.standard_normal(len(x))
        y[-60:] = np.repeat(y[-60::20], 20)
        run = Run.raw("r", {"x": x[:, None], "y": y[:, None]}, units={}, time=0.1 * np.arange(240))
        problem = Problem(one_channel, prepared(one_channel, [run]))
        point = trust_region(problem, problem.start()).point
        p.append(pure_error(problem, point, problem.residuals(point), problem.unknowns).p_value)
    assert np.sum(np.array(p) < 0.01) <= 3


def test_a_bend_is_a_lack_of_fit_of_several_sweeps():
    """Of three times the noise at both ends."""
    rng = np.random.default_rng(4)
    p = np.array([swept(rng, np.ones(11), bend=6.0) for _ in range(20)])
    assert np.sum(p < 0.001) >= 19


def test_readings_that_are_written_down_twice_are_no_repeats():
    rng, x = np.random.default_rng(5), np.linspace(-1, 1, 18)
    y = x + 0.1 * rng.standard_normal(18)
    twice = {"x": np.tile(x, 2)[:, None], "y": np.tile(y, 2)[:, None]}
    run = Run.raw("r", twice, units={})
    problem = Problem(one_channel, prepared(one_channel, [run]))
    point = trust_region(problem, problem.start()).point
    assert pure_error(problem, point, problem.residuals(point), problem.unknowns) is None


def test_a_narrow_line_is_a_misfit_with_its_frequency():
    def hum(t, **_):
        return 0.4 * np.sin(2 * np.pi * 17 * t)

    found = judged(record(white, 2, n=2000, positions=0, misfit=hum))
    assert found.significant
    assert "a line at 17 Hz" in found.where


def in_bursts(run, size=7):
    """Sampled evenly, stamped as a buffer of some samples is emptied, 0.9 ms apart."""
    k = np.arange(len(run))
    return replace(run, time=0.01 * size * (k // size) + 0.0009 * (k % size))


def test_a_line_is_seen_though_time_stamps_come_in_bursts():
    """As of a microcontroller behind a serial line: they lie on no grid, and the samples do."""

    def hum(t, **_):
        return 0.4 * np.sin(2 * np.pi * 17 * t)

    found = judged(in_bursts(record(white, 2, n=2000, positions=0, misfit=hum)))
    assert found.significant
    assert "a line at 0.17 cycles per sample" in found.where
    rng = np.random.default_rng(3)
    alarms = 0
    for seed in range(300):
        run = in_bursts(record(white, seed, n=300, positions=0))
        line = strongest_line([run], [rng.standard_normal((300, 1))])
        alarms += line.p_value < 0.05
    assert alarms < 30  # 15 are expected


def test_a_jump_is_a_misfit():
    def jump(t, **_):
        return 1.0 * (t > 5)

    found = judged(record(white, 3, n=1000, positions=0, misfit=jump))
    assert found.significant


# -- the noise -------------------------------------------------------------------------------------


def described(e, batches=40):
    run = Run.raw("r", {"y": e}, units={}, time=0.01 * np.arange(len(e)))
    first = np.arange(batches) * len(e) // batches
    return noise_model([run], [e], [first])


def test_the_correlation_of_neighbours_is_that_of_the_ar1():
    rng = np.random.default_rng(0)
    e = autoregressive(20_000, rng, None)
    found = described(e)
    # Bartlett: its standard deviation is √((1 − ρ²)/n).
    assert found.lag1 == pytest.approx(0.6, abs=4 * np.sqrt((1 - 0.36) / 40_000) + 0.01)
    assert found.colour_p < 1e-6


def test_white_noise_is_called_white_whatever_its_scale_does():
    rng, p = np.random.default_rng(1), []
    for _ in range(300):
        e = rng.standard_normal((400, 1)) * np.exp(np.sin(np.arange(400) / 30))[:, None]
        p.append(lag_one([Run.raw("r", {"y": e}, units={})], [e])[1])
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 300))


def test_a_random_walk_beside_the_noise_is_found_with_its_size():
    rng = np.random.default_rng(2)
    sizes = []
    for _ in range(12):
        walk = np.cumsum(0.05 * rng.standard_normal((4000, 2)), axis=0)
        found = described(walk + rng.standard_normal((4000, 2)))
        assert found.wander_p < 1e-3
        sizes.append(found.wander)
    # 0.05 per sample of 10 ms: 0.5 per √s; robust σ counts part of the walk.
    assert np.mean(sizes) == pytest.approx(0.5, rel=0.3)


def test_unequal_noise_is_told_and_equal_noise_is_not():
    rng = np.random.default_rng(3)
    first = np.arange(24) * 20
    p = [equal_noise([np.clip(white(480, rng, None), -3.5, 3.5)], [first]) for _ in range(300)]
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 300))
    e = white(480, rng, None)
    e[100:120] *= 4
    found = described(e, batches=24)
    assert found.unequal_p < 1e-3
    assert 3 < found.unequal < 12


@pytest.mark.parametrize("freedom", [3, 4, 6])
def test_the_degrees_of_freedom_of_the_tails_are_estimated(freedom):
    rng = np.random.default_rng(4)
    found = tails(rng.standard_t(freedom, 20_000))
    # Fisher information of ν at 4 gives a standard deviation of about 1.8 % of ν² at this n.
    assert found.freedom == pytest.approx(freedom, rel=0.15)
    assert not found.outliers


def test_normal_noise_has_normal_tails():
    rng = np.random.default_rng(5)
    heavy_ones = sum(np.isfinite(tails(rng.standard_normal(300)).freedom) for _ in range(200))
    assert heavy_ones <= 2


# -- outliers --------------------------------------------------------------------------------------


def first_of(n):
    return [np.arange(40) * n // 40]


def test_outliers_are_found_and_counted():
    rng = np.random.default_rng(6)
    shares = [outlier_share([with_outliers(600, rng, None)], first_of(600)) for _ in range(50)]
    assert np.mean(np.array(shares) > 0) >= 0.9
    # Of samples with two readings each: 1 − 0.995².
    assert np.mean(shares) == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize(
    "freedom", [3, pytest.param(4, marks=pytest.mark.long), pytest.param(6, marks=pytest.mark.long)]
)
def test_heavy_tails_are_no_outliers(freedom):
    rng = np.random.default_rng(7)
    found = [
        outliers_p_value([rng.standard_t(freedom, (400, 2))], first_of(400)) for _ in range(100)
    ]
    assert sum(p is not None for p in found) <= 2


def test_positions_that_shake_have_no_outliers():
    rng = np.random.default_rng(8)
    blocks = np.arange(600) * 24 // 600
    assert sum(outlier_share([shaking(600, rng, blocks)], first_of(600)) > 0 for _ in range(60)) < 3


def test_samples_far_off_that_follow_each_other_are_no_outliers():
    rng = np.random.default_rng(9)
    e = rng.standard_normal((1000, 2))
    e[400:408] += 12
    assert outlier_share([e], first_of(1000)) == 0.0


def test_samples_far_off_at_large_readings_are_no_outliers():
    rng = np.random.default_rng(10)
    e, level = rng.standard_normal((2000, 2)), rng.standard_normal((2000, 2))
    e[level > 2.5] -= 12
    assert outlier_share([e], first_of(2000)) > 0
    assert outlier_share([e], first_of(2000), [level]) == 0.0


@model
def compass(b=signal(3, "uT"), m=signal(3, "uT"), *, hard=param(3, "uT")):
    """A magnetometer in a known field."""
    field = quantity("field", b, "uT")
    return Residual(measured=m, predicted=quantity("reading", field + hard, "uT"), corrected=field)


def of_the_reference(rng, sway, n=2000):
    """What is significant of a compass that turns within some 30 samples, its field in a sway."""
    t = np.arange(n) / 10
    turn = Rotation.from_euler("ZYX", np.column_stack([2.3 * t, np.sin(1.7 * t), 1.3 * t]))
    b = turn.inv().apply([20.0, 0.0, -43.0])
    m = b * (1 + sway)[:, None] + [3, -2, 1] + 0.5 * rng.standard_normal((n, 3))
    run = Run.raw("r", {"b": b, "m": m}, units={"b": "uT", "m": "uT"}, time=t)
    problem = Problem(compass, prepared(compass, (run,)))
    return findings(problem, trust_region(problem, problem.start()).point)


def test_a_reference_that_sways_while_the_body_turns_is_no_noise():
    """By 0.4 %, sixty times: as large as 0.4 of the noise along the field, slow in no axis."""
    rng = np.random.default_rng(11)
    share = np.linspace(0, 1, 2000)[:, None]
    sway = np.cos(np.pi * share * np.arange(30, 61)) @ rng.standard_normal(31)
    found = of_the_reference(rng, 0.004 * sway / sway.std())
    assert [f.slow for f in found] == [True]
    assert "of what of it goes with the size of the input is a slow course" in found[0].where
    assert found[0].share == pytest.approx(0.14, abs=0.05)  # 0.16 of 1.16


@pytest.mark.parametrize(
    "seeds", [range(20), pytest.param(range(20, 1000), marks=pytest.mark.long)]
)
def test_a_reference_that_stays_gives_no_alarm(seeds):
    """At most as often as the level of a kind of misfit, 0.001, allows: of 980 four (99.6 %)."""
    alarms = sum(bool(of_the_reference(np.random.default_rng(s), np.zeros(2000))) for s in seeds)
    assert alarms <= (0 if len(seeds) == 20 else 4)


def test_an_axis_that_stands_still_on_one_level_has_the_noise_of_rounding():
    """Nothing but zero and one step in 500 readings: no outlier, and no colour of the others."""
    rng = np.random.default_rng(6)
    r = np.column_stack([0.005 * rng.standard_normal((500, 2)), np.zeros(500)])
    r[:, :2] = np.round(r[:, :2], 3)
    r[77, 2] = -0.01
    r -= r.mean(axis=0)
    run = Run.raw("r", {"y": r}, units={}, time=0.02 * np.arange(500))
    found = noise_model([run], [r], [np.arange(0, 500, 12)], measured="y")
    assert found.sigma[2] == pytest.approx(0.01 / np.sqrt(12))
    assert found.outliers == 0
    assert found.colour_p > 0.001


@pytest.mark.parametrize(("share", "verdict"), [(0.03, "adequate"), (0.25, "unexplained")])
def test_every_fourth_row_far_out_is_no_fault_of_a_reading(share, verdict):
    rng = np.random.default_rng(8)
    x = rng.uniform(-1, 1, 2000)
    far = rng.random(2000) < share
    y = 0.2 + 1.1 * x + 0.01 * rng.standard_normal(2000) + far * rng.laplace(0, 0.3, 2000)
    closing = close("linear", {"t": 0.1 * np.arange(2000), "reference": x, "reading": y})
    assert closing.verdict == verdict
    assert ("too many to be faults" in closing.misfit.where) == (share > 0.1)
