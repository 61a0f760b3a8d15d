"""Reading files as they come: preambles, delimiters, units in headers, bad cells, formats."""

from __future__ import annotations

import gzip
import os
import pickle
import subprocess
import sys
import threading
import zlib
from pathlib import Path

import h5py
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import scipy.io
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from casest.data import Table, load_runs, read_table, write_atomically
from casest.declaration.symbols import Signal
from casest.errors import DataError, UsageError


def table_of(folder: Path, text: str | bytes, name: str = "data.csv") -> Table:
    file = folder / name
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_table(file)


def error_of(folder: Path, text: str | bytes, name: str = "data.csv") -> str:
    with pytest.raises(DataError) as caught:
        table_of(folder, text, name)
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)
    return str(caught.value)


ROWS = np.array([[0.0, 1.5, -2.0], [0.1, 1.25, -2.5], [0.2, 1.0, 3e-5]])


@pytest.mark.parametrize(
    "text",
    [
        "t,vx,vy\n0,1.5,-2\n0.1,1.25,-2.5\n0.2,1.0,3e-5\n",
        "t;vx;vy\n0;1,5;-2\n0,1;1,25;-2,5\n0,2;1,0;3e-5\n",
        "t\tvx\tvy\n0\t1.5\t-2\n0.1\t1.25\t-2.5\n0.2\t1.0\t3e-5\n",
        "t vx   vy\n0 1.5  -2\n0.1  1.25 -2.5\n  0.2 1.0 3e-5\n",
        "t|vx|vy\n0|1.5|-2\n0.1|1.25|-2.5\n0.2|1.0|3e-5\n",
        "t, vx, vy\r\n0, 1.5, -2\r\n0.1, 1.25, -2.5\r\n0.2, 1.0, 3e-5\r\n",
        "\ufefft,vx,vy\n0,1.5,-2\n0.1,1.25,-2.5\n0.2,1.0,3e-5",
        "t,vx,vy,\n0,1.5,-2,\n0.1,1.25,-2.5,\n0.2,1.0,3e-5,\n",
        "t,vx,vy\n0,1.5,-2,\n0.1,1.25,-2.5,\n0.2,1.0,3e-5,\n",
        '"t","vx","vy"\n0,1.5,-2\n0.1,1.25,-2.5\n0.2,1.0,3e-5\n',
        '"t","vx","vy"\n"0","1.5","-2"\n"0.1","1.25","-2.5"\n"0.2","1.0","3e-5"\n',
        "# made by hand\nt,vx,vy\n0,1.5,-2\n% a comment between\n0.1,1.25,-2.5\n0.2,1.0,3e-5\n",
        "# t,vx,vy\n0,1.5,-2\n0.1,1.25,-2.5\n0.2,1.0,3e-5\n",
        "Fs,100\nLogging Type,0\n\nt,vx,vy\n0,1.5,-2\n0.1,1.25,-2.5\n0.2,1.0,3e-5\n\n",
        "device: XS-3 of lab 4\nrate = 100\nt,vx,vy\n0,1.5,-2\n0.1,1.25,-2.5\n0.2,1.0,3e-5\n",
    ],
)
def test_delimiters_preambles_and_line_ends_do_not_change_the_table(
    tmp_path: Path, text: str
) -> None:
    table = table_of(tmp_path, text)
    assert list(table.columns) == ["t", "vx", "vy"]
    values = np.stack([column.values for column in table.columns.values()], axis=1)
    np.testing.assert_array_equal(values, ROWS)
    assert table.n_rows == 3


def test_tabs_below_and_spaces_above_are_one_table(tmp_path):
    """Typed by hand: NumPy reads it, whatever stands in the middle."""
    rows = [f"{x:.1f}{'    ' if k < 8 else chr(9)}{2 * x:g}" for k, x in enumerate(range(60))]
    table = table_of(tmp_path, "\n".join(rows), "power.txt")
    values = np.stack([column.values for column in table.columns.values()], axis=1)
    np.testing.assert_array_equal(values, np.loadtxt(rows))
    # Where the header's words have spaces, the tabs cut.
    named = table_of(tmp_path, "\n".join(["laser current\tpower", *rows[8:]]), "named.txt")
    assert list(named.columns) == ["laser current", "power"]


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " "])
def test_a_file_without_header_has_columns_by_position(tmp_path: Path, delimiter: str) -> None:
    lines = [delimiter.join(str(x) for x in row) for row in ROWS]
    table = table_of(tmp_path, "\n".join(lines))
    assert list(table.columns) == ["0", "1", "2"]
    np.testing.assert_array_equal(table.columns["1"].values, ROWS[:, 1])


