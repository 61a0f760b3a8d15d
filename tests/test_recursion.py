"""Steps that follow one another: as in a plain loop, the same digits compiled or replayed."""

from __future__ import annotations

import shutil

import casadi as ca
import numpy as np
import pytest

from casest.engine import Recursion, recursion


def pendulum():
    """(angle and rate; torque and time) -> (after it; its energy), a symplectic step."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    rate = x[1] + u[1] * (u[0] - ca.sin(x[0]))
    angle = x[0] + u[1] * rate
    energy = 0.5 * rate**2 - ca.cos(angle)
    return Recursion(ca.Function("step", [x, u], [ca.vertcat(angle, rate), energy]))


def by_loop(state, numbers):
    found, energies = [], []
    angle, rate = state
    for torque, h in numbers:
        rate = rate + h * (torque - np.sin(angle))
        angle = angle + h * rate
        found.append((angle, rate))
        energies.append(0.5 * rate**2 - np.cos(angle))
    return np.array(found), np.array(energies)[:, None]


def given(count):
    rng = np.random.default_rng(0)
    return np.array([0.3, -0.1]), np.c_[0.1 * rng.standard_normal(count), np.full(count, 0.01)]


@pytest.fixture(params=["replayed", "compiled", "no compiler"])
def way(request, monkeypatch, tmp_path):
    if request.param == "compiled" and not any(map(shutil.which, ("cc", "gcc", "clang"))):
        pytest.skip("no C compiler")
    monkeypatch.setenv("CASEST_KERNEL", "off" if request.param == "replayed" else "always")
    monkeypatch.setenv("CASEST_CACHE", str(tmp_path))
    if request.param == "no compiler":
        monkeypatch.setenv("CC", "no-such-compiler")
    return request.param


@pytest.mark.parametrize("count", [1, 499, 500, 501, 1700])
def test_every_step_is_that_of_a_plain_loop(way, count):
    state, numbers = given(count)
    after, energy = pendulum()(state, numbers)
    expected = by_loop(state, numbers)
    np.testing.assert_allclose(after, expected[0], rtol=1e-12)
    np.testing.assert_allclose(energy, expected[1], rtol=1e-12)


def test_states_need_not_be_kept(way):
    state, numbers = given(1200)
    whole, brief = pendulum()(state, numbers), pendulum()(state, numbers, keep=False)
    np.testing.assert_array_equal(brief[1], whole[1])


def test_compiled_steps_give_the_digits_of_replayed_ones(monkeypatch, tmp_path):
    monkeypatch.setenv("CASEST_CACHE", str(tmp_path))
    state, numbers = given(3000)
    both = []
    for wish in ("always", "off"):
        monkeypatch.setenv("CASEST_KERNEL", wish)
        both.append(pendulum()(state, numbers))
    for one, other in zip(*both, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_compiler_is_asked_once_much_has_been_replayed(monkeypatch, tmp_path):
    monkeypatch.setenv("CASEST_CACHE", str(tmp_path))
    monkeypatch.setenv("CASEST_KERNEL", "auto")
    monkeypatch.setattr(recursion, "WORTHWHILE", 2500)
    step, (state, numbers) = pendulum(), given(1000)
    made = []
    for _ in range(3):
        step(state, numbers)
        made.append(len(list(tmp_path.glob("*.so"))))
    assert made[:2] == [0, 0]
    assert made[2] == (1 if any(map(shutil.which, ("cc", "gcc", "clang"))) else 0)
