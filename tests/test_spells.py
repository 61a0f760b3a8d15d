"""Spells of a record that contradict each other: standard deviations by how they scatter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from casest import calibrate
from casest.estimate.spectrum import _most_likely
from casest.estimate.spells import CHANCE, SPELLS, at_most, contradicted


def record(rng, path, rows, scatter):
    """A gain that is another one in each of 40 spells; the noise is white."""
    x = rng.standard_normal(rows)
    gain = 2 + scatter * np.repeat(rng.standard_normal(40), rows // 40)
    y = 1 + gain * x + 0.1 * rng.standard_normal(rows)
    table = np.column_stack([0.01 * np.arange(rows), x, y])
    np.savetxt(path, table, delimiter=",", header="t,reference,reading", comments="")
    return path


def z_of(found):
    return (float(found.values["gain"]) - 2) / float(found.std["gain"])


@pytest.mark.long
def test_a_gain_that_differs_from_spell_to_spell_is_as_uncertain_as_it_says(tmp_path):
    """By gains that differ so little that no residual shows it: 2 % of the noise's squares."""
    z = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        z.append(z_of(calibrate("linear", record(rng, tmp_path / "a.csv", 4000, 0.014))))
    # Without: √(1 + 100 · 0.014² / 0.1²) = 1.7.
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.25)


@pytest.mark.long
def test_spells_that_agree_change_nothing(tmp_path):
    """But in one record of a hundred."""
    changed = 0
    for seed in range(60):
        rng = np.random.default_rng(100 + seed)
        found = calibrate("linear", record(rng, tmp_path / "a.csv", 2000, 0.0))
        changed += found.colour_freedom is not None
    assert changed <= 4  # p = 0.0003


@pytest.mark.long
@pytest.mark.parametrize("freedom", [4.0, 9.0, 39.0])
def test_chance_alone_contradicts_a_variance_as_seldom_as_it_says(freedom):
    rng, many, unknowns, contradictions = np.random.default_rng(3), 10_000, 4, 0
    for _ in range(many):
        scatter = rng.chisquare(freedom, unknowns) / freedom
        cuts = [(scatter, np.full(unknowns, freedom))]
        cuts += [(np.zeros(unknowns), np.full(unknowns, freedom))] * (len(SPELLS) - 1)
        more, variance, free = contradicted(np.ones(unknowns), cuts)
        contradictions += more.any()
        assert np.all(np.where(more, variance > 1, variance == 1))
        assert np.all(np.where(more, free == freedom, np.isinf(free)))
    assert contradictions == pytest.approx(many * CHANCE / len(SPELLS), rel=0.5)


def test_few_spells_that_say_all_contradict_nothing():
    more, _, _ = contradicted(np.ones(1), [(np.full(1, 50.0), np.full(1, 1.5))])
    assert not more.any()


@pytest.mark.long
def test_smooth_noise_is_as_uncertain_as_it_is(tmp_path):
    """Noise that was averaged twice (20 samples each): 60 records. Before, the standard deviations
    of the offset were 3.3 times what the values scatter by."""
    off, said = [], []
    kept = np.exp(-1 / 20)
    for seed in range(60):
        rng = np.random.default_rng([9, seed])
        t = np.arange(1500)
        noise = lfilter([1], [1, -kept], lfilter([1], [1, -kept], rng.standard_normal(2500)))[1000:]
        x = np.sin(2 * np.pi * 6 * t / len(t))
        table = np.column_stack([0.01 * t, x, 1 + 2 * x + 0.001 * noise])
        np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="t,reference,reading",
                   comments="")  # fmt: skip
        found = calibrate("linear", tmp_path / "a.csv")
        off.append(float(found.values["offset"]) - 1)
        said.append(float(found.std["offset"]))
    scatter = float(np.sqrt(np.mean(np.square(off))))
    assert 0.8 * scatter < np.median(said) < 1.3 * scatter


def test_what_a_spectrum_draws_on_beyond_its_bands_is_no_more_than_spells_scatter():
    """Chi-square's own quantile: of nine degrees of freedom a variance is at most 4.3 times one."""
    several = [(np.array([1.0, 1.0]), np.array([9.0, 9.0]))]
    most = 9 / chi2.ppf(CHANCE, 9)
    variance = np.array([100.0, 2.0])
    np.testing.assert_allclose(at_most(variance, several, 500, 10.0), [most, 2.0])
    np.testing.assert_allclose(at_most(variance, several, 99, 10.0), variance)
    # By chance it goes below the true variance once in a hundred records.
    seen = np.random.default_rng(1).chisquare(9, 20_000) / 9
    limits = at_most(np.ones(20_000), [(seen, np.full(20_000, 9.0))], 500, 10.0)
    assert np.mean(limits < 1) == pytest.approx(CHANCE, abs=0.003)


def test_a_spectrum_of_which_most_powers_are_nothing_has_a_slope_all_the_same():
    """Eight plateaus of rows that only repeat: it was a singular matrix."""
    mean = np.full((12, 1), 1e-300)
    mean[[2, 7]] = 3e-3
    line = np.column_stack([np.ones(12), np.linspace(-3, -1, 12)])
    assert np.isfinite(_most_likely(line, mean, np.ones((12, 1)))).all()