def test_files_of_other_programs_are_read(tmp_path: Path) -> None:
    xsens = "// Sample rate: 100.0Hz\nPacketCounter\tAcc_X\n1\t0.1\n2\t0.2\n"
    table = table_of(tmp_path, xsens)
    assert list(table.columns) == ["PacketCounter", "Acc_X"]
    assert table.preamble == {"Sample rate": "100.0Hz"}
    phyphox = '"Time (s)";"Linear Acceleration x (m/s^2)"\n1,008E-2;-1,02E0\n2,0E-2;1,5E0\n'
    table = table_of(tmp_path, phyphox)
    assert [(c.name, c.unit) for c in table.columns.values()] == [
        ("Time", "s"),
        ("Linear Acceleration x", "m/s^2"),
    ]
    assert table.columns["Time"].values.tolist() == [0.01008, 0.02]
    rostopic = "%time,field.x\n1583,0.1\n1584,0.3\n"
    assert list(table_of(tmp_path, rostopic).columns) == ["time", "field.x"]
    excel = "sep=;\nt;v\n0;1\n1;2\n"
    assert table_of(tmp_path, excel).n_rows == 2
    unnamed_index = ",ax,ay\n0,1.5,2\n1,2.5,3\n"
    assert list(table_of(tmp_path, unnamed_index).columns) == ["0", "ax", "ay"]


def test_a_single_row_is_a_table(tmp_path: Path) -> None:
    assert table_of(tmp_path, "0,1,2\n").n_rows == 1
    assert table_of(tmp_path, "t,v\n0,1\n").n_rows == 1


def test_positions_written_as_names_are_no_sample(tmp_path: Path) -> None:
    table = table_of(tmp_path, "0,1,2\n5.5,6,7\n5.6,6,7\n")
    assert table.n_rows == 2


@given(
    st.lists(
        st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=3, max_size=3),
        min_size=2,
        max_size=8,
    )
)
@settings(max_examples=40, deadline=None)
def test_numbers_are_read_exactly_as_written(
    tmp_path_factory: pytest.TempPathFactory, rows: list[list[float]]
) -> None:
    text = "ax,ay,az\n" + "\n".join(",".join(map(repr, row)) for row in rows)
    table = table_of(tmp_path_factory.mktemp("exact"), text)
    values = np.stack([table.columns[name].values for name in ("ax", "ay", "az")], axis=1)
    np.testing.assert_array_equal(values, np.array(rows))


def test_what_stands_before_the_table_is_kept_and_reported(tmp_path: Path) -> None:
    table = table_of(tmp_path, "Fs,50.00\nInitialization time,60\nmx,my,mz\n1,2,3\n4,5,7\n")
    assert table.preamble == {"Fs": "50.00", "Initialization time": "60"}
    assert "2 lines before the table skipped: Fs,50.00 / Init" in table.notes[0]


def test_a_preamble_as_wide_as_the_table_is_no_row_of_it(tmp_path: Path) -> None:
    table = table_of(tmp_path, "Fs,100\nmode,fast\nt,v\n0,1\n1,2\n2,4\n")
    assert list(table.columns) == ["t", "v"]
    assert table.n_rows == 3
    assert table.preamble == {"Fs": "100", "mode": "fast"}


@pytest.mark.parametrize(
    ("header", "name", "unit"),
    [
        ("vx [m/s^2]", "vx", "m/s^2"),
        ("vx[g]", "vx", "g"),
        ("time (ms)", "time", "ms"),
        ("gyrox rad/s", "gyrox", "rad/s"),
        ("mag1x [µT]", "mag1x", "µT"),
        ("acc x raw", "acc x", "raw"),
        ("vx [nonsense]", "vx", "nonsense"),
        ("v[0]", "v[0]", None),
        ("v[x]", "v[x]", None),
        ("v[0] [g]", "v[0]", "g"),
        ("value (left)", "value (left)", None),
        ("temp 1", "temp 1", None),
        ("phase A", "phase A", None),
        ("plain", "plain", None),
    ],
)
def test_a_header_may_carry_its_unit(
    tmp_path: Path, header: str, name: str, unit: str | None
) -> None:
    table = table_of(tmp_path, f"{header},other\n1.5,2\n2,3\n")
    column = next(iter(table.columns.values()))
    assert (column.name, column.unit) == (name, unit)


