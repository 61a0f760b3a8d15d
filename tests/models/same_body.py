"""Two gyroscopes on one body, for the command line too."""

from __future__ import annotations

from casest import Residual, model, param, quantity, signal
from casest.declaration.shapes import rotation_matrix


@model
def same_body(
    w=signal(3, "rad/s"),
    other=signal(3, "rad/s"),
    *,
    turn=param(rotation_matrix),
    bias=param(3, "rad/s"),
):
    """What the other one sees, in axes of one's own."""
    return Residual(measured=w, predicted=quantity("reading", turn @ other + bias, "rad/s"))
