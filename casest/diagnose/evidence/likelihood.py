"""How likely a residual is beside some columns, its noise estimated together with them.

The cosine transform of coloured noise is nearly independent from frequency to frequency, with the
spectrum as its variance, and −2 log L = Σ log S + R²/S (P. Whittle, 1953). The spectrum is a smooth
curve, fitted to what these very columns leave, with the power given back that the fit takes from
each frequency: estimated from a residual that still holds the cause, it would count the cause as
noise; without the leverage, smooth columns would win in noise of any colour. Poses and tables have
white noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Index, Linear, robust_sd
from casest.diagnose.evidence.sums import Narrow
from casest.diagnose.levels import LEVELS

#: Rounds in which coefficients and spectrum follow each other: more change nothing.
REWEIGHTED = 2
#: Share of the power at a frequency that a fit leaves, at least.
LEFT = 0.05
#: Share of its square that a difference of sums over a band loses to rounding.
LOST = 1e-12


@dataclass(frozen=True)
class Explained:
    """−2 log L beside some columns; the noise's `powers` (K,) in each narrow band and axis.

    `values`: of the orthonormal declared unknowns, then of the columns (p + k,).
    """

    cost: float
    powers: Array
    values: Array
    likelihood: Likelihood = field(repr=False)
    beyond: Beyond | None = field(default=None, repr=False)

    @cached_property
    def spectrum(self) -> Array:
        """(N·m,), by frequency."""
        return self.likelihood.sums.at_rows(self.powers)

    @cached_property
    def left(self) -> Array:
        """Of the residual (N·m,), by frequency."""
        return self.likelihood.residual - self._taken

    @cached_property
    def course(self) -> Array:
        """What unknowns and columns explain, (N, m) in time."""
        return self.likelihood.in_time(self._taken[:, None])[:, :, 0]

    @property
    def _taken(self) -> Array:
        p = self.likelihood.declared.shape[1]
        taken = self.likelihood.declared @ self.values[:p]
        return taken if self.beyond is None else taken + self.beyond.basis @ self.values[p:]


class Beyond:
    """What columns (N, m, q) do that the unknowns cannot: `mix` (q, k) is of the columns, each of
    length one, and what remains of them is orthonormal."""

    def __init__(self, likelihood: Likelihood, columns: Array) -> None:
        self.flat = likelihood.flat(columns)
        self._likelihood = likelihood
        self.on = likelihood.declared.T @ self.flat
        self.mix = likelihood.orthonormal(self.flat.T @ self.flat - self.on.T @ self.on)

    @property
    def freedom(self) -> int:
        """How many of them are told apart from the unknowns, and from each other."""
        return int(self.mix.shape[1])

    @property
    def share(self) -> float:
        """Of the residual's squares, that they take away."""
        own = self._likelihood
        r = own.residual
        along = self.flat.T @ r - self.on.T @ (own.declared.T @ r)
        return float(np.sum((self.mix.T @ along) ** 2)) / max(float(r @ r), 1e-300)

    @cached_property
    def basis(self) -> Array:
        """Orthonormal columns (N·m, k) by frequency."""
        return self._likelihood.remains(self.flat) @ self.mix

    @cached_property
    def among(self) -> tuple[Array, Array]:
        """Sums over narrow bands of products of the unknowns (K, p, q), and of the columns
        (K, q, q), with the columns."""
        own = self._likelihood
        p, both = own.declared.shape[1], np.concatenate([own.declared, self.flat], axis=1)
        found = own.sums.of(both, self.flat)
        return found[:, :p], found[:, p:]

    @cached_property
    def frame(self) -> Array:
        """The unknowns and the orthonormal columns (p + q, p + k) as combinations of the unknowns
        and the columns."""
        p, q = self.on.shape
        return np.block([[np.eye(p), -self.on @ self.mix], [np.zeros((q, p)), self.mix]])


