"""A fleet's distribution without its noise, and as a prior: six poses do what twelve did."""

from __future__ import annotations

import json

import fleets
import numpy as np
import pyarrow.parquet as pq
import pytest

from casest import calibrate_many
from casest.cli import run
from casest.fleet.population import calibrate_with, population
from casest.results.find import find_model

NORM = find_model("norm-triangular").having(norm=fleets.GRAVITY)
LOWER = np.tril_indices(3)
#: Spread of the fleet that is simulated: of the scale's entries, and of the offset.
SCALE, OFFSET = 0.002, 0.05


def line(count, poses, seed):
    """Readings of sensors from one production, and their true unknowns (S, 9)."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((count, poses, 3))
    u *= fleets.GRAVITY / np.linalg.norm(u, axis=2, keepdims=True)
    A = np.eye(3) + np.tril(SCALE * rng.standard_normal((count, 3, 3)))
    o = 0.1 + OFFSET * rng.standard_normal((count, 3))
    v = np.einsum("sij,snj->sni", np.linalg.inv(A), u) + o[:, None]
    truth = np.concatenate([A[:, LOWER[0], LOWER[1]], o], axis=1)
    return v + fleets.SIGMA * rng.standard_normal(v.shape), truth


def flat(values):
    return np.concatenate([values["scale"][:, LOWER[0], LOWER[1]], values["offset"]], axis=1)


@pytest.fixture(scope="module")
def fleet():
    v, _ = line(2000, 24, 0)
    found = calibrate_many(NORM, {"v": v})
    return population(found.names, flat(found.values), found.covariance, found.sigma)


def test_mean_and_spread_are_those_of_the_sensors_not_of_their_noise(fleet):
    spread = np.r_[np.full(6, SCALE), np.full(3, OFFSET)]
    mean = np.r_[1, 0, 1, 0, 0, 1, 0.1, 0.1, 0.1]
    assert (np.abs(fleet.spread - spread) < 4 * fleet.spread_std).all()
    assert (fleet.spread_std < 0.03 * spread).all()
    assert (np.abs(fleet.mean - mean) < 4 * fleet.mean_std).all()
    assert fleet.sigma == pytest.approx(fleets.SIGMA, rel=0.01)


def test_six_poses_with_the_prior_cover_and_do_what_twelve_did(fleet):
    v, truth = line(4000, 6, 1)
    six = calibrate_with(NORM, {"v": v}, fleet)
    assert six.trusted.mean() > 0.999
    away = flat(six.values) - truth
    assert 0.94 < np.mean(np.abs(away) < 1.96 * flat(six.std)) < 0.96
    v, there = line(4000, 12, 2)
    twelve = calibrate_many(NORM, {"v": v})
    rms = np.sqrt(np.nanmean((flat(twelve.values) - there) ** 2, axis=0))
    assert (np.sqrt(np.mean(away**2, axis=0)) < rms).all()


def test_with_many_poses_the_prior_changes_nothing_that_matters(fleet):
    v, _ = line(50, 200, 3)
    one, other = calibrate_many(NORM, {"v": v}), calibrate_with(NORM, {"v": v}, fleet)
    away = np.abs(flat(one.values) - flat(other.values)) / flat(one.std)
    assert away.max() < 0.5


def test_a_sensor_that_is_none_of_the_fleet_is_refused(fleet):
    v, _ = line(40, 8, 4)
    v[7] += 1.0
    v[9, 2, 1] = np.nan
    found = calibrate_with(NORM, {"v": v}, fleet)
    assert np.flatnonzero(~found.trusted).tolist() == [7, 9]
    assert "larger than the noise" in found.reasons[7][0]
    assert found.reasons[9][0] == "sample 2 is not finite: measure this sensor again"


def test_unequal_numbers_of_poses_change_nobodys_numbers(fleet):
    v, _ = line(3, 8, 5)
    counts = [8, 5, 6]
    together = calibrate_with(NORM, {"v": v}, fleet, counts)
    for k, n in enumerate(counts):
        alone = calibrate_with(NORM, {"v": v[k : k + 1, :n]}, fleet)
        assert np.allclose(flat(alone.values), flat(together.values)[k], rtol=1e-9, atol=1e-12)


def written(folder, v, *words):
    file = folder.with_suffix(".parquet")
    pq.write_table(fleets.wide(v, fleets.names(len(v))), file)
    return run([*fleets.WORDS, str(file), "-o", str(folder), *fleets.NORM, *words])


def test_the_command_takes_the_prior_from_a_fleet(tmp_path, capsys):
    v, _ = line(300, 24, 6)
    assert written(tmp_path / "plain", v) == 0
    assert written(tmp_path / "fleet", v, "--covariance") == 0
    told = json.loads((tmp_path / "fleet" / "fleet.json").read_text())["population"]
    assert told["spread"][6] == pytest.approx(OFFSET, rel=0.15)
    v, truth = line(100, 6, 7)
    assert written(tmp_path / "few", v) == 2
    assert written(tmp_path / "six", v, "--prior", str(tmp_path / "fleet")) == 0
    found = fleets.results(tmp_path / "six")
    away = found["offset[0]"].to_numpy() - truth[:, 6]
    assert np.sqrt(np.mean(away**2)) < 0.5 * OFFSET
    capsys.readouterr()
    assert written(tmp_path / "seven", v, "--prior", str(tmp_path / "plain")) == 1
    said = capsys.readouterr().err
    assert "holds no population of sensors; calibrate that fleet with --covariance" in said
    assert written(tmp_path / "eight", v, "--prior", str(tmp_path / "none")) == 1
    assert "no fleet.json of casest fleet there" in capsys.readouterr().err
    other = ["fleet", "norm-diagonal", str(tmp_path / "six.parquet"), *fleets.NORM]
    words = [*other, "-o", str(tmp_path / "nine"), "--prior", str(tmp_path / "fleet")]
    assert run(words) == 1
    assert "is a fleet of norm-triangular with the unknowns" in capsys.readouterr().err
