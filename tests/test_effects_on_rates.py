"""What the rate of a state lacks is named: equations integrated by SciPy with a term more."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casest
from casest import Run, UsageError, effects, fabs, param, sign, signal
from casest.cli import run as casest_run
from casest.declaration.effect import RATES, effect
from casest.diagnose.loop import close
from casest.dynamics import Motion, dynamics, measured, state

T = np.arange(0, 12, 0.1)
ON_RATES = [e for e in effects.CATALOGUE if e.on == RATES]


@dynamics
def coasting(
    w=signal("rad/s"),
    *,
    angle=state("rad", known=True),
    speed=state("rad/s", start=9.0),
    viscous=param("1/s", start=0.1),
):
    """A flywheel that coasts."""
    return Motion(rates={"angle": speed, "speed": -viscous * speed}, outputs=(measured(w, speed),))


@dynamics
def room(
    outside=signal("degC"),
    inside=signal("degC"),
    *,
    warmth=state("degC", start=20.0),
    leak=param("1/s", start=0.3),
):
    """A room that cools."""
    rate = leak * (outside - warmth)
    return Motion(rates={"warmth": rate}, outputs=(measured(inside, warmth),))


def followed(rate, start, sigma, seed=0):
    """One state along T, read with noise."""
    found = solve_ivp(rate, (0, T[-1]), [start], "DOP853", T, rtol=1e-11, atol=1e-11).y[0]
    return found + sigma * np.random.default_rng(seed).standard_normal(len(T))


def recorded(signals, columns=None):
    made = Run.raw("r", {n: v[:, None] for n, v in signals.items()}, units={}, time=T)
    return casest.data.run.replace(made, columns=columns or {})


@pytest.mark.parametrize(
    ("name", "term"),
    [
        pytest.param("dry_friction", lambda w: 0.3, marks=pytest.mark.long),
        pytest.param("quadratic_damping", lambda w: 0.02 * w**2, marks=pytest.mark.long),
    ],
)
def test_what_slows_a_flywheel_besides_viscous_friction_is_named(name, term):
    w = followed(lambda t, w: -0.1 * w - term(w), 10.0, 0.01)
    found = close(coasting.calibration, [recorded({"w": w})], catalogue=ON_RATES)
    assert [f.candidate.label for f in found.effects] == [f"{name}(speed)"]
    assert found.verdict == "extended"
    estimate = found.after
    truth = {"viscous": 0.1, f"{name}(speed).k": 0.3 if name == "dry_friction" else 0.02}
    for parameter, expected in truth.items():
        assert abs(estimate.values[parameter] - expected) < 4 * estimate.std[parameter]


def cooling(tmp_path, folder="room.csv", seed=0):
    """A file of a room that the sun warms as well, 0.05 K/s for each kW."""
    rng = np.random.default_rng(seed)
    outside = 5 + 3 * np.sin(0.8 * T + rng.uniform(0, 6))
    sun = np.maximum(np.sin(2 * np.pi * T / 5 + rng.uniform(0, 6)), 0)

    def at(values, t):
        return np.interp(t, T, values)

    inside = followed(lambda t, x: 0.3 * (at(outside, t) - x) + 2.5 * at(sun, t), 20.0, 0.02, seed)
    file = tmp_path / folder
    rows = np.column_stack([T, outside, inside, sun])
    heading = "t [s],outside [degC],inside [degC],sun [kW]"
    np.savetxt(file, rows, "%.6f", ",", header=heading, comments="")
    return str(file)


ROOM = """
from casest import param, signal
from casest.dynamics import Motion, dynamics, measured, state

@dynamics
def room(
    outside=signal("degC"),
    inside=signal("degC"),
    *,
    warmth=state("degC", start=20.0),
    leak=param("1/s", start=0.3),
):
    rate = leak * (outside - warmth)
    return Motion(rates={"warmth": rate}, outputs=(measured(inside, warmth),))
"""


@pytest.mark.long
def test_a_column_that_drives_a_state_is_named_and_a_second_record_is_foretold(tmp_path, capsys):
    (tmp_path / "room.py").write_text(ROOM)
    first, second = cooling(tmp_path), cooling(tmp_path, "second.csv", 1)
    words = ["close", str(tmp_path / "room.py"), first, "--holdout", second, "--json"]
    assert casest_run(words) == 0
    found = json.loads(capsys.readouterr().out)
    (added,) = found["effects"]
    assert (added["name"], added["on"], added["column"]) == ("forcing", "rate of warmth", "sun")
    # Others gain nine tenths of it, and leave many times what it leaves.
    assert added["indistinguishable_from"] == []
    k = found["after"]["parameters"]["forcing(sun)@warmth.k"]
    assert abs(k["value"] - 2.5) < 4 * k["std"]
    assert k["unit"] == "(K/s)/kW"
    held_out = [found[when]["rmse_holdout"] for when in ("before", "after")]
    assert held_out[0] > 0.3
    assert held_out[1] < 0.03


def test_an_effect_on_a_rate_is_given_by_name_and_by_the_user():
    model = coasting.calibration
    assert list(model.rates) == ["rate of speed"]  # the rate of an angle is its speed by definition
    named = model.with_effect(effects.dry_friction, columns={"x": "speed"})
    assert [p.name for p in named.parameters][-1] == "dry_friction(speed).k"
    assert [p.units for p in named.parameters][-1] == ("(rad/s^2)",)

    @effect(on="rate of speed")
    def drag(r, speed=signal(), *, k=param("1/rad")):
        return r - k * speed * fabs(speed)

    assert [p.name for p in model.with_effect(drag).parameters][-1] == "drag.k"
    with pytest.raises(UsageError, match="it acts on the rate of a state, say of which; it has"):
        model.with_effect(effects.dry_friction, columns={"x": "angle"})


def test_an_effect_of_the_catalogue_is_what_the_same_term_in_the_declaration_is():
    @dynamics
    def whole(
        w=signal("rad/s"),
        *,
        angle=state("rad", known=True),
        speed=state("rad/s", start=9.0),
        viscous=param("1/s", start=0.1),
        dry=param("rad/s^2"),
    ):
        rate = -viscous * speed - dry * sign(speed)
        return Motion(rates={"angle": speed, "speed": rate}, outputs=(measured(w, speed),))

    run = recorded({"w": followed(lambda t, w: -0.1 * w - 0.3, 10.0, 0.01)})
    added = coasting.calibration.with_effect(effects.dry_friction, columns={"x": "speed"})
    one, other = (casest.attempt(m, [run], intervals=False) for m in (whole.calibration, added))
    assert other.values["dry_friction(speed).k"] == pytest.approx(one.values["dry"], rel=1e-7)
