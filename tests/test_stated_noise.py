"""Noise that was stated, of what is measured and of inputs: certified values, ODRPACK, χ²."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest

import casest as c
from casest.cli import run
from casest.dynamics import dynamics, state
from casest.leastsquares.stated import stated_noise
from casest_problems.norm import norm_triangular

LINE = '''
from casest import Residual, model, param, quantity, signal


@model
def line(y=signal("1"), x=signal("1"), *, b0=param("1"), b1=param("1", start=1.0)):
    """x = b0 + b1 y."""
    truth = quantity("truth", y, "1")
    return Residual(measured=x, predicted=b0 + b1 * truth, corrected=truth)
'''


@c.model
def growth(x=c.signal("1"), y=c.signal("1"), *, a=c.param("1", start=1.0), b=c.param("1")):
    """An exponential."""
    return c.Residual(measured=y, predicted=a * c.exp(b * x))


def record(**signals):
    held = {name: np.asarray(v, float).reshape(len(v), -1) for name, v in signals.items()}
    return c.Run.raw("record", held, units=dict.fromkeys(held, "1"))


def noisy(model, run, **stds):
    return stated_noise(model, [run], {name: [np.asarray(s)] for name, s in stds.items()})


@pytest.fixture
def cli(capsys, tmp_path):
    (tmp_path / "line.py").write_text(LINE)

    def command(data, *words, model=tmp_path / "line.py"):
        code = run(["calibrate", str(model), str(data), "--json", *map(str, words)])
        out, err = capsys.readouterr()
        return json.loads(out) if code == 0 else (code, err)

    return command


def test_iso_6143_example_1_has_all_its_printed_digits(cli, shared_data):
    found = cli(shared_data / "certified" / "iso6143_example1.csv")
    values, covariance = found["estimate"]["parameters"], found["estimate"]["covariance"]["matrix"]
    assert f"{values['b0']['value']:.5f}" == "-0.35747"
    assert f"{values['b1']['value']:.4f}" == "24.6115"
    assert f"{values['b0']['std']:.5f}" == "0.15713"
    assert f"{values['b1']['std']:.5f}" == "0.48036"
    assert f"{covariance[0][1]:.5f}" == "-0.05689"
    assert f"{found['noise']['chi_square']:.4f}" == "0.6743"
    assert "noise of x is u_x" in found["notes"]


@pytest.mark.parametrize("size", [1.0, 3.0])
def test_errors_of_inputs_are_those_of_odrpack(size):
    rng = np.random.default_rng(1)
    true, n = np.linspace(0, 3, 40), 40
    ux, uy = size * (0.05 + 0.1 * rng.random(n)), 0.1 + 0.1 * rng.random(n)
    x = true + ux * rng.standard_normal(n)
    y = 2 * np.exp(0.7 * true) + uy * rng.standard_normal(n)
    model, runs = noisy(growth, record(x=x, y=y), x=ux[:, None], y=uy[:, None])
    found = c.calibrate(model, runs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from scipy import odr
    data = odr.RealData(x, y, sx=ux, sy=uy)
    curve = odr.Model(lambda b, x: b[0] * np.exp(b[1] * x))
    other = odr.ODR(data, curve, beta0=[1, 0.5], sstol=1e-15, partol=1e-15, maxit=500).run()
    assert found.point.x == pytest.approx(other.beta, rel=1e-5)
    assert found.noise.chi_square.value == pytest.approx(other.sum_square, rel=1e-9)
    assert found.covariance - found.shift == pytest.approx(other.cov_beta, rel=1e-3)


@pytest.mark.parametrize("seed", [5, 6])
def test_residuals_that_look_correlated_by_chance_know_no_better(seed):
    """Of seed 6 they do, and standard deviations were 17 and 22 % below the stated noise's."""
    rng = np.random.default_rng(seed)
    x, n = np.linspace(0, 3, 10_000), 10_000
    ux, uy = 0.05 + 0.05 * rng.random(n), 0.1 + 0.1 * rng.random(n)
    y = 2 * np.exp(0.7 * x) + uy * rng.standard_normal(n)
    x = x + ux * rng.standard_normal(n)
    found = c.calibrate(*noisy(growth, record(x=x, y=y), x=ux[:, None], y=uy[:, None]))
    a, b = found.point.x
    slope = a * b * np.exp(b * x)
    J = np.column_stack([np.exp(b * x), a * x * np.exp(b * x)])
    normal = J.T @ (J / (uy**2 + slope**2 * ux**2)[:, None])
    expected = np.sqrt(np.diag(np.linalg.inv(normal)))  # of inputs as they were read: to a percent
    assert np.sqrt(np.diag(found.covariance - found.shift)) == pytest.approx(expected, rel=0.03)


