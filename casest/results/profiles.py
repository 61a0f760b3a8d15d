"""Profiles of the likelihood as they are written and drawn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from casest.declaration.shapes import Array
from casest.estimate.estimate import Estimate
from casest.estimate.profile_likelihood import half_width
from casest.estimate.profiles import HIGH, profiles
from casest.results.units import resolved, unit_table


@dataclass(frozen=True)
class ProfileOf:
    """Values (k,) of one unknown, how far twice the cost has risen there over the variance of one
    residual, and what a parabola would; `inside`: the rise at the ends of the 95 % interval,
    `highest`: up to which it is drawn, `bent`: it is no parabola."""

    name: str
    unit: str
    value: Array
    rise: Array
    parabola: Array
    inside: float
    highest: float
    bent: bool


def profiles_of(estimate: Estimate) -> list[ProfileOf]:
    """Every unknown of a trusted estimate that is a plain number on no bound; else none."""
    if not estimate.certificate.trusted:
        return []
    known = unit_table(estimate.model, estimate.problem.runs)
    inside = half_width(estimate.problem.residual_count - estimate.identifiability.rank) ** 2
    return [
        ProfileOf(
            p.name, resolved(p.unit, known), p.value, p.rise, p.parabola, inside, HIGH, p.bent
        )
        for p in profiles(estimate)
    ]


def profile_rows(every: Sequence[ProfileOf]) -> Iterator[str]:
    """`profiles.csv`, line by line."""
    yield "unknown,unit,value,rise,parabola"
    for p in every:
        for v, r, q in zip(p.value, p.rise, p.parabola, strict=True):
            yield f'"{p.name}",{p.unit},{v:.9g},{r:.6g},{q:.6g}'
