"""Verdicts on many sensors: codes and figures in arrays, put into words when somebody asks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from enum import IntFlag
from typing import overload

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.fleet.fit import Flags


class Code(IntFlag):
    """What may speak against an estimate, in the order in which it is said."""

    READING = 1
    NOT_FINITE = 2
    NO_REDUNDANCY = 4
    NOT_DETERMINED = 8
    BOUND = 16
    NOT_SETTLED = 32
    NO_MINIMUM = 64
    MISSHAPEN = 128
    AMBIGUOUS = 256
    NOISE = 512
    LOUD = 1024
    CORRELATED = 2048


@dataclass
class _Figures:
    """Codes with the figures that their words quote; the sensor axis is the last, W or S long.

    `where` first sample that is not finite; `bound` unknown on its bound; `step` last step in
    standard deviations; `low` and `high` rise of the cost over that of a parabola; `second` second
    order of the noise over the noise; `smallest` singular value and its direction `weakest` (n, W).
    """

    code: NDArray[np.int_]
    where: NDArray[np.int_]
    bound: NDArray[np.int_]
    step: Array
    low: Array
    high: Array
    second: Array
    smallest: Array
    weakest: Array
    sigma: Array


def _blank(n: int, width: int) -> _Figures:
    none, nan = np.zeros(width, int), np.full(width, np.nan)
    return _Figures(
        code=none,
        where=none.copy(),
        bound=none.copy(),
        step=nan,
        low=nan.copy(),
        high=nan.copy(),
        second=nan.copy(),
        smallest=nan.copy(),
        weakest=np.full((n, width), np.nan),
        sigma=nan.copy(),
    )


@dataclass
class Judged(_Figures):
    """Figures of a block with what its sensors are given: std (n, W), covariance, rmse (W,)."""

    std: Array
    covariance: Array
    rmse: Array

    @classmethod
    def of(cls, shape: tuple[int, ...], sigma: Array, rmse: Array) -> Judged:
        """Nothing said yet about W sensors of n unknowns; `shape` is (n, W)."""
        blank = _blank(*shape)
        parts = {f.name: getattr(blank, f.name) for f in fields(blank)}
        parts["sigma"] = sigma
        return cls(**parts, std=np.empty(shape), covariance=np.empty((shape[0], *shape)), rmse=rmse)

    @property
    def refused(self) -> Flags:
        """Does anything speak against the sensor?"""
        return np.asarray(self.code != 0)

    def add(self, code: Code, against: Flags, places: NDArray[np.int_] | None = None) -> None:
        """Hold a code against some sensors, `against` (W,), or (len(places),) of those places."""
        chosen = np.flatnonzero(against)
        chosen = chosen if places is None else places[chosen]
        self.code[chosen] |= int(code)


@dataclass
class Verdicts(Sequence[tuple[str, ...]]):
    """Reasons of every sensor: `verdicts[i]` is a tuple of sentences."""

    names: tuple[str, ...]
    figures: _Figures
    replaced: dict[int, tuple[bool, tuple[str, ...]]] = field(default_factory=dict)

    @classmethod
    def empty(cls, names: tuple[str, ...], size: int) -> Verdicts:
        """Room for S sensors."""
        return cls(names, _blank(len(names), size))

    def put(self, span: slice, judged: Judged) -> None:
        """Take over the figures of a block."""
        for f in fields(_Figures):
            own = getattr(judged, f.name)
            getattr(self.figures, f.name)[..., span] = own[..., : span.stop - span.start]

    def replace(self, i: int, trusted: bool, reasons: tuple[str, ...]) -> None:
        """Say of sensor i what was found out about it alone."""
        self.replaced[i] = (trusted, reasons)

    @property
    def trusted(self) -> Flags:
        """Is the sensor's estimate believed, (S,)?"""
        found = np.asarray(self.figures.code == 0)
        for i, (trusted, _) in self.replaced.items():
            found[i] = trusted
        return found

    def __len__(self) -> int:
        return len(self.figures.code)

    @overload
    def __getitem__(self, i: int) -> tuple[str, ...]: ...
    @overload
    def __getitem__(self, i: slice) -> Sequence[tuple[str, ...]]: ...
    def __getitem__(self, i: int | slice) -> tuple[str, ...] | Sequence[tuple[str, ...]]:
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(len(self)))]
        i = range(len(self))[i]
        if i in self.replaced:
            return self.replaced[i][1]
        code = Code(int(self.figures.code[i]))
        # A fit to readings that are no numbers, or that has no fit, has nothing else to say.
        for only in (Code.READING, Code.NOT_FINITE, Code.NO_REDUNDANCY, Code.NOT_DETERMINED):
            if only in code:
                return (self._against(only, i),)
        return tuple(self._against(c, i) for c in Code if c in code) or self._for(i)

    def _against(self, code: Code, i: int) -> str:
        f = self.figures
        return {
            Code.READING: f"sample {f.where[i]} is not finite: measure this sensor again",
            Code.NOT_FINITE: "the residual is not finite at the best point found; give start=",
            Code.NO_REDUNDANCY: (
                f"no redundancy: as many or fewer equations than the {len(self.names)} unknowns; "
                "record more"
            ),
            Code.NOT_DETERMINED: f"not determined: {self._weakest(i)}; vary the motion",
            Code.BOUND: (
                f"`{self.names[f.bound[i]]}` ended on its bound: the data ask for a value outside, "
                "or do not determine it"
            ),
            Code.NOT_SETTLED: (
                f"not determined well enough to settle: {self._weakest(i)}; vary the motion"
                if f.smallest[i] < 1e-3
                else "not a stationary point: the last step was still "
                f"{f.step[i]:.2g} standard deviations long"
            ),
            Code.NO_MINIMUM: "no minimum: the exact curvature is not positive in some direction",
            Code.MISSHAPEN: (
                "too uncertain for its intervals: two standard deviations away the cost rises "
                f"{f.low[i]:.2g} to {f.high[i]:.2g} times as much as they assume; vary the motion"
            ),
            Code.AMBIGUOUS: f"another solution fits alike or better, along {self._weakest(i)}",
            Code.NOISE: (
                "the noise is too large for the curvature of the fitted surface (second-order part "
                f"{f.second[i]:.2g} of the noise): the readings cover too little, or average more "
                "of them"
            ),
            Code.LOUD: (
                f"the residual ({f.sigma[i]:.3g}) is larger than the noise= of a sound sensor: the "
                "sensor is bad, or does not follow the model"
            ),
            Code.CORRELATED: (
                "residuals of neighbouring samples are alike: a time series, or a missing effect; "
                "average readings at rest, or call calibrate"
            ),
        }[code]

    def _weakest(self, i: int) -> str:
        direction = self.figures.weakest[:, i]
        order = np.argsort(-np.abs(direction))
        movers = [f"`{self.names[k]}`" for k in order[:4] if abs(direction[k]) > 0.1]
        return " and ".join(movers) or "some unknowns"

    def _for(self, i: int) -> tuple[str, ...]:
        f = self.figures
        return (
            f"stationary: the step left is at most {f.step[i]:.1g} standard deviations",
            "a minimum: steps shrink, and the cost rises along the weakest direction",
            "intervals describe the cost two standard deviations away within "
            f"{f.low[i]:.2f}-{f.high[i]:.2f}",
        )
