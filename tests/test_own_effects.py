"""A user's own effect says of itself what the shipped ones do: no name is special."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from casest import (
    DeclarationError,
    Residual,
    Run,
    UsageError,
    close,
    constant,
    effect,
    exp,
    model,
    param,
    quantity,
    signal,
)
from casest.diagnose.candidates.candidates import candidates
from casest.effects import (
    bias_course,
    bias_drift,
    harmonic,
    pulse,
    quadratic,
    second_harmonic,
    time_delay,
    warm_up,
)
from casest.effects.placing import placed_in, prepared
from casest.results.find import find_model


@model
def cell(force=signal("N"), v=signal("mV"), *, zero=param("mV"), gain=param("mV/N", start=1.0)):
    load = quantity("load", force, "N")
    reading = quantity("reading", zero + gain * load, "mV")
    return Residual(measured=v, predicted=reading, corrected=load)


@effect(on="output", columns={"warmth": "temperature"}, numbers={"about": "mean"})
def sagging(y, warmth, *, k=param("[y]/[warmth]"), about=constant(0.0)):
    return y + k * (warmth - about)


@effect(on="noise", seen_in="tails")
def shots(r):
    return exp(-((r / 6) ** 4))


def recorded(count=400, seed=3):
    """Loads with a temperature and a supply beside them; noise of 5 µV."""
    rng = np.random.default_rng(seed)
    force = 20 * np.sin(np.linspace(0, 31, count))
    warmth, supply = 30 + 5 * rng.standard_normal((2, count))
    v = 0.3 + 0.5 * force + 0.005 * rng.standard_normal(count)
    signals = {"force": force[:, None], "v": v[:, None]}
    run = Run.raw("cell", signals, units={"force": "N", "v": "mV"}, time=0.1 * np.arange(count))
    columns = {"case": warmth, "supply": supply}
    return replace(run, columns=columns, column_units={"case": "degC", "supply": "V"})


def shifted(run, by):
    return replace(run, signals={**run.signals, "v": run.signals["v"] + by[:, None]})


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("temperature", ["sagging(case)"]),
        ("other", ["sagging(supply)"]),
        ("any", ["sagging(case)", "sagging(supply)"]),
    ],
)
def test_an_effect_says_which_columns_are_looked_at_for_it(kind, expected):
    runs = prepared(cell, [recorded()])
    found, _ = candidates(cell, runs, [replace(sagging, columns=(("warmth", kind),))])
    assert [c.label for c in found] == expected


def test_an_angle_is_a_column_in_deg_or_rad_and_is_told_how_many_rad_that_is():
    run = recorded()
    turned = 3.0 * np.arange(400)
    run = replace(
        run,
        columns={
            **run.columns,
            **{"heading": turned, "slope": turned**2, "rate": turned**3, "theta_rad": turned**4},
        },
        column_units={**run.column_units, "heading": "deg", "slope": "rad", "rate": "deg/s"},
    )
    found, _ = candidates(cell, prepared(cell, [run]), [harmonic])
    assert [c.label for c in found] == [f"harmonic({n})" for n in ("heading", "slope", "theta_rad")]
    numbers = [float(dict(c.effect.declarations)["radian"].array) for c in found]
    assert numbers == pytest.approx([np.pi / 180, 1.0, 1.0])


@model
def encoder(shaft=signal("deg"), told=signal("deg"), *, gain=param(start=1.0)):
    return Residual(measured=told, predicted=quantity("turned", gain * shaft, "deg"))


def test_a_reading_is_no_angle_that_its_own_error_could_go_with():
    """Its noise is in it, and in the residual: what the sensor met explains, not what it said."""
    shaft = np.linspace(0, 700, 200)[:, None]
    run = Run.raw(
        "r", {"shaft": shaft, "told": 1.01 * shaft}, units={"shaft": "deg", "told": "deg"}
    )
    found, _ = candidates(encoder, prepared(encoder, [run]), [harmonic])
    assert [c.label for c in found] == ["harmonic(shaft)"]


def test_an_angle_that_a_model_of_any_unit_reads_has_harmonics_by_the_unit_of_the_record():
    """A resolver against an encoder: its error goes round once or twice with the very reference."""
    linear = find_model("linear")
    rng = np.random.default_rng(2)
    turn = rng.uniform(0, 360, (400, 1))
    told = turn + 1.7 * np.sin(2 * np.deg2rad(turn) + 0.4) + 0.02 * rng.standard_normal((400, 1))
    for unit, known in (("deg", ["harmonic(reference)"]), ("mV", [])):
        run = Run.raw("r", {"reference": turn, "reading": told}, units={"reference": unit})
        found, _ = candidates(linear, prepared(linear, [run]), [harmonic])
        assert [c.label for c in found] == known
    run = Run.raw(
        "r", {"reference": turn, "reading": told}, units=dict.fromkeys(run.signals, "deg")
    )
    closing = close(linear, [run], catalogue=(harmonic, second_harmonic, quadratic))
    assert [e.candidate.label for e in closing.effects] == ["second_harmonic(reference)"]
    size = [closing.after.values[f"second_harmonic(reference).{n}"] for n in ("cosine", "sine")]
    assert np.hypot(*size) == pytest.approx(1.7, rel=0.01)


def test_a_clock_that_another_effect_alone_reads_cannot_be_late():
    """Were that effect taken out again, it would be late of nothing: an internal error."""
    drifting = placed_in(bias_drift, cell)
    with pytest.raises(UsageError, match="it acts on 't'"):
        cell.with_effect(drifting).with_effect(time_delay)


def test_a_harmonic_of_a_column_without_a_unit_is_not_tried_and_says_why():
    run = recorded()
    run = replace(run, columns={**run.columns, "heading": np.arange(400.0)})
    asked = replace(harmonic, columns=(("channel", "=heading"),))
    found, skipped = candidates(cell, prepared(cell, [run]), [asked])
    assert not found
    assert "heading has no unit, and an angle is in deg or rad" in skipped[0].reason


def test_a_number_of_an_effect_is_what_data_say():
    run = recorded()
    ((candidate,), _) = candidates(cell, prepared(cell, [run]), [sagging])
    about = dict(candidate.effect.declarations)["about"]
    assert float(about.array) == pytest.approx(run.columns["case"].mean(), rel=1e-5)


def test_an_effect_with_as_many_unknowns_as_there_are_residuals_is_not_tried():
    for count, tried in ((8, 0), (9, 1)):  # two of the cell's, six of the course
        found, skipped = candidates(cell, prepared(cell, [recorded(count)]), [bias_course])
        assert len(found) == tried
        assert tried or skipped[-1].reason == "with it there are 8 unknowns for 8 residuals"


def test_moments_of_an_effect_are_searched_for():
    """Two samples off at either edge would move its size by less than its deviation."""
    run = recorded()
    there = (run.time > 12.03) & (run.time < 20.03)
    closing = close(cell, [shifted(run, 0.02 * there)], catalogue=[pulse])
    assert [f.candidate.label for f in closing.effects] == ["pulse"]
    numbers = dict(closing.effects[0].candidate.effect.declarations)
    assert float(numbers["start"].array) == pytest.approx(12.03, abs=0.25)
    assert float(numbers["stop"].array) == pytest.approx(20.03, abs=0.25)
    assert closing.after.values["pulse.k"] == pytest.approx(0.02, abs=4 * 0.005 / np.sqrt(80))


def test_a_time_constant_of_an_effect_is_searched_for_and_fitted():
    """Its size is that of what fades: the offset is the one that it ends at."""
    run = recorded()
    warmer = shifted(run, -0.02 * np.exp(-run.time / 6))
    closing = close(cell, [warmer], catalogue=[warm_up])
    assert [f.candidate.label for f in closing.effects] == ["warm_up"]
    for name, truth in (("warm_up.k", -0.02), ("warm_up.tau", 6.0), ("zero", 0.3)):
        assert abs(closing.after.values[name] - truth) < 4 * closing.after.std[name]


def test_neither_is_found_where_nothing_happens():
    assert close(cell, [recorded()], catalogue=[warm_up, pulse]).effects == ()


def test_an_own_effect_finds_its_column():
    run = recorded()
    warmth = run.columns["case"]
    found = close(cell, [shifted(run, 0.004 * (warmth - 30))], catalogue=[sagging])
    assert [f.candidate.label for f in found.effects] == ["sagging(case)"]
    k = found.after.values["sagging(case).k"]
    assert abs(k - 0.004) < 4 * found.after.std["sagging(case).k"]
    assert found.verdict == "extended"


def test_an_own_effect_on_the_noise_is_used_where_readings_lie_far_out():
    run = recorded()
    far = np.where(np.arange(400) % 50 == 7, 0.5, 0.0)
    found = close(cell, [shifted(run, far)], catalogue=[shots])
    assert [f.candidate.label for f in found.effects] == ["shots"]
    assert abs(found.after.values["zero"] - 0.3) < 4 * found.after.std["zero"]
    assert found.verdict == "adequate"
    assert close(cell, [run], catalogue=[shots]).effects == ()


@pytest.mark.parametrize(
    ("said", "message"),
    [
        (
            {"columns": {"heat": "any"}},
            "effect sag: columns= names 'heat', which is no argument that it reads",
        ),
        (
            {"columns": {"warmth": "warm"}},
            "effect sag: columns= says 'warm': give temperature or other or any or angle",
        ),
        (
            {"columns": {"warmth": "any", "supply": "any"}},
            "effect sag: columns= names 2 arguments, and one column is looked for",
        ),
        ({"numbers": {"at": "mean"}}, "numbers= names 'at', which is none of its parameters"),
        (
            {"numbers": {"k": "median"}},
            "numbers= says 'median': give mean or least or greatest or duration or radian",
        ),
        (
            {"profile": {"k": "moment"}},
            "effect sag: profile= says 'moment': give frequency or time or timescale or memory",
        ),
        (
            {"seen_in": "tails"},
            "seen_in= is for effects on the noise, and this one acts on 'output'",
        ),
        ({"seen_in": "spikes", "on": "noise"}, "seen_in= says 'spikes': give tails or random walk"),
    ],
)
def test_what_an_effect_cannot_say_is_refused_with_what_it_can(said, message):
    def sag(y, warmth, supply, *, k=param("1")):
        return y + k * warmth

    with pytest.raises(DeclarationError) as refused:
        effect(**{"on": "output", **said})(sag)
    assert message in str(refused.value)
