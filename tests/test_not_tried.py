"""What was not tried for want of a word in the declaration is said, with the way out."""

from __future__ import annotations

import numpy as np

import casest
from casest import Residual, model, param, quantity, signal


@model
def bare(x=signal("V"), y=signal("V"), *, gain=param(start=1.0), zero=param("V")):
    """Nothing is said to be corrected."""
    return Residual(measured=y, predicted=quantity("seen", zero + gain * x, "V"))


@model
def told(x=signal("V"), y=signal("V"), *, gain=param(start=1.0), zero=param("V")):
    """The same, with the input that a bend acts on."""
    true = quantity("true", x * 1.0, "V")
    seen = quantity("seen", zero + gain * true, "V")
    return Residual(measured=y, predicted=seen, corrected=true)


def record(bend):
    rng = np.random.default_rng(3)
    x = rng.uniform(-1, 1, 60)
    return {"x": x, "y": 0.1 + 1.02 * x + bend * x**3 + 0.01 * rng.standard_normal(60)}


def said(closing):
    return " ".join(str(closing).split())


def test_a_model_that_names_no_input_is_told_how_to_name_it():
    text = said(casest.close(bare, record(0.0)))
    assert "adequate: nothing that was tried is missing; bends were not (see below)" in text
    assert "not tried: axis_gain" in text
    assert "declares no corrected quantity: Residual(…, corrected=…) says on which" in text


def test_with_it_bends_are_tried_and_found():
    text = said(casest.close(told, record(0.0)))
    assert "adequate: nothing that 60 rows can show is missing" in text
    assert "corrected=…" not in text
    found = [e.candidate.label for e in casest.close(told, record(0.1)).effects]
    assert found == ["cubic"]


def test_beside_a_cause_that_was_found_it_is_said_that_bends_were_not_tried():
    rng, t = np.random.default_rng(5), 0.1 * np.arange(300)
    x = rng.uniform(-1, 1, 300)
    y = 0.1 + 1.02 * x + 0.004 * t + 0.01 * rng.standard_normal(300)
    text = said(casest.close(bare, {"t": t, "x": x, "y": y}))
    assert "extended: bias_drift" in text
    assert "; bends were not tried (see below)" in text
    assert "bends were not" not in said(casest.close(told, {"t": t, "x": x, "y": y}))
