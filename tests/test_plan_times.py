"""`casest plan` of a model with `integrate(…)`: when to read, beside every choice of times."""

from __future__ import annotations

import csv
import json
from itertools import combinations

import numpy as np
import pytest

from casest.cli import run

FALLING = '''
from casest import Residual, constant, integrate, model, param, signal, vertcat

@model
def fall(
    t=signal("s"),
    h=signal("m"),
    *,
    start=param(2, ("m", "m/s"), start=[4.0, 0.0]),
    drag=param("1/s", start=0.2),
    g=constant(9.81, "m/s^2"),
):
    """A height that falls with linear drag."""
    x = integrate(lambda x: vertcat(x[1], -g - drag * x[1]), start, over=t)
    return Residual(measured=h, predicted=x[0])

@model
def motor(
    t=signal("s"), u=signal("V", held=True), w=signal("rad/s"),
    *,
    tau=param("s", start=2.0), gain=param("rad/(s V)", start=3.0),
):
    """A motor that follows its voltage."""
    x = integrate(lambda x: (gain * u - x) / tau, 0.0, over=t)
    return Residual(measured=w, predicted=x)
'''


@pytest.fixture
def declared(tmp_path):
    path = tmp_path / "models.py"
    path.write_text(FALLING)
    return path


def falling_slopes(t, drag=0.2, v0=0.0, g=9.81):
    """∂h/∂(height, speed, drag) of h = h0 + v∞ t + (v0 − v∞)(1 − e^(−kt))/k, v∞ = −g/k, by hand."""
    e = np.exp(-drag * t)
    in_drag = (
        g * t / drag**2
        + (-g / drag**2) * (1 - e) / drag
        + (v0 + g / drag) * (t * e / drag - (1 - e) / drag**2)
    )
    return np.column_stack([np.ones_like(t), (1 - e) / drag, in_drag])


def planned(capsys, *words):
    capsys.readouterr()
    assert run(["plan", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_times_are_the_best_of_every_choice_and_their_stds_those_of_the_closed_form(
    declared, capsys, tmp_path
):
    words = ["--duration", 2, "--rate", 6, "--sensor-noise", "h=1 cm", "--count", 4]
    found = planned(capsys, f"{declared}:fall", *words, "-o", tmp_path / "out")
    t = [m["signals"]["t"] for m in found["measurements"]]
    assert t == sorted(set(t))
    J = falling_slopes(np.arange(13) / 6) / 0.01
    best = max(
        combinations(range(13), 4), key=lambda c: np.linalg.slogdet(J[list(c)].T @ J[list(c)])[1]
    )
    assert t == pytest.approx(np.array(best) / 6)
    own = J[list(best)]
    std = np.sqrt(np.diag(np.linalg.inv(own.T @ own)))
    assert [u["after"] for u in found["unknowns"].values()] == pytest.approx(std, rel=1e-5)
    # what is proved is true: the tangent's bound is no better than the best, and near it
    assert 0.8 < found["best_possible"]["share_of_std"] <= 1 + 1e-9
    text = (tmp_path / "out" / "plan.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()))
    assert [float(r["t [s]"]) for r in rows] == pytest.approx(t)


def test_a_goal_takes_as_many_times_as_it_needs(declared, capsys):
    words = ["--duration", 2, "--rate", 6, "--sensor-noise", "h=0.01", "--until", "drag<0.0025"]
    found = planned(capsys, f"{declared}:fall", *words)
    J = falling_slopes(np.arange(13) / 6) / 0.01

    def reached(count):
        return min(
            np.linalg.inv(J[list(c)].T @ J[list(c)])[2, 2] for c in combinations(range(13), count)
        )

    fewest = next(k for k in range(3, 14) if reached(k) <= 0.0025**2)
    assert found["best_possible"]["at_least"] <= fewest <= found["count"] <= fewest + 1
    assert found["goals"][0]["after"] <= 0.0025


def test_the_course_of_an_input_is_a_table(declared, capsys, tmp_path):
    # a step of 5 V at t = 1 s: w = 15 (1 − e^(−(t − 1)/2)) from then on
    t = np.arange(0, 6.01, 0.5)
    u = np.where(t >= 1.0, 5.0, 0.0)
    lines = ["t [s],u [V]", *(f"{a:g},{b:g}" for a, b in zip(t, u, strict=True))]
    (tmp_path / "steps.csv").write_text("\n".join(lines) + "\n")
    words = ["--candidates", tmp_path / "steps.csv", "--sensor-noise", "w=0.1", "--count", 2]
    found = planned(capsys, f"{declared}:motor", *words)
    s = np.maximum(t - 1, 0)
    e = np.exp(-s / 2)
    J = np.column_stack([-15 * s / 4 * e, 5 * (1 - e)]) / 0.1
    best = max(combinations(range(len(t)), 2), key=lambda c: abs(np.linalg.det(J[list(c)])))
    assert [m["signals"]["t"] for m in found["measurements"]] == pytest.approx(t[list(best)])
    own = J[list(best)]
    std = np.sqrt(np.diag(np.linalg.inv(own.T @ own)))
    assert [x["after"] for x in found["unknowns"].values()] == pytest.approx(std, rel=1e-5)


def test_what_is_missing_or_too_much_is_one_sentence(declared, capsys):
    def refused(name, *words):
        capsys.readouterr()
        assert run(["plan", f"{declared}:{name}", *map(str, words)]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        return said

    long = ("--duration", 1, "--rate", 5)
    assert "--duration" in refused("fall")
    assert "what u is over the run" in refused("motor", *long)
    assert "one can vary u" in refused("motor", *long, "--vary", "w=3")
    assert "6 times" in refused("fall", *long, "--count", 30)
    assert "longer run" in refused(
        "fall", *long, "--sensor-noise", "h=0.01", "--until", "drag<1e-6"
    )
    assert "each time can be read once" in refused("fall", *long, "--budget", 3)
