"""Data frames of four libraries, mappings and arrays are read as a file of the same numbers is."""

from __future__ import annotations

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest
import simulators as sim
import xarray as xr

import casest
from casest import calibrate, close, load_runs
from casest_problems.norm import norm_diagonal

SIGNALS = norm_diagonal.signals
NAMES = ["ax", "ay", "az"]
TIME = pd.date_range("2026-03-01", periods=40, freq="20ms", name="time")


@pytest.fixture(scope="module")
def v():
    """Readings (40, 3) in m/s² of a sensor with scale, skew and offset."""
    rng = np.random.default_rng(8)
    return sim.accelerometer(rng, skew=False).read(sim.spread_poses(40, rng), 5e-3, rng)


def frames(v):
    """The same readings as everybody has them, and how their columns are named."""
    own = {name: v[:, k] for k, name in enumerate(NAMES)}
    lists = [list(row) for row in v]
    several = pd.MultiIndex.from_tuples([("acc", axis) for axis in "xyz"])
    return {
        "pandas": (pd.DataFrame(own), "a"),
        "pandas, nullable": (pd.DataFrame(own).astype("Float64"), "a"),
        "pandas, columns of two levels": (pd.DataFrame(v, columns=several), "acc"),
        "polars": (pl.DataFrame(own), "a"),
        "polars, vectors": (pl.DataFrame({"acc": v}), "acc"),
        "polars, lists": (pl.DataFrame({"acc": lists}), "acc"),
        "pyarrow": (pa.table(own), "a"),
        "pyarrow, lists": (pa.table({"acc": lists}), "acc"),
        "arrow by its stream alone": (Streamed(pa.table(own)), "a"),
        "the interchange alone": (Interchanged(pa.table(own)), "a"),
        "a dict of lists": ({name: list(x) for name, x in own.items()}, "a"),
        "a dict with a matrix": ({"acc": v}, "acc"),
        "an array": (v, "0,1,2"),
        "a structured array": (pd.DataFrame(own).to_records(index=False), "a"),
        "xarray": (xr.Dataset({n: ("time", x) for n, x in own.items()}), "a"),
        "xarray, labelled axes": (labelled(v), "acc"),
    }


def labelled(v):
    return xr.DataArray(v, dims=("t", "axis"), coords={"axis": list("xyz")}, name="acc")


class Streamed:
    """A table of a library that nobody knows, which speaks Arrow."""

    def __init__(self, table):
        self.__arrow_c_stream__ = table.__arrow_c_stream__


class Interchanged:
    """One that speaks the older dataframe interchange."""

    def __init__(self, table):
        self.__dataframe__ = table.__dataframe__


@pytest.mark.parametrize("kind", frames(np.ones((4, 3))))
def test_a_frame_gives_the_numbers_that_are_in_it(kind, v):
    frame, columns = frames(v)[kind]
    (run,) = load_runs(frame, SIGNALS, columns={"v": columns})
    assert np.array_equal(run.signals["v"], v)


def with_metadata(v):
    """The same readings in g, where each library keeps a unit, and in a name."""
    g = v / sim.GRAVITY
    pandas = pd.DataFrame(g, columns=NAMES)
    pandas.attrs["units"] = dict.fromkeys(NAMES, "g")
    fields = [pa.field(n, pa.float64(), metadata={"unit": "g"}) for n in NAMES]
    arrow = pa.Table.from_arrays([pa.array(x) for x in g.T], schema=pa.schema(fields))
    array = labelled(g).assign_attrs(units="g")
    return [pandas, arrow, array, pl.DataFrame({f"a{k} [g]": x for k, x in enumerate(g.T)})]


@pytest.mark.parametrize("k", range(4))
def test_a_unit_is_read_where_the_library_keeps_it(k, v):
    stem = {"v": "acc" if k == 2 else "a"}
    (run,) = load_runs(with_metadata(v)[k], SIGNALS, columns=stem)
    assert run.units["v"] == "g"
    (stated,) = load_runs(v / sim.GRAVITY, SIGNALS, columns={"v": "0,1,2"}, units={"v": "g"})
    assert np.array_equal(run.signals["v"], stated.signals["v"])


