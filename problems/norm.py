"""Calibration to a constant norm: accelerometers at rest, magnetometers in a uniform field.

Ren & Liu, "Calibration of MEMS Accelerometers and Magnetometers for Rotor UAV Attitude
Estimation", eqs. (4)-(15); Burkhard, Sharma & Skaloud, "Linear Estimation of Deterministic
Accelerometer Errors", NAVIGATION 71(3), 2024, eqs. (1)-(7), in the notation of each.

corrected = scale·(v − offset) has the known length `norm`. The residual is taken in the unit of the
reading, (‖S(v−o)‖ − g)/‖Sᵀn‖ with n the corrected direction: it is, to first order, the noise of
the reading along n, and it does not vanish when the scale does. (‖S(v−o)‖ − g and its square both
tend to a smaller cost the further the solution collapses, for any data.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest import (
    Model,
    NotTrusted,
    Residual,
    Run,
    UsageError,
    constant,
    diag,
    diagonal,
    full,
    lower,
    model,
    norm_2,
    param,
    quantity,
    signal,
)

Array = NDArray[np.float64]

#: Orientations closer than this (degrees) count as one.
APART = 15.0
#: Distance from the sphere through the readings over its radius, root mean square: of noise in
#: three directions 0.37 to 0.42, in a plane 0.32 and more; of poses all over a sphere, seen with
#: scales as unequal as 1 : 0.4 : 0.4, 0.25 to 0.30, else less.
FILLED = 0.31
#: Share of their extent by which readings leave a plane, below which they lie in it.
FLAT = 1e-4
#: Rounding steps that the radius of a sphere of orientations exceeds.
STEPS = 3


def _norm_residual(corrected: Any, scale: Any, norm: float) -> Residual:
    """How far the corrected reading is from its known length, in the unit of the reading."""
    corrected = quantity("corrected", corrected, "[norm]")
    length = norm_2(corrected)
    # ‖c‖/‖Sᵀc‖ is 1/‖Sᵀn‖ in one division for the three of n = c/‖c‖.
    return Residual(
        implicit=(length - norm) * (length / norm_2(scale.T @ corrected)),
        unit="[v]",
        corrected=corrected,
        axes=("norm",),
    )


@model
def norm_diagonal(
    v=signal(3),
    *,
    scale=param(diagonal(3), "[norm]/[v]"),
    offset=param(3, "[v]"),
    norm=constant(1.0, "[v]"),
):
    """Scale of each axis and offset (Ren & Liu, eqs. 5-6): 6 unknowns.

    corrected = scale·(v − offset), each axis alone, and the length of corrected is `norm`. First
    the offset is taken away, in the unit of the reading. Scales are positive.
    """
    return _norm_residual(diag(scale) @ (v - offset), diag(scale), norm)


@model
def norm_triangular(
    v=signal(3),
    *,
    scale=param(lower(3), "[norm]/[v]"),
    offset=param(3, "[v]"),
    norm=constant(1.0, "[v]"),
):
    """Scale, non-orthogonality and offset (Burkhard et al., eq. 1, A = M⁻¹): 9 unknowns.

    corrected = scale·(v − offset), and the length of corrected is `norm`. First the offset is
    taken away, in the unit of the reading; then the matrix acts, lower triangular with positive
    diagonal: the corrected x axis is the sensor's own, and the sensor's y axis lies in the
    corrected x-y plane.
    """
    return _norm_residual(scale @ (v - offset), scale, norm)


@model
def norm_full(
    v=signal(3),
    *,
    scale=param(full(3), "[norm]/[v]"),
    offset=param(3, "[v]"),
    norm=constant(1.0, "[v]"),
):
    """Full 3×3 scale and offset (Ren & Liu, eq. 4): 12 unknowns, of which a norm sees 9.

    corrected = scale·(v − offset), and the length of corrected is `norm`.
    """
    return _norm_residual(scale @ (v - offset), scale, norm)


# -- Burkhard et al.: closed forms ------------------------------------------------------------


def readings(runs: Sequence[Run]) -> Array:
    """All readings v, (N, 3)."""
    return np.vstack([run.signals["v"] for run in runs])


def burkhard_full(z: Array, g: float) -> tuple[Array, Array]:
    """Full linear least squares: (A lower triangular, b) with ‖A(z − b)‖ = g, eqs. (2)-(6).

    z is (N, 3) with N ≥ 9 poses. The null vector of zᵀSz − 2zᵀr + d = 0 is found in units of the
    readings' size, so that the result does not depend on the unit of z. Raises NotTrusted where
    the quadric through the readings is no ellipsoid.
    """
    size = np.sqrt(np.mean(z**2))
    x, y, w = (z / size).T
    columns = [x * x, y * y, w * w, 2 * x * y, 2 * x * w, 2 * y * w, -2 * x, -2 * y, -2 * w, x**0]
    return _from_null_vector(np.column_stack(columns), list(range(6)), g, size)


def burkhard_diagonal(z: Array, g: float) -> tuple[Array, Array]:
    """The same without non-orthogonality: S diagonal, 7 columns, N ≥ 6 poses."""
    size = np.sqrt(np.mean(z**2))
    x, y, w = (z / size).T
    columns = [x * x, y * y, w * w, -2 * x, -2 * y, -2 * w, x**0]
    return _from_null_vector(np.column_stack(columns), list(range(3)), g, size)


def _from_null_vector(X: Array, quadratic: list[int], g: float, size: float) -> tuple[Array, Array]:
    theta = np.linalg.svd(X, full_matrices=X.shape[0] < X.shape[1])[2][-1]
    s, r, d = theta[quadratic], theta[-4:-1], theta[-1]
    S = np.diag(s[:3])
    if len(s) == 6:
        S[0, 1] = S[1, 0] = s[3]
        S[0, 2] = S[2, 0] = s[4]
        S[1, 2] = S[2, 1] = s[5]
    if np.trace(S) < 0:
        S, r, d = -S, -r, -d
    if np.min(np.linalg.eigvalsh(S)) <= 0:
        raise NotTrusted(
            "closed form: the readings do not lie near an ellipsoid (the fitted quadric is open); "
            "they cover too few orientations, or the axes are not those of one sensor"
        )
    b = np.linalg.solve(S, r)  # (4): needs neither g nor λ
    lam = g**2 / (b @ S @ b - d) / size**2  # (5), back in the unit of z
    if not lam > 0:
        raise NotTrusted(
            "closed form: the fitted ellipsoid is imaginary; the readings contradict it"
        )
    # λS = AᵀA with A lower triangular: the Cholesky factor of the matrix read backwards.
    flipped = np.linalg.cholesky(lam * S[::-1, ::-1])
    return flipped.T[::-1, ::-1], b * size


def burkhard_bias(z: Array, least: float | None = None) -> tuple[Array, float]:
    """Bias-only linear least squares: (b, radius), ‖z‖² = 2zᵀb + c, eq. (7). Needs no g.

    Along directions in which z spreads by less than the share `least` (None: rounding), b is 0.
    """
    size = np.sqrt(np.mean(z**2))
    u = z / size
    X = np.column_stack([2 * u, np.ones(len(u))])
    solution = np.linalg.lstsq(X, np.sum(u**2, axis=1), rcond=least)[0]
    b = solution[:3]
    return b * size, float(np.sqrt(max(solution[3] + b @ b, 0.0)) * size)


# -- Ren & Liu: six positions, and Levenberg-Marquardt on their own objective -------------------


def six_positions(v: Array, g: float) -> tuple[Array, Array]:
    """(scale, offset), each (3,), from poses with one axis up or down (Ren & Liu, IV).

    Poses are assigned by their largest component; several of one face are averaged. Exact only
    where an axis is aligned with gravity. Raises NotTrusted where a face is missing.
    """
    axis = np.argmax(np.abs(v - np.median(v, axis=0)), axis=1)
    scale, offset = np.zeros(3), np.zeros(3)
    for i, name in enumerate("xyz"):
        own = v[axis == i, i]
        middle = 0.5 * (own.min() + own.max()) if own.size else 0.0
        up, down = own[own > middle], own[own <= middle]
        if not up.size or not down.size:
            raise NotTrusted(f"six positions: no pose has {name} {'up' if not up.size else 'down'}")
        offset[i] = 0.5 * (up.mean() + down.mean())
        scale[i] = 2 * g / (up.mean() - down.mean())
    return scale, offset


def levenberg_marquardt(
    v: Array, g: float, A: Array, o: Array, free: Array, squared: bool, epsilon: float = 1e-10
) -> tuple[Array, Array, int]:
    """Ren & Liu's iteration (13) with the stop (15) on their objective (10) or the plain norm.

    `free` marks the entries of A that are unknown. λ is divided or multiplied by ten as the cost
    falls or rises. Returns (A, o, iterations). Both objectives have their global optimum at
    A → 0, so what comes out must be judged by another one.
    """
    x, damping = np.concatenate([o, A[free]]), 1e-3
    iterations = 0
    while iterations < 500:
        iterations += 1
        r, J = _paper_residual(x, v, g, free, squared)
        JtJ = J.T @ J
        while True:
            step = np.linalg.solve(JtJ + damping * np.diag(np.diag(JtJ) + 1e-300), -J.T @ r)
            trial = _paper_residual(x + step, v, g, free, squared)[0]
            if trial @ trial <= r @ r or damping > 1e12:
                break
            damping *= 10
        x, damping = x + step, max(damping / 10, 1e-15)
        if np.linalg.norm(step) < epsilon * (1 + np.linalg.norm(x)):
            break
    A = np.zeros((3, 3))
    A[free] = x[3:]
    return A, x[:3], iterations


def _paper_residual(
    x: Array, v: Array, g: float, free: Array, squared: bool
) -> tuple[Array, Array]:
    """‖A(v−o)‖² − g² of (10), or ‖A(v−o)‖ − g, with its Jacobian."""
    A = np.zeros((3, 3))
    A[free] = x[3:]
    d = v - x[:3]
    a = d @ A.T
    rows, columns = np.nonzero(free)
    J = np.hstack([-2 * a @ A, 2 * a[:, rows] * d[:, columns]])
    r = np.sum(a**2, axis=1)
    if squared:
        return r - g**2, J
    length = np.sqrt(r)
    return length - g, J / (2 * length[:, None])


# -- what casest calls ------------------------------------------------------------------------


def _values(declared: Model, A: Array, b: Array) -> dict[str, Array]:
    diagonal_only = declared.function.__name__ == "norm_diagonal"
    return {"scale": np.diag(A) if diagonal_only else A, "offset": b}


def _length(declared: Model) -> float:
    """The known length, or where the search for it starts."""
    symbol = declared["norm"]
    value = float(symbol.start_value()[0] if hasattr(symbol, "start_value") else symbol.array)
    if not value > 0:
        raise UsageError(f"norm = {value:g}: a length must be positive; --set norm=…")
    return value


def _known_scale(declared: Model) -> Array | None:
    fixed = {c.name: c.array for c in declared.constants}.get("scale")
    return None if fixed is None else (np.diag(fixed) if fixed.ndim == 1 else fixed)


def closed_form(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Burkhard's closed form for whichever of scale and offset is unknown."""
    z, g = readings(runs), _length(declared)
    known = _known_scale(declared)
    if known is not None:  # (7), in the corrected frame: ‖A z − A b‖ = g
        return {"offset": np.linalg.solve(known, burkhard_bias(z @ known.T)[0])}
    if declared.function.__name__ == "norm_diagonal":
        return _values(declared, *burkhard_diagonal(z, g))
    return _values(declared, *burkhard_full(z, g))


