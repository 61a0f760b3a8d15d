"""Which candidate explains the data best, and which are not told apart from it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.candidates.grid import grid_value
from casest.diagnose.candidates.score_test import Score, second_freedom
from casest.diagnose.selection.cross_validation import FAR, Folds, gain

#: Chance, under a model that lacks nothing, that any candidate is called significant.
FALSE_ALARM = 0.004
#: Candidates whose errors differ by fewer standard errors are not told apart.
ALIKE = 2.0
#: Differences of evidence that are not worth more than a bare mention, and not strong (Kass &
#: Raftery 1995).
BARE_MENTION, STRONG = 2.0, 6.0
#: Share of the held-out mean square below which a cause must be the only one that it can be.
SMALL = 0.01
#: Share of the mean square that is no matter.
NEXT_TO_NOTHING = 0.005


@dataclass(frozen=True)
class Fitted:
    """A model fitted to all data, with its residuals and, once they are asked for, held-out ones.

    `noise` is σ of one residual, from the middle of their distribution. `lighter` says what could
    be left away of the effect added last: unknowns fewer, and squares more, in σ². `moved` is what
    its coming changed of the other parameters, by what they predict: squares, in σ².
    """

    model: Model
    values: Mapping[str, Array]
    unknowns: int
    residuals: tuple[Array, ...]
    noise: float
    held_out: tuple[Array, ...] = ()
    lighter: tuple[tuple[int, float], ...] = ()
    moved: float = 0.0

    def without(self, label: str) -> tuple[Model, dict[str, Array]]:
        """The model without an effect, and the values of what it has left."""
        own = self.model.unknowns_of(label)
        left = tuple(a for a in self.model.effects if a.label != label)
        values = {n: v for n, v in self.values.items() if n not in own}
        return replace(self.model, effects=left), values


def cost_of(fitted: Fitted) -> float:
    """Sum of squared residuals."""
    return sum(float(np.sum(r**2)) for r in fitted.residuals)


def clipped_squares(fitted: Fitted, sigma: float) -> float:
    """Sum of squared residuals in σ², far ones counted as FAR."""
    return sum(float(np.sum(np.minimum((r / sigma) ** 2, FAR**2))) for r in fitted.residuals)


def unknowns_of(score: Score, fitted: Fitted) -> int:
    """Of the fit; a level or moment that was looked for is one more."""
    return fitted.unknowns + (grid_value(score.candidate) is not None)


def price_of(score: Score, fitted: Fitted, price: float) -> float:
    """Of the unknowns, without those of axes that cost more than they explain."""
    count = unknowns_of(score, fitted)
    ways = [(0, 0.0), *fitted.lighter]
    return min(price * (count - fewer) + more / score.inflation for fewer, more in ways)


def by_evidence(tried: Sequence[tuple[Score, Fitted]]) -> list[tuple[Score, Fitted]]:
    """Best first: the sum of squares, and a price for every unknown (Hannan & Quinn 1979).

    Schwarz's price, ln N, makes little of how well a cause with several unknowns fits a long
    record, and one unknown that wrenches all parameters wins.
    """
    criteria = evidence(tried)
    return [tried[k] for k in np.argsort(criteria, kind="stable")]


def evidence(tried: Sequence[tuple[Score, Fitted]]) -> list[float]:
    """Squares in σ² and what the unknowns cost, of each candidate: the least is the best."""
    if not tried:
        return []
    sigma = min(fitted.noise for _, fitted in tried)
    # What the noise's colour makes of the squares: beside the cause nothing else varies.
    inflation = min(score.inflation for score, _ in tried)
    price = 2 * float(np.log(np.log(max(sum(r.size for r in tried[0][1].residuals), 16))))
    return [clipped_squares(f, sigma) / inflation + price_of(s, f, price) for s, f in tried]


def as_good(
    tried: Sequence[tuple[Score, Fitted]], folds: Folds, within: float
) -> list[tuple[Score, Fitted]]:
    """The best, and what is not told apart from it and has as much evidence but for `within`."""
    if not tried:
        return []
    criteria, (score, best) = evidence(tried), tried[0]
    return [
        pair
        for c, pair in zip(criteria, tried, strict=True)
        if pair[1] is best
        or (c <= min(criteria) + within and not_told_apart(best, pair[1], score, folds))
    ]


def least_loss_first(
    tried: Sequence[tuple[Score, Fitted]], folds: Folds, known: Collection[str] = ()
) -> list[tuple[Score, Fitted]]:
    """Of those that are as good as the best, first the one that moves the parameters least.

    Where two causes explain the same, the smaller correction does the smaller harm if it is the
    wrong one. As good: in evidence and in error. Before them come effects that are known to be
    there, if the data do not speak against them.
    """
    if not tried:
        return []
    matter = NEXT_TO_NOTHING * sum(r.size for r in tried[0][1].residuals)
    near = as_good(tried, folds, min(BARE_MENTION, matter))
    near.sort(key=lambda pair: pair[1].moved)
    said = [p for p in as_good(tried, folds, STRONG) if p[0].candidate.among(known)]
    leaders = said + [p for p in near if not p[0].candidate.among(known)]
    led = {id(fitted) for _, fitted in leaders}
    return leaders + [pair for pair in tried if id(pair[1]) not in led]


def best_of_each(ranked: Sequence[Score], current: Fitted) -> list[Score]:
    """The best of several trials of one effect, those that promise most first."""
    seen: dict[str, Score] = {}
    for score in sorted(ranked, key=lambda s: -s.gain / s.inflation):
        seen.setdefault(score.candidate.label, score)
    price = np.log(sum(r.size for r in current.residuals))
    return sorted(seen.values(), key=lambda s: price * s.freedom - s.gain / s.inflation)


def with_rivals(confirmed: Sequence[Score], ranked: Sequence[Score]) -> list[Score]:
    """Those that are significant, and what explains more than they do.

    That something is missing is known then, at their p-value. A limit that two poses reach is never
    significant by itself, and may be the cause of all that others explain in part.
    """
    most, proof = max(s.gain for s in confirmed), min(s.p_value for s in confirmed)
    more = [s for s in ranked if s not in confirmed and s.gain > most]
    return [*confirmed, *(replace(s, p_value=min(s.p_value, proof)) for s in more)]


def as_promising(score: Score, winner: Score) -> bool:
    """Could it explain as much as the winner? By the first-order gains, generously."""
    lost = (winner.gain - score.gain) / winner.inflation
    return lost <= 0.2 * winner.gain / winner.inflation + 4 * ALIKE**2


def not_told_apart(one: Fitted, other: Fitted, score: Score, folds: Folds) -> bool:
    """Do the data not tell two models apart? (Vuong 1989, with 2 for every unknown)."""
    gained, error = gain(other.residuals, one.residuals, folds, one.noise)
    lead = gained + _price_of_two(other, score) - _price_of_two(one, score)
    return lead <= ALIKE * error + 1e-6 * sum(r.size for r in one.residuals)


def _price_of_two(fitted: Fitted, score: Score) -> float:
    """2 for every unknown, where leaving it away does not cost less; in σ²."""
    ways = [(0, 0.0), *fitted.lighter]
    return min(2 * (fitted.unknowns - few) * score.inflation + more for few, more in ways)


def confirmed_by_flips(
    significant: list[Score], ranked: list[Score], chance: float = FALSE_ALARM
) -> list[Score]:
    """The smallest p-value must be rare when the signs of the batches' noise are random.

    Flipping the sign of all that a batch contributes keeps unequal noise as it is, and the
    dependence between candidates (Westfall & Young 1993, with wild bootstrap weights). Rarer than
    `chance`, among those of all that are ranked.
    """
    if not significant:
        return []
    rng = np.random.default_rng(0)
    alive = [s for s in ranked if s.freedom]
    flips = rng.choice([-1.0, 1.0], (999, len(alive[0].batches)))
    smallest = np.ones(len(flips))
    from scipy.special import fdtrc

    for s in alive:
        total = flips @ s.batches
        F = np.sum(total**2, axis=1) / s.freedom / s.inflation
        second = second_freedom(s.freedom, s.inflation, s.effective)
        p = np.minimum(1.0, fdtrc(s.freedom, second, F) * s.candidate.trials)
        smallest = np.minimum(smallest, p)
    limit = float(np.quantile(smallest, chance))
    return [s for s in significant if s.p_value <= limit]
