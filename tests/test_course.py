"""Records of any length: piece by piece the numbers of the whole at once, in constant memory."""

from __future__ import annotations

import tracemalloc

import flights
import numpy as np
import pytest
from test_dynamics import turning_gravity

from casest import Run, cross, norm_2, signal
from casest.dynamics import Motion, constraint, course, dynamics, filtered, gramian, measured, state
from casest.dynamics.course import followed
from casest.dynamics.gramian import Products
from casest.dynamics.transition import linearised
from casest.results.states import follow, states_csv
from casest_problems.bias_gravity import bias_gravity, bias_gravity_magnitude

NAMES = ("x", "std", "smoothed", "smoothed_std", "innovations", "expected_std",
         "normalised_innovations")  # fmt: skip


@dynamics
def near_the_ground(
    omega=signal(3, "rad/s"), a=signal(3, "m/s^2"), *, g=state(3, "m/s^2", start=(0.0, 0.0, 9.8))
):
    """Gravity from its direction, its length known."""
    g_of = -9.8 * g / norm_2(g)
    rates = {"g": -cross(omega, g)}
    known = (constraint(norm_2(g), 9.8),)
    return Motion(rates=rates, outputs=(measured(a, g_of, intensity=0.1),), constraints=known)


def record(count, kind="even"):
    """A flight at 50 Hz; `uneven`: rows dropped, a gap, readings missing, some in part."""
    rng = np.random.default_rng(0)
    t = 0.02 * np.arange(count)
    if kind == "uneven":
        t = t[np.sort(rng.choice(count, count * 9 // 10, replace=False))]
        t[count // 3 :] += 5.0
    run = flights.record(flights.in_the_air(), t, rng)
    if kind == "uneven":
        run.signals["v"][100:140] = np.nan
        run.signals["v"][200, 1] = np.nan
    return run


MODELS = {
    "linear": bias_gravity,
    "noisy inputs": bias_gravity.sensing(omega=1e-8, a=1e-8),
    "known": bias_gravity_magnitude,
    "nonlinear": turning_gravity,
    "nonlinear and noisy": turning_gravity.sensing(omega=1e-8),
    "nonlinear and known": near_the_ground,
}
#: At uneven times each step of a linear model has an exponential of its own.
DEAR = pytest.mark.long


@pytest.mark.parametrize(
    ("model", "kind"),
    [
        pytest.param(
            *(model, kind),
            id=f"{name}, {kind}",
            marks=[DEAR] * (kind == "uneven" and name != "nonlinear"),
        )
        for name, model in MODELS.items()
        for kind in ("even", "uneven")
    ],
)
def test_in_pieces_every_number_is_the_wholes_to_rounding(model, kind, monkeypatch):
    monkeypatch.setattr(course, "PIECE", 137)
    monkeypatch.setattr(course, "LARGEST", 0)
    run = record(420, kind)
    whole, pieces = filtered(model, run), followed(model, run)
    assert pieces.settled == whole.settled
    for name in NAMES:
        np.testing.assert_allclose(getattr(pieces, name), getattr(whole, name), 1e-9, 1e-9)


@pytest.mark.parametrize("count", [2, 137, 138, 139])
def test_a_piece_may_end_anywhere(count, monkeypatch):
    monkeypatch.setattr(course, "PIECE", 137)
    run = record(count)
    np.testing.assert_array_equal(followed(bias_gravity, run).smoothed,
                                  filtered(bias_gravity, run).smoothed)  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("kind", ["even", "uneven"])
def test_the_gramian_of_any_window_is_that_of_its_record(kind, monkeypatch):
    monkeypatch.setattr(gramian, "PIECE", 256)
    run = record(900, kind)
    products = Products.of(bias_gravity, run)
    for first, last in ((0, len(run) - 1), (0, 400), (150, 162), (130, 600), (256, 512)):
        part = linearised(bias_gravity, run.take(slice(first, last + 1)), pace=products.pace)
        expected = gramian.gramian(bias_gravity, part)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert np.abs((products.gramian(first, last) - expected) / scale).max() < 1e-12


def peak(work, run, model=bias_gravity):
    """Bytes at the worst moment beyond the record and what is returned."""
    tracemalloc.start()
    try:
        found = work(model, run)
        left, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert found is not None
    return most - left


@pytest.mark.long
@pytest.mark.parametrize("work", [followed, Products.of])
def test_memory_beyond_the_record_and_the_result_is_constant(work, monkeypatch):
    """A byte for every sixteen that a record of nine numbers in a row has."""
    monkeypatch.setattr(course, "PIECE", 512)
    monkeypatch.setattr(gramian, "PIECE", 512)
    runs = [record(n) for n in (2000, 10_000)]
    work(bias_gravity, runs[0])  # what is made once
    few, many = (peak(work, run) for run in runs)
    assert many - few < 8000 * 100


@pytest.mark.long
def test_beside_noisy_inputs_a_pass_keeps_what_it_goes_along_twice(monkeypatch):
    """States, and of the noise on their errors 21 numbers, twice; beside them the inputs and std:
    fewer than 90 numbers a sample, where one covariance and its steps have 243."""
    monkeypatch.setattr(course, "PIECE", 64)
    monkeypatch.setenv("CASEST_KERNEL", "off")
    runs = [record(n) for n in (300, 700)]
    model = MODELS["noisy inputs"]
    followed(model, runs[1])  # what is made once
    few, many = (peak(followed, run, model) for run in runs)
    assert many - few < 400 * 90 * 8


def test_the_file_of_states_is_written_in_pieces_and_holds_every_digit(monkeypatch):
    monkeypatch.setattr("casest.results.states.ROWS", 64)
    found = follow(bias_gravity, record(300)).filtered
    pieces = list(states_csv(found))
    assert len(pieces) == 5
    rows = [[float(v) for v in line.split(",")] for line in "".join(pieces).splitlines()[1:]]
    expected = (found.time[:, None], found.x, found.std, found.smoothed, found.smoothed_std)
    np.testing.assert_array_equal(rows, np.hstack(expected))


def test_a_motion_that_is_not_linear_is_followed_as_before():
    from test_dynamics import turning_gravity

    run = record(200)
    signals = {name: run.signals[name] for name in ("omega", "a")}
    run = Run.raw("r", signals, units={}, time=run.time)
    np.testing.assert_array_equal(
        followed(turning_gravity, run).smoothed, filtered(turning_gravity, run).smoothed
    )
