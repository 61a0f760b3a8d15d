"""What grows from a moment on is no jump: a field that fades while somebody walks away."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from casest import close
from casest.results.find import find_model

T = 0.04 * np.arange(1000)
COMPASS = find_model("norm-diagonal").having(norm=45.0)


def waved(seed, moved):
    """Readings (N, 3) of a magnetometer turned by hand, 0.7 uT of noise; `moved` (N, 3) beside."""
    rng = np.random.default_rng([8, seed])
    turned = np.cumsum(0.25 * rng.standard_normal((T.size, 3)), axis=0)
    by_hand = np.hanning(9) / np.hanning(9).sum()
    turned = np.stack([np.convolve(c, by_hand, "same") for c in turned.T], axis=1)
    b = Rotation.from_rotvec(turned).apply([0.45, 0.1, -0.88])
    b *= 45 / np.linalg.norm(b, axis=1)[:, None]
    return b * [1.03, 0.98, 1.01] + [12, -8, 3] + moved + 0.7 * rng.standard_normal(b.shape)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(6))
def test_a_field_that_fades_is_no_jump(seed):
    """Of two public records it was said that an offset jumped near their ends."""
    growing = np.maximum(T - 36, 0)[:, None] * [-1.6, 0.9, 0.1]
    closing = close(COMPASS, {"v": waved(seed, growing), "t": T})
    assert closing.verdict == "unexplained"
    assert closing.effects == ()


@pytest.mark.long
def test_a_jump_as_late_is_found_in_most_records():
    jumped = (T > 36)[:, None] * np.array([-4, 2.5, 0.1])
    named = [close(COMPASS, {"v": waved(k, jumped), "t": T}).effects for k in range(6)]
    assert sum([e.candidate.label for e in found] == ["bias_step"] for found in named) >= 5


@pytest.mark.long
def test_who_knows_that_it_grows_says_so():
    growing = np.maximum(T - 36, 0)[:, None] * [-1.6, 0.9, 0.1]
    closing = close(COMPASS, {"v": waved(0, growing), "t": T}, known=["bias_ramp"])
    assert [e.candidate.label for e in closing.effects][:1] == ["bias_ramp"]
    k, std = (of["bias_ramp.k"] for of in (closing.after.values, closing.after.std))
    grown = np.array([-1.6, 0.9, 0.1]) / [1.03, 0.98, 1.01]  # taken from what is corrected
    assert np.all(np.abs(k + grown) < 5 * std + 0.05)
