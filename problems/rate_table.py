"""A rate table whose vertical is unknown calibrates an accelerometer.

P. Batista, C. Silvestre, P. Oliveira, B. Cardeira, "Accelerometer Calibration and Dynamic Bias and
Gravity Estimation: Analysis, Design, and Experimental Evaluation", model (2)-(5), Table I.

The table gives the attitude (body to table frame) but stands on a floor that nobody levelled: the
direction of gravity in the table frame is unknown, its magnitude known. At rest a = −g. The sign of
the singular vector is fixed by det F > 0: a table may hang upside down, a sensor frame may not
flip.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import (
    Model,
    NotTrusted,
    Residual,
    Run,
    attitude,
    constant,
    full,
    inverse,
    model,
    param,
    quantity,
    signal,
    sqrt,
    unit_vector,
)

Array = NDArray[np.float64]


@model
def rate_table(
    a=signal(3, "m/s^2"),
    attitude=attitude(),
    *,
    inverse_scale=param(full(3)),
    quadratic=param(3, "1/(m/s^2)"),
    bias=param(3, "m/s^2"),
    gravity_direction=param(unit_vector, start=(0.0, 0.0, 1.0)),
    gravity=constant(9.80665, "m/s^2"),
):
    """Scale, cross-axis, quadratic response and bias on a rate table (Batista, eqs. 2-5).

    inverse_scale·a = force + quadratic·force² + bias; gravity_direction points down, in the table
    frame; the force at rest is −gravity.
    """
    down = attitude.T @ (gravity * gravity_direction)
    force = quantity("specific_force", -down, "m/s^2")
    bent = force + quadratic * force**2
    reading = quantity("reading", inverse(inverse_scale) @ (bent + bias), "m/s^2")
    return Residual(measured=a, predicted=reading, corrected=force)


def corrected_force(values: dict[str, Any], a: Any) -> Any:
    """Closed-form inverse: the root of f + q·f² = u that tends to u as q tends to zero.

    u = F⁻¹a − b′; f = 2u/(1 + √(1 + 4qu)), which needs no division by q. Beyond 1 + 4qu = 0 the
    model has no answer (NaN).
    """
    u = values["inverse_scale"] @ a - values["bias"]
    return 2 * u / (1 + sqrt(1 + 4 * values["quadratic"] * u))


# -- Table I: two stages of singular value decompositions ------------------------------------------


def two_stage(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Batista's iteration: the quadratic term from the last gravity, until that stays.

    Several runs share F, F2 and the direction; each has a bias column of its own where `bias` is
    declared per run. Parameters that are held keep their place: they are estimated all the same
    and left out. Raises NotTrusted where the attitudes determine no unique null vector.
    """
    g = _gravity(declared)
    per_run = any(p.name == "bias" and p.scope == "run" for p in declared.parameters)
    groups = len(runs) if per_run else 1
    found = _normalised(_null_vector(_stack(runs, None, groups)), g, quadratic=False)
    for _ in range(100):
        before = found["gravity"]
        vector = _null_vector(_stack(runs, before, groups))
        found = _normalised(vector, g, quadratic=True)
        if np.linalg.norm(found["gravity"] - before) < 1e-12 * g:
            break
    bias = found["bias"].reshape(groups, 3)
    return {
        "inverse_scale": found["inverse_scale"],
        "quadratic": found["quadratic"],
        "bias": bias if per_run and groups > 1 else bias[0],
        "gravity_direction": found["gravity"] / np.linalg.norm(found["gravity"]),
    }


def _gravity(declared: Model) -> float:
    symbol = declared["gravity"]
    return float(symbol.start_value()[0] if hasattr(symbol, "start_value") else symbol.array)


def _stack(runs: Sequence[Run], gravity: Array | None, groups: int) -> Array:
    """X of stage one, or X₂ with the squares of the last gravity: three rows a sample."""
    parts = []
    for k, run in enumerate(runs):
        readings, R = run.signals["a"], run.signals["attitude"].reshape(-1, 3, 3)
        n = len(readings)
        readings_block = np.zeros((n, 3, 9))
        for i in range(3):
            readings_block[:, i, 3 * i : 3 * i + 3] = readings
        blocks = [readings_block, R.transpose(0, 2, 1)]
        if gravity is not None:
            square = (R.transpose(0, 2, 1) @ gravity) ** 2
            blocks.append(-square[:, :, None] * np.eye(3))
        own = np.zeros((n, 3, 3 * groups))
        column = 3 * min(k, groups - 1)
        own[:, :, column : column + 3] = -np.eye(3)
        parts.append(np.concatenate([*blocks, own], axis=2).reshape(3 * n, -1))
    return np.vstack(parts)


def _null_vector(X: Array) -> Array:
    """The right singular vector of the least singular value, of unit columns."""
    R = np.linalg.qr(X, mode="r")
    singular, Vt = np.linalg.svd(R)[1:]
    if len(singular) > 1 and singular[-2] < 1e-9 * singular[0]:
        raise NotTrusted("two-stage: these attitudes leave more than one solution; vary them")
    return np.asarray(Vt[-1])


def _normalised(x: Array, g: float, *, quadratic: bool) -> dict[str, Array]:
    """Scaled so that gravity has its known length and det F > 0."""
    gravity = x[9:12]
    scale = g / np.linalg.norm(gravity)
    scale *= np.sign(np.linalg.det(x[:9].reshape(3, 3)))
    x = scale * x
    rest = x[12:]
    return {
        "inverse_scale": x[:9].reshape(3, 3),
        "gravity": x[9:12],
        "quadratic": rest[:3] if quadratic else np.zeros(3),
        "bias": rest[3:] if quadratic else rest,
    }


rate_table = (
    rate_table.starting(two_stage)
    .with_estimator("two-stage", two_stage)
    .with_inverse(corrected_force)
)
