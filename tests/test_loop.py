"""The loop on worlds whose cause is known: what is named, what is left open, what is no effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import simulators as sim
import worlds
from msgspec.structs import replace as changed

import casest as c
from casest import Run
from casest.diagnose.cross_validation import rms
from casest.diagnose.loop import close
from casest.diagnose.misfit.left import predictions
from casest.effects import CATALOGUE
from casest.leastsquares.problem import Problem
from casest.results.closing import Effect, Unexplained, closing_result
from casest.results.find import find_model
from casest.results.fitted import Samples
from casest.results.verdict import sentence, undecided


def record(world, seed=0):
    """The world's record as it would be read from a file."""
    units = {name: world.units.get(name) for name in world.signals}
    run = Run.raw(world.model, dict(world.signals), units=units, time=world.time)
    degrees = {name: "degC" if name == "temperature" else None for name in world.columns}
    n = len(world.block)
    run = replace(run, columns=dict(world.columns), column_units=degrees, block=world.block)
    run = replace(run, count=np.full(n, world.count))
    if world.count > 1:
        rng, freedom = np.random.default_rng(seed), world.count - 1
        scatter = world.sigma * np.sqrt(rng.chisquare(freedom, (n, 3)) / freedom)
        run = replace(run, spread={world.read: scatter})
    return run


def declared(world):
    model = find_model(world.model)
    return model.having(norm=sim.GRAVITY) if world.model.startswith("norm") else model


def closed(place, seed, effects, **options):
    seed = seed if isinstance(seed, list) else [seed]
    world = worlds.made(place, seed, effects, **options)
    return close(declared(world), [record(world)]), world


def labels(closing):
    return [f.candidate.label for f in closing.effects]


@pytest.mark.parametrize("seed", [31, pytest.param(32, marks=pytest.mark.long)])
def test_a_step_is_found_in_poses_that_show_their_norm_only(seed):
    """The residual of a norm has no axes: where it jumps, cannot be seen in it directly."""
    closing, world = closed("norm", seed, {"bias_step": 0.12})
    assert labels(closing) == ["bias_step"]
    moment = dict(closing.effects[0].candidate.effect.declarations)["when"]
    assert abs(float(moment.array) - 0.37 * world.time[-1]) < 0.05 * world.time[-1]
    assert closing.verdict == "extended"


SIGN = pytest.mark.xfail(
    strict=True,
    reason="gain_by_sign comes first (score 65.1 against 59.7 for quadratic, a rival), and "
    "the pair with channel_bias is never tried: its score alone is -5.8, behind six others",
)


@pytest.mark.long
@pytest.mark.parametrize("seed", [7, 9, 11, pytest.param(8, marks=SIGN)])
def test_two_causes_in_few_poses_are_found_though_neither_alone_is_confirmed(seed):
    closing, _ = closed("norm", seed, {"quadratic": 3e-3, "channel_bias": 6.0})
    assert set(labels(closing)) == {"quadratic", "channel_bias(supply)"}


@pytest.mark.long
def test_an_axis_that_was_nothing_beside_what_was_missing_is_filled_in_again():
    """The slope over temperature comes first, while the bent response still looks like noise."""
    seed = [10001, *b"two", *b"norm", *b"cubic+temperature_bias"]
    closing, _ = closed("norm", seed, {"cubic": 4.5e-4, "temperature_bias": 0.045})
    assert labels(closing) == ["temperature_bias(temperature)", "cubic"]
    assert [name for f in closing.effects for name in f.names] == [
        "temperature_bias(temperature).k",
        "cubic.k",
    ]


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4])
def test_a_dead_zone_is_named_and_its_width_found(seed):
    closing, _ = closed("table", seed, {"dead_zone": 0.12})
    assert labels(closing) == ["dead_zone"]
    width, std = (getattr(closing.after, k)["dead_zone.width"] for k in ("values", "std"))
    assert np.all(np.abs(width - 0.12 * np.abs(worlds.SHARES)) < 5 * std)


