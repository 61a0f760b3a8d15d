"""Noise of every sensor of a simulated record: of what is measured, and of what a model reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.leastsquares.stated import roots_of


def with_noise(
    run: Run, noise: Mapping[str, Array], rng: np.random.Generator
) -> tuple[Run, dict[str, list[float]]]:
    """The run with noise added, and the root mean square that each number of a signal has of it.

    `noise` is what one run has in `leastsquares.stated.stated_noise`: signals together as "x,y".
    """
    signals, sizes = dict(run.signals), dict[str, list[float]]()
    for key, given in noise.items():
        group, first = tuple(key.split(",")), 0
        root = roots_of(group, given, run)
        if root.ndim == 2:
            root = root[:, :, None] * np.eye(root.shape[1])
        drawn = np.einsum("nkl,nl->nk", root, rng.standard_normal(root.shape[:2]))
        std = np.sqrt(np.mean(np.sum(root**2, axis=2), axis=0))
        for name in group:
            last = first + run.signals[name].shape[1]
            signals[name] = run.signals[name] + drawn[:, first:last]
            sizes[name], first = std[first:last].tolist(), last
    return replace(run, signals=signals), sizes
