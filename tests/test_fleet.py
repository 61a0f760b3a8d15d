"""`casest fleet`: data sets in, data sets out; nobody disturbs another's numbers."""

from __future__ import annotations

import json

import fleets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from casest import calibrate_many, model, param, signal
from casest.cli import run
from casest.dataset import names as naming
from casest.dataset import partitions
from casest.declaration.physics import Residual
from casest.estimate.reasons import Code
from casest.results.find import find_model
from casest.results.fleet import AGAINST

NORM = find_model("norm-triangular").having(norm=fleets.GRAVITY)


def fleet(dataset, out, *words):
    return run([*fleets.WORDS, str(dataset), "-o", str(out), *fleets.NORM, *words])


def numbers(table, *columns):
    columns = columns or [f"offset[{k}]" for k in range(3)]
    return np.column_stack([table[c].to_numpy() for c in columns])


# -- the same numbers as in memory, in whatever form they come -------------------------------------


def test_results_are_those_of_calibrate_many_bit_for_bit(tmp_path):
    v = fleets.dataset(tmp_path / "in")
    assert fleet(tmp_path / "in", tmp_path / "out", "--covariance") == 0
    found, direct = fleets.results(tmp_path / "out"), calibrate_many(NORM, {"v": v})
    assert found["sensor"].to_pylist() == fleets.names(80)
    assert np.array_equal(numbers(found), direct.values["offset"])
    assert np.array_equal(found["scale[2,1]_std"].to_numpy(), direct.std["scale"][:, 2, 1])
    assert np.array_equal(found["rms"].to_numpy(), direct.rmse)
    lower = np.tril_indices(9)
    written = np.array(found["covariance"].to_pylist())
    assert np.array_equal(written, direct.covariance[:, lower[0], lower[1]])
    assert found["trusted"].to_pylist() == [True] * 80
    assert pa.types.is_dictionary(found.schema.field("reason").type)
    assert found.schema.field("offset[0]").metadata == {b"unit": b"m/s^2"}


@pytest.mark.parametrize("form", [fleets.vectors, fleets.long])
@pytest.mark.parametrize("rows", [7, 1000])
def test_every_form_of_a_data_set_gives_the_same_bits(tmp_path, form, rows, monkeypatch):
    fleets.dataset(tmp_path / "wide")
    fleets.dataset(tmp_path / "other", form=form, row_group_size=rows)
    monkeypatch.setattr("casest.dataset.readings.HELD", 600)
    monkeypatch.setattr(partitions, "NUMBERS", 1500)
    for name in ("wide", "other"):
        assert fleet(tmp_path / name, tmp_path / f"{name}-out", "--processes", "1") == 0
    one, other = (fleets.results(tmp_path / f"{name}-out") for name in ("wide", "other"))
    assert one["sensor"].to_pylist() == other["sensor"].cast(pa.string()).to_pylist()
    for column in one.column_names[1:]:
        assert one[column].to_pylist() == other[column].to_pylist()


def test_a_folder_may_name_the_sensor(tmp_path):
    v = fleets.readings(3)
    for k, own in enumerate(v):
        for half, part in enumerate(np.split(own, 2)):  # two files of one sensor
            folder = tmp_path / "in" / f"unit=A {k}"
            folder.mkdir(parents=True, exist_ok=True)
            columns = {f"v{axis}": part[:, i] for i, axis in enumerate("xyz")}
            pq.write_table(pa.table(columns), folder / f"{half}.parquet")
    assert fleet(tmp_path / "in", tmp_path / "out", "--sensor", "unit") == 0
    found = fleets.results(tmp_path / "out")
    assert found["sensor"].to_pylist() == ["A 0", "A 1", "A 2"]
    assert np.array_equal(numbers(found), calibrate_many(NORM, {"v": v}).values["offset"])


def test_units_columns_and_patterns_are_as_everywhere(tmp_path):
    v = fleets.dataset(tmp_path / "in")
    columns = {axis: list(v[:, :, k] * 1000) for k, axis in enumerate(("east", "north", "up"))}
    pq.write_table(pa.table({"id": np.arange(80), **columns}), tmp_path / "in" / "other.parquet")
    words = ["--sensor", "id", "--columns", "v=east,north,up", "--unit", "v=mm/s^2"]
    assert fleet(tmp_path / "in" / "o*.parquet", tmp_path / "out", *words) == 0
    found = fleets.results(tmp_path / "out")
    assert found["sensor"].to_pylist() == [*range(80)]
    expected = calibrate_many(NORM, {"v": v}).values["offset"] * 1000
    assert np.allclose(numbers(found), expected, rtol=1e-8)
    assert found.schema.field("offset[0]").metadata == {b"unit": b"mm/s^2"}


