"""Solvers side by side: they agree on one valley, and are judged where there are several."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import simulators as sim

import casest
from casest import NotTrusted, Residual, Run, UsageError, attitude, model, param, unit_vector
from casest.cli import run
from casest.comparison.judge import SOLVERS, compare
from casest.declaration.prior import Prior
from casest.dynamics import Motion, dynamics, measured, state
from casest.leastsquares.problem import Problem
from casest.report.picture import draw
from casest.report.text.comparison import comparison_text
from casest.results.comparison import comparison_result
from casest.results.find import find_model
from casest.solve import others
from casest.solve.trust_region import trust_region

NORM = find_model("norm-triangular").having(norm=sim.GRAVITY)


def as_run(**signals):
    columns = {n: np.asarray(s, float).reshape(len(s), -1) for n, s in signals.items()}
    return Run.raw("r", columns, units={})


def readings(seed=1, sigma=1e-2):
    rng = np.random.default_rng(seed)
    sensor = sim.accelerometer(rng)
    return sensor.read(sim.spread_poses(24, rng), sigma, rng)


@model
def wave(t=casest.signal(), y=casest.signal(), *, rate=param(start=2.02)):
    """A sine of unknown rate: a valley wherever it gains or loses another turn over the record."""
    return Residual(measured=y, predicted=casest.sin(rate * t))


@model
def decay(x=casest.signal(), y=casest.signal(), *, k=param(start=1.0, bounds=(0.5, 2))):
    return Residual(measured=y, predicted=casest.exp(-k * x))


def wave_run():
    t = np.linspace(0, 20, 200)
    return as_run(t=t, y=np.sin(2 * t) + 0.05 * np.random.default_rng(0).standard_normal(200))


@pytest.fixture(scope="module")
def poses():
    return compare(NORM, [as_run(v=readings())], starts=4, sizes=(0.01, 0.1))


@pytest.fixture(scope="module")
def waves():
    return compare(wave, [wave_run()], starts=6, sizes=(0.3,))


def told(found):
    return comparison_text(comparison_result(found, model_name="wave", data=["a.csv"]))


def row(found, name):
    return next(r for r in found.rows if r.solver == name)


# -- the solvers -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SOLVERS)
def test_every_solver_solves_a_linear_problem_as_numpy_does(name):
    @model
    def linear(A=casest.signal(4), y=casest.signal(), *, c=param(4)):
        return Residual(measured=y, predicted=A.T @ c)

    rng = np.random.default_rng(0)
    A, y = rng.standard_normal((20, 4)), rng.standard_normal(20)
    problem = Problem(linear, (as_run(A=A, y=y),))
    found = SOLVERS[name](problem, problem.start())
    assert found.solver == name
    assert found.claims_success
    np.testing.assert_allclose(found.point.x, np.linalg.lstsq(A, y, rcond=None)[0], rtol=1e-6)


@pytest.mark.parametrize("name", SOLVERS)
def test_every_solver_minimises_the_weighted_sum(name):
    rng = np.random.default_rng(0)
    weight = rng.uniform(0.1, 10, 24)

    @model
    def level(y=casest.signal(), *, a=param(start=3.0)):
        return Residual(measured=y, predicted=a)

    y = rng.standard_normal(24)
    problem = Problem(level, (as_run(y=y),), (weight[:, None],))
    found = SOLVERS[name](problem, problem.start())
    assert found.point.x[0] == pytest.approx(np.average(y, weights=weight), abs=1e-7)


@pytest.mark.parametrize("name", SOLVERS)
def test_every_solver_finds_a_direction_in_the_chart_of_its_start(name):
    @model
    def table(a=casest.signal(3), R=attitude(), *, up=param(unit_vector)):
        return Residual(measured=a, predicted=R.T @ up)

    rng = np.random.default_rng(2)
    R = np.array([sim.random_rotation(rng) for _ in range(20)])
    up = np.array([0.6, 0.0, 0.8])
    run_ = as_run(a=np.einsum("nji,j->ni", R, up), R=R.reshape(20, 9))
    problem = Problem(table, (run_,))
    found = SOLVERS[name](problem, problem.start())
    np.testing.assert_allclose(problem.values(found.point)["up"], up, atol=1e-5)


def test_scipy_is_refused_where_its_jacobian_would_not_fit_into_memory(monkeypatch):
    monkeypatch.setattr(others, "DENSE", 200)
    found = compare(NORM, [as_run(v=readings())], starts=0, solvers=("scipy-lm", "trust-region"))
    assert row(found, "scipy-lm").first.status == (
        "scipy-lm needs the whole Jacobian, 2.2e+02 numbers (1.7e-06 GB, and copies of it); "
        "compare on a shorter record"
    )
    assert row(found, "trust-region").first.right


# -- judging ---------------------------------------------------------------------------------------


def test_on_one_valley_all_reach_the_same_cost_from_all_starts(poses):
    assert poses.certified
    for name in SOLVERS:
        own = row(poses, name)
        for trial in (own.first, *own.spread):
            assert 0 <= trial.excess < 1e-6 * poses.best
            assert trial.distance < 0.01
            assert trial.right
            assert trial.evaluations > 1
            assert trial.seconds > 0
        assert (own.right, own.false_successes) == (4, 0)
        assert [trial.size for trial in own.spread] == [0.01, 0.1, 0.01, 0.1]


def test_the_certified_cost_is_that_of_the_printed_values(poses):
    S, o = (poses.estimate.values[n] for n in ("scale", "offset"))
    c = (readings() - o) @ S.T
    length = np.linalg.norm(c, axis=1)
    residual = (length - sim.GRAVITY) / np.linalg.norm(c / length[:, None] @ S, axis=1)
    assert poses.best == pytest.approx(0.5 * np.sum(residual**2), rel=1e-9)


def test_estimators_of_the_models_own_have_a_distance_and_no_claim(poses):
    names = [name for name, _ in NORM.estimators]
    assert [r.solver for r in poses.rows if r.own] == names
    values = dict(NORM.estimators)["closed-form"](NORM, poses.estimate.problem.runs)
    estimate = poses.estimate
    away = []
    for name in ("scale", "offset"):
        std, difference = estimate.std[name], np.abs(values[name] - estimate.values[name])
        away.append((difference[std > 0] / std[std > 0]).max())  # zeros above the diagonal
    trial = row(poses, "closed-form").first
    assert trial.distance == pytest.approx(max(away), rel=1e-6)
    assert (trial.claims, trial.iterations, row(poses, "closed-form").spread) == (None, None, ())


def test_a_claim_in_the_wrong_valley_is_a_false_success(waves):
    assert waves.certified
    for name in SOLVERS:
        own = row(waves, name)
        assert own.first.right
        wrong = [t for t in own.spread if t.claims and abs(t.distance) > 1]
        assert own.false_successes == len(wrong)
        assert own.right + len(wrong) <= len(own.spread) == 6
        assert all(t.excess > 0.1 * waves.best for t in wrong)
    # 30 % of the rate is six turns over the record: most starts lie in other valleys
    assert row(waves, "trust-region").false_successes >= 3


@dynamics
def decays(
    y=casest.signal(), *, z=state(3, start=[0.5, 0.7, 1.0]), k=param(3, start=1.0, bounds=(0, None))
):
    """A sum of three exponentials."""
    outputs = (measured(y, casest.sum1(z)),)
    return Motion(rates={"z": -k * z}, outputs=outputs)


def test_what_has_not_settled_in_the_integrated_equations_claims_no_success():
    """Lanczos' three exponentials (1956), in four decimals: parts of the record come together long
    before rates that are so nearly alike are told apart."""
    t = np.arange(24) / 20
    y = np.round(np.exp(-np.outer(t, [1, 3, 5])) @ [0.0951, 0.8607, 1.5576], 4)
    run = Run.raw("decays", {"y": y[:, None]}, units={}, time=t)
    model = decays.calibration.having(k=param(3, start=[0.3, 3.0, 5.5], bounds=(0, None)))
    found = compare(model, [run], starts=0, solvers=["multiple-shooting"])
    ended = row(found, "multiple-shooting").first
    assert not ended.right
    assert ended.claims is False
    assert "not settled in the integrated equations" in ended.status


def test_an_optimum_that_is_reported_as_a_failure_is_a_false_failure(monkeypatch):
    def modest(problem, start):
        return replace(trust_region(problem, start), claims_success=False, status="not sure")

    monkeypatch.setitem(SOLVERS, "modest", modest)
    found = compare(wave, [wave_run()], starts=3, sizes=(1e-3,), solvers=["modest"])
    own = row(found, "modest")
    assert (own.right, own.claimed, own.false_successes, own.false_failures) == (3, 0, 0, 3)
    assert "modest: not sure" in told(found)


def test_a_lower_cost_than_the_certified_one_is_told(monkeypatch):
    """The certified fit is held in a wrong valley; a solver that jumps finds the right one."""
    import casest.comparison.judge as module

    attempt = module.attempt

    def misled(model, runs, **options):
        found = attempt(model, runs, **options)
        wrong = trust_region(found.problem, found.problem.point({"rate": 2.35})).point
        return replace(found, point=wrong)

    monkeypatch.setattr(module, "attempt", misled)
    found = compare(wave, [wave_run()], starts=0, solvers=["trust-region"])
    assert not found.certified
    assert found.best_by == "trust-region"
    assert row(found, "trust-region").first.right
    text = told(found)
    assert "NO CERTIFIED OPTIMUM" in text
    assert "found a lower cost than the certified fit" in text


def test_a_solver_that_leaves_the_bounds_is_not_right():
    x = np.linspace(0, 3, 20)
    found = compare(decay, [as_run(x=x, y=np.exp(-5 * x))], starts=0)
    lm, trf = row(found, "scipy-lm").first, row(found, "scipy-trf").first
    assert not lm.inside
    assert not lm.right
    assert lm.excess < 0 < found.best
    assert lm.status.startswith("left the bounds")
    assert trf.inside
    assert not found.certified
    assert "the fit is refused: `k` ended on its bound" in " ".join(told(found).split())


def test_equal_seeds_give_equal_starts(waves):
    again = compare(wave, [wave_run()], starts=6, sizes=(0.3,), solvers=["scipy-lm"])
    costs = [t.cost for t in row(again, "scipy-lm").spread]
    assert costs == [t.cost for t in row(waves, "scipy-lm").spread]
    other = compare(wave, [wave_run()], starts=6, seed=1, sizes=(0.3,), solvers=["scipy-lm"])
    assert costs != [t.cost for t in row(other, "scipy-lm").spread]


# -- what goes wrong becomes a row -----------------------------------------------------------------


def test_an_exception_becomes_a_row_with_its_first_line(monkeypatch):
    def broken(problem, start):
        raise RuntimeError("plugin 'snopt' not found\n at line 3")

    monkeypatch.setitem(SOLVERS, "broken", broken)
    found = compare(wave, [wave_run()], starts=2, solvers=["broken", "trust-region"])
    own = row(found, "broken")
    assert own.first.status == "RuntimeError: plugin 'snopt' not found"
    assert (own.right, own.claimed, own.false_successes) == (0, 0, 0)
    assert "  - broken: RuntimeError: plugin 'snopt' not found" in told(found)
    json.dumps(comparison_result(found, model_name="wave", data=["a"]).content(), allow_nan=False)


@pytest.mark.parametrize("name", ["ipopt", "sqpmethod", "trust-region", "scipy-lm"])
def test_a_run_that_takes_too_long_is_stopped(name, monkeypatch):
    solve = SOLVERS[name]

    def slow(problem, start):
        problem.clock.deadline = 0.0 if problem.cost(start) > 0 else 1.0
        return solve(problem, start)

    monkeypatch.setitem(SOLVERS, name, slow)
    found = compare(wave, [wave_run()], starts=0, solvers=[name], limit=3)
    assert row(found, name).first.status == "stopped: no answer within 3 s"


def test_without_a_finite_start_there_is_nothing_to_compare():
    @model
    def rooted(y=casest.signal(), *, a=param(start=-1.0)):
        return Residual(measured=y, predicted=casest.sqrt(a))

    with pytest.raises(NotTrusted, match="nothing to compare: the residual is not finite"):
        compare(rooted, [as_run(y=[1.0, 1.1])])


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"starts": -1}, "--starts -1: give 0 or more"),
        ({"sizes": (0.1, 0)}, "--spread 0: give a share above 0, such as 0.1 for 10 %"),
        ({"sizes": ()}, "no size of the spread is given; give one, such as --spread 0.1"),
        ({"limit": 0}, "--limit 0: give a time above 0 in seconds"),
        ({"solvers": ["snopt"]}, "unknown solver 'snopt' for wave; it has ipopt, ipopt-exact, "),
    ],
)
def test_options_that_make_no_sense_are_named(options, text):
    with pytest.raises(UsageError) as caught:
        compare(wave, [wave_run()], **options)
    assert str(caught.value).startswith(text)


# -- the command -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    path = tmp_path_factory.mktemp("compare") / "poses.csv"
    header = "vx [m/s^2],vy [m/s^2],vz [m/s^2]"
    np.savetxt(path, readings(), delimiter=",", header=header, comments="", fmt="%.9g")
    return path


def arguments(record, *more):
    return ["compare", "norm-triangular", str(record), "--set", "norm=9.80665 m/s^2", *more]


def test_the_command_writes_what_it_prints(record, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    few = ("--starts", "2", "--spread", "0.1", "--solver", "ipopt", "--solver", "closed-form")
    assert run(arguments(record, *few, "-o", str(out), "--json")) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    content = json.loads(printed.out)
    assert content == json.loads((out / "compare.json").read_text(encoding="utf-8"))
    assert content["certified"] is True
    assert content["best"]["unit"] == "(m/s^2)^2"
    assert content["spread"] == {"starts": 2, "sizes": [0.1], "seed": 0}
    ipopt, closed = content["solvers"]
    assert ipopt["same_start"]["status"] == "Solve_Succeeded"
    assert (ipopt["spread"]["right"], ipopt["spread"]["starts"]) == (2, 2)
    assert (closed["name"], closed["own_estimator"]) == ("closed-form", True)
    assert (out / "compare.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (out / "compare.svg").read_text(encoding="utf-8")


def test_the_printed_tables_fit_80_columns(record, capsys):
    assert run(arguments(record, "--starts", "4")) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    for name in (*SOLVERS, "closed-form", "six-position"):
        assert f"\n  {name} " in text
    assert "4/4" in text


def test_without_matplotlib_the_json_is_written_and_the_way_out_said(
    record, tmp_path, capsys, monkeypatch
):
    from casest.report import picture

    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(picture, "import_module", missing)
    out = tmp_path / "out"
    assert run(arguments(record, "--starts", "0", "--solver", "ipopt", "-o", str(out))) == 0
    printed = capsys.readouterr()
    assert printed.err == (
        "casest: no plot: matplotlib is not installed; pip install 'casest[plot]'\n"
    )
    assert "Written: " in printed.out
    assert [p.name for p in out.iterdir()] == ["compare.json"]


def test_a_refused_fit_is_exit_code_2_with_the_table_printed(tmp_path, capsys):
    path = tmp_path / "poses.csv"
    np.savetxt(path, readings(), delimiter=",", header="vx,vy,vz", comments="")
    few = ("--starts", "0", "--solver", "trust-region")
    assert run(["compare", "norm-full", str(path), "--set", "norm=9.80665", *few]) == 2
    printed = capsys.readouterr()
    assert "NO CERTIFIED OPTIMUM" in printed.out
    assert printed.err == "casest: no certified optimum to judge by\n"


def test_bad_input_is_exit_code_1(record, capsys):
    assert run(arguments(record, "--solver", "snopt")) == 1
    assert "unknown solver 'snopt' for norm-triangular" in capsys.readouterr().err


def test_a_plot_without_a_folder_is_named(poses, tmp_path):
    pytest.importorskip("matplotlib")
    with pytest.raises(casest.DataError, match="no plot can be written"):
        draw(comparison_result(poses, model_name="norm", data=[]), tmp_path / "nowhere")


def test_every_solver_keeps_constraints_and_weighs_what_is_known_before():
    """Fractions that sum to one, of which one is known better than the data tell."""

    @model
    def mixture(x=casest.signal(), y=casest.signal(), *, f=param(2, start=0.3), g=param(start=1.0)):
        predicted = f[0] * casest.exp(-x) + f[1] * casest.exp(-3 * x) + g * x
        kept = casest.constraint(casest.sum1(f), 1)
        return Residual(measured=y, predicted=predicted, constraints=kept)

    x = np.linspace(0, 4, 40)
    noise = 0.01 * np.random.default_rng(0).standard_normal(40)
    runs = [as_run(x=x, y=0.4 * np.exp(-x) + 0.6 * np.exp(-3 * x) + 0.1 * x + noise)]
    known = Prior(("g",), ((0.11,),), ((),), ((1e-6,),), 0.01, "an earlier fit")
    free, held = (compare(m, runs, starts=2) for m in (mixture, replace(mixture, prior=known)))
    for found in (free, held):
        assert found.certified
        assert {row.solver: row.first.right for row in found.rows} == dict.fromkeys(SOLVERS, True)
        assert all(row.right == 2 for row in found.rows)
    # By Lagrange's linear equations, in units of the noise and of what is known.
    columns = np.column_stack([np.exp(-x), np.exp(-3 * x), x])
    y = runs[0].signals["y"][:, 0]
    for found, more in ((free, 0.0), (held, 0.01**2 / 1e-6)):
        matrix, right = columns.T @ columns, columns.T @ y
        matrix[2, 2] += more
        right[2] += more * 0.11
        one = np.array([[1.0, 1, 0]])
        whole = np.block([[matrix, one.T], [one, np.zeros((1, 1))]])
        truth = np.linalg.solve(whole, [*right, 1])[:3]
        assert found.estimate.point.x == pytest.approx(truth, abs=1e-9)
