"""Other engines call the same function: Arrow in, Arrow out, the same bits however rows are cut."""

from __future__ import annotations

import fleets
import numpy as np
import pyarrow as pa
import pytest

from casest import DataError, UsageError, calibrate_arrow, calibrate_many
from casest.results.find import find_model

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


def test_spark_calls_it(tmp_path):
    pyspark = pytest.importorskip("pyspark.sql", reason="Spark is not installed")
    from pyspark.sql.pandas.types import from_arrow_schema

    v = fleets.readings(40)
    table = fleets.wide(v, fleets.names(40))
    spark = pyspark.SparkSession.builder.master("local[1]").getOrCreate()
    made = calibrate_arrow(NORM, table.slice(0, 1)).schema
    frame = spark.createDataFrame(table.to_pylist()).mapInArrow(rows, from_arrow_schema(made))
    found = {row["sensor"]: row["offset[0]"] for row in frame.collect()}
    direct = calibrate_many(NORM, {"v": v}).values["offset"][:, 0]
    assert [found[name] for name in fleets.names(40)] == direct.tolist()
    spark.stop()


def test_ray_calls_it():
    ray = pytest.importorskip("ray", reason="Ray is not installed")
    data = pytest.importorskip("ray.data", reason="Ray is not installed")
    v = fleets.readings(40)
    ray.init(num_cpus=1, include_dashboard=False)
    made = data.from_arrow(fleets.wide(v, fleets.names(40))).map_batches(
        lambda table: calibrate_arrow(NORM, table), batch_format="pyarrow"
    )
    found = {row["sensor"]: row["offset[0]"] for row in made.take_all()}
    direct = calibrate_many(NORM, {"v": v}).values["offset"][:, 0]
    assert [found[name] for name in fleets.names(40)] == direct.tolist()
    ray.shutdown()
