"""A hand-spun, tilted wheel calibrates an accelerometer.

F. Pedersini, "Dynamic Calibration of Triaxial Accelerometers with Simple Setup": model (1)-(7),
the four-step algorithm (14)-(35). Conventions that the paper leaves open: the misalignment is
R = Rx(θ)·Ry(φ)·Rz(ψ), and the tilt lies between 0 and π/2. Spinning the other way round with the
sensor's y and z turned over gives the same readings with an offset that differs by 2g·cos α along
the wheel's axis; of the two, the smaller offset is taken.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from casest import (
    Model,
    NotTrusted,
    Residual,
    Run,
    constant,
    cos,
    der,
    inf,
    integral,
    model,
    param,
    pi,
    polynomial,
    quantity,
    rotation,
    signal,
    sin,
    vertcat,
)

Array = NDArray[np.float64]

#: Readings are averaged over this time, in s, before the motion is sought: at 20 rad/s that takes
#: 0.7 % off what goes round, and the slip of a turn begins at 150 rad/s.
BIN = 0.02
#: Slow phase below which a motion is found, rad: the readings' noise hides less.
SETTLED = 1e-3
#: Degree up to which the angle is looked at for what a cubic speed law lacks (speed_polynomial's).
HIGHER = 8
#: Windows of whole turns: as many where there are that many turns, and what is too few for a test.
WINDOWS, FEWEST_WINDOWS = 50, 15
#: Probability under the cubic law below which it is said not to hold.
NO_LAW = 1e-3
#: Departure from it, rad, below which nothing is said: it moves no parameter by a tenth of its
#: standard deviation, and noise-free readings of few turns show as much from being averaged.
SLIGHT = 2e-4


@model
def wheel(
    t=signal("s"),
    v=signal(3, "m/s^2"),
    *,
    offset=param(3, "m/s^2"),
    gain=param(3, start=1.0, bounds=(0, inf)),
    misalignment=param(3, "rad", per="run"),
    tilt=param("rad", start=0.8, bounds=(0, pi / 2), per="run"),
    phase=param("rad", per="run"),
    speed=param(4, ("rad/s", "rad/s^2", "rad/s^3", "rad/s^4"), per="run"),
    radius=constant(0.28, "m"),
    gravity=constant(9.80665, "m/s^2"),
):
    """Accelerometer on a tilted, freely rotating wheel (Pedersini, eqs. 1-7).

    reading = offset + gain·specific_force, each axis alone; specific_force is in the sensor's
    own axes: R·a of the force a in the wheel's axes (towards the axle, along the turn, up the
    axle; +g upwards at rest), R = Rx(misalignment[0])·Ry(misalignment[1])·Rz(misalignment[2]).

    angle is counted from the lowest point in the direction of the turn, phase is its value at
    t = 0, in (−π, π]; the rate of turn is speed[0] + speed[1]·t + …; tilt is the angle between
    axle and vertical. Gains are positive.
    """
    angle = quantity("angle", phase + integral(polynomial(speed, t), t), "rad")
    rate, acceleration = der(angle, t), der(der(angle, t), t)
    a = vertcat(
        radius * rate**2 + gravity * sin(tilt) * cos(angle),
        radius * acceleration + gravity * sin(tilt) * sin(angle),
        gravity * cos(tilt),
    )
    force = quantity("specific_force", rotation(misalignment) @ a, "m/s^2")
    reading = quantity("reading", offset + gain * force, "m/s^2")
    return Residual(measured=v, predicted=reading, corrected=force)


# -- the motion, from the readings alone ----------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """Phase ϑ(t) as a polynomial, of degree four by the law, lowest coefficient first (rad, s)."""

    coefficients: Array

    def phase(self, t: Array) -> Array:
        """ϑ(t), rad."""
        return np.polynomial.polynomial.polyval(t, self.coefficients)

    def rate(self, t: Array, order: int = 1) -> Array:
        """Derivative of ϑ(t) of the given order."""
        derived = np.polynomial.polynomial.polyder(self.coefficients, order)
        return np.polynomial.polynomial.polyval(t, derived)

    def shifted(self, angle: float, sign: int = 1) -> Motion:
        """±ϑ(t) + angle."""
        coefficients = sign * self.coefficients
        coefficients[0] += angle
        return Motion(coefficients)

    def plus(self, other: Motion) -> Motion:
        """The sum of two phases."""
        size = max(len(self.coefficients), len(other.coefficients))
        parts = (np.pad(c, (0, size - len(c))) for c in (self.coefficients, other.coefficients))
        return Motion(np.add(*parts))


def find_motion(t: Array, v: Array) -> Motion:
    """Phase of the turning, up to a constant and its sign, from readings (N, 3).

    What is left of the readings when the slow part (a polynomial of degree six, eq. 2 squared) is
    taken out goes round an ellipse. Its angular rate, averaged over windows, gives a cubic; the
    phase that remains after turning back by this cubic is slow and cannot slip.
    """
    t, v = _averaged(t, v)
    z = _phasor(t, v)
    step = float(np.median(np.diff(t[:10_001])))
    advance = z[1:] * np.conj(z[:-1])
    middle = 0.5 * (t[1:] + t[:-1])
    rates = np.angle(_window_sums(advance, _windows(len(advance), step))) / step
    centres = _window_sums(middle, _windows(len(advance), step)).real
    counts = _window_sums(np.ones(len(advance)), _windows(len(advance), step)).real
    order = min(3, len(rates) - 1)
    cubic = _robust_fit(centres / counts, rates, order)
    motion = Motion(np.polynomial.polynomial.polyint(np.pad(cubic, (0, 3 - order))))
    for _ in range(3):
        left = _slow_phase(motion, t, z, step)
        motion = motion.plus(left)
        if np.abs(left.phase(t[:: max(1, len(t) // 100)])).max() < SETTLED:
            break
    return motion


def _averaged(t: Array, v: Array) -> tuple[Array, Array]:
    """Means of t (n,) and v (n, 3) over bins of at most BIN: all that the motion needs."""
    length = int(BIN / float(np.median(np.diff(t[:10_001]))) + 1e-6)
    if length < 2:
        return t, v
    return _means(t, length), _means(v, length)


def _means(x: Array, length: int) -> Array:
    """Of every `length` rows, and of what is left at the end."""
    whole = len(x) - len(x) % length
    means = np.asarray(sum(x[k:whole:length] for k in range(length)) / length)
    return means if whole == len(x) else np.append(means, x[whole:].mean(axis=0)[None], axis=0)


def _phasor(t: Array, v: Array) -> Any:
    """Complex numbers going round the unit circle once per turn."""
    slow = _slow_columns(t)
    rest = v - slow @ _fitted(slow, v)
    squares, axes = np.linalg.eigh(rest.T @ rest)
    if not squares[1] > 1e-6 * squares[2]:
        raise NotTrusted("wheel: the readings do not go round: no turning seen in them")
    return rest @ (np.sqrt(len(t) / 2 / squares[:0:-1]) * axes[:, :0:-1] @ [1, 1j])


def _fitted(columns: Array, v: Array) -> Array:
    """Coefficients of least squares, from the normal equations: a start value may be rough."""
    return np.asarray(np.linalg.lstsq(columns.T @ columns, columns.T @ v, rcond=None)[0])


def _slow_columns(t: Array) -> Array:
    """Polynomials of degree six (N, 7): all that ω² and its derivative make."""
    x = 2 * (t - t[0]) / (t[-1] - t[0]) - 1
    return np.polynomial.legendre.legvander(x, 6)


def _windows(count: int, step: float, seconds: float = 1.5) -> Any:
    """First index of every window of about the given length; at least eight windows."""
    length = max(1, min(round(seconds / step), count // 8))
    return np.arange(0, count - length + 1, length)


def _window_sums(values: Any, first: Any) -> Any:
    return np.add.reduceat(values, first)


def _robust_fit(x: Array, y: Array, degree: int) -> Array:
    """Polynomial through most points: those far off the last fit are left out, three times."""
    keep = np.ones(len(x), dtype=bool)
    fit = _polynomial(x, y, degree)
    for _ in range(3):
        away = np.abs(y - np.polynomial.polynomial.polyval(x, fit))
        limit = 4 * np.median(away[keep]) + 1e-12
        kept, keep = keep, away <= limit
        if keep.sum() <= degree + 1 or np.array_equal(keep, kept):
            break
        fit = _polynomial(x[keep], y[keep], degree)
    return fit


def _polynomial(x: Array, y: Array, degree: int) -> Array:
    """Coefficients of least squares, lowest first."""
    size = float(np.abs(x).max()) or 1.0
    columns = np.vander(x / size, degree + 1, increasing=True)
    fit = np.linalg.lstsq(columns, y, rcond=None)[0]
    return np.asarray(fit / size ** np.arange(degree + 1))


def _slow_phase(motion: Motion, t: Array, z: Any, step: float, degree: int = 4) -> Motion:
    """The slow phase that is left after turning back by a motion."""
    phase = motion.phase(t)
    left = z * (np.cos(phase) - 1j * np.sin(phase))
    first = _windows(len(t), step, 1.0)
    counts = np.diff(np.append(first, len(t)))
    slow = np.unwrap(np.angle(_window_sums(left, first)))
    centres = np.add.reduceat(t, first) / counts
    return Motion(_polynomial(centres, slow, min(degree, len(first) - 1)))


# -- everything else, linear once the motion is known ----------------------------------------------


def closed_form(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Start values of all parameters from the readings, run by run; sensor parameters averaged."""
    found = [_one_run(declared, run) for run in runs]
    values: dict[str, Array] = {}
    for name in found[0]:
        stacked = np.stack([f[name] for f in found])
        per_run = any(p.name == name and p.scope == "run" for p in declared.parameters)
        values[name] = stacked if per_run and len(runs) > 1 else stacked.mean(axis=0)
        if per_run and len(runs) == 1:
            values[name] = stacked[0]
    return values