class Likelihood:
    """A linear problem by frequency; `cut` (N, m) is taken from its residual: what is far out.

    Of two fits the same must be cut: what one explains and the other does not is far out of the
    other alone.
    """

    def __init__(self, linear: Linear, cut: Array | None = None) -> None:
        self.linear = linear
        self.shape = linear.residual.shape
        self.cut = far_out(linear.residual) if cut is None and linear.series else cut

    def cutting(self, cut: Array) -> Likelihood:
        """The same problem where something else is cut."""
        other = Likelihood(self.linear, cut)
        for name in ("sums", "declared", "_declared_sums"):
            other.__dict__[name] = getattr(self, name)
        return other

    @cached_property
    def sums(self) -> Narrow:
        """Over narrow bands of frequencies; where noise is white all rows are one band."""
        frequency = np.ones(self.shape[0])
        for span in self.linear.spans:
            n = span.stop - span.start
            frequency[span] = (np.arange(n) + 0.5) / (2 * n)
        if self.linear.coloured:
            means = self._means
            frequency[means] = (np.arange(len(means)) + 0.5) / (2 * self.shape[0])
        return Narrow(frequency, self.shape[1], flat=not self.linear.coloured)

    @cached_property
    def _declared_sums(self) -> Array:
        """Of products of the unknowns with each other (K, p, p)."""
        return self.sums.of(self.declared, self.declared)

    @cached_property
    def _residual_sums(self) -> tuple[Array, Array]:
        """Of products of the unknowns (K, p), and of the residual (K,), with the residual."""
        return self.sums.along(self.declared, self.residual), self.sums.summed(self.residual**2)

    @cached_property
    def _means(self) -> Index:
        """Where the means of stretches are, if these are many: what is slow goes on from pose to
        pose, and their means are a series as well."""
        spans = self.linear.spans
        return np.array([s.start for s in spans if len(spans) >= LEVELS.stretches], int)

    @cached_property
    def declared(self) -> Array:
        """Orthonormal columns (N·m, p) of the unknowns."""
        return self.by_frequency(self.linear.basis.reshape(*self.shape, -1))

    @cached_property
    def residual(self) -> Array:
        """(N·m,), without what is cut."""
        r = self.linear.residual
        return self.by_frequency((r if self.cut is None else r - self.cut)[:, :, None])[:, 0]

    def by_frequency(self, columns: Array) -> Array:
        """(N, m, k) as (N·m, k): each stretch by its cosines, and the means of many by theirs."""
        from scipy.fft import dct

        if self.linear.coloured:
            flat = columns.reshape(len(columns), -1)
            told = flat.any(axis=0)  # what acts on one axis is nothing on the others
            flat, found = flat[:, told], np.zeros(columns.shape)
            for span in self.linear.spans:
                flat[span] = dct(flat[span], axis=0, norm="ortho")
            if len(self._means):
                flat[self._means] = dct(flat[self._means], axis=0, norm="ortho")
            found.reshape(flat.shape[0], -1)[:, told] = flat
            columns = found
        return columns.reshape(columns.shape[0] * columns.shape[1], -1)

    def flat(self, columns: Array) -> Array:
        """Columns (N, m, q), each of length one, by frequency (N·m, q)."""
        flat = columns.reshape(self.residual.size, -1)
        size = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
        return self.by_frequency((flat / size).reshape(columns.shape))

    def in_time(self, columns: Array) -> Array:
        """(N·m, k) as (N, m, k) again."""
        from scipy.fft import idct

        columns = columns.reshape(*self.shape, -1)
        if not self.linear.coloured:
            return columns
        columns, found = columns.copy(), np.empty(columns.shape)
        if len(self._means):
            columns[self._means] = idct(columns[self._means], axis=0, norm="ortho")
        for span in self.linear.spans:
            found[span] = idct(columns[span], axis=0, norm="ortho")
        return found

    def spectrum(self, left: Array, free: Array) -> Array:
        """Of every axis (N·m,), from what is left and the share that the fit leaves free."""
        power, free = self.sums.summed(left**2), self.sums.summed(np.clip(free, LEFT, 1))
        return self.sums.at_rows(self.sums.spectrum(power, free))

    def remains(self, flat: Array) -> Array:
        """Columns (N·m, q) by frequency without what the unknowns can do."""
        Q = self.declared
        left = flat - Q @ (Q.T @ flat)
        left -= Q @ (Q.T @ left)
        return np.asarray(left)

    def orthonormal(self, products: Array) -> Array:
        """(q, k): combinations that are orthonormal of what remains of columns, of products (q, q)
        with each other, where enough does."""
        values, vectors = np.linalg.eigh(products)
        kept = values > max(self.linear.least**2, 1e-8 * values.max(initial=0.0))
        return np.asarray(vectors[:, kept] / np.sqrt(values[kept]))

    def beside(
        self,
        beyond: Beyond | None = None,
        start: Explained | None = None,
        rounds: int = REWEIGHTED,
    ) -> Explained:
        """The residual beside the unknowns and columns."""
        if not self.linear.coloured:
            return self._in_white_noise(beyond)
        S = np.ones(len(self.sums.count)) if start is None else start.powers
        products = _Products(self, beyond)
        for _ in range(rounds + (start is None)):
            values, power, taken = products.solved(1 / S)
            free = np.clip(1 - taken / self.sums.count, LEFT, 1) * self.sums.count
            S = self.sums.spectrum(power, free)
        cost = float(np.sum(self.sums.count * np.log(S) + power / S))
        return Explained(cost, S, values, self, beyond)

    def cost_of(self, power: Array) -> float:
        """−2 log L of coloured noise that leaves so much power in each narrow band (K,)."""
        count = self.sums.count
        S = self.sums.spectrum(power, count)
        return float(np.sum(count * np.log(S) + power / S))

    def plainly(self, beyond: Beyond) -> Explained:
        """By least squares alone, as if all noise were white."""
        values, power, _ = _Products(self, beyond).solved(np.ones(len(self.sums.count)))
        white = float(power.sum()) / float(self.sums.count.sum())
        return Explained(np.nan, np.full(len(power), max(white, 1e-300)), values, self, beyond)

    def _in_white_noise(self, beyond: Beyond | None) -> Explained:
        R, X = self.residual, self.declared
        if beyond is not None:
            X = np.concatenate([X, beyond.basis], axis=1)
        values = np.asarray(X.T @ R if beyond is None else np.linalg.lstsq(X, R, rcond=None)[0])
        left = R - X @ values
        power = max(float(left @ left) / len(R), 1e-300)
        powers = np.full(self.shape[1], power)
        return Explained(len(R) * float(np.log(power)), powers, values, self, beyond)

    def partly(self, beyond: Beyond, noise: Explained) -> tuple[Array, Array, Array, float]:
        """Whitened by a noise, beside the unknowns: products of the columns with each other (q, q),
        before and after, and with the residual (q,); the residual's square."""
        w, (QG, GG), (QR, RR) = 1 / noise.powers, beyond.among, self._residual_sums
        A, B, G = (_weighted(w, products) for products in (self._declared_sums, QG, GG))
        a, b, square = w @ QR, w @ self._with_residual(beyond), float(w @ RR)
        on = np.linalg.solve(A, np.column_stack([B, a]))
        C, c = on[:, :-1], on[:, -1]
        return G, G - B.T @ C, b - B.T @ c, square - float(a @ c)

    def _with_residual(self, beyond: Beyond) -> Array:
        """Sums of products of columns with the residual (K, q)."""
        return self.sums.along(beyond.flat, self.residual)


