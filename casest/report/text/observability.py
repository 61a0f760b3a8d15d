"""What `casest observe` prints: rank, what is hidden in words, how well the rest is seen."""

from __future__ import annotations

from collections.abc import Iterator

from casest.report.text.layout import note_lines, wrapped
from casest.results.observability import (
    Observability,
    ObservedMotion,
    ObservedParameters,
    ObservedStructure,
    Windows,
    combination_words,
    could_reach,
    number_or_not,
    weak_directions,
    weak_words,
    window_words,
)


def observe_text(result: Observability) -> str:
    """Rank, what is hidden in words, and the standard deviations that the data allow."""
    if isinstance(result, ObservedStructure):
        return structure_text(result)
    lines = [f"{result.model}: rank {result.rank} of {result.unknowns}{weak_words(result)}"]
    lines += [f"  - {words}" for words in result.unobservable]
    lines += [f"  - weak: {words}" for words in weak_directions(result)]
    lines += [f"  {could}" for could in [could_reach(result)] if could]
    if not result.unobservable and not weak_directions(result):
        lines.append("  every unknown is determined by these data")
    lines += ["", "  standard deviation that these data allow:", *_deviations(result)]
    if isinstance(result, ObservedMotion):
        lines += ["", *_over_windows(result.windows), *note_lines(result.notes)]
    return "\n".join(wrapped(lines))


def _over_windows(w: Windows) -> Iterator[str]:
    low, high = min(w.smallest_eigenvalue), max(w.smallest_eigenvalue)
    course = f"goes from {low:.3g} to {high:.3g}" if high > 0 else "is zero in all"
    yield (
        f"  over windows of {w.length_s:.3g} s the smallest eigenvalue (information over prior) "
        f"{course};"
    )
    yield f"  {window_words(w)}"


def _deviations(result: ObservedParameters | ObservedMotion) -> Iterator[str]:
    units = result.units if isinstance(result, ObservedMotion) else {}
    for name, std in result.std.items():
        rows = std if isinstance(std, list) else [std]
        rows = rows if rows and isinstance(rows[0], list) else [rows]
        for k, row in enumerate(rows):
            shown = ", ".join(map(number_or_not, row))
            unit = units.get(name, "") if k == 0 else ""
            yield f"    {name if k == 0 else '':<16} {shown} {unit}".rstrip()


def structure_text(result: ObservedStructure) -> str:
    """Structural rank and what no record can determine, in words."""
    free, held, n = result.structural, result.constant_inputs, result.unknowns
    order = f"{free.order} {'derivative' if free.order == 1 else 'derivatives'}"
    lines = [
        f"{result.model}: structural rank {free.rank} of {n} "
        f"(readings and {order} of them, at random points)"
    ]
    inputs = " and ".join(free.inputs)
    if result.observable:
        how = ""
        if inputs:
            how = f" where {inputs} vary" if held.rank < n else f" even with {inputs} constant"
        lines.append(f"  suitable data determine every state and parameter{how}")
    else:
        lines += [f"  - {words}" for words in free.unobservable]
    if free.undetermined:
        lines.append(f"  not determined by any record: {', '.join(free.undetermined)}")
        lines += [f"  {known}" for known in [combination_words(free)] if known]
    if held.rank < free.rank:
        lines += ["", f"  with {inputs} held constant: rank {held.rank} of {n}"]
        lines += [f"  - {words}" for words in held.unobservable]
        lines.append(f"  then not determined: {', '.join(held.undetermined)}")
        lines += [f"  {known}" for known in [combination_words(held)] if known]
    lines += note_lines(result.notes or [])
    return "\n".join(wrapped(lines))