def _number(declared: Model, name: str) -> float | None:
    """The value of a constant; None where it is an unknown."""
    symbol = declared[name]
    return float(symbol.array) if hasattr(symbol, "array") else None


def _one_run(declared: Model, run: Run) -> dict[str, Array]:
    t, v = _averaged(run.signals["t"][:, 0], run.signals["v"])
    motion = find_motion(t, v)
    turning = _turning(motion, t, v)
    mirrored = turning._replace(sine=-turning.sine)  # the same, gone round the other way
    both = [
        _from_motion(declared, motion.shifted(0.0, sign), seen)
        for sign, seen in ((1, turning), (-1, mirrored))
    ]
    return min(both, key=lambda values: float(np.linalg.norm(values["offset"])))


class _Turning(NamedTuple):
    """Readings as level + radial·ϑ̇² + cosine·cos ϑ + sine·sin ϑ, (3,) each."""

    level: Array
    radial: Array
    cosine: Array
    sine: Array


def _turning(motion: Motion, t: Array, v: Array) -> _Turning:
    """v = o + ΓR a(t) is linear in ΓR's first two columns once ϑ(t) is known (1, 6)."""
    phase, rate = motion.phase(t), motion.rate(t)
    size = np.mean(rate**2)
    columns = np.column_stack([np.ones_like(t), rate**2 / size, np.cos(phase), np.sin(phase)])
    level, radial, cosine, sine = _fitted(columns, v)
    return _Turning(level, radial / size, cosine, sine)


