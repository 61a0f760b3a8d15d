"""An estimate at Python's prompt says, saves and corrects what the command line does."""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pandas as pd
import polars as pl
import pytest
import simulators as sim
import xarray as xr

import casest
from casest import calibrate, close, load
from casest.cli import run
from casest.demo import RECORD as HANDHELD
from casest_problems.norm import norm_diagonal, norm_full, norm_triangular

RECORD = pd.read_csv(HANDHELD, comment="#")
MODEL = norm_triangular.having(norm="9.80665 m/s^2")
READ = {"columns": {"v": ["ax", "ay", "az"]}, "rate": 50}
WORDS = ["--columns", "v=ax,ay,az", "--rate", "50"]


@pytest.fixture(scope="module")
def estimate():
    return calibrate(MODEL, HANDHELD, **READ, at_rest=True)


@pytest.fixture(scope="module")
def typed(tmp_path_factory):
    """The folder of the same calibration by the command line, and what that has printed."""
    folder = tmp_path_factory.mktemp("typed")
    fit = [*WORDS, "--at-rest", "--set", "norm=9.80665 m/s^2", "-o", str(folder)]
    assert run(["calibrate", "norm-triangular", str(HANDHELD), *fit]) == 0
    return folder


@pytest.fixture(scope="module")
def loop():
    """A loop over poses of a sensor whose offset has been drifting."""
    rng = np.random.default_rng(2)
    sensor, t = sim.accelerometer(rng, skew=False), np.linspace(0, 60, 150)
    v = sensor.read(sim.sphere(150, rng), 5e-3, rng) + 0.2 * t[:, None] / 60
    columns = {"v": v, "t": t}
    return close(norm_diagonal.having(norm=sim.GRAVITY), columns, units={"v": "m/s^2", "t": "s"})


def test_print_shows_what_the_command_line_prints(estimate, capsys):
    fit = [*WORDS, "--at-rest", "--set", "norm=9.80665 m/s^2"]
    assert run(["calibrate", "norm-triangular", str(HANDHELD), *fit]) == 0
    printed = capsys.readouterr().out.partition("\n\nNext:")[0]
    assert str(estimate) == printed
    assert repr(estimate) == printed


def test_save_writes_the_result_that_the_command_line_writes(estimate, typed, tmp_path):
    folder = estimate.save(tmp_path / "fit")
    own, other = (json.loads((f / "result.json").read_text()) for f in (folder, typed))
    for content in (own, other):
        for name in ("solver", "reproduce", "data"):
            del content[name]
    assert own == other
    rows = [(f / "residuals.csv").read_text() for f in (folder, typed)]
    assert rows[0] == rows[1]
    assert "<h1" in (folder / "report.html").read_text()


def test_a_saved_result_says_the_same_again(estimate, typed):
    saved = load(typed)
    for name, value in estimate.values.items():
        assert saved.values[name] == pytest.approx(value, rel=1e-12)
        assert saved.std[name] == pytest.approx(estimate.std[name], rel=1e-9)
    assert str(saved).partition("\n\n")[2] in str(estimate)
    assert "saved in" in str(saved)
    assert saved.trusted
    assert saved.table("dict")["low95"] == pytest.approx(estimate.table("dict")["low95"])


def test_a_call_corrects_as_apply_does(estimate, typed):
    assert run(["apply", str(typed), str(HANDHELD), *WORDS, "-o", str(typed / "c.csv")]) == 0
    with (typed / "c.csv").open() as file:
        rows = list(csv.DictReader(file))
    names = [n for n in rows[0] if n.startswith("corrected")]
    expected = np.array([[float(row[n]) for n in names] for row in rows])
    with pytest.warns(UserWarning, match=r"53 of 3570 rows lie outside .* extrapolates"):
        found = estimate(RECORD)
    assert found.to_numpy() == pytest.approx(expected, rel=1e-8)
    with pytest.warns(UserWarning, match="extrapolates"):
        assert load(typed)(RECORD, **READ).equals(found)


def poses(n=4):
    return RECORD.iloc[300 : 300 + n]


