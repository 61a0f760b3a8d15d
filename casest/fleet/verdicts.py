"""Verdicts on many sensors: codes and figures in arrays, put into words when somebody asks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import overload

import numpy as np
from numpy.typing import NDArray

from casest.declaration.shapes import Array
from casest.estimate import reasons as words
from casest.estimate.reasons import ALONE, Code
from casest.fleet.fit import Flags


@dataclass
class _Figures:
    """Codes with the figures that their words quote; the sensor axis is the last, W or S long.

    `where` first sample that is not finite; `equations` how many there are; `bound` unknown on its
    bound, with its bounds `lower` and `upper`; `step` last step in standard deviations; `low` and
    `high` rise of the cost over that of a parabola; `second` second order of the noise over the
    noise; `smallest` singular value and its direction `weakest` (n, W).
    """

    code: NDArray[np.int_]
    where: NDArray[np.int_]
    equations: NDArray[np.int_]
    bound: NDArray[np.int_]
    lower: Array
    upper: Array
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
        equations=none.copy(),
        bound=none.copy(),
        lower=nan.copy(),
        upper=nan.copy(),
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
    """Figures of a block with what its sensors are given: std (n, W), covariance, rmse (W,).

    `misfit` (W,) where it was asked for: how probable as large a largest residual is.
    """

    std: Array
    covariance: Array
    rmse: Array
    misfit: Array | None = None

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
    replaced: dict[int, tuple[Code, tuple[str, ...]]] = field(default_factory=dict)

    @classmethod
    def empty(cls, names: tuple[str, ...], size: int) -> Verdicts:
        """Room for S sensors."""
        return cls(names, _blank(len(names), size))

    def put(self, span: slice, judged: Judged) -> None:
        """Take over the figures of a block."""
        for f in fields(_Figures):
            own = getattr(judged, f.name)
            getattr(self.figures, f.name)[..., span] = own[..., : span.stop - span.start]

    def replace(self, i: int, code: Code, reasons: tuple[str, ...]) -> None:
        """Say of sensor i what was found out about it alone."""
        self.replaced[i] = (code, reasons)

    def ask(self, i: int, code: Code, sigma: float) -> None:
        """Hold against sensor i, trusted alone, what only many are asked: LOUD and CORRELATED."""
        said = {Code.LOUD: words.loud(sigma), Code.CORRELATED: words.CORRELATED}
        if code:
            self.replaced[i] = (code, tuple(said[c] for c in code))

    def code(self, i: int) -> Code:
        """What speaks against sensor i."""
        return self.replaced[i][0] if i in self.replaced else Code(int(self.figures.code[i]))

    @property
    def trusted(self) -> Flags:
        """Is the sensor's estimate believed, (S,)?"""
        found = np.asarray(self.figures.code == 0)
        for i, (code, _) in self.replaced.items():
            found[i] = not code
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
        code = self.code(i)
        # A fit to readings that are no numbers, or that has no fit, has nothing else to say.
        for only in ALONE:
            if only in code:
                return (self._against(only, i),)
        return tuple(self._against(c, i) for c in Code if c in code) or self._for(i)

    def _against(self, code: Code, i: int) -> str:
        f, n = self.figures, len(self.names)
        said: dict[Code, Callable[[], str]] = {
            Code.READING: lambda: words.reading(f.where[i]),
            Code.NOT_FINITE: lambda: words.not_finite("give start="),
            Code.NO_REDUNDANCY: lambda: words.no_redundancy(f.equations[i], n, "record more"),
            Code.NOT_DETERMINED: lambda: words.not_determined(
                f"{self._weakest(i)}; vary the motion"
            ),
            Code.BOUND: lambda: words.bound(self.names[f.bound[i]], f.lower[i], f.upper[i]),
            Code.NOT_SETTLED: lambda: words.not_settled(f.step[i], f.smallest[i], self._weakest(i)),
            Code.NO_MINIMUM: words.no_minimum,
            Code.MISSHAPEN: lambda: words.misshapen(f.low[i], f.high[i]),
            Code.AMBIGUOUS: lambda: words.ambiguous_along(self._weakest(i)),
            Code.NOISE: lambda: words.noise(f.second[i]),
            Code.LOUD: lambda: words.loud(f.sigma[i]),
            Code.CORRELATED: lambda: words.CORRELATED,
        }
        return said[code]()

    def _weakest(self, i: int) -> str:
        direction = self.figures.weakest[:, i]
        order = np.argsort(-np.abs(direction))
        movers = [f"`{self.names[k]}`" for k in order[:4] if abs(direction[k]) > 0.1]
        return " and ".join(movers) or "some unknowns"

    def _for(self, i: int) -> tuple[str, ...]:
        f = self.figures
        return (
            words.stationary(f.step[i], at_most=True),
            words.minimum(),
            words.intervals(f.low[i], f.high[i]),
        )
