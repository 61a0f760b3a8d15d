"""A magnetometer on a body whose attitude is recorded too, for the command line.

casest close examples/compass.py RECORD.csv          (columns m_x m_y m_z, roll pitch yaw or qw …)
casest calibrate examples/compass.py RECORD.csv --effects examples/compass.py:soft_iron
"""

from casest import Residual, attitude, effect, horzcat, model, param, quantity, signal, vertcat


@model
def compass(m=signal(3, "uT"), attitude=attitude(), *, earth=param(3, "uT"), hard=param(3, "uT")):
    """The earth's field, seen from the body, and what the body's own iron adds (hard iron)."""
    field = quantity("field", attitude.T @ earth, "uT")
    return Residual(measured=m, predicted=quantity("reading", field + hard, "uT"), corrected=field)


@effect(on="field", formula="field + K·field, tr K = 0")
def soft_iron(field, *, k=param(8)):
    """Iron that the field magnetises, gains and skewed axes: all of a 3x3 but the common gain.

    That one cannot be told from the length of `earth`. `k` row by row; the first entry is what
    makes the trace zero.
    """
    rows = [[-k[3] - k[7], k[0], k[1]], [k[2], k[3], k[4]], [k[5], k[6], k[7]]]
    return field + vertcat(*(horzcat(*row) for row in rows)) @ field
