"""Effects on the noise: samples that count less, neighbours that are not independent."""

from __future__ import annotations

from typing import Any

from casest.declaration.effect import effect
from casest.declaration.physics import SX, fabs, if_else
from casest.declaration.symbols import constant
from casest.errors import DeclarationError


@effect(
    on="noise",
    shown_by="the samples themselves",
    formula="weight (1 − (r/6)²)² within 6 standard deviations, else 0",
    seen_in="tails",
)
def outliers(r: SX) -> SX:
    """Samples far out count less: Tukey's biweight, 6 standard deviations wide."""
    return if_else(fabs(r) < 6, (1 - (r / 6) ** 2) ** 2, 0)


@effect(
    on="noise",
    shown_by="the tails of the residual",
    formula="weight 1/(1 + r²/ν), r in units of Student's t with ν degrees of freedom",
    seen_in="tails",
)
def student_t(r: SX, *, nu: Any = constant(4.0)) -> SX:
    """Tails heavy everywhere: noise by Student's t with nu degrees of freedom.

    r comes in robust standard deviations, of which 0.6745 hold half of a normal noise; of t they
    are its upper quartile. The weights are those of the likelihood (Lange, Little & Taylor, J. Am.
    Stat. Assoc. 84, 1989, 881).
    """
    from scipy.special import stdtrit

    freedom = float(nu)
    if not freedom > 0:
        raise DeclarationError(f"nu = {freedom:g}: degrees of freedom are above zero")
    scaled = r * float(stdtrit(freedom, 0.75)) / 0.6745
    return 1 / (1 + scaled**2 / freedom)


@effect(
    on="noise",
    shown_by="a long record at rest (Allan deviation)",
    formula="y + a random walk (its size: wander, under noise)",
    seen_in="random walk",
    describes=True,
)
def bias_wander(r: SX) -> SX:
    """The offset walks at random: bias instability (IEEE Std 952).

    No sample counts less for it: the correlation that it leaves makes intervals wider.
    """
    return 1 + 0 * r
