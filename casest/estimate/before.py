"""Do these data agree with what was known before them?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from casest.leastsquares.identifiability import identify
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.stated import UNLIKELY, ChiSquare
from casest.solve.trust_region import LITTLE, trust_region


@dataclass(frozen=True)
class Disagreement:
    """χ² of the prior against the data alone, and the unknown that is pulled furthest.

    `away`: how far the answer is from the prior there, in the prior's standard deviations.
    """

    chi_square: ChiSquare
    source: str
    furthest: str
    away: float

    @property
    def agrees(self) -> bool:
        """Might chance have it so?"""
        return self.chi_square.larger >= UNLIKELY

    @property
    def words(self) -> str:
        """That the two do not agree, and where most."""
        found = self.chi_square
        return (
            f"{self.source} and these data disagree: chi-square {found.value:.4g} with "
            f"{found.degrees_of_freedom} degrees of freedom; "
            f"{self.furthest} is pulled {self.away:.2g} standard deviations away from it"
        )


def against_prior(problem: Problem, point: Point) -> Disagreement | None:
    """How well the two agree: what the fit costs more with the prior than without.

    None without a prior, or where the data say nothing that it says too.
    """
    prior, scale = problem.model.prior, problem.noise_scale
    if prior is None or scale is None:
        return None
    bare = replace(problem, model=replace(problem.model, prior=None))
    alone = trust_region(bare, point, damping=LITTLE)
    more = max(problem.cost(point) - min(alone.cost, bare.cost(point)), 0.0)
    rank = identify(bare, point, bare.factor(point)[0]).rank
    places = [i for slot, *_ in problem.known_before for i in range(slot.x.start, slot.x.stop)]
    freedom = rank + len(places) - problem.unknowns
    if freedom < 1:
        return None
    known = problem.point({**problem.values(point), **prior.by_name})
    entries = np.concatenate([known.entries for known in problem.known_before])
    std = np.sqrt(np.diag(np.array(prior.covariance)))[entries]
    away = np.abs(problem.difference(point, known)[places]) / std
    worst = int(np.argmax(away))
    found = ChiSquare(2 * more / scale**2, freedom)
    return Disagreement(found, prior.source, problem.names[places[worst]], float(away[worst]))
