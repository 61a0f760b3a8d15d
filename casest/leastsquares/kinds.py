"""Residuals of several kinds, each with a noise of its own that the data show.

A model that ties lengths in m/s² and turns in degrees together says which constant is the noise of
each (`Residual(noise=…)`). One in the unit of a signal, `[a]`, is that of the signal's mean at a
rest: it is in the residuals of that rest, and in those of the turns to it and from it. One in
`[w]/s^0.5` is how far the signal's offset wanders: in the residuals of all rests and of all turns
between. Any other is a noise of the axes that name it, from rest to rest anew. So the covariance of
all residuals of a run is V = Σ σ_c² V_c. What is 0 is estimated with the fit, by the squares that
each part leaves over and its share of the redundancy: Helmert's variance components in Förstner's
form (Förstner,
ZfV 104, 1979; Teunissen & Amiri-Simkooei, J. Geodesy 82, 2008, sec. 6).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Constant
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.wander import wandering

#: Rounds of fits, and of noises within one, until these stand still to the share CLOSE.
ROUNDS, WITHIN, CLOSE = 20, 50, 1e-3
#: Redundancy of a part below which nothing shows it, and from which on it is shown well enough.
LEAST, ENOUGH = 0.5, 10
#: Least noise of a kind, of what its axes have in all: so that there always is one.
FLOOR = 1e-3


def noises(model: Model) -> dict[str, float]:
    """Constants that are the noise of a kind of residual, by name; 0 where it is not known."""
    residual = model.traced.residual
    names = dict.fromkeys((*residual.noise, *residual.wander))
    return {n: float(model[n].array) for n in names if isinstance(model[n], Constant)}


def in_deviations(
    problem: Problem, first: Point, fit: Callable[[Problem, Point], Point]
) -> Problem:
    """The problem with its residuals in standard deviations, none of which foretells another.

    Noises that are not known are those that these data show; `fit` solves a problem from a point.
    As it is where residuals are of one kind.
    """
    known = noises(problem.model)
    if not known:
        return problem
    raw = Problem(problem.model.having(**dict.fromkeys(known, 0.0)), problem.runs)
    sizes = {n: s if s > 0 else _at_start(raw, first, n) for n, s in known.items()}
    point, unknown = first, [n for n, s in known.items() if not s > 0]
    for _ in range(ROUNDS if unknown else 1):
        point = fit(replace(raw, whitening=_whitening(raw, point, sizes)), point)
        new = _components(raw, point, sizes, unknown)
        still = all(abs(new[n] - sizes[n]) <= 10 * CLOSE * sizes[n] for n in sizes)
        sizes = new
        if still:
            break
    found = {n: float(f"{s:.5g}") for n, s in sizes.items()}
    return whitened(Problem(problem.model.having(**found), problem.runs), point)


def whitened(problem: Problem, point: Point) -> Problem:
    """The problem with what residuals share taken from them, by the noises that its model knows."""
    sizes = noises(problem.model)
    if not sizes or not all(s > 0 for s in sizes.values()):
        return problem
    return replace(problem, whitening=_whitening(problem, point, sizes))


def freedom(problem: Problem, point: Point) -> Array | None:
    """Degrees of freedom of each unknown's variance (n,), where kinds have noises of their own.

    An unknown that one kind tells is as uncertain as that kind's noise is known, beside the others
    (Satterthwaite, Biometrics Bulletin 2, 1946). None where all residuals are of one kind.
    """
    sizes = noises(problem.model)
    if not sizes or problem.whitening is None:
        return None
    variances, information = _System(problem, point).told(sizes)
    # A noise that is taken from the readings at rest is known by all of those.
    information += np.diag([_readings_tell(problem, n, size) for n, size in sizes.items()])
    total = variances.sum(axis=0)
    squares = np.einsum("cn,cd,dn->n", variances, np.linalg.pinv(information), variances)
    return np.asarray(np.where(squares > 0, total**2 / np.where(squares > 0, squares, 1.0), 1.0))


class _System:
    """Residuals and slopes of all runs, with the covariance that each noise gives them."""

    def __init__(self, problem: Problem, point: Point) -> None:
        plain = replace(problem, whitening=None)
        self.problem, self.point = problem, point
        self.there = [
            np.ones(len(run) * len(problem.model.axes), bool) if p is None else p.ravel()
            for run, p in zip(problem.runs, problem.present, strict=True)
        ]
        self.blocks = []
        for block, there in zip(plain.blocks(point), self.there, strict=True):
            slopes = np.zeros((len(there), problem.unknowns))
            slopes[:, block.x] = block.jacobian.reshape(len(there), -1)
            self.blocks.append((block.residual.ravel()[there], slopes[there]))
        self.parts = [self._parts(r) for r in range(len(problem.runs))]

    def _parts(self, r: int) -> dict[str, Array]:
        """V_c of one run for each noise, (M, M), of the residuals that there are."""
        there = self.there[r]
        found = _covariances(self.problem, self.point, r)
        return {name: V[np.ix_(there, there)] for name, V in found.items()}

    def told(self, sizes: Mapping[str, float]) -> tuple[Array, Array]:
        """Variance (c, n) of each unknown that each part gives, and how well the data tell the
        parts from each other: tr(R V_c R V_d) (c, c), twice the inverse covariance of σ²."""
        variances = np.zeros((len(sizes), self.problem.unknowns))
        information = np.zeros((len(sizes), len(sizes)))
        for _, gain, rest, parts in self._left(sizes):
            scaled = [size**2 * parts[name] for name, size in sizes.items()]
            variances += np.array([np.sum(gain * (V @ gain), axis=0) for V in scaled])
            seen = [rest @ V for V in scaled]
            information += np.array([[np.sum(x * y.T) for y in seen] for x in seen])
        return variances, information

    def updated(self, sizes: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """Noises that the squares left over show, and the redundancy of each."""
        left, squares = dict.fromkeys(sizes, 0.0), dict.fromkeys(sizes, 0.0)
        for seen, _, rest, parts in self._left(sizes):
            for name, size in sizes.items():
                V = size**2 * parts[name]
                left[name] += float(np.sum(V * rest))
                squares[name] += float(seen @ V @ seen)
        new = {n: s * float(np.sqrt(squares[n] / max(left[n], LEAST))) for n, s in sizes.items()}
        return new, left

    def _left(
        self, sizes: Mapping[str, float]
    ) -> Iterator[tuple[Array, Array, Array, dict[str, Array]]]:
        """Of each run V⁻¹ of what the fit leaves over, what a residual moves (M, n), the matrix R
        that leaves over (M, M), and the parts."""
        n = self.problem.unknowns
        inverses = [np.linalg.inv(_total(parts, sizes)) for parts in self.parts]
        matrix, gradient = np.zeros((n, n)), np.zeros(n)
        for (residual, slopes), inverse in zip(self.blocks, inverses, strict=True):
            matrix += slopes.T @ inverse @ slopes
            gradient += slopes.T @ inverse @ residual
        scale = np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
        cofactor = np.linalg.pinv(matrix / np.outer(scale, scale), hermitian=True)
        cofactor /= np.outer(scale, scale)
        step = cofactor @ gradient
        for (residual, slopes), inverse, parts in zip(
            self.blocks, inverses, self.parts, strict=True
        ):
            weighed = inverse @ slopes
            gain = weighed @ cofactor
            yield inverse @ residual - weighed @ step, gain, inverse - gain @ weighed.T, parts


def _components(
    problem: Problem, point: Point, sizes: Mapping[str, float], unknown: list[str]
) -> dict[str, float]:
    """The noises that the residuals at a point show.

    With little redundancy that of a signal is never less than what the rests themselves show. Where
    the signal wanders it never is less than its readings scatter: from rest to rest a walk can pass
    for the noise of the means.
    """
    system, found = _System(problem, point), dict(sizes)
    least = {n: max(_rests_show(problem, n), 1e-300) for n in unknown}
    floors = {n: FLOOR * _at_start(problem, point, n) for n in unknown}
    floors |= {n: max(floors[n], _readings_show(problem, n)) for n in unknown
               if _beside_a_walk(problem.model, n)}  # fmt: skip
    for _ in range(WITHIN):
        new, left = system.updated(found)
        before = dict(found)
        for n in unknown:
            found[n] = max(new[n] if left[n] > LEAST else found[n], floors[n])
            if left[n] < ENOUGH:
                found[n] = max(found[n], least[n])
        if all(abs(found[n] - before[n]) <= CLOSE * before[n] for n in unknown):
            break
    return found


def _total(parts: Mapping[str, Array], sizes: Mapping[str, float]) -> Array:
    return np.asarray(sum(size**2 * parts[name] for name, size in sizes.items()))


def _whitening(problem: Problem, point: Point, sizes: Mapping[str, float]) -> tuple[Array, ...]:
    """Lower triangular W (N·m, N·m) of each run, with W·V·Wᵀ = I."""
    found = []
    for r, present in enumerate(problem.present):
        V = _total(_covariances(problem, point, r), sizes)
        if present is not None:
            V[~present.ravel(), ~present.ravel()] = 1.0
        found.append(np.linalg.inv(np.linalg.cholesky(V)))
    return tuple(found)


def _covariances(problem: Problem, point: Point, r: int) -> dict[str, Array]:
    """V_c (N·m, N·m) of one run, for each noise, of residuals as the problem has them.

    Of some of a record's rests those that belong to them of the whole record's.
    """
    model, (record, chosen) = problem.model, problem.origin(r)
    own, prior, between = problem.slopes_in_readings(point, r)
    N, m, _ = own.shape
    rows = np.arange(N * m).reshape(N, m)[chosen].ravel()
    known = noises(model)
    found, first = {}, 0
    places = {}
    for s in model.signals:
        places[s.name] = slice(first, first + s.size)
        first += s.size
    for name, size in known.items():
        signal = _signal_of(model, name)
        if signal is None:
            axes = np.array([n == name for n in model.traced.residual.noise], float)
            there = np.ones((1, 1)) if problem.present[r] is None else problem.present[r]
            there = np.broadcast_to(there, (len(problem.runs[r]), m))
            found[name] = np.diag((there * axes / (size if size > 0 else 1.0) ** 2).ravel())
            continue
        part = places[signal]
        # Of the rests' means, then of the turns before them.
        slopes, each = np.zeros((N, m, 2 * N, part.stop - part.start)), np.arange(N)
        slopes[each, :, each] = own[:, :, part]
        slopes[each[1:], :, each[:-1]] = prior[1:, :, part]
        if name in model.traced.residual.wander:
            slopes[each, :, N + each] = between[:, :, part]
            flat = slopes.transpose(0, 1, 3, 2).reshape(N * m, -1)[rows]
            ways = np.kron(np.eye(part.stop - part.start), wandering(record))
            found[name] = flat @ ways @ flat.T
            continue
        flat = slopes[:, :, :N].reshape(N * m, -1)[rows]
        found[name] = flat @ flat.T
    return found


_OF_A_SIGNAL = re.compile(r"\[(\w+)\](/s\^0\.5)?")


def _signal_of(model: Model, name: str) -> str | None:
    """The signal in whose unit a noise is counted: [a], [a]/s^0.5; None where in another."""
    unit = _OF_A_SIGNAL.fullmatch(model[name].like or model[name].unit)
    return unit[1] if unit and unit[1] in {s.name for s in model.signals} else None


def _rests_show(problem: Problem, name: str) -> float:
    """Error of a rest's mean, of a noise that is that of a signal; else nothing."""
    if name in problem.model.traced.residual.wander:
        return 0.0
    signal = _signal_of(problem.model, name)
    spreads = [r.spread[signal] for r in problem.runs if signal is not None and signal in r.spread]
    squares = np.concatenate([s.ravel() ** 2 for s in spreads]) if spreads else np.zeros(1)
    return float(np.sqrt(np.mean(squares)))


