"""Published calibrations with uncertainties: what casest gives beside what was printed.

Values are copied from the places named. Where only relative weights are given, standard deviations
are by the residual, as published; else by the stated uncertainties. `python studies/metrology.py`
writes studies/metrology.md; `make study-metrology`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import casest as c
from casest.estimate.certificate import certify
from casest.leastsquares.identifiability import identify
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.stated import at_true_values, stated_noise
from casest.solve.outcome import Outcome

HERE = Path(__file__).parent
DATA = Path(os.environ.get("CASEST_DATA", HERE.parents[1] / "shared" / "data")) / "certified"


@c.model
def line(x=c.signal("1"), y=c.signal("1"), *, a=c.param("1"), b=c.param("1", start=1.0)):
    """A straight line."""
    return c.Residual(measured=y, predicted=a + b * x)


@c.model
def thermometer(x=c.signal("1"), y=c.signal("1"), *, a=c.param("1"), b=c.param("1")):
    """Correction of a thermometer around 20 °C (JCGM 100, H.3)."""
    return c.Residual(measured=y, predicted=a + b * (x - 20))


@c.model
def approach(
    x=c.signal("1"),
    y=c.signal("1"),
    *,
    b1=c.param("1", start=1500.0),
    b2=c.param("1", start=-50.0),
    b3=c.param("1", start=-0.1),
):
    """ODRPACK's first example."""
    return c.Residual(measured=y, predicted=b1 + b2 * (c.exp(b3 * x) - 1) ** 2)


@c.model
def lorentz(
    x=c.signal("1"),
    y=c.signal("1"),
    *,
    b1=c.param("1", start=1000.0),
    b2=c.param("1", start=0.1),
    b3=c.param("1", start=3.8),
):
    """A peak."""
    return c.Residual(
        measured=y,
        predicted=b1 * b2 * b3 / c.sqrt((x**2 - b3**2) ** 2 + (b2 * x) ** 2),
    )


@c.model
def conic(
    v=c.signal(2, "1"),
    *,
    b1=c.param("1", start=-1.0),
    b2=c.param("1", start=-3.0),
    b3=c.param("1", start=0.09),
    b4=c.param("1", start=0.02),
    b5=c.param("1", start=0.08),
):
    """An ellipse (ODRPACK's implicit example)."""
    x, y = v[0] - b1, v[1] - b2
    return c.Residual(implicit=b3 * x**2 + 2 * b4 * x * y + b5 * y**2 - 1, unit="1")


@c.model
def dielectric(
    f=c.signal("1"),
    e=c.signal(2, "1"),
    *,
    b1=c.param("1", start=4.0),
    b2=c.param("1", start=2.0),
    b3=c.param("1", start=7.0),
    b4=c.param("1", start=0.4),
    b5=c.param("1", start=0.5),
):
    """ODRPACK's third example: a complex permittivity (Havriliak and Negami) over frequency."""
    w = c.exp(b4 * (c.log(2 * np.pi * f) - b3))
    real, imaginary = 1 + w * c.cos(np.pi * b4 / 2), w * c.sin(np.pi * b4 / 2)
    phi = c.atan2(imaginary, real)
    r = (b1 - b2) * (real**2 + imaginary**2) ** (-b5 / 2)
    return c.Residual(
        measured=e, predicted=c.vertcat(b2 + r * c.cos(b5 * phi), r * c.sin(b5 * phi))
    )


@c.model
def bounded(
    x=c.signal("1"),
    y=c.signal("1"),
    *,
    b1=c.param("1", start=2.0, bounds=(0, 10)),
    b2=c.param("1", start=0.5, bounds=(0, 0.9)),
):
    """ODRPACK95's simple example."""
    return c.Residual(measured=y, predicted=b1 * c.exp(b2 * x))


@c.model
def mitosis(
    x=c.signal("1"),
    y=c.signal("1"),
    *,
    b1=c.param("1", start=0.011, bounds=(0, 1000)),
    b2=c.param("1", start=0.0033, bounds=(0, 1000)),
    b3=c.param("1", start=8.7, bounds=(0, 1000)),
):
    """ODRPACK95's fourth example: how long M takes from 0 to x/2 (Zwolak and others 2001).

    dM/dt = b1·M + (b2 + b3·M²)(x − M); the integral of its inverse over M = x·s³/2, dense where M
    is slow, by Gauss and Legendre.
    """
    nodes, weights = np.polynomial.legendre.leggauss(40)
    time = 0.0
    for s, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        M, slope = x * s**3 / 2, 1.5 * x * s**2
        time += weight * slope / (b1 * M + (b2 + b3 * M**2) * (x - M))
    return c.Residual(measured=y, predicted=time)


