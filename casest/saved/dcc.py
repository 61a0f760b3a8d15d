"""A saved result as a Digital Calibration Certificate of PTB (DCC 3.2, with D-SI 2.1), in XML.

What a calibration does not know (who made it, for whom, of which item) stands in a TOML file; what
is not said there is written as "not stated". Values are in SI base units and radians, so that every
unit is one that D-SI has; uncertainties are expanded ones of 95 %, by Student's t.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import date
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from scipy.special import fdtri

from casest import __version__, units
from casest.errors import CasestError, UsageError
from casest.estimate.profile_likelihood import half_width
from casest.results.budget import Budget, Quantity, budget_of, covariance_in
from casest.results.file import result_file
from casest.results.uncertainty import Covariance, Input

VERSION = "3.2.0"
DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
SCHEMA = f"{DCC} https://ptb.de/dcc/v{VERSION}/dcc.xsd"
INSTANCE = "http://www.w3.org/2001/XMLSchema-instance"
#: What is written where nothing is known.
UNKNOWN = "not stated"
#: Base units as D-SI spells them, in its order; an angle and a count have no dimension there.
BASES = {
    "kg": "kilogram", "m": "metre", "s": "second", "A": "ampere", "K": "kelvin",
    "angle": "radian",
}  # fmt: skip
#: From so many degrees of freedom on a distribution is called normal.
NORMAL = 1000


@dataclass(frozen=True)
class Certificate:
    """What a certificate says of itself, each a text; dates as 2026-11-23, codes of two letters."""

    identifier: str = UNKNOWN
    country: str = "ZZ"
    language: str = "en"
    begin: str = ""
    end: str = ""
    place: str = "laboratory"
    laboratory: str = UNKNOWN
    person: str = UNKNOWN
    customer: str = UNKNOWN
    item: str = UNKNOWN
    manufacturer: str = UNKNOWN
    model: str = ""
    serial: str = UNKNOWN


#: What a value must look like.
FORMS = {
    "country": ("[A-Z]{2}", "two upper-case letters, as DE"),
    "language": ("[a-z]{2}", "two lower-case letters, as en"),
    "begin": (r"\d{4}-\d\d-\d\d", "a date, as 2026-11-23"),
    "end": (r"\d{4}-\d\d-\d\d", "a date, as 2026-11-23"),
    "place": ("laboratory|customer|laboratoryBranch|customerBranch|other",
              "laboratory, customer, laboratoryBranch, customerBranch or other"),
}  # fmt: skip


def certificate_in(file: Path | None) -> Certificate:
    """What a TOML file says; UsageError for what a certificate does not have."""
    if file is None:
        return Certificate()
    try:
        said = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"--certificate {file}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"--certificate {file}: is no TOML: {error}") from None
    known = [f.name for f in fields(Certificate)]
    found = {}
    for name, value in said.items():
        if name not in known:
            raise UsageError(f"--certificate {file}: no {name}; it may say {', '.join(known)}")
        text = value.isoformat() if isinstance(value, date) else value
        form, words = FORMS.get(name, (r"(?s).*\S.*", "a text"))
        if not isinstance(text, str) or not re.fullmatch(form, text):
            raise UsageError(f"--certificate {file}: {name} = {value!r}: give {words}")
        found[name] = text
    return Certificate(**found)


def dcc(path: Path, file: Path | None = None) -> tuple[str, list[str]]:
    """XML of a saved result, with what `file` says of laboratory, customer and item; and remarks.

    Raises UsageError for refused results, and where a unit was never stated.
    """
    budget, said = budget_of(path), certificate_in(file)
    missing = [f.name for f in fields(Certificate) if getattr(said, f.name) in (UNKNOWN, "ZZ")]
    day = date.fromtimestamp(result_file(path).stat().st_mtime).isoformat()
    remarks = ["the certificate is not signed: the laboratory does that"]
    if missing:
        remarks.append(
            f"the certificate does not say {', '.join(missing)}: write them to a TOML file, "
            '--certificate FILE (laboratory = "…")'
        )
    if not (said.begin and said.end):
        remarks.append(f"its dates are those of the result's file: {day}, unless begin and end say")
    root = ET.Element(f"{{{DCC}}}digitalCalibrationCertificate", {
        "schemaVersion": VERSION, f"{{{INSTANCE}}}schemaLocation": SCHEMA})  # fmt: skip
    _administrative(_in(root, "administrativeData"), said, day)
    results = _in(_in(root, "measurementResults"), "measurementResult")
    _measured(results, budget, covariance_in(path))
    for prefix, uri in (("dcc", DCC), ("si", SI), ("xsi", INSTANCE)):
        ET.register_namespace(prefix, uri)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n", remarks


def _in(parent: ET.Element, name: str, text: str | None = None) -> ET.Element:
    found = ET.SubElement(parent, f"{{{DCC}}}{name}")
    found.text = text
    return found


def _named(parent: ET.Element, text: str, name: str = "name") -> None:
    _in(_in(parent, name), "content", text)


def _software(parent: ET.Element) -> None:
    own = _in(parent, "software")
    _named(own, "casest")
    _in(own, "release", __version__)


def _administrative(ring: ET.Element, said: Certificate, day: str) -> None:
    """Ring 1: software, core data, item, laboratory, person, customer."""
    _software(_in(ring, "dccSoftware"))
    core = _in(ring, "coreData")
    _in(core, "countryCodeISO3166_1", said.country)
    _in(core, "usedLangCodeISO639_1", said.language)
    _in(core, "mandatoryLangCodeISO639_1", said.language)
    _in(core, "uniqueIdentifier", said.identifier)
    _in(core, "beginPerformanceDate", said.begin or day)
    _in(core, "endPerformanceDate", said.end or said.begin or day)
    _in(core, "performanceLocation", said.place)
    item = _in(_in(ring, "items"), "item")
    _named(item, said.item)
    _named(_in(item, "manufacturer"), said.manufacturer)
    if said.model:
        _in(item, "model", said.model)
    identification = _in(_in(item, "identifications"), "identification")
    _in(identification, "issuer", "manufacturer")
    _in(identification, "value", said.serial)
    _contact(_in(_in(ring, "calibrationLaboratory"), "contact"), said.laboratory, said.country)
    person = _in(_in(ring, "respPersons"), "respPerson")
    _named(_in(person, "person"), said.person)
    _in(person, "mainSigner", "true")
    _contact(_in(ring, "customer"), said.customer, said.country)


def _contact(parent: ET.Element, name: str, country: str) -> None:
    _named(parent, name)
    _in(_in(parent, "location"), "countryCode", country)


def _measured(ring: ET.Element, budget: Budget, together: Covariance) -> None:
    """Ring 2: what was determined, apart and together, and what that rests on."""
    _named(ring, f"Calibration with the model {budget.model}")
    method = _in(_in(ring, "usedMethods"), "usedMethod")
    _named(method, "weighted least squares; uncertainty by JCGM 100, 5.1.2 and G.4")
    _software(_in(ring, "usedSoftware"))
    results = _in(ring, "results")
    _quantities(results, "Parameters", [_of_value(v) for v in budget.values])
    _all_together(results, together, budget)
    known = [_of_input(i) for i in budget.inputs if i.kind == "reference"]
    if known:
        _quantities(results, "References, as they were stated", known)


@dataclass(frozen=True)
class _Number:
    name: str
    value: float
    std: float | None
    unit: str
    freedom: float | None


def _of_value(v: Quantity) -> _Number:
    if v.value is None:
        raise UsageError(f"{v.name} has no value: there is nothing to certify")
    return _Number(v.name, v.value, v.std, v.unit, v.degrees_of_freedom)


def _of_input(i: Input) -> _Number:
    return _Number(i.name, i.value or 0.0, i.std, i.unit, i.degrees_of_freedom)


def _quantities(results: ET.Element, name: str, numbers: Sequence[_Number]) -> None:
    result = _in(results, "result")
    _named(result, name)
    data = _in(result, "data")
    for number in numbers:
        quantity = _in(data, "quantity")
        _named(quantity, number.name)
        _real(ET.SubElement(quantity, f"{{{SI}}}real"), number)


def _all_together(results: ET.Element, found: Covariance, budget: Budget) -> None:
    """All parameters as one vector, with the covariance of each two and the ellipsoid of 95 %.

    Those without a standard deviation (on a bound) are left out; its coverage factor is by the F
    distribution with the fewest degrees of freedom of any.
    """
    matrix = np.array(found.matrix, dtype=float)
    kept = [i for i in range(len(found.names)) if np.isfinite(matrix[i, i]) and matrix[i, i] > 0]
    if len(kept) < 2:
        return
    result = _in(results, "result")
    _named(result, "Parameters together")
    quantity = _in(_in(result, "data"), "quantity")
    _named(quantity, "all parameters, with their covariance")
    vector = ET.SubElement(quantity, f"{{{SI}}}realListXMLList")
    scale = {i: d_si(found.units[i], found.names[i]) for i in kept}

    def own(parent: ET.Element, name: str, text: str | None = None) -> ET.Element:
        made = ET.SubElement(parent, f"{{{SI}}}{name}")
        made.text = text
        return made

    own(vector, "labelXMLList", " ".join(found.names[i].replace(" ", "_") for i in kept))
    values = {i: scale[i][0] * float(found.values[i] or 0.0) + scale[i][1] for i in kept}
    own(vector, "valueXMLList", " ".join(repr(values[i]) for i in kept))
    own(vector, "unitXMLList", " ".join(scale[i][2] for i in kept))
    region = own(vector, "ellipsoidalRegionXMLList")
    covariances = own(region, "covarianceMatrix")
    for j in kept:
        column = own(covariances, "column")
        for i in kept:
            one = own(column, "covariance")
            own(one, "value", f"{scale[i][0] * scale[j][0] * matrix[i, j]:.9g}")
            own(one, "unit", _product(found.units[i], found.units[j]))
    known = [v.degrees_of_freedom for v in budget.values if v.degrees_of_freedom is not None]
    factor = np.sqrt(len(kept) * fdtri(len(kept), min([*known, 1e6]), 0.95))
    own(region, "coverageFactor", f"{factor:.4g}")
    own(region, "coverageProbability", "0.95")


def _product(one: str, other: str) -> str:
    """D-SI unit of the product of two units."""
    powers: dict[str, float] = {}
    for unit in (one, other):
        for base, power in units.size(unit or "1")[1]:
            powers[base] = powers.get(base, 0.0) + float(power)
    return _spelled(powers)


def _real(real: ET.Element, number: _Number) -> None:
    """A value in base units, with its expanded uncertainty."""

    def own(parent: ET.Element, name: str, text: str) -> None:
        ET.SubElement(parent, f"{{{SI}}}{name}").text = text

    factor, offset, unit = d_si(number.unit, number.name)
    own(real, "value", repr(factor * number.value + offset))
    own(real, "unit", unit)
    if not number.std:
        return
    freedom = 1_000_000 if number.freedom is None else int(number.freedom)
    k = half_width(freedom)
    expanded = ET.SubElement(real, f"{{{SI}}}expandedUnc")
    own(expanded, "uncertainty", f"{k * factor * number.std:.6g}")
    own(expanded, "coverageFactor", f"{k:.4g}")
    own(expanded, "coverageProbability", "0.95")
    own(expanded, "distribution", "normal" if freedom >= NORMAL else "t")


def d_si(unit: str, name: str) -> tuple[float, float, str]:
    """Factor and offset to SI base units, and these as D-SI writes them, `\\metre\\tothe{2}`.

    UsageError where the unit of `name` is not known.
    """
    try:
        factor, dimension = units.size(unit or "1")
        offset = units.zero_point(unit) if unit else 0.0
    except CasestError:
        raise UsageError(
            f"the unit of {name} is {unit}, and a certificate needs one: say it when calibrating, "
            "--unit SIGNAL=UNIT"
        ) from None
    return factor, offset, _spelled({base: float(power) for base, power in dimension})


def _spelled(powers: Mapping[str, float]) -> str:
    words = []
    for base, word in BASES.items():
        power = powers.get(base)
        if power:
            words.append(f"\\{word}" + ("" if power == 1 else f"\\tothe{{{float(power):g}}}"))
    return "".join(words) or "\\one"
