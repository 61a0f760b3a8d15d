"""What Monte Carlo says of a result's uncertainties to first order (JCGM 101, clause 8)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from msgspec import Struct

from casest.correction.spread_trials import corrected_trials
from casest.declaration.shapes import Array
from casest.errors import CasestError
from casest.estimate.estimate import Estimate
from casest.estimate.monte_carlo import FirstOrder, Validation, halves, validate
from casest.estimate.trials import Refits, Trials
from casest.results.file import plain
from casest.results.result import Number
from casest.results.rounding import rounded
from casest.results.uncertainty import CorrectedBudget, entries_of
from casest.results.units import unit_table


class Compared(Struct, frozen=True):
    """One number by first order and by Monte Carlo; `validated` is null where trials do not tell.

    Intervals are of 95 %; `apart` the larger distance of their ends, which may be `tolerance`.
    """

    name: str
    unit: str
    value: Number
    std: Number
    interval: list[Number]
    mean: Number
    monte_carlo_std: Number
    monte_carlo_interval: list[Number]
    apart: Number
    tolerance: Number
    validated: bool | None


class Validated(Struct, frozen=True):
    """All of them, after so many `trials`; `lost`: those that found no minimum. Not `stable`: time
    ran out before the results were known to a fifth of the tolerance."""

    trials: int
    lost: int
    digits: int
    limit: float
    stable: bool
    values: list[Compared]
    corrected: list[Compared]

    @property
    def every(self) -> list[Compared]:
        """Values, then components of the corrected reading."""
        return [*self.values, *self.corrected]


def validated(
    estimate: Estimate,
    corrected: CorrectedBudget | None,
    *,
    digits: int,
    limit: float,
    seed: int,
    say: Callable[[str], None] = lambda _: None,
) -> Validated:
    """Trials of a fit, and of the corrected reading of its budget; UsageError where none follow."""
    refits = Refits.of(estimate)
    names, units, slope = entries_of(estimate)
    covariance = refits.first_order
    values = _entries(estimate, slope)
    std = np.sqrt(np.diag(slope @ covariance @ slope.T))
    carried = 0.0 if estimate.inputs is None else estimate.inputs.carried
    random = np.diag(slope @ (covariance - carried) @ slope.T)
    half = halves(std, _effective(std**2, random, refits.freedom))
    now = values(_at(estimate))[0]
    first = FirstOrder(tuple(names), now, std, half)
    also, reading = _reading(estimate, corrected, refits)
    if also is not None:
        units = [*units, *[corrected.unit if corrected else ""] * len(also.names)]
        first = FirstOrder(
            (*first.names, *also.names),
            *(np.concatenate(p) for p in zip(_numbers(first), _numbers(also), strict=True)),
        )

    def outcomes(trials: Trials, rng: np.random.Generator) -> Array:
        found = values(trials)
        return found if reading is None else np.hstack([found, reading(trials, rng)])

    found = validate(refits, first, outcomes, digits=digits, limit=limit, seed=seed, say=say)
    each = _compared(found, units)
    return Validated(found.trials, found.lost, digits, limit, found.stable,
                     each[: len(names)], each[len(names) :])  # fmt: skip


def _numbers(first: FirstOrder) -> tuple[Array, Array, Array]:
    return first.values, first.std, first.half


def _effective(variance: Array, random: Array, freedom: float) -> Array:
    """Degrees of freedom where only the random part has so many (Welch & Satterthwaite)."""
    if not np.isfinite(freedom):
        return np.full(len(variance), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(random > 0, freedom * (variance / random) ** 2, np.inf)


def _at(estimate: Estimate) -> Trials:
    point, inputs = estimate.optimum or estimate.point, estimate.inputs
    known = np.zeros(0) if inputs is None else inputs.values
    return Trials(point.x[None], known[None], np.ones(1, dtype=bool))


def _entries(estimate: Estimate, slope: Array) -> Callable[[Trials], Array]:
    """Entries (T, q) of all parameters; of directions and rotations by their charts."""
    problem, point = estimate.problem, estimate.optimum or estimate.point

    def values(trials: Trials) -> Array:
        parts = []
        for slot in problem.slots:
            own = trials.unknowns[:, slot.x]
            if slot.parameter.shape.curved:
                own = problem.charted_many(slot, own, point.references[slot.ref])
            parts.append(own)
        return np.hstack(parts)

    assert values(_at(estimate)).shape[1] == len(slope)
    return values


def _reading(
    estimate: Estimate, corrected: CorrectedBudget | None, refits: Refits
) -> tuple[FirstOrder | None, Any]:
    """The corrected reading to first order, and what trials make of it."""
    if corrected is None or None in corrected.value or None in corrected.std:
        return None, None
    units = unit_table(estimate.model, estimate.problem.runs)
    value, std = np.array(corrected.value, float), np.array(corrected.std, float)
    try:
        reading = corrected_trials(estimate, units, np.array(corrected.at, float), value)
    except CasestError:
        return None, None
    random = std**2 * (1 - _shares(corrected))
    half = halves(std, _effective(std**2, random, refits.freedom))
    several = len(value) > 1
    names = tuple(corrected.name + (f"[{k}]" if several else "") for k in range(len(value)))
    return FirstOrder(names, value, std, half), reading


def _shares(corrected: CorrectedBudget) -> Array:
    """Share of the variance that is known: of references, and of the reading's own noise."""
    own = (*corrected.sensitivity, "the reading's own noise")
    known = [corrected.share[name] for name in own if name in corrected.share]
    return np.asarray(np.sum(np.nan_to_num(np.array(known, dtype=float)), axis=0))


