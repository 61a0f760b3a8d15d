"""What noise of the inputs alone may feign.

Slopes are taken at inputs as they were recorded. Noise of an input is in the residual and in the
slopes: a column that would be none beside the unknowns is that noise there, and explains it. (In a
ramp at an even pace time tells the reference better than a noisy meter did.) How much of what a
column explains is that noise is the covariance of the two, and that of normal noise with any
function of it is its variance times the mean slope (Stein 1981): so the same columns are looked at
with a little more noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.likelihood import Likelihood
from casest.diagnose.evidence.linear import Linear, alike
from casest.diagnose.evidence.score import Evidence
from casest.diagnose.levels import LEVELS

#: Noise that is added, in that of the input: little, for a slope.
LITTLE = 0.1
#: Twice the log of a ratio of likelihoods, for each residual, that no cause reaches.
MOST = 20.0


def feigned(
    evidence: Evidence, likelihood: Likelihood, draws: Sequence[tuple[Likelihood, Array]]
) -> float:
    """Gain that noise of an input may give: MOST of each residual where a cause is all noise.

    `draws`: the problem and the evidence's columns (N, m, k) with LITTLE of its noise added to that
    input.
    """
    columns, beyond = np.concatenate(evidence.columns, axis=2), evidence.beyond
    left = likelihood.remains(beyond.flat)
    values = beyond.mix @ evidence.explained.values[-evidence.freedom :]
    root = 1 / np.sqrt(evidence.explained.spectrum)
    size = np.linalg.norm(columns.reshape(len(root), -1), axis=0)
    together = []
    for noisy, moved in draws:
        own = np.linalg.norm(moved.reshape(len(root), -1), axis=0) / np.maximum(size, 1e-300)
        there = noisy.remains(noisy.flat(moved))
        change = root * ((there * own - left) @ values)
        more = (noisy.linear.residual - likelihood.linear.residual)[:, :, None]
        added = root * likelihood.by_frequency(more)[:, 0]
        together.append(float(change @ added) / LITTLE**2)
    both = float(np.mean(together)) if together else 0.0
    return _at_most(both, float(np.sum((root * likelihood.residual) ** 2)), len(root))


def _at_most(taken: float, everything: float, count: int) -> float:
    """Gain of so many residuals that is feigned, where noise explains so much of all their squares.

    A gain that is G without chance is (√G + z)² with it, z normal: where what is left after it must
    be z² to say anything, G + 2·z·√G is to be taken away.
    """
    share = min(max(taken, 0.0) / max(everything, 1e-300), 1 - 1e-12)
    gain = -count * float(np.log1p(-share))
    return min(MOST * count, gain + 2 * float(np.sqrt(LEVELS.strong * gain)))


def feigned_by_refit(
    before: Linear, after: Linear, draws: Sequence[tuple[float, Array, Array]]
) -> float | None:
    """The same of a refit, by the noise of an input that it takes from the residual; None where the
    refits are of other rows.

    `draws`: how much noise, in that of the input, and what it adds to the residuals (N, m) of both.
    A lag leaves that noise as large as it was, however much a slope in the lag magnifies it. What
    the refit changes goes with the noise as its mean slope says, which little noise shows; how
    large that change is, no more than either shows: a play turns within the noise, and is bounded.
    """
    one, other = alike([before, after])
    if one.residual.shape != other.residual.shape:
        return None
    likelihood = Likelihood(other)
    root = 1 / np.sqrt(likelihood.beside().spectrum)

    def whitened(residual: Array) -> Array:
        return np.asarray(root * likelihood.by_frequency(residual[:, :, None])[:, 0])

    together = dict[float, list[float]]()
    change = dict[float, list[float]]()
    for size, more, less in draws:
        was, moved = whitened(more) / size, whitened(more - less) / size
        together.setdefault(size, []).append(float(was @ moved))
        change.setdefault(size, []).append(float(moved @ moved))
    taken = 2 * np.mean(together[LITTLE]) - min(np.mean(c) for c in change.values())
    everything = whitened(one.residual)
    return _at_most(float(taken), float(everything @ everything), len(root))
