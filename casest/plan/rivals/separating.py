"""Measurements that tell rivals apart: T-optimal designs as designs for one amplitude.

Were rival a true, rival b would be off by δ(x) at x; b's unknowns take up what they can. What is
left, λ = min over d of dᵀM d + Σ‖δ(x) − J_b(x) d‖² with M the information that there is of b, is
the inverse variance of the amplitude of δ beside b's unknowns: so what is best for the one is best
for the other, with the same certificate. λ is the growth of 2 log of the likelihood ratio that is
to be expected, with a standard deviation of 2√λ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import NormalDist

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.errors import UsageError
from casest.plan.candidates.candidates import Candidates, Noise, whitened
from casest.plan.candidates.runs import off_by
from casest.plan.design.continuous import continuous
from casest.plan.design.criteria import Trace
from casest.plan.goals import Goal
from casest.plan.planning import ROUGHLY, Planned, Task, criterion_of, planned, task, until
from casest.plan.rivals.rivals import Rival

#: Chance with which a plan is to tell them apart; groups of rivals that it is made for.
POWER, GROUPS = 0.95, 3
#: Share of what tells two rivals apart, beside the unknowns, that is rounding; and its size in
#: the noise of one measurement, which no number of them shows.
ALIAS, NOTHING = 1e-9, 1e-6


@dataclass(frozen=True)
class Pair:
    """Were `true` the cause, `against` would be refuted: given the lead there is.

    apart: standard errors that what the two foretell must be apart by, as `close` asks of rivals.
    """

    true: str
    against: str
    lead: float
    apart: float = LEVELS.apart

    @property
    def needed(self) -> float:
        """λ with which the pair is told apart with chance POWER."""
        low, high = 0.0, 1.0
        if self.power(low) >= POWER:
            return low
        while self.power(high) < POWER:
            low, high = high, 2 * high
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self.power(middle) >= POWER else (middle, high)
        return high

    def limit(self, growth: float) -> float:
        """2 log of the likelihoods' ratio from which on the pair is told apart after this growth.

        What is clear; and `apart` standard errors of what the two foretell of old and new readings,
        whose squares differ by a λ with a variance of 4λ.
        """
        errors = 2 * float(np.sqrt(growth + max(self.lead, 0.0)))
        return max(LEVELS.clear, self.apart * errors)

    def power(self, growth: float) -> float:
        """The chance with which the pair is told apart after this growth."""
        beyond = growth + self.lead - self.limit(growth)
        if growth <= 0:
            return float(beyond >= 0)
        return NormalDist().cdf(beyond / (2 * float(np.sqrt(growth))))


@dataclass(frozen=True)
class Together:
    """Two rivals that stay one: the best chance of telling them apart, None of an exact alias.

    wider: the one that contains the other, where one does. most: measurements that were allowed.
    """

    one: str
    other: str
    chance: float | None
    wider: str | None
    most: int

    def __str__(self) -> str:
        """Why they are not told apart."""
        if self.chance is None:
            return f"{self.one} and {self.other} are one under all that can be measured here"
        best = f"{self.most} measurements for it alone: {100 * self.chance:.0f} % at best"
        if self.wider is None:
            return f"{self.one} and {self.other} stay together ({best})"
        narrow = self.one if self.wider == self.other else self.other
        return f"{self.wider} contains {narrow}: how much more it does stays open ({best})"


@dataclass(frozen=True)
class Separation:
    """Candidates as the first rival has them, and the task of telling all pairs apart.

    `amplitudes`: the columns of the pairs' amplitudes among its unknowns. together: those that the
    plan leaves one.
    """

    candidates: Candidates
    pairs: tuple[Pair, ...]
    task: Task
    amplitudes: tuple[int, ...]
    together: tuple[Together, ...] = ()

    @property
    def labels(self) -> set[str]:
        """The rivals that the plan is made for."""
        return {label for p in self.pairs for label in (p.true, p.against)}

    def growths(self, chosen: Sequence[int]) -> Array:
        """λ of each pair after some of the candidates."""
        M = self.task.information(chosen) + 1e-12 * np.eye(len(self.task.scale))
        variances = np.diag(np.linalg.inv(M))[list(self.amplitudes)]
        scale = self.task.scale[list(self.amplitudes)]
        return np.asarray(1 / (variances * scale**2))

    def powers(self, chosen: Sequence[int]) -> list[float]:
        """Chance of each pair to be told apart."""
        growths = self.growths(chosen)
        return [p.power(float(g)) for p, g in zip(self.pairs, growths, strict=True)]


def separation(
    rivals: Sequence[Rival],
    noise: Noise,
    make: Callable[[Rival], Candidates],
    what: str,
    rate: float | None = None,
    most: int = 200,
    apart: float = LEVELS.apart,
) -> Separation:
    """The task of telling the rivals apart; `make` gives the candidates as one rival has them.

    apart: standard errors that `close` asks for between two causes; of a cause and none it asks for
    0.
    Two that `most` measurements do not tell apart, or of which one contains the other, are left
    together where others remain; UsageError where none can be refuted.
    """
    found = [make(rival) for rival in rivals]
    seen = {
        (i, j): _seen(truth, rivals[i], rivals[j], noise, rate)
        for i, truth in enumerate(found)
        for j in range(len(rivals))
        if i != j
    }
    aliases = {key for key, block in seen.items() if _alias(block)}  # b takes up all that a is
    pairs = {
        (i, j): Pair(rivals[i].label, rivals[j].label, rivals[j].cost - rivals[i].cost, apart)
        for i, j in seen
        if (i, j) not in aliases
    }
    if not pairs:
        _refuse_alias(rivals, what, len(found[0]))
    together = _together(rivals, seen, pairs, most)
    planned_for = _first_groups(len(rivals), list(together))
    asked = {
        key: pair
        for key, pair in pairs.items()
        if tuple(sorted(key)) not in together and planned_for.issuperset(key)
    }
    chosen = asked or pairs  # where none is in reach, what comes nearest
    factors, information, amplitudes = _side_by_side(
        [seen[key] for key in chosen], [rivals[j].information for _, j in chosen]
    )
    names = [f"unknown {k}" for k in range(factors.shape[2])]
    return Separation(
        found[0],
        tuple(chosen.values()),
        task(factors, information, names, what, found[0].once),
        tuple(amplitudes),
        tuple(t for key, t in together.items() if asked and planned_for.issuperset(key)),
    )


def _first_groups(count: int, together: Sequence[tuple[int, int]]) -> set[int]:
    """Rivals of the first GROUPS groups of those that stay one."""
    groups = list[set[int]]()
    for i in range(count):
        own = next((g for g in groups if any((j, i) in together for j in g)), None)
        if own is None:
            groups.append({i})
        else:
            own.add(i)
    return set().union(*groups[:GROUPS])


def _together(
    rivals: Sequence[Rival],
    seen: Mapping[tuple[int, int], Array],
    pairs: Mapping[tuple[int, int], Pair],
    most: int,
) -> dict[tuple[int, int], Together]:
    """Rivals that `most` measurements, chosen for them alone, do not tell apart, and those of which
    one contains the other: how much it bends more is no question of which cause it is."""
    found = {}
    for i, j in combinations(range(len(rivals)), 2):
        ways = [key for key in ((i, j), (j, i)) if key in pairs]
        best = [_best_chance(pairs[key], seen[key], rivals[key[1]].information, most)
                for key in ways]  # fmt: skip
        if len(best) < 2 or min(best) < POWER:
            wider = rivals[ways[0][0]].label if len(ways) == 1 else None
            chance = min(best) if best else None
            found[i, j] = Together(rivals[i].label, rivals[j].label, chance, wider, most)
    return found


def _best_chance(pair: Pair, block: Array, information: Array, most: int) -> float:
    """An upper bound of the chance to tell one pair apart with so many measurements."""
    if not pair.needed:
        return 1.0
    alone = task(*_side_by_side([block], [information])[:2], [""] * block.shape[2], "")
    amplitude = np.zeros((block.shape[2], 1))
    amplitude[-1] = alone.scale[-1]
    floor = continuous(Trace(amplitude), alone.start, alone.factors, most, ROUGHLY).floor
    return pair.power(1 / max(floor, 1e-300))


def _seen(truth: Candidates, a: Rival, b: Rival, noise: Noise, rate: float | None) -> Array:
    """What b sees of each candidate as a has it: slopes and, last, by how much it is off."""
    if truth.run is not None:
        off, slopes = whitened(b.model, b.values, truth.run, noise)
        return np.concatenate([slopes, off[:, :, None]], axis=2)
    assert rate is not None
    settings = [{n: v[i] for n, v in truth.settings.items()} for i in range(len(truth))]
    return np.array([off_by(a, b, noise, each, rate) for each in settings])


def _alias(block: Array) -> bool:
    """Over everything that can be measured: is nothing left of one rival beside the other?"""
    rows = block.reshape(-1, block.shape[2])
    J, r = rows[:, :-1], rows[:, -1]
    norms = np.linalg.norm(J, axis=0)
    J = J / np.where(norms > 0, norms, 1.0)
    left = r - J @ np.linalg.lstsq(J, r, rcond=None)[0]
    least = max(ALIAS * float(np.linalg.norm(r)), NOTHING * float(np.sqrt(len(r))))
    return bool(np.linalg.norm(left) < least)


def _refuse_alias(rivals: Sequence[Rival], what: str, count: int) -> None:
    """Where none can be refuted."""
    one, other = rivals[0].label, rivals[1].label
    others = [r.label for r in rivals[2:]]
    beside = f" (and so is {', '.join(others)})" if others else ""
    raise UsageError(
        f"{what}: {one} and {other} are one under all {count} candidates{beside}: refitted, "
        f"either gives the readings of the other to {ALIAS:g}; only another kind of measurement "
        "tells them apart (--vary, --candidates)"
    )


def _side_by_side(
    blocks: Sequence[Array], known: Sequence[Array]
) -> tuple[Array, Array, list[int]]:
    """Each pair's own unknowns and its amplitude, one pair after the other."""
    N, m, _ = blocks[0].shape
    sizes = [block.shape[2] for block in blocks]
    ends = np.cumsum([0, *sizes])
    factors = np.zeros((N, m * len(blocks), ends[-1]))
    information = np.zeros((ends[-1], ends[-1]))
    for k, (block, M) in enumerate(zip(blocks, known, strict=True)):
        factors[:, m * k : m * (k + 1), ends[k] : ends[k + 1]] = block
        own = slice(int(ends[k]), int(ends[k]) + len(M))  # a new run's own unknowns are unknown
        information[own, own] = M
    return factors, information, [int(e) - 1 for e in ends[1:]]


def separated(found: Separation, count: int | None, most: int, what: str) -> Planned:
    """`count` measurements that tell the pairs apart best, or as many as POWER takes.

    UsageError with the best possible where `most` are too few.
    """
    n = len(found.task.scale)
    columns = np.zeros((n, len(found.pairs)))
    for k, (place, pair) in enumerate(zip(found.amplitudes, found.pairs, strict=True)):
        columns[place, k] = np.sqrt(max(pair.needed, 1e-6))
    if count is not None:
        return planned(found.task, criterion_of(found.task, "", columns), count)
    try:
        return until(found.task, [Goal("told apart", 1.0, "1", columns)], most)
    except UsageError:
        best = planned(found.task, criterion_of(found.task, "", columns), most)
        powers = found.powers(best.chosen)
        worst = found.pairs[int(np.argmin(powers))]
        contains = ""
        if not any(p.against == worst.true and p.true == worst.against for p in found.pairs):
            contains = f", which {worst.true} contains,"
        raise UsageError(
            f"{what}: {most} measurements tell {worst.true} from {worst.against}{contains} in "
            f"{100 * min(powers):.0f} % at best; allow more (--most), or another kind "
            "(--vary, --candidates)"
        ) from None
