"""What calibrate and close leave in common: errors, certificate, values, what is uncertain."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import casadi as ca
import numpy as np
from msgspec import UNSET, Struct, UnsetType

from casest.correction.carried import Carried, carried
from casest.correction.reading import carried_data
from casest.correction.spread import slopes, spread_program
from casest.data.run import Run, extent
from casest.declaration.effect import Attached
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Constant
from casest.dynamics.declare import Dynamics
from casest.errors import CasestError
from casest.estimate.estimate import Estimate
from casest.leastsquares.agreement import between_runs
from casest.results.application import Application, application_of
from casest.results.file import digest_of_values, plain
from casest.results.residuals import Residuals
from casest.results.result import (
    Certificate,
    Number,
    Numbers,
    Parameter,
    Reproduced,
    Result,
    reproduced,
)
from casest.results.uncertainty import CorrectedBudget, Covariance, Input, corrected_budget
from casest.results.units import resolved, unit_table
from casest.results.values import Entry, Held, entries, held
from casest.validity.colour import colour_of


class Spectrum(Struct, frozen=True):
    """Noise that is not white: power of each axis, up to a factor, over cycles per sample."""

    frequency: list[float]
    power: list[list[float]]
    samples_per_second: Number


class Noise(Struct, frozen=True):
    """Standard deviation of one residual on each axis, and where it comes from.

    `stated` is that of a usual residual by the noise that was stated; `chi_square` compares what
    is left with it, and `chi_square_p_value` is the chance of as much or more.
    """

    sigma: list[float]
    unit: str
    from_residual: Number
    from_repeats: Number
    degrees_of_freedom: int
    correlated_over_samples: Number
    stated: Number
    chi_square: Number
    chi_square_p_value: Number


class NoiseModel(Noise, frozen=True):
    """The noise after the loop: also its colour, tails and inequality.

    `of_inputs`: the share that goes with how inputs differ from their rows before and after, as
    their own noise does, and readings that were averaged; 0 where there is no saying.
    """

    sigma_by_axis: list[float]
    colour: str
    lag1_correlation: Number
    colour_p_value: Number
    wander: Number
    wander_p_value: Number
    tail_degrees_of_freedom: Number
    outlier_share: float
    quantisation_step: Number
    largest_over_smallest: Number
    unequal_p_value: Number
    of_inputs: float


class Correlation(Struct, frozen=True):
    """Correlation of the unknowns, and the standard deviation of each: null where the data do not
    determine one.

    `information` is the inverse of their covariance, from which a plan goes on.
    """

    names: list[str]
    matrix: list[list[Number]]
    std: list[Number]
    information: list[list[Number]]


class Section(Struct, frozen=True, kw_only=True):
    """One fit: errors (held-out ones null where nothing was), certificate, parameters."""

    rmse_fit: Number
    rmse_holdout: Number
    rmse_holdout_by_axis: dict[str, Number] | UnsetType = UNSET
    log_likelihood: Number | UnsetType = UNSET
    certificate: Certificate
    parameters: dict[str, Parameter]
    correlation: Correlation | UnsetType = UNSET
    covariance: Covariance | UnsetType = UNSET
    inputs: list[Input] | UnsetType = UNSET
    degrees_of_freedom: dict[str, Number] | UnsetType = UNSET


class JudgedSection(Section, frozen=True, kw_only=True):
    """One fit that held-out data have judged, axis by axis."""

    rmse_holdout_by_axis: dict[str, Number]


class Attachment(Struct, frozen=True):
    """What is needed to attach an effect again: where, and the numbers it was told."""

    name: str
    on: str | None
    columns: dict[str, str]
    numbers: dict[str, float]
    file: str
    sha256: str | UnsetType


class WeakCombination(Struct, frozen=True):
    """A combination that is determined `inflation` times worse than its parameters alone."""

    direction: str
    inflation: float
    std: Number


class Identified(Struct, frozen=True):
    """What the data determine of the unknowns."""

    rank: int
    unknowns: int
    unobservable: list[str]
    weak: list[WeakCombination]


class Scatter(Struct, frozen=True):
    """Agreement of several runs on what they share."""

    F: Number
    freedom: list[Number]
    p_value: Number
    furthest: str


class Doubt(Struct, frozen=True):
    """What in the residual speaks against the model."""

    where: str
    p_value: Number


class Corrected(Struct, frozen=True):
    """The corrected quantity, and the range it had in the fit, for inverting it later."""

    name: str
    low: float | UnsetType = UNSET
    high: float | UnsetType = UNSET


class Solver(Struct, frozen=True):
    """What found the estimate; nothing is said of it where there was nothing to solve."""

    name: str | None
    iterations: int | UnsetType | None = UNSET
    evaluations: int | UnsetType | None = UNSET
    seconds: Number | UnsetType = UNSET
    least_squares_seconds: Number | UnsetType = UNSET
    kernel: Literal["compiled", "numpy"] | UnsetType = UNSET


class Samples(Struct, frozen=True):
    """How many samples a run has, of how many readings; its first and last time in s, if any."""

    run: str
    samples: int
    readings: int
    span: list[float] | None = None


class DeclaredIn(Struct, frozen=True):
    """File of the model's declaration and its digest, so that an edited model is noticed."""

    file: str | UnsetType = UNSET
    sha256: str | UnsetType = UNSET