def test_what_is_given_comes_back_corrected(estimate):
    v = poses().iloc[:, :3].to_numpy()
    expected = estimate(v)
    assert expected.shape == (4, 3)
    assert estimate(v[0]) == pytest.approx(expected[0])
    assert estimate(v.tolist()) == pytest.approx(expected)
    columns = {"v": "v"}
    assert estimate({"v": v}, columns=columns)["corrected"] == pytest.approx(expected)
    frame = estimate(poses())
    assert list(frame.columns) == ["corrected_x", "corrected_y", "corrected_z"]
    assert list(frame.index) == [300, 301, 302, 303]
    assert isinstance(estimate(pl.from_pandas(poses())), pl.DataFrame)
    labelled = xr.DataArray(v, dims=("time", "axis"), name="v")
    assert estimate(labelled, columns=columns)["corrected"].dims == ("time", "axis")


def test_a_reading_that_is_missing_stays_missing_in_its_place(estimate):
    v = poses().iloc[:, :3].to_numpy().copy()
    v[1, 2] = np.nan
    gap = poses().copy()
    gap.iloc[1, 2] = np.nan
    for found in (estimate(v), estimate(gap).to_numpy()):
        assert np.isnan(found).all(axis=1).tolist() == [False, True, False, False]


def test_readings_in_another_unit_are_converted(estimate):
    v = poses().iloc[:, :3].to_numpy()
    g = pd.DataFrame(v / 9.80665, columns=["ax", "ay", "az"])
    assert estimate(g, units={"v": "g"}).to_numpy() == pytest.approx(estimate(v), rel=1e-9)


def test_tables_hold_every_number_with_its_unit(estimate):
    table = estimate.table()
    assert isinstance(table, pd.DataFrame)
    row = table.set_index("parameter").loc["offset[2]"]
    assert row["value"] == pytest.approx(estimate.values["offset"][2])
    assert row["low95"] < row["value"] < row["high95"]
    assert row["unit"] == "m/s^2"
    assert isinstance(estimate.table("polars"), pl.DataFrame)
    assert isinstance(estimate.table("dict"), dict)
    with pytest.raises(casest.UsageError, match="there are 'pandas', 'polars', 'arrow' and 'dict'"):
        estimate.table("excel")


def test_residuals_are_those_of_the_file(estimate, typed):
    own = estimate.residuals()
    written = pd.read_csv(typed / "residuals.csv")
    assert own["residual"].to_numpy() == pytest.approx(written["before"].to_numpy(), abs=1e-12)
    assert own["t"].to_numpy() == pytest.approx(written["t"].to_numpy())


def test_a_notebook_shows_verdict_and_values(estimate):
    html = estimate._repr_html_()
    assert "rank 9: trusted</b>" in html
    shown = re.findall(r"<code>([^<]*)</code>", html)
    assert list(estimate.table("dict")["parameter"]) == shown[:9]
    assert "<script" not in html


def test_a_report_goes_where_it_is_asked_for(estimate, tmp_path):
    assert estimate.report(tmp_path / "x.html") == tmp_path / "x.html"
    assert estimate.report(tmp_path / "new") == tmp_path / "new" / "report.html"
    assert (tmp_path / "x.html").read_text() == (tmp_path / "new" / "report.html").read_text()


def test_a_loop_prints_saves_and_corrects(loop, tmp_path):
    head = str(loop).partition("\n\n")[0].replace("\n", " ")
    assert head.startswith("norm-diagonal on dict: extended: bias_drift was missing")
    saved = load(loop.save(tmp_path))
    assert (saved.model, saved.verdict) == ("norm-diagonal", "extended")
    assert list(saved.values) == [p.name for p in loop.after.model.parameters]
    frame = loop.residuals()
    held = frame[["held_out_before", "held_out_after"]].std()
    assert held["held_out_after"] < held["held_out_before"] / 2
    assert str(loop.before).startswith("norm-diagonal on dict: 150 samples, 6 unknowns")


def test_what_a_correction_guesses_is_said(loop):
    later = {"v": [[5.6, 5.6, 5.7], [5.7, 5.6, 5.6]], "t": np.array([0.0, 1.0])}
    with pytest.warns(UserWarning, match="happened in the record of the fit"):
        loop(later)