@dataclass(frozen=True)
class Case:
    """Data, what is known of their noise, and what was published: values, stds, more by name."""

    name: str
    source: str
    model: c.Model
    data: dict[str, np.ndarray]
    noise: dict[str, np.ndarray]
    values: Sequence[str]
    stds: Sequence[str]
    covariance: str = ""
    chi_square: str = ""
    relative: bool = False
    correlation: str = ""


def of(text: str) -> np.ndarray:
    """Numbers of a text."""
    return np.array(text.split(), dtype=float)


def cases() -> list[Case]:
    """All of them."""
    iso = np.genfromtxt(DATA / "iso6143_example1.csv", delimiter=",", names=True)
    gum = np.loadtxt(DATA / "gum_h3.csv", delimiter=",", skiprows=1)
    ts = "ISO/TS 28037:2010"
    six = np.arange(1.0, 7.0)
    pearson = (
        of("0 .9 1.8 2.6 3.3 4.4 5.2 6.1 6.5 7.4"),
        of("5.9 5.4 4.4 4.6 3.5 3.7 2.8 2.8 2.4 1.5"),
    )
    weights = of("1000 1000 500 800 200 80 60 20 1.8 1"), of("1 1.8 4 8 20 20 70 70 100 500")
    rounded = (
        of(".03 .03 .04 .035 .07 .11 .13 .22 .74 1"),
        of("1 .74 .5 .35 .22 .22 .12 .12 .1 .04"),
    )
    first = of("0 0 5 7 7.5 10 16 26 30 34 34.5 100")
    second = of("1265 1263.6 1258 1254 1253 1249.8 1237 1218 1220.6 1213.8 1215.5 1212")
    exact = np.where((first == 0) | (first == 100), 1e-9, 1.0)
    ellipse = np.stack([
        of(".5 1.2 1.6 1.86 2.12 2.36 2.44 2.36 2.06 1.74 1.34 .9 -.28 -.78 -1.36 -1.9 -2.5 -2.88 "
           "-3.18 -3.44"),
        of("-.12 -.6 -1 -1.4 -2.54 -3.36 -4 -4.75 -5.25 -5.64 -5.97 -6.32 -6.44 -6.44 -6.41 -6.25 "
           "-5.88 -5.5 -5.24 -4.86"),
    ], axis=1)  # fmt: skip
    peak = of(
        "3.9094 3.85945 3.84976 3.84716 3.84551 3.83964 3.82608 3.78847 3.78163 3.72558 3.70274 "
        "3.6973 3.67373 3.65982 3.6562 3.62498 3.55525 3.41886"
    )
    height = of(
        "652 910.5 984 1000 1007.5 1053 1160.5 1409.5 1430 1122 957.5 920 777.5 709.5 698 578.5 "
        "418.5 275.5"
    )
    wide = of(
        ".000972971 .000948268 .000707632 .000706679 .000706074 .000703918 .000698955 .000456856 "
        ".000455207 .000662717 .000654619 .000652694 .000000859202 .00106589 .00106378 .00125483 "
        ".00140818 .00241839"
    )
    # Two frequencies have no weight, three are exact.
    frequency = 10 * of(
        "3 5 7 20 30 50 70 100 150 200 300 500 700 1000 1500 2000 3000 5000 7000 10000 15000"
    )
    permittivity = np.stack([
        of("4.22 4.167 4.132 3.956 3.884 3.784 3.713 3.633 3.54 3.433 3.358 3.258 3.193 3.128 "
           "3.059 2.984 2.934 2.876 2.838 2.798 2.759"),
        of(".136 .167 .188 .257 .276 .297 .309 .311 .314 .311 .305 .289 .277 .255 .24 .218 .202 "
           ".182 .168 .153 .139"),
    ], axis=1)  # fmt: skip
    weight = np.array([[559.6, -1634], [-1634, 8397]])
    return [
        Case("both uncertain, 3 gases", "ISO 6143:2001, example 1", line,
             {"x": iso["y"], "y": iso["x"]}, {"x": iso["u_y"], "y": iso["u_x"]},
             ["-0.35747", "24.6115"], ["0.15713", "0.48036"], "-0.05689", "0.6743"),
        Case("thermometer", "JCGM 100:2008, H.3", thermometer, {"x": gum[:, 0], "y": gum[:, 1]},
             {"y": np.ones(len(gum))}, ["-0.1712", "0.00218"], ["0.0029", "0.00067"],
             correlation="-0.930", relative=True),
        Case("equal uncertainties", f"{ts}, clause 6 (1)", line,
             {"x": six, "y": of("3.3 5.6 7.1 9.3 10.7 12.1")}, {"y": np.full(6, 0.5)},
             ["1.867", "1.757"], ["0.465", "0.120"], "-0.050", "1.665"),
        Case("unequal uncertainties", f"{ts}, clause 6 (2)", line,
             {"x": six, "y": of("3.2 4.3 7.6 8.6 11.7 12.8")}, {"y": of(".5 .5 .5 1 1 1")},
             ["0.885", "2.057"], ["0.530", "0.178"], "-0.082", "4.131"),
        Case("both uncertain", f"{ts}, clause 7", line,
             {"x": of("1.2 1.9 2.9 4.0 4.7 5.9"), "y": of("3.4 4.4 7.2 8.5 10.8 13.5")},
             {"x": np.full(6, 0.2), "y": of(".2 .2 .2 .4 .4 .4")},
             ["0.5788", "2.1597"], ["0.4764", "0.1355"], "-0.0577", "2.743"),
        Case("Pearson's line, York's weights", "Neri et al., J. Phys. E 22 (1989) 215", line,
             dict(zip("xy", pearson, strict=True)),
             {n: 1 / np.sqrt(w) for n, w in zip("xy", weights, strict=True)},
             ["5.47991022", "-0.480533407"], [], "", "11.86635319"),
        Case("Pearson's line, rounded weights", "SciPy 1.17, odr, test_pearson", line,
             dict(zip("xy", pearson, strict=True)), dict(zip("xy", rounded, strict=True)),
             ["5.476740", "-0.479608"], ["0.359012", "0.070629"], relative=True),
        Case("a curve, three x exact", "ODRPACK guide (1992), example 1", approach,
             {"x": first, "y": second}, {"x": exact, "y": np.ones(12)},
             ["1264.654805", "-54.018410", "-0.087850"], ["1.034927", "1.583998", "0.006332"],
             relative=True),
        Case("an ellipse, implicit", "ODRPACK guide (1992), example 2", conic, {"v": ellipse},
             {"v": np.full((20, 2), 0.0767)},  # the published residual's
             ["-0.999381", "-2.931048", "0.087573", "0.016230", "0.079754"],
             ["0.111384", "0.109767", "0.004106", "0.002750", "0.003496"], relative=True),
        Case("two responses, x known to a factor", "ODRPACK guide (1992), example 3", dielectric,
             {"f": frequency, "e": permittivity},
             {"f": np.where(frequency < 100, 1e-6, 100) * frequency,
              "e": np.linalg.inv(weight)[None]},
             ["4.37998803", "2.43330576", "8.00288459", "0.51011472", "0.51739023"],
             [], "0.0036160", "0.42053892"),
        Case("a peak", "SciPy 1.17, odr, test_lorentz", lorentz, {"x": peak, "y": height},
             {"x": wide, "y": np.full(18, 0.29)},
             ["1430.678085", "0.133905", "3.779819"], ["0.736212", "0.000351", "0.000245"],
             relative=True),
        Case("an exponential up to a bound", "ODRPACK95 1.00, simple_example", bounded,
             {"x": of(".982 1.998 4.978 6.01"), "y": of("2.7 7.4 148 403")},
             {"x": np.ones(4), "y": np.ones(4)}, ["1.63337057", "0.90000000"], [], "",
             "0.267368608", relative=True),
        Case("five times of mitosis", "ODRPACK95 1.00, drive4", mitosis,
             {"x": of(".15 .2 .25 .3 .5"), "y": of("55 45 40 30 20")},
             {"x": np.ones(5), "y": np.ones(5)},
             ["0.0136730609", "0.00204026365", "11.5908326"], [], "", "8.21894491e-4",
             relative=True),
    ]  # fmt: skip