def _beside_a_walk(model: Model, name: str) -> bool:
    """Is a noise that of a signal whose offset wanders as well?"""
    walks = model.traced.residual.wander
    return name not in walks and _signal_of(model, name) in {_signal_of(model, w) for w in walks}


def _readings_show(problem: Problem, name: str) -> float:
    """Error of a rest's mean by the differences of neighbouring readings, which no walk moves.

    Half their mean square is the variance of white noise (von Neumann, Ann. Math. Stat. 12, 1941),
    and less than that of one whose neighbours are alike.
    """
    signal, squares = _signal_of(problem.model, name) or "", []
    for run in problem.runs:
        assert run.averaged is not None
        raw = run.averaged.run.signals[signal]
        ends = zip(run.averaged.first, run.averaged.last, strict=True)
        squares += [0.5 * np.mean(np.diff(raw[i : j + 1], axis=0) ** 2) / (j + 1 - i)
                    for i, j in ends if j > i]  # fmt: skip
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


def _readings_tell(problem: Problem, name: str, size: float) -> float:
    """Degrees of freedom of a noise that is no larger than the readings at rest say, else 0."""
    least = _readings_show(problem, name) if _beside_a_walk(problem.model, name) else 0.0
    if size > (1 + CLOSE) * least:
        return 0.0
    signal = _signal_of(problem.model, name) or ""
    # Of differences, two thirds of what the readings have.
    return float(sum(run.signals[signal].shape[1] * np.sum(run.count - 1)
                     for run in problem.runs) * 2 / 3)  # fmt: skip


