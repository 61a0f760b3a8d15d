"""Scores on a record of its own that neither fit nor decision has seen."""

from __future__ import annotations

from collections.abc import Sequence

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.closing import Closing
from casest.effects.placing import prepared
from casest.estimate.held_out import residuals, split


def scored(
    closing: Closing, runs: Sequence[Run]
) -> tuple[tuple[Run, ...], list[Array], list[Array]]:
    """The samples that are scored, and their residuals before and after: the same samples."""
    models = closing.before.model, closing.after.model
    halves = [split(run, models) for run in prepared(closing.before.model, runs)]
    before, after = (
        [residuals(found.model, found.values, *half) for half in halves]
        for found in (closing.before, closing.after)
    )
    return tuple(half[1] for half in halves), before, after