def fitted(case: Case) -> c.Estimate:
    """The fit, refused or not."""
    data = {n: np.asarray(v, float).reshape(len(v), -1) for n, v in case.data.items()}
    run = c.Run.raw(case.name, data, units=dict.fromkeys(data, "1"))
    noise = {n: [u if u.ndim == 3 else u.reshape(len(u), -1)] for n, u in case.noise.items()}
    model, runs = stated_noise(case.model, [run], noise)
    return c.attempt(model, runs)


def row(case: Case) -> str:
    """One line of the table."""
    found = fitted(case)
    chi = found.noise.chi_square
    random = found.covariance - found.shift
    if case.relative:
        random = random * (found.noise.stated / found.noise.sigma) ** 2 * chi.times**2
    printed = dict(zip(found.values, map(float, case.values), strict=True))
    there = found.problem.point(printed)
    projected = at_true_values(found.problem, there)
    at_printed = 2 * projected.cost(there) / found.noise.stated**2
    said = [*zip(case.values, found.point.x, strict=True)]
    said += zip(case.stds, np.sqrt(np.diag(random)), strict=False)
    said += [(case.covariance, random[0, 1])] * bool(case.covariance)
    shared = random[0, 1] / np.sqrt(random[0, 0] * random[1, 1])
    said += [(case.correlation, shared)] * bool(case.correlation)
    said += [(case.chi_square, chi.value)] * bool(case.chi_square)
    more = f"{at_printed / chi.value - 1:+.1e} | {step_left(projected, there):.1e}"
    return line_of(case.name, case.source, said, more, found)


