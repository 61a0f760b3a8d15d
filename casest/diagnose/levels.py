"""Every chance, price, clip and limit of the loop, once, with where it comes from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Levels:
    """What the loop decides by.

    clip: robust standard deviations that a residual counts as at most (Huber; usual).
    series: rows in time from which on noise has a colour of its own, and t tests have power; fewer
        are poses, which the classical F test judges.
    chance: of naming anything where nothing is missing, in poses; shared among all families.
    strong: difference of twice the log of two likelihoods, less what the unknowns cost, that is
        strong evidence (Kass & Raftery 1995).
    clear: the same between two causes: the wrong one of two leads by as much in one of a thousand
        records at most.
    confirmed: standard errors by which held-out squares must fall, one-sided 5 %.
    apart: standard errors between two causes' held-out squares, two-sided 5 % (Vuong 1989).
    alike: share of what a cause gains that another may lose and still explain the same.
    described: lead of a formula over the best name. True causes without a name lead by 95 and more,
        formulas over causes that have one by at most 21.
    terms: of a formula. contenders: causes that are tried in pairs.
    rounds: of the loop at most.
    stretches, regions, pieces, folds: parts that are held out whole; interleaved pieces and the
        folds that they make.
    survives: share of a cause's length that the declared unknowns must leave.
    misfit: chance of each kind of misfit where there is none; share: of the variance, from which
        on one counts. blocks, block: means that are compared, and the rows in each at least.
    rows: of a longer record so many, evenly chosen, are looked at.
    """

    clip: float = 3.5
    series: int = 100
    chance: float = 0.01
    strong: float = 6.0
    clear: float = 10.0
    confirmed: float = 1.64
    apart: float = 2.0
    alike: float = 0.1
    described: float = 30.0
    terms: int = 3
    contenders: int = 6
    rounds: int = 6
    stretches: int = 10
    regions: int = 10
    pieces: int = 40
    folds: int = 5
    survives: float = 1e-3
    share: float = 0.02
    misfit: float = 0.001
    blocks: int = 60
    block: int = 20
    rows: int = 12_000


LEVELS = Levels()

#: Stretches that a continuous record is cut into, for folds and batches.
STRETCHES = 40
