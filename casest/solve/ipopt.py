"""IPOPT (Wächter & Biegler 2006) on the problem's own sums: the solver of record.

CasADi hands IPOPT three functions that the engine evaluates: cost, gradient and Hessian
(Gauss-Newton, or exact on request). IPOPT's status is information, never proof: see certificate.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from casest.declaration.shapes import Array
from casest.interruption import held_back, waits
from casest.leastsquares.flow import GivenUp
from casest.leastsquares.problem import Point, Problem
from casest.solve.outcome import Outcome

#: Solvers kept for the next problem of as many unknowns.
KEPT = 32
#: Settings where a polish follows: of long products of rotations the cost stands still earlier, and
#: the line search would fight rounding two hundred times.
STANDSTILL = {"acceptable_tol": 1e-6, "acceptable_obj_change_tol": 1e-13, "acceptable_iter": 2}
#: And from where other ways have led already: a barrier and multipliers as they are there, so that
#: an optimum is not left to be found again.
CLOSE_BY = STANDSTILL | {
    "mu_init": 1e-10,
    "bound_mult_init_method": "mu-based",
    "bound_push": 1e-9,
    "bound_frac": 1e-9,
}
#: Share of the first cost below which tolerance and barrier, shares of that, are too large.
FALLEN = 1e-4
#: Evaluations after which a search is given up: three for each iteration allowed. From wild starts
#: the line search may halve its step thirty times in every iteration, and get nowhere.
PATIENCE = 1500


def ipopt(
    problem: Problem,
    start: Point,
    *,
    exact: bool = False,
    options: dict[str, Any] | None = None,
    patience: int = PATIENCE,
) -> Outcome:
    """Minimise the cost from `start`. `exact` uses the exact Hessian instead of JᵀJ.

    Unknowns are scaled by their Jacobian columns and the cost by its start value. `options` are
    IPOPT's own, where a polish follows; after so many evaluations as `patience` it is given up.
    """
    settings = {
        "print_level": 0,
        "sb": "yes",
        "max_iter": 500,
        # Beyond this tolerance the line search fights rounding; a polish follows anyway.
        "tol": 1e-8,
        "bound_relax_factor": 0.0,
        # Starts are good and bounds rarely active: a weak barrier from the beginning.
        "mu_strategy": "monotone",
        "mu_init": 1e-6,
        **(options or {}),
    }
    found = run_nlpsol("ipopt", problem, start, settings, exact=exact, patience=patience)
    if options is None and found.claims_success and 0 < found.cost < FALLEN * problem.cost(start):
        found = _closer(problem, found, settings, exact, patience - found.evaluations)
    return replace(found, solver="ipopt-exact") if exact else found


def _closer(
    problem: Problem, end: Outcome, settings: dict[str, Any], exact: bool, patience: int
) -> Outcome:
    """Where it goes on to from its end: tolerance and barrier are shares of the cost at the start.

    At rounding it may not go on, and the end stays.
    """
    found = run_nlpsol("ipopt", problem, end.point, settings, exact=exact, patience=patience)
    better = found.claims_success and found.cost <= end.cost
    return replace(
        found if better else end,
        iterations=end.iterations + found.iterations,
        evaluations=end.evaluations + found.evaluations,
        seconds=end.seconds + found.seconds,
    )


def run_nlpsol(
    plugin: str,
    problem: Problem,
    start: Point,
    settings: dict[str, Any],
    *,
    exact: bool = False,
    patience: int = PATIENCE,
) -> Outcome:
    """Minimise the cost from `start` by an nlpsol plugin of CasADi: "ipopt" or "sqpmethod"."""
    began = time.perf_counter()
    scaled = _Scaled(problem, start, exact, patience)
    z0 = start.x / scaled.scale
    lower, upper = problem.bounds
    with _solver(plugin, problem.unknowns, settings) as solver, np.errstate(invalid="ignore"):
        solver.scaled = scaled
        with held_back():
            found = solver.nlpsol(x0=z0, lbx=lower / scaled.scale, ubx=upper / scaled.scale)
        stats = solver.nlpsol.stats()
    z = np.array(found["x"]).ravel()
    # After Invalid_Option and the like IPOPT returns the start without a word: read its status.
    point = scaled.reached(z)
    return Outcome(
        plugin,
        point,
        problem.normal(point).cost,  # kept for the polish that follows
        int(stats.get("iter_count", 0)),
        scaled.evaluations,
        bool(stats["success"]),
        str(stats["return_status"]),
        time.perf_counter() - began,
    )


class _Scaled:
    """Cost, gradient and Hessian in scaled unknowns z, remembering the last point."""

    def __init__(self, problem: Problem, start: Point, exact: bool, patience: int) -> None:
        self.problem, self.start, self.exact, self.patience = problem, start, exact, patience
        first = problem.normal(start)
        self.unit = first.cost if np.isfinite(first.cost) and first.cost > 0 else 1.0
        columns = np.sqrt(np.maximum(np.diag(first.matrix), 0.0))
        usable = np.isfinite(columns) & (columns > 0)
        self.scale = np.where(usable, np.sqrt(2 * self.unit) / np.where(usable, columns, 1.0), 1.0)
        self.evaluations = 1
        self._z = start.x / self.scale
        self._point, self._normal = start, first

    def normal(self, z: Array) -> Any:
        """Normal equations at z (cached: IPOPT asks for cost, gradient, Hessian in turn)."""
        if not np.array_equal(z, self._z):
            self._z, self._point = z.copy(), self.point(z)
            self._normal = self.problem.normal(self._point)
            self.evaluations += 1
        return self._normal

    def point(self, z: Array) -> Point:
        """The point in the chart of the start (charts stay fixed while IPOPT runs)."""
        return Point(self.scale * z, self.start.references)

    def reached(self, z: Array) -> Point:
        """The point in charts around itself; the one evaluated last where that is the same."""
        flat = not any(slot.parameter.shape.curved for slot in self.problem.slots)
        if flat and np.array_equal(z, self._z):
            return self._point
        return self.problem.moved(self.start, self.scale * z - self.start.x)

    def cost(self, z: Array) -> float:
        """Scaled cost; with its slope, for nearly every point that IPOPT tries is accepted."""
        # What is not finite makes IPOPT's line search give up: after Ctrl-C, or at long last.
        if waits() or self.evaluations > self.patience:
            return float("nan")
        try:
            return float(self.normal(z).cost / self.unit)
        except GivenUp:  # raised again where nobody swallows it: when IPOPT has ended
            self.patience = -1
            return float("nan")

    def gradient(self, z: Array) -> Array:
        """Gradient of the scaled cost, (n,)."""
        return np.asarray(self.normal(z).gradient * self.scale / self.unit)

    def hessian(self, z: Array) -> Array:
        """Hessian of the scaled cost, (n, n)."""
        matrix = self.problem.hessian(self.point(z)) if self.exact else self.normal(z).matrix
        return np.asarray(matrix * np.outer(self.scale, self.scale) / self.unit)


class _Solver:
    """An nlpsol whose functions are Python callbacks into what `scaled` holds at the time."""

    def __init__(self, plugin: str, n: int, settings: dict[str, Any]) -> None:
        self.scaled: Any = None
        dense = ca.Sparsity.dense
        # IPOPT takes the upper triangle, sqpmethod the whole matrix.
        pattern = ca.Sparsity.upper(n) if plugin == "ipopt" else dense(n, n)
        x, none = dense(n, 1), dense(0, 1)
        rows, columns = pattern.row(), _columns(pattern)

        def gradient(z: Any, _p: Any) -> list[Any]:
            z = _vector(z)
            return [self.scaled.cost(z), self.scaled.gradient(z)]

        def hessian(z: Any, _p: Any, factor: Any, _g: Any) -> list[Any]:
            matrix = float(factor) * self.scaled.hessian(_vector(z))
            return [ca.DM(pattern, matrix[rows, columns])]

        cost_f = _Callback("f", lambda z: [self.scaled.cost(_vector(z))], [x], [dense(1, 1)])
        grad_f = _Callback("nlp_grad_f", gradient, [x, none], [dense(1, 1), x])
        hess_l = _Callback("nlp_hess_l", hessian, [x, none, dense(1, 1), none], [pattern])
        z, p = ca.MX.sym("x", n), ca.MX.sym("p", 0, 1)
        factor, g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0, 1)
        f, slope = grad_f(z, p)
        lagrangian = [z, p, factor, g], [hess_l(z, p, factor, g)], ["x", "p", "lam_f", "lam_g"]
        if plugin == "ipopt":
            names = ["f", "grad_f_x"]
            own = {
                "grad_f": ca.Function("nlp_grad_f", [z, p], [f, slope], ["x", "p"], names),
                "hess_lag": ca.Function("nlp_hess_l", *lagrangian, ["triu_hess_gamma_x_x"]),
                "ipopt": settings,
            }
        else:
            names, nothing = ["f", "grad_f_x", "g", "jac_g_x"], [ca.MX(0, 1), ca.MX(0, n)]
            own = {
                "jac_fg": ca.Function("jac_fg", [z, p], [f, slope, *nothing], ["x", "p"], names),
                "hess_lag": ca.Function("nlp_hess_l", *lagrangian, ["hess_gamma_x_x"]),
                **settings,
            }
        options = {
            "no_nlp_grad": True,
            "calc_lam_p": False,
            "print_time": False,
            "show_eval_warnings": False,  # a point that is not finite is stepped back from
            **own,
        }
        self.nlpsol = ca.nlpsol("solver", plugin, {"x": z, "f": cost_f(z)}, options)
        # CasADi keeps no reference to Python callbacks: tie them to the solver's life.
        self._keep = (cost_f, grad_f, hess_l)


_idle: dict[tuple[str, int, str], _Solver] = {}


@contextmanager
def _solver(plugin: str, n: int, settings: dict[str, Any]) -> Iterator[_Solver]:
    """A solver for n unknowns; building one takes longer than a small fit, so it is kept.

    Taken off the shelf while in use: two threads, or a callback that solves, never share one.
    """
    key = plugin, n, repr(sorted(settings.items()))
    solver = _idle.pop(key, None) or _Solver(plugin, n, settings)
    try:
        yield solver
    finally:
        solver.scaled = None
        if len(_idle) < KEPT:
            _idle[key] = solver


def _columns(sparsity: Any) -> list[int]:
    return [int(c) for c in sparsity.get_triplet()[1]]


def _vector(z: Any) -> Array:
    return np.array(z.nonzeros())  # dense: much quicker than a conversion


class _Callback(ca.Callback):  # type: ignore[misc]
    """A Python function of dense inputs as a CasADi function."""

    def __init__(self, name: str, function: Callable[..., list[Any]], inputs: Any, outputs: Any):
        ca.Callback.__init__(self)
        self.function, self.inputs, self.outputs = function, inputs, outputs
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self.inputs)

    def get_n_out(self) -> int:
        return len(self.outputs)

    def get_sparsity_in(self, i: int) -> Any:
        return self.inputs[i]

    def get_sparsity_out(self, i: int) -> Any:
        return self.outputs[i]

    def eval(self, arguments: Any) -> list[Any]:
        return self.function(*arguments)
