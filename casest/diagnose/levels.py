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
    nested: share of a cause's squares that may lie outside the columns of one that contains it.
    terms: of a formula. contenders: causes that are tried in pairs. nearest: rivals that are named
        first. rounds: of the loop at most.
    stretches, regions, pieces, folds: parts that are held out whole; interleaved pieces and the
        folds that they make. few_regions: those of poses. refits: folds of which each is foretold
        by a fit of its own to the others.
    far: robust standard deviations that a held-out residual counts as at most. beyond: those from
        which on it does not count in a share of the variance.
    told: share of what the record says of a direction that the rest of it must say.
    uncertain: variance that a fit to the rest may leave of a part, in those of the noise.
    repeated: share of a column's deviation that a signal does not tell, up to which the column is
        that signal once more: two meters of one quantity agree so far, an influence does not.
    stand_in: share of a column's variance that a signal does not tell, up to which its curve
        could be a bend over that signal: of an input of one number, and of any in poses and tables.
    stays: share of what inputs do to a reading that must stay beside a column's influence, and by
        which it may change.
    passing: share of a record's rows up to which inputs that are held else go from level to level.
    fades: time constants that a record must span for a memory to be seen to fade.
    most: share of the squares below which what is left says more than how likely a slow course is;
    survives: share of a cause's length that the declared unknowns must leave; over_noise: an
        implicit residual's slopes contain its noise, of which so many must survive.
    seen, unseen: noncentrality of the score from which on an effect is found nearly always, and
        below which (three standard deviations) nobody could.
    told_share: of the variance, below which what causes explain alike is printed as 0 %.
    misfit: chance of each kind of misfit, or of a colour of noise, where there is none; share: of
        the variance, from which on one counts. blocks, block: means that are compared, and the rows
        in each at least.
    lacks: residual over the scatter within rest intervals from which on rests lack something: what
        is slower than a rest (bias instability) is not in that scatter, and no misfit of its own.
    rounded: residual over a step of the reading below which rounding alone (1/√12 = 0.29) may be
        all of it.
    half: of a step of the reading: as far is each from what it rounds.
    outliers: log-likelihood over that of Student's t from which on samples are outliers: t noise of
        3 to 6 degrees of freedom gets there in less than one of a hundred records.
    louder: median third difference, in that of three quarters of the blocks, from which on
        the noise of a block counts as louder: none of 20 000 blocks of white noise on one axis did.
    jump: by how many times what is held jumps at both ends of a level, in what it jitters there
        from lowest to highest; jitters: rows of such a level at least. In 120 000 rows of white or
        coloured noise, of heavy tails or a random walk six levels pass at most. repeats: rows that
        are the same, at least.
    rows: of a longer record so many, evenly chosen, are looked at.

    In motion: suspect: whiteness below which noise with a colour is tried, and insists: gain of
    log-likelihood that asks for it too; coloured: whiteness below which it is a misfit; loud: an
    input's matched intensity in that of its own readings, from which on it is no noise; shortest:
    samples below which nothing can be held out.
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
    nested: float = 0.5
    terms: int = 3
    contenders: int = 6
    nearest: int = 2
    rounds: int = 6
    stretches: int = 10
    regions: int = 10
    pieces: int = 40
    folds: int = 5
    few_regions: int = 6
    refits: int = 4
    far: float = 4.0
    beyond: float = 6.0
    told: float = 0.2
    uncertain: float = 10.0
    repeated: float = 0.01
    stand_in: float = 0.1
    stays: float = 0.5
    passing: float = 0.25
    fades: float = 2.0
    survives: float = 1e-3
    most: float = 0.5
    over_noise: float = 5.0
    seen: float = 45.0
    unseen: float = 9.0
    share: float = 0.02
    told_share: float = 0.005
    misfit: float = 0.001
    blocks: int = 60
    block: int = 20
    lacks: float = 1.5
    rounded: float = 0.45
    half: float = 0.5
    outliers: float = 4.0
    louder: float = 2.0
    jump: float = 10.0
    jitters: int = 5
    repeats: int = 4
    rows: int = 12_000
    suspect: float = 0.05
    insists: float = 10.0
    coloured: float = 1e-4
    loud: float = 4.0
    shortest: int = 400


LEVELS = Levels()