def far_out(residual: Array) -> Array:
    """(N, m): what residuals have beyond some robust standard deviations from their middle.

    Beside a course that coloured noise leaves free to be anywhere on average, they have one.
    """
    far, middle = LEVELS.clip * robust_sd(residual), np.median(residual, axis=0)
    return np.asarray(residual - np.clip(residual, middle - far, middle + far))


def _weighted(w: Array, products: Array) -> Array:
    """Their sum over bands (a, b), each with a weight (K,)."""
    return np.asarray(np.tensordot(w, products, 1))


class _Products:
    """Of unknowns, columns and residual with each other, over narrow bands."""

    def __init__(self, likelihood: Likelihood, beyond: Beyond | None) -> None:
        self._QQ = likelihood._declared_sums
        self._QR, self._RR = likelihood._residual_sums
        self._p = self._QQ.shape[1]
        self._frame = np.eye(self._p)
        self._more: tuple[Array, Array, Array] | None = None
        if beyond is not None:
            self._frame = beyond.frame
            self._more = (*beyond.among, likelihood._with_residual(beyond))

    def solved(self, w: Array) -> tuple[Array, Array, Array]:
        """Least squares with a weight of each band: the values (p + k,); of each band the power
        that is left, and how many of its rows the fit takes."""
        A, b = _weighted(w, self._QQ), w @ self._QR
        if self._more is not None:
            QG, GG, GR = self._more
            C = _weighted(w, QG)
            A = np.block([[A, C], [C.T, _weighted(w, GG)]])
            b = np.concatenate([b, w @ GR])
        F = self._frame
        A, b = F.T @ A @ F, F.T @ b
        size = np.sqrt(np.maximum(np.diag(A), 1e-300))
        inverse = np.linalg.inv(A / np.outer(size, size) + 1e-12 * np.eye(len(A)))
        inverse /= np.outer(size, size)
        values = inverse @ b
        v = F @ values
        power = self._RR + self._summed(np.outer(v, v)) - 2 * self._QR @ v[: self._p]
        if self._more is not None:
            power -= 2 * self._more[2] @ v[self._p :]
        # Where a fit takes all, differences of sums are their rounding.
        return values, np.maximum(power, LOST * self._RR), w * self._summed(F @ inverse @ F.T)

    def _summed(self, among: Array) -> Array:
        """Of each band (K,), products times a symmetric matrix (p + q, p + q), all together."""
        p = self._p
        found = np.tensordot(self._QQ, among[:p, :p], 2)
        if self._more is not None:
            QG, GG, _ = self._more
            found += 2 * np.tensordot(QG, among[:p, p:], 2) + np.tensordot(GG, among[p:, p:], 2)
        return np.asarray(found)