def test_units_may_stand_in_a_row_of_their_own(tmp_path: Path) -> None:
    table = table_of(tmp_path, "t,vx,vy\n[s],[m/s²],[g]\n0,1.5,2\n1,2.5,3\n")
    assert [c.unit for c in table.columns.values()] == ["s", "m/s²", "g"]
    assert table.n_rows == 2


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-16"])
def test_headers_may_hold_signs_in_any_usual_encoding(tmp_path: Path, encoding: str) -> None:
    table = table_of(tmp_path, "temp [°C],b [µT]\n1,2\n3,4\n".encode(encoding))
    assert [c.unit for c in table.columns.values()] == ["°C", "µT"]


def test_text_columns_are_kept_as_labels(tmp_path: Path) -> None:
    table = table_of(tmp_path, "part,vx\nx_a,1\nx_a,2\ny_p,3\n")
    assert table.columns["part"].is_text
    assert table.columns["part"].values.tolist() == ["x_a", "x_a", "y_p"]


def test_nameless_empty_columns_are_left_out_and_counted(tmp_path: Path) -> None:
    table = table_of(tmp_path, "t,v,,,\n0,1,,,\n1,2,,,\n")
    assert list(table.columns) == ["t", "v"]
    assert any("3 columns without name and content left out" in note for note in table.notes)


@pytest.mark.parametrize(
    ("cell", "text"), [("", "is empty"), ("oops", "holds 'oops'"), ("nan", "nan"), ("inf", "inf")]
)
def test_a_bad_cell_is_recorded_with_row_and_text_and_raises_nothing(
    tmp_path: Path, cell: str, text: str
) -> None:
    table = table_of(tmp_path, f"t,v\n0,1\n1,{cell}\n2,3\n3,4\n4,{cell}\n")
    bad = table.columns["v"].bad
    assert bad is not None
    assert (bad.row, bad.count) == (1, 2)
    assert text in str(bad)
    assert "and 1 more such rows" in str(bad)
    assert np.isnan(table.columns["v"].values[1])
    assert table.columns["t"].bad is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty"),
        ("\n \n", "holds no data"),
        ("# only\n", "holds no data"),
        ("t,vx,vy\n", "header but no rows"),
        ("t,v\n0,1\n1,2,9\n2,3\n", "row 1 (line 3) has 3 cells where the table has 2: '1,2,9'"),
        ("Fs,1\nt,v,w\n0,1,2\n1,2\n2,3,4\n", "row 1 (line 4) has 2 cells"),
        ("t,v,w\n0,1,2\n1,2,3\n2,3", "cut off: delete it"),
        ("a,b,c\n0,1,2,3\n1,2,3,4\n", "the header names 3 columns and the rows have 4 cells"),
        (b"\x00\x01\x02\x03" * 50, "is no text but binary"),
    ],
)
def test_a_broken_file_is_refused_in_one_line(
    tmp_path: Path, text: str | bytes, words: str
) -> None:
    assert words in error_of(tmp_path, text)


@pytest.mark.parametrize("header", ["t,v,v,w", "t,v [g],v [m/s^2],w"])
def test_columns_of_one_name_are_told_apart_by_a_number(tmp_path: Path, header: str) -> None:
    """A file is not refused for columns that nobody asks for, and the name stands for none."""
    path = tmp_path / "twice.csv"
    path.write_text(f"{header}\n0,1,2,3\n1,2,3,4\n")
    table = read_table(path)
    assert list(table.columns) == ["t", "v (1)", "v (2)", "w"]
    assert table.columns["v (2)"].values.tolist() == [2, 3]
    assert "2 columns are named 'v': they are 'v (1)' to 'v (2)' here" in table.notes


def test_a_missing_file_suggests_its_neighbours(tmp_path: Path) -> None:
    (tmp_path / "imu0.log").write_text("1 2\n")
    with pytest.raises(DataError, match=r"imu0\.lgo: no such file; did you mean imu0\.log\?"):
        read_table(tmp_path / "imu0.lgo")
    with pytest.raises(DataError, match=r"that folder holds imu0\.log"):
        read_table(tmp_path / "quite_other.csv")
    with pytest.raises(DataError, match="there is no folder"):
        read_table(tmp_path / "nowhere" / "a.csv")


