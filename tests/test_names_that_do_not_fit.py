"""What a refit found goes by another name: a kink in a smooth bend, a pulse that begins with the
record."""

from __future__ import annotations

import numpy as np
import pytest

import casest as c
from casest import close
from casest.diagnose.closing import Closing

N, STEP = 600, 0.1


def moved(seed: int) -> tuple[np.random.Generator, np.ndarray, np.ndarray]:
    """A generator, times, and a slow course through a range of ±2."""
    rng, t = np.random.default_rng(seed), STEP * np.arange(N)
    return rng, t, np.sin(0.9 * t) + np.sin(0.37 * t + 1)


def named(found: Closing) -> list[str]:
    return [e.candidate.label for e in found.effects]


@pytest.mark.parametrize("seed", range(3))
def test_a_smooth_bend_is_no_kink(seed):
    """Force on a pad that gets stiffer over 3 of 8 mm, from 200 to 2500 N/mm, without a corner."""
    rng, u = np.random.default_rng(seed), np.linspace(0, 8, 480)
    y = 200 * u + 2300 * np.log1p(np.exp(1.5 * (u - 4))) / 1.5 + 30 * rng.standard_normal(480)
    found = close("linear", {"reference": u, "reading": y})
    assert not {"floor", "saturation", "dead_band", "dead_zone"} & set(named(found))
    assert found.verdict == "unexplained"


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_kink_is_one(seed):
    rng, t, u = moved(seed)
    y = np.maximum(u, -0.7) + 0.02 * rng.standard_normal(N)
    assert named(close("linear", {"t": t, "reference": u, "reading": y})) == ["floor"]


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_shift_up_to_a_moment_is_a_step(seed):
    """Whatever else the first row does."""
    rng, t, u = moved(seed)
    y = 2 * u + 0.3 * (t > 35) + 0.05 * rng.standard_normal(N)
    y[0] += 0.4
    found = close("linear", {"t": t, "reference": u, "reading": y})
    assert "pulse" not in named(found)
    assert "bias_step" in named(found)


@c.model
def at_rest(s=c.signal(3, "nT"), *, level=c.param(3, "nT")):
    return c.Residual(measured=s, predicted=c.quantity("shown", level, "nT"))


@pytest.mark.parametrize("seed", [1, pytest.param(6, marks=pytest.mark.long)])
def test_what_a_constant_shows_is_bent_by_nothing(seed):
    """A sensor at rest that warms up and stays warm: its course ends in a corner, no reading does.
    Beside a parabola over the column a saturation had p = 5e-20 of a measured record."""
    rng, warm = np.random.default_rng(seed), np.linspace(0, 30, 900)
    course = 2 * np.minimum(warm, 18 + rng.uniform(-3, 3))
    level = np.array([8000.0, -18600.0, -31970.0]) + np.outer(course, [1, -1.2, -1])
    found = close(at_rest, {"s": level + 6 * rng.standard_normal((900, 3)), "warm": warm})
    assert named(found)[0] == "channel_curve(warm)"
    assert not {"floor", "saturation", "dead_band", "dead_zone"} & set(named(found))
