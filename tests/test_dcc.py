"""A result as PTB's Digital Calibration Certificate: its values, its units, what it does not know.

Files like these were valid by the schema of DCC 3.2.0 with D-SI 2.1.0 (docs/export.md).
"""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np
import pytest

from casest.cli import run
from casest.errors import UsageError
from casest.saved.dcc import d_si

NAMES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
MODEL = '''
from casest import Residual, constant, model, param, signal


@model
def cell(
    mass=signal("kg"), reading=signal("mV"), *,
    zero=param("mV"), gain=param("mV/kg", start=1.0), share=constant(1.0, "1", std=0.01),
):
    """A load cell."""
    return Residual(measured=reading, predicted=zero + gain * share * mass)
'''
READINGS = [0.11, 1.02, 1.98, 3.05, 4.01, 4.96]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dcc")
    (folder / "m.py").write_text(MODEL)
    rows = "\n".join(f"{k / 10},{r}" for k, r in enumerate(READINGS))
    (folder / "d.csv").write_text(f"mass [kg],reading [mV]\n{rows}\n")
    assert run(["calibrate", f"{folder}/m.py", f"{folder}/d.csv", "-o", f"{folder}/out"]) == 0
    return folder


def exported(folder, *words):
    assert run(["export", f"{folder}/out", "--to", "dcc", "-o", f"{folder}/c.xml", *words]) == 0
    return ET.parse(folder / "c.xml").getroot()


def test_values_are_in_base_units_with_expanded_uncertainties(folder):
    """Of a straight line with four degrees of freedom, and an exact reference for its zero."""
    root = exported(folder)
    mass = 0.1 * np.arange(6)  # kg
    (gain, zero), covariance = np.polyfit(mass, 1e-3 * np.array(READINGS), 1, cov=True)
    found = {
        q.find("dcc:name/dcc:content", NAMES).text: q.find("si:real", NAMES)
        for q in root.iterfind(".//dcc:quantity", NAMES)
        if q.find("si:real", NAMES) is not None
    }
    assert list(found) == ["zero", "gain", "share"]

    def number(name, what):
        return float(found[name].find(what, NAMES).text)

    assert number("zero", "si:value") == pytest.approx(zero)
    assert number("gain", "si:value") == pytest.approx(gain)
    u = number("zero", "si:expandedUnc/si:uncertainty")
    assert u == pytest.approx(2.776445 * np.sqrt(covariance[1, 1]), rel=1e-5)
    assert number("zero", "si:expandedUnc/si:coverageFactor") == pytest.approx(2.776, abs=1e-3)
    assert number("share", "si:expandedUnc/si:uncertainty") == pytest.approx(0.0196, rel=1e-3)
    volt = "\\kilogram\\metre\\tothe{2}\\second\\tothe{-3}\\ampere\\tothe{-1}"
    assert found["zero"].find("si:unit", NAMES).text == volt
    per = "\\metre\\tothe{2}\\second\\tothe{-3}\\ampere\\tothe{-1}"
    assert found["gain"].find("si:unit", NAMES).text == per
    assert found["share"].find("si:unit", NAMES).text == "\\one"


def test_all_parameters_stand_together_with_their_covariance(folder):
    """By NumPy's line, in base units; a reference of 1 % of the mass adds to the gain alone."""
    root = exported(folder)
    mass = 0.1 * np.arange(6)
    (gain, zero), covariance = np.polyfit(mass, 1e-3 * np.array(READINGS), 1, cov=True)
    covariance[0, 0] += (0.01 * gain) ** 2
    vector = root.find(".//si:realListXMLList", NAMES)

    def texts(of, what):
        return [found.text for found in of.iterfind(what, NAMES)]

    assert texts(vector, "si:labelXMLList") == ["zero gain"]
    values = np.array(texts(vector, "si:valueXMLList")[0].split(), dtype=float)
    assert values == pytest.approx([zero, gain])
    region = vector.find("si:ellipsoidalRegionXMLList", NAMES)
    columns = region.findall("si:covarianceMatrix/si:column", NAMES)
    matrix = [[float(x) for x in texts(c, "si:covariance/si:value")] for c in columns]
    np.testing.assert_allclose(matrix, covariance[::-1, ::-1], rtol=1e-6)
    unit = texts(columns[0], "si:covariance/si:unit")[1]  # V * V/kg
    expected = "\\kilogram\\metre\\tothe{4}\\second\\tothe{-6}\\ampere\\tothe{-2}"
    assert unit == expected
    factor = float(region.find("si:coverageFactor", NAMES).text)
    assert factor == pytest.approx(np.sqrt(2 * 6.94427), abs=1e-3)  # F(2, 4) at 95 %


def test_what_a_certificate_is_not_told_is_said(folder, capsys, tmp_path):
    root = exported(folder)
    assert "the certificate does not say identifier, country" in capsys.readouterr().err
    assert root.find(".//dcc:customer/dcc:name/dcc:content", NAMES).text == "not stated"
    told = ['country = "DE"', 'laboratory = "A & B"', "begin = 2026-11-20", "end = 2026-11-21"]
    names = ["identifier", "person", "customer", "item", "manufacturer", "serial"]
    told += [f'{name} = "x"' for name in names]
    (tmp_path / "c.toml").write_text("\n".join(told))
    root = exported(folder, "--certificate", f"{tmp_path}/c.toml")
    unsigned = "casest: the certificate is not signed: the laboratory does that\n"
    assert capsys.readouterr().err == unsigned
    assert root.find(".//dcc:calibrationLaboratory//dcc:content", NAMES).text == "A & B"
    assert root.find(".//dcc:endPerformanceDate", NAMES).text == "2026-11-21"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('country = "Germany"', "country = 'Germany': give two upper-case letters"),
        ('lab = "x"', "no lab; it may say identifier, country"),
        ("serial = 7", "serial = 7: give a text"),
        ("serial = ", "is no TOML"),
        (None, "No such file"),
    ],
)
def test_a_certificate_that_says_it_wrongly_is_refused(folder, capsys, tmp_path, text, said):
    if text is not None:
        (tmp_path / "c.toml").write_text(text)
    words = ["export", f"{folder}/out", "--to", "dcc", "--certificate", f"{tmp_path}/c.toml"]
    assert run(words) == 1
    assert said in capsys.readouterr().err


def test_options_of_other_exports_and_units_that_nobody_stated_are_refused(folder, capsys):
    assert run(["export", f"{folder}/out", "--to", "dcc", "--with-std"]) == 1
    assert "--to dcc takes --certificate alone" in capsys.readouterr().err
    assert run(["export", f"{folder}/out", "--to", "c", "--certificate", "x"]) == 1
    assert "--certificate is for --to dcc" in capsys.readouterr().err
    with pytest.raises(UsageError, match="the unit of offset is \\[v\\], and a certificate needs"):
        d_si("[v]", "offset")
    assert d_si("degC", "t") == (1.0, 273.15, "\\kelvin")
