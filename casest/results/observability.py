"""What `casest observe` leaves: what data, a trajectory, or any record of a model can show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from msgspec import UNSET, Struct, UnsetType

from casest.data.run import Run
from casest.data.timing import longest
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.dynamics import Dynamics
from casest.dynamics.filter import coefficients, filtered
from casest.dynamics.gramian import Observed as Seen
from casest.dynamics.gramian import Products, observed, over_windows
from casest.dynamics.gramian import Windows as Over
from casest.dynamics.inputs import smallest, uncertain, unstated
from casest.dynamics.intensities import period, with_stated
from casest.dynamics.path import Path
from casest.dynamics.structural import Structure, structure
from casest.dynamics.structural.unseen import Unseen
from casest.errors import DeclarationError, UsageError
from casest.estimate.calibrate import attempt
from casest.results.file import plain
from casest.results.fitted import WeakCombination, weak_of
from casest.results.result import Number, Numbers, Reproduced, Result, reproduced

#: Windows over which the smallest eigenvalue is followed: this share of the record unless told.
WINDOW = 0.1
#: Share of what was known beforehand from which on a window has taught something of a number.
HALF = 0.5


class Observed(Result, frozen=True, kw_only=True, dict=True):
    """What every `observe.json` begins with."""

    notes: list[str] | UnsetType = UNSET
    rank: int
    unknowns: int
    structural_rank: int | UnsetType | None = UNSET
    unobservable: list[str]

    @property
    def observable(self) -> bool:
        """Is every unknown determined?"""
        return self.rank == self.unknowns


class ObservedParameters(Observed, frozen=True, kw_only=True, dict=True):
    """The content of `observe.json` for a calibration's data."""

    weak: list[WeakCombination]
    std: dict[str, Numbers]
    trusted: bool
    data: list[str]
    reproduce: Reproduced


class Structural(Struct, frozen=True):
    """Rank of the readings and `order` of their derivatives.

    `combinations` of what is undetermined are determined all the same, and `more` without a short
    formula. `gap`: how clear-cut a rank in floating point is; none where it is exact.
    """

    rank: int
    undetermined: list[str]
    unobservable: list[str]
    order: int
    inputs: list[str]
    gap: Number
    combinations: list[str]
    more: int


class ObservedStructure(Observed, frozen=True, kw_only=True, dict=True):
    """The content of `observe.json` without data. `std` is empty: how well needs a record."""

    std: dict[str, Numbers]
    structural: Structural
    constant_inputs: Structural
    tolerance: str
    data: list[str]
    reproduce: Reproduced


class Windows(Struct, frozen=True):
    """Eigenvalues of the Gramian over windows, in units of what was known beforehand.

    `std` of every number of the state (`gravity[2]`) at each window's beginning, by its readings
    and what was known, which is `known`; `better_from_s`: the end of the first window that makes it
    half of that.
    """

    length_s: Number
    end_s: list[float]
    smallest_eigenvalue: list[float]
    informative_from_s: Number
    eigenvalues: list[list[float]]
    std: dict[str, list[float]]
    known: dict[str, float]
    better_from_s: dict[str, Number]


class ObservedMotion(Observed, frozen=True, kw_only=True, dict=True):
    """The content of `observe.json` for a trajectory. `std`: what the readings alone allow;
    `weak`: directions of which they tell less than was known beforehand."""

    notes: list[str]
    structural_rank: int | None
    weak: list[str]
    std: dict[str, Numbers]
    units: dict[str, str]
    eigenvalues: list[Number]
    tolerance: str
    windows: Windows
    data: list[str]
    reproduce: Reproduced


#: What `casest observe` leaves.
Observability = ObservedParameters | ObservedStructure | ObservedMotion


def observe_parameters(
    model: Model, runs: Sequence[Run], *, data: Sequence[str] = (), command: str = ""
) -> ObservedParameters:
    """What a static model's data determine: rank, null directions in words, std of each value."""
    found = attempt(model, runs)
    identified, covariance = found.identifiability, found.covariance.copy()
    for b in found.certificate.at_bound:  # what the data would say of it were it free
        covariance[b.index, b.index] = b.std**2
    std = found.problem.spread(found.point, covariance)
    return ObservedParameters(
        model=model.name,
        rank=identified.rank,
        unknowns=identified.unknowns,
        unobservable=list(identified.unobservable),
        weak=weak_of(found),
        std={name: plain(value) for name, value in std.items()},
        trusted=found.certificate.trusted,
        data=list(data),
        reproduce=reproduced(command, data),
    )


