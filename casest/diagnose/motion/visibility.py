"""What a record could show of an effect, and what the effect would do to the states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.motion.sensitivity import Sensitivity
from casest.effects.moving import Candidate


@dataclass(frozen=True)
class Visible:
    """`information` (p, p) of an effect's numbers; `moves` (n, p): rms of each on the states."""

    candidate: Candidate
    information: Array
    moves: Array


def visible(found: Sensitivity, tried: Sequence[Candidate]) -> tuple[Visible, ...]:
    """Of every candidate."""
    return tuple(
        Visible(c, np.einsum("kij,kil->jl", H, H), found.moves[:, where])
        for c, where in zip(tried, found.columns, strict=True)
        for H in [found.H[:, :, where]]
    )
