"""Plans beside known optima, and what planned poses are worth beside random and usual ones.

    make study-plans       # python studies/plans.py: some minutes on one core

The table is written to `studies/plans.md`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from casest import Run, attempt, calibrate_many, constant, exp, param, signal
from casest.dynamics import Motion as Motions
from casest.dynamics import dynamics, measured, state
from casest.dynamics.gramian import gramian, observed
from casest.dynamics.transition import linearised
from casest.plan.candidates.candidates import Candidates, Noise
from casest.plan.candidates.finding import Possible, candidates
from casest.plan.candidates.runs import runs
from casest.plan.design.continuous import continuous, information
from casest.plan.design.criteria import Trace, Volume, inverse
from casest.plan.motion.criteria import Wanted
from casest.plan.motion.experiment import planned_experiment
from casest.plan.motion.grid import Grid
from casest.plan.motion.limits import limits_of
from casest.plan.motion.planning import planned_motion
from casest.plan.motion.program import Task as Motion
from casest.plan.planning import criterion_of, planned, task
from casest_problems.bias_gravity import bias_gravity
from casest_problems.norm import norm_diagonal, norm_triangular
from casest_problems.pair import norm_pair
from casest_problems.rate_table import rate_table
from casest_problems.wheel import wheel

Array = NDArray[np.float64]
TABLE = Path(__file__).resolve().parent / "plans.md"
#: Sensors of each model, poses of each plan, noise in the model's unit.
SENSORS, POSES = 200, 24


# -- known optima ----------------------------------------------------------------------------------


def polynomials() -> Iterator[str]:
    """D-optimal for a polynomial on [−1, 1]: ±1 and the roots of P'_d, equal weights (Guest)."""
    yield "| degree | points found | largest distance from the published | weights off by | det |"
    yield "| --- | --- | --- | --- | --- |"
    for d in (2, 3, 4, 5, 6):
        roots = np.polynomial.legendre.Legendre.basis(d).deriv().roots()
        optimum = np.sort([-1.0, *roots, 1.0])
        grid = np.unique(np.round(np.append(np.linspace(-1, 1, 2001), roots), 12))
        factors = np.polynomial.legendre.legvander(grid, d)[:, None, :]
        found = continuous(Volume(), 1e-12 * np.eye(d + 1), factors, 1.0, close=1e-7)
        near = np.abs(grid[:, None] - optimum)
        own = np.argmin(near, axis=1)
        taken = found.weights > 1e-6
        weights = np.bincount(own[taken], found.weights[taken], d + 1)
        middle = np.bincount(own[taken], (found.weights * grid)[taken], d + 1) / weights
        exact = np.isin(grid, np.round(optimum, 12)) / (d + 1)
        best = Volume().value(inverse(information(1e-12 * np.eye(d + 1), factors, exact)))
        yield (
            f"| {d} | {', '.join(f'{x:.4f}' for x in middle)} | "
            f"{np.abs(middle - optimum).max():.1e} | {np.abs(weights - 1 / (d + 1)).max():.1e} | "
            f"{np.exp(best - found.value):.8f} of the optimum's |"
        )


def sphere() -> Iterator[str]:
    """On a sphere the uniform design is D-optimal; the icosahedron is a spherical 5-design."""
    golden = (1 + 5**0.5) / 2
    corners = np.array([[0, s, t * golden] for s in (1, -1) for t in (1, -1)])
    corners = np.vstack([np.roll(corners, k, axis=1) for k in range(3)]) / np.hypot(1, golden)
    found = made(norm_triangular.having(norm=1.0))
    best = continuous(Volume(), 1e-10 * np.eye(9), found.factors, 1.0, close=1e-4)
    ico = slopes_of_norm(corners)
    value = Volume().value(inverse(1e-10 * np.eye(9) + np.einsum("nm,nk->mk", ico, ico) / 12))
    yield (
        f"norm-triangular, {len(found)} poses in steps of 15°: the best continuous design has "
        f"{100 * np.exp((value - best.value) / 18):.3f} % of the icosahedron's efficiency (optimal "
        f"over the whole sphere), its bound {100 * np.exp((value - best.floor) / 18):.3f} %."
    )
    given = task(*_six())
    plan = planned(given, criterion_of(given, "D"), 6)
    up = made(norm_diagonal.having(norm=1.0)).up
    assert up is not None
    yield (
        "norm-diagonal, six poses: "
        + ", ".join(made(norm_diagonal.having(norm=1.0)).words[i] for i in plan.chosen)
        + f"; certified {100 * plan.share:.2f} % of the best possible."
    )


