"""Studies and benchmarks run for hours, so nobody runs them daily: they must at least load."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PROGRAMS = sorted([*ROOT.glob("studies/*.py"), *ROOT.glob("benchmarks/*.py")])
HELPERS = {
    *("loop_table", "mutants", "resumed", "by_hand", "fused", "own_models", "noise_records"),
    *("worlds_table", "record_files", "record_models", "record_rows"),
}


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_every_name_that_a_study_needs_is_there(path, monkeypatch):
    monkeypatch.setattr(sys, "path", [str(path.parent), str(ROOT), *sys.path])
    name = f"loaded_{path.parent.name}_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    assert path.stem in HELPERS or callable(module.main)


def test_every_mistake_of_the_mutation_study_is_in_the_code_once(monkeypatch):
    """The list follows the code: what moves must be moved there too."""
    monkeypatch.setattr(sys, "path", [str(ROOT / "studies"), *sys.path])
    mutants = importlib.import_module("mutants")
    for m in mutants.MUTANTS:
        text = (ROOT / "casest" / m.path).read_text(encoding="utf-8")
        assert (m.path, m.old, text.count(m.old)) == (m.path, m.old, 1)
        assert all((ROOT / "tests" / name).exists() for name in m.tests)
    assert len({m.name for m in mutants.MUTANTS}) == len(mutants.MUTANTS)


# -- what the studies' sensors do ------------------------------------------------------------------

KINDS = [
    "load cell that creeps", "load cell with hysteresis", "load cell that warms up",
    "gain by sign", "late thermometer", "gravity once per turn", "soft iron, one gain",
    "soft iron, gain per axis", "gains unlike", "few poses, skew", "motor current",
    "magnet comes and goes", "field that sways", "late attitude", "bias bent by warmth",
]  # fmt: skip


@pytest.fixture
def study(monkeypatch):
    """A module of the studies, by name."""
    monkeypatch.setattr(sys, "path", [str(ROOT / "studies"), *sys.path])
    return importlib.import_module


def test_every_kind_of_world_is_tested(study):
    assert list(study("sensors").KINDS) == KINDS


@pytest.mark.parametrize("kind", KINDS)
def test_a_world_is_its_seed(study, kind):
    made = study("sensors").made
    for one, again, other in zip(made(kind, 3), made(kind, 3), made(kind, 4), strict=True):
        for name, values in one.signals.items():
            np.testing.assert_array_equal(values, again.signals[name])
        assert not np.array_equal(one.signals[one.read][:9], other.signals[other.read][:9])


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.long] * (k == "late attitude")) for k in KINDS]
)
def test_without_its_effect_a_world_is_the_declared_model(study, kind):
    """The simulators' truth, in the model as users declare it, leaves nothing of the reading."""
    loop_worlds, made = study("loop_worlds"), study("sensors").made
    for seed in range(4):
        with_it, without = made(kind, seed)[0], made(kind, seed, there=False)[0]
        assert np.abs(without.hidden).max() < 1e-9 * without.sigma < np.abs(with_it.hidden).max()
        np.testing.assert_allclose(sum(with_it.parts), with_it.hidden, atol=1e-9 * with_it.sigma)
        for world, reading in ((with_it, with_it.plain[0]), (without, without.clean)):
            model, run = loop_worlds.model_of(world), loop_worlds.run_of(world, reading)
            left = loop_worlds.residual(model, world.truth, run)
            assert np.abs(left).max() < 1e-6 * world.sigma


def behind(late, early):
    """Samples by which the first series is behind the second, by their cross-correlation."""
    n, shifts = len(early), np.arange(-15, 16)
    inner = early[15 : n - 15].ravel()
    found = [np.corrcoef(late[15 + k : n - 15 + k].ravel(), inner)[0, 1] for k in shifts]
    return int(shifts[np.argmax(found)])


@pytest.mark.parametrize("samples", [1, 3, 5])
def test_the_recorded_attitude_is_late_by_as_many_samples(study, samples):
    sensors = study("sensors.magnetometers")
    rng = np.random.default_rng(samples)
    record = sensors.late_attitude(rng, float(samples))
    first, second = record(rng, True), record(rng, False)
    assert behind(first.plain[0], first.clean) == behind(second.plain[0], second.clean) == samples
    assert first.time[1] == second.time[1]  # late by the same time in both


def test_the_thermometer_is_late_by_the_time_constants_of_element_and_sheath(study):
    sensors = study("sensors.one_reading")
    rng = np.random.default_rng(1)
    world = sensors.late_thermometer(rng, 5.0)(rng, True)
    sense = np.sign(np.corrcoef(world.plain[0][:, 0], world.signals["reference"][:, 0])[0, 1])
    assert behind(sense * world.clean, world.signals["reference"]) in (5, 6, 7)


def test_a_load_that_stays_is_answered_by_the_whole_creep_in_the_end(study):
    sensors = study("sensors.one_reading")
    rng = np.random.default_rng(0)
    t = np.arange(200_000.0)
    load = np.where(t > 10, 1.0, 0.0)
    late = sensors.relaxed(np.diff(load, prepend=0.0), t, lambda s: 1 - np.exp(-((s / 50) ** 0.6)))
    assert late[10] == late[11] == 0
    assert np.all(np.diff(late) >= 0)
    assert abs(late[-1] - 1) < 1e-9
    world = sensors.creeping(rng, 0.01)(rng, True)
    share = world.hidden[:, 0] / np.ptp(world.plain[0])
    assert share[0] == 0
    assert 0.005 < share.max() <= 0.01


