"""What `casest close` prints: the verdict first, then the evidence."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

from msgspec import UnsetType

from casest.data.logs import file_name
from casest.report.next_command import following
from casest.report.text.layout import WIDTH, held_lines, item, value_table
from casest.results.closing import Closed
from casest.results.result import Number
from casest.results.rounding import percent
from casest.results.verdict import (
    chained,
    instead,
    largest,
    of_the_user,
    refusals,
    sentence,
    sided,
    to_be_asked,
    undecided,
    untried,
)

#: Lists longer than this are left to result.json.
SHOWN = 4
#: Correlation from which two unknowns are nearly one.
ONE = 0.99


def closing_text(result: Closed, output: Path | None) -> str:
    """Verdict, error before and after, effects, parameters, what stays invisible."""
    blocks = [
        _head(result),
        "\n".join(_errors(result)),
        "\n".join(_effects(result)),
        "\n".join(value_table(result.entries)),
        "\n".join(held_lines(result.held)),
        "\n".join(_moved(result)),
        "\n".join(_invisible(result)),
        "\n".join(_unexplained(result)),
        "\n".join(_detectable(result)),
        "\n".join(_notes(result)),
    ]
    if output is not None:
        blocks.append(f"Written: {output}/report.html, result.json, residuals.csv")
    blocks.append(
        following(
            result.reproduce.command,
            output,
            doubtful=result.verdict == "unexplained",
            likely=to_be_asked(result.unexplained, result.reproduce.command),
            applies=result.corrected is not None,
        )
    )
    return "\n\n".join(b for b in blocks if b)


def _head(result: Closed) -> str:
    files = ", ".join(file_name(name) for name in result.data)
    return textwrap.fill(f"{result.declared} on {files}: {sentence(result)}", WIDTH)


def _errors(result: Closed) -> Iterator[str]:
    unit = "" if result.noise.unit == "1" else f" {result.noise.unit}"
    before, after = result.before, result.after
    yield f"  residual rms{unit:<12} {'before':>12} {'after':>12}"
    rows = [
        ("fit", before.rmse_fit, after.rmse_fit),
        (_held_out(result), before.rmse_holdout, after.rmse_holdout),
    ]
    for word, one, other in rows:
        yield f"    {word:<22} {_figure(one)} {_figure(other)}"
    axes = before.rmse_holdout_by_axis
    if len(axes) > 1 and before.rmse_holdout is not None:
        for axis, value in axes.items():
            there = after.rmse_holdout_by_axis[axis]
            yield f"    held-out, {axis:<12} {_figure(value)} {_figure(there)}"


def _held_out(result: Closed) -> str:
    """Held out of the record itself, or another one, by the name of its file."""
    if isinstance(result.holdout, UnsetType):
        return "held-out"
    first, *more = map(file_name, result.holdout)
    return f"held-out, {first}" + (f" and {len(more)} more" if more else "")


def _figure(value: float | None) -> str:
    return f"{'-' if value is None else format(value, '#.5g'):>12}"


def _effects(result: Closed) -> Iterator[str]:
    if result.effects:
        yield "Added:"
    for e in result.effects:
        column = f" of column {e.column}" if e.column else ""
        yield item(f"{e.name} on {e.on}{column} ({_chance(e.p_value)}): {e.formula}")
        yield from map(item, sided(e))
        if e.indistinguishable_from:
            also = f" (less likely: {', '.join(e.less_likely)})" if e.less_likely else ""
            yield item(f"not told apart from {', '.join(e.indistinguishable_from)}{also}")
            yield from (item(f"to tell it from {w}") for w in e.would_separate[:SHOWN])
            yield from (item(words) for words in instead(e, result.after.parameters))
    yield from map(item, chained(result.effects))


def _chance(p_value: Number) -> str:
    return f"p = {p_value:.1g}" if p_value else "p < 1e-300"


def _moved(result: Closed) -> Iterator[str]:
    if not result.effects:
        return
    moved = {n: largest(z) for n, z in result.moved.items()}
    far = sorted(((z, n) for n, z in moved.items() if z >= 1), reverse=True)
    if far:
        words = ", ".join(f"{n} by {z:.1f}" for z, n in far)
        yield item(f"Moved by the addition, in standard deviations before it: {words}")
    alike = _alike(result)
    if alike:
        yield item(
            f"Hardly told apart by this record: {', '.join(alike)}: what they do together is known "
            "far better than each alone"
        )


def _alike(result: Closed) -> list[str]:
    """Pairs of unknowns, one of them added, that are nearly one."""
    found = result.after.correlation
    if not found:
        return []
    pairs = combinations(range(len(found.names)), 2)
    sizes = [(i, j, found.matrix[i][j]) for i, j in pairs]
    return [
        f"{found.names[i]} and {found.names[j]} (correlation {rho:.3f})"
        for i, j, rho in sizes
        if rho is not None and abs(rho) >= ONE and "." in found.names[i] + found.names[j]
    ]


def _invisible(result: Closed) -> Iterator[str]:
    hidden = result.invisible
    if hidden:
        yield "Could be wrong without showing (shift by a typical size):"
    for i in hidden[:SHOWN]:
        moves = ", ".join(f"{n} by {v:.2g}" for n, v in i.would_move.items())
        units = {n: "" if u == "1" else f" {u}" for n, u in i.units.items()}
        size = ", ".join(f"{n} = {v:.3g}{units[n]}" for n, v in i.typical.items())
        where = f"({i.column})" if i.column else ""
        yield item(f"{i.name}{where} ({size}): {moves}; shown by {i.shown_by}")
    if len(hidden) > SHOWN:
        yield f"  - and {len(hidden) - SHOWN} more, in result.json"


def _unexplained(result: Closed) -> Iterator[str]:
    left = result.unexplained
    if result.verdict == "unexplained" and left.fraction is not None:
        share = percent(left.fraction)
        yield item(f"Unexplained: {share} of the held-out variance, {left.where}")
        yield from (
            item(words)
            for words in undecided(left, result.after.parameters, result.reproduce.command)
        )


def _detectable(result: Closed) -> Iterator[str]:
    """How small an effect would have been seen, where none was."""
    sizes: dict[str, str] = {}
    for d in [*of_the_user(result.smallest_detectable), *result.smallest_detectable]:
        unit = "" if d.unit == "1" else f" {d.unit}"
        sizes.setdefault(d.name, f"{d.parameter} = {d.size:.2g}{unit}")
    if result.verdict == "adequate" and sizes:
        yield "Would have been seen, from this size on:"
        yield from (item(words) for words in list(sizes.values())[:SHOWN])
        if len(sizes) > SHOWN:
            yield f"  - and {len(sizes) - SHOWN} more, in result.json"


def _notes(result: Closed) -> Iterator[str]:
    yield from (item(note) for note in result.notes)
    yield from (item(words) for words in list(refusals(result))[:SHOWN])
    yield from (item(words) for words in untried(result))
