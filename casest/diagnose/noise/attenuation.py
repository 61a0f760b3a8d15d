"""What noise of the inputs' own would do to an estimate: slopes over noisy inputs are too small."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise

import numpy as np

from casest.data.run import Run
from casest.diagnose.levels import LEVELS
from casest.diagnose.noise.of_inputs import noise_like, noise_of_inputs, with_noise
from casest.effects.placing import prepared
from casest.estimate.estimate import Estimate
from casest.leastsquares.problem import Problem
from casest.leastsquares.weights import weighted

#: Draws of noise, at least and at most, and rows of all of them that are enough.
FEWEST, MOST, ENOUGH = 2, 8, 50_000


def attenuated(estimate: Estimate) -> Iterator[tuple[str, float, Mapping[str, float]]]:
    """Inputs, as much noise of each as its quick part and the residual allow (a standard deviation,
    in its unit), and by how much that would have moved parameters: those that it moves by two of
    their standard deviations.

    As much noise again moves them as far once more (J. Cook, L. Stefanski, 1994). None of implicit
    models, whose second-order shift is followed, and where noise was stated.
    """
    model = estimate.model
    if model.implicit or model.noise is not None:
        return
    runs = prepared(model, estimate.problem.runs)
    plain = Problem(model, runs)
    problem = weighted(plain, estimate.values)
    point, rng = problem.point(estimate.values), np.random.default_rng(0)
    residual = np.concatenate(problem.residuals(point))
    draws = int(np.clip(ENOUGH // max(len(residual), 1), FEWEST, MOST))
    for name, size in noise_of_inputs(problem, point, residual, _spans(runs)):
        steps = []
        for _ in range(draws):
            noisy = Problem(model, with_noise(runs, name, noise_like(runs, name, size, rng)))
            if problem.weights is not None:
                noisy = noisy.with_weights(problem.weights)
            _, gradient, matrix = noisy.normal(noisy.point(estimate.values))
            if np.isfinite(gradient).all() and np.isfinite(matrix).all():
                steps.append(np.linalg.lstsq(matrix, -gradient, rcond=1e-12)[0])
        if len(steps) < draws:  # the model has no value there: a logarithm below zero
            continue
        moved, scatter = np.mean(steps, axis=0), np.std(steps, axis=0) / np.sqrt(draws)
        std = np.sqrt(np.diag(estimate.covariance)) + scatter
        far = {
            s.parameter.name: float(np.abs(moved[s.x]).max())
            for s in problem.slots
            if np.any(np.abs(moved[s.x]) > LEVELS.apart * std[s.x])
        }
        if far:
            yield name, size, far


def _spans(runs: tuple[Run, ...]) -> list[slice]:
    """Rows of all runs that follow each other without a gap."""
    edges, first = [0], 0
    for run in runs:
        edges += (first + 1 + np.flatnonzero(np.diff(run.block))).tolist()
        first += len(run)
        edges.append(first)
    return [slice(a, b) for a, b in pairwise(edges)]
