"""Does the residual depend on anything recorded or computed? Flexible shapes, all at once.

Every column, every quantity of the model, time, and products of two are turned into a few smooth
shapes (Legendre polynomials; sine and cosine of an angle), and scored in the part of the residual
that the declared parameters leave, as in `score`. The noise's own covariance is that from batch to
batch. How small the smallest of all p-values gets by chance is found by flipping the signs of whole
batches: unequal noise, colour within batches, tails and the kinship of the tests are kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.declaration.tracing import function_of, reading_symbol, sample_symbol
from casest.diagnose.levels import CLIPPED, PIECE
from casest.engine import Replay
from casest.leastsquares.problem import Point, Problem

#: Shapes of one variable, harmonics of an angle, and pairs of variables that are tried.
ORDER, HARMONICS, PAIRS = 6, 4, 40
#: Random signs of the batches, and the number of batches from which on they are not needed.
FLIPS, MANY = 1999, 400


@dataclass(frozen=True)
class Variable:
    """Something that a residual may depend on: its values (N,) for each run.

    `turns`: an angle that goes round more than once.
    """

    name: str
    values: tuple[Array, ...]
    turns: bool = False


@dataclass(frozen=True)
class Shapes:
    """Columns (N, k) for each run, and what each stands for: words and the test it belongs to."""

    columns: tuple[Array, ...]
    words: tuple[str, ...]
    test: tuple[str, ...]


@dataclass(frozen=True)
class Dependence:
    """One test: `gain` is the sum of squares that the shapes explain, over σ².

    `p_value` counts for this test alone, `together` for the smallest of all; `words` say how the
    residual depends.
    """

    name: str
    gain: float
    freedom: int
    inflation: float
    p_value: float
    together: float
    words: str


# -- what it may depend on -----------------------------------------------------------------------


def variables(problem: Problem, point: Point, columns: Sequence[str]) -> list[Variable]:
    """Time (or order), the named columns, and the components of every quantity."""
    runs = problem.runs
    timed = all("t" in run.signals for run in runs)
    name = "time" if timed else "place in the record"
    found = [Variable(name, tuple(_when(run, timed) for run in runs))]
    found += [Variable(n, tuple(run.signals[n][:, 0] for run in runs)) for n in columns]
    if not problem.sequential:
        found += _quantities(problem, point)
    return _distinct(found)


def _when(run: Run, timed: bool) -> Array:
    return run.signals["t"][:, 0] if timed else np.arange(len(run), dtype=float)


def _quantities(problem: Problem, point: Point) -> Iterator[Variable]:
    """Components of the quantities, moved to where the residual would vanish.

    The noise of an implicit model's reading is in its quantities too, and would correlate.
    """
    traced, implicit = problem.model.traced, problem.model.implicit
    for quantity in traced.quantities.values():
        value = ca.vec(ca.SX(quantity.value))
        if not ca.depends_on(value, sample_symbol(problem.model)):
            continue
        if implicit:
            value = _consistent(problem, value)
        replay = Replay(function_of(problem.model, {"q": ca.densify(value)}))
        per_run = [
            replay(problem.parameters(point, r), s)[0][:, :, 0]
            for r, s in enumerate(problem.samples)
        ]
        for k in range(per_run[0].shape[1]):
            name = quantity.name + (f"[{k}]" if per_run[0].shape[1] > 1 else "")
            values = tuple(v[:, k] for v in per_run)
            turns = quantity.unit == "rad" and max(map(np.ptp, values)) > 2 * np.pi
            yield Variable(name, values, bool(turns))


def _consistent(problem: Problem, value: Any) -> Any:
    """A quantity with the reading moved the shortest way to a vanishing residual.

    What effects read stays: a recorded current is not in error by what the reading is.
    """
    reading, residual = reading_symbol(problem.model), problem.model.traced.expression
    G = ca.jacobian(residual, reading)
    step = G.T @ ca.solve(G @ G.T, residual)
    return value - ca.jacobian(value, reading) @ step


def _distinct(found: Sequence[Variable]) -> list[Variable]:
    """Without what is constant, not finite, or the copy of another."""
    kept: list[Variable] = []
    seen: list[Array] = []
    for variable in found:
        x = np.concatenate(variable.values)
        if not np.all(np.isfinite(x)) or np.ptp(x) <= 1e-9 * max(np.abs(x).max(), 1e-300):
            continue
        x = (x - x.mean()) / np.ptp(x)  # first: the squares of 1e-300 are zero
        x /= np.linalg.norm(x)
        # An angle that time is a copy of still goes round.
        if variable.turns or all(abs(x @ other) < 0.9999 for other in seen):
            kept.append(variable)
        if not variable.turns:
            seen.append(x)
    return kept


# -- shapes --------------------------------------------------------------------------------------


def shapes(found: Sequence[Variable], order: int) -> Shapes:
    """All shapes of all variables, and products of two."""
    columns: list[tuple[Array, ...]] = []
    words: list[str] = []
    test: list[str] = []
    for variable in found:
        for values, description in _of_one(variable, order):
            columns.append(values)
            words.append(description)
            test.append(variable.name)
    plain = [v for v in found if not v.turns]
    for one, other in list(combinations(plain, 2))[:PAIRS]:
        pairs = zip(_even(one.values), _even(other.values), strict=True)
        columns.append(tuple(a * b for a, b in pairs))
        words.append(f"varies with the product of {one.name} and {other.name}")
        test.append(f"{one.name}·{other.name}")
    count = len(found[0].values) if found else 0
    together = tuple(np.column_stack([c[r] for c in columns]) for r in range(count))
    return Shapes(together, tuple(words), tuple(test))


def _of_one(variable: Variable, order: int) -> Iterator[tuple[tuple[Array, ...], str]]:
    if variable.turns:
        for k in range(1, min(HARMONICS, max(order // 2, 1)) + 1):
            often = {1: "once", 2: "twice"}.get(k, f"{k} times")
            for wave in (np.sin, np.cos):
                values = tuple(wave(k * x) for x in variable.values)
                yield values, f"varies {often} per turn of {variable.name}"
        return
    even = _even(variable.values)
    for k in range(1, order + 1):
        one = np.eye(k + 1)[k]
        values = tuple(np.polynomial.legendre.legval(x, one) for x in even)
        yield values, f"varies with {variable.name}"


def _even(values: Sequence[Array]) -> tuple[Array, ...]:
    """Scaled to [−1, 1]; the outermost half percent on either side counts as the edge."""
    low, high = np.quantile(np.concatenate(list(values)), [0.005, 0.995])
    width = max(float(high - low), 1e-300)
    return tuple(np.clip(2 * (x - low) / width - 1, -1.0, 1.0) for x in values)


def slow_shapes(runs: Sequence[Run], count: int) -> tuple[Array, ...]:
    """Cosines of half a period to count/2 periods over each run: what a wander may have done."""
    found = []
    for run in runs:
        place = (np.arange(len(run)) + 0.5) / max(len(run), 1)
        found.append(np.cos(np.pi * np.outer(place, np.arange(1, count + 1))))
    return tuple(found)


# -- score ---------------------------------------------------------------------------------------


class _Sums:
    """Sums over the record: Gram matrix of shapes and Jacobian, and scores of every batch.

    The columns of one shape are one per axis of the residual; axes only meet in the Jacobian.
    """

    def __init__(self, problem: Problem, point: Point, sigma: float) -> None:
        self.problem, self.point, self.sigma = problem, point, sigma
        normal = problem.normal(point).matrix
        self.scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled = normal / np.outer(self.scale, self.scale)
        self.inverse = np.linalg.pinv(scaled, rcond=1e-10, hermitian=True)

    def of(
        self, columns: Sequence[Array], batches: Sequence[NDArray[np.int_]]
    ) -> tuple[Array, Array, Array]:
        """GᵀG (axes, k, k), JᵀG (axes, n, k), and per batch [raw, even] (2, batches, n + axes·k).

        `even` has residuals enlarged by what the fit took of them (MacKinnon & White's HC2).
        """
        problem, n = self.problem, self.problem.unknowns
        axes, k = len(problem.model.axes), columns[0].shape[1]
        gram, cross = np.zeros((axes, k, k)), np.zeros((axes, n, k))
        sums = [np.zeros((2, len(first), n + axes * k)) for first in batches]
        for r, span, x, residuals, J, weights in self._pieces():
            B = columns[r][span]
            number = np.searchsorted(batches[r], np.arange(span.start, span.stop), "right") - 1
            first = np.flatnonzero(np.diff(number, prepend=-1))
            for a in range(axes):
                light = B if weights is None else B * weights[:, [a]]
                gram[a] += light.T @ B
                cross[a][x] += J[:, a].T @ light
                for kind, residual in enumerate(residuals):
                    one = residual[:, [a]]
                    own = np.add.reduceat(J[:, a] * one, first)
                    sums[r][kind][np.ix_(number[first], x)] += own
                    place = slice(n + a * k, n + (a + 1) * k)
                    sums[r][kind][number[first], place] += np.add.reduceat(B * one, first)
        return gram, cross, np.concatenate(sums, axis=1)

    def _pieces(self) -> Iterator[tuple[int, slice, Any, tuple[Array, Array], Array, Any]]:
        """Run, span, unknowns, weighted residuals (raw and even), scaled Jacobian, weights."""
        limit = CLIPPED * self.sigma
        for block in self.problem.blocks(self.point):
            inner = self.inverse[np.ix_(block.x, block.x)]
            for start in range(0, len(block.residual), PIECE):
                local = slice(start, start + PIECE)
                J = np.nan_to_num(block.jacobian[local]) / self.scale[block.x]
                weights = None if block.weights is None else block.weights[local]
                residual = np.clip(block.residual[local], -limit, limit)
                taken = np.einsum("nmi,ij,nmj->nm", J, inner, J, optimize=True)
                if weights is not None:
                    residual, taken = residual * weights, taken * weights
                even = residual / np.sqrt(np.clip(1 - taken, 0.05, 1.0))
                first = block.span.start + start
                span = slice(first, first + len(residual))
                yield block.run, span, block.x, (residual, even), J, weights


def dependences(
    problem: Problem,
    point: Point,
    sigma: float,
    batches: Sequence[NDArray[np.int_]],
    found: Shapes,
    beside: Sequence[Array] | None = None,
    seed: int = 0,
) -> list[Dependence]:
    """Every test with its p-values, the most significant first.

    `beside` are shapes (N, k) per run that anything may have, and that count for nothing.
    """
    both = found.columns
    known = 0 if beside is None else beside[0].shape[1]
    if beside is not None:
        both = tuple(np.hstack([a, b]) for a, b in zip(beside, found.columns, strict=True))
    everything = _whitened(problem, point, sigma, batches, both, found, known)
    if not everything:
        return []
    names = list(everything)
    left = problem.residual_count - problem.unknowns
    p = {}
    for name, (raw, even, _) in everything.items():
        p[name] = _p_value(raw.sum(axis=0)[None], even, left)[0]
    together = _together(list(everything.values()), np.array([p[n] for n in names]), left, seed)
    words = {n: everything[n][2] for n in names}
    return sorted(
        (
            Dependence(
                n,
                float(np.sum(everything[n][0].sum(axis=0) ** 2)),
                everything[n][0].shape[1],
                _inflation(everything[n][1]),
                float(p[n]),
                float(t),
                words[n],
            )
            for n, t in zip(names, together, strict=True)
        ),
        key=lambda d: d.p_value,
    )


def _whitened(
    problem: Problem,
    point: Point,
    sigma: float,
    batches: Sequence[NDArray[np.int_]],
    columns: Sequence[Array],
    found: Shapes,
    known: int,
) -> dict[str, tuple[Array, Array, str]]:
    """For every test the scores of all batches (batches, q), raw and even, and the best words."""
    sums = _Sums(problem, point, sigma)
    gram, cross, scores = sums.of(columns, batches)
    axes, k, n = len(gram), columns[0].shape[1], problem.unknowns
    absorbed = sums.inverse @ np.hstack(list(cross))
    left = -np.hstack(list(cross)).T @ absorbed
    for a in range(axes):
        left[a * k : (a + 1) * k, a * k : (a + 1) * k] += gram[a]
    size = np.sqrt(np.maximum(np.concatenate([np.diag(g) for g in gram]), 1e-300))
    left = left / np.outer(size, size)
    scores = (scores[:, :, n:] - scores[:, :, :n] @ absorbed) / size / sigma
    first = np.concatenate([a * k + np.arange(known) for a in range(axes)]).astype(int)
    if known:
        left, scores = _beside(left, scores, first)
    tests: dict[str, tuple[Array, Array, str]] = {}
    for name in dict.fromkeys(found.test):
        mine = np.array([j for j, test in enumerate(found.test) if test == name])
        own = np.concatenate([a * k + known + mine for a in range(axes)])
        root = _root(left[np.ix_(own, own)])
        if not root.shape[1]:
            continue
        words = [found.words[j] for j in mine]
        said = _said(words, left[np.ix_(own, own)], scores[0][:, own], problem.model.axes)
        tests[name] = (scores[0][:, own] @ root, scores[1][:, own] @ root, said)
    return tests


def _beside(left: Array, scores: Array, first: NDArray[np.int_]) -> tuple[Array, Array]:
    """Take out what the columns `first` explain."""
    inverse = np.linalg.pinv(left[np.ix_(first, first)], rcond=1e-8, hermitian=True)
    share = inverse @ left[first]
    return left - left[:, first] @ share, scores - scores[:, :, first] @ share


def _root(left: Array) -> Array:
    """R with RᵀAR = 1 on what is left of the shapes; what the parameters imitate is no test."""
    values, vectors = np.linalg.eigh(left)
    kept = values > 1e-6
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]))


def _said(words: Sequence[str], left: Array, scores: Array, axes: Sequence[str]) -> str:
    """The words of the shapes that explain most, and the axis where nearly all of it is."""
    total, count, gains = scores.sum(axis=0), len(words), {}
    by_axis = np.zeros(len(axes))
    for text in dict.fromkeys(words):
        mine = np.array([j for j, w in enumerate(words) if w == text])
        own = np.concatenate([a * count + mine for a in range(len(axes))])
        gains[text] = float(np.sum((total[own] @ _root(left[np.ix_(own, own)])) ** 2))
    for a in range(len(axes)):
        own = a * count + np.arange(count)
        by_axis[a] = np.sum((total[own] @ _root(left[np.ix_(own, own)])) ** 2)
    best = max(gains, key=lambda text: gains[text])
    one = len(axes) > 1 and by_axis.max() > 0.8 * by_axis.sum()
    return best + (f", in {axes[int(np.argmax(by_axis))]}" if one else "")


def _inflation(even: Array) -> float:
    """Variance of the score over that of white noise, its directions averaged."""
    return float(max(np.sum(even**2) / even.shape[1], 1.0))


def _p_value(totals: Array, even: Array, left: int) -> Array:
    """p of each total (…, q), whose covariance the batches show."""
    from scipy.special import fdtrc

    batches, freedom = even.shape
    second = max(min(left - freedom, 20 * batches), 1)
    F = np.sum(totals**2, axis=1) / freedom / _inflation(even)
    return np.asarray(fdtrc(freedom, second, F))


def _together(
    tests: Sequence[tuple[Array, Array, str]], p: Array, left: int, seed: int
) -> NDArray[np.float64]:
    """Chance that the smallest p-value of all tests is as small as each of these."""
    batches = len(tests[0][0])
    if batches > MANY:
        return np.asarray(np.minimum(p * len(p), 1.0))
    rng = np.random.default_rng(seed)
    signs = rng.choice([-1.0, 1.0], (FLIPS, batches))
    smallest = np.ones(FLIPS)
    for _, even, _ in tests:
        smallest = np.minimum(smallest, _p_value(signs @ even, even, left))
    ranks = np.searchsorted(np.sort(smallest), p, side="right")
    return np.asarray((1 + ranks) / (1 + FLIPS))