def _from_motion(declared: Model, motion: Motion, turning: _Turning) -> dict[str, Array]:
    """Every parameter, from what the readings do as the wheel turns."""
    level, radial, c, s = turning  # radial = ΓR₁·r
    # The phase counts from where gravity pulls along the radial axis: c·cos δ + s·sin δ ∥ radial.
    shift = float(np.arctan2(s @ radial, c @ radial))
    along, across = c * np.cos(shift) + s * np.sin(shift), s * np.cos(shift) - c * np.sin(shift)
    gravity = _number(declared, "gravity") or 9.80665
    radius, tilt = _number(declared, "radius"), _number(declared, "tilt")
    if radius is None and tilt is not None:
        first = along / (gravity * np.sin(tilt))
    else:
        first = radial / (radius or 0.28)
    pull = float(along @ first / (first @ first))  # g·sin α
    tilt = float(np.arcsin(np.clip(pull / gravity, 0.02, 0.999)))
    second = across / (gravity * np.sin(tilt))
    gain, R = _gain_and_rotation(first, second)
    offset = level - gain * (R[:, 2] * gravity * np.cos(tilt))
    turned = motion.shifted(-shift)
    phase0 = float(np.angle(np.exp(1j * turned.coefficients[0])))
    speed = turned.coefficients[1:] * np.arange(1, 5)
    return {
        "offset": offset,
        "gain": gain,
        "misalignment": euler(R),
        "tilt": np.array(tilt),
        "phase": np.array(phase0),
        "speed": speed,
        "radius": np.array(radius or float(np.linalg.norm(radial / (gain * R[:, 0])) / 3**0.5)),
    }


