"""How much likelier one fit is than another that has less in it, each beside a noise of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.likelihood import Likelihood, far_out
from casest.diagnose.evidence.linear import Linear, alike, robust_sd
from casest.diagnose.levels import LEVELS


def beside_a_colour(likelihood: Likelihood) -> float:
    """−2 log L where the noise has a spectrum of its own, and no more."""
    return likelihood.beside().cost


def rises(
    less: Linear, fits: Sequence[Linear], of: Callable[[Likelihood], float] = beside_a_colour
) -> list[float]:
    """2 log of the likelihood of each fit over that of one with less in it; each has its own noise.

    What the fit with the least noise leaves far out is cut from all of them. `of`: −2 log L. Of a
    fit that takes most of the squares at least what these say: where the other instrument is the
    noisy one, a residual that has little of it in it is likely as a smooth course of its own,
    however large it is.
    """
    less, *fits = alike([less, *fits])
    best = min(fits, key=lambda x: float(np.sum(np.log(robust_sd(x.residual)))))

    def cut(linear: Linear) -> Array | None:
        alike = linear.residual.shape == best.residual.shape  # rows that moved in time are others
        return far_out(best.residual) if alike and linear.series else None

    none, far = of(Likelihood(less, cut(less))), cut(less)
    return [
        max(none - of(Likelihood(fit, cut(fit))), rise_of_squares(less, fit, far)) for fit in fits
    ]


def rise_of_squares(less: Linear, more: Linear, cut: Array | None = None) -> float:
    """2 log of the likelihood ratio of squares, of as many samples as are independent."""
    count, rise = of_squares(less, more, cut)
    return count * rise


def of_squares(less: Linear, more: Linear, cut: Array | None = None) -> tuple[float, float]:
    """How many samples are independent, and 2 log of the likelihood ratio of squares of each.

    As many as noise of the spectrum of all that there was would leave of what is taken away
    (Bartlett 1935): what is missing counts as noise, so they are too few. Nothing where less than
    most of the squares are taken. `cut`: as of a likelihood.
    """
    if not less.coloured or less.residual.shape != more.residual.shape:
        return 1.0, -np.inf
    without, beside = Likelihood(less, cut), Likelihood(more, cut)
    before, after = without.residual, beside.residual
    taken, b, a = before - after, float(before @ before), float(after @ after)
    if a > LEVELS.most * b:
        return 1.0, -np.inf
    noise = float(without.beside().powers @ without.sums.summed(taken**2))
    return b * float(taken @ taken) / max(noise, 1e-300), float(np.log(b / max(a, 1e-300)))
