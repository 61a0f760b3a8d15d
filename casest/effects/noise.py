"""Effects on the noise: samples that count less, neighbours that are not independent."""

from __future__ import annotations

from casest.declaration.effect import effect
from casest.declaration.physics import SX, fabs, if_else


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
