"""Solvers that casest does not rely on, for comparison: SciPy's and CasADi's sqpmethod.

All see what IPOPT sees: the same residuals and derivatives from the engine, the chart of the start,
unknowns scaled by their Jacobian columns, and tolerances near rounding. SciPy needs the whole
Jacobian in memory at once, casest's own solvers do not.
"""

from __future__ import annotations

import time
from typing import Any, Literal

import numpy as np

from casest.declaration.shapes import Array
from casest.errors import UsageError
from casest.leastsquares.problem import Point, Problem
from casest.solve.ipopt import run_nlpsol
from casest.solve.outcome import Outcome

Method = Literal["lm", "trf", "dogbox"]
#: Methods of `scipy.optimize.least_squares`; only the last two know bounds.
METHODS: tuple[Method, ...] = ("lm", "trf", "dogbox")
#: Numbers in a dense Jacobian above which SciPy is refused: with its copies about 4 GB.
DENSE = 100_000_000
#: Relative change of cost, unknowns and gradient below which SciPy stops.
FINE = 1e-12


def scipy_solver(problem: Problem, start: Point, method: Method) -> Outcome:
    """Minimise by SciPy's `lm` (MINPACK), `trf` or `dogbox`, with the analytic Jacobian.

    `lm` ignores the bounds. Iterations are Jacobian evaluations, as SciPy counts no others. Raises
    UsageError where the dense Jacobian would not fit into memory, ValueError or LinAlgError where
    SciPy does.
    """
    from scipy.optimize import least_squares

    _refuse_large(problem, method)
    began = time.perf_counter()
    dense = _Dense(problem, start)
    limits: dict[str, Any] = {} if method == "lm" else {"bounds": problem.bounds}
    with np.errstate(all="ignore"):
        found = least_squares(
            dense.residual,
            start.x,
            dense.jacobian,
            method=method,
            x_scale="jac",
            ftol=FINE,
            xtol=FINE,
            gtol=FINE,
            **limits,
        )
    point = problem.moved(start, found.x - start.x)
    return Outcome(
        f"scipy-{method}",
        point,
        problem.cost(point),
        int(found.njev or 0),
        int(found.nfev),
        bool(found.success),
        str(found.message),
        time.perf_counter() - began,
    )


def _refuse_large(problem: Problem, method: str) -> None:
    numbers = problem.residual_count * problem.unknowns
    if numbers > DENSE:
        raise UsageError(
            f"scipy-{method} needs the whole Jacobian, {numbers:.2g} numbers "
            f"({8e-9 * numbers:.2g} GB, and copies of it); compare on a shorter record"
        )


class _Dense:
    """Weighted residuals and Jacobian of all samples, in the chart of the start.

    Behind them what is known before, and constraints, as all solvers see them.
    """

    def __init__(self, problem: Problem, start: Point) -> None:
        self.problem, self.references = problem, start.references
        self.root: Array | None = None
        if problem.weights is not None:
            self.root = np.sqrt(np.concatenate([w.ravel() for w in problem.weights]))

    def residual(self, x: Array) -> Array:
        """All residuals, (residuals,)."""
        point = Point(x, self.references)
        whole = np.concatenate([part.ravel() for part in self.problem.residuals(point)])
        whole = whole if self.root is None else self.root * whole
        return np.concatenate([whole, self.problem.rows_beyond(point)[:, -1]])

    def jacobian(self, x: Array) -> Array:
        """The whole Jacobian, (residuals, n)."""
        point = Point(x, self.references)
        whole = self.problem.jacobian(point)
        if self.root is not None:
            whole *= self.root[:, None]
        return np.vstack([whole, self.problem.rows_beyond(point)[:, :-1]])


def sqpmethod(problem: Problem, start: Point) -> Outcome:
    """Minimise by CasADi's own SQP with the Gauss-Newton Hessian; qrqp solves the subproblems."""
    silent = {f"print_{what}": False for what in ("iter", "header", "info")}
    settings = {
        "qpsol": "qrqp",
        "qpsol_options": {**silent, "error_on_fail": False},
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
        "max_iter": 500,
        "tol_du": 1e-8,  # as for IPOPT
    }
    return run_nlpsol("sqpmethod", problem, start, settings)
