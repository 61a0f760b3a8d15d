"""`casest report`: results side by side, what differs named, what agrees left in peace."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import simulators as sim
from scipy import stats

from casest.cli import run
from casest.results.side_by_side import welch


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """One sensor on five days, whose third offset has moved on the last, and one record in g."""
    folder, rng = tmp_path_factory.mktemp("line"), np.random.default_rng(12)
    sensor = sim.accelerometer(rng, skew=False)
    for day in range(1, 6):
        v = sensor.read(sim.spread_poses(40, rng), 5e-3, rng)
        v[:, 2] += 0.1 * (day == 5)
        unit, scale = ("g", sim.GRAVITY) if day == 2 else ("m/s^2", 1.0)
        file, names = folder / f"{day}.csv", ",".join(f"v{a} [{unit}]" for a in "xyz")
        np.savetxt(file, v / scale, delimiter=",", header=names, comments="")
        words = ["--set", "norm=9.80665 m/s^2", "-o", str(folder / f"2026-05-0{day}" / "fit")]
        assert run(["calibrate", "norm-diagonal", str(file), *words]) == 0
    return folder


def days(line, *chosen):
    return [str(line / f"2026-05-0{k}" / "fit") for k in chosen]


def asked(capsys, *words):
    capsys.readouterr()
    assert run(["report", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def said(capsys, *words):
    capsys.readouterr()
    code = run(["report", *map(str, words)])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_the_test_of_agreement_is_welchs():
    """Of plain means it is the Welch ANOVA that SciPy has."""
    rng = np.random.default_rng(1)
    groups = [rng.normal(0.4 * k, 1 + k, 6 + 3 * k) for k in range(4)]
    x = np.array([g.mean() for g in groups])
    std = np.array([g.std(ddof=1) / np.sqrt(len(g)) for g in groups])
    freedom = np.array([len(g) - 1.0 for g in groups])
    expected = stats.f_oneway(*groups, equal_var=False).pvalue
    assert welch(x, std, freedom)[2] == pytest.approx(expected, rel=1e-9)


def test_what_agrees_is_said_to_agree(line, capsys):
    code, out, _ = said(capsys, *days(line, 1, 2, 3, 4))
    assert code == 0
    assert out.startswith("4 results of norm-diagonal agree in all 6 numbers that they share.")


def test_the_number_that_has_changed_is_named_and_the_result_that_is_off(line, capsys):
    found = asked(capsys, *days(line, 1, 3, 4, 5))
    by_name = {n["name"]: n for n in found["numbers"]}
    assert by_name["offset[2]"]["p_value"] < 1e-6
    assert by_name["offset[2]"]["furthest"] == "2026-05-05"
    assert by_name["offset[0]"]["p_value"] > 0.01
    assert (
        "differ in 1 of 6 numbers by more than chance:\noffset[2]."
        in said(capsys, *days(line, 1, 3, 4, 5))[1]
    )


def test_results_in_other_units_are_converted(line, capsys):
    found = asked(capsys, *days(line, 1, 2))
    offset = next(n for n in found["numbers"] if n["name"] == "offset[0]")
    assert offset["unit"] == "m/s^2"
    one, other = (v["value"] for v in offset["values"])
    assert other == pytest.approx(one, abs=6 * offset["mean_std"])


def test_dates_and_numbers_in_the_names_order_the_results(line, capsys, tmp_path):
    found = asked(capsys, *days(line, 4, 1, 3))
    assert [r["label"] for r in found["results"]] == ["2026-05-01", "2026-05-03", "2026-05-04"]
    assert [r["at"] for r in found["results"]] == [0.0, 2.0, 3.0]
    for k, name in enumerate(("25C", "-10C", "60C"), 1):
        (tmp_path / name).symlink_to(line / f"2026-05-0{k}" / "fit")
    found = asked(capsys, *(str(tmp_path / name) for name in ("25C", "-10C", "60C")))
    assert [r["at"] for r in found["results"]] == [-10.0, 25.0, 60.0]
    assert found["over"] == "# in #C"


def test_the_page_shows_what_differs_before_the_rest(line, tmp_path):
    page = tmp_path / "page.html"
    assert run(["report", *days(line, 1, 3, 4, 5), "-o", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert "<h1" in text
    titles = re.findall(r"<h2>(.*?)</h2>", text)
    assert titles == ["What differs", "All numbers", "Intervals", "The results"]
    data = json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])
    first, rest = data["figures"]
    assert [p["title"].partition(" ")[0] for p in first["panels"]] == ["offset[2]"]
    assert {p["y"]["label"] for p in first["panels"]} == {"value"}  # the title has the name
    assert len(rest["panels"]) == 5
    links = re.findall(r'<a href="([^"#]+report.html)"', text)
    assert all((tmp_path / link).is_file() for link in links)
    assert len(links) == 4


def test_one_result_is_a_page_too(line, tmp_path, capsys):
    assert run(["report", days(line, 1)[0], "-o", str(tmp_path / "new")]) == 0
    assert "One result of norm-diagonal" in (tmp_path / "new" / "report.html").read_text()
    assert capsys.readouterr().out.startswith("One result of norm-diagonal.\n")


def test_a_refused_result_is_shown_and_not_counted(line, tmp_path, capsys):
    poses = str(line / "1.csv")
    assert run(["calibrate", "norm-full", poses, "-o", str(tmp_path)]) == 2
    code, _, err = said(capsys, *days(line, 1), tmp_path)
    assert code == 1
    assert "have no number in common that two of them are sure of" in err
    code, out, _ = said(capsys, *days(line, 1, 3), tmp_path)
    assert code == 0
    assert "NOT TRUSTED" in out


def test_what_cannot_be_compared_is_said(line, tmp_path, capsys):
    code, _, err = said(capsys, days(line, 1)[0], days(line, 1)[0])
    assert (code, "given twice" in err) == (1, True)
    code, _, err = said(capsys, days(line, 1)[0], tmp_path / "no")
    assert (code, "no such result" in err) == (1, True)
