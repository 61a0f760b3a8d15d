"""An old calibration judged by records whose noise is stated: by that noise."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from casest import Run, attempt
from casest.cli import run as casest
from casest.leastsquares.stated import stated_noise
from casest.validity.check import check
from casest.validity.old import STATED, Old
from casest_problems.one_channel import linear

TRUE = (2.0, 3.0)


def line(rng, std):
    """Readings of a straight line, each with a noise of its own."""
    x = rng.uniform(0, 10, len(std))
    y = TRUE[0] + TRUE[1] * x + std * rng.standard_normal(len(std))
    signals = {"reference": x[:, None], "reading": y[:, None]}
    return Run.raw("line", signals, units={"reference": None, "reading": None})


def noisy(record, std):
    return stated_noise(linear, [record], {"reading": [std[:, None]]})


def calibrated(rng):
    std = rng.uniform(0.02, 0.2, 12)
    record = line(rng, std)
    found = attempt(*noisy(record, std), intervals=False)
    old = Old(linear, found.values, found.names, found.covariance, found.noise.sigma, STATED, None)
    return old, record, std


def by_hand(old_record, old_std, record, std):
    """chi-square of the difference of two straight lines that NumPy fits with weights."""
    fits = []
    for one, own in ((old_record, old_std), (record, std)):
        A = np.column_stack([np.ones(len(own)), one.signals["reference"][:, 0]]) / own[:, None]
        C = np.linalg.inv(A.T @ A)
        fits.append((C @ A.T @ (one.signals["reading"][:, 0] / own), C))
    (before, C), (now, D) = fits
    return float((now - before) @ np.linalg.solve(C + D, now - before))


def test_the_test_is_that_of_two_weighted_lines():
    """Three readings would say next to nothing of their noise by themselves."""
    rng = np.random.default_rng(3)
    old, before, old_std = calibrated(rng)
    std = np.array([0.02, 0.3, 0.05])
    new = line(rng, std)
    model, runs = noisy(new, std)
    test = check(old, [runs], models=[model]).dates[0].test
    expected = by_hand(before, old_std, new, std)
    assert test.statistic == pytest.approx(expected, rel=1e-6)
    assert test.p_value == pytest.approx(stats.chi2.sf(expected, 2), rel=1e-6)


def test_p_values_of_valid_calibrations_are_uniform():
    p, noise = [], []
    for seed in range(60):
        rng = np.random.default_rng([seed, 4])
        old = calibrated(rng)[0]
        std = rng.uniform(0.02, 0.5, 6)
        model, runs = noisy(line(rng, std), std)
        date = check(old, [runs], models=[model]).dates[0]
        p.append(date.test.p_value)
        noise.append(date.subject.noise.p_value)
    assert stats.kstest(p, "uniform").pvalue > 0.01
    assert np.mean(np.array(noise) < 0.05) < 0.08


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("stated"), np.random.default_rng(8)
    for name, count, shift, loud in (
        ("first", 15, 0, 1), ("same", 5, 0, 1), ("moved", 5, 0.25, 1), ("loud", 12, 0, 6),
    ):  # fmt: skip
        x = np.linspace(0, 10, count)
        y = TRUE[0] + shift + TRUE[1] * x + 0.05 * loud * rng.standard_normal(count)
        table = np.column_stack([x, y, np.full(count, 0.05)])
        for file, k in ((name, 2), (f"{name}_u", 3)):
            head = ",".join(["reference [N]", "reading [V]", "u_reading [V]"][:k])
            np.savetxt(
                folder / f"{file}.csv", table[:, :k], delimiter=",", comments="", header=head
            )
    words = ["calibrate", "linear", f"{folder}/first.csv", "--sensor-noise", "reading=50 mV"]
    assert casest([*words, "-o", f"{folder}/out"]) == 0
    return folder


@pytest.mark.parametrize(
    ("record", "words", "code"),
    [
        ("same", [], 0),
        ("moved", [], 2),
        ("loud", [], 2),
        ("loud", ["--sensor-noise", "reading=0.3"], 0),
        ("same_u", [], 0),
        ("loud_u", [], 2),
    ],
)
def test_what_was_stated_is_asked_of_new_records_too(folder, capsys, record, words, code):
    given = ["check", f"{folder}/out", f"{folder}/{record}.csv", *words]
    capsys.readouterr()
    assert casest([*given, "--json"]) == code
    noise = json.loads(capsys.readouterr().out)["noise"]
    assert noise["stated"] is True
    assert noise["before"] == pytest.approx(0.3 if words else 0.05)
    assert casest(given) == code
    assert "times as stated" in " ".join(capsys.readouterr().out.split())


def test_the_repair_states_the_noise_too(folder, capsys):
    assert casest(["check", f"{folder}/out", f"{folder}/moved.csv", "--json"]) == 2
    command = json.loads(capsys.readouterr().out)["recalibrate"]["command"]
    assert command.endswith("--sensor-noise 'reading=50 mV'")
