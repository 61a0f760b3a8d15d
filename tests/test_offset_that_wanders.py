"""Slow noise of an offset, seen through a body that turns, is no cause; nor is a telegraph."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from casest import close
from casest.diagnose.evidence import wandering
from casest.diagnose.evidence.likelihood import Likelihood
from casest.diagnose.evidence.linear import Linear, parts_of
from casest.diagnose.evidence.rises import rises
from casest.diagnose.evidence.wandering import SIZES, wandering_cost
from casest.diagnose.noise.slow_course import slow_squares

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "studies"))

import loop_worlds
from noise_records import record_of

POSES, READINGS, WAVES = 36, 10, 12


def posed(rng, offset, columns=()):
    """The length's residual over poses, (N,), of an offset (N, 3) and white noise, as a fit of an
    offset and three gains leaves it; columns (N, k) beside them, and the turned course."""
    n = POSES * READINGS
    way = rng.standard_normal((POSES, 3))
    way = np.repeat(way / np.linalg.norm(way, axis=1, keepdims=True), READINGS, axis=0)
    y = np.sum(way * offset, axis=1) + rng.standard_normal(n)
    unknowns = np.hstack([way, way**2, *columns])
    left = y - unknowns @ np.linalg.lstsq(unknowns, y, rcond=None)[0]
    number = np.zeros(n, dtype=int)
    edges = np.linspace(0, n, POSES + 1).astype(int)
    spans = tuple(slice(a, b) for a, b in pairwise(edges))
    parts = parts_of(number, number, way)
    share = np.arange(n)[:, None] / (n - 1)
    waves = np.arange(1, WAVES + 1)
    shapes = np.cos(np.pi * share * waves) / np.sqrt(waves)
    course = (way[:, None, :, None] * shapes[:, None, None, :]).reshape(n, 1, -1)
    return Linear(left[:, None], unknowns[:, None, :], spans, parts), course, way


def flicker(rng, n):
    """(n, 3) of unit variance: power of one over the frequency."""
    frequency = np.maximum(np.fft.rfftfreq(n), 1 / n)[:, None]
    found = np.fft.irfft(np.fft.rfft(rng.standard_normal((n, 3)), axis=0) / frequency**0.5, n, 0)
    return found / found.std()


def drifts(rng, n):
    """(n, 3): no noise, a line on each axis."""
    return np.linspace(-1, 1, n)[:, None] * np.array([2.0, -1.5, 1.0])


def rise_of_a_drift(seed, offset):
    """2 log L of a drift on each axis over none: with noise of a colour, and beside a wander."""
    n, found = POSES * READINGS, []
    for of in (None, wandering_cost):
        rng = np.random.default_rng(seed)
        wander = offset(rng, n)
        state = rng.bit_generator.state
        less, course, way = posed(rng, wander)
        rng.bit_generator.state = state
        drift = way * np.linspace(-1, 1, n)[:, None]
        fit, _, _ = posed(rng, wander, [drift])
        more = {} if of is None else {"of": lambda x, c=course: wandering_cost(x, c)}
        found.append(rises(less, [fit], **more)[0])
    return found


@pytest.mark.long
def test_flicker_noise_of_an_offset_looks_like_a_drift_and_beside_a_wander_it_does_not():
    """Three unknowns gain 16 in one of a thousand records of white noise."""
    every = [rise_of_a_drift(seed, lambda rng, n: 3 * flicker(rng, n)) for seed in range(60)]
    plain, beside = np.array(every).T
    assert np.sum(plain > 16) >= 5
    assert np.sum(beside > 16) <= 1


def test_a_drift_that_is_there_is_seen_beside_a_wander_as_well():
    every = [rise_of_a_drift(seed, drifts) for seed in range(10)]
    plain, beside = np.array(every).T
    assert np.all(beside > 25)
    assert np.all(beside <= plain + 5)


@pytest.mark.long
def test_white_noise_hardly_ever_pays_for_a_wander():
    """The price is that of one unknown, log N: passed in fewer than one of twenty."""
    paid = 0
    for seed in range(60):
        linear, course, _ = posed(np.random.default_rng(seed), np.zeros((POSES * READINGS, 3)))
        likelihood = Likelihood(linear)
        paid += wandering_cost(likelihood, course) < likelihood.beside().cost - 1e-9
    assert paid <= 6


@pytest.mark.long
def test_the_cost_is_that_of_the_whole_covariance(monkeypatch):
    """Beside one spectrum: −2 log of the density, least over the unknowns, by dense matrices."""
    monkeypatch.setattr(wandering, "ROUNDS", 0)
    rng = np.random.default_rng(5)
    linear, course, _ = posed(rng, drifts(rng, POSES * READINGS))
    likelihood = Likelihood(linear)
    S, X = likelihood.beside().spectrum, likelihood.declared
    W, R = likelihood.by_frequency(course), likelihood.residual
    root = 1 / np.sqrt(S)
    Q, _ = np.linalg.qr(X * root[:, None])
    r = R * root
    unit = float(r @ r - np.sum((Q.T @ r) ** 2)) / float(np.sum((W * root[:, None]) ** 2))
    costs = []
    for a in SIZES * unit:
        V = np.diag(S) + a * W @ W.T
        inverse = np.linalg.inv(V)
        values = np.linalg.solve(X.T @ inverse @ X, X.T @ inverse @ R)
        left = R - X @ values
        costs.append(np.linalg.slogdet(V)[1] + left @ inverse @ left)
    price = np.log(len(R) - X.shape[1])
    assert min(costs) + price < likelihood.beside().cost  # it pays
    assert wandering_cost(likelihood, course) == pytest.approx(min(costs) + price, rel=1e-7)


@pytest.mark.parametrize(("amplitude", "period"), [(1.0, 300), (3.0, 120)])
def test_slow_squares_are_those_of_the_wave(amplitude, period):
    rng, n = np.random.default_rng(4), 3000
    wave = amplitude * np.sin(2 * np.pi * np.arange(n) / period)
    residual = rng.standard_normal((n, 2))
    residual[:, 0] += wave
    run = loop_worlds.Run.raw("r", {"y": residual}, units={}, time=0.01 * np.arange(n))
    assert slow_squares([run], [residual]) == pytest.approx(amplitude**2 / 4, rel=0.15)
    assert slow_squares([run], [residual[:, 1:]]) == 0


@pytest.mark.parametrize(
    ("kind", "seed", "name"),
    [
        ("pink", 350051, "bias_drift"),
        pytest.param("pink", 350131, "bias_step", marks=pytest.mark.long),
        pytest.param("random telegraph", 350047, "pulse", marks=pytest.mark.long),
        pytest.param("random telegraph", 350102, "pulse", marks=pytest.mark.long),
    ],
)
def test_of_slow_noise_nothing_is_claimed_and_a_misfit_is_said(kind, seed, name):
    """Records of the study of noises, in which an earlier state claimed this."""
    _, world = record_of(kind, seed)
    closing = close(loop_worlds.model_of(world), [loop_worlds.run_of(world)])
    assert not closing.effects
    assert closing.verdict == "unexplained"
    assert name in {r.name for r in closing.refused}