def _at_start(problem: Problem, first: Point, name: str) -> float:
    """Root mean square residual of the axes of a kind, at a point; of what wanders, how far a
    signal's means at rest are apart, as if nothing else made them differ."""
    if name in problem.model.traced.residual.wander:
        return max(_steps_show(problem, name), 1e-300)
    axes = np.array([n == name for n in problem.model.traced.residual.noise])
    squares = np.concatenate([r[:, axes].ravel() ** 2 for r in problem.residuals(first)])
    return max(float(np.sqrt(np.mean(squares))), _rests_show(problem, name), 1e-300)


def _steps_show(problem: Problem, name: str) -> float:
    """Root mean square of the steps from rest to rest of a signal, in the root of a second."""
    signal, squares = _signal_of(problem.model, name), []
    for run in problem.runs:
        assert signal is not None
        assert run.averaged is not None
        assert run.averaged.run.time is not None
        time = np.asarray(run.averaged.run.time, float)
        middle = 0.5 * (time[run.averaged.first] + time[run.averaged.last])
        steps = np.diff(run.signals[signal], axis=0) ** 2 / np.diff(middle)[:, None]
        squares.append(steps.ravel())
    each = np.concatenate(squares)
    return float(np.sqrt(np.mean(each))) if len(each) else 0.0