@pytest.mark.long
def test_a_bent_course_over_temperature_follows_it_and_is_no_step():
    """An exponential: the curve over temperature, or a formula in it."""
    closing, world = closed("table", 5, {"warm_exp": 0.03})
    assert labels(closing) in (["temperature_curve(temperature)"], ["formula"])
    assert "channel" in dict(closing.effects[-1].candidate.effect.columns) or (
        "temperature" in closing.effects[-1].candidate.effect.formula
    )
    assert rms(closing.after_held_out) < 1.1 * world.sigma


@pytest.mark.long
def test_a_formula_that_leaves_nothing_stands_alone():
    """A step that is taken for a part of the product would pull the parameters away."""
    identity = [3, *b"elsewhere", *b"table", *b"product"]
    world = worlds.made("table", identity, {"product": 0.04})
    closing = close(declared(world), [record(world, identity)])
    assert labels(closing) == ["formula"]
    assert rms(closing.after_held_out) < 1.02 * world.sigma
    assert "formula" not in {r.name for r in closing.refused}


@pytest.mark.long
def test_no_formula_stands_for_an_effect_whose_fit_is_refused():
    identity = [11, *b"one", *b"table", *b"dead_zone", *b"medium"]
    world = worlds.made("table", identity, {"dead_zone": 0.03})
    closing = close(declared(world), [record(world, identity)])
    assert labels(closing) == []
    assert closing.verdict == "unexplained"
    assert closing.undecided.names[0] == "dead_zone"
    assert "formula" not in closing.undecided.names
    reasons = {r.name: r.reason for r in closing.refused}
    assert reasons["dead_zone"].startswith("its fit is refused")


@pytest.mark.long
def test_all_that_small_nonlinearity_may_be_is_named():
    """On one tilt four shapes of response look alike until they are large."""
    closing, _ = closed("wheel", 4, {"quadratic": 3e-4})
    (found,) = closing.effects
    assert "quadratic" in {found.candidate.label, *found.indistinguishable_from}


@c.model
def constant_bias(v=c.signal(3, "m/s^2"), *, bias=c.param(3, "m/s^2")):
    return c.Residual(measured=v, predicted=c.quantity("reading", bias, "m/s^2"))


def seeds(count):
    """The first in every run, the others where there is time."""
    return [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, count))]


def wandering(step, seed, count=3000):
    rng = np.random.default_rng(seed)
    walk = np.cumsum(step * rng.standard_normal((count, 3)), axis=0)
    v = 0.05 * rng.standard_normal((count, 3)) + walk
    return Run.raw("rest", {"v": v}, units={"v": "m/s^2"}, time=np.arange(count) * 0.01)


@pytest.mark.long
def test_what_hangs_on_which_of_two_causes_it_is_said():
    """Against a fit of each, made by itself."""
    closing, world = closed("wheel", 6, {"quadratic": 3e-4})
    (found,) = closing.effects
    assert {found.candidate.label, *found.rivals} == {
        "quadratic", "signed_quadratic", "cubic", "signed_cubic",
    }  # fmt: skip
    for name, moves in found.rivals.items():
        bent = replace(next(e for e in CATALOGUE if e.name == name), on="specific_force")
        fit = c.calibrate(declared(world).with_effect(bent), closing.runs)
        for parameter, shift in moves.items():
            off = fit.values[parameter] - closing.after.values[parameter] - shift
            assert np.all(np.abs(off) < 0.1 * closing.after.std[parameter] + 1e-12)


@pytest.mark.parametrize("seed", seeds(5))
def test_an_offset_that_walks_at_random_is_unexplained_and_neither_drift_nor_step(seed):
    """Most of it is a slow course, and its cause is not known."""
    closing = close(constant_bias, [wandering(2e-3, seed)])
    assert labels(closing) == []
    assert closing.verdict == "unexplained"
    assert "slow course" in closing.misfit.where


