"""Other engines call the same function: Arrow in, Arrow out, the same bits however rows are cut."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import fleets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from casest import DataError, UsageError, calibrate_arrow, calibrate_many
from casest.results.find import find_model

EXAMPLES = Path(__file__).parents[1] / "examples"
NORM = find_model("norm-triangular").having(norm=fleets.GRAVITY)


def rows(batches):
    """As Spark's `mapInArrow` calls it."""
    for batch in batches:
        yield from calibrate_arrow(NORM, batch).to_batches()


def test_rows_are_those_of_calibrate_many_however_they_are_cut():
    v = fleets.readings(50)
    v[13, 4, 2] = np.nan
    table, direct = fleets.wide(v, fleets.names(50)), calibrate_many(NORM, {"v": v})
    for size in (50, 7):
        found = pa.Table.from_batches(rows(table.to_batches(max_chunksize=size)))
        assert found["sensor"].cast(pa.string()).to_pylist() == fleets.names(50)
        good = direct.trusted
        offset = found["offset[1]"].to_numpy()
        assert np.array_equal(offset[good], direct.values["offset"][good, 1])
        assert np.isnan(offset[13])
        assert found["reason"][13].as_py() == direct.reasons[13][0]


def test_long_form_and_a_missing_column_are_refused():
    v = fleets.readings(3)
    with pytest.raises(UsageError, match="one row for each sensor"):
        calibrate_arrow(NORM, fleets.long(v, fleets.names(3)))
    with pytest.raises(DataError, match="no column unit says which sensor a row belongs to"):
        calibrate_arrow(NORM, fleets.wide(v, fleets.names(3)), sensor="unit")


def example(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def same_as_in_memory(v, found):
    offsets = {row["sensor"]: row["offset[0]"] for row in found}
    direct = calibrate_many(NORM, {"v": v}).values["offset"][:, 0]
    assert [offsets[name] for name in fleets.names(len(v))] == direct.tolist()


# Warnings of these engines about themselves are theirs.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_spark_calls_it(tmp_path, monkeypatch):
    monkeypatch.setenv("PYSPARK_PYTHON", sys.executable)  # its workers need casest too
    sql = pytest.importorskip("pyspark.sql", reason="Spark is not installed")
    v = fleets.readings(40)
    pq.write_table(fleets.wide(v, fleets.names(40)), tmp_path / "line.parquet")
    spark = sql.SparkSession.builder.master("local[1]").getOrCreate()
    frame = spark.read.parquet(str(tmp_path / "line.parquet"))
    found = example("fleet_spark").calibrated(frame).collect()
    same_as_in_memory(v, [row.asDict() for row in found])
    spark.stop()


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_ray_calls_it(tmp_path):
    ray = pytest.importorskip("ray", reason="Ray is not installed")
    data = pytest.importorskip("ray.data", reason="Ray is not installed")
    v = fleets.readings(40)
    pq.write_table(fleets.wide(v, fleets.names(40)), tmp_path / "line.parquet")
    ray.init(num_cpus=1, include_dashboard=False)
    line = data.read_parquet(str(tmp_path / "line.parquet"))
    same_as_in_memory(v, example("fleet_ray").calibrated(line).take_all())
    ray.shutdown()