@pytest.mark.parametrize("loop", ["bouc_wen", "plays"])
def test_up_and_down_differ_by_twice_the_size(study, loop):
    x = 0.5 - 0.5 * np.cos(np.linspace(0, 6 * np.pi, 1201))
    z = getattr(study("sensors.one_reading"), loop)(x, 0.05)
    up, down = (z[500], z[700])  # the second cycle, half way
    assert x[500] == pytest.approx(x[700]) == pytest.approx(0.5)
    assert up == pytest.approx(1, abs=0.02)
    assert down == pytest.approx(-1, abs=0.02)


def test_soft_iron_makes_an_ellipsoid_of_the_sphere(study):
    sensors = study("sensors.magnetometers")
    rng = np.random.default_rng(2)
    world = sensors.soft_iron(rng, 0.1, one=True)(rng, True)
    x, y, z = (world.clean - world.truth["offset"]).T
    squares = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z])
    a, b, c, d, e, f = np.linalg.lstsq(squares, np.ones(len(x)))[0]
    axes = 1 / np.sqrt(np.linalg.eigvalsh([[a, d, e], [d, b, f], [e, f, c]]))
    assert axes.max() / axes.min() == pytest.approx(1.1 / 0.9, rel=1e-6)


def test_noises_are_what_they_are_called(study):
    noises = study("noise_records")
    records = {
        kind: [noises.record_of(kind, seed)[1] for seed in range(5)] for kind in noises.NOISES
    }
    for kind, worlds in records.items():
        again = noises.record_of(kind, 4)[1]
        np.testing.assert_array_equal(again.signals[again.read], worlds[4].signals[again.read])
    poses = records["quantised to three levels"][1]
    levels = [len(np.unique(poses.signals["v"][poses.block == b, 0])) for b in range(24)]
    assert 2 <= np.median(levels) <= 4
    assert max(levels) <= 5
    for world in records["seating errors per pose"]:
        noise = (world.signals[world.read] - world.clean)[:, 0]
        own = [noise[world.block == b] for b in np.unique(world.block)]
        assert np.std([n.mean() for n in own]) > 2 * np.mean([n.std() for n in own])
    for world in records["missing blocks"]:
        assert len(np.unique(world.block)) > 3
        assert len(world.time) == len(world.block) == len(world.signals[world.read])
    held = records["held and interpolated samples"]
    neighbours = [np.diff(w.signals[w.read] - w.clean, axis=0).std() / w.sigma for w in held]
    assert max(neighbours) < 1.3  # of white noise √2


def test_what_only_describes_is_no_cause_and_names_it_all_the_same(study):
    table = study("worlds_table")
    cause = {"name": "bias_step", "label": "bias_step", "alike": [], "describes": False}
    course = {**cause, "name": "reference_wander", "label": "reference_wander", "describes": True}
    field = {"there": True, "right": ["reference_wander"], "found": [course]}
    assert table.is_named(field)
    assert not table.wrong(field)
    assert table.wrong({**field, "found": [cause, course]})
    assert not table.wrong({**field, "there": False})
    alike = {**cause, "alike": ["drift", "channel_bias(current)", "pulse"]}
    motor = {"there": True, "right": ["channel_bias(current)"], "found": [alike]}
    assert table.is_named(motor)
    assert not table.is_named({**motor, "right": ["pulse"]})


def test_parameters_further_off_by_more_than_their_scatter_are_harmed(study):
    table = study("worlds_table")
    record = {"samples": 900, "axes": 1, "truths": 2, "off_before": 0.05, "off_oracle": 0.01}
    # √(900/2) = 21.2 standard deviations a unit: 3.09 times their scatter of √(2/2) is 0.146.
    assert not table.harmed({**record, "off_after": 0.195})
    assert table.harmed({**record, "off_after": 0.197})


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "seed", "name"),
    [
        ("gains unlike", 210003, "axis_gain"),
        ("magnet comes and goes", 210010, "pulse"),
        ("late thermometer", 250002, "low_pass"),
        ("load cell that warms up", 290002, "warm_up"),
        ("load cell that warms up", 290008, "warm_up"),
    ],
)
def test_what_a_study_found_named_wrongly_is_named(study, kind, seed, name):
    """A dead zone and a cubic for two gains; a step and a temperature for a magnet in between; none
    for a lag, since a creep that explained as much had no interval; none for what settles, since
    parts as long as its own misfit could not foretell it, or a polynomial was as likely."""
    said = study("loop_worlds").one_world(kind, seed, True)
    assert (said["verdict"], [f["name"] for f in said["found"]]) == ("extended", [name])
    assert said["later_after"] < 1.05 * said["later_oracle"]


@pytest.mark.long
def test_in_few_poses_a_rival_on_its_own_axes_is_said(study):
    """Of 29 poses a dead zone explains as much as one gain that differs, on all axes not."""
    said = study("loop_worlds").one_world("gains unlike", 270005, True)
    (found,) = said["found"]
    assert found["name"] == "axis_gain" or "axis_gain" in found["alike"][:2]


@pytest.mark.long
def test_what_explains_as_much_as_a_lag_is_said(study):
    """A cycled cell with hysteresis: a lag was claimed, and nothing said to be like it."""
    said = study("loop_worlds").one_world("load cell with hysteresis", 290000, True)
    (found,) = said["found"]
    assert "hysteresis" in [found["name"], *found["alike"][:2]]
