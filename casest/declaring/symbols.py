"""Signals, parameters and constants: the symbol table that a model's signature declares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from casest.errors import DeclarationError

Array = NDArray[np.float64]
Scope = Literal["all", "run"]


@dataclass(frozen=True)
class Signal:
    """A measured input of a model, one value per sample.

    `size` is the number of numbers per sample (9 for a rotation matrix, row by row);
    `unit` is None where any unit will do (the data's own is then kept).
    """

    name: str
    size: int
    unit: str | None
    kind: Literal["plain", "rotation"] = "plain"


def signal(shape: int | str = 1, unit: str | None = None) -> Any:
    """Declare a measured input: `signal("s")`, `signal(3, "m/s^2")`, `signal(3)` (any unit)."""
    if isinstance(shape, str):
        shape, unit = 1, shape
    return Signal("", shape, unit)


def attitude() -> Any:
    """Declare a measured rotation, body to reference frame: a 3x3 matrix in the model's body.

    Data give it as `roll pitch yaw` (intrinsic Z-Y-X) or as `qw qx qy qz`.
    """
    return Signal("", 9, None, kind="rotation")
