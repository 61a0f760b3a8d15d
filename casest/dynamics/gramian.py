"""What a trajectory makes observable: the finite-horizon observability Gramian.

W(t₀, t₁) = ∫Φ(t, t₀)ᵀCᵀΘ⁻¹CΦ(t, t₀) dt, weighted by the measurement noise, is the information that
the readings hold about the state at t₀: its inverse bounds any estimator's covariance. Two forms:
products of transition matrices, and the ODE −Ẇ = AᵀW + WA + CᵀΘ⁻¹C, integrated by CVODES.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.between import motions
from casest.dynamics.declare import Dynamics
from casest.dynamics.information import even, rank_of, spectrum, without
from casest.dynamics.path import Parts, Path
from casest.dynamics.transition import (
    Linearised,
    Pace,
    checked_record,
    counted,
    linearised,
    pace_of,
    process_noise,
    usual,
)
from casest.leastsquares.null_space import sparsest

#: Below this share of the largest, in standard deviations known beforehand, a part of a direction
#: is no part of it: what two printed digits do not show.
RESIDUE = 5e-3
#: The same in a direction that is told badly, which has no exact shape: of all states, and within
#: one of them.
BLURRED, WITHIN = 0.02, 0.1
#: Steps whose product is kept, and samples that are worked on at once.
CHUNK, PIECE = 256, 4096
#: Chunks whose single steps are kept: windows that overlap begin and end in the same ones.
RECENT = 4


@dataclass(frozen=True)
class Observed:
    """Rank of the Gramian among n states, scaled so that units do not count.

    `eigenvalues` (n,) of the scaled Gramian, largest first; `unobservable` in words, with their
    `directions` (n, k) in the states' units; `weak` in words: directions of which the data tell
    less than was known beforehand; `std` (n,) what the data alone allow at the start of the record
    (NaN where they do not determine it).
    """

    rank: int
    unknowns: int
    eigenvalues: Array
    unobservable: tuple[str, ...]
    weak: tuple[str, ...]
    directions: Array
    std: Array
    gramian: Array


def gramian(model: Dynamics, system: Linearised) -> Array:
    """W of the whole record at its first sample, (n, n), from transition matrices.

    The noise of inputs, where it is known, is a motion that nobody knows: what it hides of the
    state at the first sample is not counted. Other driving noise is no matter of the trajectory.
    """
    return _reduced(*_of_steps(model, system))[1]


def _unknown_motion(model: Dynamics, system: Linearised) -> Array | None:
    """Covariance that the noise of inputs adds in every step, (N − 1, n, n)."""
    if system.process.ndim == 2:
        return None
    return process_noise(system, np.asarray(system.process - model.process, float))


def _of_steps(model: Dynamics, system: Linearised) -> Parts:
    """Φ and W of every single step at its own beginning, (N − 1, n, n) each; and Q.

    W is what driving noise CᵀΘ⁻¹C makes of the motion with Aᵀ that runs back from the step's end,
    and Φᵀ its transition.
    """
    pace, Q = system.pace or pace_of(system.steps), _unknown_motion(model, system)
    weight = np.linalg.inv(model.noise_at(pace.usual, pace.periods))
    told = np.asarray(system.C.transpose(0, 2, 1) @ weight @ system.C, float)
    none, back = np.zeros_like(system.c), system.A.transpose(0, 2, 1)[::-1]
    if np.isfinite(system.y).all() and not pace.holed:
        found = motions(back, none, told[::-1], system.steps[::-1])
        Phi, W = found.Phi[::-1].transpose(0, 2, 1), found.Q[::-1]
        return Phi, W * (pace.usual / system.steps)[:, None, None], Q
    # Single readings are no curve: each for its own time.
    Phi = system.moved[0]
    return Phi, 0.5 * pace.usual * (told[:-1] + Phi.transpose(0, 2, 1) @ told[1:] @ Phi), Q


def _reduced(Phi: Array, W: Array, Q: Array | None = None) -> Parts:
    """Neighbours joined pair by pair: (Φ₂, W₂)∘(Φ₁, W₁) = (Φ₂Φ₁, W₁ + Φ₁ᵀW₂Φ₁).

    With noise Q of every step W₂ says less: (W₂⁻¹ + Q₁)⁻¹, in a form that needs no inverse of W₂,
    and Φ and Q are those given the readings in between (Särkkä & García-Fernández 2021).
    """
    while len(Phi) > 1:
        whole = len(Phi) // 2 * 2
        first, second = slice(0, whole, 2), slice(1, whole, 2)
        later, told = Phi[second], W[second]
        if Q is not None:
            both = _over_noise(Q[first], np.concatenate([Phi[first], Q[first]], axis=2), told)
            n = Phi.shape[1]
            W1 = W[first] + Phi[first].transpose(0, 2, 1) @ told @ both[:, :, :n]
            noise = later @ both[:, :, n:] @ later.transpose(0, 2, 1) + Q[second]
            Q = np.concatenate([even(noise), Q[whole:]])
            products = later @ both[:, :, :n]
        else:
            W1 = W[first] + Phi[first].transpose(0, 2, 1) @ told @ Phi[first]
            products = later @ Phi[first]
        W = np.concatenate([even(W1), W[whole:]])
        Phi = np.concatenate([products, Phi[whole:]])
    return Phi[0], even(W)[0], None if Q is None else Q[0]


def _over_noise(Q: Array, right: Array, W: Array) -> Array:
    """(1 + QW)⁻¹·right, with states brought to one size: their units differ by powers of ten."""
    size = np.sqrt(np.maximum(np.diagonal(Q, axis1=1, axis2=2).max(axis=0), 1e-300))
    scale, n = np.where(size > 1e-150, size, 1.0), Q.shape[1]
    own, told = Q / np.outer(scale, scale), W * np.outer(scale, scale)
    return np.asarray(
        np.linalg.solve(np.eye(n) + own @ told, right / scale[:, None]) * scale[:, None]
    )


@dataclass(frozen=True)
class Products:
    """A model along a record of any length, chunk by chunk: Φ and W of each, (K, n, n); and Q.

    `along`: where a nonlinear one goes; `system`: a linear one along all of it, where it is known
    already; `unseen`: at a sample the directions (n, k) that no record shows, so that this does not
    either, or how many of n can be seen at most.
    """

    model: Dynamics
    run: Run
    along: Path | None
    pace: Pace
    system: Linearised | None
    Phi: Array
    W: Array
    Q: Array | None
    unseen: Callable[[int], Array | int] | None = None
    recent: dict[int, Parts] = field(default_factory=dict, compare=False, repr=False)

    @staticmethod
    def of(
        model: Dynamics, run: Run, along: Path | None = None, system: Linearised | None = None
    ) -> Products:
        """`along`: where a nonlinear model goes."""
        step, n = np.diff(checked_record(model, run)), model.size
        holed = any(not np.isfinite(run.signals[name]).all() for name in model.measured_signals)
        none = np.zeros((-(-len(step) // CHUNK), n, n))
        pace = replace(Pace.of(model, run), holed=holed)
        noisy = along.noisy if along else system is not None and system.process.ndim == 3
        Q = none.copy() if noisy else None
        found = Products(model, run, along, pace, system, none, none.copy(), Q)
        for k in range(0, len(step), PIECE):
            Phi, W, noise = found._steps(k, min(k + PIECE, len(step)))
            for i in range(0, len(Phi), CHUNK):
                own = slice(i, i + CHUNK)
                chunk = _reduced(Phi[own], W[own], None if noise is None else noise[own])
                found._put((k + i) // CHUNK, *chunk)
        return found

    def _put(self, k: int, Phi: Array, W: Array, Q: Array | None) -> None:
        self.Phi[k], self.W[k] = Phi, W
        if self.Q is not None and Q is not None:
            self.Q[k] = Q

    def _steps(self, first: int, last: int) -> Parts:
        if self.along is not None:
            return self.along.steps(first, last)
        where = slice(first, last + 1)
        if self.system is not None:
            return _of_steps(self.model, self.system.part(where, self.pace.part(where)))
        system = linearised(self.model, self.run.take(where), None, self.pace.part(where))
        return _of_steps(self.model, system)

    def gramian(self, first: int = 0, last: int | None = None) -> Array:
        """W (n, n) of the samples from `first` to `last`, at the first; of all unless told."""
        W = self._told(first, len(self.run) - 1 if last is None else last)
        return W if self.unseen is None else without(W, self.unseen(first))

    def _told(self, first: int, last: int) -> Array:
        begin, end = -(-first // CHUNK), last // CHUNK
        if begin >= end:
            return _reduced(*_joined(self._singles(first, last)))[1]
        inner = None if self.Q is None else self.Q[begin:end]
        parts = self._singles(first, begin * CHUNK)
        parts += [(self.Phi[begin:end], self.W[begin:end], inner)]
        return _reduced(*_joined(parts + self._singles(end * CHUNK, last)))[1]

    def _singles(self, first: int, last: int) -> list[Parts]:
        """Of the single steps from `first` to `last`, chunk by chunk."""
        found = []
        for k in range(first // CHUNK, -(-last // CHUNK)):
            Phi, W, Q = self._chunk(k)
            own = slice(max(first - k * CHUNK, 0), last - k * CHUNK)
            found.append((Phi[own], W[own], None if Q is None else Q[own]))
        return found

    def _chunk(self, k: int) -> Parts:
        if k not in self.recent:
            if len(self.recent) >= RECENT:
                del self.recent[next(iter(self.recent))]
            last = min((k + 1) * CHUNK, len(self.run) - 1)
            self.recent[k] = self._steps(k * CHUNK, last)
        return self.recent[k]


def _joined(parts: Sequence[Parts]) -> Parts:
    Phi, W, Q = zip(*parts, strict=True)
    noise = None if any(q is None for q in Q) else np.concatenate(Q)
    return np.concatenate(Phi), np.concatenate(W), noise


def gramian_by_ode(model: Dynamics, system: Linearised, tolerance: float = 1e-12) -> Array:
    """The same by integrating −Ẇ = AᵀW + WA + CᵀΘ⁻¹C backwards with CVODES (SUNDIALS, Adams).

    Signals are straight lines between samples, as in the other form; the integrator stops at every
    sample, so that it never steps over a corner.
    """
    t, n, noise = model.traced, model.size, model.noise_at(usual(system.steps))
    W, weight = ca.SX.sym("W", n, n), ca.SX(ca.DM(np.linalg.inv(noise)))
    # Time runs backwards from the end; `since` is when the step began, at its later sample.
    s, since, h = (ca.SX.sym(name) for name in ("s", "since", "h"))
    share, ends = (s - since) / h, list[ca.SX]()

    def between(name: str, like: ca.SX) -> ca.SX:
        later, earlier = (ca.SX.sym(name + end, like.sparsity()) for end in "10")
        ends.extend((later, earlier))
        return later + share * (earlier - later)

    A, C = between("A", t.A), between("C", t.C)
    read = ca.SX.sym("read")  # what share of the step readings stand for
    rate = A.T @ W + W @ A + read * (C.T @ weight @ C)
    u = ca.vertcat(*[ca.vcat(e.nonzeros()) for e in ends], since, h, read)
    back = system.time[-1] - system.time[::-1]
    columns = [_entries(M[::-1], e)[part] for M, e in ((system.A, t.A), (system.C, t.C))
               for part in (slice(None, -1), slice(1, None))]  # fmt: skip
    shares = (counted(system.steps) / system.steps)[::-1]
    numbers = np.column_stack([*columns, back[:-1], np.diff(back), shares])
    options = {
        "abstol": tolerance,
        "reltol": tolerance,
        "max_num_steps": 1_000_000,
        "linear_multistep_method": "adams",
        "nonlinear_solver_iteration": "functional",
    }
    ode = {"x": ca.vec(W), "t": s, "u": u, "ode": ca.vec(rate)}
    whole = ca.integrator("gramian", "cvodes", ode, 0, back[1:], options)
    found = np.asarray(whole(x0=np.zeros(n * n), u=numbers.T)["xf"][:, -1]).reshape(n, n)
    return np.asarray(0.5 * (found + found.T))


def _entries(matrices: Array, like: ca.SX) -> Array:
    """What can differ from zero of every matrix, (N, k), in CasADi's order."""
    rows, columns = like.sparsity().get_triplet()
    return matrices[:, rows, columns]


