"""Optima on a bound: certified with the others' spread, an interval with one end, or refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, stats

from casest import Residual, Run, attempt, cos, exp, inf, model, param, quantity, signal, sin
from casest.report.text.layout import value_table
from casest.results.observability import observe_parameters
from casest.results.values import entries

SIGMA = 0.1


@model
def mixture(
    a=signal(), b=signal(), c=signal(), y=signal(), *,
    first=param(start=0.5, bounds=(0, inf)),
    second=param(start=0.5, bounds=(0, inf)),
    third=param(start=0.5, bounds=(0, inf)),
):  # fmt: skip
    return Residual(measured=y, predicted=quantity("reading", first * a + second * b + third * c))


def run_of(**columns):
    found = {name: np.asarray(v, float)[:, None] for name, v in columns.items()}
    return Run.raw("rows", found, units={})


def mixed(seed, truth, rows=60):
    """Overlapping spectra, as of a mixture of three substances."""
    rng, place = np.random.default_rng(seed), np.linspace(0, 1, rows)
    A = np.exp(-(((place[:, None] - [0.3, 0.45, 0.7]) / 0.15) ** 2))
    y = A @ truth + SIGMA * rng.standard_normal(rows)
    return A, y, run_of(a=A[:, 0], b=A[:, 1], c=A[:, 2], y=y)


def seeds_with_a_zero(count):
    """Records in which SciPy's non-negative least squares puts the absent substance on zero."""
    found = [s for s in range(4 * count) if optimize.nnls(*mixed(s, [1, 0, 2])[:2])[0][1] == 0]
    return found[:count]


@pytest.mark.parametrize("seed", seeds_with_a_zero(5))
def test_a_share_that_is_zero_is_certified_at_the_non_negative_least_squares_solution(seed):
    A, y, run = mixed(seed, [1, 0, 2])
    found = attempt(mixture, [run])
    expected, _ = optimize.nnls(A, y)
    assert found.certificate.trusted, found.certificate.reasons
    assert [b.name for b in found.certificate.at_bound] == ["second"]
    values = [float(found.values[n]) for n in ("first", "second", "third")]
    np.testing.assert_allclose(values, expected, atol=1e-7)


def test_the_others_have_the_spread_that_they_have_with_the_bound_held():
    (seed,) = seeds_with_a_zero(1)
    _, _, run = mixed(seed, [1, 0, 2])
    found, held = attempt(mixture, [run]), attempt(mixture.having(second=0.0), [run])
    assert np.isnan(found.std["second"])
    for name in ("first", "third"):
        # The degree of freedom is counted where the unknown was asked for.
        assert float(found.plain[name]) == pytest.approx(float(held.plain[name]), rel=0.01)


@model
def decaying(
    t=signal(), y=signal(), *,
    rest=param(start=0.2, bounds=(0, inf)), size=param(start=1.0), rate=param(start=1.0),
    wave=param(2),
):  # fmt: skip
    waves = wave[0] * sin(6 * t) + wave[1] * cos(6 * t)
    predicted = size * exp(-rate * t) + rest + waves
    return Residual(measured=y, predicted=quantity("reading", predicted))


@pytest.mark.parametrize("seed", [1, 2, 4, 5, 6, 7])
def test_the_cost_is_walked_along_in_all_directions_that_a_held_bound_leaves(seed):
    """By the rounding of a direction half of them led beyond the bound, and were left out."""
    t = np.linspace(0, 2, 30)
    noise = 0.02 * np.random.default_rng(seed).standard_normal(t.size)
    run = run_of(t=t, y=np.exp(-0.5 * t) - 0.02 + noise)
    found, held = attempt(decaying, [run]), attempt(decaying.having(rest=0.0), [run])
    assert [b.name for b in found.certificate.at_bound] == ["rest"]
    # The walk is two standard deviations long, of one degree of freedom more.
    np.testing.assert_allclose(found.certificate.shape, held.certificate.shape, rtol=5e-4)


@pytest.mark.parametrize(
    ("true", "records"),
    [(0.02, 60), *(pytest.param(true, 300, marks=pytest.mark.long) for true in (0.0, 0.02, 0.05))],
)
def test_intervals_hold_the_truth_as_often_as_they_say_on_the_bound_and_near_it(true, records):
    held, on = 0, 0
    for seed in range(records):
        found = attempt(mixture, [mixed(seed, [1, true, 2])[2]])
        assert found.certificate.trusted, found.certificate.reasons
        below, above = (float(side["second"]) for side in found.interval_reach)
        value = float(found.values["second"])
        assert value - below >= 0
        held += value - below <= true <= value + above
        on += bool(found.certificate.at_bound)
    assert on > records / 30
    # 95 % of them, less three standard errors.
    assert held / records > 0.95 - 3 * np.sqrt(0.95 * 0.05 / records)


