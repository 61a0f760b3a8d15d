"""Sums from atoms that the entries of J share are CasADi's; what would lose digits is refused."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casest.declaration.tracing import function_of
from casest.engine import Replay, factored, normal_equations
from casest.results.find import SHIPPED, find_model

#: Pedersini's Table I: offset, gain, misalignment, tilt, phase, speed.
SPINNING = [1, -1, 1, 0.9, 1, 1.1, *np.radians([30, 20, 25, 45, 30]), 9, -0.09, 5e-4, 2e-6]


def spun(count):
    """Times over 90 s, and any readings: they enter the residual alone."""
    readings = np.random.default_rng(1).normal(0, 10, (count, 3))
    return np.column_stack([np.linspace(0, 90, count), readings])


@pytest.fixture(autouse=True)
def always(monkeypatch):
    """No compiled kernel, and from the first sample on."""
    monkeypatch.setenv("CASEST_KERNEL", "off")
    monkeypatch.setattr(factored, "ENOUGH", 1)


@pytest.fixture
def at_any_price(monkeypatch):
    """Even where it takes more work than entry by entry."""
    monkeypatch.setattr(factored, "_WORTHWHILE", np.inf)


def function(p, s, r, J=None):
    J = ca.jacobian(r, p) if J is None else J
    return ca.Function("f", [p, s], [ca.densify(r), J], ["parameters", "sample"], ["r", "J"])


def of_model(name):
    t = find_model(name).traced
    J = ca.jacobian(t.expression, t.coordinates)
    return function_of(find_model(name), {"r": t.expression, "J": J})


def by_casadi(f, p, samples):
    """½ Σ r², Jᵀr and JᵀJ from CasADi's values of each sample, summed in extended precision."""
    r, J = (np.array(v).astype(np.longdouble) for v in f.map(len(samples))(p, samples.T))
    m, n = f.size_out(1)
    J = J.reshape(m, len(samples), n)
    r = r.reshape(m, len(samples))
    return np.sum(r * r) / 2, np.einsum("ik,ikj->j", r, J), np.einsum("ika,ikb->ab", J, J)


def assert_close(found, expected, tolerance=1e-13):
    cost, gradient, matrix = expected
    length = np.sqrt(np.diag(matrix)).astype(float)
    assert found.cost == pytest.approx(float(cost), rel=tolerance)
    gap = np.abs(found.gradient - gradient)
    assert np.all(gap <= tolerance * length * float(np.sqrt(2 * cost)))
    assert np.all(np.abs(found.matrix - matrix) <= tolerance * np.outer(length, length))
    np.testing.assert_array_equal(found.matrix, found.matrix.T)


def tried(replay, p, samples):
    """The sums from atoms alone; None where they are refused."""
    return factored.factored_sums(replay, np.asarray(p, dtype=float), samples)


# -- the same sums ---------------------------------------------------------------------------------


def test_the_wheel_has_its_sums_from_atoms():
    f, samples = of_model("wheel"), spun(3000)
    replay = Replay(f, grouped=(0, 1))
    assert tried(replay, SPINNING, samples) is not None
    found = normal_equations(replay, SPINNING, samples)
    assert_close(found, by_casadi(f, np.array(SPINNING), samples))


@pytest.mark.parametrize("grouped", [(), (0, 1)])
@pytest.mark.parametrize("name", SHIPPED)
def test_sums_of_a_shipped_model_are_casadis(name, grouped, at_any_price):
    f, rng = of_model(name), np.random.default_rng(2)
    replay = Replay(f, grouped=grouped)
    p = rng.uniform(0.5, 1.5, replay.n_parameters)
    samples = rng.uniform(-2, 2, (300, replay.n_sample))
    assert factored.factored(replay) is not None
    assert_close(normal_equations(replay, p, samples), by_casadi(f, p, samples))


