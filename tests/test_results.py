"""Results as values: frozen, written as they stand, and nothing beside the file's own fields."""

from __future__ import annotations

import json
from importlib.resources import files

import jsonschema
import msgspec
import numpy as np
import pytest
from msgspec import UNSET

import casest as c
from casest.demo import RECORD
from casest.results.calibration import calibration_result
from casest.results.file import as_json
from casest.results.find import find_model
from casest.results.fitted import Noise, Section
from casest.results.result import Result


class Small(Result, frozen=True, kw_only=True, dict=True):
    unwritten = ("drawn",)

    numbers: object
    absent: object = UNSET
    drawn: object


def test_what_is_not_finite_is_null_and_what_is_unset_is_absent():
    shown = Small(model="m", numbers=(1.5, np.nan, {"a": np.array([np.inf, 2.0])}), drawn=object())
    assert shown.content() == {
        "casest": c.__version__, "model": "m", "numbers": [1.5, None, {"a": [None, 2.0]}],
    }  # fmt: skip
    assert json.loads(as_json(shown.content()))["numbers"] == [1.5, None, {"a": [None, 2.0]}]


@pytest.fixture(scope="module")
def calibrated():
    model = find_model("norm-triangular").having(norm=9.80665)
    columns = {"v": ("ax", "ay", "az")}
    runs = c.load_runs([RECORD], model.signals, columns=columns, rate=50, at_rest=True)
    return calibration_result(c.calibrate(model, runs), model_name="norm-triangular", data=[])


def test_a_result_does_not_change(calibrated):
    with pytest.raises(AttributeError, match="immutable"):
        calibrated.trusted = False
    with pytest.raises(AttributeError, match="immutable"):
        calibrated.estimate.certificate.trusted = False


def test_the_file_holds_what_its_schema_says_and_nothing_that_is_only_drawn(calibrated):
    content = json.loads(as_json(calibrated.content()))
    schema = json.loads(files("casest.results").joinpath("result.schema.json").read_text("utf-8"))
    jsonschema.validate(content, schema)
    assert not {*calibrated.unwritten, "before", "after"} & set(content)


def test_what_was_written_is_read_back_as_the_same_values(calibrated):
    content = json.loads(as_json(calibrated.content()))
    assert msgspec.convert(content["estimate"], Section) == calibrated.estimate
    assert msgspec.convert(content["noise"], Noise) == calibrated.noise
