"""A sign that says which of two instruments a cause belongs to is said in words."""

from __future__ import annotations

import numpy as np
import pytest

from casest.cli import run


def play(x, width):
    """What follows x with a play of so much to either side."""
    found, at = np.empty_like(x), x[0]
    for k, value in enumerate(x):
        at = min(max(at, value - width), value + width)
        found[k] = at
    return found


@pytest.mark.long
@pytest.mark.parametrize(("slack", "said"), [("reference", True), ("reading", False)])
def test_whose_play_it_is(tmp_path, capsys, slack, said):
    rng, t = np.random.default_rng(1), 0.02 * np.arange(1500)
    x = 10 * np.sin(0.9 * t) + 4 * np.sin(2.3 * t + 1)
    both = {"reference": x, "reading": 2 * x}
    both[slack] = play(both[slack], 0.3)
    both["reading"] = both["reading"] + 0.05 * rng.standard_normal(1500)
    columns = np.c_[t, both["reference"], both["reading"]]
    path = tmp_path / "r.csv"
    np.savetxt(path, columns, delimiter=",", header="t,reference,reading", comments="")
    assert run(["close", "linear", str(path)]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "hysteresis on predicted" in words
    assert ("k is below zero: the reading leads" in words) is said
