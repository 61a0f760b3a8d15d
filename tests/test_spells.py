"""Spells of a record that contradict each other: standard deviations by how they scatter."""

from __future__ import annotations

import numpy as np
import pytest

from casest import calibrate
from casest.estimate.spells import CHANCE, SPELLS, contradicted


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
