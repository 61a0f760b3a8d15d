"""`calibrate --partitions`: one record, larger than memory, with the numbers of that in memory."""

from __future__ import annotations

import errno
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from casest import load_runs
from casest.cli import run as cli
from casest.data import run as data
from casest.dataset import record
from casest.dataset.record import mapped_record
from casest.engine import by_workers, kernel, replay
from casest.estimate import correlation
from casest.estimate.calibrate import attempt
from casest.leastsquares import problem, sums
from casest.results.calibration import calibration_result
from casest.results.find import find_model

MODEL = '''
from casest import Residual, model, param, quantity, signal


@model
def probe(
    t=signal("s"),
    force=signal("N"),
    reading=signal("mV"),
    *,
    zero=param("mV"),
    gain=param("mV/N", start=1.0),
    drift=param("mV/s"),
):
    """A force sensor whose zero drifts."""
    true = quantity("true", force, "N")
    predicted = quantity("predicted", zero + gain * true + drift * t, "mV")
    return Residual(measured=reading, predicted=predicted, corrected=true)
'''
NAMES = ("time [ms]", "force [kN]", "reading [mV]", "note")


def table(count=5000, seed=0):
    """What the probe reads: force in kN, time in ms from 7 s on, a gap, a cell without a number."""
    rng = np.random.default_rng(seed)
    t = 7.0 + 0.01 * np.arange(count)
    t[count // 2 :] += 3.0
    force = 50 + 40 * np.sin(0.3 * t)
    reading = 0.5 + 1.2 * force + 2e-3 * (t - 7.0) + 0.05 * rng.standard_normal(count)
    reading[count // 3] = np.nan
    return pa.table(
        dict(zip(NAMES, (1e3 * t, force / 1e3, reading, rng.random(count)), strict=True))
    )


@pytest.fixture
def there(tmp_path, monkeypatch):
    """The model, the whole record as one file, and as a folder of three in batches of 700."""
    monkeypatch.setattr(record, "BATCH", 700)
    monkeypatch.chdir(tmp_path)
    Path("probe.py").write_text(MODEL, encoding="utf-8")
    whole = table()
    pq.write_table(whole, "whole.parquet")
    Path("parts").mkdir()
    for k, (a, b) in enumerate([(0, 1500), (1500, 1503), (1503, 5000)]):
        pq.write_table(whole.slice(a, b - a), f"parts/{k}.parquet", row_group_size=1000)
    return find_model("probe.py")


def calibrated(capsys, *words):
    code = cli(["calibrate", "probe.py", *words, "--json"])
    said = capsys.readouterr()
    return code, json.loads(said.out) if said.out else None, said.err


# -- the same numbers ------------------------------------------------------------------------------


def test_a_record_in_parts_is_the_record(there, tmp_path):
    (tmp_path / "room").mkdir()
    found = mapped_record("parts", there.signals, tmp_path / "room", kept=["note"])
    (whole,) = load_runs(["whole.parquet"], there.signals)
    for name in (s.name for s in there.signals):
        np.testing.assert_array_equal(found.signals[name], whole.signals[name])
    np.testing.assert_array_equal(found.time, whole.time)
    np.testing.assert_array_equal(found.block, whole.block)
    np.testing.assert_array_equal(found.columns["note"], whole.columns["note"])
    assert len(found) == 4999
    assert dict(found.units) == dict(whole.units)
    assert any("rows dropped: 1 without reading" in note for note in found.notes)


@pytest.mark.parametrize("dataset", ["parts", "parts/*.parquet"])
def test_what_is_estimated_is_what_the_record_in_memory_gives(there, capsys, dataset):
    code, found, said = calibrated(capsys, dataset, "--partitions", "-o", "out")
    assert code == 0
    _, whole, _ = calibrated(capsys, "whole.parquet")
    assert found["estimate"] == whole["estimate"]
    assert found["noise"] == whole["noise"]
    assert found["misfit"] is None
    assert "residuals.csv, report.html and the question whether the residual is noise are" in said
    assert sorted(p.name for p in Path("out").iterdir()) == ["result.json"]


def test_any_number_of_workers_gives_the_same_bits(there, tmp_path, monkeypatch):
    monkeypatch.setattr(kernel, "PIECE", 300)
    monkeypatch.setattr(kernel, "PIECES", 5)
    monkeypatch.setenv("CASEST_KERNEL", "always")
    run = mapped_record("parts", there.signals, tmp_path)
    every = []
    for count in (1, 2, 3):
        with by_workers(count):
            every.append(attempt(there, [run]))
    for other in every[1:]:
        np.testing.assert_array_equal(other.point.x, every[0].point.x)
        np.testing.assert_array_equal(other.covariance, every[0].covariance)
    monkeypatch.undo()
    (whole,) = load_runs([tmp_path / "whole.parquet"], there.signals)
    at_once = attempt(there, [whole])
    np.testing.assert_allclose(every[0].point.x, at_once.point.x, rtol=1e-12)


def test_memory_does_not_grow_with_the_record(there, tmp_path, monkeypatch):
    for module, name in ((problem, "LOOKED"), (problem, "BLOCK"), (sums, "BLOCK"),
                         (sums, "SAMPLED"), (correlation, "SAMPLED"), (record, "BATCH"),
                         (data, "LOOK")):  # fmt: skip
        monkeypatch.setattr(module, name, 4000)
    monkeypatch.setattr(problem, "COPIED", 0)
    monkeypatch.setenv("CASEST_KERNEL", "off")  # a compiler's source is memory, too
    peaks = []
    for count in (2 * replay.BLOCK + 1, 6 * replay.BLOCK + 1):  # whole blocks
        pq.write_table(table(count), f"{count}.parquet", row_group_size=4000)
        (tmp_path / str(count)).mkdir()
        tracemalloc.start()
        run = mapped_record(f"{count}.parquet", there.signals, tmp_path / str(count))
        found = attempt(there, [run])
        assert found.certificate.trusted
        calibration_result(found, model_name="probe", data=[]).content()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # One number of each further sample would be 0.29 MB.
    assert peaks[1] - peaks[0] < 0.1e6


SOURCE = """
import pyarrow.parquet

WHOLE = pyarrow.parquet.read_table("whole.parquet")


def tables():
    for first in (0, 1500, 1503):
        yield WHOLE.slice(first, 1500 if not first else 3 if first == 1500 else None)


def broken():
    yield WHOLE.slice(0, 700)
    raise OSError("the disk is gone")


def numbers():
    return [{"time [ms]": [1.0]}, 3.0]


something = 7
"""


def test_tables_that_a_function_makes_are_the_record(there, capsys):
    Path("source.py").write_text(SOURCE, encoding="utf-8")
    _, found, _ = calibrated(capsys, "source.py:tables", "--partitions")
    _, whole, _ = calibrated(capsys, "parts", "--partitions")
    assert found["estimate"] == whole["estimate"]
    assert [len(digest) for digest in found["reproduce"]["sha256"].values()] == [64]


WRONG = {
    "source.py:tabels": "no function 'tabels'",
    "source.py:something": "no function 'something'",
    "source.py:broken": "source.py:broken, part 1: OSError: the disk is gone",
    "source.py:numbers": "source.py:numbers, part 0",
    "nothing.py:tables": "nothing.py: no such file",
}


@pytest.mark.parametrize("name", WRONG)
def test_a_function_that_makes_no_record_is_named(there, capsys, name):
    Path("source.py").write_text(SOURCE, encoding="utf-8")
    code, _, said = calibrated(capsys, name, "--partitions", "-o", "out")
    assert code == 1
    assert WRONG[name] in said
    assert len(said.strip().splitlines()) == 1
    assert not Path("out").exists()


# -- what is refused -------------------------------------------------------------------------------


REFUSED = {
    "two": (["whole.parquet", "parts"], "2 data sets; give one"),
    "rest": (["parts", "--at-rest"], "--at-rest needs all samples in memory"),
    "holdout": (["parts", "--holdout", "whole.parquet"], "--holdout needs all samples in memory"),
    "law": (["parts", "--noise-law", "t"], "--noise-law needs all samples in memory"),
    "none": (["nowhere"], "no Parquet files there"),
    "csv": (["probe.py"], "cannot be read as Parquet"),
    "column": (["parts", "--columns", "force=newton"], "newton"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_in_a_sentence(there, capsys, case):
    words, expected = REFUSED[case]
    code, _, said = calibrated(capsys, *words, "--partitions")
    assert code == 1
    assert expected in said
    assert len(said.strip().splitlines()) == 1


def test_workers_are_for_partitions(there, capsys):
    code, _, said = calibrated(capsys, "whole.parquet", "--workers", "2")
    assert code == 1
    assert "--workers is for a record in --partitions" in said


def test_files_out_of_their_order_are_named(there, capsys):
    Path("parts/2.parquet").rename("parts/a.parquet")
    Path("parts/0.parquet").rename("parts/b.parquet")
    code, _, said = calibrated(capsys, "parts", "--partitions")
    assert code == 1
    assert "parts/a.parquet" in said or "parts/b.parquet" in said
    assert "goes backward" in said


def test_a_number_too_large_is_named_with_its_file(there, capsys):
    whole = table(1500)
    huge = np.where(np.arange(1500) == 900, 1e300, 1.0)
    pq.write_table(whole.set_column(2, "reading [mV]", pa.array(huge)), "parts/0.parquet")
    code, _, said = calibrated(capsys, "parts", "--partitions")
    assert code == 1
    assert "parts/0.parquet" in said
    assert "rows are counted from row 700 of the file" in said


def test_a_signal_that_never_changes_is_dead(there, capsys):
    still = pa.array(np.ones(5000))
    pq.write_table(table().set_column(2, "reading [mV]", still), "still.parquet")
    code, _, said = calibrated(capsys, "still.parquet", "--partitions")
    assert code == 1
    assert "a dead channel" in said


def test_a_full_disk_is_said_and_nothing_written(there, capsys, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(record.os, "posix_fallocate", full)
    code, _, said = calibrated(capsys, "parts", "--partitions", "-o", "out")
    assert code == 1
    assert "no room for" in said
    assert "TMPDIR names another folder" in said
    assert not Path("out").exists()