class Fitted(Result, frozen=True, kw_only=True, dict=True):
    """What calibrate and close leave in common.

    Beside the file: `declared`, the model's own name; `kind`, what its samples are; `entries` of
    the values, the unit of each unknown, and the constants `held`; the estimate `found` that a
    reader takes away, of which `residuals` and `application` are made when a page asks for them.
    """

    unwritten: ClassVar[tuple[str, ...]] = (
        "declared",
        "kind",
        "entries",
        "unknown_units",
        "held",
        "found",
    )

    data: list[str]
    runs: list[str]
    constants: dict[str, Numbers]
    scopes: dict[str, str]
    verdict: str | None
    trusted: bool
    noise: Noise
    estimate: Section | UnsetType = UNSET
    before: Section | UnsetType = UNSET
    after: Section | UnsetType = UNSET
    effects: Sequence[Any]
    identifiability: Identified
    scatter_between_runs: Scatter | None
    invisible: Sequence[Any] | None
    unexplained: Any
    misfit: list[Doubt] | None
    spectrum: Spectrum | None
    conditions: dict[str, list[float]]
    corrected: Corrected | None
    units: dict[str, str]
    solver: Solver
    samples: list[Samples]
    notes: list[str]
    convention: str
    declared_in: DeclaredIn
    reproduce: Reproduced
    correction: dict[str, Any]
    corrected_budget: CorrectedBudget | None
    declared: str
    kind: str
    entries: tuple[Entry, ...]
    unknown_units: dict[str, str]
    held: tuple[Held, ...]
    found: Estimate

    @property
    def correlation(self) -> Correlation:
        """Correlation of the unknowns."""
        last = self.after or self.estimate
        assert last
        assert last.correlation
        return last.correlation

    @cached_property
    def residuals(self) -> Residuals:
        """What is drawn of the residuals: of one fit, or before and after."""
        raise NotImplementedError

    @property
    def refusals(self) -> tuple[str, ...]:
        """Names of what speaks against the estimate: headings of docs/refusals.md."""
        if self.trusted:
            return ()
        codes = self.found.certificate.code
        return tuple((code.name or "").lower().replace("_", "-") for code in codes)

    @cached_property
    def application(self) -> Application:
        """How the result is applied."""
        return application_of(self.found.model, self.residuals.units, trusted=self.trusted)


