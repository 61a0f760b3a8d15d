"""What `casest compare` leaves: `compare.json`, which tables and plot read too."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from msgspec import Struct

from casest.comparison.judge import Comparison, Row, Trial
from casest.data.write import make_folder, write_atomically
from casest.estimate.reasons import SAME
from casest.results.file import as_json
from casest.results.result import Result
from casest.results.units import unit_table

#: Standard deviations of the cost within which a solver is right.
RIGHT = SAME


class Best(Struct, frozen=True):
    """The lowest cost, a half sum of squares, and who found it."""

    cost: float
    unit: str
    by: str


class CertifiedFit(Struct, frozen=True):
    """The certificate of the fit that the others are judged by, and the time it took."""

    trusted: bool
    reasons: list[str]
    seconds: float


class ResidualNoise(Struct, frozen=True):
    """Standard deviation of one residual."""

    sigma: float
    unit: str


class Spread(Struct, frozen=True):
    """Starts around the first one, and how far they lie from it."""

    starts: int
    sizes: list[float]
    seed: int


class Ended(Struct, frozen=True):
    """Where a solver ended from one start; NaN or None is what does not exist."""

    size: float
    cost: float
    excess: float
    relative_excess: float
    distance_in_std: float
    furthest: str | None
    inside_bounds: bool
    right: bool
    claims_success: bool | None
    status: str
    iterations: int | None
    evaluations: int | None
    seconds: float


class FromSpread(Struct, frozen=True):
    """How a solver did from the spread of starts; `seconds` is the median."""

    starts: int
    right: int
    claimed: int
    false_successes: int
    false_failures: int
    seconds: float
    trials: list[Ended]


class Compared(Struct, frozen=True):
    """One solver, or an estimator of the model's own."""

    name: str
    own_estimator: bool
    same_start: Ended | None
    spread: FromSpread


class SolversCompared(Result, frozen=True, kw_only=True, dict=True):
    """The content of `compare.json`. Costs are half sums of squares, times in seconds.

    Beside the file: `declared`, the model's own name, how many `samples` and `unknowns` there are.
    """

    unwritten = ("declared", "samples", "unknowns")

    data: list[str]
    command: str
    certified: bool
    best: Best
    certificate: CertifiedFit
    noise: ResidualNoise
    same_start: str
    spread: Spread
    solvers: list[Compared]
    declared: str
    samples: int
    unknowns: int


def comparison_result(
    found: Comparison, *, model_name: str, data: Sequence[str], command: str = ""
) -> SolversCompared:
    """What `compare` leaves."""
    estimate, problem = found.estimate, found.estimate.problem
    certificate = estimate.certificate
    unit = unit_table(problem.model, problem.runs)["residual"]
    return SolversCompared(
        model=model_name,
        data=list(data),
        command=command,
        certified=found.certified,
        best=Best(found.best, "1" if unit == "1" else f"({unit})^2", found.best_by),
        certificate=CertifiedFit(certificate.trusted, list(certificate.reasons), estimate.seconds),
        noise=ResidualNoise(found.sigma, unit),
        same_start="automatic" if found.automatic else "given",
        spread=Spread(found.starts, list(found.sizes), found.seed),
        solvers=[_compared(row, found.best) for row in found.rows],
        declared=problem.model.name,
        samples=sum(len(run) for run in problem.runs),
        unknowns=problem.unknowns,
    )


def _compared(row: Row, best: float) -> Compared:
    spread = FromSpread(
        len(row.spread),
        row.right,
        row.claimed,
        row.false_successes,
        row.false_failures,
        row.seconds,
        [_ended(trial, best) for trial in row.spread],
    )
    first = None if row.first is None else _ended(row.first, best)
    return Compared(row.solver, row.own, first, spread)


def _ended(trial: Trial, best: float) -> Ended:
    return Ended(
        trial.size,
        trial.cost,
        trial.excess,
        trial.excess / best if best > 0 else float("nan"),
        trial.distance,
        trial.furthest,
        trial.inside,
        trial.right,
        trial.claims,
        trial.status,
        trial.iterations,
        trial.evaluations,
        trial.seconds,
    )


def save(folder: Path, result: SolversCompared) -> Path:
    """Write `compare.json` into a folder (made if missing); returns its path."""
    make_folder(folder)
    write_atomically(folder / "compare.json", as_json(result.content()))
    return folder / "compare.json"