def test_a_data_set_may_be_wherever_fsspec_reaches(tmp_path):
    import fsspec

    v = fleets.readings(5)
    sink = pa.BufferOutputStream()
    pq.write_table(fleets.wide(v, fleets.names(5)), sink)
    fsspec.filesystem("memory").pipe("/line/a/b.parquet", bytes(sink.getvalue()))
    assert fleet("memory://line", tmp_path / "out") == 0
    found = fleets.results(tmp_path / "out")
    assert np.array_equal(numbers(found), calibrate_many(NORM, {"v": v}).values["offset"])


def test_time_begins_with_each_sensor(tmp_path):
    t = np.linspace(5, 6, 20)
    rate = np.array([2.0, -3.0])
    file = tmp_path / "drift.py"
    file.write_text(
        "from casest import Residual, model, param, quantity, signal\n\n\n@model\n"
        'def drift(t=signal("s"), y=signal("V"), *, first=param("V"), slope=param("V/s")):\n'
        '    return Residual(measured=y, predicted=quantity("p", first + slope * t, "V"))\n'
    )
    noise = 0.01 * np.random.default_rng(3).standard_normal((2, 20))
    table = {
        "sensor": np.repeat(["a", "b"], 20),
        "time [ms]": np.tile(t * 1e3, 2),
        "y [V]": (7 + rate[:, None] * (t - 5) + noise).ravel(),
    }
    pq.write_table(pa.table(table), tmp_path / "in.parquet")
    assert run(["fleet", str(file), str(tmp_path / "in.parquet"), "-o", str(tmp_path / "out")]) == 0
    found = fleets.results(tmp_path / "out")
    assert np.allclose(found["first"].to_numpy(), 7, atol=0.02)
    assert np.allclose(found["slope"].to_numpy(), rate, atol=0.03)


def test_sensors_of_unequal_records_have_the_bits_that_they_have_alone(tmp_path):
    v, counts = fleets.readings(40, 3, 90), np.random.default_rng(1).integers(12, 90, 40)
    each = [
        fleets.wide(own[None, :n], [f"{k}"])
        for k, (own, n) in enumerate(zip(v, counts, strict=True))
    ]
    pq.write_table(pa.concat_tables(each), tmp_path / "all.parquet")
    assert fleet(tmp_path / "all.parquet", tmp_path / "out") == 0
    together = numbers(fleets.results(tmp_path / "out"))
    for k in (0, 7, 39):
        pq.write_table(each[k], tmp_path / "one.parquet")
        assert fleet(tmp_path / "one.parquet", tmp_path / f"out{k}") == 0
        assert np.array_equal(numbers(fleets.results(tmp_path / f"out{k}"))[0], together[k])
        alone = calibrate_many(NORM, {"v": v[k : k + 1, : counts[k]]})
        assert np.allclose(together[k], alone.values["offset"][0], rtol=1e-9)


# -- what cannot be used is named, and disturbs nobody ---------------------------------------------


def spoilt(v):
    """Rows of sensors with what can be wrong with them, and sound ones between."""
    rows = fleets.wide(v, fleets.names(len(v))).to_pylist()
    rows[1]["vx [m/s^2]"] = rows[1]["vx [m/s^2]"][:-1]
    rows[3]["vy [m/s^2]"] = None
    rows[5]["vz [m/s^2]"][7] = None
    rows[7]["sensor"] = None
    rows[9]["sensor"] = rows[20]["sensor"]
    rows[11]["vx [m/s^2]"][0] = 1e200
    for axis in "xyz":
        rows[13][f"v{axis} [m/s^2]"] = []
    return rows


