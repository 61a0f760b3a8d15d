"""The engine agrees with CasADi's own evaluation, in constant memory."""

from __future__ import annotations

import tracemalloc
from unittest.mock import patch

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casest.declaration.tracing import sample_symbol
from casest.engine import Replay, cost, grouping, normal_equations, rows, triangular_factor
from casest.errors import CasestError
from casest.results.find import find_model

INF, NAN = np.inf, np.nan
MODERATE = [0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 1.5, 2.0, -3.0, 2.5, 0.7, -0.7, 3.0, 11.0, -25.0]
SMALL = [1e-9, -1e-9, 1e-310, 5e-324, 1e-300, -1e-300]
LARGE = [1e5, -1e22, 1e155, 1.7e308, -1.7e308, 709.0, -745.0]
SPECIAL = np.array([*MODERATE, *SMALL, *LARGE, INF, -INF, NAN])

# Correctly rounded, or a selection: NumPy and CasADi must agree to the last bit.
EXACT_UNARY = ["NEG", "SQRT", "SQ", "TWICE", "INV", "FABS", "FLOOR", "CEIL", "SIGN", "NOT"]
EXACT_BINARY = ["ADD", "SUB", "MUL", "DIV", "FMIN", "FMAX", "FMOD", "REMAINDER", "COPYSIGN"]
EXACT_BINARY += ["LT", "LE", "EQ", "NE", "AND", "OR", "IF_ELSE_ZERO", "LIFT"]
# From a mathematical library: equal to a few units in the last place.
SMOOTH_UNARY = ["EXP", "LOG", "LOG1P", "EXPM1", "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN"]
SMOOTH_UNARY += ["SINH", "COSH", "TANH", "ASINH", "ACOSH", "ATANH", "ERF"]
SMOOTH_BINARY = ["POW", "ATAN2", "HYPOT"]


def unary(name, x):
    return ca.SX.unary(getattr(ca, f"OP_{name}"), x)


def binary(name, x, y):
    return ca.SX.binary(getattr(ca, f"OP_{name}"), x, y)


def function(parameters, sample, *outputs):
    names = [f"out{i}" for i in range(len(outputs))]
    return ca.Function("f", [parameters, sample], outputs, ["parameters", "sample"], names)


def truth(f, parameters, samples):
    """CasADi, one sample at a time: a list of (N, rows, columns)."""
    values = [f.call([ca.DM(parameters), ca.DM(s)]) for s in samples]
    return [
        np.array([v[i].full() for v in values]).reshape(len(samples), *f.size_out(i))
        for i in range(f.n_out())
    ]


def assert_same(ours, theirs, rtol, smallest=0.0):
    assert ours.shape == theirs.shape
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))
    infinite = np.isinf(theirs)
    np.testing.assert_array_equal(ours[infinite], theirs[infinite])
    finite = np.isfinite(theirs)
    ours, theirs = ours[finite], theirs[finite]
    np.testing.assert_array_equal(np.signbit(ours), np.signbit(theirs))
    # Halved, so that the difference of two large values does not overflow.
    gap = np.abs(ours / 2 - theirs / 2)
    assert np.all(gap <= rtol / 2 * np.abs(theirs) + smallest)


def single_operations(unary_names, binary_names):
    """Every operation on samples, on parameters, and on one of each."""
    p, s = ca.SX.sym("p", 2), ca.SX.sym("s", 2)
    columns = [unary(name, x) for name in unary_names for x in (s[0], p[0])]
    pairs = [(s[0], s[1]), (s[0], p[1]), (p[0], s[1]), (p[0], p[1])]
    columns += [binary(name, x, y) for name in binary_names for x, y in pairs]
    return function(p, s, ca.vertcat(*columns))


def special_pairs():
    return np.array([(x, y) for x in SPECIAL for y in SPECIAL])


