"""The catalogue: physical effects that a model may lack, each a few lines with its source.

An effect on "input" applies to the quantity that a model declares as `corrected`, one on "output"
to what it predicts (an implicit model: to what it corrects), one on "rate of a state" to that of
any state of differential equations; others to the quantity or signal of that name. So a user's own
model gets every effect whose quantity it has.
"""

from __future__ import annotations

from casest.declaration.effect import Effect
from casest.effects.angles import harmonic, second_harmonic
from casest.effects.bias import bias_drift, bias_step, pulse, warm_up
from casest.effects.columns import (
    channel_bias,
    channel_curve,
    channel_gain,
    channel_gain_curve,
    g_sensitivity,
    temperature_bias,
    temperature_curve,
    temperature_gain,
    temperature_gain_curve,
)
from casest.effects.course import bias_course, bias_ramp, reference_wander
from casest.effects.motion import (
    axis_wobble,
    imbalance,
    lever_arm,
    speed_polynomial,
    vibration,
)
from casest.effects.noise import bias_wander, outliers, student_t
from casest.effects.over import (
    temperature_cubic,
    temperature_gain_cubic,
    temperature_gain_table,
    temperature_table,
)
from casest.effects.rates import (
    coupling,
    dry_friction,
    forcing,
    linear_damping,
    quadratic_damping,
    steady_drive,
)
from casest.effects.reference import reference_drift, table_angle
from casest.effects.response import (
    axis_gain,
    cross_axis,
    cross_quadratic,
    cubic,
    dead_band,
    dead_zone,
    floor,
    gain_by_sign,
    gain_matrix,
    quadratic,
    saturation,
    signed_cubic,
    signed_quadratic,
    soft_iron,
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
    axis_gain,
    cross_axis,
    soft_iron,
    gain_matrix,
    gain_by_sign,
    quadratic,
    signed_quadratic,
    cubic,
    signed_cubic,
    cross_quadratic,
    bias_drift,
    bias_step,
    pulse,
    warm_up,
    temperature_bias,
    temperature_gain,
    temperature_curve,
    temperature_gain_curve,
    channel_bias,
    channel_gain,
    channel_curve,
    channel_gain_curve,
    g_sensitivity,
    harmonic,
    second_harmonic,
    time_delay,
    axis_delay,
    low_pass,
    creep,
    signal_lag,
    saturation,
    floor,
    dead_band,
    dead_zone,
    vibration,
    lever_arm,
    imbalance,
    axis_wobble,
    speed_polynomial,
    hysteresis,
    table_angle,
    reference_drift,
    linear_damping,
    quadratic_damping,
    dry_friction,
    steady_drive,
    coupling,
    forcing,
    reference_wander,
    bias_course,
    bias_ramp,
    bias_wander,
    outliers,
)

#: Shipped effects that the loop does not try: they are there for who asks by name.
ASKED: tuple[Effect, ...] = (
    temperature_cubic,
    temperature_gain_cubic,
    temperature_table,
    temperature_gain_table,
    student_t,
)

_SHIPPED = (*CATALOGUE, *ASKED)
_FUNCTIONS = frozenset(f.function for e in _SHIPPED for f in (e, e.otherwise) if f is not None)


def shipped(effect: Effect) -> bool:
    """Is it one of the catalogue, wherever it acts and whatever it holds? Their units are tested.

    Any other is the user's own.
    """
    return effect.function in _FUNCTIONS


__all__ = ["ASKED", "CATALOGUE", "shipped", *(e.name for e in (*CATALOGUE, *ASKED))]