def observed(model: Dynamics, W: Array) -> Observed:
    """Rank, unobservable directions in words, and the standard deviations that the data allow."""
    prior = np.sqrt(np.diag(model.start_covariance))
    values, vectors, scale = spectrum(W, prior)
    rank = rank_of(values)
    null = vectors[:, rank:] / scale[:, None]
    null = null / np.maximum(np.linalg.norm(null, axis=0), 1e-300)
    kept = vectors[:, :rank] / np.sqrt(np.maximum(values[:rank], 1e-300))
    std = np.sqrt(np.sum(kept**2, axis=1)) / scale
    basis = sparsest(null).T
    touched = np.array([_parts(model, n, RESIDUE, std) for n in basis]).any(axis=0)
    words = tuple(sentence(model, n, std) for n in basis)
    weak = tuple(_weak(model, W, rank))
    return Observed(rank, model.size, values, words, weak, null, np.where(touched, np.nan, std), W)


def _parts(model: Dynamics, direction: Array, residue: float, std: Array) -> Array:
    """Which numbers (n,) a direction touches: those that it moves by a share `residue` of what was
    known beforehand where the most is moved by all of that, or else by more than their `std`."""
    prior = np.sqrt(np.diag(model.start_covariance))
    share = np.abs(direction / prior)
    most = share.max(initial=1e-300)
    return np.asarray((share > residue * most) | (np.abs(direction) > std * most))


