"""Residuals of several kinds, each with a noise of its own that the data show.

A model that ties lengths in m/s² and turns in degrees together says which constant is the noise of
each (`Residual(noise=…)`). What is 0 there is estimated with the fit, by the squares that each kind
leaves over and its share of the redundancy: Helmert's variance components in Förstner's form
(Förstner, ZfV 104, 1979; Teunissen & Amiri-Simkooei, J. Geodesy 82, 2008, sec. 6).
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Constant
from casest.leastsquares.problem import Point, Problem

#: Rounds until the noises stand still to the share CLOSE.
ROUNDS, CLOSE = 50, 1e-4
#: Redundancy of a kind below which its residuals show no noise, and from which on they alone do.
LEAST, ENOUGH = 0.5, 10


def unknown_noises(model: Model) -> tuple[str, ...]:
    """Constants that are the noise of a kind of residual and not known."""
    names = dict.fromkeys(model.traced.residual.noise)
    return tuple(n for n in names if isinstance(model[n], Constant) and not model[n].array > 0)


def in_deviations(
    problem: Problem, first: Point, fit: Callable[[Problem, Point], Point]
) -> Problem:
    """The problem with the noise of each kind that is not known as these data show it.

    `fit` solves a problem from a point. As it is where nothing is unknown.
    """
    names = unknown_noises(problem.model)
    if not names:
        return problem
    kinds = np.array([names.index(n) if n in names else -1
                      for n in problem.model.traced.residual.noise])  # fmt: skip
    repeats = np.array([_rests_show(problem, name) for name in names])
    sizes = np.maximum(_at_start(problem, first, kinds, len(names)), repeats)
    point = first
    for _ in range(ROUNDS):
        weighted = problem.with_weights(_weights(problem, kinds, sizes))
        point = fit(weighted, point)
        new = _components(weighted, point, kinds, sizes, repeats)
        still = np.allclose(new, sizes, rtol=CLOSE, atol=0.0)
        sizes = new
        if still:
            break
    found = {n: float(f"{s:.5g}") for n, s in zip(names, sizes, strict=True)}
    model = problem.model.having(**found)
    return Problem(model, problem.runs, problem.weights)


def _rests_show(problem: Problem, name: str) -> float:
    """Error of a rest's mean, in the unit of a noise that is that of a signal; else nothing."""
    signal = re.fullmatch(r"\[(\w+)\]", problem.model[name].unit)
    spreads = [r.spread[signal[1]] for r in problem.runs if signal and signal[1] in r.spread]
    squares = np.concatenate([s.ravel() ** 2 for s in spreads]) if spreads else np.zeros(1)
    return float(np.sqrt(np.mean(squares)))


def _present(problem: Problem) -> list[Array]:
    shapes = [(len(run), len(problem.model.axes)) for run in problem.runs]
    parts = zip(problem.present, shapes, strict=True)
    return [np.ones(shape) if p is None else p.astype(float) for p, shape in parts]


def _weights(problem: Problem, kinds: Array, sizes: Array) -> list[Array]:
    each = np.where(kinds < 0, 1.0, 1 / sizes[kinds] ** 2)
    return [present * each for present in _present(problem)]


def _at_start(problem: Problem, first: Point, kinds: Array, count: int) -> Array:
    """Root mean square residual of each kind where the search begins."""
    squares = [np.sum(r**2, axis=0) for r in problem.residuals(first)]
    total, number = np.sum(squares, axis=0), np.sum([p.sum(axis=0) for p in _present(problem)], 0)
    each = [
        np.sqrt(total[kinds == k].sum() / max(number[kinds == k].sum(), 1)) for k in range(count)
    ]
    return np.maximum(each, 1e-300)


def _components(
    problem: Problem, point: Point, kinds: Array, sizes: Array, repeats: Array
) -> Array:
    """Noise of each kind: squares left over its redundancy, Σ(1 − h).

    With little redundancy never less than what the rests themselves show.
    """
    squares, left = np.zeros(len(sizes)), np.zeros(len(sizes))
    R = problem.factor(point)[0]
    norms = np.linalg.norm(R, axis=0)
    inverse = np.linalg.pinv(R / np.where(norms > 0, norms, 1.0))
    for block, present in zip(problem.blocks(point), _present(problem), strict=True):
        assert block.weights is not None
        scaled = np.zeros((*block.residual.shape, len(norms)))
        scaled[:, :, block.x] = block.jacobian / np.where(norms > 0, norms, 1.0)[block.x]
        leverage = block.weights * np.sum((scaled @ inverse) ** 2, axis=2)
        for k in range(len(sizes)):
            own = kinds == k
            squares[k] += np.sum(block.residual[:, own] ** 2)
            left[k] += np.sum((present - leverage)[:, own])
    found = np.where(left > LEAST, np.sqrt(squares / np.maximum(left, LEAST)), sizes)
    return np.asarray(np.where(left < ENOUGH, np.maximum(found, repeats), found))