def _gain_and_rotation(first: Array, second: Array) -> tuple[Array, Array]:
    """Γ and R from the first two columns of ΓR: their orthonormality is linear in 1/γ²."""
    system = np.array([first**2, second**2, first * second])
    try:
        inverse_squares = np.linalg.solve(system, [1.0, 1.0, 0.0])
    except np.linalg.LinAlgError:
        inverse_squares = np.full(3, np.nan)
    usable = np.all(np.isfinite(inverse_squares)) and np.all(inverse_squares > 0.25)
    usable = usable and np.all(inverse_squares < 4)
    gain = 1 / np.sqrt(inverse_squares) if usable else np.ones(3)
    x = first / gain
    x = x / np.linalg.norm(x)
    y = second / gain - x * (x @ (second / gain))
    y = y / np.linalg.norm(y)
    return gain, np.column_stack([x, y, np.cross(x, y)])


def euler(R: Array) -> Array:
    """(θ, φ, ψ) of R = Rx(θ)·Ry(φ)·Rz(ψ), with φ in [−π/2, π/2]."""
    return np.array(
        [
            np.arctan2(-R[1, 2], R[2, 2]),
            np.arcsin(np.clip(R[0, 2], -1, 1)),
            np.arctan2(-R[0, 1], R[0, 0]),
        ]
    )


# -- the paper's four steps ------------------------------------------------------------------------


def four_step(declared: Model, runs: Sequence[Run]) -> dict[str, Array]:
    """Pedersini's algorithm (14)-(35), run by run, sensor parameters averaged.

    Where the text leaves something open: the rotation of least variance (24) is the eigenvector of
    the readings' smallest variance; the excursion (26) is that of the low-passed signal, for
    that of the raw one follows the noise's extremes; searches begin at the closed form; the
    amplitude A of (28) is the fitted one, because the standard deviation in (31) includes the
    noise; (32) is the pseudo-inverse (UᵀU)⁻¹Uᵀb.
    """
    if _number(declared, "radius") is None:
        raise NotTrusted("four-step: the algorithm needs the radius; fix it with --set radius=…")
    found = [_four_steps(declared, run) for run in runs]
    values: dict[str, Array] = {}
    for p in declared.parameters:
        stacked = np.stack([f[p.name] for f in found])
        if p.scope == "run":
            values[p.name] = stacked if len(runs) > 1 else stacked[0]
        else:
            values[p.name] = stacked.mean(axis=0)
    return values


def _four_steps(declared: Model, run: Run) -> dict[str, Array]:
    t, v = run.signals["t"][:, 0], run.signals["v"]
    start = _one_run(declared, run)
    T = _realignment(t, v, start)  # A
    motion, amplitude = _bench_rotation(t, v @ T[1], start)  # B
    g, r = _number(declared, "gravity") or 9.80665, _number(declared, "radius") or 0.28
    R, tilt, gain = _gain_search(t, v, T, motion, amplitude, start, g, r)  # C
    phase, rate = motion.phase(t), motion.rate(t)
    a = np.column_stack(
        [
            r * rate**2 + g * np.sin(tilt) * np.cos(phase),
            r * motion.rate(t, 2) + g * np.sin(tilt) * np.sin(phase),
            np.full_like(t, g * np.cos(tilt)),
        ]
    )
    offset = np.mean(v - gain * (a @ R.T), axis=0)  # D, (35)
    return {
        "offset": offset,
        "gain": gain,
        "misalignment": euler(R),
        "tilt": np.array(tilt),
        "phase": np.array(np.angle(np.exp(1j * motion.coefficients[0]))),
        "speed": motion.coefficients[1:] * np.arange(1, 5),
    }