def _weak(model: Dynamics, W: Array, rank: int) -> Iterator[str]:
    """Directions that are observable, and told less than was known of them beforehand."""
    prior = np.sqrt(np.diag(model.start_covariance))
    values, vectors = np.linalg.eigh(W * np.outer(prior, prior))
    for k, (value, v) in enumerate(zip(values, vectors.T, strict=True)):
        if k >= model.size - rank and 0 < value < 1:
            most = int(np.argmax(np.abs(v)))
            std, unit = prior[most] * abs(v[most]) / np.sqrt(value), model.state_units[most]
            yield (
                f"{_subject(model, _clear(model, v * prior), BLURRED)[0]}: {model.names[most]} is "
                f"told to {std:.3g} {unit} only; {prior[most]:.3g} was known beforehand"
            )


def _clear(model: Dynamics, direction: Array) -> Array:
    """Without what is small within its own state."""
    found = direction.copy()
    for where in model.slices().values():
        own = np.abs(found[where])
        found[where] = np.where(own > WITHIN * own.max(), found[where], 0.0)
    return found


def sentence(model: Dynamics, direction: Array, std: Array | float = np.inf) -> str:
    """ "gravity and bias along (0.27, 0.53, 0.80) move together: no reading changes"

    `std`: what else is told of each number."""
    subject, alone = _subject(model, direction, std=std)
    if " along the body axis " in subject:
        return f"{subject}: no reading changes"
    return f"{subject} changes no reading" if alone else f"{subject} together change no reading"