@pytest.mark.long
def test_a_norm_of_unequal_noise_is_right_to_second_order():
    """Without the noise the fit of so many readings is off by many of its standard deviations."""
    rng = np.random.default_rng(3)
    scale = np.array([[1, 0, 0], [0.02, 1.03, 0], [-0.01, 0.015, 0.98]])
    offset, std = np.array([0.3, -0.2, 0.1]), np.array([0.05, 0.1, 0.6])
    u = rng.standard_normal((8000, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    v = 9.81 * u @ np.linalg.inv(scale).T + offset + std * rng.standard_normal(u.shape)
    model = norm_triangular.having(norm=9.81)
    truth = np.array([1, 0.02, 1.03, -0.01, 0.015, 0.98, *offset])

    def away(model, runs):
        found = c.calibrate(model, runs)
        return (found.point.x - truth) / np.sqrt(np.diag(found.covariance))

    assert np.abs(away(model, [record(v=v)])).max() > 4
    assert np.abs(away(*noisy(model, record(v=v), v=std))).max() < 3


def test_a_covariance_between_axes_is_that_of_turned_axes():
    """In axes turned by Q, noise of Q·C·Qᵀ gives the same fit as noise of C in the old ones."""
    rng = np.random.default_rng(5)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    own = np.diag(np.square([0.02, 0.1, 0.4]))
    u = rng.standard_normal((200, 3))
    v = 9.81 * u / np.linalg.norm(u, axis=1)[:, None]
    v += rng.standard_normal(v.shape) @ np.sqrt(own)

    @c.model
    def centre(v=c.signal(3), *, o=c.param(3), r=c.constant(9.81)):
        """A sphere."""
        return c.Residual(implicit=c.norm_2(v - o) - r, unit="[v]")

    plain = c.calibrate(*noisy(centre, record(v=v), v=own[None]))
    turned = c.calibrate(*noisy(centre, record(v=v @ turn.T), v=(turn @ own @ turn.T)[None]))
    assert turned.values["o"] == pytest.approx(turn @ plain.values["o"], abs=1e-8)
    assert turned.covariance == pytest.approx(turn @ plain.covariance @ turn.T, abs=1e-10)


def test_stated_noise_of_what_is_measured_gives_the_covariance_of_weighted_least_squares():
    rng = np.random.default_rng(2)
    x, u = np.linspace(0, 1, 12), np.linspace(0.1, 0.4, 12)
    y = 1 + 2 * x + u * rng.standard_normal(12)

    @c.model
    def straight(x=c.signal("1"), y=c.signal("1"), *, a=c.param("1"), b=c.param("1")):
        """A line."""
        return c.Residual(measured=y, predicted=a + b * x)

    found = c.calibrate(*noisy(straight, record(x=x, y=y), y=u[:, None]))
    coefficients, covariance = np.polyfit(x, y, 1, w=1 / u, cov="unscaled")
    assert found.point.x == pytest.approx(coefficients[::-1])
    assert found.covariance == pytest.approx(covariance[::-1, ::-1])
    squares = np.sum(np.square((y - np.polyval(coefficients, x)) / u))
    assert found.noise.chi_square.value == pytest.approx(squares)
    assert found.interval_reach[0]["a"] / found.std["a"] == pytest.approx(1.959964, rel=1e-5)


@pytest.fixture
def weighed(tmp_path):
    rng = np.random.default_rng(4)
    y = np.linspace(1, 5, 30)
    x = 3 + 2 * y + 0.05 * rng.standard_normal(30)
    table = np.column_stack([y, x, np.full(30, 0.05), x * 0 - 1])
    np.savetxt(tmp_path / "data.csv", table, delimiter=",", header="y,x,wide,wrong", comments="")
    return tmp_path / "data.csv"


def test_a_residual_larger_than_the_stated_noise_is_a_misfit(cli, weighed):
    right = cli(weighed, "--sensor-noise", "x=0.05")
    wrong = cli(weighed, "--sensor-noise", "x=0.02")
    assert right["misfit"] == []
    assert "as chance may have it" in right["notes"][-1]
    assert "times the stated noise" in wrong["misfit"][0]["where"]
    assert any("stated too small, or the model lacks something" in n for n in wrong["notes"])
    std = [f["estimate"]["parameters"]["b1"]["std"] for f in (right, wrong)]
    assert std[1] == pytest.approx(std[0], rel=0.3)  # by the residual, and not 0.4 of it


def test_much_less_than_the_stated_noise_is_said(cli, weighed):
    found = cli(weighed, "--sensor-noise", "x=0.5")
    assert any("stated too large" in note for note in found["notes"])


def test_a_column_a_number_and_a_share_say_the_same(cli, weighed):
    a = cli(weighed, "--sensor-noise", "x=0.05")["estimate"]["parameters"]
    assert cli(weighed, "--sensor-noise", "x=wide")["estimate"]["parameters"] == a
    share = cli(weighed, "--sensor-noise", "x=1%")
    assert share["noise"]["stated"] == pytest.approx(0.09, rel=0.1)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["x=0"], "a standard deviation is above zero, and 0 is not"),
        (["x=-0.1"], "a standard deviation is above zero, and -0.1 is not"),
        (["x=wrong"], "noise of x is -1 in row 0"),
        (["x=nowhere"], "'nowhere' is no number with a unit, no percentage, and no column of"),
        (["z=0.1"], "line has no signal 'z'; it has y, x"),
        (["y=0.1"], "the residual value of line has no stated noise: say that of x too"),
        (["x=0.1 kg"], "kg"),
        (["x=1,2;3,4"], "x has 1 components, and the covariance is 2 by 2"),
        (["x=0.1,0.2"], "noise of x has shape (2,)"),
    ],
)
def test_noise_that_is_none_is_refused(cli, weighed, words, said):
    given = [w for word in words for w in ("--sensor-noise", word)]
    code, err = cli(weighed, *given)
    assert code == 1
    assert said in err
    assert err.count("\n") == 1


