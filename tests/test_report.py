"""report.html in a real browser: what it says, that it asks nobody, that figures can be read."""

from __future__ import annotations

import json
import os
import re
import shlex
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, installed

from casest import load_runs
from casest.cli import run
from casest.demo import RECORD, WHEEL
from casest.estimate.calibrate import calibrate
from casest.report.html import figures
from casest.report.html.calibration import calibration_page
from casest.report.html.page import aligned
from casest.report.html.residuals import bins
from casest.report.html.spectra import autocorrelation, spectrum, white_band
from casest.report.html.still import BOTTOM, COLUMNS, LEFT, RIGHT, TOP, WIDTH, still
from casest.results.calibration import calibration_result
from casest.results.find import find_model

HANDHELD = (str(RECORD), "--columns", "v=ax,ay,az", "--rate", "50", "--at-rest")
NORM = ("--set", "norm=9.80665 m/s^2")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    program = installed()
    if program is None:
        message = "no Chromium or Chrome on this machine: the report is not opened"
        if os.environ.get("CI") or os.environ.get("CASEST_REQUIRE_BROWSER"):
            pytest.fail(message + "; .ci/run installs it")
        pytest.skip(message)
    opened = Browser(tmp_path_factory.mktemp("browser") / "profile", program)
    opened.look()
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    """Folder of `casest close` on 15 s of the shipped wheel, whose imbalance nobody declared."""
    folder = tmp_path_factory.mktemp("closed")
    short = "".join(WHEEL.read_text(encoding="utf-8").splitlines(keepends=True)[:1501])
    (folder / "wheel.csv").write_text(short, encoding="utf-8")
    assert run(["close", "wheel", str(folder / "wheel.csv"), "-o", str(folder / "out")]) == 0
    return folder / "out"


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated")
    assert run(["calibrate", "norm-triangular", *HANDHELD, *NORM, "-o", str(folder)]) == 0
    return folder


def text(browser, selector):
    return browser.ask(f"document.querySelector({json.dumps(selector)}).textContent")


def texts(browser, selector):
    found = f"document.querySelectorAll({json.dumps(selector)})"
    return browser.ask(f"[...{found}].map(e => e.textContent)")


def test_the_result_of_a_loop_that_grew_follows_the_published_schema(closed):
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(files("casest.results").joinpath("result.schema.json").read_text("utf-8"))
    found = json.loads((closed / "result.json").read_text(encoding="utf-8"))
    assert found["effects"]
    published = jsonschema.Draft202012Validator(schema)
    published.validate(found)
    with pytest.raises(jsonschema.ValidationError):
        published.validate(found | {"verdict": "fine"})


# -- what it says ----------------------------------------------------------------------------------


def test_the_verdict_of_a_closed_loop_is_one_sentence_on_top(browser, closed):
    browser.open(closed / "report.html")
    assert text(browser, "h1") == (
        "Extended: imbalance (or axis_wobble) was missing; what is left is noise."
    )
    top = "document.querySelector('h1').getBoundingClientRect().bottom"
    assert browser.ask(top) < 300


def test_the_verdict_of_a_calibration_says_what_was_determined(browser, calibrated):
    browser.open(calibrated / "report.html")
    assert text(browser, "h1").startswith("Trusted: 9 unknowns determined from 24 rest intervals")
    assert "nothing in the residual speaks against the model" in text(browser, "h1 + p")
    assert browser.ask("document.querySelectorAll('.doubt').length") == 0


def test_a_residual_that_is_no_noise_is_said_at_the_top(browser, tmp_path):
    """The shipped wheel is out of balance: its offset is far off, its fit is proved."""
    assert run(["calibrate", "wheel", str(WHEEL), "-o", str(tmp_path)]) == 0
    browser.open(tmp_path / "report.html")
    assert text(browser, "h1").startswith("Trusted, but the residual is not noise")
    assert "9 % of it follows angle" in text(browser, "header + .doubt")


def test_every_section_is_there_and_the_contents_lead_to_it(browser, closed):
    browser.open(closed / "report.html")
    titles = texts(browser, "section > h2")
    assert titles == [
        "Effects found", "Parameters", "The evidence", "Error before and after", "Residual",
        "What belongs together", "What stayed invisible", "How the fit was certified",
        "How to apply the result", "How to get it again",
    ]  # fmt: skip
    leads = "[...document.querySelectorAll('nav a')].map(a => !!document.querySelector(a.hash))"
    assert browser.ask(leads) == [True] * len(titles)


