"""What `casest fleet` prints."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from pathlib import Path

from casest.report.text.layout import WIDTH
from casest.results.fleet import FleetResult

#: Kinds of what is rejected, in words for one and for several.
KINDS = {
    "file": ("file cannot be read", "files cannot be read"),
    "nameless": ("row without a name", "rows without a name"),
    "twice": ("row of a sensor that is there twice", "rows of sensors that are there twice"),
    "readings": ("sensor with unusable readings", "sensors with unusable readings"),
    "refused": ("sensor refused", "sensors refused"),
}


def fleet_text(result: FleetResult, folder: Path) -> str:
    """Head, parameters over the fleet, why sensors are refused, what was written."""
    lines = [textwrap.fill(_head(result), WIDTH), "", *_table(result)]
    if result.reasons:
        lines += ["", "Refused for:"]
        lines += [f"  {n:>8} {code.replace('_', ' ')}" for code, n in result.reasons.items()]
    where = f"Written: {folder}/fleet.json, fleet.html, results/, rejected.parquet"
    return "\n".join([*lines, "", textwrap.fill(where, WIDTH)])


def _head(result: FleetResult) -> str:
    rejected = ", ".join(f"{n} {KINDS[kind][n > 1]}" for kind, n in result.rejected.items() if n)
    return (
        f"{result.model} on {result.dataset}: {result.trusted} of {result.sensors} sensors trusted"
        + (f"; {rejected}: rejected.parquet names them" if rejected else "")
    )


def _table(result: FleetResult) -> Iterator[str]:
    """One line per unknown: mean and spread over the fleet, and what one sensor's is worth."""
    if not result.trusted:
        return
    rows = [("parameter", "mean", "spread", "least", "largest", "std of one", "unit")]
    for name, p in result.parameters.items():
        numbers = (p.mean, p.std, p.least, p.largest, p.typical_std)
        said = ["-" if v is None else f"{v:.4g}" for v in numbers]
        rows.append((name, *said, "" if p.unit == "1" else p.unit))  # type: ignore[arg-type]
    widths = [max(len(row[k]) for row in rows) for k in range(7)]
    for row in rows:
        first = f"  {row[0]:<{widths[0]}}"
        middle = "".join(f"  {cell:>{w}}" for cell, w in zip(row[1:6], widths[1:6], strict=True))
        yield f"{first}{middle}  {row[6]}".rstrip()