@pytest.mark.parametrize("names", [(EXACT_UNARY, EXACT_BINARY), (SMOOTH_UNARY, SMOOTH_BINARY)])
def test_every_operation_agrees_on_special_values(names):
    rtol, smallest = (0.0, 0.0) if names[0] is EXACT_UNARY else (1e-15, 1e-322)
    f = single_operations(*names)
    replay, samples = Replay(f), special_pairs()
    assert_same(replay(SPECIAL[:2], samples)[0], truth(f, SPECIAL[:2], samples)[0], rtol, smallest)
    for pair in samples[:: 1 if rtol == 0 else 3]:
        ours, theirs = replay(pair, samples[:2])[0], truth(f, pair, samples[:2])[0]
        assert_same(ours, theirs, rtol, smallest)


@pytest.mark.parametrize("names", [(EXACT_UNARY, EXACT_BINARY), (SMOOTH_UNARY, SMOOTH_BINARY)])
def test_every_operation_agrees_on_random_values(names):
    rng = np.random.default_rng(1)
    samples = rng.normal(size=(2000, 2)) * 10.0 ** rng.uniform(-3, 3, size=(2000, 2))
    f = single_operations(*names)
    p = np.array([1.7, -0.3])
    rtol = 0.0 if names[0] is EXACT_UNARY else 1e-15
    assert_same(Replay(f)(p, samples)[0], truth(f, p, samples)[0], rtol)


def test_a_constant_power_agrees():
    p, s = ca.SX.sym("p"), ca.SX.sym("s")
    f = function(p, s, ca.vertcat(*[s**k for k in (2.5, -1.5, 3, 7, -2, 0.5, 1 / 3)], p**2.5))
    samples = SPECIAL[:, None]
    ours, theirs = Replay(f)([1.3], samples)[0], truth(f, [1.3], samples)[0]
    assert_same(ours, theirs, 1e-15, 1e-322)


LEAVES = st.sampled_from(["p0", "p1", "s0", "s1", "s2"]) | st.sampled_from([0.0, 1.0, -2.5, 1e9])


def nodes(children):
    return st.tuples(st.sampled_from(EXACT_UNARY), children) | st.tuples(
        st.sampled_from(EXACT_BINARY), children, children
    )


EXACT_TREES = st.recursive(LEAVES, nodes, max_leaves=20)
# One or two layers of a library function on top: deeper, rounding could be amplified at will.
SMOOTH_TREES = st.tuples(st.sampled_from(SMOOTH_UNARY), EXACT_TREES) | st.tuples(
    st.sampled_from(SMOOTH_BINARY), EXACT_TREES, EXACT_TREES
)
PRODUCTS = st.tuples(st.sampled_from(["MUL", "COPYSIGN", "IF_ELSE_ZERO"]), EXACT_TREES)
MIXED_TREES = st.tuples(PRODUCTS, SMOOTH_TREES).map(lambda t: (t[0][0], t[0][1], t[1]))


def build(tree, symbols):
    if isinstance(tree, str):
        return symbols[tree]
    if isinstance(tree, float):
        return ca.SX(tree)
    operands = [build(t, symbols) for t in tree[1:]]
    if tree[0] == "COPYSIGN":  # the sign of a nan is nobody's promise: zero in its place
        below = binary("LE", operands[1], symbols["s2"])
        operands[1] = binary("IF_ELSE_ZERO", below, operands[1])
    return unary(tree[0], *operands) if len(operands) == 1 else binary(tree[0], *operands)


def build_function(trees):
    p, s = ca.SX.sym("p", 2), ca.SX.sym("s", 3)
    symbols = {"p0": p[0], "p1": p[1], "s0": s[0], "s1": s[1], "s2": s[2]}
    return function(p, s, ca.vertcat(*[build(t, symbols) for t in trees]))


NUMBERS = st.sampled_from(SPECIAL.tolist()) | st.floats(-100, 100) | st.floats()
POINTS = st.tuples(
    st.tuples(NUMBERS, NUMBERS),
    st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), min_size=1, max_size=9),
)


