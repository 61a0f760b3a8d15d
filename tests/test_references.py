"""References that are not exact: carried into every value, as refits with moved ones show."""

from __future__ import annotations

import json

import numpy as np
import pytest

import casest as c
from casest.cli import run
from casest.cli.values import parse_value
from casest.demo import RECORD
from casest.results.earlier import earlier_result
from casest_problems.norm import norm_triangular

GIVEN = ["--columns", "v=ax,ay,az", "--rate", "50", "--at-rest"]


@pytest.fixture
def cli(capsys):
    def command(*words):
        code = run([str(word) for word in words])
        return code, *capsys.readouterr()

    return command


@pytest.fixture(scope="module")
def rests():
    columns = {"v": ("ax", "ay", "az")}
    return c.load_runs([RECORD], norm_triangular.signals, columns=columns, rate=50, at_rest=True)


def fitted(rests, **known):
    return c.calibrate(norm_triangular.having(**known), rests)


def test_values_follow_a_reference_as_refits_with_another_one_do(rests):
    found = fitted(rests, norm=c.constant(9.80665, "m/s^2", std=0.005))
    ends = [fitted(rests, norm=9.80665 + h).point.x for h in (1e-4, -1e-4)]
    assert found.inputs.sensitivity[:, 0] == pytest.approx((ends[0] - ends[1]) / 2e-4, abs=1e-7)


def test_what_a_reference_adds_is_common_to_all_values_that_follow_it(rests):
    exact = fitted(rests, norm=9.80665)
    found = fitted(rests, norm=c.constant(9.80665, "m/s^2", std=0.005))
    slope = (fitted(rests, norm=9.80765).point.x - exact.point.x) / 1e-3
    added = found.covariance - exact.covariance
    assert added == pytest.approx(0.005**2 * np.outer(slope, slope), rel=1e-4, abs=1e-12)
    assert found.point.x == pytest.approx(exact.point.x, rel=1e-12)


def test_a_well_known_reference_gives_the_interval_of_a_normal_distribution(rests):
    """Welch and Satterthwaite: what dominates is known exactly, and Student's t becomes 1.96."""
    found = fitted(rests, norm=c.constant(9.80665, "m/s^2", std=0.5))
    reach = found.interval_reach[1]["scale"][0, 0]
    assert reach / found.std["scale"][0, 0] == pytest.approx(1.959964, rel=1e-4)


@pytest.mark.parametrize(
    "text",
    [
        "9.80665±0.0005 m/s^2",
        "9.80665 +- 0.0005 m/s^2",
        "9.80665 m/s^2 +/- 0.0005",
        "9.80665 m/s^2 ± 0.5 mm/s^2",
        "1 g ± 0.0005 m/s^2",
        "9.80665 m/s^2 ± 0.00509858106488964%",
        "1 g ± 0.05098581064889641 mg",
    ],
)
def test_a_standard_uncertainty_is_written_behind_its_value(text):
    model = norm_triangular.having(norm=c.constant(9.80665, "m/s^2"))
    found = model.having(norm=parse_value("norm", text, "--set", norm_triangular))["norm"]
    factor = 9.80665 if found.unit == "g" else 1.0
    assert found.array * factor == pytest.approx(9.80665, rel=1e-15)
    assert found.std * factor == pytest.approx(0.0005, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("9.8±", "write VALUE±STD, as in 9.80665±0.0005 m/s^2"),
        ("9.8±wide", "behind ± is 'wide', and not a number with a unit"),
        ("9.8±0 m/s^2", "must be above zero: leave it away for an exact value"),
        ("9.8±-0.1 m/s^2", "must be above zero"),
        ("9.8±0.1±0.1", "write VALUE±STD"),
        ("9.8 m/s^2±0.1 kg", "kg"),
    ],
)
def test_an_uncertainty_that_is_none_is_refused(cli, text, said):
    code, _, err = cli("calibrate", "norm-triangular", RECORD, *GIVEN, "--set", f"norm={text}")
    assert code == 1
    assert said in err
    assert err.count("\n") == 1


def test_a_declared_uncertainty_that_is_none_is_refused():
    with pytest.raises(c.DeclarationError, match="must be above zero"):
        c.constant(0.28, "m", std=-0.001)
    with pytest.raises(c.DeclarationError, match=r"has shape \(2,\), the value has \(3,\)"):
        c.constant([1, 2, 3], "m", std=[1, 2])