def _six() -> tuple[Array, Array, tuple[str, ...], str]:
    found = made(norm_diagonal.having(norm=1.0))
    return found.factors, np.zeros((6, 6)), found.names, "norm-diagonal"


def slopes_of_norm(up: Array) -> Array:
    """Of the residual of norm-triangular at scale 1 and offset 0, by hand: u_i u_j and −u."""
    x, y, z = up.T
    return np.column_stack([x * x, y * x, y * y, z * x, z * y, z * z, -x, -y, -z])


def rivals() -> Iterator[str]:
    """Atkinson & Fedorov 1975, example 1: 4.5 − 1.5eˣ − 2e⁻ˣ against a parabola."""
    grid = np.linspace(-1, 1, 4001)
    truth = 4.5 - 1.5 * np.exp(grid) - 2 * np.exp(-grid)
    factors = np.column_stack([np.ones_like(grid), grid, grid**2, truth])[:, None, :]
    found = continuous(
        Trace(np.array([[0.0], [0], [0], [1]])), 1e-13 * np.eye(4), factors, 1.0, close=1e-8
    )
    published = np.array([-1.0, -0.669, 0.144, 0.957])
    own = np.argmin(np.abs(grid[:, None] - published), axis=1)
    taken = found.weights > 1e-6
    weights = np.bincount(own[taken], found.weights[taken], 4)
    middle = np.bincount(own[taken], (found.weights * grid)[taken], 4) / weights
    yield "| | points | weights | Δ |"
    yield "| --- | --- | --- | --- |"
    yield "| published | −1, −0.669, 0.144, 0.957 | 0.253, 0.428, 0.247, 0.072 | 1.087e-3 |"
    yield (
        f"| casest | {', '.join(f'{x:.3f}' for x in middle)} | "
        f"{', '.join(f'{w:.3f}' for w in weights)} | {1 / found.value:.4e} |"
    )


#: Pyomo.DoE's reactor A → B → C: nominal values, and its prior (its test_reactor_example).
NOMINAL = (84.79085853498033, 371.71773413976416, 7.777032028026428, 15.047135137500822)
PRIOR = np.array([
    [28.67892806, 5.41249739, -81.73674601, -24.02377324],
    [5.41249739, 26.40935036, -12.41816477, -139.23992532],
    [-81.73674601, -12.41816477, 240.46276004, 58.76422806],
    [-24.02377324, -139.23992532, 58.76422806, 767.25584508],
])  # fmt: skip


#: Radau's collocation with three points (Hairer & Wanner 1996, table 5.6).
ROOT6 = 6**0.5
RADAU = np.array([
    [(88 - 7 * ROOT6) / 360, (296 - 169 * ROOT6) / 1800, (-2 + 3 * ROOT6) / 225],
    [(296 + 169 * ROOT6) / 1800, (88 + 7 * ROOT6) / 360, (-2 - 3 * ROOT6) / 225],
    [(16 - ROOT6) / 36, (16 + ROOT6) / 36, 1 / 9],
])  # fmt: skip