#: Exponents of x, y and w.
_Monomial = tuple[int, int, int]
_ONE, _X, _Y, _W = (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)
_XX, _YY, _WW, _XY, _XW, _YW = (2, 0, 0), (0, 2, 0), (0, 0, 2), (1, 1, 0), (1, 0, 1), (0, 1, 1)
#: Columns of the closed form's equations: θ = (s11, s22, 2·s12, 2·s13, 2·s23, −2r, d); what each
#: is the sum of. On the right stays −3w², on a sphere −‖z‖².
_SQUARES: tuple[dict[_Monomial, float], ...] = (
    {_XX: 1.0, _WW: -1.0}, {_YY: 1.0, _WW: -1.0}, {_XY: 1.0}, {_XW: 1.0}, {_YW: 1.0}
)  # fmt: skip
_REST: tuple[dict[_Monomial, float], ...] = ({_X: 1.0}, {_Y: 1.0}, {_W: 1.0}, {_ONE: 1.0})


def _moments(z: Array) -> dict[_Monomial, Array]:
    """Sums over samples (3, N, S) of the products of up to four readings, (S,).

    Each is summed once: the equations' own products would be twice as many.
    """
    _, count, width = z.shape
    found = {_X: np.zeros(width), _Y: np.zeros(width), _W: np.zeros(width)}  # from their mean
    found[_ONE] = np.full(width, float(count))
    x, y, w = z
    names = (_XX, _YY, _WW, _XY, _XW, _YW)
    q = np.empty((6, count, width))
    for row, (one, other) in enumerate(((x, x), (y, y), (w, w), (x, y), (x, w), (y, w))):
        np.multiply(one, other, out=q[row])
    found |= dict(zip(names, np.add.reduce(q, axis=1), strict=True))
    wanted = [(q[k], names[k], slice(k, 6)) for k in range(3)]
    wanted += [(x, _X, slice(6)), (y, _Y, slice(1, 3)), (y, _Y, slice(5, 6)), (w, _W, slice(2, 3))]
    for values, name, rows in wanted:
        sums = np.einsum("ps,jps->js", values, q[rows])
        for other, total in zip(names[rows], sums, strict=True):
            found.setdefault((name[0] + other[0], name[1] + other[1], name[2] + other[2]), total)
    return found


