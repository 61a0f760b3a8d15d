"""Where a shift of a sensor's reading came and went: edges of pulses and moments of steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from casest import Run, close
from casest.diagnose.candidates.grid import Seen, Shifts, searched
from casest.diagnose.evidence.linear import Linear, parts_of
from casest_problems.norm import norm_triangular


def problem(n=200, axes=2, unknowns=4, seed=7):
    """Residuals, slopes in some unknowns and in a shift of three numbers, all at random."""
    rng = np.random.default_rng(seed)
    residual, slopes = rng.standard_normal((n, axes)), rng.standard_normal((n, axes, unknowns))
    zeros, inputs = np.zeros(n, int), rng.standard_normal((n, 1))
    linear = Linear(residual, slopes, (), parts_of(np.arange(n), zeros, inputs))
    shift = rng.standard_normal((n, axes, 3))
    return Seen(np.einsum("nmq,nm->nq", shift, residual), None, np.arange(n) / 10, linear, shift)


@pytest.mark.parametrize(("a", "b"), [(0, 200), (20, 90), (150, 200), (77, 85)])
def test_what_a_shift_takes_is_what_least_squares_say(a, b):
    seen = problem()
    r = seen.linear.residual.ravel()
    J = seen.linear.slopes.reshape(r.size, -1)
    inside = ((np.arange(200) >= a) & (np.arange(200) < b))[:, None, None]
    both = np.hstack([J, (seen.shift * inside).reshape(r.size, -1)])
    without, beside = (np.linalg.lstsq(x, r, rcond=None)[1][0] for x in (J, both))
    found = Shifts(seen).gain(np.array([a]), np.array([b]))
    np.testing.assert_allclose(found, without - beside, rtol=5e-3)  # of what it hardly sees less


def test_where_the_declared_unknowns_do_the_same_no_shift_is_seen():
    seen = problem(axes=3)
    n = len(seen.time)
    linear = Linear(seen.linear.residual, seen.shift, (), seen.linear.parts)
    same = Seen(seen.push, None, seen.time, linear, seen.shift)
    assert Shifts(same).gain(np.array([0]), np.array([n]))[0] < 1e-6


def turned(n, jump, seed):
    """A magnetometer of equal gains turned about; a magnet beside it for a fifth of the time."""
    rng = np.random.default_rng(seed)
    field = gaussian_filter1d(rng.standard_normal((n, 3)), 12, axis=0)
    field *= 48 / np.linalg.norm(field, axis=1)[:, None]
    there = slice(int(0.55 * n), int(0.75 * n))
    reading = field + [12.0, -20.0, 5.0] + 0.2 * rng.standard_normal((n, 3))
    reading[there] += np.asarray(jump)
    return reading, there


@pytest.mark.long
@pytest.mark.parametrize(("jump", "within"), [((1.5, 5.5, 5.6), 0.06), ((0.3, -0.2, 0.4), 0.75)])
def test_a_magnet_that_comes_and_goes_is_found_in_the_length_of_the_field(jump, within):
    """Also one of 40 standard deviations, which the declared fit is spoilt by.

    Of a weak one the edges are less sharp while it lies across the field: half a turn, 0.75 s.
    """
    reading, there = turned(1000, jump, seed=2)
    run = Run.raw("turned", {"v": reading}, units={"v": "uT"}, time=np.arange(1000) / 20)
    closing = close(norm_triangular.having(norm=48.0), [run])
    assert [e.candidate.label for e in closing.effects] == ["pulse"]
    values, std = closing.after.values, closing.after.std
    told = dict(closing.effects[0].candidate.effect.declarations)
    edges = [told[name].value[0] for name in ("start", "stop")]
    np.testing.assert_allclose(edges, [there.start / 20, there.stop / 20], atol=within)
    off = np.abs(values["offset"] - [12, -20, 5]) / std["offset"]
    assert off.max() < 4


def test_a_step_is_looked_for_where_it_is():
    rng = np.random.default_rng(1)
    r = rng.standard_normal((600, 1))
    r[400:] += 1.5
    linear = Linear(r, np.ones((600, 1, 1)), (), problem(600).linear.parts)
    moments, _ = searched(("time",), Seen(-r, None, np.arange(600.0), linear))
    assert min(abs(m - 399.5) for (m,) in moments) < 3
