"""The catalogue: physical effects that a model may lack, each a few lines with its source.

An effect on "input" applies to the quantity that a model declares as `corrected`, one on "output"
to what it predicts (an implicit model: to what it corrects); others to the quantity or signal of
that name. So a user's own model gets every effect whose quantity it has.
"""

from __future__ import annotations

from casest.declaration.effect import Effect
from casest.effects.bias import (
    bias_drift,
    bias_step,
    channel_bias,
    channel_gain,
    reference_drift,
    temperature_bias,
    temperature_gain,
)
from casest.effects.motion import (
    axis_wobble,
    imbalance,
    lever_arm,
    speed_polynomial,
    vibration,
)
from casest.effects.noise import bias_wander, outliers
from casest.effects.reference import table_angle
from casest.effects.response import (
    cross_axis,
    cross_quadratic,
    cubic,
    dead_zone,
    quadratic,
    saturation,
    signed_cubic,
    signed_quadratic,
)
from casest.effects.timing import (
    axis_delay,
    creep,
    hysteresis,
    low_pass,
    signal_lag,
    time_delay,
)

CATALOGUE: tuple[Effect, ...] = (
    cross_axis,
    quadratic,
    signed_quadratic,
    cubic,
    signed_cubic,
    cross_quadratic,
    bias_drift,
    bias_step,
    temperature_bias,
    temperature_gain,
    channel_bias,
    channel_gain,
    time_delay,
    axis_delay,
    low_pass,
    creep,
    signal_lag,
    saturation,
    dead_zone,
    vibration,
    lever_arm,
    imbalance,
    axis_wobble,
    speed_polynomial,
    hysteresis,
    table_angle,
    reference_drift,
    bias_wander,
    outliers,
)

_FUNCTIONS = frozenset(f.function for e in CATALOGUE for f in (e, e.otherwise) if f is not None)


def shipped(effect: Effect) -> bool:
    """Is it one of the catalogue, wherever it acts and whatever it holds? Their units are tested.

    Any other is the user's own.
    """
    return effect.function in _FUNCTIONS


__all__ = ["CATALOGUE", "shipped", *(e.name for e in CATALOGUE)]