def _realignment(t: Array, v: Array, start: dict[str, Array]) -> Array:
    """T of (24) and (26): z′ constant, y′ of least excursion; signs as in the start's R."""
    from scipy.optimize import minimize_scalar

    W = start["gain"][:, None] * rotation_matrix(start["misalignment"])
    z = np.linalg.eigh(np.cov(v.T))[1][:, 0]
    z = z * np.sign(z @ W[:, 2])
    x = np.linalg.svd(z[None, :])[2][1]
    y = np.cross(z, x)
    plane = _low_passed(t, v @ np.column_stack([x, y]), start["speed"])

    def excursion(angle: float) -> float:
        return _excursion(plane @ [np.cos(angle), np.sin(angle)])

    guess = float(np.arctan2(y @ W[:, 1], x @ W[:, 1]))
    angle = minimize_scalar(excursion, bracket=(guess - 0.1, guess + 0.1), tol=1e-10).x
    second = np.cos(angle) * x + np.sin(angle) * y
    second = second * np.sign(second @ W[:, 1])
    return np.array([np.cross(second, z), second, z])


def _excursion(y: Array) -> float:
    """max − min, in the unit of y."""
    return float(np.ptp(y))


def _low_passed(t: Array, y: Array, speed: Array, turns: float = 4.0) -> Array:
    """Readings (N, k) without what is faster than `turns` times the wheel; both ends cut off.

    The paper names no filter; this one is chosen because with it (26) gives the spread of its
    Table I (all but the phase's). The raw signal's max − min follows the noise, and the offsets
    scatter three to six times as much as published. See studies/wheel_bound.md.
    """
    from scipy.signal import butter, sosfiltfilt

    rate = np.abs(np.polynomial.polynomial.polyval(t, speed)).max() / (2 * np.pi)  # turns/s
    cutoff = turns * rate * float(np.median(np.diff(t[:10_001])))  # cycles per sample
    end = round(1 / cutoff)
    if cutoff > 0.4 or len(y) < 10 * end:
        return y  # too few samples a turn, or too few turns
    smooth = sosfiltfilt(butter(4, 2 * cutoff, output="sos"), y, axis=0)
    return np.asarray(smooth[end:-end])


def _bench_rotation(t: Array, y: Array, start: dict[str, Array]) -> tuple[Motion, float]:
    """(29): k + A·sin ϑ(t) fitted to the re-aligned y, seven unknowns."""
    from scipy.optimize import least_squares

    length = float(t[-1])
    powers = (t[:, None] / length) ** np.arange(5)
    phase = np.concatenate([[start["phase"]], start["speed"] / np.arange(1, 5)])
    first = phase * length ** np.arange(5)
    columns = np.column_stack([np.ones_like(t), np.sin(powers @ first)])
    k, A = np.linalg.lstsq(columns, y, rcond=None)[0]

    def residual(x: Array) -> Array:
        return np.asarray(x[5] + x[6] * np.sin(powers @ x[:5]) - y)

    def jacobian(x: Array) -> Array:
        angle = powers @ x[:5]
        slope = (x[6] * np.cos(angle))[:, None] * powers
        return np.column_stack([slope, np.ones_like(t), np.sin(angle)])

    best = least_squares(residual, [*first, k, A], jac=jacobian, x_scale="jac").x
    return Motion(best[:5] / length ** np.arange(5)), float(best[6])


