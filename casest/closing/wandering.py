"""Is what looks like an effect an offset that wanders? A random walk can look like anything."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.closing.adequacy import DOUBT
from casest.closing.evidence import Fitted
from casest.closing.noise_model import (
    likelihood_of_walk,
    likelihood_of_white,
    power,
    slice_means,
)
from casest.closing.score import CLIPPED, Score
from casest.data.run import Run


def wanders(runs: Sequence[Run], before: Fitted, after: Fitted, score: Score) -> bool:
    """Does a random walk explain the slow part of the residual as well as what was added does?

    Log-likelihoods of what is seen at slow rates, less what the fitted sizes cost.
    """
    q, gain = score.freedom, score.gain / score.inflation
    cost = 0.5 * q * (1 + float(np.log1p(gain / q)))
    walk = plain = shaped = 0.0
    limit = CLIPPED * before.noise
    for run, old, new in zip(runs, before.residuals, after.residuals, strict=True):
        b, a = (slice_means(run, np.clip(r, -limit, limit)) for r in (old, new))
        if b is not None and a is not None:
            walk += likelihood_of_walk(power(b)) - old.shape[1]
            plain += likelihood_of_white(power(b))
            beside = likelihood_of_walk(power(a)) - old.shape[1]
            shaped += max(likelihood_of_white(power(a)), beside)
    return walk > plain + DOUBT and walk > shaped - cost - DOUBT