def test_a_refused_estimate_prints_its_reason_and_corrects_nothing():
    frame = poses(1)
    rng = np.random.default_rng(5)
    v = sim.accelerometer(rng).read(sim.spread_poses(30, rng), 1e-3, rng)
    with pytest.raises(casest.NotTrusted) as error:
        calibrate(norm_full.having(norm=sim.GRAVITY), v, columns={"v": "0,1,2"})
    refused = error.value.estimate
    assert "NOT TRUSTED" in str(refused).partition("\n\n")[0]
    assert not refused.trusted
    with pytest.raises(casest.UsageError, match="this estimate was refused"):
        refused(frame)


@pytest.mark.parametrize(
    ("readings", "words"),
    [
        (np.ones((4, 2)), r"the readings have shape \(4, 2\); of v they are \(N, 3\)"),
        (None, "the readings are of type NoneType: give an array, a data frame"),
        (pd.DataFrame({"bx": [1.0]}), "DataFrame: no column ax for signal v"),
    ],
)
def test_readings_that_do_not_fit_are_refused_with_the_way_out(estimate, readings, words):
    with pytest.raises(casest.CasestError, match=words):
        estimate(readings)


def test_plots_hold_the_numbers_that_they_are_of(estimate):
    (axis,) = estimate.plot().axes
    drawn = axis.lines[0].get_ydata()
    assert drawn == pytest.approx(estimate.residuals("dict")["residual"])
    assert axis.get_xlabel() == "t [s]"
    names = [a.get_yticklabels()[0].get_text() for a in estimate.plot("parameters").axes]
    assert names[-1] == "offset[2] [m/s^2]"
    shown = estimate.plot("correlation").axes[0].images[0].get_array()
    std = np.sqrt(np.diag(estimate.covariance))
    assert np.asarray(shown) == pytest.approx(estimate.covariance / np.outer(std, std))


def test_the_sphere_shows_every_pose_where_its_corrected_reading_points(estimate):
    """Lambert's projection keeps areas: its radius squared is 1 − |z|."""
    run = estimate.problem.runs[0]
    corrected = estimate(run.signals["v"])
    corrected /= np.linalg.norm(corrected, axis=1)[:, None]
    above, below = (
        np.asarray(axis.collections[0].get_offsets()) for axis in estimate.plot("sphere").axes[:2]
    )
    assert len(above) + len(below) == 24
    raw = run.signals["v"] / np.linalg.norm(run.signals["v"], axis=1)[:, None]
    x, y = np.hstack([axis.lines[1].get_data() for axis in estimate.plot("sphere").axes[:2]])
    order = np.argsort(raw[:, 2] < 0, kind="stable")
    assert x * np.sqrt(1 + np.abs(raw[order, 2])) == pytest.approx(raw[order, 0], abs=1e-9)
    assert y * np.sqrt(1 + np.abs(raw[order, 2])) == pytest.approx(raw[order, 1], abs=1e-9)
    for shown, z in ((above, corrected[:, 2] >= 0), (below, corrected[:, 2] < 0)):
        assert (shown**2).sum(axis=1) == pytest.approx(1 - np.abs(corrected[z, 2]), abs=1e-9)
        assert np.arctan2(*shown.T[::-1]) == pytest.approx(
            np.arctan2(corrected[z, 1], corrected[z, 0]), abs=1e-9
        )


def test_profiles_are_drawn_for_every_unknown(estimate):
    axes = estimate.plot("profiles").axes
    assert [a.get_xlabel() for a in axes[:9]][-1] == "offset[2] [m/s^2]"
    values, rise = axes[8].lines[0].get_data()
    assert rise[len(rise) // 2] == pytest.approx(0, abs=1e-9)
    assert rise[[0, -1]] == pytest.approx(9, rel=0.1)  # nearly linear there
    half = (values[-1] - values[0]) / 6
    assert half == pytest.approx(estimate.plain["offset"][2], rel=1e-6)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("histogram",), "there are 'residuals', 'parameters', 'correlation'"),
        (("residuals", "warmth"), r"the residual is known over corrected\[0\]"),
        (("correlation", "t"), "is for plot\\('residuals'\\)"),
    ],
)
def test_a_plot_that_there_is_not_says_which_there_are(estimate, words, said):
    with pytest.raises(casest.UsageError, match=said):
        estimate.plot(*words)


def test_what_is_no_result_is_not_loaded(tmp_path):
    with pytest.raises(casest.DataError, match="no such result"):
        load(tmp_path / "nothing")