def _equations(z: Array, k: int) -> Array:
    """Normal equations with the right side as a last column, (n, n + 1, S); k of squares."""
    m = _moments(z)
    right = {_WW: 3.0} if k else {_XX: 1.0, _YY: 1.0, _WW: 1.0}
    columns = [*_SQUARES[:k], *_REST, right]
    n = len(columns) - 1
    A = np.zeros((n, n + 1, z.shape[2]))
    for i, one in enumerate(columns[:-1]):
        for j in range(i, n + 1):
            for a, p in one.items():
                for b, q in columns[j].items():
                    product = m[a[0] + b[0], a[1] + b[1], a[2] + b[2]]
                    A[i, j] += product if p * q == 1.0 else p * q * product
    return A


def closed_form_many(declared: Model, signals: Mapping[str, Array]) -> dict[str, Any]:
    """Burkhard's closed form for many sensors at once: where `calibrate_many` starts.

    v is (S, N, 3); returns scale (S, …) and offset as (value, lower, upper), bounded as by
    `inside_the_ball`. As (4) and (5), but in readings from which their mean is taken, and with the
    trace of S held instead of the length of θ, so that normal equations do. A sphere around the
    mean where that gives no ellipsoid.
    """
    v, g = np.ascontiguousarray(np.transpose(signals["v"], (2, 1, 0))), _length(declared)
    ball = np.sqrt(np.max(np.einsum("ips,ips->ps", v, v), axis=0))[:, None]
    known = _known_scale(declared)
    z = v if known is None else np.einsum("ij,jns->ins", known, v)
    middle = np.mean(z, axis=1)
    k = 0 if known is not None else 2 if declared.function.__name__ == "norm_diagonal" else 5
    A = _equations(z - middle[:, None], k)
    n = len(A)
    spread = (A[k, k] + A[k + 1, k + 1] + A[k + 2, k + 2]) / v.shape[1]
    for i in range(n):  # Cholesky, on the upper triangle and the right side
        if i:
            A[i, i:] -= np.einsum("ks,kjs->js", A[:i, i], A[:i, i:])
        A[i, i:] /= np.sqrt(A[i, i])
    theta = -A[:, n]
    for i in range(n - 1, -1, -1):
        theta[i] -= np.einsum("ks,ks->s", A[i, i + 1 : n], theta[i + 1 :])
        theta[i] /= A[i, i]
    # S = LᵀL with L lower triangular, from its last entry on (each row: all sensors).
    S = np.zeros((3, 3, v.shape[2])) + np.eye(3)[:, :, None]
    if k:
        S[0, 0], S[1, 1], S[2, 2] = theta[0], theta[1], 3 - theta[0] - theta[1]
    if k == 5:
        S[0, 1], S[0, 2], S[1, 2] = theta[2:5] / 2
    L, b = np.zeros_like(S), theta[k : k + 3] / -2
    for i in (2, 1, 0):
        for j in range(i + 1):
            L[i, j] = S[j, i] - np.sum(L[i + 1 :, i] * L[i + 1 :, j], axis=0)
        L[i, : i + 1] /= np.sqrt(L[i, i])
    for i in (2, 1, 0):  # Lᵀy = r, and then Lb = y
        b[i] = (b[i] - np.sum(L[i + 1 :, i] * b[i + 1 :], axis=0)) / L[i, i]
    square = np.sum(b**2, axis=0) - theta[-1]
    for i in range(3):
        b[i] = (b[i] - np.sum(L[i, :i] * b[:i], axis=0)) / L[i, i]
    good = np.isfinite(b).all(axis=0) & (square > 0)
    L = np.where(good, L, np.eye(3)[:, :, None]) * (g / np.sqrt(np.where(good, square, spread)))
    offset = (np.where(good, b, 0.0) + middle).T
    if known is not None:
        return {"offset": (offset @ np.linalg.inv(known).T, -ball, ball)}
    scale = np.einsum("iis->si", L) if k == 2 else L.transpose(2, 0, 1)
    return {"scale": scale, "offset": (offset, -ball, ball)}