def test_a_folder_is_not_a_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is a folder; name the files in it"):
        read_table(tmp_path)


@pytest.mark.parametrize("name", ["a.xlsx", "a.h5", "a.json"])
def test_formats_that_are_not_read_say_so(tmp_path: Path, name: str) -> None:
    assert "export it as CSV" in error_of(tmp_path, b"something", name)


def test_gzipped_text_is_read(tmp_path: Path) -> None:
    table = table_of(tmp_path, gzip.compress(b"t,v\n0,1\n1,2\n"), "a.csv.gz")
    assert table.columns["v"].values.tolist() == [1.0, 2.0]
    assert "cannot be read" in error_of(tmp_path, b"no gzip at all", "b.csv.gz")


def test_numpy_matrices_have_columns_by_position(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", ROWS)
    table = read_table(tmp_path / "a.npy")
    assert list(table.columns) == ["0", "1", "2"]
    np.testing.assert_array_equal(table.columns["2"].values, ROWS[:, 2])


def test_structured_arrays_have_columns_by_field(tmp_path: Path) -> None:
    array = np.array([(0.0, 1), (0.5, 2)], dtype=[("t", "f8"), ("v", "i4")])
    np.save(tmp_path / "a.npy", array)
    assert read_table(tmp_path / "a.npy").columns["v"].values.tolist() == [1.0, 2.0]


def test_npz_archives_hold_vectors_matrices_and_scalars(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=ROWS[:, 0], v=ROWS, Fs=100.0)
    table = read_table(tmp_path / "a.npz")
    assert list(table.columns) == ["t", "v[0]", "v[1]", "v[2]"]
    assert table.preamble == {"Fs": "100.0"}


def test_arrays_of_unequal_length_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=np.arange(4.0), v=np.arange(5.0))
    with pytest.raises(DataError, match="v has 5 samples and t has 4"):
        read_table(tmp_path / "a.npz")


def test_pickled_objects_are_refused_unread(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "b.npz", a=np.array([None, 1], dtype=object))
    for name in ("a.npy", "b.npz"):
        with pytest.raises(DataError, match="Python objects, which are not read"):
            read_table(tmp_path / name)


def test_damaged_archives_are_named(tmp_path: Path) -> None:
    for name in ("a.npy", "a.npz", "a.mat", "a.parquet", "a.csv.gz"):
        assert "cannot be read" in error_of(tmp_path, b"\x00not what the name says" * 9, name)


def test_an_array_that_is_cut_off_says_so(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", ROWS)
    np.savez(tmp_path / "b.npz", v=ROWS)
    whole = (tmp_path / "a.npy").read_bytes()
    for length in (len(whole) - 1, len(whole) - 60):
        assert "less than its header announces" in error_of(tmp_path, whole[:length], "a.npy")
    archive = (tmp_path / "b.npz").read_bytes()
    assert "the archive is damaged" in error_of(tmp_path, archive[:-10], "b.npz")


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.mat"])
@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_a_pickle_is_refused_unread_whatever_it_is_called(
    tmp_path: Path, name: str, protocol: int
) -> None:
    class Trap:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "sprung"),))

    said = error_of(tmp_path, pickle.dumps([Trap()], protocol), name)
    assert "holds Python objects, which are not read (they could run code)" in said
    assert not (tmp_path / "sprung").exists()


