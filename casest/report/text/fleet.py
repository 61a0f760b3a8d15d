"""What `casest fleet` prints."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from pathlib import Path

from casest.report.text.layout import WIDTH, item
from casest.results.fleet import AGAINST, COMMON, CommonEffect, FleetClosed, FleetResult, OwnEffect
from casest.results.rounding import percent, rounded

#: Kinds of what is rejected, in words for one and for several.
KINDS = {
    "file": ("file cannot be read", "files cannot be read"),
    "nameless": ("row without a name", "rows without a name"),
    "twice": ("row of a sensor that is there twice", "rows of sensors that are there twice"),
    "readings": ("sensor with unusable readings", "sensors with unusable readings"),
    "refused": ("sensor refused", "sensors refused"),
}


def fleet_text(result: FleetResult, folder: Path, misread: int = 0) -> str:
    """Head, parameters over the fleet, why sensors are refused, what was written.

    `misread`: trusted sensors of which one reading is far off.
    """
    lines = [textwrap.fill(_head(result), WIDTH), "", *_table(result)]
    if result.reasons:
        lines += ["", "Refused for:"]
        lines += [f"  {n:>8} {AGAINST.get(code, code)}" for code, n in result.reasons.items()]
    if misread:
        one = "one trusted sensor" if misread == 1 else f"{misread:,} trusted sensors"
        said = f"of {one} a reading is far off (misfit): see fleet.html; --noise refuses such"
        lines += ["", item(said)]
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


def common_text(result: FleetClosed, folder: Path | None) -> str:
    """What the sensors have in common: each effect with its size, before and after."""
    head = f"{result.model} on {result.dataset}: {result.sensors} sensors have {result.said}"
    lines = [textwrap.fill(head, WIDTH)]
    for e in result.effects:
        lines += ["", *_common_lines(e)]
    if result.own is not None:
        lines += ["", *_own_lines(result.own)]
    if result.invisible:
        lines += ["", item(f"no pose could show: {', '.join(result.invisible)}")]
    if result.not_asked:
        lines += ["", item(result.not_asked)]
    if folder is not None:
        lines += ["", f"Written: {folder}/{COMMON}, common.html"]
    return "\n".join(lines)


def _common_lines(e: CommonEffect) -> Iterator[str]:
    yield f"  {e.name} (chance {e.chance:.2g} where there is none):"
    for name, (value, std) in e.parameters.items():
        yield "    {}  {} ± {}".format(name, *rounded(value, std))
    fallen = percent(1 - e.sigma_after / e.sigma_before)
    yield item(
        f"sigma of sensors that had no part in that size: {e.sigma_before:.5g} before, "
        f"{e.sigma_after:.5g} after ({fallen} less)"
    )
    far = sorted(e.moved.items(), key=lambda pair: -abs(pair[1]))[:3]
    moves = ", ".join(f"{name} by {by:.2g}" for name, by in far)
    yield item(f"declared unknowns move on average, in their own standard deviations: {moves}")
    if e.indistinguishable_from:
        yield item(f"explains as much: {', '.join(e.indistinguishable_from)}")
    for column, chance in e.follows.items():
        differs = "differs with" if chance < 0.001 else "does not differ with"
        yield item(f"its size {differs} {column} (chance {chance:.2g})")


def _own_lines(e: OwnEffect) -> Iterator[str]:
    yield f"  {e.name}, its spread over {e.sensors} sensors (chance {e.chance:.2g} without):"
    for name, (value, error) in e.parameters.items():
        yield "    {}  rms {} ± {}".format(name, *rounded(value, error))
    yield item(
        f"sigma over degrees of freedom: {e.sigma_before:.5g} before, {e.sigma_after:.5g} with it "
        "in each"
    )
    if e.indistinguishable_from:
        yield item(f"explains as much: {', '.join(e.indistinguishable_from)}")
