"""What the curvature of a model makes of noise that was stated: a shift of every residual.

True values are found to first order. Along the model, where noise is not seen, it stays in them, of
covariance T = C - CGᵀV⁻¹GC; on a curve that lets the residual be ½tr(HT) on average, H = ∂²r/∂s².
(On a circle: readings lie outside of it by σ²/2R.)
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.noise import ROOT, TRUE
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat, function_of, trace
from casest.engine import Columns, Replay


def bent(model: Model, parameters: Array, run: Run, pull: Array, inverse: Array) -> Array:
    """Mean (N, m) of each residual that comes of curvature, in its unit, at a run's true values.

    `pull` CGᵀ (N, k, m) and `inverse` V⁻¹ (N, m, m) are those there; the model is without noise.
    """
    groups = [name for name in run.signals if name.startswith(ROOT)]
    names = tuple(n for group in groups for n in group.removeprefix(ROOT).split(","))
    ends = np.cumsum([0, *(run.signals[name].shape[1] for name in names)])
    parts = dict(zip(names, np.split(run.signals[TRUE], ends[1:-1], axis=1), strict=True))
    samples = Columns([parts.get(s.name, run.signals[s.name]) for s in model.signals])
    (found,) = _bend(model, names)(parameters, samples)
    n, k, m = pull.shape
    H = found.reshape(n, m, k, k)
    mean = -np.einsum("nka,nmkl,nlb,nab->nm", pull, H, pull, inverse, optimize=True)
    first = 0
    for group in groups:
        of = group.removeprefix(ROOT).split(",")
        last = first + sum(run.signals[n].shape[1] for n in of)
        mean += _trace(H[:, :, first:last, first:last], run.signals[group])
        first = last
    return np.asarray(0.5 * mean)


def _trace(H: Array, root: Array) -> Array:
    """tr(HC) (N, m) over one signal, C from standard deviations (N, k) or roots (N, k²)."""
    k = H.shape[2]
    if root.shape[1] == k:
        return np.asarray(np.einsum("nmkk,nk->nm", H, root**2))
    matrix = root.reshape(-1, k, k)
    return np.asarray(np.einsum("nmkl,nkl->nm", H, matrix @ np.swapaxes(matrix, 1, 2)))


@lru_cache(maxsize=64)
def _bend(model: Model, names: tuple[str, ...]) -> Replay:
    """Second derivatives (m, k²) of a residual without stated noise in its noisy signals."""
    plain = trace(model)
    reading = ca.vertcat(*[flat(plain.symbols[name]) for name in names])
    each = [plain.expression[i] for i in range(plain.expression.numel())]
    rows = [ca.vec(ca.hessian(e, reading)[0]).T for e in each]
    return Replay(function_of(model, {"H": ca.densify(ca.vertcat(*rows))}, plain))