def test_of_an_offset_that_is_said_to_wander_something_is_said():
    closing = close(constant_bias, [wandering(2e-3, 0)], known=["bias_wander"])
    assert "bias_wander" in {*labels(closing), *(r.name for r in closing.refused)}


@pytest.mark.parametrize("seed", seeds(6))
def test_a_steady_offset_does_not_wander(seed):
    assert labels(close(constant_bias, [wandering(0.0, seed)])) == []


@pytest.mark.long
def test_of_a_cause_too_small_to_be_told_from_others_all_are_named():
    """Shapes of response explain the same half of a percent and put offset and gain apart: with the
    one that is added they are nearer to the truth than without. Few readings are at the ends. They
    are larger there: no saturation."""
    seed = [10000, *b"one", *b"wheel", *b"cubic", *b"small"]
    closing, world = closed("wheel", seed, {"cubic": 2.4e-6})
    (found,) = closing.effects
    assert {found.candidate.label, *found.rivals} == {
        "quadratic", "signed_quadratic", "cubic", "signed_cubic",
    }  # fmt: skip
    for name in ("offset", "gain"):
        before, after = (
            np.max(np.abs(estimate.values[name] - world.truth[name]))
            for estimate in (closing.before, closing.after)
        )
        assert after < before


LEVER = ("wheel", [10000, *b"one", *b"wheel", *b"lever_arm", *b"medium"], {"lever_arm": 0.002})


@pytest.mark.long
@pytest.mark.xfail(
    strict=True,
    reason="of three arms one direction is determined; the loop sets arm_y and arm_z to nothing "
    "and adds arm_x = 4.8e-3 ± 0.2e-3 (truth 2e-3): certified, offset 19 of its deviations off, "
    "gain 19, tilt 18, that were 0.4, 2.7 and 2.5 off before",
)
def test_a_cause_that_the_record_cannot_size_does_no_harm():
    """A lever arm on a wheel that slows down: with all three axes the fit is refused as practically
    not determined. That two of them are zero is not in the data."""
    closing, world = closed(*LEVER)
    for name in ("offset", "gain", "tilt"):
        away = np.abs(closing.after.values[name] - world.truth[name])
        assert np.all(away < 5 * closing.after.std[name])


@pytest.mark.long
def test_of_two_causes_that_pull_opposite_ways_both_are_named_where_none_is_added():
    """A drift in an offset that is constant in half of the samples: warming up is as likely."""
    rng = np.random.default_rng(2)
    t = np.arange(6000) / 10
    v = 0.3 + 0.02 * rng.standard_normal((6000, 3))
    v[:, 0] += 0.007 * (t / t[-1] - 0.5)
    run = Run.raw("r", {"v": v}, units={"v": "m/s^2"}, time=t)
    closing = close(constant_bias, [run])
    assert labels(closing) == []
    assert closing.verdict == "unexplained"
    result = closing_result(closing, model_name="rest", data=["rest.csv"])
    assert result.unexplained.one_of == list(closing.undecided.names)
    assert "bias_drift" in result.unexplained.one_of
    assert len(result.unexplained.one_of) > 1


@pytest.mark.long
def test_of_several_shapes_the_one_that_is_added_helps_and_the_others_are_named():
    """A quadratic law explains this cubic one better by luck."""
    seed = [10005, *b"one", *b"wheel", *b"signed_cubic", *b"medium"]
    closing, world = closed("wheel", seed, {"signed_cubic": 1e-5})
    (found,) = closing.effects
    assert {"signed_cubic", "cubic"} <= {found.candidate.label, *found.rivals}
    for name in ("offset", "gain"):
        before, after = (
            np.max(np.abs(estimate.values[name] - world.truth[name]))
            for estimate in (closing.before, closing.after)
        )
        assert after < before


