"""One reading corrected with the parameters of many trials, each with noise of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import casadi as ca
import numpy as np

from casest.correction.spread import opened, reading_root
from casest.declaration.shapes import Array
from casest.estimate.estimate import Estimate
from casest.estimate.trials import Trials

#: Steps to the solution of a correction that has no closed form.
STEPS = 30


def corrected_trials(
    estimate: Estimate, units: Mapping[str, str], at: Array, value: Array
) -> Callable[[Trials, np.random.Generator], Array]:
    """What makes of T trials the corrected values (T, m) of a reading `at` (width,), near `value`.

    UsageError where runs have corrections of their own.
    """
    known = opened(estimate, units)
    root = reading_root(estimate, known.inputs)
    louder = estimate.noise.sigma / (estimate.noise.stated or estimate.noise.sigma)
    whole = ca.Function("whole", [known.sample], [known.whole])
    began = (estimate.optimum or estimate.point).x

    def corrected(trials: Trials, rng: np.random.Generator) -> Array:
        count = len(trials.unknowns)
        noise = rng.standard_normal((count, len(root))) @ root.T * louder
        samples = np.array(whole.map(count)((at + noise).T))
        theta = known.coordinates[:, None] + known.fitted @ (trials.unknowns - began).T
        theta[known.known] = trials.known.T
        theta = np.vstack([theta, np.repeat(known.references[:, None], count, axis=1)])
        function = known.function.map(count)
        if known.kind == "direct":
            return np.array(function(theta, samples)).T
        found = np.repeat(np.asarray(value, dtype=float)[:, None], count, axis=1)
        for _ in range(STEPS):
            step = np.array(function(theta, np.vstack([samples, found])))[: len(found)]
            found = found + step
            if np.all(np.abs(step) <= 1e-9 * (1 + np.abs(found))):
                break
        return found.T

    return corrected