def reactor() -> Any:
    """Slopes of all concentrations, times the nominal values, of CA0 and the temperatures.

    As published: 32 elements; at a time of control the last point has the next temperature.
    """
    p, T, start = ca.SX.sym("p", 4), ca.SX.sym("T", 9), ca.SX.sym("CA0")
    a, b, seen = start, ca.SX(0), [start, ca.SX(0), ca.SX(0)]
    hA, one = ca.DM(RADAU / 32), ca.DM.eye(3)
    for e in range(32):
        now, then = T[e // 4], T[(e + 1) // 4]
        temperature = ca.vertcat(now, now, then)
        k1, k2 = (p[i] * ca.exp(-p[i + 2] * 1000 / 8.31446261815324 / temperature) for i in (0, 1))
        first = ca.solve(one + hA @ ca.diag(k1), a * ca.DM.ones(3))
        second = ca.solve(one + hA @ ca.diag(k2), b + hA @ (k1 * first))
        a, b = first[2], second[2]
        seen += [a, b, start - a - b] if e % 4 == 3 else []
    J = ca.jacobian(ca.vertcat(*seen), p) @ ca.diag(p)
    return ca.Function("slopes", [start, T, p], [J])


def pyomo() -> Iterator[str]:
    """The D-optimal experiment after a prior: published 579.21 K first, 300 K then."""
    f = reactor()

    def slopes(c: float, first: float) -> Array:
        return np.array(f(c, [first] + [300.0] * 8, NOMINAL))

    base = slopes(5, 300)
    M = base.T @ base
    firsts = np.arange(300, 700.5, 0.5)
    starts = np.arange(1, 5.01, 0.5)
    grid = [(c, t) for c in starts for t in firsts]
    factors = np.array([slopes(c, t) for c, t in grid])
    given = task(factors, PRIOR, ["A1", "A2", "E1", "E2"], "reactor")
    plan = planned(given, criterion_of(given, "D"), 1)
    c, t = grid[plan.chosen[0]]
    after = PRIOR + factors[plan.chosen[0]].T @ factors[plan.chosen[0]]
    yield "| | published (Pyomo's tests) | casest |"
    yield "| --- | --- | --- |"
    yield f"| log10 trace at CA0 = 5, 300 K | 2.96 | {np.log10(np.trace(M)):.3f} |"
    yield f"| its entry (A1, A2) | 1.84 | {M[0, 1]:.3f} |"
    yield f"| its entry (A1, E1) | −70.238 | {M[0, 2]:.3f} |"
    yield f"| best first temperature, K | 579.212 | {t:.1f} (grid of 0.5; CA0 = {c:g}) |"
    yield f"| log10 trace after | 3.214432 | {np.log10(np.trace(after)):.6f} |"
    yield f"| log10 det after | 6.214118 | {np.linalg.slogdet(after)[1] / np.log(10):.6f} |"


# -- motions and experiments -----------------------------------------------------------------------

#: Limits of a small vehicle that stays about where it is.
LIMITS = [
    ("a", "12 m/s^2"),
    ("omega", "30 deg/s"),
    ("rate of omega", "30 deg/s^2"),
    ("velocity", "0.5 m/s"),
    ("rate of velocity", "1 m/s^2"),
]


def motion() -> Iterator[str]:
    """60 s of Batista's estimator at 50 Hz, v read with 0.01 m/s, planned, random and hovering."""
    model = bias_gravity.sensing(v=0.01**2 / 50)
    yield (
        "| criterion | rank | std over that of the median of 20 random motions | gravity, m/s² | "
        "bias, m/s² | largest share of a limit | processor s |"
    )
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for name, seed in (("D", 0), ("D", 1), ("A", 0), ("E", 0), ("bias", 0)):
        began = time.process_time()
        grid = Grid.of(60.0, 30, 30, False)
        given = Motion(
            model, Wanted.of(model, name), limits_of(model, LIMITS), grid, model.noise_at(1 / 50)
        )
        found = planned_motion(given, 50.0, np.random.default_rng(seed))
        seconds = time.process_time() - began
        seen, random = found.motion.seen, found.random.seen
        ratio = np.exp(np.mean(np.log(seen.std / random.std)))
        yield (
            f"| {name} (seed {seed}) | {seen.rank} | {ratio:.2f} | {worst(seen.std[3:6])} | "
            f"{worst(seen.std[6:])} | {max(found.motion.shares.values()):.3f} | {seconds:.1f} |"
        )
    seen = hovering(model)
    yield (
        f"| hovering (docs/in_motion.md) | {seen.rank} | | {worst(seen.std[3:6])} | "
        f"{worst(seen.std[6:])} | | |"
    )


def worst(std: Array) -> str:
    """The largest of some standard deviations; what is not determined has none."""
    return "not determined" if np.isnan(std).any() else f"{std.max():.1e}"


def hovering(model: Any) -> Any:
    """What the documentation's hovering flight shows: about one axis, up and down."""
    t = np.arange(0, 60, 0.02)
    a = np.column_stack([0 * t, 0 * t, -9.80665 + 0.2 * np.sin(0.5 * t)])
    omega = np.column_stack([0 * t, 0 * t, 0.3 + 0.1 * np.sin(t)])
    signals = {"a": a, "omega": omega, "v": 0 * a}
    units = {"a": "m/s^2", "omega": "rad/s", "v": "m/s"}
    run = Run.raw("hovering", signals, units=units, time=t)
    return observed(model, gramian(model, linearised(model, run)))


@dynamics
def reaction(
    T=signal("K", held=True),
    ca=signal(),
    cb=signal(),
    cc=signal(),
    *,
    a=state(start=5.0, known=True),
    b=state(start=0.0, known=True),
    A1=param("1/s", start=NOMINAL[0]),
    A2=param("1/s", start=NOMINAL[1]),
    E1=param("kJ/mol", start=NOMINAL[2]),
    E2=param("kJ/mol", start=NOMINAL[3]),
    R=constant(8.31446261815324e-3, "kJ/(mol K)"),
):
    """Two reactions in series by Arrhenius (Pyomo.DoE's example)."""
    k1, k2 = A1 * exp(-E1 / (R * T)), A2 * exp(-E2 / (R * T))
    outputs = (measured(ca, a, std=1.0), measured(cb, b, std=1.0), measured(cc, 5 - a - b, std=1.0))
    return Motions(rates={"a": -k1 * a, "b": k1 * a - k2 * b}, outputs=outputs)


def experiment() -> Iterator[str]:
    """The reactor as declared equations, integrated exactly: eight temperatures by IPOPT."""
    began = time.process_time()
    wanted = Wanted.of(reaction, "D", PRIOR)
    limits = limits_of(reaction, [("T", "300:700 K")])
    given = Motion(reaction, wanted, limits, Grid.of(1.0, 8, 8, True), np.eye(3))
    found = planned_experiment(given, 9, np.random.default_rng(0))
    seconds = time.process_time() - began
    size = wanted.scale[list(wanted.free)]
    own = -np.linalg.slogdet(found.after / np.outer(size, size))[1] / np.log(10)
    firsts = np.arange(540.0, 610.0, 2.0)
    dets = [exact_det([first] + [300.0] * 7) for first in firsts]
    best = np.polyfit(firsts, dets, 4)
    fine = np.arange(540, 608, 0.1)
    peak = int(np.argmax(np.polyval(best, fine)))
    f = reactor()
    planned_ = np.array(f(5, [*found.u.ravel(), found.u[-1, 0]], NOMINAL))
    theirs = np.linalg.slogdet(PRIOR + planned_.T @ planned_)[1] / np.log(10)
    yield "| | first temperature, K | others, K | log10 det after |"
    yield "| --- | --- | --- | --- |"
    yield "| published (last points of collocation: the next one's) | 579.212 | 300 | 6.214118 |"
    yield (
        f"| casest, integrated exactly | {found.u[0, 0]:.1f} | {found.u[1:].min():.1f} to "
        f"{found.u[1:].max():.1f} | {own:.6f} ({theirs:.6f} in the published collocation) |"
    )
    yield (
        f"| SciPy, integrated exactly, others at 300 K | {fine[peak]:.1f} | 300 | "
        f"{np.polyval(best, fine[peak]):.6f} |"
    )
    yield ""
    yield f"Found in {seconds:.1f} s of processor time."


def exact_det(T: list[float]) -> float:
    """log10 det of the information after, by SciPy's integration and differences."""

    def seen(p: Array) -> Array:
        state_, out = np.array([5.0, 0.0]), [5.0, 0.0, 0.0]
        for t in T:
            k1, k2 = (p[i] * np.exp(-p[i + 2] * 1000 / 8.31446261815324 / t) for i in (0, 1))
            M = np.array([[-k1, 0.0], [k1, -k2]])
            state_ = expm(M / 8) @ state_
            out += [*state_, 5 - state_.sum()]
        return np.array(out)

    p = np.array(NOMINAL)
    J = np.column_stack([
        (seen(p + h) - seen(p - h)) / 2e-5 for h in 1e-5 * np.diag(p)
    ])  # fmt: skip
    return float(np.linalg.slogdet(PRIOR + J.T @ J)[1] / np.log(10))


# -- what planned poses are worth ------------------------------------------------------------------


def made(
    model: Any, values: dict[str, Any] | None = None, noise: Noise | None = None
) -> Candidates:
    """The candidates of a model."""
    noise = noise or Noise(np.ones(len(model.axes)), {})
    return candidates(model, values or {}, noise, Possible())


def usual(pair: bool) -> Array:
    """24 attitudes as they are usually taken, sensor to reference.

    The cube's, where the side matters; else its faces, its edges, and its faces again.
    """
    if pair:
        return Rotation.create_group("O").as_matrix()
    faces = np.vstack([np.eye(3), -np.eye(3)])
    edges = [
        (a + b) / 2**0.5 for i, a in enumerate(faces) for b in faces[i + 1 :] if abs(a @ b) < 1e-9
    ]
    return upward(np.vstack([faces, edges, faces]))


def upward(up: Array) -> Array:
    """Some rotation with each direction of up."""
    found = []
    for u in up:
        side = np.eye(3)[int(np.argmin(np.abs(u)))]
        y = np.cross(u, side) / np.linalg.norm(np.cross(u, side))
        found.append([np.cross(y, u), y, u])
    return np.array(found)


def chosen(model: Any, values: dict[str, Any], noise: Noise) -> tuple[Array, float]:
    """Planned attitudes, and the seconds that the plan took."""
    found = made(model, values, noise)
    began = time.process_time()
    n = len(found.names)
    given = task(found.factors, np.zeros((n, n)), found.names, model.name)
    plan = planned(given, criterion_of(given, "D"), POSES)
    seconds = time.process_time() - began
    if "attitude" in found.signals:
        return found.signals["attitude"][list(plan.chosen)].reshape(-1, 3, 3), seconds
    if len(model.axes) == 1:
        assert found.up is not None
        return upward(found.up[list(plan.chosen)]), seconds
    a, m = (found.signals[name][list(plan.chosen)] for name in ("a", "m"))
    north = m - a * np.sum(a * m, axis=1, keepdims=True) / np.sum(a * a, axis=1, keepdims=True)
    x, z = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (north, a))
    return np.stack([x, np.cross(z, x), z], axis=1), seconds


