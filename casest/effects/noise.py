"""Effects on the noise: samples that count less."""

from __future__ import annotations

from casest.declaring.physics import SX, fabs, if_else
from casest.modelling.effect import effect


@effect(
    on="noise",
    shown_by="the samples themselves",
    formula="weight (1 − (r/6)²)² within 6 standard deviations, else 0",
)
def outliers(r: SX) -> SX:
    """Samples far out count less: Tukey's biweight, 6 standard deviations wide."""
    return if_else(fabs(r) < 6, (1 - (r / 6) ** 2) ** 2, 0)