def timed(v):
    own = {name: v[:, k] for k, name in enumerate(NAMES)}
    return [
        pd.DataFrame(own, index=TIME),
        pd.DataFrame(own, index=TIME.tz_localize("Europe/Rome")),
        pd.DataFrame(own, index=(TIME - TIME[0]).rename("t")),
        pd.DataFrame(own, index=pd.Index(np.arange(40) * 0.02, name="t")),
        pl.DataFrame({"time": TIME.to_numpy(), **own}),
        pa.table({"time": TIME, **own}),
        xr.Dataset({n: ("time", x) for n, x in own.items()}, coords={"time": TIME}),
    ]


@pytest.mark.parametrize("k", range(7))
def test_moments_and_an_index_that_says_something_are_the_time(k, v):
    (run,) = load_runs(timed(v)[k], SIGNALS, columns={"v": "a"})
    assert run.time == pytest.approx(np.arange(40) * 0.02, abs=1e-6)


def test_an_index_that_only_counts_is_no_column(v):
    picked = pd.DataFrame(v, columns=NAMES).iloc[::-1]
    (run,) = load_runs(picked, SIGNALS, columns={"v": "a"})
    assert run.time is None
    assert dict(run.columns) == {}


def test_a_missing_reading_costs_its_row_and_is_said(v):
    frame = pd.DataFrame(v, columns=NAMES).astype("Float64")
    frame.loc[3, "ay"] = pd.NA
    (run,) = load_runs(frame, SIGNALS, columns={"v": "a"})
    assert list(run.rows) == [k for k in range(40) if k != 3]
    assert any(note.startswith("1 of 40 rows dropped") for note in run.notes)


def test_fewer_rows_than_axes_stay_rows():
    v = np.arange(6.0).reshape(2, 3)
    (run,) = load_runs({"v": v, "t": np.array([0.0, 1.0])}, SIGNALS)
    assert np.array_equal(run.signals["v"], v)


def test_text_and_labels_are_columns_of_their_own(v):
    frame = pd.DataFrame(v, columns=NAMES).assign(run=["a"] * 20 + ["b"] * 20, who="me")
    first, second = load_runs(frame, SIGNALS, columns={"v": NAMES})
    assert (len(first), len(second)) == (20, 20)
    assert set(first.columns["who"]) == {"me"}


def test_several_frames_are_several_runs(v):
    frame = pl.DataFrame(v, schema=NAMES)
    found = calibrate(norm_diagonal.having(norm=sim.GRAVITY), [frame[:20], frame[20:]],
                      columns={"v": "a"}, units={"v": "m/s^2"})  # fmt: skip
    assert [run.name for run in found.problem.runs] == ["DataFrame 0", "DataFrame 1"]


def test_a_frame_its_file_and_its_runs_give_the_same_estimate(v, tmp_path):
    frame = pd.DataFrame(v, columns=[f"{n} [m/s^2]" for n in NAMES])
    frame.to_csv(tmp_path / "poses.csv", index=False)
    model, columns = norm_diagonal.having(norm=sim.GRAVITY), {"v": NAMES}
    runs = load_runs(tmp_path / "poses.csv", SIGNALS, columns=columns)
    ways = [
        calibrate(model, frame, columns=columns),
        calibrate(model, str(tmp_path / "poses.csv"), columns=columns),
        calibrate(model, runs),
        calibrate(model, runs[0]),
    ]
    for found in ways[1:]:
        assert np.array_equal(found.covariance, ways[0].covariance)
        assert all(np.array_equal(found.values[n], x) for n, x in ways[0].values.items())