def bias_only(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Burkhard's bias-only closed form: the scale is one number for all axes, g over the radius."""
    b, radius = burkhard_bias(readings(runs))
    return _values(declared, np.eye(3) * _length(declared) / radius, b)


def six_position(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Ren & Liu's closed form for six aligned poses."""
    scale, offset = six_positions(readings(runs), _length(declared))
    return _values(declared, np.diag(scale), offset)


def _paper(declared: Model, runs: Sequence[Run], squared: bool) -> dict[str, Array]:
    v, g = readings(runs), _length(declared)
    free = np.eye(3, dtype=bool)
    if declared.function.__name__ != "norm_diagonal":
        free = np.tri(3, dtype=bool)
    b, radius = burkhard_bias(v)
    A, o, _ = levenberg_marquardt(v, g, np.eye(3) * g / radius, b, free, squared)
    return _values(declared, A, o)


def ren_liu(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Ren & Liu's objective (10) with their iteration (13) and stop (15)."""
    return _paper(declared, runs, squared=True)


def plain_norm(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """The same iteration on ‖S(v−o)‖ − g."""
    return _paper(declared, runs, squared=False)


def automatic_start(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Closed form where it exists, else a sphere through the readings."""
    try:
        return closed_form(declared, runs)
    except NotTrusted:
        return bias_only(declared, runs)


def inside_the_ball(declared: Model, runs: Sequence[Run]) -> dict[str, tuple[Any, Any]]:
    """The offset lies inside the ball that the readings span: the collapsed solution does not."""
    radius = float(np.max(np.linalg.norm(readings(runs), axis=1)))
    return {"offset": (-radius, radius)}


def _sphere(v: Array) -> tuple[Array, float]:
    """Directions (N, 3) of readings from the centre of the sphere through them, and its radius.

    The zero of the readings, of raw counts say, does not matter.
    """
    z = v - v.mean(axis=0)
    if not np.any(z):
        return np.zeros_like(z), 0.0
    b, radius = burkhard_bias(z, FLAT)
    return (z - b) / max(radius, 1e-300), radius


def _orientations(v: Array, enough: int, least: float = 0.0) -> int:
    """Orientations further than APART from each other, counted up to enough.

    Readings that fill the sphere through them, instead of lying on it, are the noise of one
    orientation. `least` is the smallest radius that the sphere can have, in the unit of v.
    """
    u, radius = _sphere(v)
    # Four unknowns are fitted: centre and radius.
    away = np.sum((np.linalg.norm(u, axis=1) - 1) ** 2) / max(len(v) - 4, 1)
    if not radius or np.sqrt(away) > FILLED or _rounded(v, radius):
        return 1
    left, count = u[:: max(1, len(v) // 2000)] * min(1.0, radius / max(least, 1e-300)), 0
    while len(left) and count < enough:
        chord = np.linalg.norm(left - left[0], axis=1)
        left, count = left[chord > 2 * np.sin(np.radians(APART) / 2)], count + 1
    return count


def _rounded(v: Array, radius: float) -> bool:
    """Are these few readings over and over, some steps of their rounding apart?"""
    if 2 * len(np.unique(v, axis=0)) > len(v):
        return False
    steps = np.diff(np.sort(v, axis=0), axis=0)
    steps = steps[steps > 1e-9 * np.abs(v).max()]
    return bool(radius < STEPS * steps.min(initial=np.inf))


def remarks(declared: Model, runs: Sequence[Run], values: dict[str, Array]) -> list[str]:
    """What an engineer would notice: a unit mixed up, poses in a plane, a record in motion."""
    v, norm = readings(runs), _length(declared)
    found = []
    unit = runs[0].units.get("v")
    symbol = declared["norm"]
    length = float(np.median(np.linalg.norm(v, axis=1)))
    other = unit if symbol.unit == "[v]" else symbol.unit
    alike = None if unit in (None, "count") else runs[0].in_unit("v", str(other))
    times = 1.0 if alike is None else float(np.median(np.linalg.norm(alike, axis=1))) / norm
    if not 1 / 3 < times < 3:
        both = f"({norm:g}), both in {unit}" if other == unit else f"({norm:g} {other})"
        found.append(
            f"readings are {times:.3g} times the norm {both}: is "
            f"one of the two in another unit? (--unit v=…, --set 'norm=… {unit}')"
        )
    elif unit is None and norm == 1 and 9 < length < 11:
        found.append(
            f"readings are {length:.3g} long, and norm is 1: if they are in m/s^2, say --unit "
            "v=m/s^2 --set 'norm=9.80665 m/s^2'"
        )
    spread = np.linalg.svd(v - v.mean(axis=0), compute_uv=False) / np.sqrt(len(v))
    unknowns = sum(p.shape.size for p in declared.parameters)
    poses = _orientations(
        v, max(unknowns, 2), norm / 3 if alike is not None and other == unit else 0.0
    )
    if poses == 1:
        found.append("the readings never leave one orientation: turn the sensor")
    elif poses < unknowns:
        found.append(
            f"these are {poses} different orientations (more than {APART:g} degrees apart) for "
            f"{unknowns} unknowns: hold the sensor in more, or declare fewer unknowns"
            + (" (norm-diagonal has 6)" if declared.name == "norm-triangular" else "")
        )
    elif spread[2] < 0.15 * spread[0]:
        found.append(
            f"the readings lie close to a plane (thickness {spread[2] / spread[0]:.1%} of their "
            "extent): tilt the sensor about another axis too"
        )
    if np.all(runs[0].count == 1) and len(v) > 1000 and unit in ("m/s^2", "g"):
        found.append("single readings are used as they are: if the sensor moved, add --at-rest")
    return found


def _complete(declared: Model) -> Model:
    declared = (
        declared.starting(automatic_start, many=closed_form_many)
        .bounded(inside_the_ball)
        .remarking(remarks)
    )
    named = {
        "closed-form": closed_form,
        "bias-only": bias_only,
        "six-position": six_position,
        "ren-liu": ren_liu,
        "plain-norm": plain_norm,
    }
    for name, function in named.items():
        declared = declared.with_estimator(name, function)
    return declared


norm_diagonal = _complete(norm_diagonal)
norm_triangular = _complete(norm_triangular)
norm_full = _complete(norm_full)