def test_bad_sensors_are_named_and_the_others_have_the_same_bits(tmp_path):
    v = fleets.readings(30)
    clean, bad = tmp_path / "clean.parquet", tmp_path / "bad.parquet"
    pq.write_table(fleets.wide(v, fleets.names(30)), clean)
    pq.write_table(pa.Table.from_pylist(spoilt(v), schema=pq.read_schema(clean)), bad)
    assert fleet(clean, tmp_path / "clean") == 0
    assert fleet(bad, tmp_path / "bad") == 0
    said = {(r["row"], r["kind"]): r["reason"] for r in fleets.rejected(tmp_path / "bad")}
    assert said == {
        (1, "readings"): "its lists are of unequal length (vx [m/s^2] 23, vy [m/s^2] 24, "
        "vz [m/s^2] 24): every reading has all its numbers",
        (3, "readings"): "its lists are of unequal length (vx [m/s^2] 24, vy [m/s^2] 0, "
        "vz [m/s^2] 24): every reading has all its numbers",
        (5, "refused"): "sample 7 is not finite: measure this sensor again",
        (7, "nameless"): "row 7 does not say whose readings it holds: its sensor has no name",
        (9, "twice"): f"sensor S000020 is there twice: row 9 of {bad} and row 20 of {bad}; "
        "keep one",
        (20, "twice"): f"sensor S000020 is there twice: row 9 of {bad} and row 20 of {bad}; "
        "keep one",
        (11, "readings"): "column vx reaches 1e+200, too large to compute with for signal v; "
        "it does in row 0: take it out, or choose another column",
        (13, "readings"): "it has no readings",
    }
    good = {r["sensor"]: r for r in fleets.results(tmp_path / "clean").to_pylist()}
    found = {r["sensor"]: r for r in fleets.results(tmp_path / "bad").to_pylist()}
    trusted = {name for name, r in found.items() if r["trusted"]}
    assert trusted == set(fleets.names(30)) - {fleets.names(30)[k] for k in
                                               (1, 3, 5, 7, 9, 11, 13, 20)}  # fmt: skip
    assert all(found[name] == good[name] for name in trusted)
    assert found["S000001"]["offset[0]"] is None


def test_a_sensor_in_two_files_is_found_and_both_are_named(tmp_path):
    fleets.dataset(tmp_path / "in", files=2, each=20)
    again = fleets.wide(fleets.readings(2, 9), ["S000003", "S000999"])
    pq.write_table(again, tmp_path / "in" / "part-9.parquet")
    assert fleet(tmp_path / "in", tmp_path / "out") == 0
    named = [(r["sensor"], r["row"]) for r in fleets.rejected(tmp_path / "out")]
    assert named == [("S000003", 3), ("S000003", 0)]
    assert len(fleets.results(tmp_path / "out")) == 40


def test_names_are_found_twice_in_several_passes(monkeypatch):
    sensors = naming.plain(pa.array([f"{k}" for k in range(500)] + ["7", "x" * 300, "x" * 300]))
    monkeypatch.setattr(naming, "SORTED", 60)
    found = naming.twice(lambda: iter([(0, naming.Names(sensors, np.arange(503)))]), 503)
    assert found == {"7": [(0, 7), (0, 500)], "x" * 300: [(0, 501), (0, 502)]}


def test_the_number_of_a_name_does_not_depend_on_its_place():
    """Beside names of any length, in whichever piece, and in a part of an array."""
    rng = np.random.default_rng(0)
    words = [f"{k:x}" * int(rng.integers(0, 30)) for k in range(2 * naming.FEW + 77)]
    words[5], words[naming.FEW] = "x" * 300, "µ-7"
    sensors = naming.plain(pa.array(words))
    found = naming.numbers_of(sensors)
    assert np.array_equal(naming.numbers_of(sensors.slice(3)), found[3:])
    for k in (0, 5, 6, naming.FEW - 1, naming.FEW, naming.FEW + 1, len(words) - 1):
        assert naming.numbers_of(naming.plain(pa.array([words[k]])))[0] == found[k]
    assert len(np.unique(found)) == len(set(words))
    assert naming.numbers_of(sensors.slice(0, 0)).shape == (0,)


