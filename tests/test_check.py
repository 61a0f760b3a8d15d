"""Is an old calibration still valid? False alarms as stated, changes found and named."""

from __future__ import annotations

import json
import shlex
from functools import cache

import numpy as np
import pytest
from scipy import stats

from casest import Run, UsageError, attempt, calibrate, constant
from casest.cli import run as casest
from casest.estimate.estimate import Estimate
from casest.estimate.spectrum import Certainty, Powers, noise_spectrum
from casest.validity.chart import Sums, solved
from casest.validity.check import check
from casest.validity.colour import colour_of
from casest.validity.judged import judged, subject_of
from casest.validity.old import Old
from casest_problems.norm import norm_triangular
from casest_problems.one_channel import linear

GRAVITY = 9.81
SCALE = np.array([[1.02, 0, 0], [0.01, 0.98, 0], [-0.02, 0.015, 1.01]])
OFFSET = np.array([0.3, -0.2, 0.5])
KNOCK = np.array([0.05, 0.03, 0.05])
TURNED = np.array([[0, 0, 0], [0.02, 0, 0], [-0.02, 0.015, 0]])


def old_of(found: Estimate) -> Old:
    over = found.correlated_over
    return Old(found.model, found.values, found.names, found.covariance, found.noise.sigma,
               found.noise.degrees_of_freedom / over, colour_of(found))  # fmt: skip


def line(rng, n=30, offset=2.0, gain=3.0, sigma=0.1, noise=None, time=None):
    x = rng.uniform(0, 10, n)
    y = offset + gain * x + (rng.normal(0, sigma, n) if noise is None else noise)
    signals = {"reference": x[:, None], "reading": y[:, None]}
    return Run.raw("line", signals, units={"reference": None, "reading": None}, time=time)


