"""The judge of measured records: what it calls right, unhelpful and wrong."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

from casest import Residual, Run, constant, model, param, quantity, signal

STUDIES = str(Path(__file__).parents[1] / "studies")


@pytest.fixture
def study(monkeypatch):
    """studies/records.py as a module."""
    monkeypatch.syspath_prepend(STUDIES)
    return importlib.import_module("records")


def said(verdict, *effects, stretches=(2.0, 1.0), one_of=()):
    """A row as `close` leaves it; effects as a name, or a name with its rivals and values."""
    made = [{"name": e} if isinstance(e, str) else e for e in effects]
    full = [{"label": e["name"], "rivals": [], "values": {}} | e for e in made]
    return {"verdict": verdict, "effects": full, "stretches": list(stretches), "one_of": one_of,
            "folds": list(stretches), "seconds": 1.0}  # fmt: skip


def record(study, **right):
    rows = importlib.import_module("record_rows")
    known = {"verdicts": ("extended",), "named": (frozenset({"cross_axis", "soft_iron"}),)}
    return study.Record("a record", "model.py", "a.csv", "", rows.Right(**known | right))


def test_the_name_that_the_record_shows_is_right(study):
    assert study.judged(record(study), said("extended", "cross_axis")) == "right"
    assert study.judged(record(study), said("extended", "outliers", "soft_iron")) == "right"


def test_adequate_where_something_is_missing_is_wrong(study):
    assert study.judged(record(study), said("adequate")) == "wrong: verdict adequate"


def test_a_claim_that_the_record_does_not_support_is_wrong(study):
    row = said("extended", "cross_axis", "formula")
    assert study.judged(record(study), row) == "wrong: formula is claimed"


def test_unexplained_without_the_name_is_unhelpful(study):
    why = "unhelpful: cross_axis or soft_iron is not named"
    assert study.judged(record(study), said("unexplained")) == why


def test_a_name_among_those_not_told_apart_is_named(study):
    right = record(study, verdicts=("unexplained",))
    assert study.judged(right, said("unexplained", one_of=["cross_axis"])) == "right"


def test_one_of_several_that_explain_alike_is_wrong_alone_and_right_with_a_rival(study):
    alike = frozenset({"bias_step", "channel_bias"})
    right = record(study, named=(alike,), rivals=alike)
    alone = {"name": "bias_step"}
    beside = {"name": "bias_step", "rivals": ["channel_bias(current)"]}
    assert study.judged(right, said("extended", alone)).startswith("wrong: bias_step alone")
    assert study.judged(right, said("extended", beside)) == "right"


def test_an_error_that_could_be_smaller_is_unhelpful(study):
    row = said("extended", "cross_axis", stretches=(2.0, 1.0))
    assert study.judged(record(study, within=0.5), row).startswith("unhelpful: 1 is left")
    assert study.judged(record(study, within=1.5), row) == "right"


def test_a_value_outside_its_bounds_is_wrong(study):
    lag = {"name": "signal_lag", "values": {"delay": -0.4}}
    right = record(study, named=(frozenset({"signal_lag"}),), values={"delay": (0.03, 0.08)})
    assert study.judged(right, said("extended", lag)) == "wrong: signal_lag: delay = 0.4"


def test_an_error_is_a_row(study):
    row = {"name": "a record", "error": "no such file", "seconds": 0.1}
    assert study.judged(record(study), row) == "wrong: error: no such file"
    assert "| error | - | - | - | - | 0.1 |" in study.line(record(study), row)


def test_stretches_are_predicted_by_a_fit_to_the_others(study):
    """Of a constant: the mean of nine tenths, in closed form."""

    @model
    def level(y=signal("m"), *, zero=param("m"), one=constant(1.0, "")):
        return Residual(measured=y, predicted=quantity("reading", zero * one, "m"))

    y = np.random.default_rng(1).normal(size=200)
    run = Run.raw("a", {"y": y[:, None]}, units={"y": "m"})
    tenths = y.reshape(10, 20)
    means = [np.delete(tenths, k, axis=0).mean() for k in range(10)]
    errors = np.sort(np.abs(tenths - np.array(means)[:, None]).ravel())
    expected = np.sqrt(np.mean(errors[:-1] ** 2))  # of 200 the largest is left away
    found = study.held_out(level, {"zero": np.array(0.0)}, (run,))
    assert found == pytest.approx(expected, rel=1e-9)
