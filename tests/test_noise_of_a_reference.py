"""What noise of a reference's own would do to a slope: said where its quick part allows it."""

from __future__ import annotations

import numpy as np
import pytest

from casest import close


def told(path, rng, *, of_reference, of_reading, rows=3000, held=1):
    """A slow course read by two meters; the gain is 1."""
    t = 0.1 * np.arange(rows)
    true = 20 + 3 * np.sin(0.05 * t) + 2 * np.sin(0.13 * t + 1)
    true = np.repeat(true[::held], held)[:rows]
    x = true + of_reference * rng.standard_normal(rows)
    y = true + of_reading * rng.standard_normal(rows)
    np.savetxt(path, np.column_stack([t, x, y]), delimiter=",",
               header="t [s],reference,reading", comments="", fmt="%.6f")  # fmt: skip
    return close("linear", path)


def hidden(closing):
    """Largest shift of the gain by the reference's noise that is said, and how much noise it is."""
    from casest.results.closing import closing_result

    result = closing_result(closing, model_name="linear", data=[])
    found = [h for h in result.invisible if h.name == "noise of reference"]
    return (found[0].would_move["gain"], found[0].typical["std"]) if found else None


def test_noise_of_the_reference_is_said_with_what_it_does_to_the_gain(tmp_path):
    """A slope is too small by the noise's part of the reference's variance: the course has 6.5."""
    rng = np.random.default_rng(1)
    found = told(tmp_path / "a.csv", rng, of_reference=0.8, of_reading=0.8)
    off = 1 - float(found.after.values["gain"])
    assert off == pytest.approx(0.8**2 / (6.5 + 0.8**2), rel=0.2)
    assert off > 4 * float(found.after.std["gain"])
    shift, size = hidden(found)
    # As much as it may be, by what is quick in it: with what chance may have hidden of it.
    assert 0.8 <= size < 1.0
    assert off < shift < 1.6 * off


@pytest.mark.parametrize("held", [1, 50])
def test_a_reference_without_noise_is_under_no_suspicion(tmp_path, held):
    rng = np.random.default_rng(2)
    found = told(tmp_path / "a.csv", rng, of_reference=0.0, of_reading=1.1, held=held)
    assert hidden(found) is None


def test_noise_that_moves_nothing_is_not_spoken_of(tmp_path):
    rng = np.random.default_rng(3)
    found = told(tmp_path / "a.csv", rng, of_reference=0.02, of_reading=0.02)
    assert hidden(found) is None
