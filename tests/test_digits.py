"""Variances against the same algebra in 60 decimal digits, over twelve decades of what is known."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casest.dynamics import Steps, kalman, smoothed

DIGITS = 60


def exact(array):
    """Floats as decimal numbers, digit by digit."""
    return np.vectorize(Decimal, otypes=[object])(np.asarray(array, float))


def solved(M, right):
    """M⁻¹·right of decimal numbers, by Gauss's elimination with pivots."""
    both, n = np.hstack([M, right]), len(M)
    for k in range(n):
        best = max(range(k, n), key=lambda i: abs(both[i, k]))
        both[[k, best]] = both[[best, k]]
        both[k] = both[k] / both[k, k]
        for i in set(range(n)) - {k}:
            both[i] = both[i] - both[i, k] * both[k]
    return both[:, n:]


def in_digits(steps, start, covariance):
    """Filtered and smoothed states and covariances, sample by sample, by the textbook."""
    Phi, u, Q, C, R, y = map(exact, (steps.Phi, steps.forced, steps.Q, steps.C, steps.R, steps.y))
    x, P, after, before = exact(start), exact(covariance), [], []
    for k in range(len(C)):
        if k:
            x, P = Phi[k - 1] @ x + u[k - 1], Phi[k - 1] @ P @ Phi[k - 1].T + Q[k - 1]
        before.append((x, P))
        for c, r, reading in zip(C[k], R[k], y[k], strict=True):
            gain = P @ c / (c @ P @ c + r)
            x, P = x + gain * (reading - c @ x), P - np.outer(gain, c @ P)
        after.append((x, P))
    smooth = [after[-1]]
    for k in range(len(C) - 2, -1, -1):
        (x, P), (later, Pl), (ahead, Pa) = after[k], smooth[0], before[k + 1]
        G = solved(Pa, Phi[k] @ P).T
        smooth.insert(0, (x + G @ (later - ahead), P + G @ (Pl - Pa) @ G.T))
    return after, smooth


def decades(low, high):
    return st.floats(low, high).map(lambda e: 10.0**e)


@st.composite
def tracked(draw):
    """Position, velocity and bias, one of them read: everything in units of anything."""
    size = np.array(draw(st.lists(decades(-6, 6), min_size=3, max_size=3)))
    prior = np.array(draw(st.lists(decades(0, 6), min_size=3, max_size=3)))
    noise, driven = draw(decades(-6, 0)), draw(decades(-12, 0))
    h, count = draw(decades(-3, 0)), 6
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    A = np.array([[0, 1, 0], [0, 0, -1], [0, 0, 0.0]])
    Phi = (np.eye(3) + h * A + h * h / 2 * A @ A) * size[:, None] / size
    half = driven * h * np.tril(rng.uniform(0.5, 1.5, (3, 3))) * size[:, None]
    C = np.zeros((count, 1, 3))
    C[:, 0, 0] = 1 / size[0]
    y = 0.1 * rng.standard_normal((count, 1))
    Q = half @ half.T
    each = count - 1
    steps = Steps(
        np.repeat(Phi[None], each, 0), np.zeros((each, 3)), np.repeat(Q[None], each, 0),
        C, np.zeros((count, 1)), np.full((count, 1), noise**2), y,
    )  # fmt: skip
    return steps, np.diag((prior * size) ** 2)


@settings(max_examples=60, deadline=None)
@given(tracked())
def test_variances_are_positive_and_right_over_twelve_decades(case):
    steps, covariance = case
    found = kalman(steps, np.zeros(3), covariance)
    x, P = smoothed(steps, found)
    with localcontext() as context:
        context.prec = DIGITS
        after, smooth = in_digits(steps, np.zeros(3), covariance)
        for mine, theirs in ((found.P, after), (P, smooth)):
            expected = np.array([np.diag(one).astype(float) for _, one in theirs])
            ours = np.diagonal(mine, axis1=1, axis2=2)
            assert (ours > 0).all()
            np.testing.assert_allclose(ours, expected, rtol=1e-9)
        for mine, theirs in ((found.x, after), (x, smooth)):
            expected = np.array([one.astype(float) for one, _ in theirs])
            std = np.array([np.sqrt(np.diag(one).astype(float)) for _, one in theirs])
            assert (np.abs(mine - expected) < 1e-6 * std + 1e-9 * np.abs(expected)).all()