@pytest.mark.parametrize("left", [60, 0.5])
def test_a_truncated_file_is_named_and_the_others_have_the_same_bits(tmp_path, left):
    fleets.dataset(tmp_path / "in", files=3)
    assert fleet(tmp_path / "in", tmp_path / "whole") == 0
    broken = tmp_path / "in" / "part-1.parquet"
    size = left if left > 1 else int(broken.stat().st_size * left)
    broken.write_bytes(broken.read_bytes()[:size])
    assert fleet(tmp_path / "in", tmp_path / "out") == 0
    (only,) = fleets.rejected(tmp_path / "out")
    assert (only["file"], only["kind"]) == (str(broken), "file")
    assert "cannot be read as Parquet" in only["reason"]
    whole, found = (fleets.results(tmp_path / name) for name in ("whole", "out"))
    kept = [k for k in range(120) if not 40 <= k < 80]
    assert found.to_pylist() == whole.take(kept).to_pylist()


def test_a_page_that_is_damaged_costs_its_file_alone(tmp_path):
    fleets.dataset(tmp_path / "in", files=3, compression="zstd")
    broken = tmp_path / "in" / "part-1.parquet"
    content = bytearray(broken.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 400] = bytes(400)
    broken.write_bytes(bytes(content))
    assert fleet(tmp_path / "in", tmp_path / "out") == 0
    (only,) = fleets.rejected(tmp_path / "out")
    assert (only["file"], only["kind"]) == (str(broken), "file")
    sensors = fleets.results(tmp_path / "out")["sensor"].to_pylist()
    assert sensors == fleets.names(40) + fleets.names(40, 80)


# -- what is refused before anything is computed ---------------------------------------------------


def refused(capsys, *words):
    assert run([str(w) for w in words]) == 1
    return capsys.readouterr().err.removeprefix("casest: ").strip()


def test_a_folder_without_parquet_is_refused(tmp_path, capsys):
    said = refused(capsys, *fleets.WORDS, tmp_path, "-o", tmp_path.with_name("out"))
    assert said == (
        f"{tmp_path}: no Parquet files there (….parquet, ….pq, ….parq); name a file, a folder, or "
        "a pattern in quotes"
    )


def test_a_data_set_without_names_is_refused(tmp_path, capsys):
    table = fleets.wide(fleets.readings(3), fleets.names(3)).drop_columns(["sensor"])
    pq.write_table(table, tmp_path / "a.parquet")
    said = refused(capsys, *fleets.WORDS, tmp_path / "a.parquet", "-o", tmp_path / "out")
    assert said == (
        f"{tmp_path}/a.parquet: no column sensor says which sensor a row belongs to; it has "
        "vx [m/s^2], vy [m/s^2], vz [m/s^2]; name it with --sensor COLUMN"
    )
    assert not (tmp_path / "out").exists()


def test_files_with_different_schemas_are_refused(tmp_path, capsys):
    v = fleets.readings(3)
    pq.write_table(fleets.wide(v, fleets.names(3)), tmp_path / "a.parquet")
    pq.write_table(fleets.long(v, fleets.names(3)), tmp_path / "b.parquet")
    said = refused(capsys, *fleets.WORDS, tmp_path, "-o", tmp_path.with_name("out"))
    assert said == (
        f"{tmp_path}/b.parquet: column vx [m/s^2] is double, and in {tmp_path}/a.parquet "
        "list<double>; a data set has one schema: convert it, or calibrate these files apart"
    )


def test_a_folder_with_results_of_another_model_is_refused(tmp_path, capsys):
    fleets.dataset(tmp_path / "in", files=1)
    assert fleet(tmp_path / "in", tmp_path / "out") == 0
    before = fleets.content(tmp_path / "out")
    capsys.readouterr()
    words = ["fleet", "norm-diagonal", tmp_path / "in", "-o", tmp_path / "out", *fleets.NORM]
    said = refused(capsys, *words)
    assert said.startswith(f"-o {tmp_path}/out: holds results of the model norm-triangular ")
    assert said.endswith("they are not mixed; give another -o")
    said = refused(
        capsys, *fleets.WORDS, tmp_path / "in", "-o", tmp_path / "out", *fleets.NORM, "--noise", 1
    )
    assert "holds results of other options" in said
    assert fleets.content(tmp_path / "out") == before