def norm_sensors(model: Any, R: Array, rng: Any) -> tuple[dict[str, Array], dict[str, Array]]:
    """Readings (sensors, poses, 3) of sensors that differ, and their truth."""
    diagonal = model.name == "norm-diagonal"
    scale = np.eye(3) + 0.03 * np.tril(rng.standard_normal((SENSORS, 3, 3)))
    scale = scale * np.eye(3) if diagonal else scale
    offset = 0.3 * rng.standard_normal((SENSORS, 3))
    force = np.broadcast_to(9.81 * R[..., 2, :], (SENSORS, R.shape[-3], 3))
    v = np.einsum("sij,spj->spi", np.linalg.inv(scale), force) + offset[:, None]
    truth = np.einsum("sii->si", scale) if diagonal else scale
    return {"v": v + 0.01 * rng.standard_normal(v.shape)}, {"scale": truth, "offset": offset}


def pair_sensors(model: Any, R: Array, rng: Any) -> tuple[dict[str, Array], dict[str, Array]]:
    """The same of an accelerometer and a magnetometer."""
    R = np.broadcast_to(R, (SENSORS, *R.shape[-3:]))
    force = 9.80665 * R[..., 2, :]
    flux = 50.0 * (np.cos(1.1) * R[..., 0, :] - np.sin(1.1) * R[..., 2, :])
    A = np.eye(3) + 0.03 * np.tril(rng.standard_normal((SENSORS, 3, 3)))
    M = np.eye(3) + 0.03 * rng.standard_normal((SENSORS, 3, 3))
    o, h = 0.3 * rng.standard_normal((SENSORS, 3)), 3 * rng.standard_normal((SENSORS, 3))
    a = np.einsum("sij,spj->spi", np.linalg.inv(A), force) + o[:, None]
    m = np.einsum("sij,spj->spi", np.linalg.inv(M), flux) + h[:, None]
    a, m = a + 0.02 * rng.standard_normal(a.shape), m + 0.3 * rng.standard_normal(m.shape)
    truth = {"accelerometer_offset": o, "magnetometer_offset": h}
    return {"a": a, "m": m}, truth | {"accelerometer_scale": A, "magnetometer_scale": M}


