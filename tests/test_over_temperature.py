"""A calibration over a range of temperature, from one ramp, with a thermometer that lags."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess

import numpy as np
import pytest

from casest import Run, calibrate
from casest.cli import run as casest
from casest.effects import ASKED, CATALOGUE
from casest.effects.placing import placed_in, told
from casest_problems.one_channel import load_cell

LAG = 120.0


def ramp(rng, n=1800):
    """A load cell in a chamber: true temperature, that of a first-order thermometer, reading.

    The offset follows temperature in a cubic, the sensitivity in a parabola.
    """
    t = 4.0 * np.arange(n)
    true = 20 + 35 * np.sin(2 * np.pi * t / t[-1])
    shown = np.empty(n)
    shown[0] = true[0]
    for k in range(1, n):
        shown[k] = shown[k - 1] + (1 - np.exp(-4 / LAG)) * (true[k] - shown[k - 1])
    d, load = true - 20, np.floor(t / 200) % 5 * 10.0
    offset = 3 + 0.01 * d + 1e-4 * d**2 + 3e-6 * d**3
    reading = offset + 2 * (1 + 2e-4 * d + 2e-6 * d**2) * load + rng.normal(0, 0.01, n)
    return t, load, shown, reading


def written(path, t, load, shown, reading):
    rows = zip(t, load, shown, reading, strict=True)
    lines = [",".join(f"{x:.9g}" for x in row) for row in rows]
    path.write_text("\n".join(["t [s],load [kg],temperature [degC],reading [mV]", *lines]) + "\n")
    return str(path)


OVER = [
    f"--effects={e}(temperature)"
    for e in ("temperature_cubic", "temperature_gain_curve", "signal_lag")
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("over")
    file = written(folder / "ramp.csv", *ramp(np.random.default_rng(0)))
    assert casest(["calibrate", "load-cell", file, *OVER, "-o", str(folder / "out")]) == 0
    return folder


def test_one_ramp_gives_every_coefficient_and_the_thermometers_lag(folder):
    found = json.loads((folder / "out" / "result.json").read_text())["estimate"]["parameters"]
    truth = {
        "temperature_gain_curve(temperature).k": (2e-4, 0.03),
        "temperature_gain_curve(temperature).bend": (2e-6, 0.05),
        "temperature_cubic(temperature).twist": (3e-6, 0.05),
        "signal_lag(temperature).delay": (-LAG, 0.05),
    }
    for name, (value, share) in truth.items():
        assert found[name]["value"] == pytest.approx(value, rel=share)


def test_at_rest_in_temperature_the_correction_needs_no_lag(folder, capsys):
    """Soaked at 45 °C the thermometer shows what the cell has: the loads are found."""
    d, load = 25.0, np.linspace(0, 40, 9)
    reading = 3 + 0.01 * d + 1e-4 * d**2 + 3e-6 * d**3 + 2 * (1 + 2e-4 * d + 2e-6 * d**2) * load
    n = len(load)
    shown = 45 + 0.001 * np.arange(n)
    file = written(folder / "soaked.csv", np.arange(n), np.zeros(n), shown, reading)
    capsys.readouterr()
    assert casest(["apply", str(folder / "out"), file]) == 0
    said = capsys.readouterr()
    table = np.genfromtxt(said.out.splitlines(), delimiter=",", skip_header=1)
    np.testing.assert_allclose(table[:, -1], load, atol=0.02)
    assert "outside what the calibration saw" not in said.err


def test_beyond_the_range_apply_and_every_export_say_so(folder, capsys):
    file = written(folder / "hot.csv", [0.0, 4.0], [0.0, 0.0], [45.0, 95.0], [3.0, 3.1])
    out = str(folder / "out")
    casest(["apply", out, file])
    assert "1 of 2 rows lie outside what the calibration saw" in capsys.readouterr().err
    assert casest(["export", out, "--to", "json", "-o", str(folder / "c.json")]) == 0
    capsys.readouterr()
    casest(["apply", str(folder / "c.json"), file])
    assert "temperature 45 to 95" in " ".join(capsys.readouterr().err.split())
    assert casest(["export", out, "--to", "python", "-o", str(folder / "c.py")]) == 0
    spec = importlib.util.spec_from_file_location("exported", folder / "c.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.extrapolates([[3.0, 45.0], [3.0, 95.0]]).tolist() == [False, True]


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_exported_c_says_where_it_extrapolates(folder):
    file = folder / "c.c"
    assert casest(["export", str(folder / "out"), "--to", "c", "-o", str(file)]) == 0
    main = """
    #include <stdio.h>
    int main(void) {
      const real in[] = {3, 45}, out[] = {3, 95};
      printf("%d %d", correct_load_cell_extrapolates(in), correct_load_cell_extrapolates(out));
      return 0;
    }
    """
    file.write_text(file.read_text() + main)
    program = str(folder / "c")
    subprocess.run(["cc", "-Werror", "-Wall", str(file), "-lm", "-o", program], check=True)
    assert subprocess.run([program], capture_output=True, text=True).stdout == "0 1"


def effect(name):
    return next(e for e in ASKED if e.name == name)


def test_a_table_is_the_offset_at_its_nodes_and_straight_between():
    """A bent course without noise: the values at five temperatures, of data at those alone."""
    rng = np.random.default_rng(1)
    nodes = np.array([-20.0, 0, 20, 40, 60])
    values = np.array([0.5, -0.2, 0, 0.3, 1.1])
    T, load = rng.choice(nodes, 200), rng.uniform(0, 40, 200)
    reading = 3 + 2 * load + values[np.searchsorted(nodes, T)] + rng.normal(0, 1e-3, 200)
    signals = {"load": load[:, None], "reading": reading[:, None], "temperature": T[:, None]}
    units = {"load": "kg", "reading": "mV", "temperature": "degC"}
    run = Run.raw("table", signals, units=units)
    placed = placed_in(effect("temperature_table"), load_cell)
    model = told(load_cell.with_effect(placed, columns={"channel": "temperature"}), [run])
    found = calibrate(model, [run]).values
    own = {n.rpartition(".")[2]: float(v) for n, v in found.items() if "table" in n}
    expected = dict(zip(("coldest", "cold", "warm", "warmest"), values[[0, 1, 3, 4]], strict=True))
    assert own == pytest.approx(expected, abs=2e-3)


def test_what_one_has_to_ask_for_is_no_part_of_the_loop():
    assert not {e.name for e in ASKED} & {e.name for e in CATALOGUE}
