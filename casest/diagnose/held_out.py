"""Scores on a record of its own that neither fit nor decision has seen."""

from __future__ import annotations

from collections.abc import Sequence

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.closing import Closing
from casest.effects.placing import prepared
from casest.estimate.held_out import lasting, residuals, split
from casest.leastsquares.kinds import noises


def scored(
    closing: Closing, runs: Sequence[Run]
) -> tuple[tuple[Run, ...], list[Array], list[Array]]:
    """The samples that are scored, and their residuals before and after: the same samples."""
    alike = noises(closing.after.model)  # residuals that are counted in deviations, in the same
    each = [(lasting(f).having(**alike), f.values) for f in (closing.before, closing.after)]
    models = [model for model, _ in each]
    halves = [split(run, models) for run in prepared(closing.before.model, runs)]
    before, after = (
        [residuals(model, model.among(values), *half) for half in halves] for model, values in each
    )
    return tuple(half[1] for half in halves), before, after
