"""The step of a filter in C says what the filter of the record says, and what Estimator says."""

from __future__ import annotations

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
from test_asynchronous import MODEL, driven
from test_dynamics import turning_gravity
from test_online import STEP, record

from casest import Run, UsageError, atan2, signal
from casest.cli import run as command
from casest.correction.filter_c import filter_source
from casest.dynamics import Estimator, Motion, angle, dynamics, filtered, measured, state
from casest.dynamics.stepwise import stepwise
from casest_problems.bias_gravity import bias_gravity, bias_gravity_magnitude

COMPILER = shutil.which("cc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
FLAGS = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O0", "-shared", "-fPIC"]


@dynamics
def beacon(
    v=signal("m/s"),
    bearing=signal("rad"),
    *,
    x=state("m", std=1.0, start=-5.0, intensity=1e-3),
    y=state("m", std=1.0, start=0.3, intensity=1e-3),
):
    """A bearing that wraps, passing a beacon."""
    return Motion(rates={"x": v}, outputs=(measured(bearing, angle(atan2(y, x)), std=0.02),))


class Compiled:
    """The exported step behind Estimator's interface; its state is the C struct."""

    def __init__(self, text, model, folder):
        (folder / "filter.c").write_text(text, encoding="utf-8")
        words = [COMPILER, *FLAGS, "filter.c", "-o", "filter.so", "-lm"]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert "malloc" not in text
        self.library, self.n = ctypes.CDLL(str(folder / "filter.so")), model.size
        self.name = f"filter_{model.name.replace('-', '_')}"
        self.real = np.float32 if "typedef float" in text else np.float64
        self.struct, self.signals = ctypes.create_string_buffer(65536), model.signals
        self.begin()

    def begin(self):
        getattr(self.library, f"{self.name}_begin")(self.struct)

    def step(self, reading, t):
        """What is returned, x and P."""
        sample = np.concatenate([np.ravel(reading[s.name]) for s in self.signals])
        sample = sample.astype(self.real)
        x, P = np.zeros(self.n, self.real), np.zeros((self.n, self.n), self.real)
        parts = [ctypes.c_void_p(a.ctypes.data) for a in (sample, x, P)]
        step = getattr(self.library, f"{self.name}_step")
        return step(self.struct, parts[0], ctypes.c_double(t), *parts[1:]), x, P


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Every step compiled once."""
    known = {}

    def make(model, period=STEP, single=False):
        key = filter_source(stepwise(model, period), single)
        if key not in known:
            known[key] = Compiled(key, model, tmp_path_factory.mktemp("filter"))
        known[key].begin()
        return known[key]

    return make


def rows(run):
    return [{name: own[k] for name, own in run.signals.items()} for k in range(len(run))]


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(bias_gravity, id="linear", marks=pytest.mark.long),
        pytest.param(bias_gravity.sensing(a=1e-8), id="noisy inputs", marks=pytest.mark.long),
        pytest.param(turning_gravity, id="nonlinear"),
    ],
)
def test_it_is_the_filter_of_the_record(model, compiled):
    run = record([s.name for s in model.signals])
    whole, device = filtered(model, run, smooth=False), compiled(model)
    for k, (reading, t) in enumerate(zip(rows(run), run.time, strict=True)):
        code, x, P = device.step(reading, t)
        assert code == 0
        np.testing.assert_allclose(x, whole.x[k], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(np.sqrt(np.diag(P)), whole.std[k], rtol=1e-9)


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(bias_gravity, id="linear", marks=pytest.mark.long),
        pytest.param(
            bias_gravity.sensing(omega=1e-6, a=1e-8),
            id="noise along states",
            marks=pytest.mark.long,
        ),
        pytest.param(turning_gravity.sensing(omega=1e-6), id="nonlinear and noisy"),
    ],
)
def test_it_is_estimator_at_irregular_times_and_over_a_gap(model, compiled):
    run = record([s.name for s in model.signals], 80).take(slice(45, 75))
    time = np.cumsum(np.random.default_rng(0).uniform(0.2, 2.0, len(run)) * STEP)
    time[20:] += 1.5
    estimator, device = Estimator(model, STEP), compiled(model)
    for reading, t in zip(rows(run), time, strict=True):
        now, (_, x, P) = estimator.step(reading, t), device.step(reading, t)
        np.testing.assert_allclose(x, now.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(P, now.P, rtol=1e-8, atol=1e-12)


def test_an_angle_that_wraps_and_a_command_that_holds(compiled):
    t = np.arange(0, 10, 0.1)
    bearing = np.angle(np.exp(1j * (np.arctan2(0.4 - 0.05 * t, t - 5))))
    run = Run.raw(
        "passing", {"v": np.ones((100, 1)), "bearing": bearing[:, None]}, units={}, time=t
    )
    whole, device = filtered(beacon, run, smooth=False), compiled(beacon, 0.1)
    for k, reading in enumerate(rows(run)):
        _, x, _ = device.step(reading, t[k])
        np.testing.assert_allclose(x, whole.x[k], atol=1e-9)
    force = np.random.default_rng(0).choice([-1.0, 2.0], (100, 1))
    run = Run.raw("pushed", {"force": force, "x": np.sin(t)[:, None]}, units={}, time=t)
    whole, device = filtered(driven, run, smooth=False), compiled(driven, 0.1)
    found = np.array([device.step(reading, t[k])[1] for k, reading in enumerate(rows(run))])
    np.testing.assert_allclose(found, whole.x, atol=1e-9)


def test_fast_motion_is_followed_in_parts(compiled):
    """A pendulum of 20 rad per usual step, by the rotation that it is."""

    @dynamics
    def spinning(x=signal("m"), *, p=state("m", start=1.0, std=1e-6), q=state("m", std=1e-6)):
        """Round and round."""
        rates = {"p": 2000.0 * q / 10.0, "q": -200.0 * p}
        return Motion(rates=rates, outputs=(measured(x, p, std=1e3),))

    device = compiled(spinning, 0.1)
    device.step({"x": np.nan}, 0.0)
    code, x, _ = device.step({"x": np.nan}, 0.1)
    assert code == 0
    np.testing.assert_allclose(x, [np.cos(20), -np.sin(20)], atol=1e-9)


def test_what_cannot_be_taken_changes_nothing(compiled):
    run, device = record(["a", "omega", "v"]), compiled(bias_gravity)
    first, second = rows(run)[:2]
    device.step(first, 0.0)
    kept = device.struct.raw
    assert device.step(second, 0.0)[0] == 1
    assert device.step(second, np.nan)[0] == 1
    assert device.step({**second, "omega": np.full(3, np.nan)}, STEP)[0] == 2
    assert device.step({**second, "a": np.full(3, 1e308)}, 1e6)[0] == 3
    assert device.struct.raw == kept
    _, x, _ = device.step(second, STEP)
    device.begin()
    device.step(first, 0.0)
    np.testing.assert_array_equal(device.step(second, STEP)[1], x)


def test_in_float_it_says_nearly_the_same(compiled):
    run = record(["a", "omega", "v"])
    whole = filtered(bias_gravity, run, smooth=False)
    device = compiled(bias_gravity, single=True)
    for reading, t in zip(rows(run), run.time, strict=True):
        code, x, _ = device.step(reading, t)
    assert code == 0
    assert np.max(np.abs(x - whole.x[-1]) / whole.std[-1]) < 1e-2


def test_what_is_known_exactly_is_not_exported():
    with pytest.raises(UsageError, match="what it knows exactly"):
        filter_source(stepwise(bias_gravity_magnitude, STEP))


def test_the_command_line_writes_it(tmp_path, capsys):
    (tmp_path / "sledge.py").write_text(MODEL)
    model, out = str(tmp_path / "sledge.py"), tmp_path / "sledge.c"
    words = ["export", model, "--to", "c", "--period", "0.01", "--sensor-noise", "a=0.02"]
    assert command([*words, "-o", str(out)]) == 0
    text = out.read_text(encoding="utf-8")
    assert "sample[0]  a [m/s^2]" in text
    done = subprocess.run([COMPILER, *FLAGS, str(out), "-o", str(tmp_path / "s.so"), "-lm"],
                          capture_output=True, check=False)  # fmt: skip
    assert done.returncode == 0
    capsys.readouterr()
    for wrong, said in (
        (["export", model, "--to", "c"], "--period"),
        (["export", model, "--to", "python", "--period", "0.01"], "Estimator"),
        (["export", model, "--to", "c", "--period", "-1"], "must be positive and finite"),
        (["export", model, "--to", "c", "--period", "1", "--run", "1"], "--run"),
        (["export", "norm-triangular", "--to", "c", "--period", "0.1"], "no estimator in motion"),
    ):
        assert command(wrong) == 1
        assert said in capsys.readouterr().err


def test_the_folder_of_a_filter_exports_the_very_step_that_it_took(tmp_path, capsys):
    """Constants, start and noise as they were typed for the record; nothing is typed again."""
    (tmp_path / "sledge.py").write_text(MODEL)
    rng, t = np.random.default_rng(4), np.arange(0, 3, STEP)
    a, x = np.cos(t) + 0.02 * rng.standard_normal(len(t)), 1 - np.cos(t)
    x += 0.2 * rng.standard_normal(len(t))
    data, out = tmp_path / "record.csv", tmp_path / "out"
    np.savetxt(data, np.c_[t, a, x], delimiter=",", header="t,a,x", comments="", fmt="%.17g")
    words = ["filter", f"{tmp_path / 'sledge.py'}:sledge", str(data), "--std", "velocity=1"]
    words += ["--sensor-noise", "a=0.02", "--sensor-noise", "x=20 cm", "-o", str(out)]
    assert command(words) == 0
    assert command(["export", str(out), "--to", "c", "-o", str(tmp_path / "step.c")]) == 0
    model = stepwise_model(tmp_path)
    device = Compiled((tmp_path / "step.c").read_text(encoding="utf-8"), model, tmp_path)
    table = np.loadtxt(out / "states.csv", delimiter=",", skiprows=1)  # time, states, their std
    for k in range(len(t)):
        _, states, P = device.step({"a": a[k], "x": x[k]}, t[k])
        np.testing.assert_allclose(states, table[k, 1:4], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(np.sqrt(np.diag(P)), table[k, 4:7], rtol=1e-7)
    capsys.readouterr()
    for wrong, said in (
        (["export", str(out), "--to", "json"], "--to c alone"),
        (["export", str(out), "--to", "c", "--period", "1"], "says what its filter used"),
    ):
        assert command(wrong) == 1
        assert said in capsys.readouterr().err
    with (tmp_path / "sledge.py").open("a", encoding="utf-8") as file:
        file.write("raise SystemExit('run')\n")
    assert command(["export", str(out), "--to", "c"]) == 1
    assert "sledge.py has changed since the result was made: filter" in capsys.readouterr().err
    (out / "filter.json").write_text("{}")
    assert command(["export", str(out), "--to", "c"]) == 1
    assert "does not say what step its filter took" in capsys.readouterr().err


def stepwise_model(folder):
    from casest.results.find import find_any

    return find_any(f"{folder / 'sledge.py'}:sledge")
