"""Time in the model's own unit, runs in the order of the file, raw counts, kHz and mGal."""

from __future__ import annotations

import numpy as np
import pytest

from casest import Residual, attempt, der, effect, model, param, quantity, signal, sin
from casest.data import load_runs
from casest.data.scaling import parse_scale
from casest.effects import CATALOGUE
from casest.errors import UnitError
from casest.units import conversion


def written(path, rows, header):
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.12g")
    return path


def drifting(unit):
    """A voltage that drifts, its rate in V per the declared unit of time."""

    @model
    def drift(t=signal(unit), y=signal("V"), *, rate=param(f"V/{unit}"), level=param("V")):
        return Residual(measured=y, predicted=quantity("reading", level + rate * t, "V"))

    return drift


@pytest.mark.parametrize(
    ("unit", "in_a_second"),
    [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("min", 1 / 60), ("h", 1 / 3600)],
)
@pytest.mark.parametrize(("column", "factor"), [("t [s]", 1.0), ("time (ms)", 1e3), ("t_us", 1e6)])
def test_a_declared_unit_of_time_is_the_one_that_the_model_works_in(
    tmp_path, unit, in_a_second, column, factor
):
    """0.2 V/s over 100 s, whatever the file's clock counts and whatever the model declares."""
    seconds = np.linspace(5.0, 105.0, 201)
    y = 1.5 + 0.2 * (seconds - 5.0)
    path = written(tmp_path / "d.csv", np.c_[seconds * factor, y], f"{column},y [V]")
    declared = drifting(unit)
    (run,) = load_runs(path, declared.signals)
    np.testing.assert_allclose(run.time, seconds - 5.0, atol=1e-9)
    np.testing.assert_allclose(run.signals["t"][:, 0], (seconds - 5.0) * in_a_second, rtol=1e-9)
    found = attempt(declared, [run])
    assert found.values["rate"] * in_a_second == pytest.approx(0.2, rel=1e-6)
    assert found.values["level"] == pytest.approx(1.5, abs=1e-6)


@pytest.mark.parametrize("unit", ["ms", "min"])
def test_a_derivative_is_by_the_declared_time(tmp_path, unit):
    """An angle of 0.3·sin(2t) read by its rate: 0.6·cos(2t) rad/s, in rad per the unit."""
    start = 2e-3 if unit == "ms" else 120.0

    @model
    def rate_of_swing(t=signal(unit), y=signal(f"rad/{unit}"), *, size=param("rad", start=0.1),
                      w=param(f"rad/{unit}", start=start)):  # fmt: skip
        angle = quantity("angle", size * sin(w * t), "rad")
        return Residual(measured=y, predicted=der(angle, t))

    t = np.arange(400) * 0.01
    path = written(tmp_path / "r.csv", np.c_[t, 0.6 * np.cos(2 * t)], "t [s],y [rad/s]")
    runs = load_runs(path, rate_of_swing.signals)
    found = attempt(rate_of_swing, runs)
    per_second = 1e3 if unit == "ms" else 1 / 60
    assert found.values["size"] == pytest.approx(0.3, rel=1e-5)
    assert found.values["w"] * per_second == pytest.approx(2.0, rel=1e-5)


@effect(on="reading")
def creeping(y, t=signal("s"), *, k=param("V/s")):
    """A user's own effect that counts seconds."""
    return y + k * t


@pytest.mark.parametrize("unit", ["s", "ms", "min"])
@pytest.mark.parametrize("name", ["creeping", "bias_drift"])
def test_an_effect_that_counts_seconds_is_refused_where_the_model_counts_others(
    tmp_path, unit, name
):
    """A drift of 0.02 V/s is found as such, or not asked for: never in another unit."""

    @model
    def steady(t=signal(unit), y=signal("V"), *, level=param("V"), wave=param("V", start=0.1)):
        w = 2 * np.pi * {"s": 1.0, "ms": 1e-3, "min": 60.0}[unit]
        return Residual(measured=y, predicted=quantity("reading", level + wave * sin(w * t), "V"))

    t = np.arange(300) * 0.05
    y = 1 + 0.02 * t + 0.1 * np.sin(2 * np.pi * t)
    path = written(tmp_path / "c.csv", np.c_[t, y], "t [s],y [V]")
    added = creeping if name == "creeping" else next(e for e in CATALOGUE if e.name == name)
    if unit != "s":
        with pytest.raises(UnitError, match=f"reads t in s, and model steady has it in {unit}"):
            steady.with_effect(added, on="reading")
        return
    declared = steady.with_effect(added, on="reading")
    found = attempt(declared, load_runs(path, declared.signals))
    (own,) = [p for p in declared.parameters if p.name.startswith(name)]
    factor = conversion(str(own.unit), "V/s")[0]
    assert factor * float(np.ravel(found.values[own.name])[0]) == pytest.approx(0.02, rel=1e-5)


