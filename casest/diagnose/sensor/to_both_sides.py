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
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.evidence.held_out import share_taken
from casest.diagnose.evidence.linear import Linear, alike
from casest.diagnose.protocol.state import ANOTHER
from casest.diagnose.sensor.fits import Fit
from casest.diagnose.sensor.rows import Rows


def to_both_sides(before: Fit, after: Fit, added: Sequence[Candidate], rows: Rows) -> str:
    """Why a memory is none: a mean to both sides leaves no more; else empty."""
    if not any(what.effect is not None and what.effect.kind in OVER_TIME for what in added):
        return ""
    one, other = alike([rows.linear(before), rows.linear(after)])
    if one.feigned is None or one.residual.shape != other.residual.shape:
        return ""
    if _left(one, one.feigned) > float(np.sum(other.residual**2)):
        return ""
    return f"noise of the inputs, averaged over rows before and after, does as well: {ANOTHER}"


def most_feigned(before: Fit, after: Fit, rows: Rows) -> float:
    """The most that noise of the inputs gains where a memory is added: no more than the best mean
    to both sides (2 log of the likelihood ratio). Infinite of anything else."""
    known = {attached.label for attached in before.model.effects}
    if any(a.kind not in OVER_TIME for a in after.model.effects if a.label not in known):
        return np.inf
    one = rows.linear(before)
    mean = rows.best_mean(before, one)
    if mean is None:
        return np.inf
    squares = float(np.sum(one.residual**2))
    return one.residual.size * float(np.log(squares / max(_left(one, mean[:, :, None]), 1e-300)))


def _left(linear: Linear, mean: Array) -> float:
    """Squares that are left beside a mean (N, m, 1)."""
    Q, r = replace(linear, feigned=mean, counts=True).basis, linear.residual.ravel()
    return float(np.sum((r - Q @ (Q.T @ r)) ** 2))


def of_inputs(fit: Fit, rows: Rows) -> float:
    """Share of what is left of held-out squares that such a mean takes: noise of what is read
    beside the reading, or readings that were averaged themselves; 0 where there is no saying."""
    plain = replace(rows.linear(fit), counts=False)
    return 0.0 if plain.feigned is None else share_taken(plain, plain.feigned[:, :, 0])
