"""GUM H.2: why 0.295 is printed where first order gives 0.296."""

from __future__ import annotations

import numpy as np
import pytest

import casest as c
from casest.leastsquares.stated import stated_noise

#: Table H.2 of JCGM 100:2008: voltage (V), current (A), phase (rad) of five sets.
SETS = np.array([
    [5.007, 4.994, 5.005, 4.990, 4.999],
    [0.019663, 0.019639, 0.019640, 0.019685, 0.019678],
    [1.0456, 1.0438, 1.0468, 1.0428, 1.0433],
])  # fmt: skip


@c.model
def reactance(
    V=c.signal("V"), current=c.signal("A"), phase=c.signal("rad"), *, X=c.param("ohm", start=100.0)
):
    """X = V sin(phase) / current."""
    return c.Residual(implicit=V * c.sin(phase) - X * current, unit="V")


def test_the_printed_digit_is_that_of_the_second_way_and_casest_goes_the_first():
    each = SETS[0] * np.sin(SETS[2]) / SETS[1]
    second = np.std(each, ddof=1) / np.sqrt(5)  # H.2.4: the scatter of five values of X
    V, current, phase = SETS.mean(axis=1)
    slope = np.array([np.sin(phase), -V * np.sin(phase) / current, V * np.cos(phase)]) / current
    covariance = np.cov(SETS) / 5
    first = np.sqrt(slope @ covariance @ slope)  # H.2.3: from the means
    assert (f"{first:.5f}", f"{second:.5f}") == ("0.29558", "0.29549")
    data = {
        n: np.array([[m]]) for n, m in zip(("V", "current", "phase"), SETS.mean(1), strict=True)
    }
    run = c.Run.raw("H.2", data, units={"V": "V", "current": "A", "phase": "rad"})
    found = c.attempt(*stated_noise(reactance, [run], {"V,current,phase": [covariance[None]]}))
    assert float(found.std["X"]) == pytest.approx(first, rel=1e-6)
