"""What `casest compare` prints: tables within 80 columns."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from casest.data.logs import file_name
from casest.report.next_command import following
from casest.report.text.layout import WIDTH, item
from casest.results.comparison import RIGHT, Compared, SolversCompared


def comparison_text(result: SolversCompared, written: Sequence[Path] = ()) -> str:
    """Head, table from the same start, table of the spread, who gave no answer and why."""
    solvers = [row for row in result.solvers if row.same_start and not row.own_estimator]
    own = [row for row in result.solvers if row.own_estimator]
    blocks = [_head(result), "\n".join(_first_table(result, solvers))]
    if own:
        blocks.append("\n".join(_own_table(own)))
    if any(row.spread.trials for row in result.solvers):
        blocks.append("\n".join(_spread_table(result, solvers)))
    words = list(_words(result))
    if words:
        blocks.append("\n".join(["In words:", *map(item, words)]))
    if written:
        blocks.append(textwrap.fill(f"Written: {', '.join(map(str, written))}", WIDTH))
    blocks.append(following(result.command, trusted=result.certified))
    return "\n\n".join(b for b in blocks if b)


def _head(result: SolversCompared) -> str:
    unit = "" if result.noise.unit == "1" else result.noise.unit
    verdict = "certified optimum" if result.certified else "NO CERTIFIED OPTIMUM; best point"
    line = (
        f"{result.declared} on {', '.join(file_name(name) for name in result.data)}: "
        f"{result.samples} samples, {result.unknowns} unknowns; {verdict}: cost "
        f"{result.best.cost:.6g}{_squared(unit)}, one residual's noise "
        f"{result.noise.sigma:.3g}{unit and ' ' + unit}; certified "
        f"fit {seconds_text(result.certificate.seconds)}"
    )
    return textwrap.fill(line, WIDTH)


def _squared(unit: str) -> str:
    compound = any(sign in unit for sign in "/*^ ")
    return f" ({unit})²" if compound else f" {unit}²" if unit else ""


def _first_table(result: SolversCompared, rows: Sequence[Compared]) -> Iterator[str]:
    start = "the automatic start" if result.same_start == "automatic" else "the start given"
    yield f"From {start}:"
    yield ""
    form = f"  {{:<{_names(rows)}}} {{:>11}} {{:>9}}  {{:>5}} {{:>6}} {{:>5}} {{:>5}} {{:>9}}"
    heads = "solver", "cost excess", "distance", "right", "claims", "iter", "eval", "time"
    yield form.format(*heads)
    for row in rows:
        trial = row.same_start
        assert trial is not None
        yield form.format(
            row.name,
            _number(trial.relative_excess),
            _number(trial.distance_in_std),
            _yes(trial.right),
            _yes(trial.claims_success),
            _count(trial.iterations),
            _count(trial.evaluations),
            seconds_text(trial.seconds),
        )
    yield from textwrap.wrap(
        f"excess: (cost − best)/best; distance: of the unknown furthest from the optimum, in its "
        f"standard deviations; right: within {RIGHT:g} of them by the cost; claims: the solver's "
        "own status",
        WIDTH,
        initial_indent="  ",
        subsequent_indent="  ",
    )


def _own_table(rows: Sequence[Compared]) -> Iterator[str]:
    yield "Estimators of the model's own, which minimise something else and need no start:"
    yield ""
    form = "  {:<13} {:>11} {:>9} {:>35}"
    yield form.format("estimator", "cost excess", "distance", "time")
    for row in rows:
        trial = row.same_start
        assert trial is not None
        excess, distance = _number(trial.relative_excess), _number(trial.distance_in_std)
        yield form.format(row.name, excess, distance, seconds_text(trial.seconds))


def _spread_table(result: SolversCompared, rows: Sequence[Compared]) -> Iterator[str]:
    names = _names(rows)
    sizes, width = _shown(result, names)
    starts = max(row.spread.starts for row in rows)
    yield f"From {starts} starts around it, moved by shares of each unknown's size:"
    yield ""
    form = f"  {{:<{names}}} {{:>5}} {{:>7}} {{:>7}} {{:>7}} {{:>8}}" + f" {{:>{width}}}" * len(
        sizes
    )
    heads = [_percent(size) for size in sizes]
    yield form.format("solver", "right", "claimed", "falsely", "doubted", "time", *heads)
    for row in rows:
        own = row.spread
        if own.trials:
            yield form.format(
                row.name,
                f"{own.right}/{own.starts}",
                own.claimed,
                own.false_successes,
                own.false_failures,
                seconds_text(own.seconds),
                *(_share(row, size) for size in sizes),
            )
    yield from textwrap.wrap(
        "falsely: claims success, but is not at the optimum; doubted: is there, but reports a "
        "failure; time: median; then right by how far the start was moved",
        WIDTH,
        initial_indent="  ",
        subsequent_indent="  ",
    )


def _names(rows: Sequence[Compared]) -> int:
    """How wide the column of names is."""
    return max(13, *(len(row.name) for row in rows))


def _shown(result: SolversCompared, names: int) -> tuple[list[float], int]:
    """As many sizes as fit beside the rest, and the width of their columns."""
    sizes = list(dict.fromkeys(result.spread.sizes))
    width = max(5, *(len(_percent(size)) for size in sizes))
    return sizes[: (WIDTH - 41 - names) // (width + 1)], width


def _percent(size: float) -> str:
    return f"{100 * size:.3g}%"


def _share(row: Compared, size: float) -> str:
    own = [trial.right for trial in row.spread.trials if trial.size == size]
    return f"{sum(own)}/{len(own)}" if own else "–"


def _words(result: SolversCompared) -> Iterator[str]:
    """What the tables cannot say."""
    if result.best.by != "certified":
        yield (
            f"{result.best.by} found a lower cost than the certified fit: there is another valley; "
            "give --start, and judge all above by that lower cost"
        )
    if not result.certificate.trusted:
        yield f"the fit is refused: {result.certificate.reasons[0]}"
    for row in result.solvers:
        trial = row.same_start
        if trial is not None and (not trial.inside_bounds or trial.claims_success is False):
            yield f"{row.name}: {trial.status}"


def _number(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else "–"


def _yes(value: bool | None) -> str:
    return "–" if value is None else "yes" if value else "NO"


def _count(value: int | None) -> str:
    return "–" if value is None else str(value)


def seconds_text(seconds: float) -> str:
    """A time in the unit that suits it."""
    if not np.isfinite(seconds):
        return "–"
    if seconds < 1e-3:
        return f"{1e6 * seconds:.3g} µs"
    return f"{1e3 * seconds:.3g} ms" if seconds < 0.9995 else f"{seconds:.3g} s"
