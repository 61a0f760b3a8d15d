"""What `casest calibrate` prints: plain text that fits 80 columns."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator
from pathlib import Path

from casest.data.logs import file_name
from casest.report.next_command import following
from casest.report.text.layout import WIDTH, held_lines, item, value_table
from casest.results.calibration import Calibration, doubt_sentence
from casest.results.fitted import worse_elsewhere


def calibration_text(result: Calibration, output: Path | None) -> str:
    """Verdict, values with uncertainty, what was not determined, why it is believed."""
    certificate = result.estimate.certificate
    doubt = [doubt_sentence(result)] if result.misfit else []
    title = "Believed because" if result.trusted else "Refused because"
    blocks = [
        _head(result),
        "\n".join(item(note) for note in [*doubt, *result.notes]),
        "\n".join(value_table(result.entries)),
        "\n".join(held_lines(result.held)),
        "\n".join(_fit_lines(result)),
        *_determined(result),
        "\n".join([f"{title}:", *(item(r) for r in certificate.reasons)]),
        "\n".join(_helped(result)),
        *_written(result, output),
    ]
    return "\n\n".join(b for b in blocks if b)


def _head(result: Calibration) -> str:
    samples = sum(run.samples for run in result.samples)
    verdict = "trusted" if result.trusted else "NOT TRUSTED"
    if result.doubtful:
        verdict += ", but the residual is not noise"
    verdict += worse_elsewhere(result.holdout, result.holdout_over_fit)
    files, determined = ", ".join(file_name(name) for name in result.data), result.identifiability
    line = (
        f"{result.declared} on {files}: {samples} {result.kind}, "
        f"{determined.unknowns} unknowns, rank {determined.rank}: {verdict}"
    )
    return textwrap.fill(line, WIDTH)


def _fit_lines(result: Calibration) -> Iterator[str]:
    noise, errors, solver = result.noise, result.estimate, result.solver
    unit = "" if noise.unit == "1" else f" {noise.unit}"
    sigma = f"{noise.sigma[0]:.3g}{unit}" if math.isfinite(noise.sigma[0]) else "unknown"
    yield f"  residual rms {errors.rmse_fit:.3g}{unit}; noise of one residual {sigma}"
    if errors.rmse_holdout is not None:
        yield f"  held-out residual rms {errors.rmse_holdout:.3g}{unit}"
    if result.over_repeats and not result.doubtful:
        yield item(
            f"the residual is {result.over_repeats:.1f} times what the scatter within the rest "
            f"intervals explains ({noise.from_repeats:.2g}{unit}): the model lacks something; the "
            "standard deviations above include that misfit as if it were noise"
        )
    if solver.least_squares_seconds and solver.seconds:
        ratio = solver.least_squares_seconds / solver.seconds
        yield "  (standard deviations are those of the least-squares solution)"
        yield (
            f"  {solver.name} took {1e3 * solver.seconds:.2g} ms; the "
            f"least-squares solution {ratio:.0f} times as long"
        )


def _determined(result: Calibration) -> Iterator[str]:
    found = result.identifiability
    if found.unobservable and result.trusted:
        lines = [item(words) for words in found.unobservable]
        yield "\n".join(["These data do not determine:", *lines])
    if found.weak:
        worst = sorted(found.weak, key=lambda w: -w.inflation)[:3]
        lines = [
            item(f"{w.direction}: {w.inflation:.0f} times worse than each alone") for w in worst
        ]
        if len(found.weak) > 3:
            lines.append(f"  - and {len(found.weak) - 3} more, in result.json")
        yield "\n".join(["Weakly determined (one standard deviation of the combination):", *lines])
    if found.rank == found.unknowns and not found.weak and result.trusted:
        yield "The data determine every unknown; no weak combination."


def _helped(result: Calibration) -> Iterator[str]:
    """Where each refusal is explained."""
    if result.refusals:
        pages = [f"docs/refusals.md#{name}" for name in result.refusals]
        yield f"What each means and what to do: {pages[0]}"
        yield from (f"  {page}" for page in pages[1:])


def _written(result: Calibration, output: Path | None) -> Iterator[str]:
    """Files written, and what to type next."""
    if output is not None:
        yield f"Written: {output}/report.html, result.json, residuals.csv"
    yield following(
        result.reproduce.command,
        output,
        trusted=result.trusted,
        doubtful=result.doubtful,
        applies=result.corrected is not None,
    )
