"""`close --partitions`: searched in some samples of a record, judged by all of them."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from casest import Run, effects
from casest.cli import run as cli
from casest.data import run as data
from casest.dataset import record
from casest.dataset.record import mapped_record
from casest.diagnose import long_record
from casest.diagnose.long_record import close_long, held_out, looked_at, spacing
from casest.diagnose.record_scores import scores
from casest.diagnose.sensor import Sensor
from casest.engine import by_workers
from casest.estimate import correlation
from casest.estimate.calibrate import attempt, calibrate
from casest.leastsquares import problem, sums
from casest.results.find import find_model

MODEL = '''
from casest import Residual, model, param, quantity, signal


@model
def probe(
    force=signal("N"),
    reading=signal("mV"),
    *,
    zero=param("mV"),
    gain=param("mV/N", start=1.0),
):
    """A force sensor."""
    true = quantity("true", force, "N")
    predicted = quantity("predicted", zero + gain * true, "mV")
    return Residual(measured=reading, predicted=predicted, corrected=true)
'''
#: The whole catalogue takes seconds for each record.
NAMES = ("quadratic", "cubic", "bias_step", "temperature_bias", "creep")
FEW = tuple(e for e in effects.CATALOGUE if e.name in NAMES)
#: One in three is looked at.
COUNT = 25_000


def signals(count=COUNT, seed=0, bend=0.0):
    """Time, force and reading, which bends by `bend` mV at 40 N, with noise of 0.05 mV."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(count)
    force = 40 * np.sin(0.7 * t) + 10 * np.sin(0.31 * t)
    reading = 0.5 + 1.2 * force + bend * (force / 40) ** 2
    reading += 0.05 * rng.standard_normal(count)
    return t, force, reading, 20 + np.sin(0.01 * t) + 0.01 * rng.standard_normal(count)


def table(**how):
    names = ("time [s]", "force [N]", "reading [mV]", "temp [degC]")
    return pa.table(dict(zip(names, signals(**how), strict=True)))


@pytest.fixture
def there(tmp_path, monkeypatch):
    """The model; one sample in three is looked at of records of COUNT."""
    monkeypatch.setattr(long_record, "SEARCHED", 12_000)
    monkeypatch.setattr(effects, "CATALOGUE", FEW)
    monkeypatch.chdir(tmp_path)
    Path("probe.py").write_text(MODEL, encoding="utf-8")
    return find_model("probe.py")


def closed(capsys, *words):
    code = cli(["close", "probe.py", *words, "--json"])
    said = capsys.readouterr()
    return code, json.loads(said.out) if said.out else None, said.err


def run_of(**how):
    t, force, reading, temp = signals(**how)
    run = Run.raw("probe", {"force": force[:, None], "reading": reading[:, None]},
                  units={"force": "N", "reading": "mV"}, time=t)  # fmt: skip
    run.columns["temp"] = temp
    return run


# -- the same as in memory -------------------------------------------------------------------------


@pytest.mark.long
def test_a_record_that_is_looked_at_whole_is_closed_as_any_other(there, capsys):
    pq.write_table(table(count=1500, bend=0.05), "short.parquet")
    _, found, _ = closed(capsys, "short.parquet", "--partitions")
    _, whole, _ = closed(capsys, "short.parquet")
    record = found.pop("whole_record")
    for result in (found, whole):
        del result["reproduce"], result["solver"]
    assert found == whole
    assert (record["samples"], record["looked_at_every"]) == (1500, 1)


@pytest.mark.long
def test_the_cause_and_the_numbers_are_those_of_the_record_in_memory(there, capsys):
    pq.write_table(table(bend=0.05), "long.parquet")
    code, found, _ = closed(capsys, "long.parquet", "--partitions", "-o", "out")
    _, whole, _ = closed(capsys, "long.parquet")
    assert code == 0
    assert found["whole_record"]["looked_at_every"] == 3
    assert [e["name"] for e in found["effects"]] == ["quadratic"]
    assert [e["name"] for e in whole["effects"]] == ["quadratic"]
    assert found["verdict"] == whole["verdict"] == "extended"
    for name, value in whole["after"]["parameters"].items():
        np.testing.assert_allclose(
            found["after"]["parameters"][name]["value"], value["value"], rtol=1e-7
        )
    for side in ("before", "after"):
        assert found[side]["rmse_fit"] == pytest.approx(whole[side]["rmse_fit"], rel=1e-9)
        assert found[side]["rmse_holdout"] == pytest.approx(whole[side]["rmse_holdout"], rel=1e-5)
    assert sorted(p.name for p in Path("out").iterdir()) == [
        "report.html", "residuals.csv", "result.json"]  # fmt: skip
    assert len(Path("out/residuals.csv").read_text().splitlines()) == 1 + 2 * 8334


def test_held_out_errors_are_those_of_fits_to_the_other_folds(there):
    run = run_of(count=4000, bend=0.05)
    estimate = calibrate(there, [run])
    found = held_out(estimate, run)
    _, force, reading, _ = signals(count=4000, bend=0.05)
    A, fold = np.column_stack([np.ones(4000), force]), np.repeat(long_record._folds(40, 0), 100)
    squares = 0.0
    for k in range(4):
        fitted = np.linalg.lstsq(A[fold != k], reading[fold != k])[0]
        squares += np.sum((A[fold == k] @ fitted - reading[fold == k]) ** 2)
    assert found.held_out == pytest.approx(np.sqrt(squares / 4000), rel=1e-9)
    assert found.pieces.sum() == pytest.approx(squares, rel=1e-9)