def test_correlations_that_cannot_be_are_refused():
    readings = record(v=np.random.default_rng(0).standard_normal((30, 3)))
    model = norm_triangular.having(norm=1.0)
    impossible = np.array([[1, 2, 0], [2, 1, 0], [0, 0, 1.0]])[None]
    with pytest.raises(c.UsageError, match="noise of v: the correlations are not positive semi"):
        noisy(model, readings, v=impossible)


DECLARED = LINE.replace(
    'y=signal("1"), x=signal("1")', 'y=signal("1", std=0.02), x=signal(1, "1", std=0.05)'
)


def test_the_std_of_a_declared_signal_is_its_stated_noise(cli, weighed, tmp_path):
    declared = tmp_path / "declared.py"
    declared.write_text(DECLARED)
    said = cli(weighed, "--sensor-noise", "x=0.05", "--sensor-noise", "y=0.02")
    found = cli(weighed, model=declared)
    assert found["estimate"] == said["estimate"]
    assert found["noise"] == said["noise"]
    option = cli(weighed, "--sensor-noise", "x=0.2", model=declared)  # goes before
    also = cli(weighed, "--sensor-noise", "x=0.2", "--sensor-noise", "y=0.02")
    assert option["noise"] == also["noise"]


def test_python_takes_the_std_of_a_declared_signal_too():
    @c.model
    def level(v=c.signal(2, "m", std=(0.1, 0.2)), *, a=c.param(2, "m")):
        """A constant."""
        return c.Residual(measured=v, predicted=a)

    found = c.calibrate(level, {"v": np.random.default_rng(1).normal(0, [0.1, 0.2], (25, 2))})
    assert found.std["a"] == pytest.approx([0.1 / 5, 0.2 / 5])