@settings(max_examples=150, deadline=None)
@given(trees=st.lists(EXACT_TREES, min_size=1, max_size=5), point=POINTS)
def test_random_expressions_of_exact_operations_agree_to_the_last_bit(trees, point):
    f, (p, samples) = build_function(trees), point
    ours = Replay(f)(np.array(p), np.array(samples))[0]
    assert_same(ours, truth(f, p, samples)[0], rtol=0.0)


@settings(max_examples=150, deadline=None)
@given(trees=st.lists(SMOOTH_TREES | MIXED_TREES, min_size=1, max_size=5), point=POINTS)
def test_random_expressions_of_all_operations_agree(trees, point):
    f, (p, samples) = build_function(trees), point
    ours = Replay(f)(np.array(p), np.array(samples))[0]
    # Not at the edge of overflow and underflow, where the last digit decides between two worlds.
    theirs = truth(f, p, samples)[0]
    inside = ~((np.abs(theirs) < 1e-290) & (theirs != 0))
    assert_same(np.where(inside, ours, 0), np.where(inside, theirs, 0), rtol=1e-14, smallest=1e-290)


WHOLE = st.sampled_from(["p0", "p1", "s0", "s1", "s2"]) | st.sampled_from([0.0, 1.0, -3.0])
SUMS = st.recursive(
    WHOLE,
    lambda inner: (
        st.tuples(st.sampled_from(["NEG", "TWICE", "SQ"]), inner)
        | st.tuples(st.sampled_from(["ADD", "SUB", "MUL"]), inner, inner)
    ),
    max_leaves=12,
)
INTEGERS = st.integers(-3, 3).map(float)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    trees=st.lists(SUMS, min_size=1, max_size=6),
    p=st.tuples(INTEGERS, INTEGERS),
    samples=st.lists(st.tuples(INTEGERS, INTEGERS, INTEGERS), min_size=1, max_size=4),
)
def test_grouping_terms_leaves_whole_numbers_as_they_are(trees, p, samples):
    """Whole numbers are added and multiplied without rounding: the order must not matter."""
    f = build_function(trees)
    with patch.object(grouping, "_work", side_effect=[0, 1]):  # even where it does not pay
        ours = Replay(f, grouped=(0,))(np.array(p), np.array(samples))[0]
    theirs = truth(f, p, samples)[0]
    small = np.abs(theirs) < 2**52
    np.testing.assert_array_equal(ours[small], theirs[small])


@pytest.mark.parametrize("name", ["wheel", "rate-table", "norm-triangular", "norm-pair"])
def test_grouped_residuals_and_jacobians_are_casadis(name):
    """To a few units in the last place of the largest entry of the same row."""
    t, rng = find_model(name).traced, np.random.default_rng(0)
    p = ca.vertcat(t.coordinates, t.references)
    s = sample_symbol(find_model(name))
    J = ca.jacobian(t.expression, t.coordinates)
    f = ca.Function("f", [p, s], [t.expression, J], ["parameters", "sample"], ["r", "J"])
    x, samples = rng.uniform(0.5, 1.5, p.numel()), rng.uniform(-2, 2, (50, s.numel()))
    replay, plain = Replay(f, grouped=(0, 1)), Replay(f)
    for ours, theirs in zip(replay(x, samples), truth(f, x, samples), strict=True):
        largest = np.abs(theirs).max(axis=2, keepdims=True) + 1
        assert np.all(np.abs(ours - theirs) <= 1e-13 * largest)
    work = [len(r.plan([*r.entries(0), *r.entries(1)]).steps) for r in (replay, plain)]
    assert work[0] <= work[1]
    assert name != "wheel" or work[0] < 0.8 * work[1]


def test_if_else_zero_is_zero_where_false_whatever_the_other_operand():
    p, s = ca.SX.sym("p"), ca.SX.sym("s")
    f = function(p, s, ca.if_else(s > 0, ca.log(s), p))
    ours = Replay(f)(np.array([4.0]), np.array([[0.0], [-1.0], [1.0]]))[0].ravel()
    np.testing.assert_array_equal(ours, [4.0, 4.0, 0.0])