def test_any_number_of_workers_gives_the_same_bits(there, monkeypatch):
    monkeypatch.setenv("CASEST_KERNEL", "always")  # else a second fit has what the first compiled
    run, every = long_record.with_columns([run_of(count=13_000)])[0], []
    for count in (1, 2, 3):
        with by_workers(count):
            estimate = attempt(there, [run])
            table = scores(Sensor(there, (run,), FEW), estimate, run)
            every.append((held_out(estimate, run), table))
    for errors, table in every[1:]:
        np.testing.assert_array_equal(errors.pieces, every[0][0].pieces)
        for one, own in zip(every[0][1], table, strict=True):
            assert (one.label, one.chance, one.share) == (own.label, own.chance, own.share)
            np.testing.assert_array_equal(one.sizes, own.sizes)


# -- what all samples say --------------------------------------------------------------------------


def test_the_score_of_a_cause_is_that_of_its_fit(there):
    run = long_record.with_columns([run_of(count=6000, bend=0.004)])[0]
    estimate = attempt(there, [run])
    sensor = Sensor(there, (run,), FEW)
    found = {s.label: s for s in scores(sensor, estimate, run)}
    own = found["quadratic"]
    model = own.what.added_to(there)
    fitted = attempt(model, [run])
    np.testing.assert_allclose(own.sizes, fitted.values["quadratic.k"], rtol=1e-6)
    np.testing.assert_allclose(own.stds, fitted.std["quadratic.k"], rtol=0.3)
    costs = [2 * e.problem.cost(e.point) for e in (estimate, fitted)]
    assert own.share == pytest.approx(1 - costs[1] / costs[0], rel=1e-6)


@pytest.mark.long
def test_what_is_too_small_for_the_rows_is_named_by_all_samples(there):
    run = run_of(count=400_000, bend=0.0015)
    few = looked_at(run, spacing(len(run)))
    assert len(few) == 11_765
    found = close_long(there, run, catalogue=FEW)
    assert [f.candidate.label for f in found.closing.effects] == ["quadratic"]
    k = found.closing.after.values["quadratic.k"] * (1.2 * 40) ** 2
    assert abs(k - 0.0015) < 3 * found.closing.after.std["quadratic.k"] * (1.2 * 40) ** 2
    assert not long_record.loop.close(there, [few], catalogue=FEW).effects


def test_noise_shows_nothing(there):
    chances = []
    for seed in range(6):
        run = long_record.with_columns([run_of(count=2000, seed=seed)])[0]
        sensor = Sensor(there, (run,), FEW)
        chances.append(min(s.chance for s in scores(sensor, attempt(there, [run]), run)))
    assert min(chances) > 1e-3


@pytest.mark.long
def test_memory_does_not_grow_with_the_record(there, tmp_path, monkeypatch):
    for module, name in ((problem, "LOOKED"), (problem, "BLOCK"), (sums, "BLOCK"),
                         (sums, "SAMPLED"), (correlation, "SAMPLED"), (record, "BATCH"),
                         (data, "LOOK")):  # fmt: skip
        monkeypatch.setattr(module, name, 4000)
    monkeypatch.setattr(problem, "COPIED", 0)
    monkeypatch.setenv("CASEST_KERNEL", "off")  # a compiler's source is memory, too
    peaks = []
    for count in (48_000, 96_000):  # one in four and one in eight: as many are looked at
        pq.write_table(table(count=count, bend=0.05), f"{count}.parquet", row_group_size=4000)
        (tmp_path / str(count)).mkdir()
        tracemalloc.start()
        run = mapped_record(f"{count}.parquet", there.signals, tmp_path / str(count), kept=None)
        found = close_long(there, run, catalogue=FEW)
        assert found.closing.effects
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # One number of each further sample would be 0.38 MB.
    assert peaks[1] - peaks[0] < 0.2e6


# -- what is refused -------------------------------------------------------------------------------


REFUSED = {
    "two": (["a.parquet", "b.parquet"], "2 data sets; give one"),
    "rest": (["a.parquet", "--at-rest"], "--at-rest needs all samples in memory"),
    "holdout": (["a.parquet", "--holdout", "b.parquet"], "--holdout needs all samples in memory"),
    "none": (["nowhere"], "no Parquet files there"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_in_a_sentence(there, capsys, case):
    words, expected = REFUSED[case]
    code, _, said = closed(capsys, *words, "--partitions")
    assert code == 1
    assert expected in said
    assert len(said.strip().splitlines()) == 1


def test_a_fit_that_is_refused_is_written_with_its_reasons(there, capsys):
    twice = MODEL.replace("gain=", 'other=param("mV"),\n    gain=').replace(
        "zero +", "zero + other +"
    )
    Path("probe.py").write_text(twice, encoding="utf-8")
    pq.write_table(table(), "a.parquet")
    code, found, said = closed(capsys, "a.parquet", "--partitions", "-o", "out")
    assert code == 2
    assert found["trusted"] is False
    assert found["samples"][0]["samples"] == COUNT
    assert "no trustworthy estimate: not determined" in said
    assert json.loads(Path("out/result.json").read_text())["trusted"] is False


def test_workers_are_for_partitions(there, capsys):
    pq.write_table(table(count=1500), "short.parquet")
    code, _, said = closed(capsys, "short.parquet", "--workers", "2")
    assert code == 1
    assert "--workers is for a record in --partitions" in said


def test_what_is_not_tried_is_said(there):
    run = run_of()
    found = close_long(there, run, catalogue=FEW)
    reasons = {s.name: s.reason for s in found.closing.skipped}
    assert "one in 3 is looked at; close a stretch" in reasons["creep"]