def test_what_is_to_be_said_with_effects_is_a_name_that_it_takes():
    """A constant that may be wrong is freed with --free, and is no effect."""
    moves = {"radius": {}, "temperature_bias(temp)": {}}
    left = Unexplained(0.1, "", list(moves), moves, [])
    (words,) = undecided(left, {})
    assert words.endswith("--effects 'temperature_bias(temp)'")
    assert not list(undecided(Unexplained(0.1, "", ["radius"], {"radius": {}}, []), {}))


@pytest.mark.long
@pytest.mark.parametrize("first", [10000, 10001])
def test_a_cause_that_is_known_to_be_there_comes_first(first):
    """What is left is as large as the noise."""
    place, seed, _ = LEVER
    world = worlds.made(place, [first, *seed[1:]], {"lever_arm": 0.004})
    closing = close(declared(world), [record(world)], known=["lever_arm"])
    assert labels(closing) == ["lever_arm"]
    assert closing.undecided is None
    chance = 1 / np.sqrt(2 * sum(r.size for r in closing.after_held_out))
    assert rms(closing.before_held_out) / world.sigma > 1 + 15 * chance
    assert abs(rms(closing.after_held_out) / world.sigma - 1) < 3 * chance


def test_of_what_is_asked_for_it_is_said_why_it_is_not_there():
    """On one tilt a wheel cannot show cross-axis terms; it has no thermometer and no table."""
    world = worlds.made("wheel", [5], {}, seconds=12.0, rate=50.0)
    run = replace(record(world), columns={}, column_units={})
    asked = ["cross_axis", "temperature_bias", "table_angle", "bias_drift", "outliers"]
    closing = close(declared(world), [run], known=asked)
    assert labels(closing) == []
    reasons = {r.name: r.reason for r in closing.refused}
    assert reasons["cross_axis"] == "these data cannot show it"
    assert reasons["temperature_bias"] == "the data have no column that it could follow"
    assert "is not applicable" in reasons["table_angle"]
    assert "no more of it than noise" in reasons["bias_drift"]
    assert "no more are far out" in reasons["outliers"]


@c.model
def pressure_cell(
    p=c.signal("kPa"),
    out=c.signal("mV"),
    *,
    zero=c.param("mV"),
    gain=c.param("mV/kPa", start=1.0),
):
    inside = c.quantity("pressure", p, "kPa")
    reading = c.quantity("reading", zero + gain * inside, "mV")
    return c.Residual(measured=out, predicted=reading, corrected=inside)


@pytest.mark.long
def test_a_bend_that_two_causes_make_together_is_no_formula():
    """A cube about the middle of the range, half of a percent of the variance: cube and square
    about zero are the same curve."""
    rng = np.random.default_rng(0)
    p = rng.uniform(5, 95, (6000, 1))
    x = (p - 50) / 45
    truth = 1 + 0.85 * p + 0.0093 * (x**3 - 0.6 * x)
    run = Run.raw("r", {"p": p, "out": truth + 0.02 * rng.standard_normal((6000, 1))},
                  units={"p": "kPa", "out": "mV"})  # fmt: skip
    closing = close(pressure_cell, [run])
    assert "formula" not in labels(closing)
    off = {}
    for name in ("before", "after"):
        estimate = getattr(closing, name)
        problem = Problem(estimate.model, closing.runs)
        (predicted,) = predictions(problem, problem.point(estimate.values))
        off[name] = np.sqrt(np.mean((predicted - truth) ** 2))
    assert off["after"] < 0.5 * off["before"]


