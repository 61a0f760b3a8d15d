"""What a problem asks of a model for one sample, ready to be evaluated over all of them.

Kept per model: many problems may have the same one, and building an evaluation takes longer than a
small fit.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import casadi as ca
import numpy as np

from casest.declaration.model import Model
from casest.declaration.tracing import function_of, sample_symbol
from casest.engine import Replay


@lru_cache(maxsize=64)
def residual_and_jacobian(model: Model) -> Replay:
    """r and ∂r/∂x of one sample; kept, for many problems may have the same model."""
    t = model.traced
    J = ca.jacobian(t.expression, t.coordinates)
    return Replay(function_of(model, {"r": t.expression, "J": J}), grouped=(0, 1))


@lru_cache(maxsize=64)
def linear(model: Model) -> bool:
    """Is the residual linear in all unknowns, none of them a direction or rotation?"""
    t = model.traced
    if any(p.shape.curved for p in model.parameters):
        return False
    if model.sequential:
        return False
    return not ca.depends_on(ca.jacobian(t.expression, t.coordinates), t.coordinates)


@lru_cache(maxsize=64)
def laplacian(model: Model) -> Replay:
    """Σ ∂²r/∂s² over the numbers of each signal, (m, signals): for each residual and signal."""
    sample, expression = sample_symbol(model), model.traced.expression
    rows = []
    for i in range(expression.numel()):
        second = ca.diag(ca.hessian(expression[i], sample)[0])
        ends = np.cumsum([0, *(s.size for s in model.signals)])
        rows.append([ca.sum1(second[a:b]) for a, b in pairwise(ends.tolist())])
    return Replay(function_of(model, {"L": ca.densify(ca.blockcat(rows))}))


@lru_cache(maxsize=64)
def slope_in_sample(model: Model) -> Replay:
    """∂r/∂s of one sample with respect to its signals, (m, k)."""
    slope = ca.jacobian(model.traced.expression, sample_symbol(model))
    return Replay(function_of(model, {"G": slope}))
