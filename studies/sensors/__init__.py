"""Sensors with something that their declared model lacks, and pairs of records of them.

Plain NumPy and SciPy: nothing here knows casest or its catalogue. Where physics has more to it than
a formula of one term, so have these: creep is a stretched exponential or two time constants,
hysteresis is Bouc and Wen's or three plays, a lag is looked up in a dense simulation.

`made(kind, seed)` gives two records of one sensor, moved differently; where the effect happens but
once (a magnet, a field that sways) the second is without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from sensors.magnetometers import late_attitude, magnet, motor, soft_iron, sway
from sensors.motions import between
from sensors.one_reading import creeping, cycled, late_thermometer, one_sided, turned_shaft, warming
from sensors.three_axes import bent_by_warmth, few_poses, unlike_axes
from sensors.world import Sensor, World

#: Names that say the same of these records: two series against each other in time. A lag of which
#: time constant is short against the motion is a delay, and a fast creep.
LATE = ("signal_lag", "low_pass", "time_delay", "axis_delay", "creep")


@dataclass(frozen=True)
class Kind:
    """What makes it, its sizes from the least to the largest, and the names that are right."""

    sensor: Sensor
    sizes: tuple[float, float]
    right: tuple[str, ...]


#: Largest sizes are such that the best single term (one time constant, a sign, a cubic) leaves
#: less than 0.45 of the noise, which is 10 % of the error, in 88 to 100 of 100 visible worlds.
KINDS: dict[str, Kind] = {
    "load cell that creeps": Kind(creeping, (3e-4, 6e-3), ("creep",)),
    "load cell with hysteresis": Kind(cycled, (3e-5, 6e-4), ("hysteresis",)),
    "load cell that warms up": Kind(warming, (1e-4, 1e-2), ("warm_up",)),
    "gain by sign": Kind(one_sided, (2e-4, 3e-2), ("gain_by_sign",)),
    "late thermometer": Kind(late_thermometer, (0.05, 3.0), LATE),
    "gravity once per turn": Kind(turned_shaft, (1e-4, 1e-2), ("harmonic",)),
    "soft iron, one gain": Kind(
        partial(soft_iron, one=True), (1e-3, 0.1), ("soft_iron", "axis_gain", "cross_axis")
    ),
    "soft iron, gain per axis": Kind(
        partial(soft_iron, one=False), (1e-3, 0.1), ("soft_iron", "cross_axis")
    ),
    "gains unlike": Kind(unlike_axes, (1e-4, 3e-2), ("axis_gain", "soft_iron", "gain_matrix")),
    "few poses, skew": Kind(few_poses, (4e-4, 3e-2), ("cross_axis", "soft_iron", "gain_matrix")),
    "motor current": Kind(motor, (2e-3, 0.2), ("channel_bias(current)",)),
    "magnet comes and goes": Kind(magnet, (2e-3, 0.2), ("pulse",)),
    "field that sways": Kind(sway, (5e-4, 2e-2), ("reference_wander",)),
    "late attitude": Kind(late_attitude, (0.05, 5.0), LATE[:-1]),
    "bias bent by warmth": Kind(
        bent_by_warmth, (3e-4, 1e-2), ("temperature_curve", "temperature_bias")
    ),
}


def made(kind: str, seed: int, *, there: bool = True) -> tuple[World, World]:
    """Two records of one sensor; without the effect where it is not to be there."""
    chosen = KINDS[kind]
    rng = np.random.default_rng([seed, there, *kind.encode()])
    own, first, second = rng.spawn(3)
    size = between(rng, *chosen.sizes) if there else 0.0
    record = chosen.sensor(own, size)
    return record(first, True), record(second, False)