def table_sensors(model: Any, R: Array, rng: Any) -> tuple[dict[str, Array], dict[str, Array]]:
    """The same of a rate table."""
    R = np.broadcast_to(R, (SENSORS, *R.shape[-3:]))
    F = np.eye(3) + 0.03 * rng.standard_normal((SENSORS, 3, 3))
    q, b = 1e-3 * rng.standard_normal((SENSORS, 3)), 0.3 * rng.standard_normal((SENSORS, 3))
    down = np.append(0.02 * rng.standard_normal((SENSORS, 2)), np.ones((SENSORS, 1)), axis=1)
    down = -down / np.linalg.norm(down, axis=1, keepdims=True)
    force = -9.80665 * np.einsum("spji,sj->spi", R, down)
    bent = force + q[:, None] * force**2 + b[:, None]
    a = np.einsum("sij,spj->spi", np.linalg.inv(F), bent)
    a = a + 0.01 * rng.standard_normal(a.shape)
    readings = {"a": a, "attitude": R.reshape(SENSORS, -1, 9)}
    return readings, {"inverse_scale": F, "quadratic": q, "bias": b}


Make = Callable[[Any, Array, Any], tuple[dict[str, Array], dict[str, Array]]]


def errors(model: Any, make: Make, R: Array) -> tuple[dict[str, Array], int]:
    """Root mean square error of each entry over the sensors that are trusted, and their number."""
    readings, truth = make(model, R, np.random.default_rng(7))
    values, good = fitted(model, readings)
    found = {}
    for name, value in truth.items():
        off = (values[name] - value[: len(good)])[good]
        rms = np.sqrt(np.mean(off**2, axis=0)).ravel()
        found[name] = rms[rms > 0]
    return found, int(good.sum())