def _subject(
    model: Dynamics, direction: Array, residue: float = RESIDUE, std: Array | float = np.inf
) -> tuple[str, bool]:
    """What moves in a direction, in words, as far as it touches it; is it a single number?"""
    direction = np.where(_parts(model, direction, residue, np.asarray(std)), direction, 0.0)
    parts = [(name, direction[where]) for name, where in model.slices().items()
             if np.any(direction[where])]  # fmt: skip
    if len(parts) > 1 and all(len(v) == 3 for _, v in parts):
        unit = parts[0][1] / np.linalg.norm(parts[0][1])
        unit = unit * np.sign(unit[np.argmax(np.abs(unit))])
        along = [float(v @ unit) for _, v in parts]
        if all(np.linalg.norm(v - a * unit) < residue * np.linalg.norm(v)
               for (_, v), a in zip(parts, along, strict=True)):  # fmt: skip
            axis = ", ".join(f"{u if abs(u) >= 5e-3 else 0.0:.2f}" for u in unit)
            names = " and ".join(name for name, _ in parts)
            same = all(abs(a - along[0]) < residue * abs(along[0]) for a in along)
            how = "move together" if same else "move in proportion"
            return f"{names} along the body axis ({axis}) {how}", False
    # Of several that are as large but for rounding the first has a plus.
    first = np.flatnonzero(np.abs(direction) > 0.999 * np.abs(direction).max())[0]
    moved = [(model.names[i], v / direction[first]) for i, v in enumerate(direction) if v]
    if len(moved) == 1:
        return moved[0][0], True
    return ", ".join(f"{label} {value:+.3g}" for label, value in moved), False


def smallest_eigenvalue(
    model: Dynamics, run: Run, window: float, count: int = 60
) -> tuple[Array, Array]:
    """Smallest eigenvalue of the Gramian over windows of that length (s) along the record.

    Returned: the windows' ends (s) and the eigenvalues, scaled by the states' prior standard
    deviations, so that they are squared signal over noise: above 1 a window alone teaches more
    than was known.
    """
    found = over_windows(Products.of(model, run), window, count)
    return found.ends, found.eigenvalues[:, 0]


@dataclass(frozen=True)
class Windows:
    """What windows that end at `ends` (K,), s, tell of the state at their beginning.

    `eigenvalues` (K, n) of the Gramian, ascending, in units of what was known beforehand; `std`
    (K, n) of every number of the state by that and the window's readings.
    """

    ends: Array
    eigenvalues: Array
    std: Array


def over_windows(products: Products, window: float, count: int = 60) -> Windows:
    """One window of so many seconds, moved along the record to `count` places."""
    prior = np.sqrt(np.diag(products.model.start_covariance))
    time = np.asarray(products.run.time, float)
    ends = (
        np.linspace(time[0] + window, time[-1], count)
        if time[-1] - time[0] > window
        else (time[-1:])
    )
    found, stds = [], []
    for end in ends:
        first = min(int(np.searchsorted(time, end - window - 1e-12)), len(time) - 2)
        last = max(int(np.searchsorted(time, end + 1e-12)) - 1, first + 1)
        W = products.gramian(first, last)
        values, axes = np.linalg.eigh(W * np.outer(prior, prior))
        values[: len(values) - rank_of(spectrum(W, prior)[0])] = 0.0  # rounding
        found.append(values)
        stds.append(prior * np.sqrt(axes**2 @ (1 / (1 + np.maximum(values, 0.0)))))
    return Windows(np.asarray(ends, float), np.array(found), np.array(stds))