def test_the_page_shows_the_numbers_of_the_result(browser, closed):
    result = json.loads((closed / "result.json").read_text(encoding="utf-8"))
    browser.open(closed / "report.html")
    row = "[...document.querySelectorAll('#error tr')].map(r => r.innerText.split('\\t'))"
    cells = {r[0]: r[1:3] for r in browser.ask(row)}
    for name, key in (("fit", "rmse_fit"), ("held-out", "rmse_holdout")):
        for cell, side in zip(cells[name], ("before", "after"), strict=True):
            assert float(cell) == pytest.approx(result[side][key], rel=1e-3)
    for axis in "xyz":
        shown = float(cells[f"held-out, {axis}"][1])
        assert shown == pytest.approx(result["after"]["rmse_holdout_by_axis"][axis], rel=1e-3)
    digest = next(iter(result["reproduce"]["sha256"].values()))
    assert digest in text(browser, "#reproduce")
    shown = text(browser, "#reproduce pre")
    assert shlex.split(shown.replace("\\\n", " ")) == shlex.split(result["reproduce"]["command"])
    invisible = text(browser, "#invisible")
    assert all(i["name"] in invisible and i["shown_by"] in invisible for i in result["invisible"])


def test_how_far_a_parameter_moved_is_in_its_own_standard_deviation(browser, closed):
    result = json.loads((closed / "result.json").read_text(encoding="utf-8"))
    before, after = (result[k]["parameters"]["gain"] for k in ("before", "after"))
    moved = (after["value"][2] - before["value"][2]) / before["std"][2]
    browser.open(closed / "report.html")
    row = next(r for r in texts(browser, "#parameters tr") if r.startswith("gain[2]"))
    assert f"{moved:+.1f}" in row
    for end in after["interval95"]:
        assert f"{end[2] if isinstance(end, list) else end:.4f}" in row


def test_the_correction_is_written_out(browser, calibrated):
    browser.open(calibrated / "report.html")
    first = "corrected[0] = scale[0,0]·(v[0]-offset[0])"
    assert first in text(browser, "#apply")
    assert "m/s²" in text(browser, "#apply ol")


def test_a_refused_calibration_has_a_report_that_says_why(browser, tmp_path):
    assert run(["calibrate", "norm-full", *HANDHELD, *NORM, "-o", str(tmp_path)]) == 2
    browser.open(tmp_path / "report.html")
    assert text(browser, "h1").startswith("No trustworthy estimate: ")
    assert "Do not apply it" in text(browser, "#apply")
    assert "rotation of the sensor frame" in text(browser, "#uncertain")
    assert browser.complaints() == []


def test_observe_says_what_is_hidden(browser, tmp_path):
    assert run(["observe", "norm-full", *HANDHELD, *NORM, "-o", str(tmp_path)]) == 0
    browser.open(tmp_path / "report.html")
    assert text(browser, "h1") == "Not observable: these data determine 9 of 12 unknowns."
    assert len(texts(browser, "#hidden li")) == 3
    assert browser.complaints() == []


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """An independent flight (tests/test_dynamics.py), observed and filtered."""
    from test_dynamics import flight

    folder = tmp_path_factory.mktemp("flown")
    record, _, _ = flight(seconds=10, rate=50)
    signals = record.signals
    columns = np.column_stack([record.time, signals["a"], signals["omega"], signals["v"]])
    names = [f"{s}{axis} [{u}]" for s, u in (("a", "m/s^2"), ("omega", "rad/s"), ("v", "m/s"))
             for axis in "xyz"]  # fmt: skip
    header = ",".join(["t [s]", *names])
    np.savetxt(folder / "flight.csv", columns, delimiter=",", header=header, comments="")
    for command in ("observe", "filter"):
        given = [command, "bias-gravity", str(folder / "flight.csv"), "-o", str(folder / command)]
        assert run(given) == 0
    return folder


def test_eigenvalues_over_time_states_with_bands_and_innovations(browser, flown):
    browser.open(flown / "observe" / "report.html")
    assert text(browser, "h1") == "Observable: these data determine all 9 unknowns."
    assert browser.ask("document.querySelectorAll('#windows-std path.line').length") == 9
    browser.open(flown / "filter" / "report.html")
    assert text(browser, "h1").startswith("Innovations are ")
    for name, unit in (("velocity", "m/s"), ("gravity", "m/s²"), ("bias", "m/s²")):
        figure = f"#state-{name}"
        assert browser.ask(f"document.querySelectorAll('{figure} .ribbon').length") == 6
        labels = texts(browser, f"{figure} .label.y")
        assert len(labels) == 6
        assert all(f"({unit})" in label or f" {unit})" in label for label in labels)
    assert "innovation (m/s)" in " ".join(texts(browser, "#over-time .label.y"))
    assert len(browser.requests()) == 1
    assert browser.complaints() == []


