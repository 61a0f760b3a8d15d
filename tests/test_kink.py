"""Least costs with a kink: proved by the slopes around them, against a search by brute force."""

from __future__ import annotations

import numpy as np
import pytest

from casest import Residual, Run, close, if_else, model, param, signal
from casest.estimate.calibrate import attempt
from casest.estimate.kink import at_kink, left_at_kink
from casest.results.closing import closing_result

WEIGHTS = np.linspace(0, 8, 60)


@model
def spring(
    x=signal(), y=signal(), *, length=param(), rate=param(start=4.0), least=param(start=0.8)
):
    """Nothing gives below the least weight."""
    return Residual(measured=y, predicted=length + rate * if_else(x > least, x - least, 0.0))


def record(seed):
    rng = np.random.default_rng([20261128, seed])
    y = 0.6 + 5.1 * np.maximum(WEIGHTS - 1.1, 0) + 0.2 * rng.standard_normal(60)
    return Run.raw("spring", {"x": WEIGHTS[:, None], "y": y[:, None]}, units={})


def squares(run, least):
    """Least sum of squares with this threshold, by NumPy."""
    y = run.signals["y"][:, 0]
    A = np.stack([np.ones(60), np.maximum(WEIGHTS - least, 0)], axis=1)
    left = y - A @ np.linalg.lstsq(A, y, rcond=None)[0]
    return float(left @ left)


@pytest.fixture(scope="module")
def fits():
    return [(run, attempt(spring, [run])) for run in map(record, range(60))]


@pytest.mark.long
def test_a_kink_is_found_and_proved_where_no_threshold_around_fits_better(fits):
    kinks = 0
    for run, found in fits:
        assert found.certificate.trusted
        best = float(found.values["least"])
        kinks += "kink" in found.certificate.reasons[0]
        around = best + np.concatenate([np.linspace(-0.3, 0.3, 601), [-1e-7, 1e-7]])
        least = min(squares(run, w) for w in around)
        assert squares(run, best) <= least + 1e-4 * found.noise.sigma**2
        row = np.min(np.abs(WEIGHTS - best)) < 1e-5
        assert row == ("kink" in found.certificate.reasons[0])
    assert kinks >= 1  # one in thirty or so


@pytest.mark.long
def test_intervals_of_thresholds_hold_the_truth(fits):
    inside = []
    for _, found in fits:
        low, high = (float(side["least"]) for side in found.interval_reach)
        inside.append(-high <= float(found.values["least"]) - 1.1 <= low)
    assert np.mean(inside) >= 0.87


def test_what_is_no_least_cost_is_not_proved(fits):
    for _, found in fits[:10]:
        sigma = found.noise.sigma
        for away in (-0.3, 0.3):
            values = {n: float(v) for n, v in found.values.items()}
            point = found.problem.point({**values, "least": values["least"] + away})
            assert left_at_kink(found.problem, point, sigma) is None


@model
def roof(x=signal(), y=signal(), *, a=param(start=0.0)):
    """The residual grows towards a = 0 from both sides: a kink that is a largest cost."""
    return Residual(measured=y, predicted=x * (2.0 - if_else(a > 0, a, -a)))


def test_a_largest_cost_with_a_kink_is_not_proved():
    x = np.linspace(1, 2, 20)[:, None]
    run = Run.raw("roof", {"x": x, "y": 0.5 * x}, units={})
    found = attempt(roof, [run], start={"a": 1.0}).problem
    point = found.point({"a": 0.0})
    assert left_at_kink(found, point, 1.0) is None
    assert at_kink(found, point, 1.0) is None


def test_a_threshold_beyond_which_all_lies_is_said_to_be_an_offset(tmp_path):
    """A distance counted from a plane 200 mm off: of a lens, reading base + k / distance."""
    (tmp_path / "lens.py").write_text(
        "from casest import Residual, model, param, quantity, signal\n\n\n@model\n"
        'def lens(d=signal("mm"), y=signal("V"), *, base=param("V"), k=param("V*mm", start=9.0)):\n'
        '    """An encoder behind a lens."""\n'
        '    far = quantity("far", d, "mm")\n'
        "    return Residual(measured=y, predicted=base + k / far, corrected=far)\n"
    )
    rng = np.random.default_rng(4)
    d = np.linspace(340, 660, 60)
    y = 1 + 900 / (d - 200) + 0.002 * rng.standard_normal(60)
    found = close(str(tmp_path / "lens.py"), {"d": d, "y": y})
    result = closing_result(found, model_name="lens", data=[])
    assert [e.name for e in result.effects] == ["dead_band"]
    (note,) = (n for n in result.notes if "lies beyond the width" in n)
    assert note.startswith("all of far lies beyond the width of dead_band, on one side: there")
    assert float(note.rpartition(" ")[2]) == pytest.approx(200, abs=5)
