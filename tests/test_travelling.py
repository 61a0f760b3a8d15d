"""Models, effects and results on their way to another process."""

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pytest
import simulators as sim

from casest import UsageError, calibrate_many, model, param, quantity, signal
from casest.declaration.physics import Residual
from casest.declaration.travelling import fingerprint
from casest.effects import CATALOGUE
from casest.results.find import SHIPPED, find_model

OWN = """
from casest import Residual, model, param, quantity, signal

FACTOR = {factor}


@model
def spring(x=signal("m"), force=signal("N"), *, stiffness=param("N/m", start=1.0)):
    return Residual(measured=force, predicted=quantity("pull", FACTOR * stiffness * x, "N"))
"""

#: Reads a pickle and says what the model predicts at x = 2.
ELSEWHERE = """
import pickle, sys
found = pickle.load(open(sys.argv[1], "rb"))
print(found.name, found(x=[[2.0]], force=[[0.0]])["predicted"].ravel()[0])
"""


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_model_arrives_as_it_was(name):
    sent = find_model(name)
    assert sent.traced  # symbols that do not pickle
    assert pickle.loads(pickle.dumps(sent)) == sent


def test_every_effect_of_the_catalogue_arrives_as_it_was():
    assert pickle.loads(pickle.dumps(CATALOGUE)) == CATALOGUE


def test_a_model_with_constants_and_an_effect_arrives_as_it_was():
    imbalance = next(e for e in CATALOGUE if e.name == "imbalance")
    sent = find_model("wheel").having(radius=0.3).with_effect(imbalance)
    assert pickle.loads(pickle.dumps(sent)) == sent


def own(folder, factor):
    folder.mkdir(exist_ok=True)
    file = folder / "spring.py"
    file.write_text(OWN.format(factor=factor))
    return find_model(str(file))


def test_a_users_model_reaches_a_process_that_has_not_its_file(tmp_path):
    sent = tmp_path / "model.pickle"
    sent.write_bytes(pickle.dumps(own(tmp_path / "here", 3.0)))
    (tmp_path / "here" / "spring.py").unlink()
    done = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, str(sent)], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["spring", "6.0"]


def test_two_users_models_of_one_name_stay_two(tmp_path):
    sent = [pickle.dumps(own(tmp_path / str(k), factor)) for k, factor in enumerate((3.0, 5.0))]
    found = [pickle.loads(text)(x=[[2.0]], force=[[0.0]])["predicted"].item() for text in sent]
    assert found == [6.0, 10.0]


def test_a_model_made_inside_a_function_is_refused_by_name():
    @model
    def local(x=signal("m"), *, gain=param("1", start=1.0)):
        return Residual(measured=x, predicted=quantity("p", gain * x, "m"))

    with pytest.raises(UsageError, match=r"local of .* cannot be sent to another process: it is"):
        pickle.dumps(local)


def test_the_fingerprint_is_that_of_the_source_and_the_numbers(tmp_path):
    first = fingerprint(own(tmp_path / "a", 3.0))
    assert fingerprint(own(tmp_path / "b", 3.0)) == first
    assert fingerprint(own(tmp_path / "c", 4.0)) != first
    free = find_model("norm-triangular")
    assert fingerprint(free.having(norm=9.81)) != fingerprint(free.having(norm=9.82))


def test_the_fingerprint_is_the_same_in_every_process():
    code = (
        "from casest.results.find import find_model\n"
        "from casest.declaration.travelling import fingerprint\n"
        "print(fingerprint(find_model('norm-pair')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == fingerprint(find_model("norm-pair"))


def test_results_of_many_sensors_arrive_as_they_were():
    rng = np.random.default_rng(0)
    triad = sim.accelerometer(rng)
    v = np.array([triad.read(sim.spread_poses(24, rng), 0.01, rng) for _ in range(3)])
    v[1] = 0.0
    sent = calibrate_many(find_model("norm-triangular").having(norm=sim.GRAVITY), {"v": v})
    found = pickle.loads(pickle.dumps(sent))
    assert found.model == sent.model
    assert np.array_equal(found.covariance, sent.covariance, equal_nan=True)
    assert [*found.reasons] == [*sent.reasons]