# -- how it behaves --------------------------------------------------------------------------------


@pytest.mark.parametrize("dark", [False, True])
def test_no_request_leaves_the_page_and_the_console_is_silent(browser, closed, calibrated, dark):
    browser.look(dark=dark)
    for folder in (closed, calibrated):
        page = folder / "report.html"
        browser.open(page)
        assert browser.requests() == [page.resolve().as_uri()]
        assert browser.complaints() == []
    browser.look()


def test_every_panel_has_axes_with_labels_and_units(browser, closed, calibrated):
    """In the words of the labels: a dimensionless axis is one of numbers, lags or categories."""
    for folder in (closed, calibrated):
        browser.open(folder / "report.html")
        browser.ask("document.querySelectorAll('details').forEach(d => d.open = true)")
        browser.ask("new Promise(r => setTimeout(() => r(1), 300))")
        panels = browser.ask(
            "[...document.querySelectorAll('.panels svg')].map(s => "
            "[...s.querySelectorAll('.label')].map(l => [l.textContent, l.dataset.unit]))"
        )
        assert len(panels) >= 4
        for labels in panels:
            assert labels
            for label, unit in labels:
                assert label
                if unit == "1":
                    assert re.search(r"autocorrelation|lag|number|\[", label), label
                else:
                    assert unit in label, label


def test_light_and_dark_differ_and_text_stands_out_in_both(browser, closed):
    colours = []
    for dark in (False, True):
        browser.look(dark=dark)
        browser.open(closed / "report.html")
        style = "getComputedStyle(document.body)"
        colours.append([browser.ask(f"{style}.{k}") for k in ("backgroundColor", "color")])
    browser.look()
    light, dark = colours
    assert light[0] != dark[0]
    assert all(contrast(*pair) > 7 for pair in colours)  # WCAG 2.1, level AAA