def step_left(problem: Problem, there: Point) -> float:
    """What the certificate says of a point as it is: the step left, in standard deviations."""
    claimed = Outcome("published", there, problem.cost(there), 1, 1, True, "", 0.0)
    sigma = float(np.sqrt(2 * claimed.cost / (problem.residual_count - problem.unknowns)))
    known = identify(problem, there)
    return certify(problem, claimed, (), known, problem.factor(there), sigma).step


def line_of(
    name: str, source: str, said: Sequence[tuple[str, float]], there: str, found: c.Estimate
) -> str:
    """What was printed beside what casest gives, as a line of the table."""
    pairs = [(p, _alike(p, v)) for p, v in said]
    equal = sum(p == v for p, v in pairs)
    others = "; ".join(f"{v} for {p}" for p, v in pairs if p != v)
    trusted = "yes" if found.certificate.trusted else "no: " + found.certificate.reasons[0]
    return (
        f"| {name} | {source} | {equal} of {len(pairs)} | {others or '–'} | {there} | {trusted} |"
    )


@c.model
def gauge_block(
    reading=c.signal("nm"),
    *,
    length=c.param("nm", start=5e7),
    standard=c.constant(50_000_623, "nm", std=25, freedom=18),
    repeated=c.constant(215, "nm", std=5.8, freedom=24),
    accidental=c.constant(0, "nm", std=3.9, freedom=5),
    systematic=c.constant(0, "nm", std=6.7, freedom=8),
    expansion=c.constant(11.5e-6, "1/K", std=1.2e-6),
    warmth=c.constant(-0.1, "K", std=0.41),
    unlike=c.constant(0, "1/K", std=0.58e-6, freedom=50),
    colder=c.constant(0, "K", std=0.029, freedom=2),
):
    """A gauge block beside a standard; the comparator's reading and all else are inputs."""
    difference = repeated + accidental + systematic
    told = standard + difference - standard * (unlike * warmth + expansion * colder)
    return c.Residual(measured=reading, predicted=length - told)


def gauge() -> str:
    """GUM H.1: standard uncertainty to first order, effective degrees of freedom, both printed."""
    run = c.Run.raw("H.1", {"reading": np.zeros((1, 1))}, units={"reading": "nm"})
    model, runs = stated_noise(gauge_block, [run], {"reading": [np.full(1, 1e-3)]})
    found = c.attempt(model, runs)
    said = [("50000838", float(found.values["length"])), ("32", float(found.std["length"])),
            ("16", float(found.effective_freedom[0]))]  # fmt: skip
    return line_of("gauge block", "JCGM 100:2008, H.1", said, "– | –", found)