def test_runs_come_in_the_order_of_the_file_each_with_its_own_rows(tmp_path):
    """Labels that are not sorted, and come again."""
    labels = np.repeat([7, 3, 12, 7], 25)
    t = np.concatenate([np.arange(25), np.arange(50), np.arange(25, 50)]) * 0.1
    y = 100.0 * labels + np.arange(100)
    path = written(tmp_path / "r.csv", np.c_[labels, t, y], "run,t [s],y [V]")
    runs = load_runs(path, drifting("s").signals)
    assert [run.name for run in runs] == ["r:7", "r:3", "r:12"]
    for run, label in zip(runs, (7, 3, 12), strict=True):
        rows = np.flatnonzero(labels == label)
        np.testing.assert_array_equal(run.rows, rows)
        np.testing.assert_allclose(run.signals["y"][:, 0], y[rows])


def test_values_of_a_run_stay_with_the_run_of_their_label(tmp_path):
    """Levels of their own, of runs whose labels are words in no order."""
    declared = drifting("s").scoped("level", "run")
    names, levels = ["west", "east", "north"], {"west": 5.0, "east": -2.0, "north": 0.5}
    rows = ["run,t [s],y [V]"]
    for name in names:
        rows += [f"{name},{0.1 * k:.1f},{levels[name] + 0.3 * 0.1 * k:.6f}" for k in range(30)]
    path = tmp_path / "w.csv"
    path.write_text("\n".join(rows), encoding="utf-8")
    runs = load_runs(path, declared.signals)
    found = attempt(declared, runs)
    assert [run.name.partition(":")[2] for run in runs] == names
    np.testing.assert_allclose(found.values["level"], [levels[n] for n in names], atol=1e-5)


@pytest.mark.parametrize(
    ("entry", "step"), [("Fs,50.00", 0.02), ("Fs,0.25 kHz", 0.004), ("sample rate,8 Hz", 0.125)]
)
def test_a_rate_above_the_table_is_read_with_its_unit(tmp_path, entry, step):
    path = tmp_path / "p.csv"
    lines = [entry, "y [V]", *(f"{0.1 * k + 1e-3 * k**2:.4f}" for k in range(40))]
    path.write_text("\n".join(lines), encoding="utf-8")
    (run,) = load_runs(path, drifting("s").signals)
    np.testing.assert_allclose(np.diff(run.time), step)


@pytest.mark.parametrize(
    ("old", "new", "factor"),
    [
        ("kHz", "Hz", 1000.0),
        ("mGal", "m/s^2", 1e-5),  # 1 Gal = 1 cm/s²: BIPM, SI brochure, 8th ed., table 9
        ("Gal", "m/s^2", 1e-2),
        ("mGal", "ug", 1e-5 / 9.80665 * 1e6),
        ("us", "min", 1e-6 / 60),
        ("V/ms", "V/s", 1000.0),
    ],
)
def test_units_convert_as_their_definitions_say(old, new, factor):
    assert conversion(old, new) == pytest.approx((factor, 0.0), rel=1e-12)


def test_a_gravimeters_reading_is_read_in_its_unit(tmp_path):
    @model
    def gravimeter(y=signal("m/s^2"), *, level=param("m/s^2")):
        return Residual(measured=y, predicted=level)

    values = 5000.0 + np.arange(20.0)
    path = written(tmp_path / "g.csv", values[:, None], "y [mGal]")
    (run,) = load_runs(path, gravimeter.signals)
    assert attempt(gravimeter, [run]).values["level"] == pytest.approx(5009.5e-5, rel=1e-12)


@pytest.mark.parametrize("kind", ["int8", "int16", "int32", "uint8", "uint16"])
def test_raw_counts_are_read_as_a_processor_reads_their_bits(kind):
    """Both ends, both sides of the sign, as NumPy's own integers wrap."""
    size = 2 ** int("".join(filter(str.isdigit, kind)))
    stored = np.array([0, 1, size // 2 - 1, size // 2, size // 2 + 1, size - 1])
    expected = stored.astype(np.uint64).astype(f"u{kind.lstrip('u')}").astype(kind)
    found = parse_scale(f"{kind}/4").apply(stored.astype(float), "f", "c")
    np.testing.assert_array_equal(found, expected.astype(float) / 4)
