"""A magnetometer and the gyroscope beside it, moved about without rests.

The field of the Earth keeps still while the body turns, so that its course in the body's axes is
what the gyroscope says: ḟ = −(ω − drift)×f. What the magnetometer reads of it, iron·f + offset,
tells soft and hard iron, how the two sensors are mounted against one another and the gyroscope's
bias, with neither attitude nor strength of the field known (Rodríguez-Martínez & Troni, "MAGYC",
arXiv 2410.13827; Huang, Hendeby & Skog, arXiv 2505.16662). Here every reading is weighed by its
noise along the most probable course of the field; noise of the gyroscope bends that course.
"""

from __future__ import annotations

from casest import cross, signal, vertcat
from casest.dynamics import Motion, dynamics, measured, state


@dynamics
def mag_gyro(
    m=signal(3, "uT"),
    w=signal(3, "rad/s"),
    *,
    field=state(3, "uT", start=(0.0, 0.0, 50.0), std=50.0),
    iron=state(8, "1", start=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), std=0.3),
    offset=state(3, "uT", std=20.0),
    drift=state(3, "rad/s", intensity=1e-10, std=0.02),
):
    """Soft iron, hard iron and the gyroscope's bias from a magnetometer and a gyroscope in motion.

    field is that of the Earth in the gyroscope's axes, in the scale of the magnetometer's x; iron
    what the magnetometer makes of it, row by row behind the first number, which is one. The bias
    wanders by 0.03 °/s in an hour: a usual MEMS gyroscope's.
    """
    rows = (vertcat(1, iron[0:2]), iron[2:5], iron[5:8])
    seen = vertcat(*[row.T @ field for row in rows])
    return Motion(
        rates={"field": -cross(w - drift, field)},
        outputs=(measured(m, seen + offset, std=0.5),),
    )
