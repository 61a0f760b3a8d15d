"""Optimal designs: known optima, every design of a small set, and a certificate that holds."""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
import pytest

from casest.plan.design.continuous import certified, continuous, information
from casest.plan.design.criteria import Largest, Longest, Trace, Volume, inverse
from casest.plan.design.exact import exchanged, in_order, rounded

TRACE = 1e-8


def polynomial(degree, grid):
    """Factors (N, 1, degree + 1) of a polynomial regression."""
    return np.polynomial.legendre.legvander(grid, degree)[:, None, :]


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_the_d_optimum_of_a_polynomial_lies_at_the_roots_of_guest(degree):
    # Guest 1958: ±1 and the roots of P'_d, each with the weight 1/(d + 1)
    roots = np.polynomial.legendre.Legendre.basis(degree).deriv().roots()
    optimum = np.sort([-1, *roots, 1])
    grid = np.sort(np.append(np.linspace(-1, 1, 101), roots))
    factors = polynomial(degree, grid)
    found = continuous(Volume(), TRACE * np.eye(degree + 1), factors, degree + 1, close=1e-5)
    taken = found.weights > 0.01
    near = np.abs(grid[:, None] - optimum).min(axis=1) < 0.011
    assert near[taken].all()
    shares = [found.weights[np.abs(grid - x) < 0.011].sum() for x in optimum]
    assert shares == pytest.approx([1 / (degree + 1)] * (degree + 1), abs=0.01)
    exact = np.isin(grid, optimum) / (degree + 1)
    value, floor = certified(Volume(), TRACE * np.eye(degree + 1), factors, exact, degree + 1)
    assert value - floor < 1e-6  # Kiefer and Wolfowitz: the largest slope is the mean one


@pytest.mark.parametrize(
    "criterion",
    [Volume(), Trace(np.eye(3)), Longest(), Largest(np.eye(3)), Trace(np.array([[1.0], [0], [2]]))],
    ids=["D", "A", "E", "G", "c"],
)
def test_exchange_finds_the_best_of_all_designs_of_a_small_set(criterion):
    rng = np.random.default_rng(3)
    factors = rng.standard_normal((9, 2, 3))
    known = TRACE * np.eye(3)

    def value(chosen):
        counts = np.bincount(chosen, minlength=9).astype(float)
        return criterion.value(inverse(information(known, factors, counts)))

    best = min(value(list(c)) for c in combinations_with_replacement(range(9), 4))
    start = rounded(continuous(criterion, known, factors, 4).weights, 4)
    assert value(exchanged(criterion, known, factors, start)) <= best + 0.02 * abs(best)


@pytest.mark.parametrize(
    "criterion", [Volume(), Trace(np.eye(4)), Longest(), Largest(np.eye(4))], ids=list("DAEG")
)
def test_no_design_is_better_than_the_certificate_says(criterion):
    rng = np.random.default_rng(5)
    factors, known = rng.standard_normal((40, 1, 4)), 0.1 * np.eye(4)
    found = continuous(criterion, known, factors, 6)
    assert found.floor <= found.value
    for _ in range(300):
        few = rng.choice(40, rng.integers(1, 9), replace=False)
        weights = np.zeros(40)
        weights[few] = rng.dirichlet(np.ones(len(few)))
        M = known + 6 * np.einsum("i,ikm,ikn->mn", weights, factors, factors)
        assert criterion.value(np.linalg.inv(M)) >= found.floor


def test_what_one_more_candidate_makes_of_a_criterion_is_what_it_is_then():
    rng = np.random.default_rng(7)
    factors, C = rng.standard_normal((6, 2, 4)), np.linalg.inv(np.diag([1.0, 2, 3, 4]))
    for criterion in (Volume(), Trace(np.eye(4)), Longest(), Largest(np.eye(4))):
        after = criterion.after(C, factors)
        direct = [criterion.value(np.linalg.inv(np.linalg.inv(C) + F.T @ F)) for F in factors]
        assert after == pytest.approx(direct)


def test_rounding_keeps_the_number_and_every_candidate_with_weight():
    weights = np.array([0.5, 0.3, 0.15, 0.05, 0.0])
    chosen = rounded(weights, 10)
    assert len(chosen) == 10
    assert set(chosen) == {0, 1, 2, 3}


def test_those_come_first_that_bring_most():
    factors = np.array([[[1.0, 0]], [[0, 5.0]], [[0, 1.0]], [[3.0, 0]]])
    assert in_order(Volume(), np.eye(2), factors, [0, 1, 2, 3])[:2] == [1, 3]
