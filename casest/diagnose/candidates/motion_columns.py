"""Columns that record the motion that a sensor is carried through, and no influence on it.

What the sensor meets while it is moved goes with the motion, whatever it is: places where the field
differs, axes that come late, a body that bends. So a gain that follows a gyro's axis may describe
an error, and names no cause. A temperature, a current, a supply is an influence of its own.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from casest.data.matching import vectors
from casest.data.run import Run
from casest.declaration.model import Model
from casest.diagnose.levels import LEVELS
from casest.units import known, size

#: What inertial sensors and magnetometers measure.
_MEASURED = tuple(size(unit)[1] for unit in ("m/s^2", "rad/s", "T"))
#: What their columns are called where no unit says it: ax, gyr_y, mag_z, qw, pitch.
_CALLED = re.compile(
    r"(^|_)(a|acc|accel|g|gyr|gyro|w|omega|m|mag)_?[xyz]$|(^|_)q(uat)?_?[wxyz0-3]$"
    r"|^(roll|pitch|yaw)$",
    re.IGNORECASE,
)


def columns_of_motion(model: Model, runs: Sequence[Run]) -> frozenset[str]:
    """Columns of the motion, where the model's sensor is one that is moved. `runs` are prepared."""
    run = runs[0]
    moved = any(
        s.kind == "rotation"
        or _is_motion("", run.units.get(s.name))
        or any(_CALLED.search(name) for name in run.called.get(s.name, ()))
        for s in model.signals
    )
    if not moved and not any(s.size == 3 for s in model.signals):
        return frozenset()
    named = {n for n in run.columns if _is_motion(n, run.column_units.get(n))}
    return frozenset(named | _axes_of_a_vector(runs))


def _axes_of_a_vector(runs: Sequence[Run]) -> set[str]:
    """Columns without a unit that are three by their names, and do not go alike: another sensor's
    axes, whatever it is called. Three thermometers do go alike."""
    units = runs[0].column_units
    # What is a number in all runs is a signal of each.
    numbers = [n for n in runs[0].columns if all(n in run.signals for run in runs)]
    unknown = [n for n in numbers if not _says(units.get(n))]
    found = set[str]()
    for group in vectors(unknown):
        columns = [np.concatenate([run.signals[n][:, 0] for run in runs]) for n in group]
        with np.errstate(invalid="ignore"):
            untold = 1 - np.corrcoef(columns) ** 2
        if np.nanmax(untold, initial=0.0) > LEVELS.stand_in:
            found.update(group)
    return found


def _is_motion(name: str, unit: str | None) -> bool:
    return size(unit)[1] in _MEASURED if unit and _says(unit) else bool(_CALLED.search(name))


def _says(unit: str | None) -> bool:
    """Does a unit say what is measured?"""
    return bool(unit and known(unit) and "count" not in unit)
