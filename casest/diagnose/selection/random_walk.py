"""Is what looks like an effect an offset that wanders? A random walk can look like anything."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.data.run import Run
from casest.diagnose.candidates.score_test import Score
from casest.diagnose.levels import BEYOND_WALK, CLIPPED
from casest.diagnose.noise.noise_model import (
    likelihood_of_walk,
    likelihood_of_white,
    power,
    slice_means,
)
from casest.diagnose.selection.model_evidence import Fitted

#: Share of what an effect explains that the means of slices hold, at least, if a walk may be it.
SLOW_SHARE = 0.5


def is_random_walk(runs: Sequence[Run], before: Fitted, after: Fitted, score: Score) -> bool:
    """Does a random walk explain the slow part of the residual as well as what was added does?

    Log-likelihoods of what is seen at slow rates, less what the fitted sizes cost. What lowers the
    squares at other rates for the most part is nothing that a walk could be.
    """
    q, gain = score.freedom, score.gain / score.inflation
    cost = 0.5 * q * (1 + float(np.log1p(gain / q)))
    walk = plain = shaped = slow = fallen = 0.0
    limit = CLIPPED * before.noise
    for run, old, new in zip(runs, before.residuals, after.residuals, strict=True):
        old, new = (np.clip(r, -limit, limit) for r in (old, new))
        b, a = slice_means(run, old), slice_means(run, new)
        if b is not None and a is not None:
            walk += likelihood_of_walk(power(b)) - old.shape[1]
            plain += likelihood_of_white(power(b))
            beside = likelihood_of_walk(power(a)) - old.shape[1]
            shaped += max(likelihood_of_white(power(a)), beside)
            slow += float(np.sum(b**2 - a**2)) * len(old) / len(b)
            fallen += float(np.sum(old**2 - new**2))
    if slow < SLOW_SHARE * fallen:
        return False
    return walk > plain + BEYOND_WALK and walk > shaped - cost - BEYOND_WALK