def fitted(model: Any, readings: dict[str, Array]) -> tuple[dict[str, Array], Array]:
    """Values of every sensor, and which are trusted; one by one where they are no fleet's."""
    if len(model.axes) == 1:
        fits = calibrate_many(model, readings)
        return {n: np.asarray(v) for n, v in fits.values.items()}, np.asarray(fits.trusted)
    found = []
    for s in range(SENSORS):
        own = {name: value[s] for name, value in readings.items()}
        units = {"a": "m/s^2", "m": "uT", "attitude": None}
        run = Run.raw("r", own, units={n: units[n] for n in own})
        found.append(attempt(model, [run], intervals=False))
    values = {n: np.array([f.values[n] for f in found]) for n in found[0].values}
    return values, np.array([f.certificate.trusted for f in found])


def worth() -> Iterator[str]:
    """Errors after planned poses over those after as many random and usual ones."""
    cases: list[tuple[Any, Make, dict[str, Any], bool]] = [
        (norm_diagonal.having(norm=9.81), norm_sensors, {}, False),
        (norm_triangular.having(norm=9.81), norm_sensors, {}, False),
        (norm_pair, pair_sensors, {"dip": np.array(1.1)}, True),
        (rate_table, table_sensors, {}, True),
    ]
    yield (
        "| model | unknown | planned over random | planned over usual | trusted: planned, "
        "random, usual | plan, s |"
    )
    yield "| --- | --- | --- | --- | --- | --- |"
    for model, make, values, side in cases:
        noise = Noise(np.ones(len(model.axes)), {})
        if model is norm_pair:
            noise = Noise(np.ones(3), {"a": 0.02, "m": 0.3})
        best, seconds = chosen(model, values, noise)
        rng = np.random.default_rng(3)
        random = Rotation.random(SENSORS * POSES, random_state=rng).as_matrix()
        random = random.reshape(SENSORS, POSES, 3, 3)
        result = [errors(model, make, R) for R in (best, random, usual(side))]
        counts = ", ".join(str(n) for _, n in result) + f" of {SENSORS}"
        for i, name in enumerate(result[0][0]):
            over = []
            for other in (1, 2):
                theirs = result[other][0][name]
                same = len(theirs) == len(result[0][0][name]) and result[other][1] > SENSORS // 2
                ratio = np.exp(np.mean(np.log(result[0][0][name] / theirs))) if same else np.nan
                over.append(f"{ratio:.2f}" if np.isfinite(ratio) else "not determined")
            tail = f"{counts} | {seconds:.2f}" if i == 0 else " | "
            yield f"| {model.name if i == 0 else ''} | {name} | {over[0]} | {over[1]} | {tail} |"


