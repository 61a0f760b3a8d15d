"""What of a residual goes with the size of what is measured, sample by sample.

An error of the reference, a field that sways, has its direction: where a body turns, it is slow in
no axis of the sensor, and slow along the reference.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.declaration.effect import effect
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.symbols import param
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.slopes import slopes
from casest.effects.placing import placed_in
from casest.errors import CasestError
from casest.leastsquares.problem import Point, Problem


@effect(on="input")
def swell(u: SX, *, k: SX = param()) -> SX:
    """A reference of another size: its slope is that of the residual in it."""
    return u * (1 + k)


def along_reference(problem: Problem, point: Point, residuals: Sequence[Array]) -> list[Array]:
    """The part (N, 1) of residuals (N, m) along what a larger reference would do to them, per run.

    None of them where a sample has one residual, or the model has no input of its own.
    """
    if len(problem.model.axes) < 2:
        return []
    rows = [np.arange(len(run)) for run in problem.runs]
    try:
        what = Candidate(placed_in(swell, problem.model))
        ((_, slope),) = slopes(problem, point, [what], rows)
    except CasestError:
        return []
    if isinstance(slope, CasestError):
        return []
    length = np.linalg.norm(slope[:, :, 0], axis=1, keepdims=True)
    direction = slope[:, :, 0] / np.maximum(length, 1e-300)
    ends = np.cumsum([len(run) for run in problem.runs])[:-1]
    parts = zip(np.split(direction, ends), residuals, strict=True)
    return [np.sum(d * r, axis=1, keepdims=True) for d, r in parts]
