"""Every command on differential equations: it works, or says in a sentence why not."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from test_equations import GASOIL

from casest import Run, attempt, calibrate_many
from casest.cli import run
from casest.errors import UsageError
from casest.results.find import find_model

SWING = """
from casest import param, signal, sin
from casest.dynamics import Motion, dynamics, measured, state

@dynamics
def swing(
    a=signal("rad"), w=signal("rad/s"),
    *,
    angle=state("rad", start=1.0),
    rate=state("rad/s", start=0.5),
    w2=param("1/s^2", start=39, bounds=(0, None)),
    viscous=param("1/s", start=0.3),
):
    rates = {"angle": rate, "rate": -w2 * sin(angle) - viscous * rate}
    return Motion(rates=rates, outputs=(measured(a, angle, std=0.01), measured(w, rate, std=0.02)))
"""


@pytest.fixture
def swing(tmp_path):
    path = tmp_path / "swing.py"
    path.write_text(SWING)
    return str(path)


@pytest.fixture
def gasoil(tmp_path):
    path = tmp_path / "gasoil.py"
    path.write_text(GASOIL)
    return str(path)


def simulated(swing, folder, seed):
    """A record of two measured states by `casest simulate`."""
    plan = ("--duration", "1.5", "--rate", "40", "--value", "w2=36", "--noise", "0.01")
    assert run(["simulate", swing, *plan, "--seed", str(seed), "-o", str(folder)]) == 0
    return str(folder / "record.csv")


def test_simulate_calibrate_and_a_held_out_experiment(swing, tmp_path, capsys):
    """The second begins elsewhere: its own beginning is fitted to one half, the other is scored."""
    first = simulated(swing, tmp_path / "one", 0)
    start = ("--value", "angle_start=-0.7", "--value", "rate_start=2")
    again = tmp_path / "two"
    plan = ("--duration", "1.5", "--rate", "40", "--value", "w2=36", "--noise", "0.01")
    assert run(["simulate", swing, *plan, *start, "--seed", "1", "-o", str(again)]) == 0
    truth = json.loads((again / "truth.json").read_text())
    assert truth["parameters"]["angle_start"] == -0.7
    capsys.readouterr()
    words = ["calibrate", swing, first, "--holdout", str(again / "record.csv"), "--json"]
    assert run(words) == 0
    found = json.loads(capsys.readouterr().out)["estimate"]
    w2 = found["parameters"]["w2"]
    assert abs(w2["value"] - 36) < 4 * w2["std"]
    # Noise of 0.01 in units of the declared 0.01 and 0.02.
    assert found["rmse_holdout"] == pytest.approx(np.sqrt((1 + 0.25) / 2), rel=0.2)


def test_compare_puts_every_solver_on_equations(gasoil, shared_data, capsys):
    data = str(shared_data / "certified/cops_gasoil.csv")
    several = ("trust-region", "scipy-trf", "growing-horizon", "multiple-shooting", "collocation")
    words = [word for name in several for word in ("--solver", name)]
    assert run(["compare", gasoil, data, "--starts", "0", "--json", *words]) == 0
    found = json.loads(capsys.readouterr().out)
    ended = {row["name"]: row["same_start"] for row in found["solvers"]}
    assert set(ended) == set(several)
    # Collocation ends at the optimum of what it has made of the equations, judged as it ends.
    assert all(ended[name]["right"] for name in several if name != "collocation")
    assert all(ended[name]["claims_success"] == ended[name]["right"] for name in several)
    assert ended["collocation"]["distance_in_std"] < 0.1


def said(words, capsys) -> str:
    """What a command says that refuses."""
    assert run(words) == 1
    return " ".join(capsys.readouterr().err.split())


def test_what_is_asked_of_single_rows_is_refused_in_a_sentence(
    gasoil, shared_data, tmp_path, capsys
):
    data = str(shared_data / "certified/cops_gasoil.csv")
    assert run(["calibrate", gasoil, data, "-o", str(tmp_path / "g")]) == 0
    capsys.readouterr()
    result = str(tmp_path / "g")
    assert "of states that are followed" in said(["apply", result, data, "--with-std"], capsys)
    assert "there is nothing to correct" in said(["export", result, "--to", "c"], capsys)
    assert "say --duration, and with --rate" in said(["plan", result], capsys)


@pytest.fixture
def line(tmp_path):
    """Three reactors by SciPy, one reading missing; of a fourth times are out of order."""
    t, rng, rows = np.linspace(0, 0.95, 20), np.random.default_rng(0), []
    for k in range(4):
        k1 = 11 + k

        def slope(_, y, k1=k1):
            return -(k1 + 1) * y[0] ** 2, k1 * y[0] ** 2 - 8 * y[1]

        y = solve_ivp(slope, (0, t[-1]), (1, 0), "DOP853", t, rtol=1e-10, atol=1e-12).y
        y += 0.003 * rng.standard_normal(y.shape)
        rows.append({"sensor": f"R{k}", "t": t[: 20 - k].tolist(), "y1": y[0, : 20 - k].tolist(),
                     "y2": y[1, : 20 - k].tolist()})  # fmt: skip
    rows[1]["y1"][4] = None
    rows[3]["t"][5] = rows[3]["t"][4]
    pyarrow = pytest.importorskip("pyarrow")
    pytest.importorskip("pyarrow.parquet").write_table(
        pyarrow.Table.from_pylist(rows), tmp_path / "line.parquet"
    )
    return str(tmp_path / "line.parquet")


def test_a_fleet_of_equations_is_calibrated_record_by_record(gasoil, line, tmp_path, capsys):
    folder = tmp_path / "fleet"
    words = ["fleet", gasoil, line, "--processes", "1", "-o", str(folder)]
    assert run(words) == 0
    assert "3 of 4 sensors trusted" in " ".join(capsys.readouterr().out.split())
    parquet = pytest.importorskip("pyarrow.parquet")
    found = parquet.read_table(folder / "results").to_pylist()
    for k in range(3):
        assert abs(found[k]["k1"] - 11 - k) < 4 * found[k]["k1_std"]
        assert abs(found[k]["k2"] - 8) < 4 * found[k]["k2_std"]
    assert found[3]["k1"] is None
    assert "put the rows in order" in found[3]["reason"]
    # What the sensors have in common is asked of rows that stand for themselves.
    common = ["close", gasoil, line, "--sensor", "sensor"]
    assert "give the records to one fit" in said(common, capsys)


def test_one_record_of_a_fleet_is_fitted_as_by_itself(gasoil, shared_data):
    """Both are the certified optimum; a louder sensor than is said to be sound is refused."""
    model = find_model(gasoil)
    table = np.loadtxt(shared_data / "certified/cops_gasoil.csv", delimiter=",", skiprows=1)
    given = dict(zip(("t", "y1", "y2"), table.T[:, None, :], strict=True))
    found = calibrate_many(model, given)
    own = attempt(model, [Run.raw("r", {n: given[n][0][:, None] for n in ("y1", "y2")}, units={},
                                  time=table[:, 0])])  # fmt: skip
    assert found.trusted[0]
    assert found.values["k1"][0] == own.values["k1"]
    assert found.std["k1"][0] == own.std["k1"]
    loud = calibrate_many(model, given, noise=1e-4)
    assert not loud.trusted[0]
    assert "larger than the noise=" in loud.reasons[0][0]
    with pytest.raises(UsageError, match="needs the signal 't'"):
        calibrate_many(model, {n: given[n] for n in ("y1", "y2")})


def test_apply_follows_a_new_record_from_its_own_beginning(swing, tmp_path, capsys):
    """SciPy integrates the same equation with the result's constants and the beginning told."""
    first = simulated(swing, tmp_path / "one", 0)
    assert run(["calibrate", swing, first, "-o", str(tmp_path / "c")]) == 0
    start = ("--value", "angle_start=-0.7", "--value", "rate_start=2", "--value", "w2=36")
    plan = ("--duration", "1.5", "--rate", "40", "--noise", "0.01", "--seed", "1")
    assert run(["simulate", swing, *plan, *start, "-o", str(tmp_path / "two")]) == 0
    capsys.readouterr()
    assert run(["apply", str(tmp_path / "c"), str(tmp_path / "two/record.csv")]) == 0
    out, err = capsys.readouterr()
    assert "fitted to this record: angle_start = -0." in err
    heading, *rows = out.splitlines()
    assert heading == (
        "row,t [s],a [rad],w [rad/s],angle [rad],rate [rad/s],a_predicted [rad],w_predicted [rad/s]"
    )
    table = np.array([row.split(",") for row in rows], float)
    found = json.loads((tmp_path / "c/result.json").read_text())["estimate"]["parameters"]
    w2, viscous = found["w2"]["value"], found["viscous"]["value"]

    def slope(t, x):
        return x[1], -w2 * np.sin(x[0]) - viscous * x[1]

    t = table[:, 1]
    truth = solve_ivp(slope, (0, t[-1]), table[0, 4:6], t_eval=t, method="DOP853", rtol=1e-12,
                      atol=1e-12).y.T  # fmt: skip
    np.testing.assert_allclose(table[:, 4:6], truth, atol=2e-8)  # nine digits are written
    np.testing.assert_array_equal(table[:, 4:6], table[:, 6:8])
    # The record's own beginning is what was simulated, to a few standard deviations of 60 readings.
    np.testing.assert_allclose(table[0, 4:6], (-0.7, 2), atol=0.05)


