"""What moves a whole world along with a body is seen by no record: symmetries, exactly applied.

Records are integrated by SciPy, and what changes no reading is the symmetry itself, applied to the
beginning of another integration. What a record allows is by differences of such integrations.
"""

import re

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, solve_ivp

from casest import Run, atan2, cos, signal, sin, sqrt
from casest.dynamics import Motion, angle, dynamics, measured, state
from casest.dynamics.information import without
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


P = {
    "x": state("m", start=3.1, std=1.0),
    "y": state("m", start=0.9, std=1.0),
    "heading": state("rad", start=0.35, std=1.0),
}


def distance(x, y, b=(0.0, 0.0)):
    return sqrt((x - b[0]) ** 2 + (y - b[1]) ** 2)


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


def driven(start):
    """The pose over time."""

    def rate(t, p):
        return [speed(t) * np.cos(p[2]), speed(t) * np.sin(p[2]), turning(t)]

    return solve_ivp(rate, (0, T[-1]), start, t_eval=T, rtol=1e-11, atol=1e-12).y.T


def ranges(poses, beacon=(0.0, 0.0)):
    """Distances to a beacon over time."""
    return np.hypot(poses[:, 0] - beacon[0], poses[:, 1] - beacon[1])


def turned(p, angle):
    """A pose or a place after a turn of the world."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * p[0] - s * p[1], s * p[0] + c * p[1], *(p[2:] + angle)])


def passing(vx, vy, start=(30.0, 20.0), motion=(-1.0, 0.5)):
    """The bearing of a target in uniform motion over time."""
    x = start[0] + cumulative_trapezoid(motion[0] - vx, T, initial=0)
    y = start[1] + cumulative_trapezoid(motion[1] - vy, T, initial=0)
    return np.arctan2(y, x)


def record(model, noise=None, **readings):
    """A run; `noise` of the signals, white, one reading."""
    rng = np.random.default_rng(1)
    signals = {"v": speed(T), "turn": turning(T)} | readings
    known = {}
    for s in model.signals:
        own = (noise or {}).get(s.name, 0.0) * rng.standard_normal(len(T))
        known[s.name] = (signals[s.name] + own)[:, None]
    return Run.raw("r", known, units={s.name: s.unit for s in model.signals}, time=T)


HOW = {
    "exact": (beacon, {}),
    "with noise": (beacon, {"d": SIGMA}),
    "with noise of an input": (beacon.sensing(v=0.1**2 * 0.1), {"d": SIGMA, "v": 0.1}),
    "driven": (beacon.driven(x=0.01, y=0.01), {"d": SIGMA}),
}


@pytest.mark.parametrize("how", HOW)
def test_a_turn_about_the_beacon_is_seen_by_no_record_of_its_distance(how):
    model, noise = HOW[how]
    d = ranges(driven(POSE))
    assert np.allclose(d, ranges(driven(turned(POSE, 0.7))), atol=1e-9)
    # A driven one is pushed by what no input shows.
    d = d + (0.3 * np.sin(T) if how == "driven" else 0.0)
    told = observe_motion(model, record(model, noise, d=d))
    assert (told.rank, told.structural_rank) == (2, 2)
    assert told.std == {"x": [None], "y": [None], "heading": [None]}
    (words,) = told.unobservable
    # By a small angle a body moves across by its distance, in whatever direction it is.
    x, y, heading = (float(n) for n in re.findall(r"[-+][0-9.]+", words))
    assert np.hypot(x, y) / heading == pytest.approx(np.hypot(*POSE[:2]), rel=0.1)
    assert max(told.windows.smallest_eigenvalue) == 0


def test_a_compass_or_a_second_beacon_shows_the_turn():
    poses = driven(POSE)
    seen = observe_motion(compass, record(compass, d=ranges(poses), c=poses[:, 2]))
    assert seen.rank == 3
    assert observe_motion(two, record(two, d=ranges(poses), e=ranges(poses, OTHER))).rank == 3


def test_what_a_record_allows_is_that_of_differences_between_integrations():
    """The information of the distances by two beacons, by central differences."""

    def readings(start):
        return np.concatenate([ranges(driven(start)), ranges(driven(start), OTHER)])

    steps = 1e-5 * np.eye(3)
    J = np.column_stack([(readings(POSE + h) - readings(POSE - h)) / 2e-5 for h in steps])
    expected = np.sqrt(np.diag(np.linalg.inv(J.T @ J))) * SIGMA
    poses = driven(POSE)
    told = observe_motion(two, record(two, d=ranges(poses), e=ranges(poses, OTHER))).std
    found = np.ravel([told[name] for name in ("x", "y", "heading")])
    assert np.allclose(found, expected, rtol=0.02)


def test_beacons_that_nobody_knows_leave_the_world_free_to_move_and_turn():
    def seen(pose, one, other):
        return ranges(driven(pose), one), ranges(driven(pose), other)

    before, one = seen(POSE, np.zeros(2), OTHER), np.array([1.0, -2.0])
    after = seen(turned(POSE, 0.4) + np.array([1.0, -2.0, 0.0]), one, turned(OTHER, 0.4) + one)
    assert np.allclose(before, after, atol=1e-9)
    model = slam.sensing(v=0.1**2 * 0.1)
    told = observe_motion(model, record(model, {"v": 0.1}, d=before[0], e=before[1]))
    assert (told.rank, told.unknowns, len(told.unobservable)) == (4, 7, 3)


@pytest.mark.parametrize("model", [target, target.driven(ux=1e-3, uy=1e-3)])
def test_from_a_ship_that_keeps_its_course_a_target_may_be_near_and_slow_or_far_and_fast(model):
    """Not structural: a turn of the ship would show it."""
    steady = {"vx": 1 + 0 * T, "vy": 0.3 + 0 * T}
    b = passing(**steady)
    farther = (60.0, 40.0), (-3.0, 0.7)  # twice as far off, and twice as fast beside the ship
    assert np.allclose(b, passing(**steady, start=farther[0], motion=farther[1]))
    told = observe_motion(model, record(model, {"b": 0.002}, **steady, b=b))
    assert (told.rank, told.structural_rank) == (3, 4)
    turns = {"vx": 1 + np.sin(0.5 * T), "vy": 0.3 + np.cos(0.7 * T)}
    told = observe_motion(model, record(model, {"b": 0.002}, **turns, b=passing(**turns)))
    assert told.rank == 4


@dynamics
def pond(
    counted=signal("1"),
    *,
    fish=state(start=100.0),
    seen=state(start=0.1),
    death=state("1/s", start=0.1),
    catch=state("1/s", start=0.1),
):
    """Fish of which a share is counted."""
    rates = {"fish": -(death + catch) * fish}
    return Motion(rates=rates, outputs=(measured(counted, seen * fish, std=0.05),))


def test_what_one_hidden_number_takes_along_is_not_determined_either():
    """More fish and a smaller share are counted alike, and so are deaths and a catch: four numbers,
    and a fish more moves the share by a thousandth, which is more than the count would allow."""
    counts = 0.1 * 100 * np.exp(-0.2 * T)
    assert np.allclose(counts, 0.05 * 200 * np.exp(-(0.13 + 0.07) * T))
    noisy = counts + 0.05 * np.random.default_rng(0).standard_normal(len(T))
    told = observe_motion(pond, Run.raw("r", {"counted": noisy[:, None]}, units={}, time=T))
    assert told.rank == 2
    assert told.std == {name: [None] for name in ("fish", "seen", "death", "catch")}
    product, rates = told.unobservable
    assert product.startswith("fish +1, seen -")
    assert float(re.findall(r"-[0-9.]+", product)[0]) == pytest.approx(-0.001, rel=0.02)
    assert rates == "death +1, catch -1 together change no reading"


def test_what_is_told_whatever_some_directions_are_is_the_inverse_of_the_others_covariance():
    M = np.random.default_rng(0).standard_normal((6, 6))
    M[:, 3] *= 1e5
    W, P = M.T @ M, np.linalg.inv(M.T @ M)
    left = without(W, np.eye(6)[:, 4:])
    assert np.allclose(left[:4, :4], np.linalg.inv(P[:4, :4]), rtol=1e-9)
    assert not left[4:].any()
    assert np.linalg.matrix_rank(without(M.T @ M, 4) / np.outer(np.abs(M).max(0), np.abs(M).max(0)),
                                 tol=1e-9) == 4  # fmt: skip
