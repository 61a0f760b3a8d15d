"""IPOPT (Wächter & Biegler 2006) on the problem's own sums: the solver of record.

CasADi hands IPOPT three functions that the engine evaluates: cost, gradient and Hessian
(Gauss-Newton, or exact on request). IPOPT's status is information, never proof: see certificate.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from casest.declaring.shapes import Array
from casest.solve.outcome import Outcome
from casest.stack import Point, Problem


def ipopt(
    problem: Problem,
    start: Point,
    *,
    exact: bool = False,
    options: dict[str, Any] | None = None,
) -> Outcome:
    """Minimise the cost from `start`. `exact` uses the exact Hessian instead of JᵀJ.

    Unknowns are scaled by their Jacobian columns and the cost by its start value. `options` are
    IPOPT's own.
    """
    began = time.perf_counter()
    scaled = _Scaled(problem, start, exact)
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
    z0 = start.x / scaled.scale
    lower, upper = problem.bounds
    solver = _solver(scaled, problem.unknowns, settings)
    with np.errstate(invalid="ignore"):
        found = solver(x0=z0, lbx=lower / scaled.scale, ubx=upper / scaled.scale)
    stats = solver.stats()
    z = np.array(found["x"]).ravel()
    # After Invalid_Option and the like IPOPT returns the start without a word: read its status.
    point = problem.moved(start, scaled.scale * z - start.x)
    return Outcome(
        "ipopt-exact" if exact else "ipopt",
        point,
        problem.cost(point),
        int(stats.get("iter_count", 0)),
        scaled.evaluations,
        bool(stats["success"]),
        str(stats["return_status"]),
        time.perf_counter() - began,
    )


class _Scaled:
    """Cost, gradient and Hessian in scaled unknowns z, remembering the last point."""

    def __init__(self, problem: Problem, start: Point, exact: bool) -> None:
        self.problem, self.start, self.exact = problem, start, exact
        first = problem.normal(start)
        self.unit = first.cost if np.isfinite(first.cost) and first.cost > 0 else 1.0
        columns = np.sqrt(np.maximum(np.diag(first.matrix), 0.0))
        usable = np.isfinite(columns) & (columns > 0)
        self.scale = np.where(usable, np.sqrt(2 * self.unit) / np.where(usable, columns, 1.0), 1.0)
        self.evaluations = 0
        self._z: Array | None = None
        self._normal = first

    def normal(self, z: Array) -> Any:
        """Normal equations at z (cached: IPOPT asks for cost, gradient, Hessian in turn)."""
        if self._z is None or not np.array_equal(z, self._z):
            self._z, self._normal = z.copy(), self.problem.normal(self.point(z))
            self.evaluations += 1
        return self._normal

    def point(self, z: Array) -> Point:
        """The point in the chart of the start (charts stay fixed while IPOPT runs)."""
        return Point(self.scale * z, self.start.references)

    def cost(self, z: Array) -> float:
        """Scaled cost alone."""
        if self._z is not None and np.array_equal(z, self._z):
            return float(self._normal.cost / self.unit)
        self.evaluations += 1
        return self.problem.cost(self.point(z)) / self.unit

    def gradient(self, z: Array) -> Array:
        """Gradient of the scaled cost, (n,)."""
        return np.asarray(self.normal(z).gradient * self.scale / self.unit)

    def hessian(self, z: Array) -> Array:
        """Hessian of the scaled cost, (n, n)."""
        matrix = self.problem.hessian(self.point(z)) if self.exact else self.normal(z).matrix
        return np.asarray(matrix * np.outer(self.scale, self.scale) / self.unit)


def _solver(scaled: _Scaled, n: int, settings: dict[str, Any]) -> Any:
    """An nlpsol whose functions are Python callbacks into the engine."""
    dense, triangle = ca.Sparsity.dense, ca.Sparsity.upper(n)
    x, none = dense(n, 1), dense(0, 1)
    rows, columns = triangle.row(), _columns(triangle)

    def gradient(z: Any, _p: Any) -> list[Any]:
        z = _vector(z)
        return [scaled.cost(z), scaled.gradient(z)]

    def hessian(z: Any, _p: Any, factor: Any, _g: Any) -> list[Any]:
        matrix = float(factor) * scaled.hessian(_vector(z))
        return [ca.DM(triangle, matrix[rows, columns])]

    cost_f = _Callback("f", lambda z: [scaled.cost(_vector(z))], [x], [dense(1, 1)])
    grad_f = _Callback("nlp_grad_f", gradient, [x, none], [dense(1, 1), x])
    hess_l = _Callback("nlp_hess_l", hessian, [x, none, dense(1, 1), none], [triangle])
    z, p = ca.MX.sym("x", n), ca.MX.sym("p", 0, 1)
    factor, g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0, 1)
    options = {
        "grad_f": ca.Function(
            "nlp_grad_f", [z, p], list(grad_f(z, p)), ["x", "p"], ["f", "grad_f_x"]
        ),
        "hess_lag": ca.Function(
            "nlp_hess_l",
            [z, p, factor, g],
            [hess_l(z, p, factor, g)],
            ["x", "p", "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        ),
        "no_nlp_grad": True,
        "calc_lam_p": False,
        "print_time": False,
        "ipopt": settings,
    }
    solver = ca.nlpsol("solver", "ipopt", {"x": z, "f": cost_f(z)}, options)
    # CasADi keeps no reference to Python callbacks: tie them to the solver's life.
    scaled.keep = (cost_f, grad_f, hess_l)  # type: ignore[attr-defined]
    return solver


def _columns(sparsity: Any) -> list[int]:
    return [int(c) for c in sparsity.get_triplet()[1]]


def _vector(z: Any) -> Array:
    return np.array(z, dtype=float).ravel()


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
