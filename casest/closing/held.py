"""What a profile holds while a candidate is tried: a level or a moment, moved step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casest.closing.candidates import Candidate
from casest.closing.profile import least_beside
from casest.closing.score import Score
from casest.data.run import Run


def held_value(candidate: Candidate) -> tuple[str, str, float] | None:
    """Name, kind and value of what a profile holds: a level or a moment."""
    profile = dict(candidate.effect.profile) if candidate.effect else {}
    for name, kind in profile.items():
        assert candidate.effect is not None
        for n, d in candidate.effect.declarations:
            if n == name and kind in ("level", "time"):
                return name, kind, float(d.array)
    return None


def strides(kind: str, value: float, runs: Sequence[Run]) -> list[float]:
    """From coarse to fine: shares of a level; samples around a moment."""
    if kind == "level":
        return [abs(value) * 0.02 / 4**k for k in range(4)]
    times = [run.signals["t"][:, 0] for run in runs if "t" in run.signals]
    gap = min((float(np.median(np.diff(t))) for t in times if len(t) > 1), default=1.0)
    return [gap * n for n in (8, 2, 1)]


def within(kind: str, value: float, runs: Sequence[Run], axes: int) -> bool:
    """Does a run have enough samples before and after the moment?"""
    if kind != "time":
        return True
    times = [run.signals["t"][:, 0] for run in runs if "t" in run.signals]
    return any(
        least_beside(len(t), axes)
        <= np.count_nonzero(t <= value)
        <= len(t) - least_beside(len(t), axes)
        for t in times
    )


def holding(score: Score, name: str, value: float) -> Score:
    """The score's candidate with another value held."""
    assert score.candidate.effect is not None
    effect = score.candidate.effect.holding(**{name: float(f"{value:.9g}")})
    return replace(score, candidate=replace(score.candidate, effect=effect, traced=None))
