"""`--noise-law`: what the noise of a residual is distributed by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from casest.cli.shared import echo, progress
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model


def with_noise_law(model: Model, runs: Sequence[Run], law: str) -> Model:
    """The model with its noise by `normal`, `t` (degrees of freedom estimated) or `t:NU`."""
    from casest.diagnose.noise.student import estimated, with_student

    name, colon, number = law.partition(":")
    if law == "normal":
        return model
    if name != "t" or bool(colon) != bool(number):
        raise UsageError(f"--noise-law {law}: there is normal, t, and t:NU, as t:4")
    if model.noise is not None:
        raise UsageError(
            f"--noise-law {law}: noise that was stated is normal; leave --sensor-noise out, and "
            "the residual says how large it is"
        )
    if colon:
        return with_student(model, _freedom(law, number))
    progress("looking for the degrees of freedom of the noise")
    model, freedom = estimated(model, runs)
    said = (
        f"Student's t with {freedom:g} degrees of freedom"
        if math.isfinite(freedom)
        else "normal: its tails are no heavier"
    )
    echo(f"casest: the noise is {said}", err=True)
    return model


def _freedom(law: str, number: str) -> float:
    try:
        freedom = float(number)
    except ValueError:
        freedom = -1.0
    if not 0 < freedom < math.inf:
        raise UsageError(f"--noise-law {law}: degrees of freedom are a number above zero")
    return freedom