def test_rows_of_a_sensor_that_do_not_stand_together_are_named(tmp_path):
    table = fleets.long(fleets.readings(4), fleets.names(4))
    order = np.r_[0:30, 60:96, 30:60]
    pq.write_table(table.take(order), tmp_path / "a.parquet")
    assert fleet(tmp_path / "a.parquet", tmp_path / "out") == 0
    found = fleets.rejected(tmp_path / "out")
    said = {(r["sensor"], r["kind"]) for r in found}
    assert said == {("S000001", "twice"), ("S000002", "twice")}
    assert all("the rows of a sensor stand together: sort them" in r["reason"] for r in found)


def test_a_folder_within_the_data_set_is_refused(tmp_path, capsys):
    fleets.dataset(tmp_path / "in", files=1, each=3)
    said = refused(capsys, *fleets.WORDS, tmp_path / "in", "-o", tmp_path / "in" / "out")
    assert said.endswith("which it would become a part of; give a folder beside it")


def test_a_model_that_many_cannot_have_is_refused_before_the_data(tmp_path, capsys):
    said = refused(capsys, "fleet", "rate-table", tmp_path / "none", "-o", tmp_path / "out")
    assert "direction or rotation" in said


# -- what is left ----------------------------------------------------------------------------------


def test_no_sensor_trusted_is_exit_code_2_and_everything_is_written(tmp_path, capsys):
    v = fleets.readings(4)
    v[:] = v[:, :1]
    pq.write_table(fleets.wide(v, fleets.names(4)), tmp_path / "a.parquet")
    assert fleet(tmp_path / "a.parquet", tmp_path / "out") == 2
    assert "no sensor is trusted" in capsys.readouterr().err
    found = json.loads((tmp_path / "out" / "fleet.json").read_text())
    assert (found["sensors"], found["trusted"], found["rejected"]) == (4, 0, {"refused": 4})
    assert len(fleets.rejected(tmp_path / "out")) == 4


def test_where_no_row_is_left_everything_is_written_all_the_same(tmp_path, capsys):
    """Rows of all sensors mixed: each is there many times, and none has a result."""
    table = fleets.long(fleets.readings(3), fleets.names(3))
    mixed = np.arange(len(table)).reshape(3, -1).T.ravel()
    pq.write_table(table.take(mixed), tmp_path / "a.parquet")
    assert fleet(tmp_path / "a.parquet", tmp_path / "out") == 2
    assert "rejected.parquet says why" in capsys.readouterr().err
    found = json.loads((tmp_path / "out" / "fleet.json").read_text())
    assert (found["sensors"], found["rejected"]) == (0, {"twice": len(table)})
    assert (tmp_path / "out" / "fleet.html").is_file()


def test_a_file_of_which_no_name_can_be_read_is_said_to_be_damaged(tmp_path, capsys):
    file = tmp_path / "a.parquet"
    pq.write_table(fleets.long(fleets.readings(40), fleets.names(40)), file)
    column = pq.ParquetFile(file).metadata.row_group(0).column(0)
    with file.open("r+b") as stream:
        stream.seek(column.dictionary_page_offset or column.data_page_offset)
        stream.write(b"\xff" * 40)
    said = refused(capsys, *fleets.WORDS, file, "-o", tmp_path / "out")
    assert "none of its 1 files can be read" in said


def test_without_a_folder_for_what_it_finds_it_says_so(tmp_path, capsys):
    pq.write_table(fleets.wide(fleets.readings(3), fleets.names(3)), tmp_path / "a.parquet")
    assert "Missing option '-o'" in refused(capsys, *fleets.WORDS, tmp_path / "a.parquet")


def test_counts_are_said_in_one_line(tmp_path, capsys):
    v = fleets.readings(30)
    clean = fleets.wide(v, fleets.names(30))
    table = pa.Table.from_pylist(spoilt(v), schema=clean.schema)
    pq.write_table(table, tmp_path / "a.parquet")
    assert fleet(tmp_path / "a.parquet", tmp_path / "out") == 0
    said = " ".join(capsys.readouterr().out.split("\n\n")[0].split())
    assert "22 of 27 sensors trusted; 1 row without a name, 4 sensors with unusable" in said


