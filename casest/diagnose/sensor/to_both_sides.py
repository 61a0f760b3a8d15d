"""A memory against what noise of the input feigns: a mean of rows before and after alike.

What a memory does comes late. Where an input is recorded with noise, whatever averages its rows
foretells the reading better: a memory those before, but rows before and after better still. So a
memory must leave less than the best mean to both sides does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casest.declaration.effect import OVER_TIME
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.evidence.held_out import share_taken
from casest.diagnose.evidence.linear import alike
from casest.diagnose.protocol.state import ANOTHER
from casest.diagnose.sensor.fits import Fit
from casest.diagnose.sensor.rows import Rows


def to_both_sides(before: Fit, after: Fit, added: Sequence[Candidate], rows: Rows) -> str:
    """Why a memory is none: a mean to both sides leaves no more; else empty."""
    if not any(what.effect is not None and what.effect.kind in OVER_TIME for what in added):
        return ""
    one, other = alike([rows.linear(before), rows.linear(after)])
    mean = rows.best_mean(before, one) if one.residual.shape == other.residual.shape else None
    if mean is None:
        return ""
    Q = replace(one, feigned=mean[:, :, None], counts=True).basis
    r = one.residual.ravel()
    left = r - Q @ (Q.T @ r)
    if float(np.sum(left**2)) > float(np.sum(other.residual**2)):
        return ""
    return f"noise of the inputs, averaged over rows before and after, does as well: {ANOTHER}"


def of_inputs(fit: Fit, rows: Rows) -> float:
    """Share of what is left of held-out squares that such a mean takes: noise of what is read
    beside the reading, or readings that were averaged themselves; 0 where there is no saying."""
    plain = replace(rows.linear(fit), counts=False)
    return 0.0 if plain.feigned is None else share_taken(plain, plain.feigned[:, :, 0])