def contrast(one, other):
    """Contrast of two CSS colours (WCAG 2.1)."""

    def luminance(colour):
        c = np.array([int(v) for v in re.findall(r"\d+", colour)[:3]]) / 255
        linear = np.where(c <= 0.03928, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    high, low = sorted([luminance(one), luminance(other)], reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_dragging_zooms_all_panels_and_a_double_click_goes_back(browser, closed):
    browser.open(closed / "report.html")
    browser.ask("document.querySelectorAll('details').forEach(d => d.open = true)")
    browser.ask("new Promise(r => setTimeout(() => r(1), 300))")
    browser.ask("document.querySelector('#over-time svg').scrollIntoView({block: 'center'})")
    places = "[...document.querySelectorAll('#over-time svg')].map(s => s.getBoundingClientRect())"
    box = browser.ask(f"(({{x, y, width, height}}) => [x, y, width, height])({places}[0])")
    ticks = "[...document.querySelectorAll('#over-time svg')].map(s => s.textContent)"
    whole = browser.ask(ticks)
    middle = box[1] + box[3] / 2
    browser.drag((box[0] + 0.4 * box[2], middle), (box[0] + 0.5 * box[2], middle))
    zoomed = browser.ask(ticks)
    assert all(a != b for a, b in zip(whole, zoomed, strict=True))
    assert "s" in text(browser, "#over-time output")
    browser.ask("document.querySelector('#over-time [data-action=all]').click()")
    assert browser.ask(ticks) == whole


def test_the_verdict_has_its_colour_and_its_consequence(browser, closed, calibrated):
    browser.open(closed / "report.html")
    colour = "getComputedStyle(document.querySelector('h1')).color"
    assert browser.ask("document.querySelector('h1').className") == "doubtful"
    doubtful = browser.ask(colour)
    moved = json.loads((closed / "result.json").read_text(encoding="utf-8"))["moved"]
    worst, name = max((float(np.max(np.abs(z))), name) for name, z in moved.items())
    said = f"Fitted without it, {name} is off by {worst:.0f} of its printed standard deviations."
    assert said in text(browser, "h1 + p")
    browser.open(calibrated / "report.html")
    assert browser.ask("document.querySelector('h1').className") == "good"
    assert browser.ask(colour) != doubtful


def test_parameters_stand_within_two_screens_and_noise_last(browser, closed):
    browser.open(closed / "report.html")
    at = "document.querySelector('{}').getBoundingClientRect().top"
    assert browser.ask(at.format("#parameters")) < 1500
    assert browser.ask(at.format("#convincing")) < browser.ask(at.format("#residual"))
    assert browser.ask("document.querySelector('#over-time').closest('details').open") is False
    assert re.match("Residual [xyz] over angle", text(browser, "#convincing figcaption"))


def test_values_are_read_by_pointer_and_by_keys(browser, calibrated):
    """Of the first pose: its corrected value and its residual, as residuals.csv has it."""
    browser.open(calibrated / "report.html")
    browser.ask("document.querySelector('#lengths svg').focus()")
    press = (
        "document.querySelector('#lengths svg').dispatchEvent("
        "new KeyboardEvent('keydown', {key: 'ArrowRight', bubbles: true}))"
    )
    for number in ("1", "2"):
        browser.ask(press)
        assert text(browser, "#lengths .value").startswith(f"reading: {number}; ")
    browser.ask("document.querySelector('#convincing svg').scrollIntoView({block: 'center'})")
    place = "document.querySelector('#convincing circle.point').getBoundingClientRect()"
    x, y = browser.ask(f"(({{x, y}}) => [x, y])({place})")
    browser.mouse("mouseMoved", x + 3, y + 3)
    assert re.fullmatch(r"[−\d.]+ m/s²; [−\d.]+ m/s²", text(browser, "#convincing .value"))


def test_the_sphere_shows_every_pose_and_the_widest_gap(browser, calibrated):
    browser.open(calibrated / "report.html")
    count = "document.querySelectorAll('#sphere circle.point.after').length"
    assert browser.ask(count) == browser.ask(count.replace("after", "before")) == 24
    assert texts(browser, "#sphere text.key") == ["● corrected", "● reading"] * 2
    assert "half angle of" in text(browser, "#sphere figcaption")
    assert texts(browser, "#lengths text.key") == ["● corrected", "● reading"]


#: Kinds of pages, each made once by its own command.
KINDS = ("calibrate", "close", "observe", "filter", "plan", "budget", "check", "several", "fleet")


@pytest.fixture(scope="module")
def kinds(tmp_path_factory, calibrated, closed, flown):
    """The page of each kind by its name."""
    import fleets

    folder, fit = tmp_path_factory.mktemp("kinds"), str(calibrated)
    fleets.dataset(folder / "line", files=1, each=60)
    later = str(folder / "later")
    commands = {
        "plan": ["plan", fit, "--count", "3"],
        "budget": ["budget", fit],
        "check": ["check", fit, *HANDHELD],
        "later": ["calibrate", "norm-triangular", *HANDHELD, "--set", "norm=9.81 m/s^2"],
        "fleet": [*fleets.WORDS, str(folder / "line"), *fleets.NORM],
    }
    for name, words in commands.items():
        assert run([*words, "-o", str(folder / name)]) == 0
    assert run(["report", fit, later, "-o", str(folder / "several.html")]) == 0
    found = {name: next((folder / name).glob("*.html")) for name in commands}
    found |= {name: flown / name / "report.html" for name in ("observe", "filter")}
    found |= {name: f / "report.html" for name, f in (("calibrate", calibrated), ("close", closed))}
    return found | {"several": folder / "several.html"}


@pytest.fixture(scope="module")
def axe():
    """Deque's rules of accessibility: contrast, headings, names, what scrolls, what has focus."""
    script = files("axe_core_python").joinpath("axe.min.js").read_text("utf-8")

    def violations(browser):
        # Panels of one figure are alike: the first of each is looked at.
        browser.ask("document.querySelectorAll('.panels svg + svg').forEach(e => e.remove()); 1")
        browser.ask(script + "; 1")
        return browser.ask("axe.run().then(r => r.violations.map(v => [v.id, v.nodes[0].html]))")

    return violations


@pytest.mark.parametrize(
    "kind", [KINDS[0], *(pytest.param(kind, marks=pytest.mark.long) for kind in KINDS[1:])]
)
def test_axe_finds_no_violation_and_a_phone_shows_the_width(browser, kinds, axe, kind):
    """On each kind of page, light; in the dark on 400 pixels, which need no scrolling sideways."""
    browser.open(kinds[kind])
    assert browser.complaints() == []
    assert axe(browser) == []
    browser.look(400, dark=True)
    assert axe(browser) == []  # a phone also scrolls tables and code, which keys must reach
    assert browser.ask("document.documentElement.scrollWidth") == 400
    browser.look()


@pytest.mark.parametrize(
    "kind",
    ["calibrate", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("filter", "fleet"))],
)
def test_without_scripts_every_figure_is_a_still_picture(browser, kinds, kind):
    """As many pictures as the script draws, none of them empty or outside its frame."""
    drawn = browser.open(kinds[kind]) and browser.ask(
        "document.querySelectorAll('.panels svg').length"
    )
    browser.send("Emulation.setScriptExecutionDisabled", value=True)
    browser.events.clear()
    browser.send("Page.navigate", url=kinds[kind].resolve().as_uri())
    browser.wait_for("Page.loadEventFired")
    shapes = (
        "[...document.querySelectorAll('.still svg')].map(s => s.querySelectorAll('.after').length)"
    )
    found = browser.ask(shapes)
    lines = "[...document.querySelectorAll('.still svg .line')]"
    wide = browser.ask(f"Math.max(...{lines}.map(p => p.getBBox().width))")
    said = browser.ask("document.querySelector('main > noscript').textContent")
    browser.send("Emulation.setScriptExecutionDisabled", value=False)
    assert len(found) == drawn > 0
    assert sum(n > 0 for n in found) >= drawn / 2
    assert 0 < wide <= 560
    assert "these pictures are still" in said


def test_a_still_picture_keeps_a_peak_and_the_place_of_a_value():
    """One sample among 100 000 stands out; 5 of 0 to 10 is in the middle."""
    y = np.zeros(100_000)
    y[77_777] = 10.0
    arrays = [np.arange(100_000.0), y, np.array([5.0]), np.array([5.0])]
    across, upright = figures.axis("t", "s", 0, 99_999), figures.axis("y", "1", 0, 10)
    line = {"kind": "line", "look": "after", "x": 0, "y": 1}
    drawn = still(figures.panel("p", across, upright, [line]), arrays.__getitem__)
    points = re.search(r'class="line after" d="M([^"]*)"', drawn)[1].split("L")
    highest = min(float(p.split()[1]) for p in points)
    assert highest == TOP
    assert len(points) <= 2 * COLUMNS
    one = {"kind": "dots", "look": "after", "x": 2, "y": 3}
    drawn = still(
        figures.panel("p", figures.axis("x", "1", 0, 10), upright, [one]), arrays.__getitem__
    )
    cx, cy = map(float, re.search(r'cx="([\d.]+)" cy="([\d.]+)"', drawn).groups())
    assert cx == pytest.approx((LEFT + WIDTH - RIGHT) / 2)
    assert cy == pytest.approx((TOP + 170 - BOTTOM) / 2)


def test_it_prints(browser, closed):
    browser.open(closed / "report.html")
    assert browser.printed().startswith(b"%PDF")
    assert browser.complaints() == []


def test_a_hundred_thousand_samples_are_a_page_of_less_than_a_megabyte(browser, tmp_path):
    """It opens in a third of a second to a second on an idle machine."""
    rng = np.random.default_rng(0)
    n = 100_000
    mass, temperature = rng.uniform(0, 5, n), np.linspace(15, 30, n)
    reading = 0.5 + 0.1 * 9.81 * mass + 0.02 * temperature + 0.003 * rng.standard_normal(n)
    reading[77_777] += 1.0
    np.savetxt(
        tmp_path / "long.csv", np.column_stack([np.arange(n) / 200, mass, temperature, reading]),
        delimiter=",", header="t [s],mass [kg],temperature [degC],output [mV]",
        comments="", fmt="%.8g",
    )  # fmt: skip
    model = find_model(str(Path(__file__).parent / "models" / "load_cell.py:load_cell"))
    runs = load_runs(tmp_path / "long.csv", model.signals)
    found = calibrate(model, runs)
    result = calibration_result(found, model_name="load_cell.py", data=[])
    page = tmp_path / "report.html"
    page.write_text(calibration_page(result), encoding="utf-8")
    assert page.stat().st_size < 1_000_000
    browser.open(page)
    browser.ask("document.querySelectorAll('details').forEach(d => d.open = true)")
    browser.ask("new Promise(r => setTimeout(() => r(1), 300))")
    assert browser.ask("document.querySelectorAll('svg, canvas').length") > 0
    assert browser.complaints() == []
    # One sample far out is not lost among the hundred thousand: it reaches the panel's upper edge.
    top = "[...document.querySelectorAll('#over-time .line')].map(p => p.getBBox().y)[0]"
    assert browser.ask(top) < 30


def test_what_a_person_named_does_not_become_html(browser, tmp_path):
    wicked = "<img src=x onerror=alert(1)>"
    record = tmp_path / "a&b <i>.csv"
    rng = np.random.default_rng(1)
    x = rng.uniform(-1, 1, (200, 2))
    mass, other = 2 + x.T
    lines = [f"mass [kg],temperature [degC],output [mV],{wicked}</script>"]
    output = 0.5 + 0.1 * 9.81 * mass + 0.001 * rng.standard_normal(200)
    lines += [f"{m},{20 + m * o},{y},{o}" for m, o, y in zip(mass, other, output, strict=True)]
    record.write_text("\n".join(lines), encoding="utf-8")
    model = str(Path(__file__).parent / "models" / "load_cell.py:load_cell")
    assert run(["calibrate", model, str(record), "-o", str(tmp_path / "out")]) == 0
    browser.open(tmp_path / "out" / "report.html")
    assert wicked in browser.ask("document.body.textContent")
    assert "a&b <i>.csv" in text(browser, ".origin")
    assert browser.ask("document.querySelectorAll('img, i').length") == 0
    assert browser.complaints() == []


# -- numbers behind the figures --------------------------------------------------------------------


def record_of(residual, *, rate=100.0):
    from casest.data.run import Run

    time_ = np.arange(len(residual)) / rate
    return Run.raw("r", {"v": residual}, units={"v": "m"}, time=time_)


def test_the_spectrum_holds_the_variance_and_finds_the_line():
    """Parseval: the density integrates to the mean square, of noise and of a sine."""
    rng = np.random.default_rng(0)
    t = np.arange(20_000) / 100
    residual = (0.3 * rng.standard_normal(len(t)) + 0.5 * np.sin(2 * np.pi * 7 * t))[:, None]
    found = spectrum((record_of(residual),), (residual,), 0.01)
    assert found is not None
    step = found.frequency[1] - found.frequency[0]
    assert found.power.sum() * step == pytest.approx(0.3**2 + 0.5**2 / 2, rel=0.03)
    assert found.frequency[np.argmax(found.power[:, 0])] == pytest.approx(7, abs=step)


def test_the_spectrum_is_that_of_scipy():
    from scipy.signal import welch

    rng = np.random.default_rng(3)
    residual = np.cumsum(rng.standard_normal((8192, 1)), axis=0) * 0.01
    found = spectrum((record_of(residual),), (residual,), 0.01)
    assert found is not None
    f, power = welch(residual[:, 0], 100, nperseg=2048, detrend="constant")
    assert found.frequency == pytest.approx(f[1:-1])
    assert np.median(found.power[:, 0] / power[1:-1]) == pytest.approx(1, abs=0.01)


def test_white_noise_lies_in_its_bands_nineteen_times_of_twenty():
    rng = np.random.default_rng(1)
    inside, lags, means = [], [], []
    for _ in range(20):
        residual = rng.standard_normal((4000, 1))
        runs = (record_of(residual),)
        found = spectrum(runs, (residual,), 0.01)
        assert found is not None
        low, high = white_band(found.freedom)
        relative = found.power[:, 0] / (2 * 0.01)
        inside.append(np.mean((relative > low) & (relative < high)))
        rho, count = autocorrelation(runs, (residual,))
        lags.append(np.mean(np.abs(rho) < 1.96 / np.sqrt(count)))
        _, mean, half = bins(rng.uniform(size=4000), residual[:, 0], 1.0)
        means.append(np.mean(np.abs(mean) < half))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)
    assert np.mean(lags) == pytest.approx(0.95, abs=0.02)
    assert np.mean(means) == pytest.approx(0.95, abs=0.03)


def test_decimal_points_stand_below_each_other():
    found = aligned(["0.25", "−12.5", "3", "100.125"])
    ends = [len(t) - (t.index(".") if "." in t else t.index("\u2008")) for t in found]
    assert len(set(ends)) == 1


def test_the_page_is_written_whole(closed):
    page = (closed / "report.html").read_text(encoding="utf-8")
    assert page.endswith("</html>\n")
    assert sorted(p.name for p in closed.iterdir()) == [
        "report.html", "residuals.csv", "result.json",
    ]  # fmt: skip
