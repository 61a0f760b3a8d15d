"""What sensors have in common, or each in a size of its own: named by thousands, else not."""

from __future__ import annotations

import json

import fleets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from casest import calibrate_many
from casest.cli import run
from casest.effects import CATALOGUE
from casest.fleet.common import CHANCE, added, seen, trials
from casest.fleet.spread import excess
from casest.results.find import find_model

NORM = find_model("norm-triangular").having(norm=fleets.GRAVITY)
LOWER = np.tril_indices(3)


def unknowns(found):
    return np.concatenate([found.values["scale"][:, *LOWER], found.values["offset"]], axis=1)


def asked(v):
    found = calibrate_many(NORM, {"v": v})
    every = trials(NORM, CATALOGUE)
    for trial in every:
        added(trial, unknowns(found), [v], np.arange(len(v)) % 2, {})
    return {t.effect.name: t for t in every if seen(t)}


def with_cubic(v, size):
    """A cubic in the reading, of `size` m/s² at 1 g on every axis."""
    return v + size * (v / fleets.GRAVITY) ** 3


def close(file, *words):
    return run(["close", "norm-triangular", str(file), "--sensor", "sensor", *fleets.NORM, *words])


@pytest.mark.long
def test_an_effect_that_no_sensor_shows_is_named_by_three_thousand(tmp_path, capsys):
    """0.2 standard deviations in each sensor; its size is right, and sensors held out agree."""
    size, count = 0.0075, 3000
    v = with_cubic(fleets.readings(count), size)
    file = tmp_path / "a.parquet"
    pq.write_table(fleets.wide(v, fleets.names(count)), file)
    assert close(file, "-o", str(tmp_path / "out")) == 0
    assert "3000 sensors have cubic in common" in " ".join(capsys.readouterr().out.split())
    page = (tmp_path / "out" / "common.html").read_text(encoding="utf-8")
    assert "3,000 sensors have cubic in common." in page
    assert "sigma before" in page
    found = json.loads((tmp_path / "out" / "common.json").read_text())
    (effect,) = found["effects"]
    assert effect["name"] == "cubic"
    # corrected = reading − size·(reading/g)³ to first order: k = −size/g³ in that unit
    for value, std in effect["parameters"].values():
        assert abs(value + size / fleets.GRAVITY**3) < 4 * std
        assert abs(value) < 0.25 * std * np.sqrt(count)  # what one sensor shows of it
    assert effect["sigma_after"] < effect["sigma_before"]
    assert effect["sigma_after"] == pytest.approx(fleets.SIGMA, rel=0.01)
    assert {"gain_matrix", "cross_axis"} <= set(found["invisible"])


def test_one_such_sensor_alone_shows_nothing():
    v = with_cubic(fleets.readings(30), 0.0075)
    assert all(t.whole.chance()[1] > 0.01 for t in asked(v).values())


@pytest.mark.long
def test_fleets_without_an_effect_are_told_of_none():
    """Chances of all effects over 12 fleets are as even as chances are."""
    from scipy.stats import kstest

    chances = {}
    for seed in range(12):
        for name, trial in asked(fleets.readings(300, 100 + seed)).items():
            chances.setdefault(name, []).append(trial.whole.chance()[1])
    assert len(chances) >= 6
    for name, own in chances.items():
        assert kstest(own, "uniform").pvalue > 1e-3, name
        assert min(own) > CHANCE / len(chances)