def test_an_array_under_the_name_of_an_archive_is_told_its_own(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", ROWS)
    np.savez(tmp_path / "b.npz", v=ROWS)
    assert "call it .npy" in error_of(tmp_path, (tmp_path / "a.npy").read_bytes(), "c.npz")
    assert "call it .npz" in error_of(tmp_path, (tmp_path / "b.npz").read_bytes(), "c.npy")


@pytest.mark.parametrize("seed", range(4))
def test_binary_rubbish_called_csv_is_no_text(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rubbish = rng.integers(seed % 2, 256, 5000, dtype=np.uint8).tobytes()
    assert "is no text but binary; export it as CSV" in error_of(tmp_path, rubbish)


def test_a_recording_that_ends_in_zero_bytes_is_named_by_line(tmp_path: Path) -> None:
    text = b"t,v\n" + b"".join(b"%d,1\n" % k for k in range(900)) + bytes(4000)
    assert "line 902 holds a zero byte: the recording is damaged" in error_of(tmp_path, text)


def test_utf_16_that_is_cut_in_the_middle_of_a_sign_is_named(tmp_path: Path) -> None:
    text = "t,v\n0,1\n1,2\n".encode("utf-16")
    assert "its UTF-16 text is damaged at byte" in error_of(tmp_path, text[:-1])


def test_a_name_too_long_for_the_system_is_an_error_of_the_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        read_table(tmp_path / ("x" * 3000))


@pytest.mark.parametrize("by_rows", [True, False])
def test_matlab_files_hold_vectors_of_either_orientation(tmp_path: Path, by_rows: bool) -> None:
    t, v = np.arange(20.0), np.random.default_rng(0).normal(size=(20, 3))
    content = {"t": t[:, None] if by_rows else t[None], "v": v if by_rows else v.T, "Fs": 100}
    scipy.io.savemat(tmp_path / "a.mat", content)
    table = read_table(tmp_path / "a.mat")
    assert list(table.columns) == ["t", "v[0]", "v[1]", "v[2]"]
    np.testing.assert_array_equal(table.columns["v[1]"].values, v[:, 1])
    assert table.preamble["Fs"] == "100"


def test_matlab_structs_are_opened(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "a.mat", {"log": {"t": ROWS[:, 0], "vx": ROWS[:, 1]}})
    assert list(read_table(tmp_path / "a.mat").columns) == ["t", "vx"]


def test_a_matrix_alone_is_found_by_its_name_and_by_position(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "a.mat", {"acc": ROWS})
    assert list(read_table(tmp_path / "a.mat").columns) == ["acc[0]", "acc[1]", "acc[2]"]
    for columns in ({"v": "acc"}, {"v": "0,1,2"}, {"v": "acc[0],acc[1],acc[2]"}):
        (run,) = load_runs(tmp_path / "a.mat", [Signal("v", 3, None)], columns=columns)
        np.testing.assert_array_equal(run.signals["v"], ROWS)
    (run,) = load_runs(tmp_path / "a.mat", [Signal("acc", 3, None)])
    np.testing.assert_array_equal(run.signals["acc"], ROWS)


def version_73(file: Path, content: dict[str, object]) -> None:
    """A file as MATLAB 7.3 lays it out: a text header, then HDF5 with every array transposed."""
    with h5py.File(file, "w", userblock_size=512) as store:

        def put(place: h5py.Group, name: str, value: object) -> None:
            if isinstance(value, dict):
                group = place.create_group(name)
                group.attrs["MATLAB_class"] = np.bytes_("struct")
                for field, one in value.items():
                    put(group, field, one)
                return
            if isinstance(value, str):
                data = np.array([[ord(sign)] for sign in value], dtype=np.uint16)
            else:
                data = np.atleast_2d(np.asarray(value)).T
            made = place.create_dataset(name, data=data)
            kind = "char" if isinstance(value, str) else "double"
            made.attrs["MATLAB_class"] = np.bytes_(kind)

        for name, value in content.items():
            put(store, name, value)
        reference = store.create_dataset("cells", (1, 2), dtype=h5py.ref_dtype)
        reference.attrs["MATLAB_class"] = np.bytes_("cell")
        store.create_group("#refs#")
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    with file.open("r+b") as stream:
        stream.write(head)


@pytest.mark.parametrize("by_rows", [True, False])
def test_matlab_v73_is_read_like_the_versions_before(tmp_path: Path, by_rows: bool) -> None:
    t, v = np.arange(20.0), np.random.default_rng(0).normal(size=(20, 3))
    content = {"t": t[:, None] if by_rows else t, "log": {"v": v if by_rows else v.T}, "Fs": 100.0}
    version_73(tmp_path / "a.mat", {**content, "device": "XS-3"})
    table = read_table(tmp_path / "a.mat")
    assert sorted(table.columns) == ["t", "v[0]", "v[1]", "v[2]"]
    np.testing.assert_array_equal(table.columns["v[2]"].values, v[:, 2])
    assert table.preamble == {"Fs": "100.0", "device": "XS-3"}
    assert any("cells" in note and "left out" in note for note in table.notes)


def test_matlab_v73_that_is_damaged_or_lacks_its_library_says_what_helps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    assert "'-v7')" in error_of(tmp_path, head + b"\x00" * 512, "a.mat")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(UsageError, match=r"needs the library h5py: pip install 'casest\[matlab\]'"):
        read_table(tmp_path / "a.mat")


@pytest.mark.parametrize("compressed", [False, True])
def test_a_matlab_file_with_a_damaged_tag_is_named(tmp_path: Path, compressed: bool) -> None:
    """A type of numbers that there is none of ends the process in SciPy."""
    values = np.arange(60.0).reshape(20, 3)
    scipy.io.savemat(tmp_path / "a.mat", {"v": values}, do_compression=False)
    raw = bytearray((tmp_path / "a.mat").read_bytes())
    at = raw.index(np.array([9, values.nbytes], dtype="<u4").tobytes())  # miDOUBLE, its bytes
    raw[at] = 44
    if compressed:
        packed = zlib.compress(bytes(raw[128:]))
        raw[128:] = np.array([15, len(packed)], dtype="<u4").tobytes() + packed
    assert "are of the unknown type 44" in error_of(tmp_path, bytes(raw), "a.mat")
    raw[126:128] = b"MI"  # the other order of bytes
    assert "cannot be read as MATLAB" in error_of(tmp_path, bytes(raw), "a.mat")


def test_a_matlab_matrix_without_the_imaginary_part_it_announces_is_named(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "a.mat", {"v": ROWS, "w": ROWS})
    raw = bytearray((tmp_path / "a.mat").read_bytes())
    raw[128 + 8 + 8 + 1] |= 8  # header, tag of the matrix, tag of its flags, class
    assert "has not the numbers that it announces" in error_of(tmp_path, bytes(raw), "a.mat")


def test_matlab_structs_in_structs_cells_and_text_pass_the_check_of_tags(tmp_path: Path) -> None:
    content = {
        "t": ROWS[:, 0],
        "deep": {"inner": {"x": 1.0}},
        "cells": np.array([1, "a"], object),
        "text": "XS-3",
        "empty": np.zeros((0, 0)),
        "flag": np.array([True, False, True]),
        "complex": np.array([1.0, 2.0, 1j]),
        "sparse": scipy.sparse.csc_array(np.eye(3)),
    }
    for compressed in (False, True):
        scipy.io.savemat(tmp_path / "a.mat", content, do_compression=compressed)
        table = read_table(tmp_path / "a.mat")
        assert table.columns["t"].values.tolist() == ROWS[:, 0].tolist()
        assert table.columns["flag"].values.tolist() == [1, 0, 1]
        assert table.preamble["text"] == "XS-3"


def test_text_that_is_called_mat_is_read_as_text(tmp_path: Path) -> None:
    table = table_of(tmp_path, "t,v\n0,1\n1,2\n", "a.mat")
    assert table.columns["v"].values.tolist() == [1.0, 2.0]


def test_the_measured_text_that_is_called_mat_is_read(shared_data: Path) -> None:
    """51 175 rows of time and three counts, says the source."""
    file = shared_data / "xsens-imutk" / "xsens_acc.mat"
    table = read_table(file)
    assert (table.n_rows, len(table.columns)) == (51175, 4)
    np.testing.assert_array_equal(table.columns["2"].values, np.loadtxt(file)[:, 2])


def test_a_parquet_file_read_in_pieces_is_the_one_read_whole(tmp_path: Path, monkeypatch) -> None:
    rng, file = np.random.default_rng(0), tmp_path / "a.parquet"
    content = {"v": rng.standard_normal(100), "n": rng.integers(0, 9, 100)}
    labels = [f"r{k // 30}" for k in range(100)]
    table = pyarrow.table({**content, "run": labels})
    pyarrow.parquet.write_table(table, file, row_group_size=33)
    monkeypatch.setattr("casest.data.arrays.PIECE", 7)
    found = read_table(file)
    for name, values in content.items():
        np.testing.assert_array_equal(found.columns[name].values, values)
    assert found.columns["run"].values.tolist() == labels


def test_a_parquet_column_of_vectors_becomes_a_column_for_each_component(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).normal(size=(70, 3))
    for kind in (pyarrow.list_(pyarrow.float64()), pyarrow.list_(pyarrow.float64(), 3)):
        table = pyarrow.table({"acc": pyarrow.array(rows.tolist(), kind)})
        pyarrow.parquet.write_table(table, tmp_path / "a.parquet")
        found = read_table(tmp_path / "a.parquet")
        assert list(found.columns) == ["acc[0]", "acc[1]", "acc[2]"]
        assert np.array_equal(np.column_stack([c.values for c in found.columns.values()]), rows)


def test_a_parquet_column_of_lists_of_several_lengths_is_named(tmp_path: Path) -> None:
    table = pyarrow.table({"acc": [[1.0, 2.0], [3.0]]})
    pyarrow.parquet.write_table(table, tmp_path / "a.parquet")
    with pytest.raises(DataError, match=r"a.parquet: column acc holds lists of 1 to 2 numbers"):
        read_table(tmp_path / "a.parquet")


def test_parquet_keeps_units_labels_nulls_and_times(tmp_path: Path) -> None:
    vx = pyarrow.field("vx", pyarrow.float32(), metadata={"unit": "g"})
    schema = pyarrow.schema(
        [vx, ("part", pyarrow.string()), ("n", pyarrow.int64()), ("t", pyarrow.timestamp("ms"))]
    )
    content = {"vx": [1.0, 2.0], "part": ["a", "b"], "n": [1, None], "t": [1000, 1500]}
    pyarrow.parquet.write_table(pyarrow.table(content, schema), tmp_path / "a.parquet")
    table = read_table(tmp_path / "a.parquet")
    assert table.columns["vx"].unit == "g"
    assert table.columns["part"].values.tolist() == ["a", "b"]
    assert table.columns["n"].bad is not None
    assert np.diff(table.columns["t"].values).tolist() == [0.5e9]
    assert table.columns["t"].unit == "ns"


def test_reading_text_loads_no_heavy_library(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,vx [g]\n0,1\n1,2\n")
    code = (
        "import sys; from casest.data import read_table, load_runs\n"
        f"read_table({str(tmp_path / 'a.csv')!r})\n"
        "sys.exit(any(m in sys.modules for m in ('pint', 'scipy', 'pyarrow', 'pandas')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_hundred_thousand_rows_are_read(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=(100_000, 6))
    np.savetxt(tmp_path / "a.csv", values, fmt="%.6g", delimiter=",", header="a,b,c,d,e,f")
    table = read_table(tmp_path / "a.csv")
    read = np.column_stack([table.columns[name].values for name in "abcdef"])
    np.testing.assert_allclose(read, values, rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "n_rows", "columns"),
    [
        ("ckexplorer/acc_log.csv", 16000, ["ax", "ay", "az"]),
        ("mpu9150-mikoff/imu0.log", 15969, ["0", "1", "2", "3", "4", "5"]),
        (
            "mpu6050-tomisuarez/example_data_calibration.csv",
            10245,
            ["ax", "ay", "az", "gx", "gy", "gz"],
        ),
        ("qmc5883l-tomisuarez/noisy_raw_data.csv", 22743, ["mx", "my", "mz"]),
        ("psim-thermal/ETUColdTest3_7_20.csv", 49, ["Time", "F2", "F3", "F4", "C1"]),
    ],
)
def test_measured_files_are_read_as_they_are(
    shared_data: Path, name: str, n_rows: int, columns: list[str]
) -> None:
    table = read_table(shared_data / name)
    assert table.n_rows == n_rows
    assert list(table.columns) == columns


def test_three_styles_of_unit_in_one_measured_header(shared_data: Path) -> None:
    table = read_table(shared_data / "psim-thermal" / "TVCtest3_7_20.csv")
    found = {column.name: column.unit for column in table.columns.values()}
    assert found["time"] == "ms"
    assert found["mag1x"] == "T"
    assert found["gyrox"] == "rad/s"
    assert found["temp"] is None
    assert table.n_rows == 6250


def test_writing_replaces_the_whole_file_and_leaves_no_other(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    target.write_text("old")
    write_atomically(target, "new ±")
    assert target.read_text(encoding="utf-8") == "new ±"
    assert os.listdir(tmp_path) == ["result.json"]


def test_an_interrupted_write_leaves_the_old_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "result.json"
    target.write_text("old")

    def interrupted(handle: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(target, "new")
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["result.json"]


def test_a_reader_never_sees_half_a_file(tmp_path: Path) -> None:
    target, texts, seen = tmp_path / "a.txt", {c: c * 200_000 for c in "xy"}, set()
    write_atomically(target, texts["x"])
    writer = threading.Thread(
        target=lambda: [write_atomically(target, texts[c]) for c in "yxyxyxyxyx"]
    )
    writer.start()
    while writer.is_alive():
        seen.add(target.read_text())
    assert seen <= set(texts.values())


def test_a_missing_output_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"result\.json: cannot be written"):
        write_atomically(tmp_path / "nowhere" / "result.json", "text")