def test_a_known_value_may_be_text_with_its_unit(v):
    """Earth's field in uT, then in gauss, of which one is 100 uT; readings in mG."""
    field = v / sim.GRAVITY * 48.0  # uT
    words = {"columns": {"v": "0,1,2"}, "units": {"v": "mG"}}
    one, other = (
        calibrate(norm_diagonal.having(norm=said), 10 * field, **words)
        for said in ("48 uT", "0.48 gauss")
    )
    assert one.values["scale"] == pytest.approx(100 * other.values["scale"], rel=1e-9)
    assert one.values["offset"] == pytest.approx(other.values["offset"], rel=1e-6, abs=1e-6)


def test_the_loop_takes_frames_too(v):
    closed = close(norm_diagonal.having(norm=sim.GRAVITY), v, columns={"v": "0,1,2"},
                   units={"v": "m/s^2"}, catalogue=())  # fmt: skip
    assert closed.runs[0].name == "ndarray"


WRONG = [
    (3, "the data hold 3, of type int: give files, data frames"),
    ([1.0, 2.0], "the data hold 1.0, of type float: give files, data frames"),
    ("no.csv", "no.csv: no such file"),
    ({}, "dict: is empty; give columns by name"),
    (pd.DataFrame({"ax": [], "ay": [], "az": []}), "DataFrame: holds a header but no rows"),
    ({"ax": [1, 2], "ay": [1, 2, 3]}, "dict: ay has 3 rows and ax has 2"),
    (pd.DataFrame(np.ones((3, 2)), columns=["a", "a"]), "DataFrame: two columns are named 'a'"),
    (
        pd.DataFrame({"bx": [1.0, 2.0], "by": 1.0, "bz": 2.0}),
        "DataFrame: no columns vx vy vz for signal v; the file has bx, by, bz; "
        'try columns={"v": "bx,by,bz"}',
    ),
    (pl.DataFrame({"v": [[1.0], [1.0, 2.0]]}), "a column holds lists of 1 to 2 numbers"),
    (pl.LazyFrame({"v": [1.0]}), "its rows are not computed yet; give LazyFrame.collect()"),
]


@pytest.mark.parametrize(("given", "words"), WRONG, ids=[w for _, w in WRONG])
@pytest.mark.filterwarnings("ignore:Determining the column names of a LazyFrame")
def test_what_cannot_be_read_is_named_with_the_way_out(given, words):
    with pytest.raises(casest.CasestError) as error:
        calibrate(norm_diagonal, given)
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"columns": ["a", "b", "c"]}, """columns=['a', 'b', 'c'] is of type list"""),
        ({"columns": {"v": "0,1,2"}, "units": "g"}, """like units={"v": 'g'}"""),
        ({"columns": {"v": "0,1,2"}, "units": {"v": "gg"}}, """units={"v": "gg"}: unknown unit"""),
    ],
)
def test_arguments_of_another_type_are_named_with_what_to_give(v, words, said):
    with pytest.raises(casest.CasestError) as error:
        calibrate(norm_diagonal, v, **words)
    assert said in str(error.value)


def test_runs_are_not_read_again_and_not_mixed(v):
    (run,) = load_runs(v, SIGNALS, columns={"v": "0,1,2"})
    with pytest.raises(casest.UsageError, match="these are runs already: say it where they are"):
        calibrate(norm_diagonal, run, units={"v": "g"})
    with pytest.raises(casest.UsageError, match="runs and a ndarray are given together"):
        calibrate(norm_diagonal, [run, v])


def test_what_is_no_model_is_named(v):
    with pytest.raises(casest.UsageError, match="did you mean 'norm-diagonal'"):
        calibrate("norm-diagonl", v)
    with pytest.raises(casest.UsageError, match="of type ndarray: give one that @model"):
        calibrate(v, norm_diagonal)


def test_a_unit_that_nobody_knows_is_named_with_its_constant():
    with pytest.raises(casest.UnitError, match="norm: unknown unit 'xT'"):
        norm_diagonal.having(norm="48 xT")
