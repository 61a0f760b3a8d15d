"""What moves a whole world along with a body is seen by no record: symmetries, exactly applied.

Records are integrated by SciPy, and what changes no reading is the symmetry itself, applied to the
beginning of another integration. What a record allows is by differences of such integrations.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from casest import Run, atan2, cos, signal, sin, sqrt
from casest.dynamics import Motion, angle, dynamics, measured, state
from casest.results.observability import observe_motion

T = np.arange(0, 20, 0.1)
SIGMA = 0.05
POSE = np.array([3.0, 1.0, 0.3])
OTHER = np.array([-2.0, 4.0])


def speed(t):
    return 1 + 0.5 * np.sin(0.7 * t)


def turning(t):
    return 0.3 * np.cos(0.5 * t)


def posed(x, y, heading, v, turn):
    return {"x": v * cos(heading), "y": v * sin(heading), "heading": turn}


def pose(std=1.0, intensity=0.0):
    return {
        "x": state("m", start=3.1, std=std, intensity=intensity),
        "y": state("m", start=0.9, std=std, intensity=intensity),
        "heading": state("rad", start=0.35, std=std),
    }


def distance(x, y, b=(0.0, 0.0)):
    return sqrt((x - b[0]) ** 2 + (y - b[1]) ** 2)


P = pose()


@dynamics
def beacon(v=signal("m/s"), turn=signal("rad/s"), d=signal("m"), *, x=P["x"], y=P["y"],
           heading=P["heading"]):  # fmt: skip
    """A distance to one beacon."""
    out = measured(d, distance(x, y), std=SIGMA)
    return Motion(rates=posed(x, y, heading, v, turn), outputs=(out,))


@dynamics
def compass(v=signal("m/s"), turn=signal("rad/s"), d=signal("m"), c=signal("rad"), *, x=P["x"],
            y=P["y"], heading=P["heading"]):  # fmt: skip
    """And a compass."""
    out = measured(d, distance(x, y), std=SIGMA), measured(c, angle(heading), std=0.02)
    return Motion(rates=posed(x, y, heading, v, turn), outputs=out)


@dynamics
def two(v=signal("m/s"), turn=signal("rad/s"), d=signal("m"), e=signal("m"), *, x=P["x"],
        y=P["y"], heading=P["heading"]):  # fmt: skip
    """Two beacons."""
    out = (
        measured(d, distance(x, y), std=SIGMA),
        measured(e, distance(x, y, tuple(OTHER)), std=SIGMA),
    )
    return Motion(rates=posed(x, y, heading, v, turn), outputs=out)


@dynamics
def slam(v=signal("m/s"), turn=signal("rad/s"), d=signal("m"), e=signal("m"), *, x=P["x"],
         y=P["y"], heading=P["heading"], bx=state("m", start=0.1, std=1.0),
         by=state("m", start=-0.1, std=1.0), ex=state("m", start=-2.1, std=1.0),
         ey=state("m", start=3.9, std=1.0)):  # fmt: skip
    """Two beacons, and nobody knows where."""
    out = (
        measured(d, distance(x, y, (bx, by)), std=SIGMA),
        measured(e, distance(x, y, (ex, ey)), std=SIGMA),
    )
    return Motion(rates=posed(x, y, heading, v, turn), outputs=out)


@dynamics
def target(vx=signal("m/s"), vy=signal("m/s"), b=signal("rad"), *,
           x=state("m", start=30.0, std=5.0), y=state("m", start=20.0, std=5.0),
           ux=state("m/s", start=-1.0, std=1.0), uy=state("m/s", start=0.5, std=1.0)):  # fmt: skip
    """A target in uniform motion, seen from a ship with velocity (vx, vy): its bearing."""
    rates = {"x": ux - vx, "y": uy - vy, "ux": 0 * ux, "uy": 0 * uy}
    return Motion(rates=rates, outputs=(measured(b, angle(atan2(y, x)), std=0.002),))


def driven(start, speed=speed, turning=turning):
    """The pose over time."""

    def rate(t, p):
        return [speed(t) * np.cos(p[2]), speed(t) * np.sin(p[2]), turning(t)]

    return solve_ivp(rate, (0, T[-1]), start, t_eval=T, rtol=1e-11, atol=1e-12).y.T


def ranges(p, beacon=(0.0, 0.0)):
    return np.hypot(p[:, 0] - beacon[0], p[:, 1] - beacon[1])


def run_of(model, rng=None, v_noise=0.0, **readings):
    """A record, with noise where there is an rng."""
    signals = {"v": speed(T), "turn": turning(T)} | readings
    if rng is not None:
        sigma = {"v": v_noise, "d": SIGMA, "e": SIGMA, "c": 0.02, "b": 0.002}
        signals = {n: s + sigma.get(n, 0.0) * rng.standard_normal(len(T)) for n, s in signals.items()}
    known = {s.name: signals[s.name][:, None] for s in model.signals}
    return Run.raw("r", known, units={s.name: s.unit for s in model.signals}, time=T)