def observe_structure(
    model: Dynamics,
    *,
    known: Sequence[str] = (),
    unmeasured: Sequence[str] = (),
    experiments: int = 1,
    command: str = "",
) -> ObservedStructure:
    """What any record could show: structural rank with inputs that vary freely, or held.

    `known` states at the beginning, `unmeasured` inputs and several `experiments` as in
    `structure`.
    """

    def ranked(varying: bool) -> Structure:
        return structure(
            model, varying=varying, known=known, unmeasured=unmeasured, experiments=experiments
        )

    free = ranked(varying=True)
    held = ranked(varying=False) if free.inputs else free
    return ObservedStructure(
        model=model.name,
        notes=[f"not in exact arithmetic: {free.rounded}"] if free.rounded else [],
        rank=free.rank,
        unknowns=free.unknowns,
        unobservable=list(free.unobservable),
        std={},
        structural=_structural(free),
        constant_inputs=_structural(held),
        tolerance=_tolerance(free, held),
        data=[],
        reproduce=reproduced(command, ()),
    )


def _tolerance(free: Structure, held: Structure) -> str:
    if not free.rounded:
        return "exact arithmetic modulo a prime at random points: no threshold"
    return (
        "singular values below 1e-10 of the largest count as zero; the smallest that "
        f"counts is {min(free.gap, held.gap):.1g} times the largest that does not"
    )


def _structural(found: Structure) -> Structural:
    return Structural(
        found.rank,
        list(found.undetermined),
        list(found.unobservable),
        found.order,
        list(found.inputs),
        plain(found.gap),
        list(found.combinations),
        found.more,
    )


def _structure(model: Dynamics) -> Structure | None:
    """What a better record could reach; None where it cannot be said."""
    try:
        return structure(model)
    except DeclarationError:
        return None


def observe_motion(
    model: Dynamics,
    run: Run,
    window: float | None = None,
    *,
    data: Sequence[str] = (),
    command: str = "",
) -> ObservedMotion:
    """What a trajectory makes observable, by the Gramian over the whole record and over windows.

    `std` is what the readings alone allow at the beginning of the record, per state. A nonlinear
    model is linearised along a trajectory of its own (`path`).
    """
    noisy = unstated(model, run)
    model = with_stated(model, run, noisy)
    most = _structure(model)
    products = _products(model, run, most)
    seen = observed(model, products.gramian())
    time = np.asarray(run.time, float)
    duration, step = float(time[-1] - time[0]), float(np.median(np.diff(time)))
    if window is not None and not 2 * step <= window < np.inf:
        raise UsageError(
            f"--window {window:g} s: a window must hold two steps of "
            f"{step:.3g} s at least; the record lasts {duration:.3g} s"
        )
    length = min(window or WINDOW * duration, duration)
    windows = _windows(model, over_windows(products, length), length)
    std = {name: plain(seen.std[where]) for name, where in model.slices().items()}
    return ObservedMotion(
        model=model.name,
        notes=[
            *assumed(run),
            *noise_of_inputs(model, run, noisy),
            *_readings_alone(model),
            *_too_short(seen, run),
        ],
        rank=seen.rank,
        unknowns=seen.unknowns,
        structural_rank=most.rank if most else None,
        unobservable=list(seen.unobservable),
        weak=list(seen.weak),
        std=std,
        units={s.name: s.unit for s in model.states},
        eigenvalues=plain(seen.eigenvalues / max(float(seen.eigenvalues[0]), 1e-300)),
        tolerance="eigenvalues of the Gramian scaled to a unit diagonal, below 1e-11 of the "
        "largest, count as zero",
        windows=windows,
        data=list(data),
        reproduce=reproduced(command, data),
    )


def _windows(model: Dynamics, found: Over, length: float) -> Windows:
    telling = np.flatnonzero(found.eigenvalues[:, 0] > 1)
    known = np.sqrt(np.diag(model.start_covariance))
    better = {}
    for name, column, before in zip(model.names, found.std.T, known, strict=True):
        since = np.flatnonzero(column < HALF * before)
        better[name] = plain(found.ends[since[0]]) if since.size else None
    return Windows(
        plain(length),
        plain(found.ends),
        plain(found.eigenvalues[:, 0]),
        plain(found.ends[telling[0]]) if telling.size else None,
        plain(found.eigenvalues),
        {name: plain(column) for name, column in zip(model.names, found.std.T, strict=True)},
        {name: plain(value) for name, value in zip(model.names, known, strict=True)},
        better,
    )


def assumed(run: Run) -> list[str]:
    """What was assumed of a record, gaps included, one sentence each."""
    clocks: dict[bytes, list[str]] = {}  # the samples, and the signals that have them
    for name in run.read:
        clocks.setdefault(run.read[name].tobytes(), []).append(name)
    if not run.read:
        return [*run.notes, *_gaps(np.asarray(run.time, float), np.asarray(run.rows), "time")]
    notes = [note for names in clocks.values()
             for note in _gaps(run.clock(names[0]), np.asarray(run.rows)[run.read[names[0]]],
                               " and ".join(names))]  # fmt: skip
    return [*run.notes, *notes]


