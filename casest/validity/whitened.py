"""A new record under old parameters, in units in which its noise is white and of one size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.estimate.correlation import is_series
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.sums import some_residuals
from casest.validity.colour import Colour, rate_of

#: Samples of a record from which on it says itself how the noise of its axes differs.
ENOUGH = 100
#: Gauss-Newton steps, and halvings of each.
STEPS, HALVINGS = 30, 20


class Factor(NamedTuple):
    """J = QR of the whitened rows, b = Qᵀr (n,), and the norm of the rest of r."""

    R: Array
    b: Array
    rest: float

    @property
    def squares(self) -> float:
        """‖r‖²."""
        return float(self.b @ self.b) + self.rest**2


@dataclass(frozen=True)
class Whitened:
    """A problem whose rows are divided by what is known of the noise's shape.

    `colour` of its spectrum (None: white), and `axes` (m,), relative standard deviations.
    """

    problem: Problem
    colour: Colour | None
    axes: Array

    def factor(self, point: Point) -> Factor:
        """Of all rows at a point."""
        if self.colour is None and np.all(self.axes == 1):
            return Factor(*self.problem.factor(point))
        n, whole = self.problem.unknowns, np.zeros((0, self.problem.unknowns + 1))
        for x, rows in self._rows(point):
            piece = np.zeros((len(rows), n + 1))
            piece[:, [*x, n]] = rows
            whole = np.asarray(np.linalg.qr(np.vstack([whole, piece]), mode="r"))
        full = np.zeros((n + 1, n + 1))
        full[: len(whole)] = whole[: n + 1]
        return Factor(full[:n, :n], full[:n, n], float(abs(full[n, n])))

    def _rows(self, point: Point) -> Iterator[tuple[Any, Array]]:
        """Unknowns and whitened rows [J r] (N·m, k + 1) of each stretch."""
        for block in self.problem.blocks(point):
            root = 1.0 if block.weights is None else np.sqrt(block.weights)[:, :, None]
            rows = np.concatenate([block.jacobian, block.residual[:, :, None]], axis=2) * root
            run = self.problem.runs[block.run]
            for own in _stretches(run, block.span):
                yield block.x, self._white(rows[own], run).reshape(-1, rows.shape[2])

    def _white(self, rows: Array, run: Run) -> Array:
        """Rows (N, m, k) over their noise: in the cosine transform where that has a colour."""
        from scipy.fft import dct

        if self.colour is not None and is_series(run):
            power = self.colour.at(len(rows), rate_of(run))
            rows = dct(rows, axis=0, norm="ortho") / np.sqrt(power)[:, :, None]
        return np.asarray(rows / self.axes[:, None])

    def power_known(self, point: Point) -> Array:
        """Variance (n,) of the logarithm of the noise's power where each unknown is told."""
        n, colour = self.problem.unknowns, self.colour
        if colour is None:
            return np.zeros(n)
        logs, weights = [np.zeros(0)], [np.zeros((0, n))]
        for block in self.problem.blocks(point):
            run = self.problem.runs[block.run]
            if not is_series(run):
                continue
            for own in _stretches(run, block.span):
                rows = self._white(block.jacobian[own], run)
                wide = np.zeros((len(own), n))
                wide[:, block.x] = np.sum(rows**2, axis=1)
                logs.append(colour.asked(len(own), rate_of(run)))
                weights.append(wide)
        return colour.certainty.variances(np.concatenate(logs), np.concatenate(weights))

    def neighbours(self, point: Point) -> tuple[float, int]:
        """Correlation of neighbouring whitened residuals of series, and of how many."""
        from scipy.fft import dct, idct

        products, squares, count = 0.0, 0.0, 0
        for run, residual in zip(self.problem.runs, self.problem.residuals(point), strict=True):
            if not is_series(run):
                continue
            for own in _stretches(run, slice(0, len(run))):
                r = residual[own]
                if self.colour is not None:
                    power = self.colour.at(len(r), rate_of(run))
                    r = idct(dct(r, axis=0, norm="ortho") / np.sqrt(power), axis=0, norm="ortho")
                r = r / self.axes
                products += float(np.sum(r[1:] * r[:-1]))
                squares += float(np.sum(r**2))
                count += r.size
        return (products / squares if squares > 0 else 0.0), count

    def fitted(self, point: Point, free: Array) -> tuple[Point, Factor]:
        """The least-squares point reached along the `free` directions (n, k), and the rows there.

        Gauss-Newton; a step is halved until it gains.
        """
        here = self.factor(point)
        for _ in range(STEPS if free.shape[1] else 0):
            step = -free @ _solved(here.R @ free, here.b)
            for _ in range(HALVINGS):
                moved = self.problem.moved(point, step)
                moved = replace(moved, x=self.problem.inside(moved.x))
                there = self.factor(moved)
                if there.squares <= here.squares:
                    break
                step = step / 2
            else:
                break
            gain = here.squares - there.squares
            point, here = moved, there
            if gain <= 1e-10 * here.squares:
                break
        return point, here

    def with_own_axes(self, point: Point) -> Whitened:
        """The same with the sizes that the axes' residuals have there, if there are enough."""
        residuals = some_residuals(self.problem, point)
        m = residuals[0].shape[1]
        if m == 1 or sum(map(len, residuals)) < ENOUGH:
            return self
        size = np.sqrt(np.mean(np.concatenate(residuals) ** 2, axis=0))
        if not (size > 0).all():
            return self
        return replace(self, axes=size / np.sqrt(np.mean(size**2)))


def _stretches(run: Run, span: slice) -> list[Array]:
    """Rows of a piece of a run that follow each other without a gap."""
    where = np.zeros(span.stop - span.start) if run.spread else run.block[span]
    return np.split(np.arange(len(where)), np.flatnonzero(np.diff(where)) + 1)


def _solved(A: Array, b: Array) -> Array:
    """Least squares with unit columns; directions that nothing determines stay where they are."""
    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)
    return np.asarray(np.linalg.lstsq(A / size, b, rcond=1e-10)[0] / size)
