"""Sensors of one channel, against certified, published and measured numbers."""

from __future__ import annotations

import json

import numpy as np
import pytest
from nist import digits

from casest import Run, UsageError, attempt, calibrate, close, constant
from casest.cli import run as casest
from casest.effects import CATALOGUE, quadratic
from casest.effects.placing import placed_in
from casest_problems.one_channel import linear, load_cell, polynomial, pressure
from casest_problems.thermistor import steinhart_hart, thermistor_beta

# NIST StRD, linear regression: https://www.itl.nist.gov/div898/strd/lls/lls.shtml
NORRIS = np.fromstring(
    """0.2 0.1 337.4 338.8 118.2 118.1 884.6 888.0 10.1 9.2 226.5 228.1 666.3 668.5 996.3 998.5
    448.6 449.1 777.0 778.9 558.2 559.2 0.4 0.3 0.6 0.1 775.5 778.1 666.9 668.8 338.0 339.3 447.5
    448.9 11.6 10.8 556.0 557.7 228.1 228.3 995.8 998.0 887.6 888.8 120.2 119.6 0.3 0.3 0.3 0.6
    556.8 557.6 339.1 339.3 887.2 888.0 999.0 998.5 779.0 778.9 11.1 10.2 118.3 117.6 229.2 228.9
    669.1 668.4 448.9 449.2 0.5 0.2""",
    sep=" ",
).reshape(-1, 2)
PONTIUS = np.fromstring(
    """.11019 .21956 .32949 .43899 .54803 .65694 .76562 .87487 .98292 1.09146 1.20001 1.30822
    1.41599 1.52399 1.63194 1.73947 1.84646 1.95392 2.06128 2.16844 .11052 .22018 .32939 .43886
    .54798 .65739 .76596 .87474 .98300 1.09150 1.20004 1.30818 1.41613 1.52408 1.63159 1.73965
    1.84696 1.95445 2.06177 2.16829""",
    sep=" ",
)
NOINT1 = np.column_stack([np.arange(60.0, 71), np.arange(130.0, 141)])

# Vishay BCcomponents 2322 640 (NTCLE100E3103), 10 kΩ, B25/85 = 3977 K: R/R25 = exp(A + B/T + C/T² +
# D/T³), document 29049.
VISHAY = (-14.6337, 4791.842, -115334.0, -3.730535e6)


def record(reference, reading, name="reference", read="reading", unit=None, own=None, **more):
    signals = {
        name: np.asarray(reference, float)[:, None],
        read: np.asarray(reading, float)[:, None],
    }
    signals |= {n: np.asarray(v, float)[:, None] for n, v in more.items()}
    return Run.raw("record", signals, units={n: None for n in signals} | {name: unit, read: own})


def thermistor(celsius, ohm):
    kelvin = np.asarray(celsius, float) + 273.15
    return record(kelvin, ohm, "temperature", "resistance", "K", "ohm")


def vishay(celsius):
    T = np.asarray(celsius, float) + 273.15
    A, B, C, D = VISHAY
    return 1e4 * np.exp(A + B / T + C / T**2 + D / T**3)


def test_a_straight_line_has_nists_certified_numbers():
    found = calibrate(linear, [record(*NORRIS.T)])
    assert digits(found.values["offset"], -0.262323073774029) > 10
    assert digits(found.values["gain"], 1.00211681802045) > 10
    assert digits(found.plain["offset"], 0.232818234301152) > 8
    assert digits(found.plain["gain"], 0.429796848199937e-03) > 8


def test_a_parabola_over_millions_has_nists_certified_numbers():
    loads = np.tile(150000.0 * np.arange(1, 21), 2)
    found = calibrate(polynomial, [record(loads, PONTIUS)])
    certified = {
        "offset": (0.673565789473684e-03, 0.107938612033077e-03),
        "gain": (0.732059160401003e-06, 0.157817399981659e-09),
        "quadratic": (-0.316081871345029e-14, 0.486652849992036e-16),
    }
    for name, (value, std) in certified.items():
        assert digits(found.values[name], value) > 8
        assert digits(found.plain[name], std) > 8


