"""Measurements that tell rivals apart: T-optimal designs as designs for one amplitude.

Were rival a true, rival b would be off by δ(x) at x; b's unknowns take up what they can. What is
left, λ = min over d of dᵀM d + Σ‖δ(x) − J_b(x) d‖² with M the information that there is of b, is
the inverse variance of the amplitude of δ beside b's unknowns: so what is best for the one is best
for the other, with the same certificate. λ is the growth of 2 log of the likelihood ratio that is
to be expected, with a standard deviation of 2√λ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.errors import UsageError
from casest.plan.candidates.candidates import Candidates, Noise, whitened
from casest.plan.candidates.runs import off_by
from casest.plan.goals import Goal
from casest.plan.planning import Planned, Task, criterion_of, planned, task, until
from casest.plan.rivals.rivals import Rival

#: Chance with which a plan is to tell them apart.
POWER = 0.95
#: Share of what tells two rivals apart, beside the unknowns, that is rounding.
ALIAS = 1e-9


@dataclass(frozen=True)
class Pair:
    """Were `true` the cause, `against` would be refuted: λ needed, given the lead there is."""

    true: str
    against: str
    lead: float

    @property
    def needed(self) -> float:
        """λ with which 2 log of the likelihood ratio is beyond the limit with chance POWER."""
        missing, z = LEVELS.clear - self.lead, NormalDist().inv_cdf(POWER)
        if missing <= -z * z:
            return 0.0
        return float((z + np.sqrt(max(z * z + missing, 0.0))) ** 2)

    def power(self, growth: float) -> float:
        """The chance with which the pair is told apart after this growth."""
        if growth <= 0:
            return float(self.lead >= LEVELS.clear)
        return NormalDist().cdf((growth + self.lead - LEVELS.clear) / (2 * float(np.sqrt(growth))))


@dataclass(frozen=True)
class Separation:
    """Candidates as the first rival has them, and the task of telling all pairs apart.

    `amplitudes`: the columns of the pairs' amplitudes among its unknowns.
    """

    candidates: Candidates
    pairs: tuple[Pair, ...]
    task: Task
    amplitudes: tuple[int, ...]

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
) -> Separation:
    """The task of telling the rivals apart; `make` gives the candidates as one rival has them.

    UsageError where two of them are one under all that can be measured.
    """
    found = [make(rival) for rival in rivals]
    blocks, known, pairs, aliases = [], [], [], list[tuple[str, str]]()
    for a, truth in zip(rivals, found, strict=True):
        for b in rivals:
            if a is b:
                continue
            block = _seen(truth, a, b, noise, rate)
            if _alias(block):  # b takes up all that a is: it cannot be refuted
                _refuse_alias(a, b, rivals, aliases, what, len(block))
                aliases.append((a.label, b.label))
                continue
            blocks.append(block)
            known.append(b.information)
            pairs.append(Pair(a.label, b.label, b.cost - a.cost))
    factors, information, amplitudes = _side_by_side(blocks, known)
    names = [f"unknown {k}" for k in range(factors.shape[2])]
    return Separation(
        found[0], tuple(pairs), task(factors, information, names, what), tuple(amplitudes)
    )


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
    return bool(np.linalg.norm(left) < ALIAS * max(float(np.linalg.norm(r)), ALIAS))


def _refuse_alias(
    a: Rival,
    b: Rival,
    rivals: Sequence[Rival],
    aliases: Sequence[tuple[str, str]],
    what: str,
    count: int,
) -> None:
    """Where neither of two can be refuted."""
    if (b.label, a.label) not in aliases:
        return
    others = [r.label for r in rivals if r is not a and r is not b]
    beside = f" ({', '.join(others)} aside)" if others else ""
    raise UsageError(
        f"{what}: {b.label} and {a.label} are one under all {count} candidates{beside}: refitted, "
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
        raise UsageError(
            f"{what}: {most} measurements tell {worst.true} from {worst.against} in "
            f"{100 * min(powers):.0f} % at best; allow more (--most), or another kind "
            "(--vary, --candidates)"
        ) from None
