"""Loops over samples in C and in lanes: the same as one after the other, whatever the compiler."""

import casadi as ca
import numpy as np
import pytest

from casest.engine import Recursion, chained, stretches
from casest.engine.chain import _in_stretches
from casest.engine.kernel import compiles

needs_a_compiler = pytest.mark.skipif(not compiles(), reason="no compiler here")


def one_by_one(M, b, first):
    found = [first]
    for own, pushed in zip(M, b, strict=True):
        found.append(own @ found[-1] + pushed)
    return np.array(found)


@pytest.mark.parametrize("kernel", ["off", pytest.param("always", marks=needs_a_compiler)])
@pytest.mark.parametrize("size", [(1, 1, 1), (50, 4, 1), (401, 9, 7)])
def test_a_chain_of_steps_is_that_of_numpy_step_by_step(kernel, size, monkeypatch):
    monkeypatch.setenv("CASEST_KERNEL", kernel)
    count, n, p = size
    rng = np.random.default_rng(count)
    M, b = 0.3 * rng.standard_normal((count, n, n)), rng.standard_normal((count, n, p))
    first = rng.standard_normal((n, p))
    expected = one_by_one(M, b, first)
    np.testing.assert_allclose(chained(M, b, first), expected, rtol=1e-12, atol=1e-13)
    # Views that run backwards, and turned ones, as a filter's adjoint hands them over.
    turned = chained(M[::-1].transpose(0, 2, 1), b[::-1], first)
    assert np.allclose(turned, one_by_one(M[::-1].transpose(0, 2, 1), b[::-1], first), 1e-12)
    np.testing.assert_allclose(_in_stretches(M, b, first), expected, rtol=1e-12, atol=1e-13)


def step(with_sine):
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    pushed = ca.fmax(x[0], u[0]) / (2 + x[1] ** 2)
    kept = ca.if_else(x[2] > u[1], x[2] / 3, -0.5 * x[0])
    bent = ca.sin(x[1]) if with_sine else x[1] - 0.25 * x[0]
    later = ca.vertcat(0.5 * pushed, bent, kept + 1e-3)
    return ca.Function("step", [x, u], [later, ca.vertcat(pushed, kept), x[0] * u[0]])


@needs_a_compiler
@pytest.mark.parametrize("with_sine", [False, True])
@pytest.mark.parametrize("several", [2, 4, 5, 11])
def test_runs_in_lanes_have_the_digits_of_single_ones(with_sine, several, monkeypatch):
    """A step with a sine cannot be turned into lanes, and runs one by one."""
    rng = np.random.default_rng(several)
    states, numbers = rng.standard_normal((several, 3)), rng.standard_normal((70, 2))
    monkeypatch.setenv("CASEST_KERNEL", "off")
    expected = [Recursion(step(with_sine))(s, numbers, keep=False) for s in states]
    monkeypatch.setenv("CASEST_KERNEL", "always")
    runs = Recursion(step(with_sine))
    found = runs.beside(states, numbers)
    (own,) = runs._beside.values()
    assert (own["library"] is None) == with_sine
    for own, other in zip(found, expected, strict=True):
        for a, b in zip(own, other, strict=True):
            assert np.array_equal(a, b)


@needs_a_compiler
@pytest.mark.parametrize("count", [63, 64, 71, 400])
def test_stretches_from_known_states_have_the_digits_of_the_whole(count, monkeypatch):
    """A record too short for lanes is run as a whole, too."""
    rng = np.random.default_rng(count)
    state, numbers = rng.standard_normal(3), rng.standard_normal((count + 3, 2))[3:]
    monkeypatch.setenv("CASEST_KERNEL", "off")
    expected = Recursion(step(False))(state, numbers)
    monkeypatch.setenv("CASEST_KERNEL", "always")
    runs, begin = Recursion(step(False)), stretches(count)
    assert len(begin) == (1 if count < 64 else 8)
    known = np.vstack([state, expected[0][begin[1:] - 1]])
    for a, b in zip(runs.along(known, [numbers]), expected, strict=True):
        assert np.array_equal(a, b)
    assert any(own["library"] for own in runs._beside.values()) == (len(begin) > 1)