def readings(rng, n=20, scale=SCALE, offset=OFFSET, sigma=0.01):
    """Rotations of gravity, seen by an ellipsoid: v = S⁻¹·g·n + o."""
    n = rng.normal(size=(n, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    return np.linalg.solve(scale, GRAVITY * n.T).T + offset + rng.normal(0, sigma, n.shape)


def poses(rng, **changes):
    return (Run.raw("poses", {"v": readings(rng, **changes)}, units={"v": "m/s^2"}),)


@cache
def accelerometer() -> Old:
    model = norm_triangular.having(norm=constant(GRAVITY, "m/s^2"))
    return old_of(calibrate(model, poses(np.random.default_rng(1), n=40)))


def test_p_values_of_valid_calibrations_are_uniform():
    """Old errors, few samples and both noises included: 200 calibrations, a new record each."""
    rng, found = np.random.default_rng(2), []
    for _ in range(200):
        old = old_of(attempt(linear, [line(rng, 12)], solver="trust-region", intervals=False))
        found.append(judged(subject_of(old, (line(rng, 8),))).p_value)
    assert stats.kstest(found, "uniform").pvalue > 0.01


def red(rng, n, phi=0.9, sigma=0.1):
    white = rng.normal(0, sigma * np.sqrt(1 - phi**2), n)
    noise = np.empty(n)
    noise[0] = rng.normal(0, sigma)
    for k in range(1, n):
        noise[k] = phi * noise[k - 1] + white[k]
    return noise


def test_noise_with_the_colour_of_the_old_record_is_no_change():
    """First-order noise over 19 samples: as white the share below 5 % would be ten times that."""
    rng, found = np.random.default_rng(3), []
    old = old_of(calibrate(linear, [line(rng, 4000, noise=red(rng, 4000), time=np.arange(4000.0))]))
    for _ in range(120):
        run = line(rng, 600, noise=red(rng, 600), time=np.arange(600.0))
        subject = subject_of(old, (run,))
        assert subject.noise.p_value > 1e-3
        found.append(judged(subject).p_value)
    assert stats.binomtest(int(np.sum(np.array(found) < 0.05)), 120, 0.05).pvalue > 0.01


def test_how_well_a_spectrum_is_known_is_how_far_it_scatters_from_record_to_record():
    rng, count = np.random.default_rng(5), 1000
    frequency = (np.arange(count) + 0.5) / (2 * count)
    low = np.array([1e-3, 5e-3, 3e-2])
    found = []
    for _ in range(150):
        power = rng.standard_normal(count) ** 2  # of white noise, by any orthonormal transform
        curve = noise_spectrum([Powers(frequency, power, np.ones(count))])
        found.append(np.log(curve(low)) - np.log(curve(frequency)).mean())
    known = np.sqrt(Certainty(count).variances(np.log(low), np.eye(3)))
    assert np.std(found, axis=0) == pytest.approx(known, rel=0.25)


def test_what_is_told_slowly_in_noise_that_follows_itself_has_few_degrees_of_freedom():
    rng, freedom, time = np.random.default_rng(6), {}, np.arange(2000.0)
    for phi in (0.0, 0.95):
        first, second = (line(rng, n, noise=red(rng, n, phi), time=time[:n]) for n in (2000, 500))
        old = old_of(attempt(linear, [first], solver="trust-region"))
        freedom[phi] = judged(subject_of(old, (second,))).freedom
    assert freedom[0.95] < 40  # the offset is told by the slowest frequencies alone
    assert freedom[0.0] > 400


CHANGES = {
    "offset": {"offset": OFFSET + KNOCK},
    "offset[2]": {"offset": OFFSET + 0.08 * np.eye(3)[2]},
    "scale by a common factor": {"scale": 1.01 * SCALE},
    "scale[2,2]": {"scale": SCALE * [[1, 1, 1], [1, 1, 1], [1, 1, 1.01]]},
    "scale between the axes": {"scale": SCALE + TURNED},
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_change_is_named_and_its_size_is_found(what):
    rng = np.random.default_rng(4)
    found = check(accelerometer(), [poses(rng, **CHANGES[what])])
    assert not found.valid
    change = found.dates[0].change
    assert change.cause.label == what
    truth = {"scale": SCALE, "offset": OFFSET} | CHANGES[what]
    for m in change.moved:
        name, _, place = m.name.partition("[")
        true = truth[name][tuple(map(int, place.rstrip("]").split(",")))]
        assert abs(m.after - true) < 4 * m.std


def test_six_poses_are_enough_to_see_an_offset():
    """Fewer equations than unknowns: what the poses see is asked, and no more."""
    rng = np.random.default_rng(5)
    assert check(accelerometer(), [poses(rng, n=6)]).valid
    found = check(accelerometer(), [poses(rng, n=6, offset=OFFSET + 2 * KNOCK)])
    assert found.dates[0].test.rank == 6
    assert not found.valid


def test_louder_noise_is_a_change_of_the_noise_alone():
    rng = np.random.default_rng(6)
    found = check(accelerometer(), [poses(rng, n=60, sigma=0.03)]).dates[0]
    assert found.louder
    assert not found.moved
    assert found.subject.noise.ratio == pytest.approx(3, rel=0.3)
    quieter = check(accelerometer(), [poses(rng, n=60, sigma=0.003)])
    assert quieter.valid


def test_parameters_of_a_run_alone_are_fitted_and_shared_ones_tested():
    rng = np.random.default_rng(7)
    model = linear.scoped("offset", "run")
    old = old_of(calibrate(model, [line(rng, offset=2), line(rng, offset=5)]))
    assert check(old, [(line(rng, offset=-7.0),)]).valid
    found = check(old, [(line(rng, offset=-7.0, gain=3.2),)])
    assert found.dates[0].change.cause.label == "gain"


def test_a_drift_too_small_for_any_date_shows_in_the_chart():
    """1.4 standard deviations of a date's mean reading, from the second date on."""
    rng = np.random.default_rng(8)
    old = old_of(calibrate(linear, [line(rng, 20_000)]))
    still = check(old, [(line(rng),) for _ in range(12)])
    assert still.valid
    assert not still.drifting
    moved = check(old, [(line(rng, offset=2.0 + 0.025 * (k > 0)),) for k in range(40)])
    assert sum(not d.valid for d in moved.dates) <= 1
    assert moved.drifting
    assert not moved.valid


def test_the_chart_alarms_as_often_as_it_says():
    """Eight dates of other sizes, each with the same error of the old value, 400 times: of the last
    dates' p-values the shares below 5 and 50 % are those."""
    rng, found = np.random.default_rng(9), []
    for _ in range(400):
        old = rng.normal(0, 0.7, 2)
        sums = [Sums(*(np.zeros(shape) for shape in ((2, 2), 2, (2, 2))))]
        for k in range(8):
            A = rng.normal(size=(1 + k % 3, 2))
            b = A @ old + rng.normal(size=len(A))
            sums.append(sums[-1].plus(Sums(A.T @ A, A.T @ b, A.T @ A), 0.2))
        T, rank = solved(sums[-1], 0.49 * np.eye(2)).test
        found.append(stats.chi2.sf(T, rank))
    assert stats.kstest(found, "uniform").pvalue > 0.01


def test_dates_that_each_show_one_unknown_add_up():
    one, other = np.diag([4.0, 0.0]), np.diag([0.0, 9.0])
    first = Sums(np.zeros((2, 2)), np.zeros(2), np.zeros((2, 2)))
    first = first.plus(Sums(one, -one @ [1.0, 2.0], one), 0.2)
    assert np.isnan(solved(first, np.zeros((2, 2))).shift[1])
    both = first.plus(Sums(other, -other @ [1.0, 2.0], other), 0.2)
    np.testing.assert_allclose(solved(both, np.zeros((2, 2))).shift, [1.0, 2.0])


# -- the command -----------------------------------------------------------------------------------


def written(path, rng, **changes):
    rows = [",".join(f"{x:.6f}" for x in v) for v in readings(rng, **changes)]
    rows = [f"{row},{20 + 0.1 * k}" for k, row in enumerate(rows)]
    path.write_text("\n".join(["vx [m/s^2],vy [m/s^2],vz [m/s^2],temp [degC]", *rows]) + "\n")
    return str(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("check"), np.random.default_rng(10)
    first = written(folder / "first.csv", rng, n=40)
    words = ["calibrate", "norm-triangular", first, "--set", f"norm={GRAVITY} m/s^2"]
    assert casest([*words, "-o", str(folder / "out")]) == 0
    written(folder / "same.csv", rng)
    written(folder / "knocked.csv", rng, offset=OFFSET + KNOCK)
    return folder


def test_the_exit_code_and_the_file_say_whether_it_is_valid(folder, capsys):
    out = folder / "checked"
    assert casest(["check", str(folder / "out"), str(folder / "same.csv"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["valid"] is True
    words = ["check", str(folder / "out"), str(folder / "knocked.csv"), "-o", str(out)]
    assert casest(words) == 2
    said = json.loads((out / "check.json").read_text())
    assert said["valid"] is False
    assert said["false_alarm_rate"] == 0.001
    assert said["test"]["p_value"] < said["test"]["level"]
    assert said["explained_by"]["what"] == "offset"
    assert [c["name"] for c in said["changed"]] == ["offset[0]", "offset[1]", "offset[2]"]
    assert said["recalibrate"]["hold"] == ["scale"]
    page = (out / "report.html").read_text()
    assert "Not valid: offset changed" in page
    assert 'id="control"' in page
    printed = " ".join(capsys.readouterr().out.split())
    assert "NOT VALID: offset changed" in printed


def test_the_smallest_recalibration_runs_as_it_is_printed(folder, capsys):
    casest(["check", str(folder / "out"), str(folder / "knocked.csv"), "--json"])
    command = json.loads(capsys.readouterr().out)["recalibrate"]["command"]
    words = shlex.split(command)[1:]
    assert casest([*words, "-o", str(folder / "again")]) == 0
    found = json.loads((folder / "again" / "result.json").read_text())["estimate"]["parameters"]
    assert list(found) == ["offset"]
    np.testing.assert_allclose(found["offset"]["value"], OFFSET + KNOCK, atol=0.02)


def test_several_dates_have_a_chart(folder, capsys):
    dates = [str(folder / "same.csv"), str(folder / "knocked.csv")]
    out = folder / "dates"
    assert casest(["check", str(folder / "out"), *dates, "-o", str(out)]) == 2
    said = json.loads((out / "check.json").read_text())
    assert [d["valid"] for d in said["dates"]] == [True, False]
    assert len(said["chart"]["lines"]) == 9
    assert all(len(line["mean"]) == 2 for line in said["chart"]["lines"])
    assert "knocked: not valid" in capsys.readouterr().out.replace(".csv", "")


def test_conditions_that_the_calibration_did_not_see_are_said(folder, capsys):
    rows = (folder / "knocked.csv").read_text().splitlines()
    hot = [rows[0], *(f"{row.rpartition(',')[0]},65" for row in rows[1:])]
    (folder / "hot.csv").write_text("\n".join(hot) + "\n")
    casest(["check", str(folder / "out"), str(folder / "hot.csv"), "--json"])
    said = json.loads(capsys.readouterr().out)
    assert said["conditions"] == [{"column": "temp", "before": [20.0, 23.9], "now": [65.0, 65.0]}]


def test_the_record_of_the_calibration_itself_says_nothing(folder, capsys):
    casest(["check", str(folder / "out"), str(folder / "first.csv")])
    assert "says nothing of the calibration's validity" in " ".join(capsys.readouterr().out.split())


def test_what_cannot_be_checked_is_refused_in_one_sentence(folder, capsys):
    same = str(folder / "same.csv")
    result = json.loads((folder / "out" / "result.json").read_text())

    def said(change, *words):
        content = change(json.loads(json.dumps(result)))
        (folder / "changed").mkdir(exist_ok=True)
        (folder / "changed" / "result.json").write_text(json.dumps(content))
        assert casest(["check", str(folder / "changed"), same, *words]) == 1
        return capsys.readouterr().err

    def older(content):
        del content["estimate"]["correlation"]["std"]
        return content

    assert "made by an older casest" in said(older)
    assert "this estimate was refused" in said(lambda c: c | {"trusted": False})
    assert "--false-alarms 2" in said(lambda c: c, "--false-alarms", "2")
    assert casest(["check", str(folder / "out"), str(folder / "nowhere.csv")]) == 1


def test_a_model_whose_parameters_are_all_a_runs_own_holds_nothing():
    rng = np.random.default_rng(11)
    model = linear.scoped("offset", "run").scoped("gain", "run")
    old = old_of(calibrate(model, [line(rng), line(rng)]))
    with pytest.raises(UsageError, match="nothing that an old calibration could hold"):
        check(old, [(line(rng),)])
