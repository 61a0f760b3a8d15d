"""What `casest close` prints of an estimator in motion: the verdict first, then the evidence."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from pathlib import Path

from casest.data.logs import file_name
from casest.report.next_command import following
from casest.report.text.layout import WIDTH, item
from casest.results.motion import MotionClosed, called, numbers_of, sentence
from casest.results.rounding import rounded

#: Lists longer than this are left to result.json.
SHOWN = 4


def motion_text(result: MotionClosed, output: Path | None) -> str:
    """Verdict, error before and after, effects, states at the end, what stays invisible."""
    files = ", ".join(file_name(name) for name in result.data)
    head = f"{result.model} on {files}: {sentence(result)}"
    blocks = [
        textwrap.fill(head, WIDTH),
        "\n".join(_errors(result)),
        "\n".join(_effects(result)),
        "\n".join(_parameters(result)),
        "\n".join(_intensities(result)),
        "\n".join(_left(result)),
    ]
    if output is not None:
        blocks.append(f"Written: {output}/report.html, result.json, residuals.csv")
    typed, complete = result.reproduce.command, not result.effects
    blocks.append(following(typed, output, trusted=result.trusted, applies=complete, moving=True))
    return "\n\n".join(b for b in blocks if b)


def _errors(result: MotionClosed) -> Iterator[str]:
    before, after = result.before, result.after
    title = f"one-step innovations, rms {result.noise.unit}"
    yield f"  {title:<34}{'before':>10}{'after':>12}"
    yield f"    {'fit':<30}{before.rmse_fit:>12.5g}{after.rmse_fit:>12.5g}"
    yield f"    {'held-out':<30}{before.rmse_holdout:>12.5g}{after.rmse_holdout:>12.5g}"
    for axis, value in before.rmse_holdout_by_axis.items():
        there = after.rmse_holdout_by_axis[axis]
        yield f"    {'held-out, ' + axis:<30}{value:>12.5g}{there:>12.5g}"
    if result.effects:
        yield f"    log-likelihood: {result.risen:+.1f}"


def _effects(result: MotionClosed) -> Iterator[str]:
    if result.effects:
        yield "Added:"
    for e in result.effects:
        yield item(f"{called(e)} (p = {e.p_value:.1g}): {e.formula}{numbers_of(e)}")
        if e.indistinguishable_from:
            yield item(f"not told apart from {', '.join(e.indistinguishable_from)}")
            yield from (item(words) for words in e.would_separate)


def _parameters(result: MotionClosed) -> Iterator[str]:
    yield "At the end of the record, and the numbers of what was added:"
    rows = [
        (name if len(p.value) == 1 else f"{name}[{k}]", *rounded(v, s), str(p.unit))
        for name, p in result.after.parameters.items()
        for k, (v, s) in enumerate(zip(p.value, p.std, strict=True))
    ]
    width, left, middle = (max(len(r[k]) for r in rows) for k in range(3))
    for name, value, std, unit in rows:
        shown = "" if unit == "1" else unit
        yield f"  {name:<{width}}  {value:>{left}} ± {std:<{middle}}  {shown}".rstrip()


def _intensities(result: MotionClosed) -> Iterator[str]:
    """What the record asks for; published ones may be far away."""
    declared, after = result.noise.declared, result.noise.intensities.after
    said = [
        f"{name} {value:.2g}" + (f" (declared {declared[name]:.2g})" if name in declared else "")
        for name, value in after.items()
    ]
    yield item("noise intensities matched to the record: " + ", ".join(said))


def _left(result: MotionClosed) -> Iterator[str]:
    left = result.unexplained
    if result.verdict == "unexplained" and left.where:
        yield item(f"Unexplained: {left.fraction:.1%} of the variance, {left.where}")
    if result.invisible:
        yield "Could be wrong without showing (shift by a typical size):"
    for i in result.invisible[:SHOWN]:
        moves = ", ".join(f"{n} by {v:.2g}" for n, v in i.would_move.items())
        sizes = ", ".join(f"{size:.2g}" for size in i.typical.values())
        yield item(f"{called(i)} ({sizes}): {moves}; shown by {i.shown_by}")
    yield from (item(f"{r.name} was not added: {r.reason}") for r in result.refused)
    yield from (item(note) for note in result.notes)
