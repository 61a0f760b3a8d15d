"""A panel as a still picture, for readers without scripts: what plot.js draws, but no tools."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from casest.declaration.shapes import Array
from casest.report.html.numbers import printed
from casest.report.html.page import escaped

#: Width of a panel and what is left free at its edges, in pixels.
WIDTH, LEFT, RIGHT, TOP, BOTTOM = 640, 90, 10, 20, 38
#: Columns to which a long series is thinned, each by its least and greatest value.
COLUMNS = 200

Place = Callable[[Any], Array]


def still(panel: Mapping[str, Any], values: Callable[[int], Array]) -> str:
    """SVG of a panel (as in `figures.panel`); `values` are the arrays by their numbers."""
    height = 330 if panel.get("square") else panel.get("height", 170)
    right = LEFT + height - TOP - BOTTOM if panel.get("square") else WIDTH - RIGHT
    px = _scale(panel["x"], LEFT, right)
    py = _scale(panel["y"], height - BOTTOM, TOP)
    low, high = (float(py(v)) for v in panel["y"]["range"])
    box = f'x="{LEFT}" y="{high:.0f}" width="{right - LEFT}" height="{low - high:.0f}"'
    parts = [
        *_bands(panel, py, right),
        *_ticks(panel, px, py, height),
        *(part for one in panel["series"] for part in _series(one, values, px, py)),
        f'<rect class="frame" {box}/>',
        f'<text class="title" x="{LEFT}" y="13">{escaped(panel["title"])}</text>',
        f'<text class="label" x="{(LEFT + right) / 2:.0f}" y="{height - 5}" text-anchor="middle">'
        f"{escaped(_labelled(panel['x']))}</text>",
        f'<text class="label" x="{right}" y="13" text-anchor="end">{_keys(panel)}</text>',
    ]
    said = escaped(f"{panel['title']}: {_labelled(panel['y'])} over {_labelled(panel['x'])}")
    size = f"0 0 {WIDTH} {height}"
    return f'<svg viewBox="{size}" role="img" aria-label="{said}">{"".join(parts)}</svg>'


def _scale(axis: Mapping[str, Any], begin: float, end: float) -> Place:
    """From values to pixels; what lies outside stays at the edge."""
    size = np.log10 if axis["log"] else np.asarray
    low, high = (float(size(v)) for v in axis["range"])

    def place(v: Any) -> Array:
        share = (size(np.maximum(v, 1e-300) if axis["log"] else v) - low) / ((high - low) or 1.0)
        return np.asarray(begin + np.clip(share, 0, 1) * (end - begin))

    return place


def _labelled(axis: Mapping[str, Any]) -> str:
    label, unit = axis["label"], axis["unit"]
    own = re.fullmatch(r"\[[^\]]*\]", unit)  # brackets of its own
    return str(label) if unit == "1" else f"{label} {unit}" if own else f"{label} ({unit})"


def _keys(panel: Mapping[str, Any]) -> str:
    """What is drawn: the upright axis, and the names of several series."""
    named = [f"● {s['name']}" for s in panel["series"] if s.get("name")]
    return escaped("  ".join([*named, _labelled(panel["y"])]).strip())


def _bands(panel: Mapping[str, Any], py: Place, right: float) -> Iterator[str]:
    for band in panel.get("bands") or []:
        high, low = float(py(band["high"])), float(py(band["low"]))
        size = f'width="{right - LEFT}" height="{low - high:.1f}"'
        yield f'<rect class="band" x="{LEFT}" y="{high:.1f}" {size}/>'
        for y in (high, low):
            yield f'<path class="edge" d="M{LEFT} {y:.1f}H{right}"/>'


def _ticks(panel: Mapping[str, Any], px: Place, py: Place, height: int) -> Iterator[str]:
    names = panel.get("categories")
    across = _at(panel["x"], 7)
    upright = list(range(len(names))) if names else _at(panel["y"], max(3, (height - 58) // 28))
    bottom, top = height - BOTTOM, TOP
    ends = [float(px(v)) for v in panel["x"]["range"]]
    for v in across:
        x = float(px(v))
        yield f'<path class="grid" d="M{x:.1f} {top}V{bottom}"/>'
        yield f'<text x="{x:.1f}" y="{bottom + 15}" text-anchor="middle">{_text(v)}</text>'
    for v in upright:
        y, said = float(py(v)), escaped(names[v]) if names else _text(v)
        yield f'<path class="grid" d="M{ends[0]:.1f} {y:.1f}H{ends[1]:.1f}"/>'
        yield f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{said}</text>'


def _at(axis: Mapping[str, Any], count: int) -> list[float]:
    """Round numbers (1, 2, 5 of a decade), or decades, within the axis."""
    low, high = axis["range"]
    if axis["log"]:
        first, last = np.ceil(np.log10(low) - 1e-9), np.floor(np.log10(high) + 1e-9)
        every = max(1.0, np.ceil((last - first + 1) / count))
        decades = 10.0 ** np.arange(first, last + 0.5, every)
        return list(decades) if len(decades) > 1 else [low, high]
    raw = (high - low) / count or 1.0
    size = 10.0 ** np.floor(np.log10(raw))
    step = next(f * size for f in (1, 2, 5, 10) if f * size >= raw * (1 - 1e-9))
    return [float(k * step) for k in np.arange(np.ceil(low / step), np.floor(high / step) + 0.5)]


def _text(value: float) -> str:
    return printed(f"{value:.4g}") if abs(value) > 1e-14 else "0"


def _series(
    one: Mapping[str, Any], values: Callable[[int], Array], px: Place, py: Place
) -> Iterator[str]:
    kind, look, x = one["kind"], one["look"], px(values(one["x"]))
    if kind == "ribbon":
        low, high = (py(values(one[end])) for end in ("low", "high"))
        step = max(1, len(x) // COLUMNS)
        there = np.isfinite(low[::step] + high[::step])
        edge = [np.concatenate([v[::step][there], w[::step][there][::-1]])
                for v, w in ((x, x), (high, low))]  # fmt: skip
        yield f'<path class="ribbon {look}" d="{_path(*edge)}Z"/>' if there.any() else ""
        return
    y = py(values(one["y"]))
    if kind in ("spans", "bars"):
        ends = [(px if kind == "spans" else py)(values(one[end])) for end in ("low", "high")]
        move = "M{0:.1f} {2:.1f}H{1:.1f}" if kind == "spans" else "M{2:.1f} {0:.1f}V{1:.1f}"
        for k in np.flatnonzero(np.isfinite(x + y)):
            d = move.format(ends[0][k], ends[1][k], (y if kind == "spans" else x)[k])
            yield f'<path class="line {look}" d="{d}"/>'
    if kind in ("spans", "bars", "dots") or (kind == "points" and len(x) <= 2 * COLUMNS):
        shape, r = ("point", 2) if kind == "points" else ("dot", 3.6)
        for k in np.flatnonzero(np.isfinite(x + y)):
            yield f'<circle class="{shape} {look}" cx="{x[k]:.1f}" cy="{y[k]:.1f}" r="{r}"/>'
    elif kind == "stems":
        zero = float(py(0.0))
        stems = (f"M{a:.1f} {zero:.1f}V{b:.1f}" for a, b in zip(x, y, strict=True))
        yield f'<path class="line {look}" d="{"".join(stems)}"/>'
    else:
        yield f'<path class="line {look}" d="{_path(*_thinned(x, y))}"/>'


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """Least and greatest of each column, in their order: no peak is lost."""
    if len(x) <= 2 * COLUMNS:
        return x, y
    parts = np.array_split(np.arange(len(x)), COLUMNS)
    found = [sorted({int(p[k]) for k in _ends(y[p])}) for p in parts]
    kept = [k for pair in found for k in pair]
    return x[kept], y[kept]


def _ends(y: Array) -> Sequence[Any]:
    there = np.isfinite(y)
    if not there.any():
        return [0]
    return [np.argmin(np.where(there, y, np.inf)), np.argmax(np.where(there, y, -np.inf))]


def _path(x: Array, y: Array) -> str:
    """M and L of points; what is no number interrupts the line."""
    drawn, pen = [], "M"
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if not np.isfinite(a + b):
            pen = "M"
            continue
        drawn.append(f"{pen}{a:.1f} {b:.1f}")
        pen = "L"
    return "".join(drawn)
