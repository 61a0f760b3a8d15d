"""Student's t as the law of the noise, with its degrees of freedom stated or estimated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.diagnose.noise.tails import even_scale, tails
from casest.effects.noise import student_t
from casest.errors import DataError
from casest.estimate.calibrate import attempt

#: Degrees of freedom to begin with, rounds of fits at most, and a change of 1/ν that is none.
FIRST, ROUNDS, STILL = 4.0, 6, 0.01
#: Fewest residuals from which degrees of freedom can be estimated.
FEWEST = 50


def with_student(model: Model, freedom: float) -> Model:
    """The model with noise by Student's t with so many degrees of freedom."""
    return model.with_effect(student_t.holding(nu=freedom))


def estimated(model: Model, runs: Sequence[Run]) -> tuple[Model, float]:
    """The same with those that the residual of the fit shows, which is made anew with them, and
    they; the model as it is, and infinity, where tails are no heavier than normal."""
    count = sum(map(len, runs)) * len(model.axes)
    if count < FEWEST:
        raise DataError(
            f"--noise-law t: {count} residuals do not show how heavy tails are, {FEWEST} would: "
            "state it, --noise-law t:4"
        )
    freedom = FIRST
    for _ in range(ROUNDS):
        found = attempt(with_student(model, freedom), runs, intervals=False)
        residuals = found.problem.residuals(found.point)
        whole = [np.zeros(1, dtype=np.int_) for _ in residuals]
        even = even_scale(residuals, whole, unequal=False)
        before, freedom = freedom, tails(np.concatenate([z.ravel() for z in even])).freedom
        if not np.isfinite(freedom):
            return model, np.inf
        if abs(1 / freedom - 1 / before) < STILL:
            break
    freedom = float(f"{freedom:.3g}")
    return with_student(model, freedom), freedom
