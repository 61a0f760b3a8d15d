"""What happened in one record alone is not carried to another one."""

from __future__ import annotations

import json

import numpy as np
import pytest

from casest.cli import run

MODEL = '''from casest import Residual, model, param, signal

@model
def still(v=signal("mV"), t=signal("s"), *, level=param("mV")):
    """A voltage that is said to stay the same."""
    return Residual(measured=v, predicted=level)
'''


@pytest.mark.long
@pytest.mark.parametrize("again", [False, True])
def test_a_magnet_that_came_and_went_is_in_no_other_record(tmp_path, capsys, again):
    """A pulse of 5 mV from 20 to 30 s, in noise of 0.1 mV; the other record has none.

    Carried to it as it was, the pulse would be wrong by 5·√(10/60) = 2 mV. In two records at the
    same moment it comes again each time: then it is kept.
    """
    rng, files = np.random.default_rng(4), []
    for name, there in (("a", 1), ("b", 1), ("other", again)):
        t = np.arange(300) / 5
        v = 7 + 5 * there * ((t > 20) & (t <= 30)) + 0.1 * rng.standard_normal(300)
        files.append(str(tmp_path / f"{name}.csv"))
        np.savetxt(files[-1], np.c_[t, v], delimiter=",", header="t [s],v [mV]", comments="")
    (tmp_path / "still.py").write_text(MODEL, encoding="utf-8")
    fitted, out = files[: 1 + again], tmp_path / "out"
    said = ["close", str(tmp_path / "still.py"), *fitted, "--holdout", files[2], "-o", str(out)]
    assert run(said) == 0
    found = json.loads((out / "result.json").read_text("utf-8"))
    assert [e["name"] for e in found["effects"]] == ["pulse"]
    assert found["after"]["parameters"]["pulse.k"]["value"] == pytest.approx(5, abs=0.1)
    # The declared model takes the pulse for a part of the level, 5/6 mV of it.
    assert found["before"]["rmse_holdout"] > 0.8
    assert found["after"]["rmse_holdout"] == pytest.approx(0.1, rel=0.1)
    assert found["holdout"] == [files[2]]
    assert "    held-out, other.csv " in capsys.readouterr().out
    note = "pulse: happened in the record of the fit; another one is foretold without what passed"
    assert any(note in n for n in found["notes"]) == (not again)


@pytest.mark.parametrize(("other", "off"), [pytest.param(1, 2.0, marks=pytest.mark.long), (2, 1.0)])
def test_of_an_offset_that_jumped_another_record_has_the_mean(tmp_path, other, off):
    """A jump by 3 mV after 20 of 60 s: of another record at 7 or at 10 mV the level is 9 mV."""
    rng, t, files = np.random.default_rng(5), np.arange(300) / 5, []
    for name, level in (("a", 7 + 3 * (t > 20)), ("low", 7), ("high", 10)):
        v = level + 0.1 * rng.standard_normal(300)
        files.append(str(tmp_path / f"{name}.csv"))
        np.savetxt(files[-1], np.c_[t, v], delimiter=",", header="t [s],v [mV]", comments="")
    (tmp_path / "still.py").write_text(MODEL, encoding="utf-8")
    said = ["close", str(tmp_path / "still.py"), files[0], "--holdout", files[other]]
    assert run([*said, "-o", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "result.json").read_text("utf-8"))
    assert [e["name"] for e in found["effects"]] == ["bias_step"]
    assert found["after"]["rmse_holdout"] == pytest.approx(np.hypot(off, 0.1), rel=0.03)