def _gaps(time: Array, rows: Array, where: str) -> list[str]:
    """What was assumed in gaps of a clock with samples at `time` (M,), s."""
    step = np.diff(time)
    wide = np.flatnonzero(step > longest(step)) if len(step) else np.zeros(0, int)
    if not wide.size:
        return []
    worst = int(wide[np.argmax(step[wide])])
    return [
        f"{wide.size} {'gap' if wide.size == 1 else 'gaps'} in {where}, the longest of "
        f"{step[worst]:.3g} s after row {int(rows[worst])} (t = {time[worst]:.6g} s): "
        "inputs were taken as straight lines across; the states that they drive are known "
        "after it no better than at the beginning"
    ]


def _products(model: Dynamics, run: Run, most: Structure | None) -> Products:
    """In pieces; at once where the noise of inputs is known, as its estimates are of the whole.

    Of a nonlinear model never more than `most`, what any record could show: it is linearised where
    its states are thought to be, and what is wrong with that may show what they cannot.
    """
    if not model.linear:
        path, unseen = Path.of(model, run), Unseen.of(most, run) if most else None
        hidden = None if unseen is None else lambda k: unseen.at(path.x[k], k)
        return replace(Products.of(model, run, path), unseen=hidden)
    if model.input_noise is None:
        return Products.of(model, run)
    # As the filter goes, which no bound may be above.
    system = filtered(model, run).system if uncertain(model) else coefficients(model, run)
    return Products.of(model, run, system=system)


def noise_of_inputs(model: Dynamics, run: Run, noisy: Mapping[str, float]) -> list[str]:
    """What noise was taken out of a motion, and how slow a turn would be taken for none."""
    notes = []
    for name in uncertain(model):
        unit = next(s.unit for s in model.signals if s.name == name)
        std = float(np.sqrt(model.sensors[name] / period(run, name)))
        least = smallest(std, len(run.recorded(name)))
        how = "shows noise" if name in noisy else "has noise"
        state = f" (--sensor-noise {name}=… states it)" if name in noisy else ""
        notes.append(
            f"{name} {how} of {std:.3g} {unit}{state}; what that makes of the motion is not "
            f"counted, and {name} below {least:.2g} {unit} all the time cannot be told from none"
        )
    return notes


def _readings_alone(model: Dynamics) -> list[str]:
    if not model.traced.g.numel():
        return []
    return [
        "what the model knows exactly (constraint) is not counted: this the readings alone show"
    ]


def _too_short(seen: Seen, run: Run) -> list[str]:
    if seen.rank == seen.unknowns:
        return []
    words = too_short(run, seen.unknowns)
    return [f"{w}; what is called unobservable may only need a longer one" for w in words]


def too_short(run: Run, unknowns: int) -> list[str]:
    """Whether a record has no more samples than there are states to tell apart."""
    if len(run) > unknowns:
        return []
    duration = float(np.ptp(np.asarray(run.time, float)))
    return [
        f"the trajectory is too short for the question: {len(run)} samples over {duration:.3g} s "
        f"for {unknowns} unknowns"
    ]


def window_words(windows: Windows) -> str:
    """Since when a window alone tells every state more than was known beforehand."""
    since = windows.informative_from_s
    if since is None:
        return "no window alone tells every state more than was known beforehand"
    return f"the first window that tells every state more than was known ends at {since:.4g} s"


def combination_words(found: Structural) -> str:
    """Which functions of what is undetermined are determined; empty where there are none."""
    parts = list(found.combinations)
    if found.more:
        what = "combination" if found.more == 1 else "combinations"
        parts.append(f"{found.more} more {what} without a short formula" if parts else
                     f"{found.more} {what} without a short formula")  # fmt: skip
    return f"determined all the same: {', '.join(parts)}" if parts else ""


def weak_directions(result: Observability) -> list[str]:
    """What a trajectory tells less well than it was known beforehand, or a calibration's data much
    worse than each unknown alone, in words; the worst first."""
    if isinstance(result, ObservedMotion):
        return result.weak
    combinations = result.weak if isinstance(result, ObservedParameters) else []
    return [
        f"{w.direction}: {w.inflation:.3g} times worse than each alone"
        for w in sorted(combinations, key=lambda w: -w.inflation)
    ]


def weak_words(result: Observability) -> str:
    """How much of the rank says nothing: `, 1 of them weak`."""
    count = len(weak_directions(result))
    return f", {count} of them weak" if count else ""


def could_reach(result: Observability) -> str:
    """Whether another record could show what this one hides; empty where it hides nothing."""
    could = result.structural_rank if isinstance(result, ObservedMotion) else None
    if could is None or result.observable:
        return ""
    if could > result.rank:
        return f"another motion could show more: the structural rank is {could}"
    return f"no motion shows more: the structural rank is {could} too"


def number_or_not(value: Number) -> str:
    """A standard deviation, or that there is none."""
    return "not determined" if value is None else f"{value:.2g}"