def test_apply_needs_no_reading_where_the_beginning_is_known(gasoil, shared_data, tmp_path, capsys):
    data = str(shared_data / "certified/cops_gasoil.csv")
    assert run(["calibrate", gasoil, data, "-o", str(tmp_path / "g")]) == 0
    (tmp_path / "times.csv").write_text("t [s]\n0\n0.1\n0.5\n2\n")
    capsys.readouterr()
    assert run(["apply", str(tmp_path / "g"), str(tmp_path / "times.csv")]) == 0
    heading, *rows = capsys.readouterr().out.splitlines()
    assert heading == "row,t [s],y[0],y[1],y1_predicted,y2_predicted"
    table = np.array([row.split(",") for row in rows], float)
    found = json.loads((tmp_path / "g/result.json").read_text())["estimate"]["parameters"]
    k = [found[name]["value"] for name in ("k1", "k2", "k3")]

    def slope(t, y):
        return -(k[0] + k[2]) * y[0] ** 2, k[0] * y[0] ** 2 - k[1] * y[1]

    truth = solve_ivp(slope, (0, 2), (1, 0), t_eval=table[:, 1], method="DOP853", rtol=1e-12,
                      atol=1e-14).y.T  # fmt: skip
    np.testing.assert_allclose(table[:, 2:4], truth, atol=2e-9)


def test_observe_tells_what_a_record_of_equations_determines(gasoil, shared_data, capsys):
    assert run(["observe", gasoil, str(shared_data / "certified/cops_gasoil.csv")]) == 0
    assert "rank 3 of 3" in capsys.readouterr().out


def test_the_wheel_by_its_equation_is_simulated_and_its_readings_corrected(tmp_path, capsys):
    plan = ["simulate", "wheel-motion", "--duration", "4", "--rate", "50"]
    values = ["--value", "speed=9", "--value", "friction=0.004", "--value", "drag=4e-4"]
    assert run([*plan, *values, "-o", str(tmp_path / "w")]) == 0
    table = np.genfromtxt(tmp_path / "w/record.csv", delimiter=",", skip_header=1)
    centripetal = 0.28 * 9**2
    assert table[0, 1] == pytest.approx(centripetal + 9.80665 * np.sin(0.8), rel=1e-9)