def test_fleet_json_holds_the_spread_of_each_parameter(tmp_path):
    v = fleets.dataset(tmp_path / "in", files=3)
    assert fleet(tmp_path / "in", tmp_path / "out") == 0
    found = json.loads((tmp_path / "out" / "fleet.json").read_text())
    direct = calibrate_many(NORM, {"v": v})
    offset = direct.values["offset"][:, 1]
    told = found["parameters"]["offset[1]"]
    assert told["mean"] == pytest.approx(offset.mean(), rel=1e-12)
    assert told["std"] == pytest.approx(offset.std(ddof=1), rel=1e-12)
    assert (told["least"], told["largest"]) == (offset.min(), offset.max())
    assert told["typical_std"] == pytest.approx(direct.std["offset"][:, 1].mean(), rel=1e-12)
    assert found["constants"] == {"norm": fleets.GRAVITY}


def test_misfit_is_the_chance_of_the_prediction_of_a_reading_left_out():
    """Externally studentised: each reading predicted by a fit to the others (here: refitted)."""

    @model
    def line(x=signal("1"), y=signal("1"), *, a=param("1"), b=param("1")):
        return Residual(measured=y, predicted=a + b * x)

    from scipy.stats import t as student

    rng = np.random.default_rng(5)
    x, y = rng.standard_normal((2, 40, 12))
    y[3, 5] += 20
    found = calibrate_many(line, {"x": x, "y": y}, misfit=True)
    exact = []
    for i in range(40):
        least = []
        for k in range(12):
            A, rest = np.column_stack([np.ones(12), x[i]]), np.arange(12) != k
            c, ss, *_ = np.linalg.lstsq(A[rest], y[i, rest])
            cov = np.linalg.inv(A[rest].T @ A[rest])
            off = (y[i, k] - A[k] @ c) / np.sqrt(ss[0] / 9 * (1 + A[k] @ cov @ A[k]))
            least.append(2 * 12 * student.sf(abs(off), 9))
        exact.append(min(1.0, min(least)))
    # The two largest residuals are looked at: of some a third one is larger for its leverage.
    assert (found.misfit > np.array(exact) * (1 - 1e-6)).all()
    assert np.mean(found.misfit < np.array(exact) * (1 + 1e-6)) > 0.9
    assert found.misfit[3] < 1e-3


def test_every_reason_against_a_sensor_has_words():
    assert {code.name.lower() for code in Code} <= set(AGAINST)


def test_a_sensor_with_a_knocked_pose_is_named_among_sound_ones(tmp_path, capsys):
    v = fleets.readings(200)
    pq.write_table(fleets.wide(v, fleets.names(200)), tmp_path / "sound.parquet")
    assert fleet(tmp_path / "sound.parquet", tmp_path / "sound") == 0
    assert "a reading is far off" not in capsys.readouterr().out
    v[77, 5] *= 1.03
    pq.write_table(fleets.wide(v, fleets.names(200)), tmp_path / "a.parquet")
    assert fleet(tmp_path / "a.parquet", tmp_path / "out") == 0
    assert "of one trusted sensor a reading is far off" in capsys.readouterr().out
    page = (tmp_path / "out" / "fleet.html").read_text()
    assert "S000077" in page.partition("one reading is further off")[2]


def test_the_page_shows_yield_outlying_sensors_and_drift_over_the_date(tmp_path):
    v = fleets.readings(300)
    v[:, :, 2] += np.linspace(0, 3, 300)[:, None]  # an offset that drifts over the days
    v[123, :, 0] += 40.0
    v[7, 5, 1] = np.nan
    days = np.datetime64("2026-03-01T00:00:00") + np.arange(300) * np.timedelta64(3600, "s")
    table = fleets.wide(v, fleets.names(300)).append_column("made", pa.array(days))
    order = np.random.default_rng(0).permutation(300)
    pq.write_table(table.take(order), tmp_path / "a.parquet")
    assert fleet(tmp_path / "a.parquet", tmp_path / "out", "--keep", "made") == 0
    page = (tmp_path / "out" / "fleet.html").read_text()
    assert "299 of 300 sensors trusted." in page
    assert "<td>S000123</td>" in page
    assert "made since 2026-03-01T00:00:00" in page
    data = json.loads(page.partition('id="data">')[2].partition("</script>")[0])
    drift = next(f for f in data["figures"] if f["id"] == "drift-figure")["panels"]
    third = next(p for p in drift if p["title"] == "offset[2]")
    assert third["x"]["unit"] == "d"
    means = data["arrays"][third["series"][1]["y"]]
    assert means[-1] - means[0] == pytest.approx(3 * (len(means) - 1) / len(means), abs=0.5)