def _gain_search(
    t: Array,
    v: Array,
    T: Array,
    motion: Motion,
    amplitude: float,
    start: dict[str, Array],
    g: float,
    r: float,
) -> tuple[Array, float, Array]:
    """(30)-(34): misalignment and tilt by search, the gain of each candidate by (32)."""
    from scipy.optimize import minimize

    phase = motion.phase(t)
    basis = [motion.rate(t) ** 2, np.cos(phase), motion.rate(t, 2), np.sin(phase)]
    features = np.column_stack(basis)
    both = np.hstack([features - features.mean(axis=0), v - v.mean(axis=0)])
    gram = both.T @ both  # all that (34) needs of the samples
    FF, FV, VV = gram[:4, :4], gram[:4, 4:], gram[4:, 4:]

    def gain_of(R: Array, tilt: float) -> Array:
        rows = [T[1] * R[:, 0], T[2] * R[:, 0], T[2] * R[:, 1], T[1] * R[:, 1]]
        right = np.array([0, 0, 0, amplitude / (g * np.sin(tilt))])
        return np.asarray(np.linalg.lstsq(np.array(rows), right, rcond=None)[0])

    def objective(x: Array) -> float:
        R, tilt = rotation_matrix(x[:3]), x[3]
        a = np.zeros((4, 3))
        a[0, 0], a[1, 0] = r, g * np.sin(tilt)
        a[2, 1], a[3, 1] = r, g * np.sin(tilt)
        M = a @ (gain_of(R, tilt)[:, None] * R).T
        return float(np.trace(VV - 2 * M.T @ FV + M.T @ FF @ M))

    first = [*start["misalignment"], float(start["tilt"])]
    options = {"xatol": 1e-9, "fatol": 1e-12 * gram[4:, 4:].trace(), "maxiter": 4000}
    best = minimize(objective, first, method="Nelder-Mead", options=options).x
    R = rotation_matrix(best[:3])
    return R, float(best[3]), gain_of(R, best[3])


def rotation_matrix(angles: Array) -> Array:
    """R = Rx(θ)·Ry(φ)·Rz(ψ) of plain numbers."""
    c, s = np.cos(angles), np.sin(angles)
    x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    y = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    return np.asarray(x @ y @ z)


# -- does the cubic law hold? ----------------------------------------------------------------------


@dataclass(frozen=True)
class LawMisfit:
    """What a polynomial of degree eight finds in the angle beyond the law's degree four.

    `departure` is its largest size (rad); `p_value` the probability of as much from noise alone,
    whose size is what the scatter from turn to turn shows.
    """

    departure: float
    p_value: float


def law_misfit(t: Array, v: Array) -> LawMisfit | None:
    """F test of the cubic speed law on the angle averaged over whole turns; None if too short.

    Whole turns, because what comes once or twice a turn (an unbalanced wheel, unequal gains) then
    averages out, and because noise that is correlated over less than a turn does not matter.
    """
    from scipy.special import fdtrc  # SciPy loads slowly

    short = float(np.median(np.diff(t[:10_001])))
    t, v = _averaged(t, v)
    step = float(np.median(np.diff(t[:10_001])))
    width = float(np.sqrt(max(step**2 - short**2, 0.0)))
    motion = find_motion(t, v)
    for _ in range(3):
        left = _slow_phase(motion, t, _circular(t, v, motion, width), step, HIGHER)
        motion = motion.plus(left)
    found = _by_turns(motion, t, _circular(t, v, motion, width))
    if found is None:
        return None
    centres, angle, weights = found
    x = 2 * (centres - t[0]) / (t[-1] - t[0]) - 1
    columns = weights[:, None] * np.polynomial.legendre.legvander(x, HIGHER)
    Q, _ = np.linalg.qr(columns)
    part = Q.T @ (weights * angle)
    beyond, freedom = part[5:], len(x) - HIGHER - 1
    rest = weights * angle - Q @ part
    F = np.mean(beyond**2) / max(float(rest @ rest) / freedom, 1e-300)
    departure = float(np.abs(Q[:, 5:] @ beyond / weights).max())
    return LawMisfit(departure, float(fdtrc(len(beyond), freedom, F)))


def _circular(t: Array, v: Array, motion: Motion, width: float) -> Any:
    """exp(iϑ) as the readings show it: their ellipse made a circle, spikes clipped.

    Readings averaged over `width` seconds lose amplitude with speed.
    """
    phase, slow = motion.phase(t), _slow_columns(t)
    left = np.sinc(motion.rate(t) * width / (2 * np.pi))
    columns = np.column_stack([slow, left * np.cos(phase), left * np.sin(phase)])
    found = np.linalg.lstsq(columns, v, rcond=None)[0]
    rest = v - slow @ found[:-2]
    x, y = np.linalg.lstsq(found[-2:].T, rest.T, rcond=None)[0]
    z = x + 1j * y
    return z / np.maximum(1.0, np.abs(z) / 2)


