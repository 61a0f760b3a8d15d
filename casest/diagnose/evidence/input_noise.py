"""What noise of the inputs alone may feign.

Slopes are taken at inputs as they were recorded. Noise of an input is in the residual and in the
slopes: a column that would be none beside the unknowns is that noise there, and explains it. (In a
ramp at an even pace time tells the reference better than a noisy meter did.) So the same columns
are looked at with so much noise more: as far as what changes in them goes with what was added to
the residual, that column explains noise of that input, and as much of it may be its whole gain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.likelihood import Likelihood
from casest.diagnose.evidence.linear import Linear, alike
from casest.diagnose.evidence.score import Evidence
from casest.diagnose.levels import LEVELS

#: Twice the log of a ratio of likelihoods, for each residual, that no cause reaches.
MOST = 20.0


def feigned(
    evidence: Evidence, likelihood: Likelihood, draws: Sequence[tuple[Likelihood, Array]]
) -> float:
    """Gain that noise of an input may give: MOST of each residual where a cause is all noise.

    `draws`: the problem and the evidence's columns (N, m, k) with noise added to that input.
    """
    columns, beyond = np.concatenate(evidence.columns, axis=2), evidence.beyond
    left = likelihood.remains(beyond.flat)
    values = beyond.mix @ evidence.explained.values[-evidence.freedom :]
    root = 1 / np.sqrt(evidence.explained.spectrum)
    size = np.linalg.norm(columns.reshape(len(root), -1), axis=0)
    explained = float(np.sum((root * (left @ values)) ** 2))
    together = []
    for noisy, moved in draws:
        own = np.linalg.norm(moved.reshape(len(root), -1), axis=0) / np.maximum(size, 1e-300)
        there = noisy.remains(noisy.flat(moved))
        change = root * ((there * own - left) @ values)
        more = (noisy.linear.residual - likelihood.linear.residual)[:, :, None]
        added = root * likelihood.by_frequency(more)[:, 0]
        together.append(float(change @ added))
    both = max(float(np.mean(together)) if together else 0.0, 0.0)
    all_there = float(np.sum((root * likelihood.residual) ** 2))
    share = LEVELS.jitter * both**2 / max(explained * all_there, 1e-300)
    return len(root) * min(MOST, -float(np.log1p(-min(share, 1 - 1e-12))))


def feigned_by_refit(
    before: Linear, after: Linear, draws: Sequence[tuple[Array, Array]]
) -> float | None:
    """The same of a refit, by the noise of an input that it takes from the residual; None where the
    refits are of other rows.

    `draws`: what noise of that input adds to the residuals (N, m) of both. A lag leaves that noise
    as large as it was, however much a slope in the lag magnifies it.
    """
    one, other = alike([before, after])
    if one.residual.shape != other.residual.shape:
        return None
    likelihood = Likelihood(other)
    root = 1 / np.sqrt(likelihood.beside().spectrum)

    def squares(residual: Array) -> float:
        return float(np.sum((root * likelihood.by_frequency(residual[:, :, None])[:, 0]) ** 2))

    taken = float(np.mean([squares(less) - squares(more) for less, more in draws]))
    share = LEVELS.jitter * max(taken, 0.0) / max(squares(one.residual), 1e-300)
    return len(root) * min(MOST, -float(np.log1p(-min(share, 1 - 1e-12))))