def model():
    """Residual (3×1), a sparse Jacobian (3×4), and outputs that do not depend on the sample."""
    p, s = ca.SX.sym("p", 4), ca.SX.sym("s", 5)
    r = ca.vertcat(
        p[0] * s[0] + ca.sin(p[1] * s[1]) - s[2],
        p[2] * s[3] + p[3],
        ca.exp(p[1]) - s[4] * p[3],
    )
    only_parameters = ca.horzcat(p[0] * p[1], ca.cos(p[2]))
    return function(p, s, r, ca.jacobian(r, p), only_parameters, ca.DM([[1, 0], [2, 3]]), s[2])


PARAMETERS = np.array([0.4, -1.2, 2.0, 0.3])


def record(n, k=5, seed=0):
    return np.random.default_rng(seed).normal(size=(n, k))


@pytest.mark.parametrize("n", [0, 1, 2, 37, 100])
@pytest.mark.parametrize("block", [1, 7, 10, 8192])
def test_blocks_give_the_nonzeros_of_every_sample_once(n, block):
    f, samples = model(), record(n)
    seen = 0
    for span, outputs in Replay(f).blocks(PARAMETERS, samples, block=block):
        assert span.start == seen
        assert 0 < span.stop - span.start <= block
        for i, (ours, theirs) in enumerate(
            zip(outputs, truth(f, PARAMETERS, samples[span]), strict=True)
        ):
            pattern = f.sparsity_out(i)
            index = np.array(pattern.find(), dtype=int)
            flat = theirs.transpose(0, 2, 1).reshape(len(theirs), -1)
            assert_same(ours.T, flat[:, index], rtol=1e-14, smallest=1e-15)
        seen = span.stop
    assert seen == n


