"""What sensors have in common: named by thousands of which none shows it, else not named."""

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
    assert {"soft_iron", "cross_axis"} <= set(found["invisible"])


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
