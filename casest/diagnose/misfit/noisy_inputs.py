"""What noise of a recorded input alone lets a residual follow.

Where the input reads high by chance the residual is low: in the order of that reading, within each
level that was held, neighbours are alike. So more of that noise is drawn, what it lets a residual
follow is found in it, and as much of that as there is, is taken away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.misfit.structure import order_of
from casest.diagnose.misfit.variables import Variable
from casest.diagnose.noise.of_inputs import noise_like, noise_of_inputs, with_noise
from casest.leastsquares.problem import Point, Problem

#: Draws, and the rows of which the means are one course.
DRAWS, SMOOTH = 8, 20


def beside_noise_of_inputs(
    problem: Problem,
    point: Point,
    residuals: Sequence[Array],
    variable: Variable,
    named: Callable[[Problem], Sequence[Variable]],
) -> list[Array]:
    """Residuals (N, m) without what noise of each input lets them follow of a variable.

    `named`: variables of the problem with other inputs. As they are where noise was stated: what
    they follow is asked in the order of the true values then.
    """
    r = np.concatenate(residuals)
    ends = [0, *accumulate(map(len, problem.runs))]
    spans = [slice(a, b) for a, b in pairwise(ends)]
    if problem.model.noise is not None:
        return list(residuals)
    rng, courses = np.random.default_rng(0), list[Array]()
    for name, size in noise_of_inputs(problem, point, r, spans):
        course = np.zeros_like(r)
        for _ in range(DRAWS):
            runs = with_noise(problem.runs, name, noise_like(problem.runs, name, size, rng))
            noisy = Problem(problem.model, runs)
            moved = {v.name: v for v in named(noisy)}.get(variable.name)
            if moved is None or all(map(np.array_equal, moved.values, variable.values)):
                break
            more = zip(noisy.residuals(point), problem.residuals(point), strict=True)
            course += np.concatenate([n - o for n, o in more])[order_of(moved)]
        courses.append(_smooth(course))
    if not courses:
        return list(residuals)
    order = order_of(variable)
    left = r.copy()
    for k in range(r.shape[1]):
        X = np.stack([c[:, k] for c in courses], axis=1)
        left[order, k] -= X @ np.maximum(np.linalg.lstsq(X, r[order, k], rcond=1e-9)[0], 0.0)
    return np.split(left, ends[1:-1])


def _smooth(course: Array) -> Array:
    """Means (N, m) of so many rows around each."""
    width = min(SMOOTH, len(course))
    sums = np.cumsum(np.vstack([np.zeros((1, course.shape[1])), course]), axis=0)
    low = np.clip(np.arange(len(course)) - width // 2, 0, len(course) - width)
    return np.asarray((sums[low + width] - sums[low]) / width)