def test_std_of_a_signal_is_refused_where_nothing_would_come_of_it():
    with pytest.raises(c.DeclarationError, match="std -1 must be above zero"):
        c.signal("m", std=-1)
    with pytest.raises(c.DeclarationError, match="what an effect reads counts as exact"):
        c.effect(on="truth")(lambda x, warm=c.signal("K", std=0.1), *, k=c.param("1"): x + k * warm)
    with pytest.raises(c.DeclarationError, match="as --sensor-noise v=STD"):
        dynamics(lambda v=c.signal("m", std=0.1), *, x=state("m"): None)

    @c.model
    def level(v=c.signal("m", std=0.1), *, a=c.param("m")):
        """A constant."""
        return c.Residual(measured=v, predicted=a)

    with pytest.raises(c.UsageError, match="calibrate_many does not weigh samples"):
        c.calibrate_many(level, {"v": np.zeros((3, 5, 1))})


PEARSON = "0 .9 1.8 2.6 3.3 4.4 5.2 6.1 6.5 7.4", "5.9 5.4 4.4 4.6 3.5 3.7 2.8 2.8 2.4 1.5"
YORK = "1000 1000 500 800 200 80 60 20 1.8 1", "1 1.8 4 8 20 20 70 70 100 500"


def york(x, y, ux, uy, r, slope):
    """York et al., Am. J. Phys. 72 (2004) 367, eqs. 13: line, std and χ², by their recipe."""
    wx, wy = 1 / ux**2, 1 / uy**2
    alpha = np.sqrt(wx * wy)
    for _ in range(200):
        w = wx * wy / (wx + slope**2 * wy - 2 * slope * r * alpha)
        u, v = x - np.sum(w * x) / np.sum(w), y - np.sum(w * y) / np.sum(w)
        beta = w * (u / wy + slope * v / wx - (slope * u + v) * r / alpha)
        slope = np.sum(w * beta * v) / np.sum(w * beta * u)
    level = np.sum(w * y) / np.sum(w) - slope * np.sum(w * x) / np.sum(w)
    adjusted = np.sum(w * x) / np.sum(w) + beta
    at = adjusted - np.sum(w * adjusted) / np.sum(w)
    std = 1 / np.sqrt(np.sum(w * at**2))
    return level, slope, std, np.sum(w * (y - slope * x - level) ** 2)


@pytest.mark.parametrize("said", ["correlation", "columns"])
def test_noise_that_two_signals_share_gives_the_line_of_york(cli, tmp_path, said):
    x, y = (np.array(text.split(), float) for text in PEARSON)
    ux, uy = (1 / np.sqrt(np.array(text.split(), float)) for text in YORK)
    r = np.linspace(-0.8, 0.9, 10)
    table = np.column_stack([x, y, ux, uy, r, ux**2, r * ux * uy, uy**2])
    head = "y,x,wide,high,r,vx,vxy,vy"
    np.savetxt(tmp_path / "d.csv", table, delimiter=",", header=head, comments="", fmt="%.16g")
    words = {
        "correlation": ["y=wide", "x=high", "y,x=r"],
        "columns": ["y,x=vx,vxy,vy"],
    }[said]
    options = [w for word in words for w in ("--sensor-noise", word)]
    found = cli(tmp_path / "d.csv", *options)
    level, slope, std, squares = york(x, y, ux, uy, r, -0.5)
    values = found["estimate"]["parameters"]
    assert values["b1"]["value"] == pytest.approx(slope, rel=1e-6)
    assert values["b0"]["value"] == pytest.approx(level, rel=1e-6)
    assert values["b1"]["std"] == pytest.approx(std, rel=2e-3)
    assert found["noise"]["chi_square"] == pytest.approx(squares, rel=1e-6)
    assert next(i["name"] for i in found["estimate"]["inputs"]) == "noise of y and x"


