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
from casest.diagnose.evidence.likelihood import LEFT, Explained, Likelihood
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
    everything = float(np.sum((root * likelihood.residual) ** 2))
    return at_most(_of_all(both, everything, len(root)), len(root))


def at_most(gain: float, count: int) -> float:
    """Of so many residuals what noise may gain that gains so much on average.

    A gain that is G without chance is (√G + z)² with it, z normal: where what is left after it must
    be z² to say anything, G + 2·z·√G is to be taken away.
    """
    return min(MOST * count, gain + 2 * float(np.sqrt(LEVELS.strong * gain)))


def _of_all(taken: float, everything: float, count: int) -> float:
    """Gain of so many residuals that is feigned, where noise explains so much of all squares."""
    share = min(max(taken, 0.0) / max(everything, 1e-300), 1 - 1e-12)
    return -count * float(np.log1p(-share))


def feigned_by_refit(
    before: Linear, after: Linear, draws: Sequence[tuple[float, Array, Array, Array]]
) -> float | None:
    """What noise of an input gains in a refit on average; None where the refits are of other rows.

    `draws`: how much noise, in that of the input, and what it adds to the residuals (N, m) of both,
    and to those without what was added where all else is as after it. A lag leaves that noise as
    large as it was, however much a slope in the lag magnifies it. What the refit changes goes with
    the noise as its mean slope says, which little noise shows; how large that change is, no more
    than either shows: a play turns within the noise, and is bounded. Noise that inputs lose to
    another cause counts by its part of all that there was. What a cause itself smooths makes a
    residual likelier, whatever else it explains.
    """
    one, other = alike([before, after])
    if one.residual.shape != other.residual.shape:
        return None
    likelihood = Likelihood(other)
    beside = likelihood.beside()

    def by_frequency(residual: Array) -> Array:
        return np.asarray(likelihood.by_frequency(residual[:, :, None])[:, 0])

    own, smoothed = list[tuple[float, Array, Array]](), list[tuple[float, Array, Array]]()
    for size, more, less, plain in draws:
        now = by_frequency(less)
        for found, was in ((own, by_frequency(more)), (smoothed, by_frequency(plain))):
            moved = (was - now) / size
            both = likelihood.sums.summed(was / size * moved)
            found.append((size, both, likelihood.sums.summed(moved**2)))
    everything = float(np.sum(by_frequency(one.residual) ** 2 / beside.spectrum))
    taken = float(np.sum(_taken(own) / beside.powers))
    gain = _of_all(taken, everything, len(beside.spectrum))
    return max(gain, _likelier(beside, _taken(smoothed))) if one.coloured else gain


def _taken(draws: Sequence[tuple[float, Array, Array]]) -> Array:
    """Noise (K,) in each band that a refit takes away."""
    together = np.mean([t for size, t, _ in draws if size == LITTLE], axis=0)
    sizes = {size for size, *_ in draws}
    change = [np.mean([c for s, _, c in draws if s == size], axis=0) for size in sizes]
    return np.asarray(2 * together - min(change, key=lambda c: float(c.sum())))


def _likelier(after: Explained, taken: Array) -> float:
    """By how much what is left is likelier than it would be with noise of powers `taken` (K,)."""
    own = after.likelihood
    left = own.sums.summed(after.left**2)
    return max(own.cost_of(np.maximum(left + taken, LEFT * left)) - own.cost_of(left), 0.0)
