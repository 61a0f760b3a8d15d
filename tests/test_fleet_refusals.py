"""What `casest fleet` refuses in a sentence before it computes, beside what test_fleet shows."""

from __future__ import annotations

import fleets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from casest.cli import run
from casest.dataset import partitions
from casest.results import fleet_rows


@pytest.fixture
def said(tmp_path, capsys, monkeypatch):
    """What is said of a table, or of a file as it lies there."""
    monkeypatch.chdir(tmp_path)

    def ask(table, *words):
        if table is not None:
            pq.write_table(table, "line.parquet")
        assert run([*fleets.WORDS, "line.parquet", "-o", "out", *fleets.NORM, *words]) == 1
        assert not (tmp_path / "out" / "fleet.json").exists()
        return capsys.readouterr().err.removeprefix("casest: ").strip()

    return ask


@pytest.fixture
def line():
    return fleets.wide(fleets.readings(4), fleets.names(4))


def test_options_that_exclude_each_other(said, line):
    assert said(line, "--at-rest").startswith("--at-rest finds rests in one record")
    assert said(line, "--workers", "1", "--processes", "1").startswith(
        "--workers starts workers here: leave out --scheduler and --processes"
    )
    assert said(line, "--noise", "1", "--prior", "x").startswith(
        "--noise: with --prior the noise is that of the fleet"
    )


def test_columns_that_cannot_be_what_they_are_said_to_be(said, line):
    assert said(line, "--keep", "supplier").startswith(
        "line.parquet: no column supplier to keep; it has sensor, vx [m/s^2]"
    )
    words = ["--columns", "v=vx,vy,vz", "--keep", "vx [m/s^2]"]
    assert "holds no one value per sensor" in said(line, *words)
    assert "is of type double, and the name of a sensor is text or a whole number" in said(
        line.append_column("weight", pa.array(np.ones(4))), "--sensor", "weight"
    )
    twice = line.append_column("vx", line["vx [m/s^2]"])
    assert said(twice) == "line.parquet: two columns are named 'vx'; rename one of them"
    assert "no columns vx vy vz for signal v" in said(line.rename_columns(["sensor", *"abc"]))
    assert "holds no columns of numbers" in said(line.select(["sensor"]))


def test_a_unit_of_another_quantity(said, line):
    words = ["--unit", "v=kg", "--unit", "vx=s"]
    assert "its axes mix" in said(line.rename_columns(["sensor", "vx", "vy", "vz"]), *words)


def test_names_that_are_not_there(said, line):
    nobody = line.set_column(0, "sensor", pa.array([None, "", " ", None], pa.string()))
    assert said(nobody) == "line.parquet: holds no row that names a sensor; check the export"


def test_a_column_of_few_values_is_no_name(said, monkeypatch):
    monkeypatch.setattr(partitions, "MOST", 3)
    table = fleets.long(fleets.readings(8), fleets.names(8))
    mixed = table.take(np.random.default_rng(0).permutation(len(table)))
    assert "in long form the rows of a sensor stand together; sort them" in said(mixed)


def test_files_of_which_none_can_be_read(said, tmp_path):
    (tmp_path / "line.parquet").write_bytes(b"PAR1 and no more")
    found = said(None)
    assert found.startswith("line.parquet: none of its 1 files can be read: line.parquet: cannot")


def test_a_model_in_time_without_a_time(tmp_path, capsys):
    file = tmp_path / "drift.py"
    file.write_text(
        "from casest import Residual, model, param, quantity, signal\n\n\n@model\n"
        'def drift(t=signal("s"), y=signal("V"), *, slope=param("V/s")):\n'
        '    return Residual(measured=y, predicted=quantity("p", slope * t, "V"))\n'
    )
    pq.write_table(pa.table({"sensor": ["a"], "y": [[1.0, 2.0]]}), tmp_path / "a.parquet")
    words = ["fleet", str(file), str(tmp_path / "a.parquet"), "-o", str(tmp_path / "out")]
    assert run(words) == 1
    assert "no time column (t, time, timestamp) for signal t; it has y" in capsys.readouterr().err


def test_a_folder_of_something_else(said, line, tmp_path):
    (tmp_path / "out" / "results").mkdir(parents=True)
    assert said(line).startswith("-o out: holds a folder results that casest fleet did not begin")
    (tmp_path / "out" / ".tasks").mkdir()
    (tmp_path / "out" / ".tasks" / "job.json").write_text("{")
    assert said(line) == (
        "out/.tasks/job.json: cannot be read; remove the folder above it, or give another -o"
    )


def test_a_url_without_a_store(said, line, tmp_path, capsys):
    assert run([*fleets.WORDS, "nowhere://line", "-o", str(tmp_path / "out"), *fleets.NORM]) == 1
    assert "nowhere://line: cannot be opened" in capsys.readouterr().err


def test_vectors_of_unequal_length(tmp_path):
    v = fleets.readings(3)
    rows = fleets.vectors(v, fleets.names(3))
    spoilt = rows.to_pylist()
    spoilt[1]["v"][5] = spoilt[1]["v"][5][:2]
    table = pa.Table.from_pylist(spoilt, schema=rows.schema)
    pq.write_table(table, tmp_path / "a.parquet")
    out = tmp_path / "out"
    assert run([*fleets.WORDS, str(tmp_path / "a.parquet"), "-o", str(out), *fleets.NORM]) == 0
    (only,) = fleets.rejected(out)
    assert only["reason"] == "reading 5 of its v has not the 3 numbers of a vector"


def test_of_very_many_sensors_some_partitions_are_drawn(tmp_path, monkeypatch):
    fleets.dataset(tmp_path / "in", files=6, each=50)
    monkeypatch.setattr(partitions, "NUMBERS", 50 * fleets.POSES * 3)
    monkeypatch.setattr(fleet_rows, "LOOKED_AT", 100)
    out = tmp_path / "out"
    words = [*fleets.WORDS, str(tmp_path / "in"), "-o", str(out), *fleets.NORM]
    assert run([*words, "--processes", "1"]) == 0
    page = (out / "fleet.html").read_text()
    assert "300 of 300 sensors trusted." in page
    assert "Not looked for among so many: drawn are 100 sensors." in page