def odd_models():
    p, s = ca.SX.sym("p", 4), ca.SX.sym("s", 3)
    late = ca.if_else(s[0] > p[0], p[1] * s[1], p[2] * s[1] ** 2)
    divided = (p[0] * s[0] + p[1]) / (2 + s[1] ** 2) / p[2] - s[2]
    return {
        "divided": function(p, s, ca.vertcat(divided, p[3] / (3 + s[0]) - s[1])),
        "chosen": function(p, s, ca.vertcat(late, p[3] * s[2] - ca.fabs(p[0] * s[0]))),
        "shared": function(
            p, s, ca.vertcat(*(p[i] * s[0] ** 2 + p[3] * s[1] - 1 for i in (0, 1, 2)))
        ),
        "constant": function(p, s, ca.vertcat(p[0] + p[1] * s[0], 2 * p[2] - p[3] - s[1])),
        "without columns": function(p, s, ca.vertcat(s[0] - 1, p[0] * s[1] + p[1], s[2])),
        "nowhere": function(p, s, ca.vertcat(s[0], s[1] * s[2])),
        "squared": function(p, s, (p[0] * s[0] + p[1] * s[1]) ** 2 * p[2] - (p[3] - s[2]) ** 2),
        "of parameters alone": function(p, s, ca.vertcat(p[0] * p[1], ca.sin(p[2]) - p[3])),
        "functions": function(p, s, ca.exp(p[0] * s[0]) * p[1] + ca.sin(p[2] * s[1] + p[3]) - s[2]),
    }


@pytest.mark.parametrize("name", odd_models())
def test_sums_of_an_odd_model_are_casadis(name, at_any_price):
    f, rng = odd_models()[name], np.random.default_rng(3)
    p, samples = rng.uniform(0.5, 1.5, 4), rng.normal(size=(2500, 3))
    replay = Replay(f)
    assert tried(replay, p, samples) is not None
    assert_close(normal_equations(replay, p, samples), by_casadi(f, p, samples))


def test_weights_of_two_count_everything_twice(at_any_price):
    f, rng = of_model("rate-table"), np.random.default_rng(4)
    replay = Replay(f, grouped=(0, 1))
    p = rng.uniform(0.5, 1.5, replay.n_parameters)
    samples = rng.uniform(-2, 2, (300, replay.n_sample))
    found = normal_equations(replay, p, samples, np.full((300, 3), 2.0))
    assert_close(found, [2 * x for x in by_casadi(f, p, samples)])


LEAVES = ["p0", "p1", "s0", "s1", "s2", 1.0, -3.0]
TREES = st.recursive(
    st.sampled_from(LEAVES),
    lambda inner: (
        st.tuples(st.sampled_from(["NEG", "TWICE", "SQ"]), inner)
        | st.tuples(st.sampled_from(["ADD", "SUB", "MUL"]), inner, inner)
    ),
    max_leaves=10,
)
INTEGERS = st.integers(-3, 3).map(float)