def fitted_content(
    estimate: Estimate, model_name: str, data: Sequence[str], command: str
) -> dict[str, Any]:
    """The fields that a calibration and a closed loop have in common."""
    problem, identified = estimate.problem, estimate.identifiability
    corrected = _corrected_range(estimate)
    table = unit_table(problem.model, problem.runs)
    units = {name: unit for name, unit in table.items() if "[" not in name}
    unknowns = zip(estimate.names, problem.units, strict=True)
    return {
        "model": model_name,
        "data": list(data),
        "runs": [run.name for run in problem.runs],
        "constants": {c.name: plain(c.array) for c in problem.model.constants},
        "scopes": {p.name: p.scope for p in problem.model.parameters},
        "trusted": estimate.certificate.trusted,
        "noise": _noise(estimate, table["residual"]),
        "identifiability": Identified(
            identified.rank,
            identified.unknowns,
            list(identified.unobservable),
            weak_of(estimate),
        ),
        "scatter_between_runs": _scatter(estimate),
        "spectrum": _spectrum(estimate),
        "conditions": ranges(problem.runs),
        "corrected": corrected,
        "units": units,
        "solver": _solver(estimate),
        "samples": [
            Samples(run.name, len(run), int(np.sum(run.count)), run.span and list(run.span))
            for run in problem.runs
        ],
        "notes": [*dict.fromkeys(n for run in problem.runs for n in run.notes), *estimate.notes],
        "convention": inspect.getdoc(problem.model.function) or "",
        "declared_in": declared_in(problem.model),
        "reproduce": reproduced(command, data),
        **_correction(estimate, units, corrected),
        "declared": estimate.model.name,
        "kind": "rest intervals" if problem.runs[0].spread else "samples",
        "entries": entries(estimate),
        "unknown_units": {name: resolved(unit, units) for name, unit in unknowns},
        "held": held(estimate, units),
        "found": estimate,
    }


def worse_elsewhere(files: Sequence[str] | UnsetType, times: float | UnsetType) -> str:
    """That another record is foretold much worse than the fitted one, after a verdict."""
    if files is UNSET or times is UNSET:
        return ""
    return f"; but errors on {', '.join(files)} are {times:.2g} times those of the fit"


def weak_of(estimate: Estimate) -> list[WeakCombination]:
    """Combinations that are determined, but badly."""
    return [WeakCombination(w.words, w.inflation, plain(w.std)) for w in estimate.weak]