def test_the_result_says_which_share_a_reference_has(cli, tmp_path):
    given = ["norm-triangular", RECORD, *GIVEN, "--set", "norm=9.80665±0.005 m/s^2"]
    code, out, _ = cli("calibrate", *given, "-o", tmp_path)
    estimate = json.loads((tmp_path / "result.json").read_text())["estimate"]
    (norm,) = [i for i in estimate["inputs"] if i["kind"] == "reference"]
    assert code == 0
    assert "norm = 9.80665 ± 0.005 m/s^2 (held; up to" in out
    assert (norm["name"], norm["std"], norm["unit"]) == ("norm", 0.005, "m/s^2")
    shown = estimate["covariance"]
    std = dict(zip(shown["names"], np.sqrt(np.diag(shown["matrix"])), strict=True))
    assert std["scale[1,0]"] == pytest.approx(estimate["parameters"]["scale"]["std"][1][0])
    added = (norm["sensitivity"]["scale[0,0]"] * 0.005 / std["scale[0,0]"]) ** 2
    assert norm["share"]["scale[0,0]"] == pytest.approx(added, rel=1e-9)


def test_what_is_held_from_an_earlier_result_is_as_uncertain_as_it_was_found(cli, tmp_path, rests):
    code, _, _ = cli(
        "calibrate", "norm-triangular", RECORD, *GIVEN, "--set", "norm=9.80665", "-o", tmp_path
    )
    assert code == 0
    lab = earlier_result(str(tmp_path), norm_triangular)
    held = fitted(rests, norm=9.80665, scale=lab.constant("scale"))
    exact = fitted(rests, norm=9.80665, scale=lab.values["scale"])
    shown = json.loads((tmp_path / "result.json").read_text())["estimate"]["covariance"]
    slopes = []
    for i, j in norm_triangular["scale"].shape.entries:
        moved = lab.values["scale"].copy()
        moved[i, j] += 1e-5
        slopes.append((fitted(rests, norm=9.80665, scale=moved).point.x - exact.point.x) / 1e-5)
    carried = np.array(slopes).T @ np.array(shown["matrix"])[:6, :6] @ np.array(slopes)
    assert held.covariance == pytest.approx(exact.covariance + carried, rel=1e-3, abs=1e-11)


def test_a_covariance_that_no_numbers_can_have_is_refused(cli, tmp_path):
    code, _, _ = cli(
        "calibrate", "norm-triangular", RECORD, *GIVEN, "--set", "norm=9.80665", "-o", tmp_path
    )
    file = tmp_path / "result.json"
    saved = json.loads(file.read_text())
    matrix = saved["estimate"]["covariance"]["matrix"]
    matrix[0][1] = matrix[1][0] = 2 * np.sqrt(matrix[0][0] * matrix[1][1])
    file.write_text(json.dumps(saved))
    again = ["--set", "norm=9.80665", "--fix", f"scale=@{file}"]
    code, _, err = cli("calibrate", "norm-triangular", RECORD, *GIVEN, *again)
    assert code == 1
    assert "the correlations are not positive semidefinite" in err


@c.model
def gauge_block(
    reading=c.signal("nm", std=1e-3),
    *,
    length=c.param("nm", start=5e7),
    standard=c.constant(50_000_623, "nm", std=25, freedom=18),
    repeated=c.constant(215, "nm", std=5.8, freedom=24),
    accidental=c.constant(0, "nm", std=3.9, freedom=5),
    systematic=c.constant(0, "nm", std=6.7, freedom=8),
    warmth=c.constant(-0.1, "K", std=0.41),
    unlike=c.constant(0, "1/K", std=0.58e-6, freedom=50),
    colder=c.constant(0, "K", std=0.029, freedom=2),
):
    """JCGM 100:2008, H.1, with an expansion of 11.5e-6 per kelvin."""
    told = standard + repeated + accidental + systematic
    return c.Residual(
        measured=reading,
        predicted=length - told + standard * (unlike * warmth + 11.5e-6 * colder),
    )


def test_the_gauge_block_of_the_gum_has_its_uncertainty_and_16_degrees_of_freedom():
    found = c.calibrate(gauge_block, {"reading": [0.0]})
    assert float(found.values["length"]) == pytest.approx(50_000_838, abs=0.01)
    assert round(float(found.std["length"])) == 32
    assert found.effective_freedom == (16,)
    (low, high) = (float(side["length"]) for side in found.interval_reach)
    assert (low, high) == pytest.approx((2.119905 * 31.7, 2.119905 * 31.7), rel=2e-3)


def test_degrees_of_freedom_of_what_is_exact_are_refused():
    with pytest.raises(c.DeclarationError, match="is that of a std, and there is none"):
        c.constant(1.0, "m", freedom=5)
    with pytest.raises(c.DeclarationError, match="degrees of freedom are above zero"):
        c.constant(1.0, "m", std=0.1, freedom=0)
