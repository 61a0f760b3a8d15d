"""What cannot be told apart, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casest.declaration.shapes import Array


def combination(scaled: Array, scale: Array, names: Sequence[str]) -> str:
    """The unknowns that move together in a direction, the largest movers first."""
    scaled = scaled / np.abs(scaled).max()
    movers = [int(i) for i in np.argsort(-np.abs(scaled)) if abs(scaled[i]) > 0.05]
    if len(movers) == 1:
        return f"nothing is said of {names[movers[0]]}"
    change = scaled[movers] * scale[movers]
    change = change / change[0]
    ratio = ", ".join(f"{names[i]} {c:+.3g}" for i, c in zip(movers[1:], change[1:], strict=True))
    return f"{names[movers[0]]} +1 goes with {ratio}, and changes nothing"