def correlation_of(estimate: Estimate) -> Correlation:
    """Correlation of the unknowns."""
    std = np.sqrt(np.diag(estimate.covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix = np.asarray(estimate.covariance / np.outer(std, std))
    names, information = list(estimate.names), plain(estimate.information)
    return Correlation(names, plain(matrix), plain(std), information)


def _noise(estimate: Estimate, unit: str) -> Noise:
    noise, chi = estimate.noise, estimate.noise.chi_square
    return Noise(
        [float(noise.sigma)] * len(estimate.model.axes),
        unit,
        plain(noise.residual),
        plain(noise.repeats),
        noise.degrees_of_freedom,
        plain(estimate.correlated_over),
        plain(noise.stated),
        None if chi is None else plain(chi.value),
        None if chi is None else plain(chi.larger),
    )


def _spectrum(estimate: Estimate) -> Spectrum | None:
    """The noise's colour, for judging later records; null where it is white."""
    found = colour_of(estimate) if estimate.certificate.trusted else None
    if found is None:
        return None
    return Spectrum(found.frequency.tolist(), found.power.tolist(), plain(found.rate))


def ranges(runs: Sequence[Run]) -> dict[str, list[float]]:
    """Least and greatest of every other column of numbers: under what conditions it was fitted."""
    found: dict[str, list[float]] = {}
    for name in sorted({name for run in runs for name in run.columns}):
        parts = [run.columns[name] for run in runs if name in run.columns]
        if all(p.dtype.kind in "fiu" for p in parts):
            ends = [pair for pair in (extent(p[:, None]) for p in parts) if pair is not None]
            if ends:
                found[name] = [float(min(a[0] for a, _ in ends)), float(max(b[0] for _, b in ends))]
    return found


def noise_of(noise: Noise) -> tuple[Array, str]:
    """σ of one residual on each axis (m,), and its unit."""
    sigma = np.array(noise.sigma)
    each = noise.sigma_by_axis if isinstance(noise, NoiseModel) else ()
    if len(each) > 1 and all(each):  # unequal axes, with the mean square of the fit
        sigma = sigma * np.asarray(each) / np.sqrt(np.mean(np.square(each)))
    return sigma, noise.unit


def _scatter(estimate: Estimate) -> Scatter | None:
    """Agreement of several runs on what they share; null for one run, or a refused estimate."""
    if not estimate.certificate.trusted:
        return None
    found = between_runs(estimate.problem, estimate.point, estimate.correlated_over)
    if found is None:
        return None
    freedom = [plain(f) for f in found.freedom]
    return Scatter(plain(found.F), freedom, plain(found.p_value), found.worst)


def attachment(attached: Attached) -> Attachment:
    """Where an effect is attached, and the numbers it was told."""
    numbers = {
        n: float(d.array)
        for n, d in attached.effect.declarations
        if isinstance(d, Constant) and not d.dims
    }
    file = Path(inspect.unwrap(attached.effect.function).__code__.co_filename).resolve()
    name, columns = attached.effect.name, dict(attached.columns)
    return Attachment(name, attached.on, columns, numbers, str(file), digest_of_source(file))


def _corrected_range(estimate: Estimate) -> Corrected | None:
    """Name of the corrected quantity and the range it had in the fit."""
    name = estimate.model.traced.corrected
    if name is None:
        return None
    declared = ca.densify(ca.vec(estimate.model.along.quantities[name].declared))
    low, high = np.inf, -np.inf
    for (values,) in estimate.problem.evaluated_pieces(estimate.point, {"c": declared}):
        finite = values[np.isfinite(values)]
        low, high = min(low, finite.min(initial=low)), max(high, finite.max(initial=high))
    return Corrected(name) if low > high else Corrected(name, float(low), float(high))


def _correction(
    estimate: Estimate, units: Mapping[str, str], corrected: Corrected | None
) -> dict[str, Any]:
    """What it takes to correct readings without the model's source, else the reason why not; and
    where the uncertainty of a corrected reading comes from."""
    around = None
    if corrected and corrected.low is not UNSET and corrected.high is not UNSET:
        around = (corrected.low, corrected.high)
    model = estimate.model.without_noise  # readings are corrected without their noise
    found = carried(model, estimate.values, estimate.problem.runs, units, around)
    if isinstance(found, str):
        why = {"reason": found, **({"follows": True} if follows(model) else {})}
        return {"correction": why, "corrected_budget": None}
    found, budget = _with_spread(estimate, units, found, model)
    lasting = model.elsewhere([run.span for run in estimate.problem.runs])
    if lasting is not model:
        values, runs = lasting.among(estimate.values), estimate.problem.runs
        other = carried(lasting, values, runs, units, around)
        if isinstance(other, str):
            return {"correction": {"reason": other}, "corrected_budget": None}
        other = _with_spread(estimate, units, other, lasting)[0]
        once = tuple(a.label for a in model.effects if a not in lasting.effects)
        once = tuple(name for name in once if name not in found.program.left)
        found = replace(found, elsewhere=other, once=once)
    values = {name: plain(value) for name, value in estimate.values.items()}
    of = digest_of_values(values, estimate.certificate.trusted)
    return {"correction": {"of": of, **carried_data(found)}, "corrected_budget": budget}


def follows(model: Model) -> bool:
    """Are its states followed along a record, with nothing that would be corrected?"""
    return model.traced.integrates and model.traced.corrected is None


def _with_spread(
    estimate: Estimate, units: Mapping[str, str], found: Carried, model: Model
) -> tuple[Carried, CorrectedBudget | None]:
    """Standard deviations of corrected readings; none where runs differ, or nothing is trusted.

    By what the `model` has of the fitted one.
    """
    if found.own or not estimate.certificate.trusted:
        return found, None
    try:
        how = slopes(estimate, units, model)
        spread = spread_program(estimate, how, units, found.program.output.name)
        budget = corrected_budget(estimate, how, found.program, found.readings[0])
    except (CasestError, RuntimeError):  # an operation without a derivative: there is no std
        return found, None
    return replace(found, spread=spread), budget


def _solver(estimate: Estimate) -> Solver:
    if not estimate.outcomes:
        return Solver(None)
    first, extra = estimate.outcomes[0], estimate.extra
    return Solver(
        extra.get("estimator", first.solver),
        first.iterations,
        first.evaluations,
        plain(extra.get("seconds", first.seconds)),
        plain(extra["least_squares_seconds"]) if "least_squares_seconds" in extra else UNSET,
        "compiled" if estimate.problem.compiled else "numpy",
    )


def declared_in(model: Model | Dynamics) -> DeclaredIn:
    """The file that declares a model, and its SHA-256 as it is now."""
    path = Path(inspect.unwrap(model.function).__code__.co_filename).resolve()
    if not path.exists():
        return DeclaredIn()
    return DeclaredIn(str(path), digest_of_source(path))


def digest_of_source(path: Path) -> str | UnsetType:
    """SHA-256 of a file of declarations as it is now; UNSET where there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else UNSET