@pytest.mark.parametrize("n", [0, 1, 20_001])
def test_a_call_gives_every_output_dense(n):
    f, samples = model(), record(n)
    mapped = [np.array(v) for v in f.map(n)(PARAMETERS, samples.T)] if n else []
    for i, ours in enumerate(Replay(f)(PARAMETERS, samples)):
        assert ours.shape == (n, *f.size_out(i))
        if n:
            size = f.size_out(i)
            theirs = mapped[i].reshape(size[0], n, size[1]).transpose(1, 0, 2)
            np.testing.assert_allclose(ours, theirs, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("n", [0, 1, 20_001])
def test_a_sum_is_the_sum_over_samples_of_any_output(n):
    f, samples = model(), record(n)
    replay = Replay(f)
    for i, values in enumerate(replay(PARAMETERS, samples)):
        ours = replay.sum(PARAMETERS, samples, output=i)
        np.testing.assert_allclose(ours, values.sum(axis=0), rtol=1e-12, atol=1e-10)


def test_results_of_two_calls_are_separate():
    replay, a, b = Replay(model()), record(50, seed=1), record(50, seed=2)
    first = replay(PARAMETERS, a)
    kept = [v.copy() for v in first]
    replay(2 * PARAMETERS, b)
    for x, y in zip(first, kept, strict=True):
        np.testing.assert_array_equal(x, y)


def test_interleaved_iterations_do_not_share_a_buffer():
    replay, a, b = Replay(model()), record(50, seed=1), record(50, seed=2)
    expected = replay(PARAMETERS, a)[0], replay(2 * PARAMETERS, b)[0]
    one, two = replay.blocks(PARAMETERS, a, 10), replay.blocks(2 * PARAMETERS, b, 10)
    for (span, x), (_, y) in zip(one, two, strict=True):
        np.testing.assert_array_equal(x[0].T, expected[0][span, :, 0])
        np.testing.assert_array_equal(y[0].T, expected[1][span, :, 0])


def test_new_parameters_reach_the_values_that_depend_on_nothing_else():
    f, samples = model(), record(3)
    replay = Replay(f)
    for p in (PARAMETERS, 2 * PARAMETERS):
        np.testing.assert_allclose(
            replay(p, samples)[2], truth(f, p, samples)[2], rtol=1e-15, atol=0
        )


@pytest.mark.parametrize("order", ["C", "F"])
def test_samples_may_be_mapped_from_a_file(tmp_path, order):
    samples = record(1000)
    path = tmp_path / "samples"
    mapped = np.memmap(path, dtype=np.float64, mode="w+", shape=samples.shape, order=order)
    mapped[:] = samples
    mapped.flush()
    mapped = np.memmap(path, dtype=np.float64, mode="r", shape=samples.shape, order=order)
    replay = Replay(model())
    for ours, theirs in zip(replay(PARAMETERS, mapped), replay(PARAMETERS, samples), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    ours, theirs = (normal_equations(replay, PARAMETERS, s) for s in (mapped, samples))
    np.testing.assert_array_equal(ours.matrix, theirs.matrix)


def test_an_expression_equal_to_another_output_is_given_in_both():
    p, s = ca.SX.sym("p"), ca.SX.sym("s")
    x = ca.sin(p * s)
    a, b, c = Replay(function(p, s, x, x, ca.vertcat(s, x)))(np.array([2.0]), record(5, 1))
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(c[:, 1:], a)


# What cannot be replayed is named.


def test_an_mx_function_is_refused():
    p, s = ca.MX.sym("p"), ca.MX.sym("s")
    with pytest.raises(CasestError, match=r"'f' is a MXFunction: build it from SX"):
        Replay(function(p, s, p * s))


def test_other_inputs_are_refused():
    x = ca.SX.sym("x")
    with pytest.raises(CasestError, match=r"'g' has the inputs \['x'\]"):
        Replay(ca.Function("g", [x], [x], ["x"], ["y"]))


def test_a_sparse_or_rectangular_input_is_refused():
    p, s = ca.SX.sym("p"), ca.SX.sym("s", 2, 2)
    with pytest.raises(CasestError, match=r"'sample' of function 'f' is 2x2"):
        Replay(function(p, s, p * s))


def test_a_free_symbol_is_refused():
    p, s, q = ca.SX.sym("p"), ca.SX.sym("s"), ca.SX.sym("q")
    names = (["parameters", "sample"], ["y"])
    f = ca.Function("f", [p, s], [p * s * q], *names, {"allow_free": True})
    with pytest.raises(CasestError, match="free symbols"):
        Replay(f)


def test_a_wrong_shape_is_named():
    replay = Replay(model())
    with pytest.raises(CasestError, match=r"parameters of 'f' have the shape \(3,\): give \(4,\)"):
        replay(np.zeros(3), record(2))
    with pytest.raises(CasestError, match=r"samples of 'f' have the shape \(2, 4\): give \(N, 5\)"):
        replay(PARAMETERS, record(2, 4))
    with pytest.raises(CasestError, match=r"weights have the shape \(2, 1\): give \(2, 3\)"):
        normal_equations(replay, PARAMETERS, record(2), np.ones((2, 1)))
    with pytest.raises(CasestError, match="block is 0"):
        list(replay.blocks(PARAMETERS, record(2), block=0))


def test_outputs_that_are_not_residual_and_jacobian_are_refused():
    p, s = ca.SX.sym("p", 2), ca.SX.sym("s")
    with pytest.raises(CasestError, match=r"the second must be the Jacobian, \(1, n\)"):
        normal_equations(Replay(function(p, s, p[0] * s)), np.zeros(2), record(2, 1))
    with pytest.raises(CasestError, match="not a dense column of residuals"):
        cost(Replay(function(p, s, p.T * s)), np.zeros(2), record(2, 1))


# Normal equations


def wide_model(n):
    """Two residuals, the first with all n columns, the second with three."""
    p, s = ca.SX.sym("p", n), ca.SX.sym("s", n)
    r = ca.vertcat(ca.sin(ca.dot(p, s)) - s[0], p[0] * p[1] + s[1] * p[n - 1] ** 2)
    return function(p, s, r, ca.jacobian(r, p))


def point_and_record(n, seed=3):
    rng = np.random.default_rng(seed)
    return rng.normal(size=n), rng.normal(size=(9001, n))


@pytest.mark.parametrize(
    ("weighted", "n"),  # different BLAS routines
    [
        *((weighted, n) for n in (3, 12) for weighted in (False, True)),
        *(pytest.param(weighted, 40, marks=pytest.mark.long) for weighted in (False, True)),
    ],
)
def test_normal_equations_are_the_sums_over_all_rows(n, weighted):
    f, (p, samples) = wide_model(n), point_and_record(n)
    replay = Replay(f)
    w = np.random.default_rng(4).uniform(0, 2, (len(samples), 2)) if weighted else None
    # CasADi's values are (2, N) and (2, N n); summed here in extended precision.
    r, jacobian = (np.array(v).astype(np.longdouble).T for v in f.map(len(samples))(p, samples.T))
    r = r.reshape(-1)
    jacobian = jacobian.reshape(len(samples), n, 2).transpose(0, 2, 1).reshape(-1, n)
    flat = np.ones(r.size) if w is None else w.reshape(-1)
    wj, wr = jacobian * flat[:, None], r * flat
    normal = normal_equations(replay, p, samples, w)
    scale = np.abs(wj).T @ np.abs(jacobian)
    assert np.all(np.abs(normal.matrix - wj.T @ jacobian) <= 1e-14 * scale)
    assert np.all(np.abs(normal.gradient - wj.T @ r) <= 1e-14 * (np.abs(wj).T @ np.abs(r)))
    assert normal.cost == pytest.approx(float(0.5 * wr @ r), rel=1e-13)
    assert cost(replay, p, samples, w) == pytest.approx(float(0.5 * wr @ r), rel=1e-13)
    np.testing.assert_array_equal(normal.matrix, normal.matrix.T)


def test_the_cost_needs_no_jacobian():
    p, s = ca.SX.sym("p"), ca.SX.sym("s")
    only_residual = Replay(function(p, s, p * s))
    assert cost(only_residual, np.array([2.0]), np.array([[1.0], [3.0]])) == 0.5 * (4 + 36)


def test_no_samples_give_zero_sums():
    replay, none = Replay(model()), np.zeros((0, 5))
    normal = normal_equations(replay, PARAMETERS, none)
    assert normal.cost == cost(replay, PARAMETERS, none) == 0
    assert not normal.gradient.any()
    assert not normal.matrix.any()
    assert not triangular_factor(replay, PARAMETERS, none).any()
    r, jacobian = rows(replay, PARAMETERS, none)
    assert (r.shape, jacobian.shape) == ((0, 3), (0, 3, 4))


def test_rows_are_residuals_and_jacobians_per_sample():
    f, samples = model(), record(100)
    r, jacobian = rows(Replay(f), PARAMETERS, samples)
    theirs = truth(f, PARAMETERS, samples)
    np.testing.assert_allclose(r, theirs[0][:, :, 0], rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(jacobian, theirs[1], rtol=1e-13, atol=1e-15)


def test_results_are_nan_without_a_warning_where_a_residual_is():
    p, s = ca.SX.sym("p", 2), ca.SX.sym("s")
    r = ca.vertcat(p[0] * ca.log(s), p[1] * s)
    replay = Replay(function(p, s, r, ca.jacobian(r, p)))
    parameters, samples = np.array([2.0, 3.0]), np.array([[1.0], [-1.0], [0.0], [2.0]])
    normal = normal_equations(replay, parameters, samples)
    assert np.isnan(normal.cost)
    assert np.isnan(cost(replay, parameters, samples))
    np.testing.assert_array_equal(np.isnan(normal.gradient), [True, False])
    np.testing.assert_array_equal(np.isnan(normal.matrix), [[True, False], [False, False]])
    assert np.isnan(triangular_factor(replay, parameters, samples)).any()
    assert np.isnan(rows(replay, parameters, samples)[0][1, 0])


@pytest.mark.parametrize("count", [1, 2, 50, 20_000])
@pytest.mark.parametrize("weighted", [False, True])
def test_the_triangular_factor_has_the_normal_matrix_as_its_square(count, weighted):
    replay, samples = Replay(model()), record(count)
    w = np.random.default_rng(5).uniform(0, 2, (count, 3)) if weighted else None
    factor = triangular_factor(replay, PARAMETERS, samples, w)
    normal = normal_equations(replay, PARAMETERS, samples, w)
    assert factor.shape == (5, 5)
    np.testing.assert_array_equal(factor, np.triu(factor))
    square = factor.T @ factor
    close = {"rtol": 1e-11, "atol": 1e-11 * max(1, count) ** 0.5}
    np.testing.assert_allclose(square[:4, :4], normal.matrix, **close)
    np.testing.assert_allclose(square[:4, 4], normal.gradient, **close)
    assert 0.5 * square[4, 4] == pytest.approx(normal.cost, rel=1e-11)


def test_the_triangular_factor_does_not_square_the_condition_number():
    # Vandermonde, degree 9 on [0, 1]: condition 1e6 to 1e7. The solution is known: all ones.
    n = 10
    p, s = ca.SX.sym("p", n), ca.SX.sym("s", 2)
    powers = ca.vertcat(1, s[0], *[ca.power(s[0], i) for i in range(2, n)])
    r = ca.dot(powers, p) - s[1]
    replay = Replay(function(p, s, r, ca.jacobian(r, p)))
    t = np.linspace(0, 1, 20_000)
    samples = np.column_stack([t, sum(t**i for i in range(n))])
    start = np.zeros(n)
    factor = triangular_factor(replay, start, samples)
    by_factor = -np.linalg.solve(factor[:n, :n], factor[:n, n])
    normal = normal_equations(replay, start, samples)
    by_normal = -np.linalg.solve(normal.matrix, normal.gradient)
    error, error_normal = np.abs(by_factor - 1).max(), np.abs(by_normal - 1).max()
    assert error < 1e-8
    assert error_normal > 100 * error


def test_memory_does_not_grow_with_the_number_of_samples():
    replay = Replay(model())
    samples = np.zeros((2_000_000, 5))
    for work in (
        lambda: normal_equations(replay, PARAMETERS, samples),
        lambda: triangular_factor(replay, PARAMETERS, samples[:400_000]),
        lambda: replay.sum(PARAMETERS, samples, output=1),
        lambda: cost(replay, PARAMETERS, samples),
    ):
        tracemalloc.start()
        work()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 20e6  # bytes; the samples are 80 MB


def test_replays_that_are_kept_share_one_bound_of_memory():
    """Whoever keeps many models keeps their instructions, not a block of samples of each."""
    from casest.engine.replay import BLOCK
    from casest.engine.waiting import WAITING

    x = ca.SX.sym("x", 3)
    samples = np.random.default_rng(0).normal(size=(BLOCK, 3))

    def of(k):
        outputs = [ca.vertcat(*[ca.sin(x * j + k) for j in range(100)])]
        names = ["parameters", "sample"], ["values"]
        function = ca.Function("f", [ca.SX.sym("p", 0), x], outputs, *names)
        return Replay(function)

    kept = [of(k) for k in range(40)]
    first = kept[0](np.zeros(0), samples)[0]
    for each in kept:
        each(np.zeros(0), samples)
    plans = [p for each in kept for p in each._plans.values()]
    waiting = [w for p in plans for w in p._idle]
    assert sum(w.n_bytes for w in waiting) <= WAITING.most
    one = plans[-1]._idle[0].n_bytes
    assert one * len(plans) > 2 * WAITING.most  # what they would keep without it
    assert 0 < len(waiting) < len(plans)
    assert plans[-1]._idle  # what was used last is used again
    np.testing.assert_array_equal(kept[0](np.zeros(0), samples)[0], first)
