"""A gyroscope at rest, for the command line: a record of it says what its bias follows.

casest close examples/at_rest.py RECORD.csv --columns v=gyrox,gyroy,gyroz --unit v=rad/s
"""

from casest import Residual, model, param, quantity, signal


@model
def constant_bias(v=signal(3, "rad/s"), *, bias=param(3, "rad/s")):
    """At rest a gyroscope reads its bias."""
    return Residual(measured=v, predicted=quantity("reading", bias, "rad/s"))
