"""The search for a motion as a nonlinear program: multiple shooting, IPOPT.

Unknowns are the inputs at knots and the states at the nodes of a grid, each in its own size. What
the readings tell of the state at the beginning is summed from the end backwards,
W(tₖ) = wₖCᵀΘ⁻¹C + ΦₖᵀW(tₖ₊₁)Φₖ, so that its derivative costs about as much as itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.errors import UsageError
from casest.plan.motion.criteria import Wanted
from casest.plan.motion.grid import Grid
from casest.plan.motion.limits import Limit

#: Runge-Kutta steps between two nodes, of Φ and of the states alone, which limits are kept by.
STEPS, FINE = 2, 5
#: What keeps inputs small and smooth that matter to nothing else, in shares of a standard
#: deviation.
SMOOTH = 3e-2
#: Of IPOPT. A share of 1e-5 of a standard deviation is no better motion.
SETTINGS = {
    "hessian_approximation": "limited-memory",
    "limited_memory_max_history": 30,
    "nlp_scaling_method": "none",
    "mu_init": 1e-2,
    "tol": 1e-4,
    "acceptable_tol": 3e-2,
    "acceptable_iter": 4,
    "acceptable_constr_viol_tol": 1e-3,
    "acceptable_obj_change_tol": 1e-5,
    "print_level": 0,
    "sb": "yes",
}


#: The same for the nearest motion within limits: an error of a node's state grows over all others.
NEAREST = SETTINGS | {
    "mu_init": 1e-4,
    "max_iter": 60,
    "acceptable_tol": 1e-2,
    "acceptable_iter": 1,
    "acceptable_constr_viol_tol": 1e-6,
    "acceptable_obj_change_tol": 1e20,
}

#: Expressions, and between what they stay.
Constraints = tuple[Any, Array, Array]
#: A state and what is followed along with it.
Parts = tuple[Any, ...]


@dataclass(frozen=True)
class Scenario:
    """One beginning of the states: x (n, K + 1) as CasADi's symbols in their sizes, guesses (K + 1,
    n) of them, constraints, and what the readings tell at the beginning."""

    x: Any
    guess: Array
    constraints: Constraints
    W: Any


@dataclass(frozen=True)
class Task:
    """The best motion of a model: what is wanted, within which limits, on which grid.

    noise: Θ (m, m), in whose units a reading tells CᵀΘ⁻¹C; finer: times as many Runge-Kutta steps
    as are usual.
    """

    model: Dynamics
    wanted: Wanted
    limits: tuple[Limit, ...]
    grid: Grid
    noise: Array
    finer: int = 1

    # -- functions of one sample ---------------------------------------------------------------

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Names of what is planned."""
        return self.model.input_signals

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Where each input lies among all."""
        found, place = {}, 0
        for name in self.inputs:
            size = next(s.size for s in self.model.signals if s.name == name)
            found[name] = slice(place, place + size)
            place += size
        return found

    @cached_property
    def wide(self) -> int:
        """How many numbers all inputs are."""
        return max((s.stop for s in self.columns.values()), default=0)

    def _expressions(self, parts: Sequence[Any]) -> tuple[Any, Any, list[Any]]:
        """x, u and expressions of both."""
        t = self.model.traced
        u = ca.vertcat(ca.SX(0, 1), *[flat(t.symbols[n]) for n in self.inputs])
        clock = [flat(t.symbols[s.name]) for s in self.model.signals if s.name == "t"]
        every = ca.vertcat(ca.SX(0, 1), *(ca.densify(ca.vec(p)) for p in parts))
        driving = [n for n in t.measured if ca.depends_on(every, flat(t.symbols[n]))]
        if driving or (clock and ca.depends_on(every, clock[0])):
            raise UsageError(
                f"{self.model.name}: {driving[0] if driving else 't'} drives the motion and "
                "cannot be set: a motion is planned of inputs alone"
            )
        return t.x, u, [ca.densify(p) for p in parts]

    @cached_property
    def rate(self) -> Any:
        """(x, u) -> ẋ, ∂ẋ/∂x."""
        t = self.model.traced
        x, u, out = self._expressions([t.f, t.A])
        return ca.Function("rate", [x, u], out)

    @cached_property
    def slope(self) -> Any:
        """(x, u) -> Θ^(-1/2)·C, of states in the sizes that are wanted."""
        size = ca.DM(np.diag(self.wanted.scale))
        root = ca.DM(np.linalg.inv(np.linalg.cholesky(self.noise)))
        x, u, out = self._expressions([root @ self.model.traced.C @ size])
        return ca.Function("slope", [x, u], out)

    @cached_property
    def told(self) -> Any:
        """(x, u) -> CᵀΘ⁻¹C, of states in the sizes that are wanted."""
        x, u = self.slope.sx_in()
        C = self.slope(x, u)
        return ca.Function("told", [x, u], [C.T @ C])

    @cached_property
    def step(self) -> Any:
        """(x, u at both ends) -> x and Φ, of scaled states, over one interval."""
        up, down = (ca.DM(np.diag(s)) for s in (1 / self.wanted.scale, self.wanted.scale))

        def slopes(state: Parts, u: Any) -> Parts:
            f, A = self.rate(state[0], u)
            return f, up @ A @ down @ state[1]

        return self._stepped("step", slopes, self.finer * STEPS, ca.SX.eye(self.model.size))

    @cached_property
    def move(self) -> Any:
        """(x, u at both ends) -> x alone."""
        return self._stepped("move", lambda s, u: (self.rate(s[0], u)[0],), self.finer * FINE)

    def _stepped(
        self, name: str, slopes: Callable[[Parts, Any], Parts], steps: int, *more: Any
    ) -> Any:
        """Runge-Kutta steps over one interval, inputs being straight lines."""
        x, u0, u1 = (ca.SX.sym(s, k) for s, k in (("x", self.model.size), ("u0", self.wide),
                                                 ("u1", self.wide)))  # fmt: skip
        h, now = self.grid.step / steps, (x, *more)
        for i in range(steps):
            a, b = (u0 + (u1 - u0) * (i + e) / steps for e in (0, 1))
            k1 = slopes(now, a)
            k2 = slopes(_moved(now, k1, h / 2), (a + b) / 2)
            k3 = slopes(_moved(now, k2, h / 2), (a + b) / 2)
            k4 = slopes(_moved(now, k3, h), b)
            now = tuple(
                ca.densify(s + h / 6 * (p + 2 * q + 2 * r + v))
                for s, p, q, r, v in zip(now, k1, k2, k3, k4, strict=True)
            )
        return ca.Function(name, [x, u0, u1], list(now), {"cse": True})

    # -- along a motion ------------------------------------------------------------------------

    def states(self, u: Array, start: Array | None = None) -> Array:
        """States (K + 1, n) at the nodes of a motion with inputs u (P, k) at knots."""
        begin, end = self.ends(u)
        found = [self.model.start if start is None else start]
        for a, b in zip(begin, end, strict=True):
            found.append(np.asarray(self.move(found[-1], a, b)).ravel())
        return np.array(found)

    def ends(self, u: Array) -> tuple[Array, Array]:
        """Inputs (K, k) at the beginning and the end of every interval."""
        time = self.grid.time
        return self.grid.at(time[:-1]) @ u, self.grid.at(time[1:], before=True) @ u

    def information(self, u: Array, weights: Array, start: Array | None = None) -> Array:
        """What the readings tell of the scaled state at the beginning, (n, n)."""
        x, (begin, end) = self.states(u, start), self.ends(u)
        K, n = len(begin), self.model.size
        Phi = np.array(self.step.map(K)(x[:-1].T, begin.T, end.T)[1])
        at = np.vstack([begin, end[-1:]])
        T = np.array(self.told.map(K + 1)(x.T, at.T))
        W = weights[K] * T[:, K * n :]
        for k in range(K - 1, -1, -1):
            own = Phi[:, k * n : (k + 1) * n]
            W = weights[k] * T[:, k * n : (k + 1) * n] + own.T @ W @ own
        return np.asarray(0.5 * (W + W.T))

    def factors(self, u: Array, start: Array | None = None) -> Array:
        """What the reading at each node tells of the scaled states that are unknown, as factors
        (K + 1, m, f) of its information."""
        x, (begin, end) = self.states(u, start), self.ends(u)
        Phi, found = np.eye(self.model.size), []
        at = np.vstack([begin, end[-1:]])
        for k in range(len(at)):
            C = np.array(self.slope(x[k], at[k])).reshape(-1, self.model.size)
            found.append((C @ Phi)[:, self.wanted.free])
            if k < len(begin):
                Phi = np.array(self.step(x[k], begin[k], end[k])[1]) @ Phi
        return np.array(found)

    # -- the program ---------------------------------------------------------------------------

    def solved(
        self,
        u: Array,
        weights: Array,
        most: int,
        starts: Sequence[Array] = (),
        worst: bool = False,
        limited: int | None = None,
    ) -> Array:
        """Inputs (P, k) of the best motion that `most` steps lead to from u, within the limits.

        weights (K + 1,): how much the reading at each node counts. Where several `starts` (n,) are
        possible, what is wanted is averaged over them, or of the `worst` of them; limits of states
        hold from all of them, or from the first `limited`.
        """
        starts = list(starts) or [self.model.start]
        us, of_u = ca.MX.sym("u", self.wide, len(u)), self._input_sizes()
        bound = len(starts) if limited is None else limited
        every = [
            self._scenario(us, of_u, u, start, weights, limited=i < bound)
            for i, start in enumerate(starts)
        ]
        near = [self.information(u, weights, start) for start in starts]
        wanted = [self.wanted.function(W)(s.W) for s, W in zip(every, near, strict=True)]
        own = self._of_inputs(us, of_u)
        J = SMOOTH / us.numel() * ca.sumsqr(us)
        if len(u) > 1:
            J += SMOOTH / us.numel() * ca.sumsqr(us[:, 1:] - us[:, :-1])
        if not worst:
            J += sum(wanted[1:], wanted[0]) / len(wanted)
            return _least(J, every, us, u / of_u, [own], {**SETTINGS, "max_iter": most}) * of_u
        largest = ca.MX.sym("largest")
        below = ca.vertcat(*wanted) - largest
        both = own, (below, np.full(len(wanted), -np.inf), np.zeros(len(wanted)))
        settings = {**SETTINGS, "max_iter": most}
        more = largest, max(map(self.wanted.value, near))
        return _least(J + largest, every, us, u / of_u, both, settings, more) * of_u

    def nearest(self, u: Array) -> Array:
        """Inputs (P, k) nearest to u with which everything keeps to its limits."""
        us, of_u = ca.MX.sym("u", self.wide, len(u)), self._input_sizes()
        every = [self._scenario(us, of_u, u, self.model.start)]
        J = 0.5 * ca.sumsqr(us - ca.DM((u / of_u).T))
        return _least(J, every, us, u / of_u, [self._of_inputs(us, of_u)], NEAREST) * of_u

    def _input_sizes(self) -> Array:
        """How large each number of the inputs is, (k,)."""
        found = np.ones(self.wide)
        for limit in self.limits:
            if not limit.rate and limit.of in self.columns:
                found[self.columns[limit.of]] = limit.size
        return found

    def _state_sizes(self, x: Array) -> Array:
        """How large each state is, (n,): as limited, else as it is in a motion x (K + 1, n)."""
        found = np.maximum(np.abs(x).max(axis=0), 1e-3 * self.wanted.scale)
        where = self.model.slices()
        for limit in self.limits:
            if not limit.rate and limit.of in where:
                found[where[limit.of]] = limit.size
        return np.asarray(found)

    def _kept(self, x: Array) -> Array:
        """States within their limits, and finite: where a search can begin."""
        x = np.where(np.isfinite(x), x, x[0])
        where = self.model.slices()
        for limit in self.limits:
            if not limit.rate and limit.of in where:
                x[1:, where[limit.of]] = limit.kept(x[1:, where[limit.of]])
        return x

    def _of_inputs(self, us: Any, of_u: Array) -> Constraints:
        """Limits of inputs and of their rates."""
        own = [limit for limit in self.limits if limit.of in self.columns]
        return _joined([self._limited(limit, None, us, None, None, of_u) for limit in own])

    def _scenario(
        self,
        us: Any,
        of_u: Array,
        u: Array,
        start: Array,
        weights: Array | None = None,
        *,
        limited: bool = True,
    ) -> Scenario:
        """States along inputs, from one beginning; about as large as along u (P, k)."""
        x = self.states(u, start)
        x = self._kept(x) if limited else np.where(np.isfinite(x), x, x[0])
        of_x = self._state_sizes(x)
        K, n = len(self.grid.time) - 1, self.model.size
        xs = ca.MX.sym("x", n, K + 1)
        begin, end = (ca.mtimes(us, ca.sparsify(ca.DM(E.T))) for E in self._at_ends())
        # Apart from Φ, or the Jacobian of the constraints would come with that of Φ.
        after = self._scaled(self.move, of_x, of_u).map(K)(xs[:, :-1], begin, end)
        at = ca.horzcat(begin, end[:, -1])
        rates = self._scaled(self.rate, of_x, of_u, only=0).map(K + 1)(xs, at)
        parts = [(ca.vec(after - xs[:, 1:]), np.zeros(n * K), np.zeros(n * K))]
        where = self.model.slices()
        for limit in (limit for limit in self.limits if limited and limit.of in where):
            parts.append(self._limited(limit, xs, us, rates, of_x, of_u))
        W = None
        if weights is not None:
            Phi = self._scaled(self.step, of_x, of_u, only=1).map(K)(xs[:, :-1], begin, end)
            W = _summed(self._scaled(self.told, of_x, of_u).map(K + 1)(xs, at), Phi, weights, n)
        return Scenario(xs, x / of_x, _joined(parts), W)

    def _at_ends(self) -> tuple[Array, Array]:
        time = self.grid.time
        return self.grid.at(time[:-1]), self.grid.at(time[1:], before=True)

    def _scaled(self, f: Any, of_x: Array, of_u: Array, only: int | None = None) -> Any:
        """A function of states and inputs in their sizes; states that it gives too."""
        symbols = [ca.SX.sym(f"s{i}", *f.size_in(i)) for i in range(f.n_in())]
        out = f.call([ca.DM(of_x) * symbols[0], *(ca.DM(of_u) * s for s in symbols[1:])])
        if f.name() == "move":
            out[0] = out[0] / ca.DM(of_x)
        return ca.Function(f.name(), symbols, out if only is None else [out[only]])

    def _limited(
        self, limit: Limit, x: Any, u: Any, rates: Any, of_x: Array | None, of_u: Array
    ) -> Constraints:
        """A limit as constraints: of lengths their squares, in shares of what is allowed."""
        where = self.model.slices()
        if limit.of in where:
            assert of_x is not None
            own = where[limit.of]
            values = rates[own, :] if limit.rate else ca.DM(of_x[own]) * x[own, 1:]
        else:
            own = self.columns[limit.of]
            values = ca.DM(of_u[own]) * u[own, :]
            if limit.rate:
                step = float(self.grid.knots[1] - self.grid.knots[0])
                values = (values[:, 1:] - values[:, :-1]) / step
        if limit.length is not None:
            count = values.shape[1]
            squares = ca.vec(ca.sum1(values**2) / limit.length**2)
            return squares, np.full(count, -np.inf), np.ones(count)
        low, high = (np.full(values.numel(), end / limit.size) for end in (limit.low, limit.high))
        return ca.vec(values / limit.size), low, high


def _joined(parts: Sequence[Constraints]) -> Constraints:
    """Constraints one below the other."""
    low, high = (np.concatenate([np.zeros(0), *(p[i] for p in parts)]) for i in (1, 2))
    return ca.vertcat(ca.MX(0, 1), *(p[0] for p in parts)), low, high


def _least(
    J: Any,
    every: Sequence[Scenario],
    us: Any,
    u: Array,
    own: Sequence[Constraints],
    settings: Mapping[str, Any],
    more: tuple[Any, float] | None = None,
) -> Array:
    """Inputs (P, k) in their sizes where J is least, from u; `more`: one more unknown."""
    g, low, high = _joined([*(s.constraints for s in every), *own])
    unknown = [*(s.x for s in every), us, *([] if more is None else [more[0]])]
    guess = [*(s.guess for s in every), u, *([] if more is None else [np.array([more[1]])])]
    start = np.concatenate([part.ravel() for part in guess])
    lower, upper, place = np.full(len(start), -np.inf), np.full(len(start), np.inf), 0
    for s in every:
        begin = slice(place, place + s.guess.shape[1])
        lower[begin] = upper[begin] = start[begin]
        place += s.guess.size
    options = {"ipopt": dict(settings), "print_time": False, "show_eval_warnings": False}
    nlp = {"x": ca.veccat(*unknown), "f": J, "g": g}
    solver = ca.nlpsol("motion", "ipopt", nlp, options)
    found = solver(x0=start, lbx=lower, ubx=upper, lbg=low, ubg=high)
    return np.array(found["x"]).ravel()[place : place + u.size].reshape(u.shape)


def _moved(state: Parts, rate: Parts, h: float) -> Parts:
    return tuple(s + h * r for s, r in zip(state, rate, strict=True))


def _summed(T: Any, Phi: Any, weights: Array, n: int) -> Any:
    """W at the first node: what all nodes tell."""
    A, B, C = (ca.SX.sym(name, n, n) for name in "ABC")
    w = ca.SX.sym("w")
    joined = ca.Function("joined", [A, B, C, w], [w * A + B.T @ C @ B])
    K = len(weights) - 1
    W = weights[K] * T[:, K * n :]
    for k in range(K - 1, -1, -1):
        own = slice(k * n, (k + 1) * n)
        W = joined(T[:, own], Phi[:, own], W, weights[k])
    return W
