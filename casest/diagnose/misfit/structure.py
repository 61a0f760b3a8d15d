"""Is a residual a function of something? Neighbours in its order are alike then.

Rows are put in the order of a variable and averaged over blocks; the squared differences of
neighbouring means against their variance (J. von Neumann, 1941) are 1 on average for what follows
nothing. Of a table's single rows that ratio has an exact law, which counts that a fit to few rows
has taken what is smooth, and neighbours of noise are unlike then (Durbin & Watson 1971, by Imhof's
1961 integral), and that noise may be larger at one end. Of MANY rows and more the products of
neighbours are summed, against their own squares: normal whatever the sizes are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Index
from casest.diagnose.levels import LEVELS
from casest.diagnose.misfit.variables import Variable

#: Means at least, as many as are wanted, and rows in each of a series, whose noise may have a
#: colour. Of eight means no order is unlikely enough.
FEWEST, WANTED, SHORTEST = 8, 24, 4
#: Rows of a table at least, each of which is measured by itself; and from which on products are as
#: good as the ratio, whose law takes long there.
FEW_ROWS, MANY = 12, 100
#: Share of the rows over which the size of a table's noise is told, from the row's neighbours.
NEIGHBOURS = 0.6
#: Places at most to which a residual with a slow course is moved along the record, and the share
#: from which on one is told from none.
PLACES, LEAST_SHARE = 99, 1e-3
#: Half waves over the ranks of a variable, of which a residual is told to follow it.
WAVES = 6
#: Where Imhof's integrand is asked: it is smooth in log u, and nothing at both ends.
LOGS = np.linspace(-25.0, 15.0, 801)
#: Share of a row's variance that the fit leaves, at least.
LEAST = 0.2


@dataclass(frozen=True)
class Structure:
    """What the residual follows, the share of its variance that does, and the chance of as much."""

    name: str
    share: float
    p_value: float


def structures(
    residuals: Sequence[Array],
    variables: Sequence[Variable],
    *,
    unknowns: Array | None = None,
    among: Sequence[Variable] = (),
) -> list[Structure]:
    """Of every variable, the least likely first; residuals (N, m) of each run, clipped.

    `unknowns`: of a table, orthonormal columns (N·m, p) of what its fit has taken. Rows of a table
    are looked at one by one: means of so few blocks are never unlikely. `among`: those that were
    looked through to find these, where they are more.
    """
    r, orders = np.concatenate(residuals), [order_of(v) for v in variables]
    # Of variables that put the rows in one order, or the other way round, one is asked.
    through = [order_of(v) for v in among] or orders
    tried = len({min(k.tobytes(), k[::-1].tobytes()) for k in through})
    found = [
        _of_means(v.name, r[k], tried)
        if unknowns is None
        else _of_rows(v.name, r, unknowns, k, tried)
        for v, k in zip(variables, orders, strict=True)
    ]
    return sorted((f for f in found if f is not None), key=lambda f: f.p_value)


def more_than_courses_do(
    found: Structure, residuals: Sequence[Array], variable: Variable, samples: int
) -> bool:
    """Does a residual with a course over so many samples follow a variable because of its values?

    Two slow courses go together for a while, whatever they are of. Moved along the record, and back
    from its end, a residual (N, m) of each run keeps its own and loses all that the variable does
    to it: by whole lengths of the course, or of the variable where that changes sooner. The
    share where it belongs is one more of those shares, or not: Student's t of their log odds.
    """
    from scipy.special import logit, stdtr

    order, r = order_of(variable), np.concatenate(residuals)
    step = min(samples, _length(np.concatenate(variable.values)))
    there_and_back = np.concatenate([r, r[::-1]])
    moved = np.arange(step, 2 * len(r) - step + 1, step)
    if len(moved) < 2:
        return False
    moved = moved[np.linspace(0, len(moved) - 1, min(PLACES, len(moved))).astype(int)]
    placed = [_of_means(found.name, np.roll(there_and_back, k, axis=0)[order], 1) for k in moved]
    shares = [found.share, *(s.share for s in placed if s is not None)]
    own, *others = logit(np.clip(shares, LEAST_SHARE, 1 - LEAST_SHARE))
    spread = float(np.std(others, ddof=1)) * float(np.sqrt(1 + 1 / len(others)))
    t = (own - float(np.mean(others))) / max(spread, 1e-9)
    return bool(stdtr(len(others) - 1, -t) < LEVELS.chance)


def more_than_its_colour_does(residuals: Sequence[Array], variable: Variable, over: float) -> bool:
    """Does a residual whose neighbours in time are alike, over so many samples, follow a variable
    by more than such noise would? Rows that are near in a slow variable are near in time.

    F of WAVES over the variable's ranks, of which each axis is told in innovations: those of an
    autoregression over twice as many samples, by Yule and Walker.
    """
    from scipy.linalg import solve_toeplitz
    from scipy.signal import lfilter
    from scipy.special import fdtrc
    from scipy.stats import rankdata

    r = np.concatenate(residuals)
    place = (rankdata(_within_a_turn(variable)) - 0.5) / len(r)
    waves = np.cos(np.pi * place[:, None] * np.arange(1, WAVES + 1))
    memory = int(min(max(np.ceil(2 * over), 1), len(r) // 10))
    freedom, chances = len(r) - WAVES - memory, []
    for own in (r - r.mean(axis=0)).T[np.ptp(r, axis=0) > 0]:
        kin = np.fft.irfft(np.abs(np.fft.rfft(own, 2 * len(own))) ** 2)[: memory + 1]
        kin[0] *= 1 + 1e-9
        back = np.concatenate([[1.0], -solve_toeplitz(kin[:-1], kin[1:])])
        new, columns = lfilter(back, [1.0], own), lfilter(back, [1.0], waves, axis=0)
        Q, _ = np.linalg.qr(columns[memory:])
        taken = float(np.sum((Q.T @ new[memory:]) ** 2))
        left = float(np.sum(new[memory:] ** 2)) - taken
        chances.append(float(fdtrc(WAVES, freedom, taken / WAVES / max(left / freedom, 1e-300))))
    return any(chance * len(chances) < LEVELS.misfit for chance in chances)


def _length(x: Array) -> int:
    """Samples from a high to the next low of a series (N,), about: half of its power is slower."""
    power = np.abs(np.fft.rfft(np.concatenate([x, x[::-1]]) - x.mean())[1 : len(x)]) ** 2
    below = np.cumsum(power)
    return int(np.ceil(len(x) / (1 + np.searchsorted(below, below[-1] / 2))))


def order_of(variable: Variable) -> Index:
    """Its rows from the least to the largest; of an angle that goes round, within a turn.

    Rows of one value are in no order: in that of the record a slow course would follow it.
    """
    x = _within_a_turn(variable)
    by_chance = np.random.default_rng(0).permutation(len(x))
    return by_chance[np.argsort(x[by_chance], kind="stable")]


def _within_a_turn(variable: Variable) -> Array:
    x = np.concatenate(variable.values)
    return np.asarray(np.mod(x, 2 * np.pi) if variable.turns else x)


def _of_means(name: str, r: Array, tried: int) -> Structure | None:
    """What rows (N, m) in the order of a variable say in means of several."""
    from scipy.special import ndtr

    size = max(SHORTEST, min(LEVELS.block, len(r) // WANTED), len(r) // LEVELS.blocks)
    count = len(r) // size
    if count < FEWEST:
        return None
    means = r[: count * size].reshape(count, size, -1).mean(axis=1)
    z = _of_ratios(_steps(means) / _variance(means), count)
    return _structure(name, r, means, float(ndtr(-z.max())) * len(z) * tried)


def _of_rows(name: str, r: Array, unknowns: Array, order: Index, tried: int) -> Structure | None:
    """What rows (N, m) of a table say in the order of a variable, each axis by itself."""
    from scipy.special import ndtr

    count, axes = r.shape
    if count < FEW_ROWS:
        return None
    taken = unknowns.reshape(count, axes, -1)[order]
    ordered, chances = r[order], []
    for k in range(axes):
        away, own = ordered[:, k] - ordered[:, k].mean(), taken[:, k]
        if count < MANY:
            chances.append(_of_ratio(away, own))
        else:
            chances.append(float(ndtr(-_of_products(away, own))))
    return _structure(name, r, ordered, min(chances) * axes * tried)


def _structure(name: str, r: Array, means: Array, chance: float) -> Structure:
    share = np.maximum(_variance(means) - _steps(means), 0).sum() / max(r.var(axis=0).sum(), 1e-300)
    return Structure(name, min(float(share), 1.0), min(1.0, chance))


def _steps(means: Array) -> Array:
    """Variance (m,) of means (N, m) by the differences of neighbours."""
    return np.asarray(np.mean(np.diff(means, axis=0) ** 2, axis=0) / 2)


def _variance(means: Array) -> Array:
    return np.asarray(np.maximum(means.var(axis=0, ddof=1), 1e-300))


def _of_products(r: Array, unknowns: Array) -> float:
    """Normal where rows (N,) follow nothing, whatever their sizes are.

    `unknowns` (N, p): what the fit has taken, by which products of neighbours are below zero.
    """
    left = np.eye(len(r)) - unknowns @ unknowns.T
    expected = float(np.sum(left[1:] * left[:-1] * r**2))
    products = r[1:] * r[:-1]
    return float((products.sum() - expected) / np.sqrt(max(np.sum(products**2), 1e-300)))


def _of_ratio(r: Array, unknowns: Array) -> float:
    """Chance of neighbours (N,) as alike, in noise of the sizes that they have, from which a fit
    has taken its unknowns' columns (N, p)."""
    squares = float(r @ r)
    if not squares > 0:
        return 1.0
    n = len(r)
    left = np.eye(n) - unknowns @ unknowns.T
    differences = np.diff(np.eye(n), axis=0)
    form = differences.T @ differences - float(np.sum(np.diff(r) ** 2)) / squares * np.eye(n)
    size = np.sqrt(_around(r**2 / np.maximum(np.diag(left), LEAST)))
    sized = size[:, None] * (left @ form @ left) * size
    return _below_zero(np.asarray(np.linalg.eigvalsh(sized), float))


def _around(values: Array) -> Array:
    """Means of values (N,) and their neighbours, over the whole."""
    width = max(5, int(NEIGHBOURS * len(values)) | 1)
    padded = np.pad(values, width // 2, mode="reflect")
    found = np.convolve(padded, np.ones(width) / width, "valid")
    return np.asarray(found / found.mean())


def _below_zero(weights: Array) -> float:
    """Chance that Σ λ·χ²₁ is below zero, by Imhof's integral over log u."""
    w = weights[np.abs(weights) > 1e-9 * np.abs(weights).max(initial=0.0)]
    if not w.size:
        return 0.5
    u = np.exp(LOGS)[:, None] * w / np.abs(w).max()
    angle, size = 0.5 * np.arctan(u).sum(axis=1), 0.25 * np.log1p(u**2).sum(axis=1)
    whole = float(np.sum(np.sin(angle) * np.exp(-size))) * (LOGS[1] - LOGS[0])
    return float(np.clip(0.5 - whole / np.pi, 0.0, 1.0))


def _of_ratios(ratio: Array, count: int) -> Array:
    """Von Neumann's ratios of so many means of one size, as standard normals."""
    return np.asarray((1 - ratio) / np.sqrt((count - 2) / (count**2 - 1.0)))