def mountings() -> Iterator[str]:
    """A second run of a wheel: another mounting, another tilt, both, or the same again."""
    values = {
        "speed": np.array([10, -0.05, 1e-4, 1e-7]),
        "misalignment": np.array([0.5, 0.4, 0.3]),
        "tilt": np.array(0.8),
    }
    noise = Noise(np.full(3, 0.05), {})
    again = runs(wheel, values, noise, {"tilt": np.array([[0.8]])}, duration=60, rate=50)
    every = runs(wheel, values, noise, {}, duration=60, rate=50)
    given = task(every.factors, again.factors[0].T @ again.factors[0], every.names, "wheel")
    plan = planned(given, criterion_of(given, "D"), 1)
    first, best = plan.covariances
    assert first is not None
    assert best is not None
    same = inverse(2 * again.factors[0].T @ again.factors[0])
    yield f"Best of {len(every)}: {every.words[plan.chosen[0]]}."
    yield ""
    yield "| std | one run | the same run again | the planned second run |"
    yield "| --- | --- | --- | --- |"
    for i, name in enumerate(every.names):
        row = [np.sqrt(C[i, i]) for C in (first, same, best)]
        yield f"| {name} | " + " | ".join(f"{x:.2g}" for x in row) + " |"


def speed() -> Iterator[str]:
    """24 of 2000 candidates, 22 unknowns, three residuals each."""
    rng = np.random.default_rng(0)
    F = rng.standard_normal((2000, 3, 22))
    for name in "DA":
        began = time.process_time()
        given = task(F, np.zeros((22, 22)), [f"x{k}" for k in range(22)], "random")
        plan = planned(given, criterion_of(given, name), 24)
        yield (
            f"* {name}: {time.process_time() - began:.1f} s, certified {100 * plan.share:.1f} % "
            "of the best possible."
        )


PARTS = {
    "D-optimal polynomials (Guest 1958)": polynomials,
    "The sphere": sphere,
    "Two rivals (Atkinson & Fedorov 1975, example 1)": rivals,
    "Pyomo.DoE's reactor": pyomo,
    "A motion of 60 s": motion,
    "Pyomo.DoE's reactor as declared equations": experiment,
    f"{POSES} poses, {SENSORS} simulated sensors of each model": worth,
    "A wheel's second run": mountings,
    "Time of 24 of 2000 candidates, 22 unknowns": speed,
}


def main() -> None:
    """Every part, one after the other."""
    lines = ["# Plans beside known optima", "", "Made by `make study-plans`.", ""]
    for title, part in PARTS.items():
        print(title, flush=True)
        lines += [f"## {title}", "", *part(), ""]
        print("\n".join(lines[-12:]), flush=True)
    TABLE.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