def test_an_upper_bound_is_one_too():
    """The truth lies on it, as a full share does; SciPy's bounded solver says what is right."""
    seen = 0
    for seed in range(12):
        A, y, run = mixed(seed, [1, 0.5, 2])
        right = optimize.lsq_linear(A, y, ([0, 0, 0], [np.inf, np.inf, 2]), tol=1e-12).x
        if right[2] < 2 - 1e-9:
            continue
        seen += 1
        found = attempt(mixture.having(third=param(start=0.5, bounds=(0, 2))), [run])
        (only,) = found.certificate.at_bound
        assert found.certificate.trusted, found.certificate.reasons
        assert (only.name, only.upper, only.bound) == ("third", True, 2)
        values = [float(found.values[n]) for n in ("first", "second", "third")]
        np.testing.assert_allclose(values, right, atol=1e-5)
        assert float(found.interval_reach[1]["third"]) == 0
        assert 0 < float(found.interval_reach[0]["third"]) < 0.2
    assert seen >= 3


def test_a_bound_that_the_data_contradict_is_refused_with_how_far():
    _, _, run = mixed(1, [1, 0.5, 2])
    capped = mixture.having(third=param(start=0.5, bounds=(0, 1.0)))
    found = attempt(capped, [run])
    assert not found.certificate.trusted
    assert (
        "`third` ended on its bound (0, 1): the data ask for a value"
        in (found.certificate.reasons[0])
    )
    assert "standard deviations beyond it" in found.certificate.reasons[0]


@model
def cooling(
    x=signal(), y=signal(), *,
    level=param(), size=param(start=1.0), rate=param(start=0.5, bounds=(0, inf)),
    drift=param(start=0.1, bounds=(0, inf)),
):  # fmt: skip
    return Residual(
        measured=y, predicted=quantity("reading", level + size * exp(-rate * x) + drift * x)
    )


def bare(x, level, size, rate):
    return level + size * np.exp(-rate * x)


def test_a_rate_of_drift_that_is_zero_beside_a_curve_is_certified():
    x, trusted = np.linspace(0, 6, 80), 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        y = 1 + 2 * np.exp(-0.8 * x) + 0.02 * rng.standard_normal(80)
        found = attempt(cooling, [run_of(x=x, y=y)])
        if not found.certificate.at_bound:
            continue
        trusted += 1
        assert found.certificate.trusted, found.certificate.reasons
        curve, spread = optimize.curve_fit(
            lambda x, a, b, k: a + b * np.exp(-k * x), x, y, [1, 1, 1]
        )
        values = [float(found.values[n]) for n in ("level", "size", "rate")]
        np.testing.assert_allclose(values, curve, rtol=1e-5)
        own = [float(found.plain[n]) for n in ("level", "size", "rate")]
        np.testing.assert_allclose(own, np.sqrt(np.diag(spread)), rtol=0.02)
    assert trusted >= 3


def test_an_interval_ends_at_a_bound_that_is_near():
    """A value nearer than two standard deviations to its bound: the interval ends at the bound."""
    seen = 0
    for seed in range(12):
        _, _, run = mixed(seed, [1, 0.05, 2])
        found = attempt(mixture, [run])
        assert found.certificate.trusted, found.certificate.reasons
        value, std = float(found.values["second"]), float(found.std["second"])
        if found.certificate.at_bound or value > 1.9 * std:
            continue
        seen += 1
        assert float(found.interval_reach[0]["second"]) == pytest.approx(value)
        t = stats.t.ppf(0.975, 57)
        assert float(found.interval_reach[1]["second"]) == pytest.approx(t * std, rel=1e-6)
    assert seen >= 3


def test_the_prompt_says_where_its_interval_ends():
    (seed,) = seeds_with_a_zero(1)
    lines = list(value_table(entries(attempt(mixture, [mixed(seed, [1, 0, 2])[2]]))))
    (line,) = [line for line in lines if "second" in line]
    assert "0   on its bound; below 0.0" in line
    assert "not determined" not in line


def test_what_the_data_see_of_a_value_on_its_bound_is_its_std_were_it_free():
    (seed,) = seeds_with_a_zero(1)
    _, _, run = mixed(seed, [1, 0, 2])
    free = param(start=0.5)
    unbounded = attempt(mixture.having(first=free, second=free, third=free), [run])
    seen = observe_parameters(mixture, [run])
    assert float(seen.std["second"]) == pytest.approx(float(unbounded.plain["second"]), rel=0.1)


def test_an_end_of_the_bounds_that_is_none_is_open():
    assert param(start=0.5, bounds=(0, None)) == param(start=0.5, bounds=(0, inf))