def test_a_line_through_the_origin_is_a_line_with_its_offset_held():
    found = calibrate(linear.having(offset=constant(0.0, "")), [record(*NOINT1.T)])
    assert digits(found.values["gain"], 2.07438016528926) > 10
    assert digits(found.plain["gain"], 0.165289256198347e-01) > 8


def test_a_polynomial_takes_terms_of_higher_degree():
    """Wampler's fifth problem has degree 5; numpy's own solution serves for the fourth."""
    x = np.linspace(-2, 3, 60)
    y = 1 - x + 0.5 * x**2 + 0.2 * x**3 - 0.1 * x**4
    y = y + np.random.default_rng(1).normal(0, 0.01, 60)
    found = calibrate(polynomial.freed("cubic").freed("quartic"), [record(x, y)])
    names = ("offset", "gain", "quadratic", "cubic", "quartic")
    expected = np.polynomial.polynomial.polyfit(x, y, 4)
    np.testing.assert_allclose([found.values[n] for n in names], expected, rtol=1e-9)


def test_a_reference_far_from_zero_is_counted_from_its_middle(tmp_path, capsys):
    """Heights by a barometer over a range of 2 hPa, by the standard atmosphere's formula."""
    rng, path = np.random.default_rng(5), tmp_path / "walk.csv"
    p = rng.uniform(1013.9, 1015.8, 150)
    height = 44330.8 * (1 - (p / 1013.25) ** 0.190263)
    table = np.column_stack([p, height + 0.002 * rng.standard_normal(150)])
    np.savetxt(path, table, delimiter=",", header="reference [hPa],reading [m]", comments="")
    assert casest(["calibrate", "polynomial", str(path)]) == 2
    said = " ".join(capsys.readouterr().out.split())
    assert "reference is from 1013.9" in said
    way = said.partition("count it from its middle, ")[2].split(" What")[0].split()[:2]
    assert way == ["--set", "at=1015"]
    assert casest(["close", "polynomial", str(path), *way, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    parameters = found["after"]["parameters"]
    gain = -44330.8 * 0.190263 / 1013.25 * (1015 / 1013.25) ** (0.190263 - 1)
    bend = gain * (0.190263 - 1) / (2 * 1015)
    for name, truth in (("gain", gain), ("quadratic", bend)):
        value, std = (parameters[name][k] for k in ("value", "std"))
        assert abs(value - truth) < 3.5 * std
    # Where one counts from is a choice, which cannot be wrong.
    assert not any(h["name"] == "at" for h in found["invisible"])


def test_beta_is_the_data_sheets_between_its_two_temperatures():
    celsius = np.repeat([25.0, 85.0], 4)
    noise = 1 + 1e-6 * np.tile([1, -1, 1, -1], 2)
    found = calibrate(thermistor_beta, [thermistor(celsius, vishay(celsius) * noise)])
    assert float(found.values["beta"]) == pytest.approx(3977, abs=1)
    assert float(found.values["nominal_resistance"]) == pytest.approx(1e4, rel=1e-4)


def test_steinhart_hart_has_the_published_numbers_of_a_thermistor():
    """The example of the well-known SRS calculator: 25, 10 and 4 kΩ at 5, 25 and 45 °C."""
    ohm = np.repeat([25e3, 10e3, 4e3], 2) * (1 + 1e-7 * np.tile([1, -1], 3))
    found = calibrate(steinhart_hart, [thermistor(np.repeat([5.0, 25.0, 45.0], 2), ohm)])
    assert float(found.values["a"]) == pytest.approx(2.108508173e-3, rel=1e-5)
    assert float(found.values["b"]) == pytest.approx(0.7979204727e-4, rel=1e-4)
    assert float(found.values["c"]) == pytest.approx(6.535076315e-7, rel=1e-4)


def test_steinhart_hart_follows_a_manufacturers_table_where_beta_does_not():
    celsius = np.arange(-40.0, 126, 5)
    run = thermistor(celsius, vishay(celsius))
    assert attempt(steinhart_hart, [run]).rmse < 0.05
    assert attempt(thermistor_beta, [run]).rmse > 0.5


def test_a_nominal_temperature_that_is_freed_is_refused_in_words(tmp_path, capsys):
    """With the nominal resistance it is one number: each moves along the same curve."""
    celsius, path = np.arange(-10.0, 80, 10), tmp_path / "ntc.csv"
    table = np.column_stack([celsius, vishay(celsius)])
    np.savetxt(
        path, table, delimiter=",", header="temperature [degC],resistance [ohm]", comments=""
    )
    words = ["thermistor-beta", str(path)]
    assert casest(["calibrate", *words, "--free", "nominal_temperature"]) == 2
    assert "`nominal_temperature` cannot be told apart" in " ".join(capsys.readouterr().out.split())
    assert casest(["close", *words, "--fix", "nominal_resistance=10000", "--json"]) == 0
    tried = json.loads(capsys.readouterr().out)["smallest_detectable"]
    assert not any(d["name"] == "nominal_temperature" for d in tried)  # a choice


@pytest.mark.parametrize("seed", [3, 5, 7])
@pytest.mark.filterwarnings("error")
def test_the_same_term_twice_never_has_a_standard_deviation_of_zero(seed):
    """`quadratic` of the polynomial and of the catalogue, by rounding alone: 1013.4 ± 0."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(250, 300, 60)
    y = 1013.25 * (1 - 2.2558e-5 * x) ** 5.2559 + 0.02 * rng.standard_normal(60)
    twice = polynomial.with_effect(quadratic, on="corrected")
    found = attempt(twice, [record(x, y, unit="m", own="hPa")])
    assert not found.certificate.trusted
    assert all(np.isnan(s) or s > 0 for s in found.std.values())


def test_temperatures_in_degrees_that_nobody_stated_are_refused():
    run = record(
        [0, 25, 50, 75], [32e3, 1e4, 3.6e3, 1.5e3], "temperature", "resistance", "K", "ohm"
    )
    for model in (thermistor_beta, steinhart_hart):
        with pytest.raises(UsageError, match=r'units=\{"temperature": "degC"\}'):
            calibrate(model, [run])
    with pytest.raises(UsageError, match="resistance: 0 ohm"):
        calibrate(steinhart_hart, [thermistor([0, 25, 50, 75], [32e3, 1e4, 0, 1.5e3])])


def test_measured_load_cells_have_the_sensitivities_that_others_found(shared_data):
    """997.2 and 1004.3 counts/lb, ± 1; cell B without the three samples that SOURCE.md names."""
    data = np.genfromtxt(
        shared_data / "swing-project" / "loadcell_swing.csv", delimiter=",", skip_header=1
    )
    held = ~np.isnan(data[:, 1])
    for counts, expected in ((data[:, 2], 997.2), (data[:, 3], 1004.3)):
        good = held & (counts > -1e6)
        found = calibrate(load_cell, [record(data[good, 1], counts[good], "load")])
        assert float(found.values["sensitivity"]) == pytest.approx(expected, abs=1)


def test_the_creep_of_a_load_cell_is_an_effect_of_the_catalogue():
    """A relaxation in a loop of its own: 1 % of the reading, over 30 s."""
    t = np.arange(0, 400, 0.5)
    load, crept = np.floor(t / 60) % 5 * 10.0, np.zeros(len(t))
    for i in range(1, len(t)):
        crept[i] = crept[i - 1] + (1 - np.exp(-0.5 / 30)) * (0.02 * load[i] - crept[i - 1])
    reading = 3 + 2 * load + crept + np.random.default_rng(0).normal(0, 0.02, len(t))
    run = record(load, reading, "load")
    run = Run.raw("cell", dict(run.signals), units=dict(run.units), time=t)
    creep = next(e for e in CATALOGUE if e.name == "creep")
    found = calibrate(load_cell.with_effect(placed_in(creep, load_cell)), [run])
    settled = float(found.values["sensitivity"])
    assert settled == pytest.approx(2.02, rel=1e-3)
    assert settled * float(found.values["creep.k"]) == pytest.approx(0.02, rel=0.05)
    assert float(found.values["creep.tau"]) == pytest.approx(30, rel=0.1)


def test_a_pressure_sensor_has_the_coefficients_of_its_end_points():
    """A bridge given by its readings at 0, 5 and 10 bar and two temperatures, as a sheet does."""
    cold, hot = np.array([0.40, 15.6, 31.0]), np.array([0.60, 15.2, 30.0])
    rng = np.random.default_rng(3)
    p, T = rng.uniform(0, 10, 200), rng.uniform(-20, 80, 200)
    bend = [np.polynomial.polynomial.polyfit([0, 5, 10], end, 2) for end in (cold, hot)]
    ends = [np.polynomial.polynomial.polyval(p, b) for b in bend]
    share = (T + 20) / 100
    mV = (1 - share) * ends[0] + share * ends[1] + rng.normal(0, 0.002, 200)
    found = calibrate(pressure, [record(p, mV, "pressure", unit="bar", own="mV", temperature=T)])
    assert float(found.values["offset"]) == pytest.approx(0.49, abs=0.002)
    assert float(found.values["offset_drift"]) == pytest.approx(0.002, abs=1e-4)
    span = 0.55 * (31.0 - 0.4) + 0.45 * (30.0 - 0.6)
    assert float(found.values["sensitivity"]) * 10 * (
        1 + 10 * float(found.values["nonlinearity"])
    ) == pytest.approx(span, abs=0.01)


ONE = {
    "linear": ("reference,reading", lambda x: (x, 2 + 3 * x)),
    "polynomial": ("reference,reading", lambda x: (x, 2 + 3 * x + 0.05 * x**2)),
    "load-cell": ("load [kg],reading [mV]", lambda x: (x, 0.1 + 0.2 * x)),
    "thermistor-beta": ("temperature [degC],resistance [ohm]", lambda x: (10 * x, vishay(10 * x))),
    "steinhart-hart": ("temperature [degC],resistance [ohm]", lambda x: (10 * x, vishay(10 * x))),
}  # fmt: skip


@pytest.mark.parametrize("name", ONE)
def test_readings_alone_are_corrected_by_command(name, tmp_path, capsys):
    header, readings = ONE[name]
    x, y = readings(np.linspace(1, 8, 24))
    rng = np.random.default_rng(0)
    y = y * (1 + rng.normal(0, 1e-5, len(y)))
    rows = [f"{a:.9g},{b:.9g}" for a, b in zip(x, y, strict=True)]
    whole, alone = tmp_path / "record.csv", tmp_path / "readings.csv"
    whole.write_text("\n".join([header, *rows]) + "\n")
    alone.write_text("\n".join([header.split(",")[1], *(r.split(",")[1] for r in rows)]) + "\n")
    assert casest(["calibrate", name, str(whole), "-o", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "result.json").read_text())["trusted"]
    capsys.readouterr()
    assert casest(["apply", str(tmp_path / "out"), str(alone)]) == 0
    table = np.genfromtxt(capsys.readouterr().out.splitlines(), delimiter=",", skip_header=1)
    kelvin = 273.15 if "temperature" in header else 0.0
    tolerance = 0.4 if name == "thermistor-beta" else 0.05
    np.testing.assert_allclose(table[:, -1], x + kelvin, atol=tolerance)


def test_what_the_source_was_set_to_takes_no_gain_from_the_current_that_was_measured():
    """A shunt that bends a little, its current read back by the source with noise of its own."""
    rng = np.random.default_rng(1)
    set_to = np.repeat(np.linspace(0.1, 1, 18), 12)
    current = 5e-4 * set_to
    reading = -0.04 + 4900 * current - 0.004 * set_to**2 + rng.normal(0, 1e-4, len(current))
    measured = current * (1 + rng.normal(0, 3e-4, len(current)))
    closing = close("linear", {"reference": measured, "reading": reading, "setpoint": set_to})
    assert closing.effects
    assert closing.after.values["gain"] == pytest.approx(4900, rel=0.01)
