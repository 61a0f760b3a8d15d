"""What `casest fleet` leaves beside the rows: `fleet.json`, which text and page read too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from casest.declaration.model import Model
from casest.declaration.travelling import fingerprint
from casest.errors import UsageError
from casest.fleet.population import Population
from casest.results.file import load_json
from casest.results.result import Result
from casest.tasks.common import Common, Told
from casest.tasks.job import Job
from casest.tasks.spread import OwnSize, Spreads
from casest.tasks.tally import Moments, Total

FLEET, COMMON = "fleet.json", "common.json"

#: What first speaks against a sensor, by the code that `fleet.json` counts it under.
AGAINST = {
    "readings": "readings that cannot be used",
    "reading": "a reading that is no number",
    "not_finite": "a residual that is not finite",
    "no_redundancy": "too few readings for the unknowns",
    "not_determined": "an unknown that the readings do not determine",
    "bound": "an unknown on a bound of its own",
    "not_settled": "no stationary point",
    "no_minimum": "no minimum",
    "misshapen": "a cost that is no parabola",
    "ambiguous": "another solution",
    "noise": "noise that the residual bends with",
    "loud": "more noise than a sound sensor has",
    "correlated": "readings that resemble their neighbours",
    "poor_valley": "several valleys, and a poor fit",
    "model": "what the model says of it",
}


class Spread(Struct, frozen=True, kw_only=True):
    """An unknown over the trusted sensors: mean and standard deviation, least and largest.

    `typical_std` is the mean of the sensors' own standard deviations.
    """

    mean: float | None
    std: float | None
    least: float | None
    largest: float | None
    typical_std: float | None
    unit: str


class PopulationFound(Struct, frozen=True, kw_only=True):
    """Mean and covariance of the unknowns over the fleet, without the noise of the estimates.

    `sigma` of one residual; `mean_std` and `spread_std` are uncertainties of `mean` and `spread`;
    from `sensors` of them, outlying ones left out. There where covariances were asked for.
    """

    names: list[str]
    mean: list[float]
    mean_std: list[float]
    spread: list[float]
    spread_std: list[float]
    covariance: list[list[float]]
    sigma: float
    sensors: int


class FleetResult(Result, frozen=True, kw_only=True):
    """The content of `fleet.json`: nothing in it depends on who computed, nor when."""

    model_hash: str
    constants: dict[str, Any]
    dataset: str
    partitions: int
    sensors: int
    trusted: int
    rejected: dict[str, int]
    reasons: dict[str, int]
    parameters: dict[str, Spread]
    rms: Spread
    population: PopulationFound | None
    options: str
    versions: dict[str, str]


def fleet_result(
    job: Job,
    total: Total,
    *,
    dataset: str,
    partitions: int,
    unreadable: Sequence[Any],
    found: Population | None = None,
) -> FleetResult:
    """All partitions of a data set in numbers; `found` of their sensors."""
    rejected = dict(total.rejected)
    if unreadable:
        rejected["file"] = rejected.get("file", 0) + len(unreadable)
    names = [name for p in job.model.parameters for name in p.entry_names]
    constants = {c.name: c.array.tolist() for c in job.model.constants}
    return FleetResult(
        model=job.model.name,
        model_hash=fingerprint(job.model),
        constants=constants,
        dataset=dataset,
        partitions=partitions,
        sensors=total.sensors,
        trusted=total.trusted,
        rejected=dict(sorted(rejected.items())),
        reasons=total.codes,
        parameters={name: _spread(name, total.moments, job.units.get(name, "")) for name in names},
        rms=_spread("rms", total.moments, ""),
        population=None if found is None else _population(found),
        options=job.identity["options"],
        versions={name: v for name, v in job.identity.items() if name in job.versions},
    )


def known(folder: Path, model: Model, units: Mapping[str, str]) -> Population:
    """The fleet in a folder, as a prior for sensors of the same model in the same units.

    Raises UsageError where there is none, or it is another model's.
    """
    option, file = f"--prior {folder}", folder / FLEET
    try:
        content = load_json(file)
        found, parameters = content["population"], content["parameters"]
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"{option}: no {FLEET} of casest fleet there that can be read") from None
    if found is None:
        raise UsageError(
            f"{option}: holds no population of sensors; calibrate that fleet with --covariance"
        )
    names = [name for p in model.parameters for name in p.entry_names]
    if content["model"] != model.name or found["names"] != names:
        raise UsageError(
            f"{option}: is a fleet of {content['model']} with the unknowns "
            f"{', '.join(found['names'])}, and this is {model.name} with {', '.join(names)}"
        )
    for name in names:
        before, now = parameters[name]["unit"], units.get(name, "")
        if before != now:
            raise UsageError(f"{option}: {name} is in {before or 'no unit'} there, here in {now}")
    mean, covariance, mean_std, spread_std = (
        np.array(found[n]) for n in ("mean", "covariance", "mean_std", "spread_std")
    )
    sigma, count = found["sigma"], found["sensors"]
    return Population(tuple(names), mean, covariance, sigma, mean_std, spread_std, count)


def _population(found: Population) -> PopulationFound:
    return PopulationFound(
        names=list(found.names),
        mean=found.mean.tolist(),
        mean_std=found.mean_std.tolist(),
        spread=found.spread.tolist(),
        spread_std=found.spread_std.tolist(),
        covariance=found.covariance.tolist(),
        sigma=found.sigma,
        sensors=found.count,
    )


def _spread(name: str, moments: Mapping[str, Moments], unit: str) -> Spread:
    own, std = moments.get(name, Moments()), moments.get(f"{name}_std", Moments())
    some = own.count > 0
    return Spread(
        mean=own.mean if some else None,
        std=own.std if own.count > 1 else None,
        least=own.least if some else None,
        largest=own.largest if some else None,
        typical_std=std.mean if std.count else None,
        unit=unit,
    )


class CommonEffect(Struct, frozen=True, kw_only=True):
    """An effect that the fleet has: unknowns with their common size, and what it changes."""

    name: str
    parameters: dict[str, list[float]]
    chance: float
    indistinguishable_from: list[str]
    follows: dict[str, float]
    sigma_before: float
    sigma_after: float
    moved: dict[str, float]


class OwnEffect(Struct, frozen=True, kw_only=True):
    """An effect of which each of so many sensors has a size of its own.

    parameters: root mean square over sensors, around what they have in common, with its error;
    sigma: over degrees of freedom, before and with the effect in each.
    """

    name: str
    parameters: dict[str, list[float]]
    chance: float
    sensors: int
    indistinguishable_from: list[str]
    sigma_before: float
    sigma_after: float


class FleetClosed(Result, frozen=True, kw_only=True):
    """The content of `common.json`.

    `parameters` of an effect hold value and standard deviation; `moved` the mean move of each
    declared unknown in its own standard deviations. `own`: what each sensor has in a size of its
    own; `own_tried`: the chance of as much where no effect has a spread.
    """

    dataset: str
    sensors: int
    effects: list[CommonEffect]
    tried: dict[str, float]
    invisible: list[str]
    own: OwnEffect | None
    own_tried: dict[str, float]

    @property
    def not_asked(self) -> str:
        """Why no spread was asked for, in words; empty where it was."""
        return (
            ""
            if self.own_tried
            else (
                "whether each has something in a size of its own was not asked: that takes three "
                "residuals more in each than unknowns, an effect's included, and 400 at most"
            )
        )

    @property
    def said(self) -> str:
        """What the sensors have, in words."""
        names = ", ".join(e.name for e in self.effects)
        common = f"{names} in common" if names else "nothing in common that their model lacks"
        if self.own is None:
            return common
        own = "" if self.own.name in names.split(", ") else f"{self.own.name} "
        joined = "" if not own else "and " if names else "but "
        return f"{common}, {joined}{own}each in a size of its own"


def common_result(job: Job, told: Told, spreads: Spreads, dataset: str) -> FleetClosed:
    """What was asked of a fleet, and what it said."""
    return FleetClosed(
        model=job.model.name,
        dataset=dataset,
        sensors=told.sensors,
        effects=[_effect(e) for e in told.effects],
        tried={name: chance for name, chance, visible in told.tried if visible},
        invisible=[name for name, _, visible in told.tried if not visible],
        own=None if spreads.found is None else _own(spreads.found),
        own_tried=dict(spreads.tried),
    )


def _own(e: OwnSize) -> OwnEffect:
    sizes = zip(e.names, e.size, e.error, strict=True)
    return OwnEffect(
        name=e.effect.name,
        parameters={name: [float(v), float(s)] for name, v, s in sizes},
        chance=e.chance,
        sensors=e.sensors,
        indistinguishable_from=list(e.rivals),
        sigma_before=e.before,
        sigma_after=e.after,
    )


def _effect(e: Common) -> CommonEffect:
    pairs = zip(e.names, e.size, e.std, strict=True)
    return CommonEffect(
        name=e.effect.name,
        parameters={name: [float(v), float(s)] for name, v, s in pairs},
        chance=e.chance,
        indistinguishable_from=list(e.rivals),
        follows=e.follows,
        sigma_before=e.before,
        sigma_after=e.after,
        moved=e.moved,
    )
