"""A filter's innovations as what the loop searches: effects on signals, refitted with the noise."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Linear, Parts, parts_of, spans_of
from casest.diagnose.evidence.score import Trial
from casest.diagnose.motion import grid
from casest.diagnose.motion.fit import Fit, fitted, rise
from casest.diagnose.motion.sensitivity import gains, sensitivity
from casest.diagnose.protocol import Kept, Subject
from casest.effects.moving import Candidate
from casest.errors import DataError

#: Share of its signal that an effect has to leave.
LEFT = 0.1
#: Times that a refit goes on where its scoring has not come to an end.
AGAIN = 3


@dataclass(frozen=True)
class Innovations(Subject[Fit]):
    """A record of an estimator in motion, and what may be missing: the loop's subject.

    Whitened innovations are linear in constants that the model lacks, the states already marginal
    (Willsky & Jones 1976): that is all that the loop asks for.
    """

    run: Run
    tried: tuple[Candidate, ...]
    _parts: dict[bytes, Parts] = field(default_factory=dict, compare=False, repr=False)

    def linear(self, fit: Fit) -> Linear:
        """Whitened innovations, and their answers to the numbers that were added."""
        if "linear" not in fit.__dict__:  # asked for many times of each fit
            fit.__dict__["linear"] = self._linear(fit)
        found: Linear = fit.__dict__["linear"]
        return found

    def _linear(self, fit: Fit) -> Linear:
        rest = [c for c, _ in fit.added]
        found = fit.answers or sensitivity(fit.base, fit.added, rest, fit.run, fit.found)
        rows = _rows(fit)
        block = fit.run.block[rows]
        spans, key = spans_of(block, np.zeros_like(block)), rows.tobytes()
        if key not in self._parts:
            self._parts[key] = _parts(fit, rows)
        return Linear(found.z[rows], -found.H[rows], spans, self._parts[key])

    def linear_in(self, fit: Fit, other: Fit) -> Linear:
        """Its innovations in the standard deviations of this one's: in its own those of any fit are
        one in the mean, however large they are."""
        linear, rows = self.linear(other), _rows(other)
        if not np.array_equal(rows, _rows(fit)):
            return linear
        back, own = gains(fit.found).back[rows], gains(other.found).L[rows]
        turn = back @ own
        residual = np.einsum("nij,nj->ni", turn, linear.residual)
        return replace(linear, residual=residual, slopes=turn @ linear.slopes)

    def compared(self, less: Fit, fit: Fit) -> tuple[Linear, Linear]:
        """Both through the filter of the refit, to first order: one that allows for more noise
        follows the readings, and leaves other innovations in every row."""
        there = {c.label for c, _ in less.added}
        return self._apart(fit, {c.label for c, _ in fit.added} - there)[0], self.linear(fit)

    def _apart(self, fit: Fit, labels: Set[str]) -> tuple[Linear, Array]:
        """The innovations as if some effects were not there, to first order, and their columns."""
        assert fit.answers is not None
        linear, pairs = self.linear(fit), zip(fit.added, fit.answers.columns, strict=True)
        gone = [(v, np.arange(w.start, w.stop)) for (c, v), w in pairs if c.label in labels]
        value, where = (np.concatenate(each) for each in zip(*gone, strict=True))
        columns, others = linear.slopes[:, :, where], np.delete(linear.slopes, where, axis=2)
        return linear.without(others, -(columns @ value)), columns

    def trials(self, fit: Fit) -> list[Trial]:
        """Every effect that is not there, in what the innovations answer to it."""
        there = {c.label for c, _ in fit.added}
        rest = [c for c in self.tried if c.label not in there]
        rows = _rows(fit)
        linear = self.linear(fit)
        return self._trials(fit, [c for r in rest for c in grid.on_grid(fit, r, linear, rows)])

    def _trials(self, fit: Fit, several: Sequence[Candidate]) -> list[Trial]:
        found, rows = sensitivity(fit.base, fit.added, several, fit.run, fit.found), _rows(fit)
        H = -found.H[rows]
        return [
            Trial(c, c.label, H[:, :, where], variants=c.trials)
            for c, where in zip(several, found.columns, strict=True)
        ]

    def nearer(self, fit: Fit, trial: Trial, scale: float) -> list[Trial]:
        """Moments around its own."""
        return self._trials(fit, grid.nearer(fit, trial.what, scale))

    def refit(self, fit: Fit, added: Sequence[Trial]) -> Fit | str:
        """Numbers and intensities in turn, from the first-order step."""
        more = tuple(_begun(self.linear(fit), t) for t in added)
        numbers, along, start = (*fit.added, *more), fit.found.smoothed, fit.intensities
        for _ in range(AGAIN):
            try:
                found = fitted(
                    fit.base, self.run, along, added=numbers, colour=fit.colour, start=start,
                    bounded=fit.bounded,
                )  # fmt: skip
            except (np.linalg.LinAlgError, DataError) as error:
                return f"its refit fails: {error}"
            if not np.isfinite(found.likelihood):
                return "its refit fails"
            if found.trusted:
                return _taken_away(found) or found
            numbers, along, start = found.added, found.found.smoothed, found.intensities
        return "its refit does not come to an end"

    def rises(self, less: Fit, fits: Sequence[Fit]) -> list[float]:
        """2 log of the likelihood of each over that of the fit, on the readings of both."""
        return [2 * rise(fit, less) for fit in fits]

    def without(self, fit: Fit, what: Candidate) -> Fit | None:
        """The fit without an effect that was added."""
        kept = [(c, v) for c, v in fit.added if c.label != what.label]
        return fitted(fit.base, self.run, fit.found.smoothed, added=kept, colour=fit.colour,
                      start=fit.intensities, bounded=fit.bounded)  # fmt: skip

    def apart(self, fit: Fit, kept: Kept) -> tuple[Linear, Trial] | None:
        """The innovations as if an effect were not there, and the effect as a trial of them."""
        if fit.answers is None:
            return None
        linear, columns = self._apart(fit, {kept.what.label})
        return linear, Trial(kept.what, kept.what.label, columns)


def _taken_away(fit: Fit) -> str:
    """Which effect leaves nothing of its signal: what is taken away explains readings of zero, and
    is no error of a sensor."""
    for candidate, numbers in fit.added:
        left = candidate.left_of(numbers, fit.run.signals)
        if left < LEFT:
            return f"it would leave {left:.2g} of {candidate.on}"
    return ""


def _parts(fit: Fit, rows: NDArray[np.int_]) -> Parts:
    """Regions are those of the inputs: of what the body did."""
    measured = set(fit.base.measured_signals)
    names = [s.name for s in fit.base.signals if s.name not in measured and s.name != "t"]
    inputs = [np.nan_to_num(fit.run.signals[n]) for n in names]
    met = np.hstack(inputs) if inputs else np.zeros((len(fit.run), 1))
    block = fit.run.block[rows]
    return parts_of(block, np.zeros_like(block), met[rows])


def _rows(fit: Fit) -> NDArray[np.int_]:
    """Rows in which anything was read."""
    return np.flatnonzero(np.isfinite(fit.found.innovations).any(axis=1))


def _begun(linear: Linear, trial: Trial) -> tuple[Candidate, Array]:
    """An effect at its first-order numbers; what it was searched over is one of them now."""
    candidate, more = grid.free(trial.what)
    return candidate, np.concatenate([_step(linear, trial), more])


def _step(linear: Linear, trial: Trial) -> Array:
    """First-order numbers of an effect beside those that are there."""
    J = np.concatenate([linear.slopes, trial.columns], axis=2).reshape(linear.residual.size, -1)
    size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    found = np.linalg.lstsq(J / size, -linear.residual.ravel(), rcond=1e-10)[0] / size
    return np.asarray(found[linear.slopes.shape[2] :])