def test_a_covariance_in_a_file_is_that_in_words(cli, weighed, tmp_path):
    (tmp_path / "c.csv").write_text("4e-4,1e-4\n1e-4,25e-4\n")
    said = cli(weighed, "--sensor-noise", "y,x=4e-4,1e-4;1e-4,25e-4")
    assert cli(weighed, "--sensor-noise", f"y,x=@{tmp_path}/c.csv")["estimate"] == said["estimate"]
    apart = cli(weighed, "--sensor-noise", "y=0.02", "--sensor-noise", "x=0.05")
    none = cli(weighed, "--sensor-noise", "y,x=4e-4,0;0,25e-4")
    b1 = [f["estimate"]["parameters"]["b1"] for f in (apart, none)]
    assert b1[0]["std"] == pytest.approx(b1[1]["std"], rel=1e-9)
    assert b1[0]["value"] == pytest.approx(b1[1]["value"], rel=1e-9)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["y,x=0.5"], "whose standard deviations are stated too"),
        (["y=0.1", "x=0.1", "y,x=1.5"], "a correlation lies between -1 and 1, and 1.5 does not"),
        (["y=0.1", "x=0.1", "y,x=many"], "'many' is no correlation, and no column of"),
        (["y,x=1,2;3"], "is no covariance"),
        (["y,x=1,0,0;0,1,0;0,0,1"], "y and x have 2 components, and the covariance is 3 by 3"),
        (["y,x=wide,wide"], "a covariance of 2 numbers has 3 columns"),
        (["y,x=1,2;2,1"], "noise of y and x: the correlations are not positive semidefinite"),
        (["y=0.1", "y,x=1,0;0,1"], "noise of y is stated twice"),
        (["y,x=@nowhere.csv"], "nowhere.csv: No such file"),
        (["y,z=1,0;0,1"], "line has no signal 'z'"),
    ],
)
def test_what_signals_cannot_share_is_refused(cli, weighed, words, said):
    given = [w for word in words for w in ("--sensor-noise", word)]
    code, err = cli(weighed, *given)
    assert code == 1
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("verb", ["compare", "observe"])
def test_compare_and_observe_know_stated_noise_too(weighed, capsys, tmp_path, verb):
    (tmp_path / "line.py").write_text(LINE)
    words = [verb, f"{tmp_path}/line.py", str(weighed), "--json", "--sensor-noise", "x=0.4"]
    more = ["--starts", "1", "--solver", "ipopt", "--spread", "0.1"] if verb == "compare" else []
    assert run([*words, "--sensor-noise", "y=0.1", *more]) == 0
    found = json.loads(capsys.readouterr().out)
    if verb == "observe":
        y = np.linspace(1, 5, 30)
        std = np.hypot(0.4, 2 * 0.1) / np.sqrt(np.sum((y - 3) ** 2))
        assert found["std"]["b1"] == pytest.approx(std, rel=0.01)
    else:
        # Of a residual: that of the reading, and what the input's makes of it on a slope of two.
        assert found["noise"]["sigma"] == pytest.approx(np.hypot(0.4, 2 * 0.1), rel=0.01)
        assert found["solvers"][0]["same_start"]["right"]


def test_residuals_of_which_one_follows_from_others_are_refused():
    @c.model
    def twice(v=c.signal("m", std=0.1), *, a=c.param("m"), b=c.param("m")):
        """Two residuals of one reading."""
        return c.Residual(implicit=c.vertcat(v - a, 2 * (v - b)), unit="m")

    with pytest.raises(c.UsageError, match="leave residuals out that follow from others"):
        c.calibrate(twice, {"v": np.arange(5.0)})
