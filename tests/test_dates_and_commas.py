"""Dates, times of day and decimal commas: read as they are meant, never guessed in silence."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from casest.data import Run, Table, load_runs, read_table
from casest.declaration.symbols import Signal
from casest.errors import DataError

KRAFT = Signal("kraft", 1, None)
T = Signal("t", 1, "s")


def table_of(folder: Path, text: str) -> Table:
    (folder / "data.csv").write_text(text, encoding="utf-8")
    return read_table(folder / "data.csv")


def run_of(folder: Path, text: str, signals=(T, KRAFT), **options) -> Run:
    (folder / "data.csv").write_text(text, encoding="utf-8")
    (run,) = load_runs([folder / "data.csv"], signals, **options)
    return run


def error_of(folder: Path, text: str, signals=(T, KRAFT), **options) -> str:
    with pytest.raises(DataError) as caught:
        run_of(folder, text, signals, **options)
    assert "\n" not in str(caught.value)
    assert "data.csv" in str(caught.value)
    return str(caught.value)


def values(table: Table, *names: str) -> list[list[float]]:
    return [table.columns[name].values.tolist() for name in names]


GERMAN = "12.03.2026;10:00:00;0,0;0,01232;ok\n12.03.2026;10:00:01;-0,5;1,5e-3;ok\n"
HEADER = "Datum;Zeit;Kraft;Weg;Status\n"


@pytest.mark.parametrize("header", ["", HEADER])
def test_german_dates_decimal_commas_and_a_column_of_text_are_read(tmp_path, header):
    table = table_of(tmp_path, header + GERMAN)
    names = HEADER.strip().split(";") if header else list("01234")
    assert list(table.columns) == names
    assert values(table, *names[2:4]) == [[0.0, -0.5], [0.01232, 0.0015]]
    assert table.columns[names[4]].values.tolist() == ["ok", "ok"]


def test_more_columns_of_text_than_of_numbers_leave_the_delimiter_as_it_is(tmp_path):
    table = table_of(tmp_path, "1,5;ok;ok;gut;ok\n1,75;ok;nein;gut;ok\n")
    assert values(table, "0") == [[1.5, 1.75]]
    assert table.columns["2"].values.tolist() == ["ok", "nein"]


@pytest.mark.parametrize("sign", [",", ";", "\t"])
def test_quoted_numbers_may_have_decimal_commas(tmp_path, sign):
    rows = "\n".join(
        sign.join(f'"{cell}"' for cell in row) for row in [("1,5", "2,7"), ("-1", "0,25")]
    )
    assert values(table_of(tmp_path, f"a{sign}b\n{rows}\n"), "a", "b") == [[1.5, -1], [2.7, 0.25]]


# -- thousands -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ("kraft;b\n1.234,5;1\n2.345,5;2\n", "1.234,5"),
        ("kraft,b\n'1,234.5';1\n".replace("'", '"').replace(";", ",") + '"1,334.5",2\n', "1,234.5"),
        ("kraft;b\n1.234;0,5\n2.345;0,7\n", "1.234"),  # beside decimal commas
        ("kraft;b\n1,234;0.5\n2,345;0.7\n", "1,234"),  # beside decimal points
        ('kraft,b\n"1,234","1,500"\n"2,345","2,500"\n', "1,234"),
        ("kraft;b\n1'234;1\n2'345;2\n", "1'234"),
        ("kraft;b\n1 234,5;1\n2 345,5;2\n", "1 234,5"),
    ],
)
def test_what_may_be_thousands_is_no_number_for_a_signal(tmp_path, text, cell):
    said = error_of(tmp_path, text, [KRAFT])
    assert f"column kraft row 0 holds '{cell}'" in said
    assert "thousands and decimals cannot be told apart: export without separators" in said


def test_points_that_separate_no_thousands_stay_decimal_beside_commas(tmp_path):
    table = table_of(tmp_path, "a;b\n1.25;0,5\n1.234;0,7\n")
    assert values(table, "a", "b") == [[1.25, 1.234], [0.5, 0.7]]


def test_three_decimals_behind_each_comma_are_decimals_and_it_is_said(tmp_path):
    table = table_of(tmp_path, "a;b\n1,234;2,345\n1,235;2,346\n")
    assert values(table, "a") == [[1.234, 1.235]]
    assert any(
        n.startswith("commas are read as decimal points, 1,234 as 1.234") for n in table.notes
    )
    assert table_of(tmp_path, "a;b\n1,234;2,345\n1,235;0,346\n").notes == ()


# -- the time of a record ------------------------------------------------------------------------

MOMENTS = [datetime(2026, 3, 12, 23, 59, 59, 250_000), datetime(2026, 3, 13, 0, 0, 1, 500_000)]
ELAPSED = [0.0, (MOMENTS[1] - MOMENTS[0]).total_seconds()]


@pytest.mark.parametrize(
    ("form", "cut"),
    [
        ("%Y-%m-%d %H:%M:%S.%f", 0),
        ("%Y-%m-%dT%H:%M:%S.%fZ", 0),
        ("%Y/%m/%d %H:%M:%S.%f", 0),
        ("%d.%m.%Y %H:%M:%S.%f", 3),
        ("%d.%m.%y %H:%M:%S,%f", 3),
        ("%d/%m/%Y %H:%M:%S.%f", 0),
        ("%m/%d/%Y %I:%M:%S.%f %p", 0),
        ("%d.%m.%Y;%H:%M:%S,%f", 3),
        ("%Y-%m-%d;%H:%M:%S.%f", 0),
        ("%d-%m-%Y;%H:%M:%S.%f", 0),
    ],
)
def test_a_moment_in_any_common_form_is_the_time(tmp_path, form, cut):
    """Across midnight, so that the date counts; strftime writes it."""
    rows = [moment.strftime(form)[: -cut or None] for moment in MOMENTS]
    run = run_of(tmp_path, "".join(f"{row};{k},5\n" for k, row in enumerate(rows)),
                 columns={"kraft": "2" if ";" in form else "1"})  # fmt: skip
    np.testing.assert_allclose(run.signals["t"][:, 0], ELAPSED, atol=1e-9)
    assert any(note.startswith("time from ") for note in run.notes)


@pytest.mark.parametrize("name", ["Zeit", "time", "Uhrzeit"])
def test_a_date_and_a_time_of_day_are_the_time_together(tmp_path, name):
    rows = "12.03.2026;23:59:59,25;0,5;ok\n13.03.2026;00:00:01,5;0,75;ok\n"
    run = run_of(tmp_path, f"Datum;{name};Kraft;Status\n{rows}")
    np.testing.assert_allclose(run.signals["t"][:, 0], [0, 2.25])
    assert f"time from Datum and {name}" in run.notes
    assert list(run.columns) == ["Status"]


def test_the_date_and_the_time_of_day_may_be_named(tmp_path):
    text = "start;ende;tag;kraft\n23:00:00;23:59:59;12.03.2026;1\n01:00:00;01:00:01;13.03.2026;2\n"
    run = run_of(tmp_path, text, columns={"t": "tag,ende"})
    np.testing.assert_allclose(run.time, [0, 3602])
    silent = run_of(tmp_path, text, [KRAFT])
    assert silent.time is None
    assert list(silent.columns) == ["start", "ende", "tag"]
    assert any("start and ende hold times, kept as text" in note for note in silent.notes)


def test_a_day_that_may_be_a_month_is_not_guessed(tmp_path):
    two_days = "date;clock;kraft\n03/04/2026;10:00:00;1\n04/04/2026;09:00:00;2\n"
    said = error_of(tmp_path, two_days)
    assert "column date row 0 holds '03/04/2026', where day and month cannot be told apart" in said
    assert "write dates as 2026-03-12 or 12.03.2026" in said
    silent = run_of(tmp_path, two_days, [KRAFT])
    assert silent.time is None
    assert silent.columns["date"].tolist() == ["03/04/2026", "04/04/2026"]
    assert any("day and month cannot be told apart" in note for note in silent.notes)
    one_day = "date;clock;kraft\n03/04/2026;10:00:00;1\n03/04/2026;10:00:02;2\n"
    np.testing.assert_array_equal(run_of(tmp_path, one_day).time, [0, 2])


def test_a_time_of_day_that_repeats_stays_a_label_where_no_time_is_needed(tmp_path):
    text = "clock;kraft\n10:00:00;1\n10:00:00;2\n10:00:01;4\n"
    run = run_of(tmp_path, text, [KRAFT])
    assert run.time is None
    assert run.columns["clock"].tolist() == ["10:00:00", "10:00:00", "10:00:01"]
    assert "repeats" in error_of(tmp_path, text)


@pytest.mark.parametrize("cell", ["30.02.2026", "2026-13-01", "25:00:00", "10:61:00", "9999-01-01"])
def test_what_is_no_day_or_time_is_text_and_refused_as_the_time(tmp_path, cell):
    text = f"when;kraft\n{cell};1\n{cell};2\n"
    assert run_of(tmp_path, text, [KRAFT]).columns["when"].tolist() == [cell, cell]
    said = error_of(tmp_path, text, columns={"t": "when"})
    assert f"column when row 0 holds '{cell}', which is no time" in said


def test_a_pair_that_is_no_date_and_time_of_day_is_refused(tmp_path):
    text = "a;b;kraft\n10:00:00;11:00:00;1\n10:00:01;11:00:01;2\n"
    assert "are not a date and a time of day" in error_of(tmp_path, text, columns={"t": "a,b"})
    assert "must name one column" in error_of(tmp_path, text, columns={"t": "a,kraft"})


def test_an_unbalanced_quotation_mark_with_half_a_file_behind_it_is_named(tmp_path):
    text = 'a,b\n1,2\n"' + "x" * 200_000 + ",3\n1,2\n"
    assert "a quoted cell cannot be read" in error_of(tmp_path, text, [KRAFT])