def test_a_residual_that_resembles_itself_over_many_samples_is_not_called_noise_alone():
    world = worlds.made("norm", [6], {})
    closing = close(declared(world), [record(world)])
    result = closing_result(closing, model_name="norm", data=[])
    added = Effect(name="vibration", on="reading", column=None, parameters={}, p_value=0.0,
                   holdout_gain=1.0, formula="", indistinguishable_from=[], less_likely=[],
                   would_separate=[], instead_would_move={})  # fmt: skip
    said = [
        sentence(changed(result, verdict="extended", effects=[added], not_tried=[],
                         samples=[Samples("table", count, count)],
                         noise=changed(result.noise, correlated_over_samples=over)))
        for over, count in ((1.0, 2000), (33.2, 2000), (1.0, 19))
    ]  # fmt: skip
    assert said[0] == "extended: vibration was missing; what is left is noise"
    assert said[1].endswith("what is left is coloured noise (alike over 33 samples), or a lag")
    few = [Samples("table", 19, 19)]
    short = sentence(
        changed(result, verdict="extended", effects=[added], not_tried=[], samples=few)
    )
    assert short.endswith("what is left is noise as far as 19 rows can tell")
    words = changed(added, name="formula")
    for effects, missing in (
        ([words], "a formula describes what was missing, of unknown cause"),
        ([added, words],
         "vibration was missing, and a formula describes what else was, of unknown cause"),
    ):  # fmt: skip
        said = sentence(changed(result, verdict="extended", effects=effects, not_tried=[]))
        assert said.startswith(f"extended: {missing}; what is left is ")
    for count in (3, 4):
        said = sentence(changed(result, verdict="unexplained", effects=[added] * count))
        assert said.startswith("unexplained: beside vibration, ")
        assert said.endswith("one that is not among them") is (count == 4)


@pytest.mark.parametrize(
    ("left", "said"),
    [
        (Unexplained(0.9, "", [], {}, []), "a misfit remains that no candidate explains"),
        (Unexplained(0.9, "", ["cubic", "quadratic"], {}, [], share=0.85),
         "a misfit remains that cubic or quadratic explain alike"),
        (Unexplained(0.9, "", ["cubic", "quadratic"], {}, [], share=0.03),
         "a misfit remains, of which cubic or quadratic explain 3 %"),
        (Unexplained(0.9, "", ["cubic", "quadratic"], {}, [], share=0.008),
         "a misfit remains that no candidate explains"),
        (Unexplained(0.9, "", ["cubic", "quadratic"], {}, [], in_rows="row 7 of bath", share=0.85),
         "a misfit remains in row 7 of bath, which the others speak against"),
    ],
)  # fmt: skip
def test_the_headline_says_how_much_of_a_misfit_candidates_explain(left, said):
    """Of a small part of it they are no answer (studies/strangers.md)."""
    world = worlds.made("norm", [6], {})
    result = closing_result(close(declared(world), [record(world)]), model_name="norm", data=[])
    assert sentence(changed(result, verdict="unexplained", unexplained=left)).endswith(said)


@pytest.mark.long
def test_a_lag_of_the_response_is_no_wandering_offset():
    """A tenth of it is slow, and that a walk explains as well; the rest it cannot."""
    identity = [17, *b"one", *b"wheel", *b"hysteresis", *b"medium"]
    world = worlds.made("wheel", identity, {"hysteresis": 0.03})
    closing = close(declared(world), [record(world, identity)])
    assert labels(closing) == ["hysteresis"]
    assert rms(closing.after_held_out) < 1.01 * world.sigma


@pytest.mark.parametrize("bent", [False, True])
def test_errors_that_go_to_and_fro_are_not_called_noise_alone(tmp_path, bent):
    """Those of a reading that was differentiated: the next one has the other sign (ρ = −½)."""
    rng = np.random.default_rng(8)
    x = np.repeat(rng.uniform(1, 3, 300), 4) + 0.2 * rng.standard_normal(1200)
    y = 1 + 2 * x + 0.2 * bent * x**2 + np.diff(0.05 * rng.standard_normal(1201))
    table = np.column_stack([0.01 * np.arange(1200), x, y])
    path = tmp_path / "differences.csv"
    np.savetxt(path, table, delimiter=",", header="t,reference,reading", comments="")
    said = sentence(c.close("linear", path).result)
    assert said.startswith("extended: " if bent else "adequate: ")
    told = float(said.partition("errors go to and fro: of neighbours ρ = ")[2][:5])
    assert told == pytest.approx(-0.5, abs=0.06)
