"""Figures as data for the page's script: panels, their axes with units, and compact arrays."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.report.html.numbers import printed_unit
from casest.report.html.page import escaped, prose, tag
from casest.report.html.still import still

#: Arrays up to this length are written out as numbers.
SHORT = 400
#: Half width of a 95 % band in standard deviations.
BAND = 1.96


@dataclass
class Figures:
    """All figures of a page, and the arrays that their series share."""

    figures: list[dict[str, Any]] = field(default_factory=list)
    arrays: list[Any] = field(default_factory=list)
    _known: dict[bytes, int] = field(default_factory=dict)
    _values: list[Array] = field(default_factory=list)

    def array(self, values: Array, *, exact: bool = False) -> int:
        """Number of an array; 16 bits a value, or single precision where `exact`."""
        values = np.asarray(values, dtype=float)
        key = values.tobytes() + bytes([exact])
        if key not in self._known:
            self._known[key] = len(self.arrays)
            self.arrays.append(_stored(values, exact))
            self._values.append(values)
        return self._known[key]

    def series(
        self, kind: str, look: str, x: Array, *, exact: bool = False, **columns: Array
    ) -> dict[str, Any]:
        """A line, points, stems, dots or a ribbon: `y`, or `low` and `high`, over x."""
        found = {"kind": kind, "look": look, "x": self.array(x, exact=True)}
        return found | {name: self.array(v, exact=exact) for name, v in columns.items()}

    def add(
        self,
        name: str,
        caption: tuple[str, str],
        panels: Sequence[dict[str, Any]],
        *,
        two: bool = False,
        zoom: bool = False,
    ) -> str:
        """A figure's place in the page, and still pictures for a reader without scripts.

        `two`: panels stand in pairs, before beside after.
        """
        self.figures.append({"id": name, "panels": list(panels), "two": two, "zoom": zoom})
        bold, text = caption
        said = tag("figcaption", tag("b", escaped(bold)), " ", prose(text))
        box = tag("div", class_="panels two" if two else "panels")
        pictures = "".join(still(p, self._values.__getitem__) for p in panels)
        others = tag("noscript", tag("div", pictures, class_="panels still"))
        inside = said, _TOOLS if zoom else "", box, others
        return tag("figure", *inside, id=name, class_="zoom" if zoom else "")


_TOOLS = (
    '<div class="tools"><button type="button" data-action="all">whole record</button>'
    '<button type="button" data-action="in" aria-label="zoom in">+</button>'
    '<button type="button" data-action="out" aria-label="zoom out">−</button>'
    '<button type="button" data-action="left" aria-label="earlier">←</button>'
    '<button type="button" data-action="right" aria-label="later">→</button>'
    "<span>drag to zoom, double-click for the whole</span><output></output></div>"
)


def axis(
    label: str, unit: str, low: float, high: float, *, log: bool = False, room: float = 0.0
) -> dict[str, Any]:
    """An axis with its label, unit and range; `room` is a share of it left free at either end."""
    if not (math.isfinite(low) and math.isfinite(high)):
        low, high = (0.1, 1.0) if log else (0.0, 1.0)
    if log:
        low = max(low, 1e-300)
        high = max(high, low * 1.001)
        factor = (high / low) ** room
        low, high = low / factor, high * factor
    else:
        wide = (high - low) or max(abs(high), 1.0) * 0.1
        low, high = low - room * wide, high + room * wide
    said = "1" if unit == f"[{label}]" else printed_unit(unit) or "1"  # its own name says no more
    return {"label": label, "unit": said, "range": [low, high], "log": log}


def panel(
    title: str,
    x: dict[str, Any],
    y: dict[str, Any],
    series: Sequence[dict[str, Any]],
    **more: Any,
) -> dict[str, Any]:
    """One set of axes. More: `bands`, `marks`, `categories`, `height` in pixels."""
    return {"title": title, "x": x, "y": y, "series": list(series), **more}


def _stored(values: Array, exact: bool) -> Any:
    finite = values[np.isfinite(values)]
    if len(values) <= SHORT:
        return [float(f"{v:.6g}") if np.isfinite(v) else None for v in values.tolist()]
    if exact and len(finite) == len(values):
        step = (values[-1] - values[0]) / (len(values) - 1)
        even = values[0] + step * np.arange(len(values))
        if np.abs(values - even).max() < 0.01 * abs(step):
            return {"start": float(values[0]), "step": float(step), "n": len(values)}
    if exact:
        return {"f32": _base64(values.astype("<f4"))}
    scale = float(np.abs(finite).max(initial=0.0)) / 32767 or 1.0
    counts = np.where(np.isfinite(values), np.round(values / scale), -32768)
    return {"i16": _base64(counts.astype("<i2")), "scale": scale}


def _base64(values: np.ndarray[Any, Any]) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")
