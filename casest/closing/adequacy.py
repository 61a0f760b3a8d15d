"""Is anything left? Noise as it is, and what of the residual is no noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from casest.closing.crossfit import rms
from casest.closing.loop import Closing

#: Residual over repeats from which on the model lacks something.
LACKS = 2.0


@dataclass(frozen=True)
class Misfit:
    """What is left beyond noise: share of the held-out variance, and where it lives.

    `noise` holds what is known of the noise itself.
    """

    significant: bool
    fraction: float
    where: str
    noise: Mapping[str, Any]


def misfit(closing: Closing) -> Misfit:
    """Compare what is left with what repeats show."""
    noise = closing.after.noise
    held_out = rms(closing.after_held_out)
    if noise.repeats and noise.residual > LACKS * noise.repeats:
        fraction = 1 - (noise.repeats / held_out) ** 2
        where = (
            f"between rest intervals: the residual is {noise.residual / noise.repeats:.1f} times "
            "what the scatter within them explains"
        )
        return Misfit(True, float(fraction), where, {})
    fraction = max(0.0, 1 - (noise.sigma / held_out) ** 2) if np.isfinite(noise.sigma) else 0.0
    return Misfit(False, float(fraction), "", {})
