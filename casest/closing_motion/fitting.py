"""A moving estimator with effects, fitted to a record: noise by likelihood, numbers by scoring."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casest.closing_motion.effects import Candidate, Colour, extended
from casest.closing_motion.sensitivity import Sensitivity, sensitivity
from casest.closing_motion.tuning import Prepared, applied, matched, prepared
from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.filter import Filtered, filtered
from casest.dynamics.transition import process_along

#: Rounds of scoring of an effect's numbers, and the step in standard deviations that ends it.
ROUNDS, ENOUGH = 4, 0.1
#: Correlation times of noise that are tried, in samples.
COLOURS = (3, 9, 30, 90, 300)


@dataclass(frozen=True)
class Fit:
    """An estimator with effects at their most likely numbers, and its filter over the record.

    `ready`: the record made ready for its likelihoods; `answers`: how the innovations answer to the
    numbers of `added`; None where there are none.
    `last_step`: of the scoring, in standard deviations.
    """

    base: Dynamics
    model: Dynamics
    added: tuple[tuple[Candidate, Array], ...]
    colour: Colour | None
    intensities: Mapping[str, float]
    likelihood: float
    ready: Prepared
    found: Filtered
    answers: Sensitivity | None
    last_step: float = 0.0

    @property
    def unknowns(self) -> int:
        """Numbers that were estimated beside the states and intensities."""
        return sum(c.size for c, _ in self.added) + (2 if self.colour else 0)

    @property
    def evidence(self) -> float:
        """Log-likelihood less what as many numbers gain from noise alone (Schwarz 1978)."""
        readings = np.isfinite(self.found.innovations).sum()
        return self.likelihood - 0.5 * self.unknowns * float(np.log(readings))

    def lighter(self) -> Fit:
        """The same without the transitions and the noise along the record: to be looked at, and
        judged, but no longer filtered."""
        ready = replace(self.ready, system=replace(self.ready.system))
        system = replace(self.found.system, process=self.model.process)
        found = replace(self.found, system=system)
        return replace(self, ready=ready, found=found)

    @property
    def std(self) -> Array:
        """Standard deviation of all numbers of the effects, in order."""
        if self.answers is None:
            return np.zeros(0)
        H = self.answers.H
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(np.einsum("kij,kil->jl", H, H)))))


def fitted(
    base: Dynamics,
    run: Run,
    along: Array,
    *,
    added: Sequence[tuple[Candidate, Array]] = (),
    colour: Colour | None = None,
    start: Mapping[str, float] | None = None,
) -> Fit:
    """Numbers and intensities in turn, from given ones. `along`: states (N, n) to begin with."""
    added = tuple(added)
    last = 0.0
    for k in range(ROUNDS if added else 1):
        fit = _tuned(base, run, along, added, colour, start)
        if not added:
            return fit
        assert fit.answers is not None
        H, z = fit.answers.H, fit.answers.z
        information = np.einsum("kij,kil->jl", H, H)
        step = np.linalg.solve(information, np.einsum("kij,ki->j", H, z))
        last = float(np.max(np.abs(step) * np.sqrt(np.diag(information))))
        fit = replace(fit, last_step=last)
        if last < ENOUGH or k == ROUNDS - 1:
            return fit
        added, start, along = _moved(fit, step), fit.intensities, fit.found.smoothed
    raise AssertionError


def _moved(fit: Fit, step: Array) -> tuple[tuple[Candidate, Array], ...]:
    assert fit.answers is not None
    pairs = zip(fit.added, fit.answers.columns, strict=True)
    return tuple((c, v + step[where]) for (c, v), where in pairs)


def _tuned(
    base: Dynamics,
    run: Run,
    along: Array,
    added: tuple[tuple[Candidate, Array], ...],
    colour: Colour | None,
    start: Mapping[str, float] | None,
) -> Fit:
    grown = extended(base, added, colour)
    along = np.pad(along[:, : grown.size], ((0, 0), (0, max(0, grown.size - along.shape[1]))))
    ready = prepared(grown, run, along)
    known = {name: value for name, value in (start or {}).items() if name in ready.names}
    intensities, likelihood = matched(ready, run, known)
    model = applied(grown, intensities)
    system = None
    if model.linear:
        system = ready.system.driven(process_along(model, run, along))
    found = filtered(model, run, system=system, spread=False)
    tried = [c for c, _ in added]
    answers = sensitivity(base, added, tried, run, found) if added else None
    return Fit(base, model, added, colour, intensities, likelihood, ready, found, answers)


def coloured(fit: Fit, run: Run) -> Fit:
    """The same with correlated noise on the output that it helps most, over the best time."""
    trials = [_best_colour(fit, run, name, where) for name, where in _outputs(fit.base).items()]
    return max(trials, key=lambda f: f.likelihood)


def _best_colour(fit: Fit, run: Run, name: str, where: slice) -> Fit:
    """From the middle of the correlation times towards where the likelihood rises."""
    step = float(np.median(np.diff(fit.found.time)))
    signal = next(s for s in fit.base.signals if s.name == name)
    std = float(np.nanmedian(np.abs(fit.found.innovations[:, where]))) / 2
    done: dict[int, Fit] = {}

    def at(k: int) -> float:
        if not 0 <= k < len(COLOURS):
            return -np.inf
        if k not in done:
            colour = Colour(name, signal.size, signal.unit or "1", COLOURS[k] * step, std)
            found = fitted(fit.base, run, fit.found.smoothed, added=fit.added, colour=colour,
                           start=fit.intensities)  # fmt: skip
            done[k] = found.lighter()
        return done[k].likelihood

    best = 1 if at(1) > at(2) else 2
    way = -1 if best == 1 else 1
    while at(best + way) > at(best):
        best += way
    return done[best]


def _outputs(model: Dynamics) -> dict[str, slice]:
    """Rows of every output signal."""
    t, rows, place = model.traced, {}, 0
    for name, o in zip(t.measured, t.outputs, strict=True):
        rows[name] = slice(place, place + o.predicted.numel())
        place += o.predicted.numel()
    return rows
