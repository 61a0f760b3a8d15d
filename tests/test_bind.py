"""Columns matched to signals: names, units, time, groups, rotations, raw counts, and refusals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from casest.data import Run, load_runs
from casest.declaration.symbols import Signal
from casest.errors import CasestError, DataError, UnitError, UsageError

V = Signal("v", 3, "m/s^2")
ANY = Signal("v", 3, None)
T = Signal("t", 1, "s")
TEMPERATURE = Signal("temperature", 1, "degC")
ATTITUDE = Signal("attitude", 9, None, kind="rotation")

THREE = "1,2,3\n1.5,2.5,3.5\n2,3,5\n"


def runs_of(
    folder: Path, text: str, signals: Sequence[Signal] = (V,), **options: Any
) -> tuple[Run, ...]:
    file = folder / "imu.csv"
    file.write_text(text)
    return load_runs([file], signals, **options)


def run_of(folder: Path, text: str, signals: Sequence[Signal] = (V,), **options: Any) -> Run:
    (run,) = runs_of(folder, text, signals, **options)
    return run


def refusal(
    kind: type[CasestError],
    folder: Path,
    text: str,
    signals: Sequence[Signal] = (V,),
    **options: Any,
) -> str:
    with pytest.raises(kind) as caught:
        runs_of(folder, text, signals, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


# --- finding columns ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "header",
    [
        "vx,vy,vz",
        "v_x,v_y,v_z",
        "V_X,V_Y,V_Z",
        "v[0],v[1],v[2]",
        "v0,v1,v2",
        "v1,v2,v3",
        "v.x,v.y,v.z",
        "v[x],v[y],v[z]",
        "vx [m/s^2],vy [m/s^2],vz [m/s^2]",
        "vz,vy,vx",
    ],
)
def test_a_vector_is_found_by_the_names_people_give_it(tmp_path: Path, header: str) -> None:
    expected = np.array([[1, 2, 3], [1.5, 2.5, 3.5], [2, 3, 5]])
    if header == "vz,vy,vx":
        expected = expected[:, ::-1]
    run = run_of(tmp_path, f"{header}\n{THREE}")
    np.testing.assert_array_equal(run.signals["v"], expected)
    assert run.signals["v"].dtype == np.float64


@pytest.mark.parametrize("choice", [("az", "ay", "AX"), "az,ay,ax", ("2", "1", "0"), "2,1,0"])
def test_columns_are_chosen_by_name_or_position(tmp_path: Path, choice: Any) -> None:
    run = run_of(tmp_path, f"ax,ay,az\n{THREE}", columns={"v": choice})
    np.testing.assert_array_equal(run.signals["v"][0], [3, 2, 1])


def test_a_file_without_header_is_read_by_position(tmp_path: Path) -> None:
    run = run_of(tmp_path, THREE, columns={"v": "0,1,2"})
    assert run.signals["v"].shape == (3, 3)


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        (
            f"ax,ay,az\n{THREE}",
            {},
            "no columns vx vy vz for signal v; the file has ax, ay, az; try --columns v=ax,ay,az",
        ),
        (THREE, {}, "try --columns v=0,1,2"),
        (
            f"gx,gy,gz,accx,accy,accz\n{THREE.replace(chr(10), ',1,2,3' + chr(10))}",
            {"columns": {"v": "accx,accy,acz"}},
            "no column acz for signal v; did you mean accz?",
        ),
        (THREE, {"columns": {"v": "0,1,7"}}, "asks for column 7, and the columns are 0 to 2"),
        (THREE, {"columns": {"v": "0,1"}}, "signal v needs 3 columns and --columns v=0,1 gives 2"),
        (THREE, {"columns": {"v": "0,1,1"}}, "names 1 twice"),
    ],
)
def test_a_missing_column_is_answered_with_what_to_type(
    tmp_path: Path, text: str, options: dict[str, Any], words: str
) -> None:
    assert words in refusal(DataError, tmp_path, text, **options)


def test_a_unit_behind_a_column_is_that_of_the_signal(tmp_path: Path) -> None:
    """As a header with its unit is written: of none it is stated so, of another it is refused."""
    signals = [Signal("level", 1, None)]
    asked = {"columns": {"level": "volt [V]"}}
    message = refusal(DataError, tmp_path, "volt [mV],ppm\n1,2\n2,3\n", signals, **asked)
    assert "the header of volt says mV" in message
    assert "--unit SIGNAL=V" in message
    warm = [Signal("warmth", 1, None)]
    message = refusal(DataError, tmp_path, "T [degC]\n1\n2\n", warm, columns={"warmth": "T [K]"})
    assert "the header of T says degC" in message  # of one size, and of another zero
    for header in ("volt [V],ppm", "volt,ppm"):
        (run,) = runs_of(tmp_path, f"{header}\n1,2\n2,3\n", signals, **asked)
        assert run.units["level"] == "V"
    (run,) = runs_of(tmp_path, "volt,ppm\n1,2\n2,3\n", signals, units={"level": "mV"}, **asked)
    assert run.units["level"] == "mV"
    (run,) = runs_of(tmp_path, "ax,ay,az\n1,2,3\n2,3,5\n", columns={"v": "ax,ay,az [g]"})
    np.testing.assert_allclose(run.signals["v"][0], 9.80665 * np.array([1.0, 2.0, 3.0]))


def test_a_near_scalar_column_is_suggested(tmp_path: Path) -> None:
    text = "temp,b\n20,1\n21,2\n"
    message = refusal(DataError, tmp_path, text, [TEMPERATURE])
    assert "try --columns temperature=temp" in message


def test_the_only_column_of_a_signals_unit_is_suggested(tmp_path: Path) -> None:
    mass = Signal("mass", 1, "kg")
    message = refusal(DataError, tmp_path, "out [mV],weight [g],T [degC]\n1,2,3\n2,3,4\n", [mass])
    assert "try --columns mass=weight" in message


def test_all_signals_that_are_missing_are_said_at_once(tmp_path: Path) -> None:
    """Each once: a user types the command again one time, not once for each signal."""
    signals = [Signal("temperature", 1, "degC"), Signal("resistance", 1, "ohm")]
    message = refusal(DataError, tmp_path, "T [degC],R [kOhm]\n1,2\n2,3\n", signals)
    assert message.endswith("try --columns temperature=T --columns resistance=R")
    bare = [Signal("load", 1, None), Signal("reading", 1, None)]
    message = refusal(DataError, tmp_path, "weight [kg],output [mV]\n1,2\n2,3\n", bare)
    assert message.endswith("try --columns load=… --columns reading=…")


def test_a_suggestion_needs_more_than_two_letters_in_common_and_brings_its_unit(tmp_path) -> None:
    bare = [Signal("load", 1, None), Signal("reading", 1, None)]
    message = refusal(DataError, tmp_path, "Gewicht,ADC\n1,2\n2,3\n", bare)
    assert message.endswith("try --columns load=… --columns reading=…")
    turned = [Signal("attitude", 9, None, "rotation")]
    message = refusal(DataError, tmp_path, "roll_deg,pitch_deg,yaw_deg\n0,0,0\n0,1,9\n", turned)
    assert message.endswith("try --columns attitude=roll_deg,pitch_deg,yaw_deg --unit attitude=deg")


def test_every_group_that_a_vector_could_be_is_offered(tmp_path: Path) -> None:
    text = "turn.x,turn.y,turn.z,force.x,force.y,force.z\n1,2,3,4,5,6\n2,3,4,5,6,7\n"
    message = refusal(DataError, tmp_path, text)
    assert "--columns v=force.x,force.y,force.z" in message
    assert " or --columns v=" in message
    assert "v=turn.x,turn.y,turn.z" in message


def test_a_time_that_is_called_by_its_unit_has_it(tmp_path: Path) -> None:
    file = tmp_path / "raw.csv"
    for name in ("ms", "tick_ms"):
        file.write_text(f"{name},x,y,z\n0,1,2,3\n20,2,3,4\n40,3,4,6\n")
        (run,) = load_runs(file, (Signal("v", 3, None),), columns={"v": "x,y,z", "t": name})
        assert run.time is not None
        assert run.time.tolist() == pytest.approx([0, 0.02, 0.04])


@pytest.mark.parametrize(
    ("head", "rows", "said"),
    [
        ("uhr [s],x,y,z", 5, "uhr"),  # a unit of time
        ("uhr,x,y,z", 100, "uhr"),
        ("uhr,x,y,z", 5, ""),  # the table of an input, maybe
        ("warm [degC],x,y,z", 100, ""),
        ("s,x,y,z,uhr [s]", 100, "uhr"),
        ("t,x,y,z", 100, ""),
    ],
)
def test_a_column_that_grows_and_is_not_called_the_time_is_pointed_out(tmp_path, head, rows, said):
    """Steps, pulses and lags are not looked for without a time."""
    grows = 0.5 * np.arange(rows)
    table = np.column_stack([grows, np.random.default_rng(0).normal(size=(rows, 3)), 2 * grows])
    file = tmp_path / "log.csv"
    width = head.count(",") + 1
    np.savetxt(file, table[:, :width], delimiter=",", header=head, comments="")
    (run,) = load_runs(file, (Signal("v", 3, None),), columns={"v": "x,y,z"})
    told = [note for note in run.notes if "grows from row to row" in note]
    words = f"{said} grows from row to row: if it is the time, say --columns t={said}"
    assert told == ([words] if said else [])
    (run,) = load_runs(file, (Signal("v", 3, None),), columns={"v": "x,y,z"}, rate=10.0)
    assert not any("grows" in note for note in run.notes)


def test_two_signals_of_one_column_are_said_to_be(tmp_path: Path) -> None:
    """A reading that is its own reference: gain 1 ± 1e-21, and trusted."""
    file = tmp_path / "gauge.csv"
    file.write_text("soll,ist\n1,1.1\n2,2.3\n4,4.2\n")
    signals = (Signal("reference", 1, None), Signal("reading", 1, None))
    for column, notes in (("soll", 1), ("ist", 0)):
        (run,) = load_runs(file, signals, columns={"reference": "soll", "reading": column})
        assert sum("reference and reading are one column, soll" in n for n in run.notes) == notes


def test_rows_that_are_counted_are_no_time(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    table = np.column_stack([np.arange(200), np.random.default_rng(0).normal(size=(200, 3))])
    np.savetxt(file, table, delimiter=",", header="row,x,y,z", comments="")
    (run,) = load_runs(file, (Signal("v", 3, None),), columns={"v": "x,y,z"})
    assert not any("grows" in note for note in run.notes)


def test_a_suggestion_with_blanks_is_quoted_for_the_shell(tmp_path: Path) -> None:
    text = "Acc. X,Acc. Y,Acc. Z\n1,2,3\n2,3,5\n"
    message = refusal(DataError, tmp_path, text)
    assert "try --columns 'v=Acc. X,Acc. Y,Acc. Z'" in message


def test_columns_may_be_named_by_what_they_have_in_common(tmp_path: Path) -> None:
    text = "AccX,AccY,AccZ,w\n1,2,3,0\n4,5,6,0\n"
    run = run_of(tmp_path, text, columns={"v": ("Acc",)})
    np.testing.assert_array_equal(run.signals["v"], [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"units": {"w": "g"}}, "--unit w=…: no signal or column w"),
        ({"scales": {"vxx": "/2"}}, "--scale vxx=…: no signal or column vxx; did you mean vx?"),
        ({"columns": {"vv": "0,1,2"}}, "--columns vv=…: no signal or column vv; did you mean v?"),
        ({"rate": 0.0}, "rate 0.0 Hz makes no sense"),
        ({"rate": float("nan")}, "makes no sense"),
        ({"scales": {"v": "int16^2"}}, "scale 'int16^2' is not understood at '^2'"),
        ({"scales": {"v": "int12/2"}}, "scale 'int12/2' is not understood"),
        ({"scales": {"v": "/0"}}, "is not understood at '/0'"),
        ({"scales": {"v": ""}}, "is not understood"),
    ],
)
def test_options_that_fit_nothing_are_refused(
    tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    assert words in refusal(UsageError, tmp_path, f"vx,vy,vz\n{THREE}", **options)


@pytest.mark.parametrize(
    ("header", "chosen", "found"),
    [
        ("acc_x_raw,acc_y_raw,acc_z_raw", "acc", None),
        ("imu acc X raw,imu acc Y raw,imu acc Z raw", "imu", None),
        ("AccRawX,AccRawY,AccRawZ", "acc", None),
        ("acc1 (g),acc2 (g),acc3 (g)", "acc", None),
        ("acc_0_raw,acc_1_raw,acc_2_raw", "acc", None),
        ("acc_x_raw,acc_y_raw,acc_z_raw", "acc_", None),
    ],
)
def test_a_vector_is_found_by_what_its_columns_have_in_common(
    tmp_path: Path, header: str, chosen: str, found: None
) -> None:
    text = f"n,{header},gyr_x_raw,gyr_y_raw,gyr_z_raw\n7,1,2,3,4,5,6\n9,3,2,2,5,5,5\n"
    run = run_of(tmp_path, text, [ANY], columns={"v": chosen})
    assert run.signals["v"].tolist() == [[1, 2, 3], [3, 2, 2]]


def test_a_vector_that_can_be_read_in_two_ways_is_refused_with_both(tmp_path: Path) -> None:
    header = ",".join(f"acc_{axis}_{kind}" for kind in ("raw", "cal") for axis in "xyz")
    text = f"{header}\n1,2,3,4,5,6\n3,2,2,5,5,5\n"
    said = refusal(DataError, tmp_path, text, [ANY], columns={"v": "acc"})
    assert (
        "acc for signal v can be read in 2 ways, acc_x_raw,acc_y_raw,acc_z_raw or acc_x_cal" in said
    )
    assert "--columns v=acc_x_raw,acc_y_raw,acc_z_raw" in said
    run = run_of(tmp_path, text, [ANY], columns={"v": "acc_x_cal,acc_y_cal,acc_z_cal"})
    assert run.signals["v"][0].tolist() == [4, 5, 6]


FORCE = Signal("kraft", 1, "N")


@pytest.mark.parametrize(
    "header",
    ["Kraft in N", "Kraft (N)", "Kraft [N]", "Kraft/N", "Kraft / N", "Kraft in [N]"],
)
def test_a_quantity_is_found_however_its_unit_is_written(tmp_path: Path, header: str) -> None:
    text = f"{header},Weg in mm\n1,2\n2,5\n"
    for options in ({"columns": {"kraft": "Kraft"}}, {}):
        run = run_of(tmp_path, text, [FORCE], **options)
        assert run.signals["kraft"][:, 0].tolist() == [1, 2]
    thousand = run_of(tmp_path, text.replace(header, header.replace("N", "kN")), [FORCE])
    assert thousand.signals["kraft"][:, 0].tolist() == [1000, 2000]


def test_a_column_is_found_by_its_first_words_where_one_begins_so(tmp_path: Path) -> None:
    text = "Kraft gemessen,Kraftwerk,Weg\n1,2,3\n2,5,4\n"
    run = run_of(tmp_path, text, [FORCE], columns={"kraft": "Kraft"})
    assert run.signals["kraft"][:, 0].tolist() == [1, 2]
    both = "Kraft gemessen,Kraft gerechnet\n1,2\n2,5\n"
    said = refusal(DataError, tmp_path, both, [FORCE], columns={"kraft": "Kraft"})
    assert "can be read in 2 ways, Kraft gemessen or Kraft gerechnet; name the column" in said


@pytest.mark.parametrize("header", ["timestamp,gx,gz,foo", "", "sample,a,b,c"])
def test_the_time_stamp_is_not_offered_as_an_axis(tmp_path: Path, header: str) -> None:
    rows = "\n".join(f"{1583 + k},{k % 3},{k % 4},{k % 5}" for k in range(9))
    said = refusal(DataError, tmp_path, f"{header}\n{rows}\n".lstrip(), [ANY])
    names = header.split(",") if header else list("0123")
    assert said.endswith(f"try --columns v={','.join(names[1:])}")


def test_no_file_at_all_is_refused() -> None:
    with pytest.raises(UsageError, match="no data file given"):
        load_runs([], [V])


# --- bad cells ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "words"), [("inf", "'inf'"), ("oops", "'oops'"), ("1e400", "'1e400'"), ("?", "'?'")]
)
def test_a_bad_cell_in_a_used_column_is_named(tmp_path: Path, cell: str, words: str) -> None:
    text = f"vx,vy,vz\n1,2,3\n4,{cell},6\n7,8,9\n"
    message = refusal(DataError, tmp_path, text)
    assert "imu.csv: column vy row 1" in message
    assert words in message
    assert "repair or delete that row" in message


def test_a_bad_cell_elsewhere_costs_only_its_column_and_is_noted(tmp_path: Path) -> None:
    run = run_of(tmp_path, "vx,vy,vz,temp,n\n1,2,3,20,1\n4,5,6,,2\n7,8,9,21,3\n")
    assert list(run.columns) == ["n"]
    assert "column temp left out: row 1 is empty" in run.notes


@pytest.mark.parametrize("cell", ["", "nan", "NaN", "n/a", "null"])
def test_a_row_without_a_reading_is_dropped_counted_and_said(tmp_path: Path, cell: str) -> None:
    text = (
        f"t [s],vx,vy,vz,n\n0,1,2,3,1\n1,4,{cell},6,2\n2,7,8,9,4\n3,{cell},1,{cell},8\n4,5,1,2,16\n"
    )
    run = run_of(tmp_path, text, [T, V])
    assert run.signals["v"].tolist() == [[1, 2, 3], [7, 8, 9], [5, 1, 2]]
    assert run.rows.tolist() == [0, 2, 4]
    assert run.signals["t"][:, 0].tolist() == [0, 2, 4]
    assert run.columns["n"].tolist() == [1, 4, 16]
    assert "2 of 5 rows dropped: 2 without vx vy vz, the first row 1" in run.notes


def test_dropped_rows_keep_their_place_in_time_where_a_rate_gives_it(tmp_path: Path) -> None:
    text = "vx,vy,vz\n,2,3\n4,5,6\n,8,9\n3,1,2\n"
    run = run_of(tmp_path, text, [T, V], rate=10)
    np.testing.assert_allclose(run.signals["t"][:, 0], [0, 0.2])


def test_many_dropped_rows_in_a_row_are_a_gap_without_a_time_too(tmp_path: Path) -> None:
    rows = ["1,2,3" if k % 2 else "2,1,4" for k in range(20)]
    rows[8:15] = [",,"] * 7
    run = run_of(tmp_path, "vx,vy,vz\n" + "\n".join(rows) + "\n")
    assert run.block.tolist() == [0] * 8 + [1] * 5


def three_axes(seed: int, count: int = 400, step: float = 0.0) -> np.ndarray:
    """Readings of a moving sensor, to `step` if there is one."""
    rng = np.random.default_rng(seed)
    found = np.cumsum(rng.standard_normal((count, 3)), axis=0) + 40
    return np.round(found / step) * step if step else found


def written(values: np.ndarray) -> str:
    return "vx,vy,vz\n" + "\n".join(",".join(f"{x:.12g}" for x in row) for row in values) + "\n"


def test_what_a_waiting_logger_writes_again_is_no_reading(tmp_path: Path) -> None:
    """Zeros are none from the first on; of the last reading that is written again the first is."""
    padded = three_axes(1)
    padded[392:] = 0
    run = run_of(tmp_path, written(padded))
    assert run.rows.tolist() == list(range(392))
    (note,) = [n for n in run.notes if "dropped" in n]
    assert note.startswith("8 of 400 rows dropped: 8 repeat vx vy vz")
    assert note.endswith("the first row 392")
    waiting = three_axes(2)
    waiting[100:110] = waiting[99]
    run = run_of(tmp_path, written(waiting))
    assert run.rows.tolist() == [*range(100), *range(110, 400)]


@pytest.mark.parametrize("seed", range(8))
def test_readings_that_come_twice_for_another_reason_stay(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    quiet = np.round(rng.standard_normal((400, 3)) * 0.4)  # at rest, on few levels
    held = np.repeat(three_axes(seed, 100), 4, axis=0)  # a slower sensor, written four times
    for values in (quiet, held, three_axes(seed, step=1.0), three_axes(seed)):
        assert len(run_of(tmp_path, written(values))) == 400
    short = three_axes(seed, 30)
    short[10:14] = short[10]  # of a table nobody knows
    assert len(run_of(tmp_path, written(short))) == 30


def test_a_record_without_one_whole_row_is_refused(tmp_path: Path) -> None:
    said = refusal(DataError, tmp_path, "vx,vy,vz\n,2,3\n4,,6\n7,8,\n")
    assert "no row has every number that is needed (3 of 3 rows dropped: 3 without vx vy vz" in said
    text = "run,vx,vy,vz\na,1,2,3\na,2,1,4\nb,,1,1\nb,,2,2\n"
    run = run_of(tmp_path, text)
    assert run.name == "imu:a"
    assert "run b left out: none of its rows is complete" in run.notes


def test_rows_without_the_time_that_a_model_needs_are_dropped(tmp_path: Path) -> None:
    run = run_of(tmp_path, "t,vx,vy,vz\n0,1,2,3\n,2,3,4\n2,4,5,6\n", [T, V])
    assert run.signals["t"][:, 0].tolist() == [0, 2]
    assert "1 of 3 rows dropped: 1 without t, the first row 1" in run.notes


def test_an_optical_attitude_with_gaps_of_nan_is_used_where_it_is_there(shared_data: Path) -> None:
    """3944 of 57 141 rows of the quaternion are NaN: known from the file by SciPy alone."""
    file = shared_data / "broad" / "26_disturbed_phone_vibration_A.mat"
    quaternion = scipy.io.loadmat(str(file))["opt_quat"]
    there = np.isfinite(quaternion).all(axis=1)
    (run,) = load_runs(
        [file],
        [Signal("m", 3, None), ATTITUDE],
        columns={"m": "imu_mag", "attitude": [f"opt_quat[{k}]" for k in range(4)]},
    )
    assert len(run) == there.sum() == 57141 - 3944
    expected = Rotation.from_quat(quaternion[there][:, [1, 2, 3, 0]]).as_matrix().reshape(-1, 9)
    np.testing.assert_allclose(run.signals["attitude"], expected, atol=1e-9)
    words = (
        "3944 of 57141 rows dropped: 3944 without opt_quat[0] opt_quat[1] opt_quat[2] opt_quat[3]"
    )
    assert any(words in note for note in run.notes)


def test_a_column_that_is_whole_where_the_signals_are_is_kept(tmp_path: Path) -> None:
    run = run_of(tmp_path, "vx,vy,vz,temp\n1,2,3,20\n4,,6,\n7,8,9,21\n")
    assert run.columns["temp"].tolist() == [20, 21]


def test_extra_columns_must_be_there_and_cost_the_rows_that_they_lack(tmp_path: Path) -> None:
    text = "vx,vy,vz,temp\n1,2,3,20\n4,5,6,\n7,8,9,21\n"
    run = run_of(tmp_path, text, extra=["temp"])
    assert run.columns["temp"].tolist() == [20, 21]
    assert "1 of 3 rows dropped: 1 without temp, the first row 1" in run.notes
    assert "did you mean temp?" in refusal(DataError, tmp_path, text, extra=["tmep"])


def test_labels_where_numbers_are_needed_are_refused(tmp_path: Path) -> None:
    text = "part,vx,vy\na,1,2\nb,2,3\n"
    message = refusal(DataError, tmp_path, text, columns={"v": "part,vx,vy"})
    assert "column part row 0 holds 'a', and signal v needs numbers" in message


@pytest.mark.parametrize("signal", [V, ANY])
def test_a_signal_that_never_changes_is_refused(tmp_path: Path, signal: Signal) -> None:
    message = refusal(DataError, tmp_path, "vx,vy,vz\n1,2,3\n1,2,3\n1,2,3\n", [signal])
    assert "signal v (columns vx vy vz) is 1, 2, 3 in all 3 rows; a dead channel" in message


def test_a_setting_of_its_own_in_each_run_is_no_dead_channel(tmp_path: Path) -> None:
    """A motor at 3 V, and at 4 V (a public record was refused)."""
    signals = [Signal("u", 1, "V"), Signal("y", 1, None)]
    for k, volts in enumerate((3, 4, 3)):
        rows = "".join(f"{volts},{y}\n" for y in (1.5, 2.5, 3.0))
        (tmp_path / f"{k}.csv").write_text(f"u [V],y\n{rows}")
    files = [str(tmp_path / f"{k}.csv") for k in range(3)]
    assert [r.signals["u"][0, 0] for r in load_runs(files, signals)] == [3, 4, 3]
    whole = "u [V],y,run\n3,1,a\n3,2,a\n4,1,b\n4,2,b\n"
    (tmp_path / "runs.csv").write_text(whole)
    assert len(load_runs([str(tmp_path / "runs.csv")], signals)) == 2
    with pytest.raises(DataError, match=r"signal u \(columns u\) is 3 in all 3 rows; a dead"):
        load_runs([files[0], files[2]], signals)


@pytest.mark.parametrize(
    ("size", "words"),
    [
        (
            "1e-310",
            "signal v (columns vx vy vz) is nowhere larger than 3e-310, too small to compute with",
        ),
        (
            "1e-200",
            "signal v (columns vx vy vz) is nowhere larger than 3e-200, too small to compute with",
        ),
        ("1e200", "column vx reaches 2e+200, too large to compute with"),
    ],
)
def test_readings_beyond_what_can_be_squared_are_refused(
    tmp_path: Path, size: str, words: str
) -> None:
    power = size[1:]
    text = f"vx,vy,vz\n1{power},2{power},3{power}\n2{power},1{power},1{power}\n"
    said = refusal(DataError, tmp_path, text)
    assert words in said
    assert "--scale v" in said
    said = refusal(DataError, tmp_path, "vx,vy,vz\n1,2,3\n1,2,3\n2,1e200,1\n2,1,1\n")
    assert "for signal v; it does in row 2: take it out" in said
    one = run_of(tmp_path, "vx,vy,vz,w\n1,1e-310,3,1e300\n2,1,1,2e300\n")
    assert one.signals["v"][0, 1] == 1e-310
    assert "column w left out: it holds numbers too large to compute with" in one.notes


def test_one_dead_axis_is_noted(tmp_path: Path) -> None:
    run = run_of(tmp_path, "vx,vy,vz\n1,2,3\n1,3,3.5\n1,4,2\n")
    assert "vx: 1 in all 3 rows; a dead channel?" in run.notes


def test_a_rotation_may_be_constant(tmp_path: Path) -> None:
    run = run_of(tmp_path, "roll [rad],pitch [rad],yaw [rad]\n0,0,0\n0,0,0\n", [ATTITUDE])
    np.testing.assert_array_equal(run.signals["attitude"], np.tile(np.eye(3).ravel(), (2, 1)))


# --- units -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "options"),
    [
        ("vx [g],vy [g],vz [g]", {}),
        ("vx (g),vy (g),vz (g)", {}),
        ("vx g,vy g,vz g", {}),
        ("vx,vy,vz", {"units": {"v": "g"}}),
        ("vx,vy,vz", {"units": {"vx": "g", "vy": "g", "vz": "g"}}),
        ("vx [m/s^2],vy [m/s^2],vz [m/s^2]", {"units": {"v": "g"}}),
        ("vx [huh],vy [huh],vz [huh]", {"units": {"v": "g"}}),
    ],
)
def test_units_of_header_or_user_are_converted_to_the_declared(
    tmp_path: Path, header: str, options: dict[str, Any]
) -> None:
    run = run_of(tmp_path, f"{header}\n{THREE}", **options)
    np.testing.assert_allclose(run.signals["v"][0], np.array([1, 2, 3]) * 9.80665)
    assert run.units["v"] == "m/s^2"


def test_a_temperature_converts_with_its_offset(tmp_path: Path) -> None:
    run = run_of(tmp_path, "temperature [degF],b\n32,1\n212,2\n", [TEMPERATURE])
    np.testing.assert_allclose(run.signals["temperature"][:, 0], [0, 100], atol=1e-9)


def test_a_signal_of_any_unit_keeps_that_of_the_data(tmp_path: Path) -> None:
    run = run_of(tmp_path, f"vx [LSB],vy [LSB],vz [LSB]\n{THREE}", [ANY])
    assert run.units["v"] == "count"
    silent = run_of(tmp_path, f"vx,vy,vz\n{THREE}", [ANY])
    assert silent.units["v"] is None


def test_mixed_units_in_a_vector_are_converted_to_the_first(tmp_path: Path) -> None:
    run = run_of(tmp_path, f"vx [g],vy [mg],vz [m/s^2]\n{THREE}", [ANY])
    np.testing.assert_allclose(run.signals["v"][0], [1, 2e-3, 3 / 9.80665])
    assert run.units["v"] == "g"


def test_a_silent_file_is_taken_at_the_declared_unit_and_says_so(tmp_path: Path) -> None:
    run = run_of(tmp_path, f"vx,vy,vz\n{THREE}")
    (note,) = run.notes
    assert note.startswith("v: no unit stated for vx vy vz, taken as m/s^2 (median length 4.55")
    assert "--unit v=…" in note


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("vx [rad/s],vy [rad/s],vz [rad/s]", "column vx is in rad/s and signal v wants m/s^2"),
        ("vx [m/s^2],vy [LSB],vz [m/s^2]", "column vy is in count and signal v wants m/s^2"),
        ("vx [m/s^2],vy [m/s^3^],vz", "column vy: unknown unit 'm/s^3^': did you mean"),
    ],
)
def test_a_unit_that_does_not_fit_is_refused_by_column(
    tmp_path: Path, header: str, words: str
) -> None:
    message = refusal(UnitError, tmp_path, f"{header}\n{THREE}")
    assert "imu.csv" in message
    assert words in message
    assert "--unit v=" in message


def test_axes_of_different_kind_are_refused(tmp_path: Path) -> None:
    message = refusal(UnitError, tmp_path, f"vx [g],vy [T],vz [g]\n{THREE}", [ANY])
    assert "column vy is in T and its axes mix" in message


def test_an_unknown_unit_from_the_user_names_the_option(tmp_path: Path) -> None:
    message = refusal(UnitError, tmp_path, f"vx,vy,vz\n{THREE}", units={"v": "gg"})
    assert "--unit v=gg: unknown unit 'gg'" in message


@given(st.floats(1e-3, 1e3))
@settings(max_examples=20, deadline=None)
def test_the_unit_of_the_file_does_not_change_the_signal(
    tmp_path_factory: pytest.TempPathFactory, size: float
) -> None:
    folder = tmp_path_factory.mktemp("units")
    values = size * np.random.default_rng(0).normal(size=(5, 3))

    def written(unit: str, factor: float) -> Run:
        body = "\n".join(",".join(repr(float(x)) for x in row / factor) for row in values)
        return run_of(folder, f"vx [{unit}],vy [{unit}],vz [{unit}]\n{body}")

    np.testing.assert_allclose(
        written("g", 9.80665).signals["v"], written("m/s²", 1.0).signals["v"], rtol=1e-14
    )


# --- raw counts --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scale", "stored", "expected"),
    [
        ("int16/256+25", 65236, -300 / 256 + 25),
        ("int16/256+25", 256, 26.0),
        ("int16", -300, -300),
        ("int8*2", 255, -2),
        ("uint16", -1, 65535),
        ("int32/2", 4294967295, -0.5),
        ("/131", 262, 2.0),
        ("*0.01-5", 500, 0.0),
        ("+1e1", 1, 11.0),
        ("int16 / 340 + 36.53", 0, 36.53),
    ],
)
def test_raw_counts_become_values_step_by_step(
    tmp_path: Path, scale: str, stored: int, expected: float
) -> None:
    text = f"temp,n\n{stored},1\n7,2\n"
    for name in ("temp", "temperature"):  # by column, by signal
        run = run_of(
            tmp_path,
            text,
            [TEMPERATURE],
            columns={"temperature": "temp"},
            scales={name: scale},
        )
        assert run.signals["temperature"][0, 0] == pytest.approx(expected)


def test_scaled_counts_are_counts_no_more(tmp_path: Path) -> None:
    text = "vx [LSB],vy [LSB],vz [LSB]\n2,4,6\n4,6,65534\n"
    told = run_of(tmp_path, text, scales={"v": "int16/2"}, units={"v": "g"})
    np.testing.assert_allclose(told.signals["v"], np.array([[1, 2, 3], [2, 3, -1]]) * 9.80665)
    assumed = run_of(tmp_path, text, scales={"v": "int16/2"})
    np.testing.assert_allclose(assumed.signals["v"], [[1, 2, 3], [2, 3, -1]])


@pytest.mark.parametrize("cell", ["1.5", "70000", "-40000"])
def test_a_value_that_is_no_such_count_is_named(tmp_path: Path, cell: str) -> None:
    text = f"temp,n\n20,1\n{cell},2\n"
    message = refusal(
        DataError,
        tmp_path,
        text,
        [TEMPERATURE],
        columns={"temperature": "temp"},
        scales={"temp": "int16/256"},
    )
    assert f"column temp row 1 holds {float(cell):g}, which is no int16" in message


@pytest.mark.parametrize("written", ["/16384", "1/16384", "0.00006103515625"])
def test_a_factor_may_be_written_as_a_number(tmp_path: Path, written: str) -> None:
    text = "vx,vy,vz\n16384,-16384,8192\n0,1,2\n"
    run = run_of(tmp_path, text, scales={"v": written})
    np.testing.assert_array_equal(run.signals["v"][0], [1, -1, 0.5])


def test_columns_that_no_signal_takes_are_scaled_too(tmp_path: Path) -> None:
    text = "vx,vy,vz,temp [raw]\n1,2,3,65236\n4,5,6,65233\n"
    run = run_of(tmp_path, text, scales={"temp": "int16/256+25"}, units={"temp": "°C"})
    assert run.columns["temp"][0] == pytest.approx(23.828125)
    assert run.column_units["temp"] == "degC"


# --- time --------------------------------------------------------------------------------------


def timed(steps: Sequence[float], header: str = "t", start: float = 0.0) -> str:
    time = start + np.cumsum([0.0, *steps])
    rows = (f"{t!r},{i},{i * i},{-i}" for i, t in enumerate(time.tolist()))
    return f"{header},vx,vy,vz\n" + "\n".join(rows)


@pytest.mark.parametrize(
    ("header", "size"),
    [
        ("t [s]", 1.0),
        ("time (ms)", 1e-3),
        ("Timestamp [us]", 1e-6),
        ("time_ms", 1e-3),
        ("t_us", 1e-6),
        ("millis", 1e-3),
        ("micros()", 1e-6),
        ("TIME", 1.0),
    ],
)
def test_time_is_found_and_converted_and_starts_at_zero(
    tmp_path: Path, header: str, size: float
) -> None:
    run = run_of(tmp_path, timed([10, 10, 10], header, start=1000.0), [T, V])
    np.testing.assert_allclose(run.signals["t"][:, 0], np.arange(4) * 10 * size)
    assert run.time is not None
    np.testing.assert_array_equal(run.time, run.signals["t"][:, 0])
    assert any("that sample is t = 0" in note for note in run.notes)
    assert not {"t", "time"} & {name.lower() for name in run.columns}


def test_the_columns_own_zero_is_kept_when_told(tmp_path: Path) -> None:
    run = run_of(tmp_path, timed([1, 1], start=5.0), [T, V], time_zero="column")
    np.testing.assert_array_equal(run.signals["t"][:, 0], [5, 6, 7])


def test_the_unit_of_time_may_be_stated(tmp_path: Path) -> None:
    run = run_of(tmp_path, timed([20, 20]), [T, V], units={"t": "ms"})
    np.testing.assert_allclose(run.signals["t"][:, 0], [0, 0.02, 0.04])


def test_time_without_a_unit_is_taken_as_seconds_and_says_so(tmp_path: Path) -> None:
    run = run_of(tmp_path, timed([20, 20]), [T, V])
    words = "t: no unit stated, taken as s (median step 20 s); if that is wrong say --unit t=ms"
    assert words in run.notes


def test_a_column_that_always_grows_is_suggested_as_the_time(tmp_path: Path) -> None:
    text = "vx,vy,vz,Zeit\n1,2,3,10\n2,1,4,11\n0,5,2,12\n"
    assert "give --rate HZ or --columns t=Zeit" in refusal(DataError, tmp_path, text, [T, V])


@pytest.mark.parametrize(
    "texts",
    [
        ("2020-03-07 15:45:00.000", "2020-03-07 15:45:00.250", "2020-03-07 15:45:01"),
        ("15:45:00.000", "15:45:00.250", "15:45:01.000"),
        ("2020-03-07T15:45:00Z", "2020-03-07T15:45:00.25Z", "2020-03-07T15:45:01Z"),
    ],
)
def test_dates_and_clock_times_are_times(tmp_path: Path, texts: Sequence[str]) -> None:
    rows = "\n".join(f"{text},{i},{i},{2 * i}" for i, text in enumerate(texts))
    run = run_of(tmp_path, f"time,vx,vy,vz\n{rows}\n", [T, V])
    np.testing.assert_allclose(run.signals["t"][:, 0], [0, 0.25, 1.0])


def test_a_rate_makes_time_without_a_column(tmp_path: Path) -> None:
    run = run_of(tmp_path, f"vx,vy,vz\n{THREE}", [T, V], rate=50)
    np.testing.assert_allclose(run.signals["t"][:, 0], [0, 0.02, 0.04])


def test_a_rate_above_the_table_is_used_and_reported(tmp_path: Path) -> None:
    text = f"Fs,100\nvx,vy,vz\n{THREE}"
    run = run_of(tmp_path, text, [T, V])
    np.testing.assert_allclose(run.signals["t"][:, 0], [0, 0.01, 0.02])
    assert "time from the entry 'Fs,100': 100 Hz" in run.notes
    told = run_of(tmp_path, text, [T, V], rate=10)
    np.testing.assert_allclose(told.signals["t"][:, 0], [0, 0.1, 0.2])


def test_a_stated_rate_wins_over_a_column_and_says_so(tmp_path: Path) -> None:
    run = run_of(tmp_path, timed([1, 0, 1]), [T, V], rate=10)
    np.testing.assert_allclose(run.signals["t"][:, 0], [0, 0.1, 0.2, 0.3])
    assert "time column t not used: rate 10 Hz is given" in run.notes


def test_time_is_kept_for_models_that_do_not_ask_for_it(tmp_path: Path) -> None:
    run = run_of(tmp_path, timed([0.1, 0.1]), [V])
    assert run.time is not None
    assert list(run.signals) == ["v"]
    assert run_of(tmp_path, f"vx,vy,vz\n{THREE}").time is None


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ([1, -2, 1], "column t row 2: time -1 s goes backward from 1 s in row 1 (1 such rows)"),
        ([1, 0, 0], "column t row 2: time 1 s repeats 1 s in row 1 (2 such rows)"),
    ],
)
def test_time_must_increase(tmp_path: Path, steps: Sequence[float], words: str) -> None:
    message = refusal(DataError, tmp_path, timed(steps), [T, V])
    assert words in message
    assert "--rate HZ" in message


def test_a_bad_time_that_no_signal_needs_is_only_noted(tmp_path: Path) -> None:
    run = run_of(tmp_path, timed([1, -2, 1]), [V])
    assert run.time is None
    assert any(note.startswith("time not used:") for note in run.notes)


def stamped(stamps: Sequence[float]) -> str:
    """Rows whose readings tell when they were made."""
    return "t,vx,vy,vz\n" + "".join(f"{t:g},{t:g},2,3\n" for t in stamps)


@pytest.mark.parametrize(
    ("stamps", "said"),
    [
        (np.arange(60.0)[::-1], "the newest row comes first"),
        (np.roll(np.arange(60.0), 20), "the log wraps: it begins at row 20"),
        ([*range(30), 31, 30, *range(32, 60)], "1 row came late, the first row 31"),
        ([*range(30), 35, 30, 31, 32, 33, 34, *range(36, 60)], "5 rows came late"),
    ],
)
def test_rows_that_a_log_has_in_another_order_are_put_in_that_of_time(
    tmp_path: Path, stamps: Sequence[float], said: str
) -> None:
    for wanted in ([T, V], [V]):
        run = run_of(tmp_path, stamped(stamps), wanted)
        assert run.time is not None
        np.testing.assert_array_equal(run.time, np.arange(60.0))
        np.testing.assert_array_equal(run.signals["v"][:, 0], np.arange(60.0))
        np.testing.assert_array_equal(np.asarray(stamps)[run.rows], np.arange(60.0))
        assert len(np.unique(run.block)) == 1
        assert any(said in note for note in run.notes)


def test_a_row_that_came_late_is_named_as_in_its_file(tmp_path: Path) -> None:
    """There is another run before."""
    rows = [f"a,{t},1,2,3\n" for t in range(20)]
    rows += [f"b,{t},{t},2,3\n" for t in (0, 1, 2, 4, 3, *range(5, 12))]
    (tmp_path / "log.csv").write_text("run,t,vx,vy,vz\n" + "".join(rows))
    _, late = load_runs([str(tmp_path / "log.csv")], [Signal("v", 3, None)])
    assert any("1 row came late, the first row 24" in note for note in late.notes)
    np.testing.assert_array_equal(late.rows, [20, 21, 22, 24, 23, *range(25, 32)])


def test_rows_of_one_stamp_of_a_coarse_clock_are_spread_over_its_step(tmp_path: Path) -> None:
    """250 rows at 2.5 Hz, by a clock of whole seconds: each is off by less than one."""
    true = np.arange(250) / 2.5
    run = run_of(tmp_path, stamped(np.floor(true)), [V])
    assert run.time is not None
    assert np.all(np.diff(run.time) > 0)
    assert np.abs(run.time - true).max() < 0.5
    assert any("stamps are 1 s apart, and 250 of 250 rows share one" in n for n in run.notes)


@pytest.mark.parametrize(
    "stamps",
    [
        np.repeat(np.arange(30.0), 3),  # repeats of a table
        [*range(60), 59.001, 59.001, *range(60, 120)],  # a fine clock, and a row twice
    ],
)
def test_rows_of_one_stamp_are_else_in_no_order(tmp_path: Path, stamps: Sequence[float]) -> None:
    assert run_of(tmp_path, stamped(stamps), [V]).time is None


@pytest.mark.parametrize(
    "stamps",
    [
        [*range(40), *range(30)],  # started again
        [*range(40), *np.arange(0.5, 30)],  # and at other times
        [*range(50), 7.5, *range(51, 60)],  # one wrong stamp
    ],
)
def test_times_of_which_nobody_can_tell_the_order_are_not_put_in_one(
    tmp_path: Path, stamps: Sequence[float]
) -> None:
    assert "goes backward" in refusal(DataError, tmp_path, stamped(stamps), [T, V])
    assert run_of(tmp_path, stamped(stamps), [V]).time is None


@pytest.mark.parametrize(
    ("text", "kind", "words"),
    [
        (f"vx,vy,vz\n{THREE}", DataError, "no time column (t, time, timestamp) for signal t"),
        ("t [m],vx,vy,vz\n0,1,2,3\n1,2,3,4\n", UnitError, "column t as time: m does not convert"),
        ("t,vx,vy,vz\na,1,2,3\nb,2,3,4\n", DataError, "column t row 0 holds 'a', which is no time"),
        ("t,vx,vy,vz\n0,1,2,3\n?,2,3,4\n2,4,5,6\n", DataError, "column t row 1 holds '?'"),
    ],
)
def test_a_time_that_is_none_is_refused(
    tmp_path: Path, text: str, kind: type[CasestError], words: str
) -> None:
    assert words in refusal(kind, tmp_path, text, [T, V])


def test_a_time_of_another_unit_matters_only_where_time_is_needed(tmp_path: Path) -> None:
    run = run_of(tmp_path, "time [LSB],vx,vy,vz\n0,1,2,3\n1,2,3,4\n", [V])
    assert run.time is None
    assert any("count does not convert to s" in note for note in run.notes)


def test_a_capital_t_without_a_unit_of_time_is_a_temperature(tmp_path: Path) -> None:
    for header in ("T", "T [°C]"):
        run = run_of(tmp_path, f"{header},vx,vy,vz\n20,1,2,3\n19,2,3,4\n", [V])
        assert run.time is None
        assert "T" in run.columns
    assert run_of(tmp_path, "T [s],vx,vy,vz\n0,1,2,3\n1,2,3,4\n", [V]).time is not None


@pytest.mark.parametrize(
    ("name", "scale"), [("t", "/1000000"), ("t", "/1e6"), ("t", "*1e-6"), ("Zeit", "/1000000")]
)
def test_time_stamps_are_scaled_like_any_count(tmp_path: Path, name: str, scale: str) -> None:
    text = timed([20_000, 20_000], "Zeit", start=5e6)
    run = run_of(tmp_path, text, [T, V], columns={"t": "Zeit"}, scales={name: scale})
    np.testing.assert_allclose(run.signals["t"][:, 0], [0, 0.02, 0.04])
    assert any("Zeit: no unit stated, taken as s (median step 0.02 s)" in n for n in run.notes)


def test_scaled_time_stamps_have_the_unit_that_is_stated(tmp_path: Path) -> None:
    text = timed([20, 20], "ticks")
    said = {"columns": {"t": "ticks"}, "scales": {"t": "/2"}}
    run = run_of(tmp_path, text, [T, V], units={"t": "us"}, **said)
    np.testing.assert_allclose(run.time, [0, 10e-6, 20e-6])
    counts = run_of(tmp_path, timed([20, 20], "ticks [count]"), [T, V], **said)
    np.testing.assert_allclose(counts.time, [0, 10, 20])
    stated = run_of(tmp_path, timed([20_000, 20_000]), [T, V], units={"t": "us"})
    np.testing.assert_allclose(stated.time, [0, 0.02, 0.04])


def test_a_time_in_microseconds_that_is_scaled_too_is_asked_about(tmp_path: Path) -> None:
    text = timed([20_000, 20_000], "time_us")
    message = refusal(UsageError, tmp_path, text, [T, V], scales={"t": "/1000000"})
    assert "column time_us is in us by its header, and --scale changes its numbers" in message
    told = run_of(tmp_path, text, [T, V], scales={"t": "/1000000"}, units={"t": "s"})
    np.testing.assert_allclose(told.time, [0, 0.02, 0.04])


def test_lost_packets_and_a_gap_are_said_with_count_and_place(tmp_path: Path) -> None:
    """1000 samples at 100 Hz with jitter; 20 lost one at a time, then 40 in a row."""
    rng = np.random.default_rng(1)
    lost = np.arange(25, 425, 20)
    kept = np.setdiff1d(np.arange(1000), [*lost, *range(700, 740)])
    time = 0.01 * kept + rng.normal(0, 2e-4, len(kept))
    rows = "\n".join(f"{t:.5f},{k % 7},{k % 5},{k % 3}" for k, t in enumerate(time))
    run = run_of(tmp_path, f"t [s],vx,vy,vz\n{rows}\n", [T, V])
    (note,) = [note for note in run.notes if "missing" in note]
    assert note.startswith("t: 20 samples missing in 20 places, the first behind row 24 (t = 0.239")
    assert "1 gap, the longest 0.4" in note
    assert f"(40 samples) behind row {700 - 20 - 1} (t = 6.99" in note
    assert note.endswith("the median step is 0.01 s")


@pytest.mark.parametrize("form", ["even", "jitter", "poses"])
def test_a_whole_record_and_one_at_uneven_times_lack_nothing(tmp_path: Path, form: str) -> None:
    rng = np.random.default_rng(2)
    steps = {
        "even": np.full(200, 0.01),
        "jitter": 0.01 + rng.uniform(-3e-3, 3e-3, 200),
        "poses": rng.uniform(1, 3, 200),
    }[form]
    run = run_of(tmp_path, timed(steps.tolist(), "t [s]"), [T, V])
    assert not [note for note in run.notes if "missing" in note or "gap" in note]


def test_many_long_steps_may_be_coarse_time_stamps(tmp_path: Path) -> None:
    """800 Hz with stamps in whole milliseconds: each fourth step is two of them."""
    stamps = np.floor(np.arange(200) * 1.25)
    run = run_of(tmp_path, timed(np.diff(stamps).tolist(), "t [ms]"), [T, V])
    assert any("or the time stamps are coarse" in note for note in run.notes)


def test_a_gap_in_time_starts_a_block(tmp_path: Path) -> None:
    run = run_of(tmp_path, timed([1, 1, 6, 1, 1, 4, 1, 40, 1]), [T, V])
    assert run.block.tolist() == [0, 0, 0, 1, 1, 1, 1, 1, 2, 2]


# --- groups ------------------------------------------------------------------------------------


def test_a_run_column_splits_the_file_into_runs(tmp_path: Path) -> None:
    text = "run,t,vx,vy,vz\n1,5,1,2,3\n1,6,2,3,4\n2,0.5,3,4,5\n2,1.5,5,6,7\n2,2.5,5,6,8\n"
    first, second = runs_of(tmp_path, text, [T, V])
    assert (first.name, second.name) == ("imu:1", "imu:2")
    assert (len(first), len(second)) == (2, 3)
    np.testing.assert_array_equal(second.rows, [2, 3, 4])
    np.testing.assert_array_equal(second.signals["t"][:, 0], [0, 1, 2])


def test_a_pose_column_makes_blocks_and_a_return_makes_another(tmp_path: Path) -> None:
    text = "pose,vx,vy,vz\na,1,2,3\na,2,3,4\nb,3,4,5\na,4,5,6\na,5,6,8\n"
    run = run_of(tmp_path, text)
    assert run.block.tolist() == [0, 0, 1, 2, 2]
    assert "pose" not in run.columns


def test_groups_may_be_called_otherwise(tmp_path: Path) -> None:
    text = "part,vx,vy,vz\na,1,2,3\na,2,3,4\nb,3,4,5\nb,5,6,7\n"
    assert run_of(tmp_path, text, columns={"pose": "part"}).block.tolist() == [0, 0, 1, 1]
    assert len(runs_of(tmp_path, text, columns={"run": "part"})) == 2


def test_a_row_without_its_group_is_refused(tmp_path: Path) -> None:
    text = "run,vx,vy,vz\n1,1,2,3\n,2,3,4\n2,3,4,5\n"
    assert "column run row 1 is empty" in refusal(DataError, tmp_path, text)


def test_files_of_one_name_are_told_apart(tmp_path: Path) -> None:
    files = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        files.append(tmp_path / folder / "imu.csv")
        files[-1].write_text(f"vx,vy,vz\n{THREE}")
    assert [run.name for run in load_runs(files, [V])] == ["imu#1", "imu#2"]


def test_every_other_column_is_kept_with_its_unit(tmp_path: Path) -> None:
    text = "part,vx,vy,vz,temp [°C],volt\na,1,2,3,20,5\nb,2,3,4,21,5\n"
    run = run_of(tmp_path, text)
    assert list(run.columns) == ["part", "temp", "volt"]
    assert run.column_units == {"part": None, "temp": "degC", "volt": None}
    assert run.columns["part"].tolist() == ["a", "b"]


def test_a_raw_run_counts_one_sample_each_and_has_no_spread(tmp_path: Path) -> None:
    run = run_of(tmp_path, f"vx,vy,vz\n{THREE}")
    assert run.count.tolist() == [1, 1, 1]
    assert run.spread == {}
    assert run.rows.tolist() == [0, 1, 2]


def test_taking_samples_keeps_all_parts_together(tmp_path: Path) -> None:
    run = run_of(tmp_path, timed([1, 1, 20, 1]) + "\n", [T, V])
    for part in (run.take(np.array([1, 3])), run.take(np.array([0, 1, 0, 1, 0], dtype=bool))):
        assert part.rows.tolist() == [1, 3]
        assert part.signals["v"][:, 0].tolist() == [1, 3]
        assert part.block.tolist() == [0, 1]
        assert len(part) == 2


def test_a_run_of_unequal_parts_is_refused() -> None:
    with pytest.raises(DataError, match="x: w has 3 samples, the run has 4"):
        Run.raw("x", {"v": np.zeros((4, 3)), "w": np.zeros((3, 3))}, units={})
    with pytest.raises(DataError, match=r"signal v has shape \(4,\), not \(N, k\)"):
        Run.raw("x", {"v": np.zeros(4)}, units={})


# --- rotations ---------------------------------------------------------------------------------

ANGLES = np.array([[10.0, -20.0, 30.0], [-170.0, 80.0, 5.0], [0.0, 45.0, -90.0]])


def matrices(angles: np.ndarray) -> np.ndarray:
    """Intrinsic z-y-x from SciPy, which wants yaw first."""
    return Rotation.from_euler("ZYX", angles[:, ::-1], degrees=True).as_matrix().reshape(-1, 9)


def rotation_text(header: str, rows: np.ndarray) -> str:
    return header + "\n" + "\n".join(",".join(map(repr, row)) for row in rows.tolist())


@pytest.mark.parametrize(
    ("header", "factor", "options"),
    [
        ("roll [deg],pitch [deg],yaw [deg]", 1.0, {}),
        ("Roll (°),Pitch (°),Yaw (°)", 1.0, {}),
        ("roll,pitch,yaw", 1.0, {"units": {"attitude": "deg"}}),
        ("roll [rad],pitch [rad],yaw [rad]", np.pi / 180, {}),
        ("roll,pitch,yaw", np.pi / 180, {}),
        ("attitude_roll [deg],attitude_pitch [deg],attitude_yaw [deg]", 1.0, {}),
        ("a [deg],b [deg],c [deg]", 1.0, {"columns": {"attitude": "a,b,c"}}),
    ],
)
def test_angles_become_body_to_reference_matrices(
    tmp_path: Path, header: str, factor: float, options: dict[str, Any]
) -> None:
    run = run_of(tmp_path, rotation_text(header, ANGLES * factor), [ATTITUDE], **options)
    np.testing.assert_allclose(run.signals["attitude"], matrices(ANGLES), atol=1e-12)


@pytest.mark.parametrize(
    "header", ["qw,qx,qy,qz", "q_w,q_x,q_y,q_z", "quat_w,quat_x,quat_y,quat_z"]
)
def test_quaternions_become_matrices_and_are_normalised(tmp_path: Path, header: str) -> None:
    rotations = Rotation.from_matrix(matrices(ANGLES).reshape(-1, 3, 3))
    q = np.roll(rotations.as_quat(), 1, axis=1) * 1.004
    run = run_of(tmp_path, rotation_text(header, q), [ATTITUDE])
    np.testing.assert_allclose(run.signals["attitude"], matrices(ANGLES), atol=1e-12)


def test_nine_columns_are_a_matrix_row_by_row(tmp_path: Path) -> None:
    text = rotation_text(",".join(f"attitude{i}" for i in range(9)), matrices(ANGLES))
    run = run_of(tmp_path, text, [ATTITUDE])
    np.testing.assert_allclose(run.signals["attitude"], matrices(ANGLES))


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("qw,qx,qy,qz\n1,0,0,0\n1,1,0,0\n", {}, "qw qx qy qz row 1: a norm of 1.414"),
        ("roll,pitch,yaw\n0,0,0\n0,90,0\n", {}, "column pitch row 1 holds 90 without a unit"),
        ("roll,pich,yaw\n0,0,0\n0,1,0\n", {}, "try --columns attitude=roll,pich,yaw"),
        ("a,b\n0,0\n1,1\n", {}, "no columns roll pitch yaw or qw qx qy qz for signal attitude"),
        ("a,b\n0,0\n1,1\n", {"columns": {"attitude": "a,b"}}, "needs 3 (roll, pitch, yaw), 4"),
    ],
)
def test_what_is_no_rotation_is_refused(
    tmp_path: Path, text: str, options: dict[str, Any], words: str
) -> None:
    assert words in refusal(DataError, tmp_path, text, [ATTITUDE], **options)


def test_angles_in_a_unit_that_is_no_angle_are_refused(tmp_path: Path) -> None:
    text = "roll [g],pitch [g],yaw [g]\n0,0,0\n0,1,0\n"
    assert "column roll is in g" in refusal(UnitError, tmp_path, text, [ATTITUDE])


# --- clipping ----------------------------------------------------------------------------------


def circling(n: int = 4000, size: float = 25.0, noise: float = 0.05) -> np.ndarray:
    """A sensor on a wheel: three axes, in motion all the time."""
    rng = np.random.default_rng(3)
    phase = np.linspace(0, 40 * np.pi, n)
    clean = size * np.stack([np.cos(phase), np.sin(phase), 0.1 * np.cos(phase / 3)], axis=1)
    return clean + noise * rng.normal(size=(n, 3))


def clipping_notes(folder: Path, values: np.ndarray) -> list[str]:
    np.savetxt(folder / "imu.csv", values, delimiter=",", header="vx,vy,vz", fmt="%.10g")
    (run,) = load_runs([folder / "imu.csv"], [ANY])
    return [note for note in run.notes if "clipped" in note]


def test_readings_clipped_on_one_side_are_counted(tmp_path: Path) -> None:
    values = circling()
    values[:, 0] = np.minimum(values[:, 0], 19.6)
    count = np.count_nonzero(values[:, 0] == 19.6)
    assert clipping_notes(tmp_path, values) == [
        f"vx: {count} readings at the largest value 19.6 — clipped at full scale?"
    ]


@pytest.mark.parametrize("resolution", [0.0, 0.01, 0.1])
def test_symmetric_clipping_is_seen_on_both_sides(tmp_path: Path, resolution: float) -> None:
    values = np.clip(circling(), -19.6, 19.6)
    if resolution:
        values = np.round(values / resolution) * resolution
    found = clipping_notes(tmp_path, values)
    assert [note[:2] for note in found] == ["vx", "vx", "vy", "vy"]


@pytest.mark.parametrize("resolution", [0.0, 1e-3, 0.05, 0.5])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.5])
def test_a_sensor_within_its_range_is_not_called_clipped(
    tmp_path: Path, resolution: float, noise: float
) -> None:
    values = circling(noise=noise)
    if resolution:
        values = np.round(values / resolution) * resolution
    assert clipping_notes(tmp_path, values) == []


@pytest.mark.parametrize("resolution", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
def test_coarse_readings_at_rest_are_not_called_clipped(
    tmp_path: Path, resolution: float, noise: float
) -> None:
    rng = np.random.default_rng(5)
    down = np.concatenate([np.eye(3), -np.eye(3)]) * 9.81
    poses = np.repeat(down, 300, axis=0) + noise * rng.normal(size=(1800, 3))
    assert clipping_notes(tmp_path, np.round(poses / resolution) * resolution) == []


# --- measured files ----------------------------------------------------------------------------


def test_the_cold_test_is_bursts_in_seconds_with_a_temperature(shared_data: Path) -> None:
    (run,) = load_runs(
        [shared_data / "psim-thermal" / "TVCtest3_7_20.csv"],
        [T, Signal("omega", 3, "rad/s")],
        columns={"omega": "gyrox,gyroy,gyroz"},
        scales={"temp": "int16/256+25"},
        units={"temp": "degC"},
    )
    assert run.block.max() + 1 == 25
    temperature = np.asarray(run.columns["temp"], dtype=float)
    assert temperature.max() == pytest.approx(23.9, abs=0.1)
    assert temperature.min() == pytest.approx(15.6, abs=0.1)
    assert run.column_units["mag1x"] == "T"
    assert run.time is not None
    assert run.time[-1] == pytest.approx(2 * 3600, rel=0.05)


def test_measured_gyro_readings_are_no_accelerations(shared_data: Path) -> None:
    with pytest.raises(UnitError, match="column gyrox is in rad/s and signal v wants m/s\\^2"):
        load_runs(
            [shared_data / "psim-thermal" / "TVCtest3_7_20.csv"],
            [V],
            columns={"v": "gyrox,gyroy,gyroz"},
        )


@pytest.mark.parametrize(
    ("name", "columns"),
    [
        ("ckexplorer/acc_log.csv", "0,1,2"),
        ("ckexplorer/acc_mag_log.csv", "0,1,2"),
        ("ckexplorer/acc_mag_log.csv", "3,4,5"),
        ("mpu9150-mikoff/imu0.log", "0,1,2"),
        ("mpu9150-mikoff/imu1.log", "3,4,5"),
        ("mpu6050-tomisuarez/example_data_calibration.csv", "0,1,2"),
        ("mpu6050-tomisuarez/example_data_tinit_calc.csv", "3,4,5"),
        ("mpu6050-tomisuarez/imu_static_test.csv", "3,4,5"),
        ("qmc5883l-tomisuarez/noisy_raw_data.csv", "0,1,2"),
        ("psim-thermal/TVCtest3_7_20.csv", "4,5,6"),
        ("imucal/example_ferraris_session.csv", "acc_x,acc_y,acc_z"),
        ("imucal/annotated_session.csv", "gyr_x,gyr_y,gyr_z"),
    ],
)
def test_measured_records_within_their_range_raise_no_clipping_note(
    shared_data: Path, name: str, columns: str
) -> None:
    (run,) = load_runs([shared_data / name], [ANY], columns={"v": columns})
    assert not [note for note in run.notes if "clipped" in note]


def test_the_unit_1_stands_behind_a_space_and_an_index_does_not(tmp_path: Path) -> None:
    """As SI writes the unit of a number; `casest simulate` heads such a column so."""
    count = Signal("counted", 1, "1")
    run = run_of(tmp_path, "counted [1],v[1]\n1,2\n2,5\n", [count])
    assert run.signals["counted"][:, 0].tolist() == [1.0, 2.0]
    assert "v[1]" in run.columns


def test_a_few_readings_far_off_all_others_are_named(tmp_path: Path) -> None:
    """Also of an input, of which no residual tells; what moves now and then is none of these."""
    values = circling()
    values[[7, 90], 1] = -8388608, 65535
    np.savetxt(tmp_path / "imu.csv", values, delimiter=",", header="vx,vy,vz", fmt="%.10g")
    (run,) = load_runs([tmp_path / "imu.csv"], [ANY])
    (note,) = [note for note in run.notes if "faults?" in note]
    assert note.startswith(f"vy: 2 of {len(values)} readings, like -8.38861e+06 (row 7, 90), are ")
    still = 0.01 * np.random.default_rng(3).standard_normal(values.shape)
    still[40:140] += 5.0  # 2.5 % of the rows
    np.savetxt(tmp_path / "imu.csv", still, delimiter=",", header="vx,vy,vz", fmt="%.10g")
    (run,) = load_runs([tmp_path / "imu.csv"], [ANY])
    assert not [note for note in run.notes if "faults?" in note]


def told_of_faults(tmp_path: Path, reference: Any, reading: Any) -> list[str]:
    """Which of a reading and its reference are said to have readings far off."""
    both = np.column_stack([reference, reading])
    np.savetxt(tmp_path / "motor.csv", both, delimiter=",", header="reference,reading", comments="")
    signals = [Signal(name, 1, None) for name in ("reference", "reading")]
    (run,) = load_runs([tmp_path / "motor.csv"], signals)
    return [note.partition(":")[0] for note in run.notes if "faults?" in note]


def test_a_reading_that_goes_where_its_input_goes_is_no_fault(tmp_path: Path) -> None:
    """A motor that stands, and is run for a few rows: nearly always nothing, then 1500 rpm."""
    command, rng = np.zeros(2000), np.random.default_rng(6)
    command[700:712] = -1500.0
    motor = command + 6 * rng.standard_normal(2000)
    assert told_of_faults(tmp_path, command, motor) == []
    motor[40] = 32767.0
    assert told_of_faults(tmp_path, command, motor) == ["reading"]


def test_a_row_that_is_lost_in_all_columns_is_still_a_fault(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    reference = rng.uniform(0, 10, 2000)
    reading = 2 * reference + 0.1 * rng.standard_normal(2000)
    reference[40] = reading[40] = -9999.0
    assert told_of_faults(tmp_path, reference, reading) == ["reference", "reading"]
