"""Where to look, in motion, for what has a moment or a frequency.

The innovations themselves say where: what they say of each sample's share in an effect, summed from
a moment on, or by frequency. How much was looked through is counted, and paid for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casest.declaration.effect import Effect
from casest.declaration.shapes import Array
from casest.diagnose.candidates.grid import Seen, searched
from casest.diagnose.evidence.linear import Index, Linear
from casest.diagnose.motion.fit import Fit
from casest.diagnose.motion.sensitivity import gains, pushes
from casest.effects.moving import Candidate

#: Records of pure noise that tell how much information there is on each moment.
SURROGATES = 8
#: Moments that are looked at, and the share of a record within which two are one.
MOMENTS, APART = 3, 0.02
#: Share of a record at its ends in which no step is looked for: it would be an offset.
EDGE = 0.05
#: What is found on a grid first and is fitted then: an effect is smooth in it.
SMOOTH = ("frequency",)


def profile(candidate: Candidate) -> dict[str, str]:
    """What it is searched over, and of what kind that is."""
    return dict(candidate.effect.profile) if isinstance(candidate.effect, Effect) else {}


def on_grid(fit: Fit, candidate: Candidate, linear: Linear, rows: Index) -> list[Candidate]:
    """The candidate at values of what it is searched over; alone where that is nothing."""
    searching = profile(candidate)
    if not searching:
        return [candidate]
    ((name, kind),) = searching.items()
    z = gains(fit.found).z
    time = fit.run.signals["t"][:, 0]
    if kind == "time":
        noise = np.random.default_rng(0).standard_normal((*z.shape, SURROGATES))
        both = np.concatenate([z[:, :, None], noise], axis=2)
        said = pushes(fit.base, fit.added, candidate, fit.run, fit.found, both)
        values, trials = _moments(time, said)
    else:
        said = pushes(fit.base, fit.added, candidate, fit.run, fit.found, z[:, :, None])
        live = said[rows][:, np.ptp(said[:, :, 0], axis=0) > 0, 0]
        found, trials = searched((kind,), Seen(live, None, time[rows], linear))
        values = [v for (v,) in found]
    return [replace(candidate, held=((name, float(f"{v:.9g}")),), trials=trials) for v in values]


def nearer(fit: Fit, candidate: Candidate, scale: float) -> list[Candidate]:
    """Some samples earlier and later."""
    if "time" not in profile(candidate).values():
        return []
    step = float(np.median(np.diff(fit.found.time)))
    ((name, value),) = candidate.held
    far = max(1, round(10 * scale))
    several = sorted({far, max(1, far // 3)})
    moved = [value + way * k * step for k in several for way in (-1, 1)]
    return [replace(candidate, held=((name, float(f"{v:.9g}")),)) for v in moved]


def _moments(time: Array, said: Array) -> tuple[list[float], float]:
    """The best moments for a step, between two samples; `said` (N, p, 1 + surrogates)."""
    count = len(time)
    after = np.cumsum(said[::-1], axis=0)[::-1]
    information = np.mean(after[:, :, 1:] ** 2, axis=2)
    wide = max(3, int(APART * count))
    gain = np.zeros(count)
    for own, size in zip(after[:, :, 0].T, information.T, strict=True):
        smooth = np.convolve(size, np.ones(2 * wide + 1) / (2 * wide + 1), "same")
        gain += own**2 / np.maximum(smooth, 1e-12 * smooth.max(initial=1e-300))
    edge, found = max(4, int(EDGE * count)), list[int]()
    gain[:edge] = gain[count - edge :] = 0.0
    for k in np.argsort(-gain):
        if len(found) == MOMENTS or not gain[k] > 0:
            break
        if all(abs(int(k) - other) > wide for other in found):
            found.append(int(k))
    return [float(0.5 * (time[k - 1] + time[k])) for k in found], float(count)


def free(candidate: Candidate) -> tuple[Candidate, Array]:
    """With its frequency unknown again, from where it was found."""
    smooth: Sequence[str] = [n for n, kind in profile(candidate).items() if kind in SMOOTH]
    return candidate.free(smooth)
