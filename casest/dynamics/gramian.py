"""What a trajectory makes observable: the finite-horizon observability Gramian.

W(t₀, t₁) = ∫Φ(t, t₀)ᵀCᵀΘ⁻¹CΦ(t, t₀) dt, weighted by the measurement noise, is the information that
the readings hold about the state at t₀: its inverse bounds any estimator's covariance. Two forms:
products of transition matrices, and the ODE −Ẇ = AᵀW + WA + CᵀΘ⁻¹C, integrated by CVODES.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.between import motions
from casest.dynamics.declare import Dynamics
from casest.dynamics.transition import (
    Linearised,
    Pace,
    checked_record,
    counted,
    linearised,
    pace_of,
    usual,
)
from casest.leastsquares.null_space import sparsest

#: A direction counts as observable from this share of the largest scaled eigenvalue on. Rounding
#: and the error of a fourth-order step stay below 1e-13.
NULL = 1e-11
#: Steps whose product is kept, and samples that are worked on at once.
CHUNK, PIECE = 256, 4096


@dataclass(frozen=True)
class Observed:
    """Rank of the Gramian among n states, scaled so that units do not count.

    `eigenvalues` (n,) of the scaled Gramian, largest first; `unobservable` in words, with their
    `directions` (n, k) in the states' units; `std` (n,) what the data alone allow at the start of
    the record (NaN where they do not determine it).
    """

    rank: int
    unknowns: int
    eigenvalues: Array
    unobservable: tuple[str, ...]
    directions: Array
    std: Array
    gramian: Array


def gramian(model: Dynamics, system: Linearised) -> Array:
    """W of the whole record at its first sample, (n, n), from transition matrices."""
    return _reduced(*_of_steps(model, system))[1]


def _of_steps(model: Dynamics, system: Linearised) -> tuple[Array, Array]:
    """Φ and W of every single step at its own beginning, (N − 1, n, n) each.

    W is what driving noise CᵀΘ⁻¹C makes of the motion with Aᵀ that runs back from the step's end,
    and Φᵀ its transition.
    """
    pace = system.pace or pace_of(system.steps)
    weight = np.linalg.inv(model.noise_at(pace.usual))
    told = np.asarray(system.C.transpose(0, 2, 1) @ weight @ system.C, float)
    none, back = np.zeros_like(system.c), system.A.transpose(0, 2, 1)[::-1]
    if np.isfinite(system.y).all() and not pace.holed:
        found = motions(back, none, told[::-1], system.steps[::-1])
        Phi, W = found.Phi[::-1].transpose(0, 2, 1), found.Q[::-1]
        return Phi, W * (pace.usual / system.steps)[:, None, None]
    # Single readings are no curve: each for its own time.
    Phi = system.moved[0]
    return Phi, 0.5 * pace.usual * (told[:-1] + Phi.transpose(0, 2, 1) @ told[1:] @ Phi)


def _reduced(Phi: Array, W: Array) -> tuple[Array, Array]:
    """Neighbours joined pair by pair: (Φ₂, W₂)∘(Φ₁, W₁) = (Φ₂Φ₁, W₁ + Φ₁ᵀW₂Φ₁)."""
    while len(Phi) > 1:
        even = len(Phi) // 2 * 2
        first, second = slice(0, even, 2), slice(1, even, 2)
        joined = W[first] + Phi[first].transpose(0, 2, 1) @ W[second] @ Phi[first]
        products = Phi[second] @ Phi[first]
        W = np.concatenate([joined, W[even:]])
        Phi = np.concatenate([products, Phi[even:]])
    return Phi[0], 0.5 * (W[0] + W[0].T)


@dataclass(frozen=True)
class Products:
    """A model along a record of any length, chunk by chunk: Φ and W of each, (K, n, n)."""

    model: Dynamics
    run: Run
    along: Array | None
    pace: Pace
    Phi: Array
    W: Array

    @staticmethod
    def of(model: Dynamics, run: Run, along: Array | None = None) -> Products:
        """`along`: states (N, n) along which a nonlinear model is linearised."""
        step, n = np.diff(checked_record(model, run)), model.size
        holed = any(not np.isfinite(run.signals[name]).all() for name in model.measured_signals)
        none = np.zeros((-(-len(step) // CHUNK), n, n))
        found = Products(model, run, along, replace(pace_of(step), holed=holed), none, none.copy())
        for k in range(0, len(step), PIECE):
            Phi, W = found._steps(k, min(k + PIECE, len(step)))
            for i in range(0, len(Phi), CHUNK):
                own = _reduced(Phi[i : i + CHUNK], W[i : i + CHUNK])
                found.Phi[(k + i) // CHUNK], found.W[(k + i) // CHUNK] = own
        return found

    def _steps(self, first: int, last: int) -> tuple[Array, Array]:
        where = slice(first, last + 1)
        along = None if self.along is None else self.along[where]
        system = linearised(self.model, self.run.take(where), along, self.pace)
        return _of_steps(self.model, system)

    def gramian(self, first: int = 0, last: int | None = None) -> Array:
        """W (n, n) of the samples from `first` to `last`, at the first; of all unless told."""
        last = len(self.run) - 1 if last is None else last
        begin, end = -(-first // CHUNK), last // CHUNK
        if begin >= end:
            return _reduced(*self._steps(first, last))[1]
        parts = [(self.Phi[begin:end], self.W[begin:end])]
        if first < begin * CHUNK:
            parts.insert(0, self._steps(first, begin * CHUNK))
        if end * CHUNK < last:
            parts.append(self._steps(end * CHUNK, last))
        Phi, W = zip(*parts, strict=True)
        return _reduced(np.concatenate(Phi), np.concatenate(W))[1]


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
    scale = np.sqrt(np.where(np.diag(W) > 0, np.diag(W), 1.0))
    # Scaled by what is known beforehand: so many of a state's own standard deviations are visible.
    prior = np.sqrt(np.diag(model.start_covariance))
    scale = np.where(np.diag(W) > 0, scale, 1 / prior)
    values, vectors = np.linalg.eigh(W / np.outer(scale, scale))
    order = np.argsort(values)[::-1]
    values, vectors = values[order], vectors[:, order]
    rank = int(np.sum(values > NULL * values[0])) if values[0] > 0 else 0
    null = vectors[:, rank:] / scale[:, None]
    null = null / np.maximum(np.linalg.norm(null, axis=0), 1e-300)
    kept = vectors[:, :rank] / np.sqrt(np.maximum(values[:rank], 1e-300))
    std = np.sqrt(np.sum(kept**2, axis=1)) / scale
    touched = np.linalg.norm(vectors[:, rank:], axis=1) > 1e-5
    words = tuple(_words(model, null))
    return Observed(rank, model.size, values, words, null, np.where(touched, np.nan, std), W)


def _words(model: Dynamics, null: Array) -> Sequence[str]:
    """Each unobservable direction as a sentence."""
    basis = sparsest(null)
    return [sentence(model, basis[:, k]) for k in range(basis.shape[1])]


def sentence(model: Dynamics, direction: Array) -> str:
    """ "gravity and bias along (0.27, 0.53, 0.80) move together" """
    largest = np.abs(direction).max()
    parts: list[tuple[str, Array]] = []
    for name, where in model.slices().items():
        own = direction[where]
        if np.abs(own).max(initial=0.0) > 1e-6 * largest:
            parts.append((name, own))
    vectors = [v for _, v in parts if len(v) == 3]
    if len(parts) > 1 and len(vectors) == len(parts):
        unit = vectors[0] / np.linalg.norm(vectors[0])
        unit = unit * np.sign(unit[np.argmax(np.abs(unit))])
        along = [float(v @ unit) for v in vectors]
        if all(np.linalg.norm(v - a * unit) < 1e-5 * np.linalg.norm(v)
               for v, a in zip(vectors, along, strict=True)):  # fmt: skip
            axis = ", ".join(f"{u if abs(u) >= 5e-3 else 0.0:.2f}" for u in unit)
            names = " and ".join(name for name, _ in parts)
            same = all(abs(a - along[0]) < 1e-4 * abs(along[0]) for a in along)
            how = "move together" if same else "move in proportion"
            return f"{names} along the body axis ({axis}) {how}: no reading changes"
    words: list[str] = []
    label = ""
    for name, own in parts:
        for i, value in enumerate(own):
            if abs(value) > 1e-6 * largest:
                label = name if len(own) == 1 else f"{name}[{i}]"
                words.append(f"{label} {value / largest:+.3g}")
    if len(words) == 1:
        return f"{label} changes no reading"
    return f"{', '.join(words)} together change no reading"


def smallest_eigenvalue(
    model: Dynamics, run: Run, window: float, count: int = 60
) -> tuple[Array, Array]:
    """Smallest eigenvalue of the Gramian over windows of that length (s) along the record.

    Returned: the windows' ends (s) and the eigenvalues, scaled by the states' prior standard
    deviations, so that they are squared signal over noise: above 1 a window alone teaches more
    than was known.
    """
    ends, values = window_eigenvalues(Products.of(model, run), window, count)
    return ends, values[:, 0]


def window_eigenvalues(products: Products, window: float, count: int = 60) -> tuple[Array, Array]:
    """All of them, ascending: the windows' ends (K,) and eigenvalues (K, n), scaled alike."""
    prior = np.sqrt(np.diag(products.model.start_covariance))
    time = np.asarray(products.run.time, float)
    ends = (
        np.linspace(time[0] + window, time[-1], count)
        if time[-1] - time[0] > window
        else (time[-1:])
    )
    found = []
    for end in ends:
        first = min(int(np.searchsorted(time, end - window - 1e-12)), len(time) - 2)
        last = max(int(np.searchsorted(time, end + 1e-12)) - 1, first + 1)
        found.append(np.linalg.eigvalsh(products.gramian(first, last) * np.outer(prior, prior)))
    return np.asarray(ends, float), np.array(found)