def _compared(found: Validation, units: list[str]) -> list[Compared]:
    first, verdicts = found.first, found.validated
    return [
        Compared(
            name,
            units[i],
            plain(first.values[i]),
            plain(first.std[i]),
            plain(first.values[i] + first.half[i] * np.array([-1, 1])),
            plain(found.mean[i]),
            plain(found.std[i]),
            plain(found.interval[i]),
            plain(np.max(found.apart[i])),
            plain(found.tolerance[i]),
            verdicts[i],
        )
        for i, name in enumerate(first.names)
    ]


def sentence(found: Validated) -> str:
    """What the trials say, in words."""
    of = len(found.every)
    yes = sum(v.validated is True for v in found.every)
    no = [v.name for v in found.every if v.validated is False]
    open_ = [v.name for v in found.every if v.validated is None]
    words = f"Monte Carlo (JCGM 101), {found.trials:,} trials: "
    if found.lost:
        words += f"{found.lost:,} of them found no minimum; "
    words += f"first order is validated for {yes} of {of} numbers"
    if no:
        words += f", and not for {_listed(no)}: take the trials' intervals there"
    if open_:
        words += (
            f"; for {_listed(open_)} the trials of {found.limit:g} s do not tell: give them more "
            "time (--limit SECONDS)"
        )
    return words


def _listed(names: list[str], most: int = 6) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


#: What a verdict is called.
VERDICTS = {True: "validated", False: "not validated", None: "open"}


def rows(found: Validated) -> Iterator[tuple[str, ...]]:
    """Of each number: name, both intervals, how far apart they are and may be, the verdict."""
    for v in found.every:
        if v.std is None or None in (*v.interval, *v.monte_carlo_interval):
            yield v.name, "", "", "", "", VERDICTS[v.validated]
            continue
        ends = (*v.interval, *v.monte_carlo_interval)
        own, other = (
            f"{rounded(float(low or 0), v.std)[0]} to {rounded(float(high or 0), v.std)[0]}"
            for low, high in (ends[:2], ends[2:])
        )
        apart, may_be = f"{v.apart:.2g}", f"{v.tolerance:.2g}"
        yield v.name, own, other, apart, may_be, VERDICTS[v.validated]