@c.model
def impedance(
    V=c.signal("V"),
    current=c.signal("A"),
    phase=c.signal("rad"),
    *,
    R=c.param("ohm", start=100.0),
    X=c.param("ohm", start=100.0),
):
    """Resistance and reactance from voltage, current and phase."""
    parts = c.vertcat(V * c.cos(phase) - R * current, V * c.sin(phase) - X * current)
    return c.Residual(implicit=parts, unit="V")


def alternating() -> str:
    """GUM H.2: five sets of three readings, whose means are correlated; |Z| follows from both."""
    sets = np.stack([
        of("5.007 4.994 5.005 4.990 4.999"),
        of(".019663 .019639 .019640 .019685 .019678"),
        of("1.0456 1.0438 1.0468 1.0428 1.0433"),
    ])  # fmt: skip
    data = {n: m.reshape(1, 1) for n, m in zip(impedance.symbols, sets.mean(axis=1), strict=False)}
    run = c.Run.raw("H.2", data, units={"V": "V", "current": "A", "phase": "rad"})
    noise = {"V,current,phase": [np.cov(sets)[None] / 5]}
    found = c.attempt(*stated_noise(impedance, [run], noise))
    size = np.hypot(*found.point.x)
    slope = np.vstack([np.eye(2), found.point.x / size])
    covariance = slope @ found.covariance @ slope.T
    std = np.sqrt(np.diag(covariance))
    shared = covariance / np.outer(std, std)
    values = [*found.point.x, size]
    printed = ["127.732", "219.847", "254.260"], ["0.071", "0.295", "0.236"]
    said = [*zip(printed[0], values, strict=True), *zip(printed[1], std, strict=True)]
    said += [("-0.588", shared[0, 1]), ("-0.485", shared[0, 2]), ("0.993", shared[1, 2])]
    return line_of("resistance and reactance", "JCGM 100:2008, H.2", said, "– | –", found)


def _alike(printed: str, value: float) -> str:
    """The value with as many decimals as were printed."""
    return f"{value:.{len(printed.partition('.')[2])}f}"


HEAD = """# Published calibrations with uncertainties

Made by `make study-metrology` (`studies/metrology.py`). Every printed digit of values, standard
uncertainties, covariance and χ² counts: what was published beside what casest gives. "χ² there"
is that at the printed values over casest's least, less one (true values projected): of digits that
were rounded it is a little more than zero; below zero casest's would be no minimum. "Step there" is
what casest's certificate says of the printed values: how many standard deviations they are from
where the cost leads; it believes nothing beyond 1e-4, and rounded digits have up to 0.008.
ODRPACK's examples stop at half of the digits that a double has. Of the ellipse casest takes off the
mean that curvature gives a residual, which ODRPACK does not: hence other values, by fractions of
their standard deviations.

**Two answers that ODRPACK95 publishes with its examples are no minima**, and the certificate says
so. Of the exponential it reports "sum of squares convergence" at b1 = 1.633, b2 on its bound, with
a χ² of 0.267; at b1 = 1.440 it is 0.192 (SciPy's `least_squares` finds the same, `pytest
tests/test_metrology.py`). The times of mitosis end at its limit of 20 iterations, half a percent
above the least. Neither fit is trusted at the minimum either: the bound contradicts the first
record, and the second hardly determines its constants.

GUM H.1 and H.2 evaluate a measurement equation: fits without freedom, of one row, whose inputs are
constants with standard uncertainties and degrees of freedom (H.1; 16 are the effective ones), or
signals whose noise is stated together (H.2). H.4 and H.5 are no fits: no cases here. ISO 6143
example 2 and the other clauses of ISO/TS 28037 could not be had with their digits. Of NIST's
Uncertainty Machine no example was tried.

Of H.2 the GUM prints 0.295 for u(X). Its first way, first order from the means, gives 0.29558 from
all digits of the readings (0.29572 from the rounded ones of its Table H.2); its second way, X of
each of the five sets and the scatter of those, gives 0.29549. The GUM prints that for both; casest
goes the first way (`pytest tests/test_metrology.py`).

| case | published in | digits equal | casest for the published | χ² there | step there | trusted |
| --- | --- | --- | --- | --- | --- | --- |
"""


def main() -> None:
    """Write the table."""
    rows = [gauge(), alternating(), *(row(case) for case in cases())]
    (HERE / "metrology.md").write_text(HEAD + "\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