def _by_turns(motion: Motion, t: Array, z: Any) -> tuple[Array, Array, Array] | None:
    """Times, angles and weights of windows of whole turns, at most fifty; None if under fifteen."""
    turned = np.abs(motion.phase(t) - motion.phase(t[:1])) / (2 * np.pi)
    each = max(1, int(np.ceil(turned[-1] / WINDOWS)))
    index = np.floor(turned / each)
    first = np.flatnonzero(np.diff(index, prepend=-1))
    counts = np.diff(np.append(first, len(t)))[:-1]  # the last window is no whole turn
    if len(counts) < FEWEST_WINDOWS:
        return None
    left = np.add.reduceat(z * np.exp(-1j * motion.phase(t)), first)[:-1]
    centres = np.add.reduceat(t, first)[:-1] / counts
    angle = motion.phase(centres) + np.unwrap(np.angle(left))
    return centres, angle, np.sqrt(counts / counts.mean())


def remarks(declared: Model, runs: Sequence[Run], values: Mapping[str, Any]) -> Iterator[str]:
    """What an engineer would notice: a run too long for the cubic speed law."""
    if any(attached.effect.name == "speed_polynomial" for attached in declared.effects):
        return
    for run in runs:
        try:
            found = law_misfit(run.signals["t"][:, 0], run.signals["v"])
        except (NotTrusted, np.linalg.LinAlgError):
            continue  # no turning seen: that is said elsewhere
        if found is not None and found.p_value < NO_LAW and found.departure > SLIGHT:
            yield (
                f"the cubic speed law does not hold in {run.name}: the angle departs from it by up "
                f"to {found.departure:.2g} rad (p = {found.p_value:.1g}), and the other parameters "
                "take up part of that. Air drag and bearings do it in a long run: record or cut "
                "shorter runs, calibrate wheel-motion, which has them as constants, or add the "
                "effect speed_polynomial (`casest close` tries it)"
            )


def convention(declared: Model, values: Mapping[str, Array]) -> dict[str, Array]:
    """Of two spins the smaller offset; phase in (−π, π]; φ of the misalignment in [−π/2, π/2]."""
    chosen = _spin(declared, values)
    if "phase" in chosen:
        chosen["phase"] = -((-chosen["phase"] + np.pi) % (2 * np.pi) - np.pi)
    if "misalignment" in chosen:
        angles = np.atleast_2d(chosen["misalignment"])
        found = np.array([euler(rotation_matrix(a)) for a in angles])
        chosen["misalignment"] = found.reshape(chosen["misalignment"].shape)
    return chosen


def _spin(declared: Model, values: Mapping[str, Array]) -> dict[str, Array]:
    """The values, or those of the opposite spin that gives the same readings, by their offset.

    With y and z of the wheel turned over, −ϑ and o + 2g·cos α·Γr₃ predict what ϑ and o do: in one
    mounting (several would need one offset each), and as long as nothing is added to the model.
    """
    mirrored = ("offset", "gain", "misalignment", "tilt", "phase", "speed")
    known = {name: values.get(name, _constant(declared, name)) for name in (*mirrored, "gravity")}
    one_mounting = np.ndim(known["misalignment"]) == 1 and np.ndim(known["tilt"]) == 0
    changeable = all(name in values for name in ("offset", "misalignment", "phase", "speed"))
    if declared.effects or not (one_mounting and changeable):
        return dict(values)
    R = rotation_matrix(known["misalignment"])
    axle = known["gain"] * R[:, 2] * known["gravity"] * np.cos(known["tilt"])
    if np.linalg.norm(known["offset"]) <= np.linalg.norm(known["offset"] + 2 * axle):
        return dict(values)
    return {
        **values,
        "offset": known["offset"] + 2 * axle,
        "misalignment": euler(R * [1, -1, -1]),
        "phase": -known["phase"],
        "speed": -known["speed"],
    }


def _constant(declared: Model, name: str) -> Array:
    """The value of a constant, whatever its shape."""
    return np.asarray(getattr(declared[name], "array", np.nan))


wheel = (
    wheel.starting(closed_form)
    .canonical(convention)
    .remarking(remarks)
    .with_estimator("four-step", four_step)
    .with_estimator("closed-form", closed_form)
)
