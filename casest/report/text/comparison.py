"""What `casest compare` prints and writes: tables within 80 columns, and `compare.json`."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from casest import __version__
from casest.comparison.judge import Comparison, Row, Trial
from casest.data.logs import file_name
from casest.data.write import write_atomically
from casest.errors import DataError
from casest.estimate.certificate import SAME
from casest.report.next_command import following
from casest.report.text.calibration import WIDTH, item
from casest.results.file import as_json, plain
from casest.results.units import unit_table


def comparison_text(
    found: Comparison, data: Sequence[str], written: Sequence[Path] = (), command: str = ""
) -> str:
    """Head, table from the same start, table of the spread, who gave no answer and why."""
    solvers = [row for row in found.rows if row.first is not None and not row.own]
    own = [row for row in found.rows if row.own]
    blocks = [_head(found, data), "\n".join(_first_table(found, solvers))]
    if own:
        blocks.append("\n".join(_own_table(found, own)))
    if any(row.spread for row in found.rows):
        blocks.append("\n".join(_spread_table(found, solvers)))
    words = list(_words(found))
    if words:
        blocks.append("\n".join(["In words:", *map(item, words)]))
    if written:
        blocks.append(textwrap.fill(f"Written: {', '.join(map(str, written))}", WIDTH))
    blocks.append(following(command, trusted=found.certified))
    return "\n\n".join(b for b in blocks if b)


def _head(found: Comparison, data: Sequence[str]) -> str:
    problem, estimate = found.estimate.problem, found.estimate
    samples = sum(len(run) for run in problem.runs)
    unit = _unit(found)
    verdict = "certified optimum" if found.certified else "NO CERTIFIED OPTIMUM; best point"
    line = (
        f"{problem.model.name} on {', '.join(file_name(name) for name in data)}: {samples} "
        f"samples, {problem.unknowns} unknowns; {verdict}: cost {found.best:.6g}"
        f"{_squared(unit)}, one residual's noise {found.sigma:.3g}{unit and ' ' + unit}; certified "
        f"fit {seconds_text(estimate.seconds)}"
    )
    return textwrap.fill(line, WIDTH)


def _unit(found: Comparison) -> str:
    problem = found.estimate.problem
    unit = unit_table(problem.model, problem.runs)["residual"]
    return "" if unit == "1" else unit


def _squared(unit: str) -> str:
    compound = any(sign in unit for sign in "/*^ ")
    return f" ({unit})²" if compound else f" {unit}²" if unit else ""


def _first_table(found: Comparison, rows: Sequence[Row]) -> Iterator[str]:
    yield f"From {'the automatic start' if found.automatic else 'the start given'}:"
    yield ""
    form = "  {:<13} {:>11} {:>9}  {:>5} {:>6} {:>5} {:>5} {:>9}"
    heads = "solver", "cost excess", "distance", "right", "claims", "iter", "eval", "time"
    yield form.format(*heads)
    for row in rows:
        trial = row.first
        assert trial is not None
        yield form.format(
            row.solver,
            _number(_relative(found, trial)),
            _number(trial.distance),
            _yes(trial.right),
            _yes(trial.claims),
            _count(trial.iterations),
            _count(trial.evaluations),
            seconds_text(trial.seconds),
        )
    yield from textwrap.wrap(
        f"excess: (cost − best)/best; distance: of the unknown furthest from the optimum, in its "
        f"standard deviations; right: within {SAME:g} of them by the cost; claims: the solver's "
        "own status",
        WIDTH,
        initial_indent="  ",
        subsequent_indent="  ",
    )


def _own_table(found: Comparison, rows: Sequence[Row]) -> Iterator[str]:
    yield "Estimators of the model's own, which minimise something else and need no start:"
    yield ""
    form = "  {:<13} {:>11} {:>9} {:>35}"
    yield form.format("estimator", "cost excess", "distance", "time")
    for row in rows:
        trial = row.first
        assert trial is not None
        excess, distance = _number(_relative(found, trial)), _number(trial.distance)
        yield form.format(row.solver, excess, distance, seconds_text(trial.seconds))


def _spread_table(found: Comparison, rows: Sequence[Row]) -> Iterator[str]:
    sizes, width = _shown(found)
    starts = max(len(row.spread) for row in rows)
    yield f"From {starts} starts around it, moved by shares of each unknown's size:"
    yield ""
    form = "  {:<13} {:>5} {:>7} {:>7} {:>7} {:>8}" + f" {{:>{width}}}" * len(sizes)
    heads = [_percent(size) for size in sizes]
    yield form.format("solver", "right", "claimed", "falsely", "doubted", "time", *heads)
    for row in rows:
        if row.spread:
            yield form.format(
                row.solver,
                f"{row.right}/{len(row.spread)}",
                row.claimed,
                row.false_successes,
                row.false_failures,
                seconds_text(row.seconds),
                *(_share(row, size) for size in sizes),
            )
    yield from textwrap.wrap(
        "falsely: claims success, but is not at the optimum; doubted: is there, but reports a "
        "failure; time: median; then right by how far the start was moved",
        WIDTH,
        initial_indent="  ",
        subsequent_indent="  ",
    )


def _shown(found: Comparison) -> tuple[list[float], int]:
    """As many sizes as fit beside the rest, and the width of their columns."""
    sizes = list(dict.fromkeys(found.sizes))
    width = max(5, *(len(_percent(size)) for size in sizes))
    return sizes[: (WIDTH - 54) // (width + 1)], width


def _percent(size: float) -> str:
    return f"{100 * size:.3g}%"


def _share(row: Row, size: float) -> str:
    own = [trial.right for trial in row.spread if trial.size == size]
    return f"{sum(own)}/{len(own)}" if own else "–"


def _words(found: Comparison) -> Iterator[str]:
    """What the tables cannot say."""
    if found.interrupted:
        yield f"interrupted after {found.done} of {found.planned} runs; what was done is shown"
    if found.best_by != "certified":
        yield (
            f"{found.best_by} found a lower cost than the certified fit: there is another valley; "
            "give --start, and judge all above by that lower cost"
        )
    if not found.estimate.certificate.trusted:
        yield f"the fit is refused: {found.estimate.certificate.reasons[0]}"
    for row in found.rows:
        trial = row.first
        if trial is not None and (not trial.inside or trial.claims is False):
            yield f"{row.solver}: {trial.status}"


def _relative(found: Comparison, trial: Trial) -> float:
    return trial.excess / found.best if found.best > 0 else float("nan")


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


# -- compare.json ----------------------------------------------------------------------------------


def comparison_result(
    found: Comparison, *, model_name: str, data: Sequence[str], command: str = ""
) -> dict[str, Any]:
    """The content of `compare.json`. Costs are half sums of squares, times in seconds."""
    estimate = found.estimate
    unit = unit_table(estimate.problem.model, estimate.problem.runs)["residual"]
    return {
        "casest": __version__,
        "model": model_name,
        "data": list(data),
        "command": command,
        "certified": found.certified,
        "best": {
            "cost": plain(found.best),
            "unit": "1" if unit == "1" else f"({unit})^2",
            "by": found.best_by,
        },
        "certificate": {
            "trusted": estimate.certificate.trusted,
            "reasons": list(estimate.certificate.reasons),
            "seconds": plain(estimate.seconds),
        },
        "noise": {"sigma": plain(found.sigma), "unit": unit},
        "same_start": "automatic" if found.automatic else "given",
        "spread": {"starts": found.starts, "sizes": list(found.sizes), "seed": found.seed},
        "interrupted": found.interrupted,
        "runs": {"planned": found.planned, "done": found.done},
        "solvers": [_row_content(found, row) for row in found.rows],
    }


def save(folder: Path, content: Mapping[str, Any]) -> Path:
    """Write `compare.json` into a folder (made if missing); returns its path."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made ({error.strerror}); give another -o") from None
    write_atomically(folder / "compare.json", as_json(content))
    return folder / "compare.json"


def _row_content(found: Comparison, row: Row) -> Mapping[str, Any]:
    return {
        "name": row.solver,
        "own_estimator": row.own,
        "same_start": None if row.first is None else _trial_content(found, row.first),
        "spread": {
            "starts": len(row.spread),
            "right": row.right,
            "claimed": row.claimed,
            "false_successes": row.false_successes,
            "false_failures": row.false_failures,
            "seconds": plain(row.seconds),
            "trials": [_trial_content(found, trial) for trial in row.spread],
        },
    }


def _trial_content(found: Comparison, trial: Trial) -> Mapping[str, Any]:
    return {
        "size": trial.size,
        "cost": plain(trial.cost),
        "excess": plain(trial.excess),
        "relative_excess": plain(_relative(found, trial)),
        "distance_in_std": plain(trial.distance),
        "furthest": trial.furthest,
        "inside_bounds": trial.inside,
        "right": trial.right,
        "claims_success": trial.claims,
        "status": trial.status,
        "iterations": trial.iterations,
        "evaluations": trial.evaluations,
        "seconds": plain(trial.seconds),
    }