def test_the_column_that_an_effect_follows_is_named(tmp_path):
    lines = np.arange(1000) % 4
    v = fleets.readings(1000)
    v = np.where((lines == 1)[:, None, None], with_cubic(v, 0.02), v)
    table = fleets.wide(v, fleets.names(1000))
    table = table.append_column("line", pa.array([f"L{k}" for k in lines]))
    table = table.append_column("shift", pa.array((np.arange(1000) // 7) % 3))
    pq.write_table(table, tmp_path / "a.parquet")
    words = ["--keep", "line", "--keep", "shift", "-o", str(tmp_path / "out")]
    assert close(tmp_path / "a.parquet", *words) == 0
    (effect, *_) = json.loads((tmp_path / "out" / "common.json").read_text())["effects"]
    assert effect["name"] in ("cubic", "signed_quadratic")
    assert effect["follows"]["line"] < 1e-6
    assert effect["follows"]["shift"] > 0.001


def test_keep_alone_and_a_second_file_are_refused(tmp_path, capsys):
    assert run(["close", "norm-triangular", "a.csv", "--keep", "line"]) == 1
    assert "say --sensor COLUMN too" in capsys.readouterr().err
    assert close(tmp_path / "a.parquet", str(tmp_path / "b.parquet")) == 1
    assert "a fleet is one data set, whose halves are held out in turn" in capsys.readouterr().err


# -- a size of its own in each ---------------------------------------------------------------------


def spreads(v):
    """Excess of every effect that poses can show, by name."""
    found = calibrate_many(NORM, {"v": v})
    told = {}
    for trial in trials(NORM, CATALOGUE):
        added(trial, unknowns(found), [v], np.arange(len(v)) % 2, {})
        if seen(trial):
            told[trial.effect.name] = excess(trial, unknowns(found), [v])
    return told


def noises(kind, shape, rng):
    """Of 0.01 m/s², and not alike everywhere."""
    plain = 0.01 * rng.standard_normal(shape)
    return {
        "one axis louder": lambda: plain * [1, 1, 4],
        "heavy tails": lambda: 0.01 * rng.standard_t(3, shape),
        "spikes": lambda: plain + 0.3 * (rng.random(shape) < 0.002) * rng.standard_normal(shape),
        "each its own": lambda: plain * np.exp(rng.standard_normal((shape[0], 1, 1))),
    }[kind]()


@pytest.mark.long
@pytest.mark.parametrize("kind", ["one axis louder", "heavy tails", "spikes", "each its own"])
def test_noise_of_any_kind_is_no_spread(kind):
    """Mean excess in its standard errors over 6 fleets: as far from zero as chance has it."""
    rng, far = np.random.default_rng(11), {}
    for seed in range(6):
        silent = fleets.readings(800, seed, noise=0.0)
        for name, own in spreads(silent + noises(kind, silent.shape, rng)).items():
            if own.told > 400:
                far.setdefault(name, []).append(own.chance()[0])
    assert len(far) >= 5
    for name, t in far.items():
        assert abs(np.sum(t)) / np.sqrt(len(t)) < 3.5, name
        assert max(t) < 4, name


def test_the_excess_of_a_spread_is_its_information():
    """One sensor's poses, read 4000 times, once with louder poses: E[θᵀIθ], by NumPy."""
    rng = np.random.default_rng(5)
    one = fleets.readings(1, 3, noise=0.0)
    loud = rng.uniform(0.3, 3, one.shape)
    v = one + 0.01 * loud * rng.standard_normal((4000, *one.shape[1:]))
    found = calibrate_many(NORM, {"v": v})
    cubic = next(t for t in trials(NORM, CATALOGUE) if t.effect.name == "cubic")
    nothing = excess(cubic, unknowns(found), [v])
    assert abs(nothing.chance()[0]) < 3.5
    size = 0.05
    own = size * rng.standard_normal((4000, 1, 3))
    v = v + own * (v / fleets.GRAVITY) ** 3
    found = calibrate_many(NORM, {"v": v})
    told = excess(cubic, unknowns(found), [v])

    def norm(x):
        scale, y = np.zeros((3, 3)), one[0] + x[9:] * one[0] ** 3
        scale[LOWER] = x[:6]
        return np.linalg.norm((y - x[6:9]) @ scale.T, axis=1)

    x = np.append(np.median(unknowns(found), axis=0), np.zeros(3))
    J = np.stack([(norm(x + h) - norm(x - h)) / 2e-6 for h in 1e-6 * np.eye(12)], axis=1)
    G = J[:, 9:] - J[:, :9] @ np.linalg.lstsq(J[:, :9], J[:, 9:])[0]
    expected = (size / fleets.GRAVITY**3) ** 2 * np.sum(G**2)
    mean = np.nanmean(told.over)
    assert mean == pytest.approx(expected, abs=4 * np.nanstd(told.over) / np.sqrt(4000))
    assert mean > 8 * np.nanstd(told.over) / np.sqrt(4000)
    rms, error = told.size
    assert np.all(np.abs(rms - size / fleets.GRAVITY**3) < 4 * error)


@pytest.mark.long
@pytest.mark.parametrize("common", [0.0, 0.0075])
def test_an_effect_that_differs_from_sensor_to_sensor_is_named(tmp_path, capsys, common):
    """Half a standard deviation in each, around nothing or around what all have in common."""
    rng = np.random.default_rng(3)
    own = common + 0.02 * rng.standard_normal((3000, 1, 3))
    readings = fleets.readings(3000, 7)
    v = readings + own * (readings / fleets.GRAVITY) ** 3
    file = tmp_path / "a.parquet"
    pq.write_table(fleets.wide(v, fleets.names(3000)), file)
    assert close(file, "-o", str(tmp_path / "out")) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "each in a size of its own" in said
    page = (tmp_path / "out" / "common.html").read_text(encoding="utf-8")
    assert "each in a size of its own" in page
    found = json.loads((tmp_path / "out" / "common.json").read_text())
    assert [e["name"] for e in found["effects"]] == (["cubic"] if common else [])
    assert "cubic" in {found["own"]["name"], *found["own"]["indistinguishable_from"]}
    assert found["own"]["name"] == "cubic" or not common
    assert not {"axis_gain", "gain_matrix"} & set(found["own"]["indistinguishable_from"])
    # what is left is the noise that was put in, when each has its own
    assert found["own"]["sigma_after"] == pytest.approx(fleets.SIGMA, rel=0.01)
    assert found["own"]["sigma_before"] > 1.02 * fleets.SIGMA


def test_where_poses_are_too_few_for_a_spread_that_is_said(tmp_path, capsys):
    file = tmp_path / "a.parquet"
    pq.write_table(fleets.wide(fleets.readings(60, 1, poses=13), fleets.names(60)), file)
    assert close(file, "-o", str(tmp_path / "out")) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "whether each has something in a size of its own was not asked" in said
    assert "was not asked" in (tmp_path / "out" / "common.html").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "out" / "common.json").read_text())["own_tried"] == {}