def built(tree, symbols):
    if not isinstance(tree, tuple):
        return symbols.get(tree, tree)
    operands = [ca.SX(built(t, symbols)) for t in tree[1:]]
    way = ca.SX.unary if len(operands) == 1 else ca.SX.binary
    return way(getattr(ca, f"OP_{tree[0]}"), *operands)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    trees=st.lists(TREES, min_size=6, max_size=6),
    p=st.tuples(INTEGERS, INTEGERS),
    samples=st.lists(st.tuples(INTEGERS, INTEGERS, INTEGERS), min_size=1, max_size=4),
)
def test_sums_of_whole_numbers_are_exact(trees, p, samples):
    """Nothing is rounded, so the order of additions and multiplications must not matter."""
    x, s = ca.SX.sym("p", 2), ca.SX.sym("s", 3)
    symbols = {f"p{i}": x[i] for i in range(2)} | {f"s{i}": s[i] for i in range(3)}
    cells = [built(tree, symbols) for tree in trees]
    f = function(x, s, ca.vertcat(*cells[:2]), ca.blockcat([cells[2:4], cells[4:]]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(factored, "_WORTHWHILE", np.inf)
        patch.setattr(factored, "LOSS", 1e100)
        patch.setattr(factored, "_UNDERFLOW", 0.0)
        found = tried(Replay(f), p, np.array(samples))
    cost, gradient, matrix = by_casadi(f, np.array(p), np.array(samples))
    whole = np.block([[matrix, gradient[:, None]], [gradient[None], np.array([[2 * cost]])]])
    if found is not None and np.abs(whole).max() < 2**40:
        np.testing.assert_array_equal(found, whole.astype(float))


# -- refused ---------------------------------------------------------------------------------------


def cancelling():
    """∂r/∂p₀ = (s − p₁) is of order 1 where its terms are of order p₁."""
    p, s = ca.SX.sym("p", 2), ca.SX.sym("s", 2)
    J = ca.blockcat([[p[0] * (s[0] - p[1]), p[0]], [s[1], p[1]]])
    return function(p, s, ca.vertcat(p[0] * (s[0] - p[1]), p[1]), J)


def around(centre):
    rng = np.random.default_rng(5)
    return np.array([2.0, centre]), np.array([centre, 0]) + rng.normal(size=(1000, 2))


def test_terms_that_cancel_lose_no_digits(at_any_price):
    f, (p, samples) = cancelling(), around(1e6)
    replay = Replay(f)
    assert tried(replay, p, samples) is None
    assert_close(normal_equations(replay, p, samples), by_casadi(f, p, samples))


def test_without_the_refusal_they_would(at_any_price, monkeypatch):
    monkeypatch.setattr(factored, "LOSS", 1e100)
    f, (p, samples) = cancelling(), around(1e6)
    found = tried(Replay(f), p, samples)[0, 0]
    assert abs(found / float(by_casadi(f, p, samples)[2][0, 0]) - 1) > 1e-6


def test_after_three_refusals_in_a_row_nothing_is_tried_any_more(at_any_price):
    replay, near, far = Replay(cancelling()), around(1.0), around(1e6)
    for _ in range(2):
        assert tried(replay, *far) is None
        assert tried(replay, *far) is None
        assert tried(replay, *near) is not None
    for _ in range(3):
        assert tried(replay, *far) is None
    assert tried(replay, *near) is None
    assert_close(normal_equations(replay, *near), by_casadi(cancelling(), *near))


@pytest.mark.parametrize(("size", "by"), [(1e200, 1e-200), (1e-170, 1e170)])
def test_atoms_out_of_range_where_the_entry_is_not_are_refused(size, by, at_any_price):
    p, s = ca.SX.sym("p"), ca.SX.sym("s", 2)
    f = function(p, s, p * s[0], (p * s[0]) ** 2 * s[1])
    samples = np.random.default_rng(6).uniform(0.5, 1.5, (50, 2)) * [size, 1.0]
    replay = Replay(f)
    assert tried(replay, [by], samples) is None
    assert_close(normal_equations(replay, [by], samples), by_casadi(f, [by], samples))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("column", [1, 7])  # of the reading; of the attitude
def test_what_is_not_finite_is_where_it_was(bad, column, monkeypatch):
    f, rng = of_model("rate-table"), np.random.default_rng(7)
    replay = Replay(f, grouped=(0, 1))
    p = rng.uniform(0.5, 1.5, replay.n_parameters)
    samples = rng.uniform(-2, 2, (100, replay.n_sample))
    samples[40, column] = bad
    found = normal_equations(replay, p, samples)
    assert not np.isfinite(found.cost)
    monkeypatch.setattr(factored, "ENOUGH", 1000)
    for ours, theirs in zip(found, normal_equations(replay, p, samples), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_few_samples_are_evaluated_entry_by_entry(monkeypatch):
    monkeypatch.undo()
    assert tried(Replay(of_model("wheel")), SPINNING, spun(100)) is None
