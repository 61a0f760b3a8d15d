"""The loop in motion: filter, look at the innovations, add the best effect, judge it, again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.data.splits import interleaved_blocks
from casest.declaration.shapes import Array
from casest.diagnose.motion.fit import Fit, coloured, fitted, forgotten, rise
from casest.diagnose.motion.score_test import Score, scores, stretches
from casest.diagnose.motion.sensitivity import sensitivity
from casest.diagnose.motion.whiteness import Whiteness, whiteness
from casest.dynamics.declare import Dynamics
from casest.dynamics.filter import filtered
from casest.dynamics.likelihood import applied, first_guess, likelihood, reached
from casest.dynamics.transition import process_along
from casest.effects.moving import Candidate, Colour, candidates
from casest.errors import DataError

#: Chance, under an estimator that lacks nothing, that any candidate is called significant.
FALSE_ALARM = 0.004
#: The held-out gain must exceed this many of its own standard errors.
HELD_OUT = 1.64
#: Candidates whose log-likelihoods differ by less are not told apart.
ALIKE = 3.0
#: Candidates that are refitted in a round, rounds, blocks and folds of held-out time.
CONTENDERS, ROUNDS, BLOCKS, FOLDS = 3, 6, 40, 4
#: Whiteness below which noise with a colour is tried; gain of likelihood that asks for it too.
SUSPECT, ASKS = 0.05, 10.0
#: An input's matched intensity that is so many times what its own readings show is no noise.
LOUD = 4.0
#: Significance of what is left.
UNEXPLAINED = 1e-4
#: Samples below which nothing can be held out.
SHORTEST = 400


@dataclass(frozen=True)
class Added:
    """An effect that was added, or noise with a colour, with the evidence."""

    candidate: Candidate | Colour
    p_value: float
    gain: float
    indistinguishable_from: tuple[str, ...]


@dataclass(frozen=True)
class MotionClosing:
    """What the loop leaves: fits before and after, evidence, what was refused.

    `held_out`: innovations (N, m) of both, in the rows of the readings, each block of time
    predicted with numbers from the others.
    """

    declared: Dynamics
    run: Run
    before: Fit
    after: Fit
    effects: tuple[Added, ...]
    refused: tuple[tuple[str, str], ...]
    first: tuple[Score, ...]
    left: Whiteness
    held_out: tuple[Array, Array]
    #: Inputs whose noise had to be matched far above their own, and how many times.
    loud: Mapping[str, float]

    @property
    def coloured(self) -> bool:
        """Are the innovations not white after the loop?"""
        return self.left.p_value < UNEXPLAINED

    @property
    def misfit(self) -> bool:
        """Are they not, or white only because an input was called noisier than it is?"""
        return self.coloured or bool(self.loud)

    @property
    def verdict(self) -> str | None:
        """adequate, extended or unexplained; None without a trusted estimate."""
        if not self.after.trusted:
            return None
        if self.misfit:
            return "unexplained"
        return "extended" if self.effects else "adequate"


def close_motion(
    model: Dynamics, run: Run, *, say: Callable[[str], None] = lambda _: None
) -> MotionClosing:
    """Trace the innovations of an estimator to effects that it lacks, and add them.

    Intensities are matched to the record first: a filter that expects other noise than there is
    has innovations that are not white, for no physical reason. Raises DataError where the record
    is too short to hold any of it out.
    """
    if len(run) < SHORTEST:
        raise DataError(
            f"{run.file or run.name}: {len(run)} samples are too few to hold some of them out; "
            f"closing the loop needs {SHORTEST} at least"
        )
    return _Loop(model, run, say).closed()


class _Loop:
    """The state of one closing: the fit as it grows."""

    def __init__(self, model: Dynamics, run: Run, say: Callable[[str], None]) -> None:
        self.model, self.run, self.say = model, run, say
        self.folds = interleaved_blocks(run, BLOCKS, FOLDS)
        self.tried = candidates(model, run)
        self.limit = FALSE_ALARM / (len(self.tried) + 1)
        self.added: list[Added] = []
        self.refused: list[tuple[str, str]] = []

    def closed(self) -> MotionClosing:
        """Run the loop."""
        along = filtered(self.model, self.run).smoothed
        before = current = fitted(self.model, self.run, along)
        ranked, left = self._judged(current)
        first = ranked
        for _ in range(ROUNDS):
            better = self._with_effect(current, ranked) or self._with_colour(current, left)
            if better is None:
                break
            before = before.lighter()
            current = self._weeded(better)
            ranked, left = self._judged(current)
        one, two = (f.by_reading(held_out(f, self.folds)) for f in (before, current))
        there = {a.candidate.label for a in self.added}
        added = tuple(
            replace(a, indistinguishable_from=tuple(
                x for x in a.indistinguishable_from if x not in there))
            for a in self.added
        )  # fmt: skip
        return MotionClosing(
            self.model,
            self.run,
            before,
            current.with_spread(),
            added,
            tuple(self.refused),
            tuple(first),
            left,
            (one, two),
            self._loud(current),
        )

    def _judged(self, fit: Fit) -> tuple[list[Score], Whiteness]:
        """Scores of every candidate that is not there yet; are the innovations white?"""
        there = [c for c, _ in fit.added]
        rest = [c for c in self.tried if c not in there]
        found = sensitivity(fit.base, fit.added, rest, fit.run, fit.found)
        whole = np.isfinite(fit.found.innovations).all(axis=1)
        return scores(found, rest), whiteness(found.z[whole])

    def _with_effect(self, current: Fit, ranked: list[Score]) -> Fit | None:
        """The fit with the best effect that held-out time confirms; None if none does."""
        promising = self._promising(ranked) or self._promising(self._strictly(current))
        alike: list[tuple[Score, Fit]] = []
        for score in promising[:CONTENDERS]:
            fit = self._refitted(current, score).lighter()
            if self._likelier(fit, current, score.candidate.size):
                alike.append((score, fit))
            best = max((f.evidence(current) for _, f in alike), default=0.0)
            alike = [(s, f) for s, f in alike if best - f.evidence(current) < ALIKE]
        if not alike:
            return None
        # Of those that explain it alike, the one that is met more often.
        score, chosen = min(alike, key=lambda pair: self.tried.index(pair[0].candidate))
        gained = self._confirmed(current, chosen)
        if gained is None:
            self._refuse(score.candidate.label, "held-out time does not confirm it")
            return None
        others = tuple(s.candidate.label for s, fit in alike if fit is not chosen)
        self.added.append(Added(score.candidate, score.p_value, gained, others[:2]))
        self.say(f"{score.candidate.label}: held-out innovations become smaller")
        return chosen

    def _promising(self, ranked: list[Score]) -> list[Score]:
        """Significant ones, those left out that would gain less than half of the best."""
        significant = [s for s in ranked if s.p_value <= self.limit]
        most = max((s.gain for s in significant), default=0.0)
        return sorted((s for s in significant if s.gain > 0.5 * most), key=lambda s: -s.gain)

    def _strictly(self, current: Fit) -> list[Score]:
        """Scores with no more noise than the sensors' own: a large effect that the matched
        intensities have swallowed stands out again. Empty where these say the same."""
        if not self._noise_is_odd(current):
            return []
        model = applied(current.model, self._of_sensors(current))
        system = None
        if not model.linear:
            process = process_along(model, current.run, current.found.smoothed)
            system = current.ready.system.driven(process)
        found = filtered(model, current.run, system=system, spread=False)
        rest = [c for c in self.tried if all(c is not a for a, _ in current.added)]
        return scores(sensitivity(current.base, current.added, rest, current.run, found), rest)

    def _refitted(self, current: Fit, score: Score) -> Fit:
        return fitted(current.base, self.run, current.found.smoothed,
                      added=(*current.added, (score.candidate, score.step)),
                      colour=current.colour, start=current.intensities)  # fmt: skip

    def _likelier(self, fit: Fit, current: Fit, size: int) -> bool:
        """Is the rise of likelihood more than so many more numbers gain from noise?"""
        from scipy.special import chdtrc

        risen = 2 * rise(fit, current)
        return bool(np.isfinite(risen) and risen > 0 and chdtrc(size, risen) <= self.limit)

    def _with_colour(self, current: Fit, white: Whiteness) -> Fit | None:
        """The fit with correlated noise on an output, if the innovations ask for it."""
        if current.colour or not (white.p_value < SUSPECT or self._noise_is_odd(current)):
            return None
        from scipy.special import chdtrc

        trial = coloured(current, self.run)
        risen = max(rise(trial, current), 0.0)
        p_value = min(1.0, 4 * float(chdtrc(2, 2 * risen)))
        if p_value > self.limit or trial.colour is None:
            return None
        gained = self._confirmed(current, trial)
        if gained is None:
            self._refuse(trial.colour.label, "held-out time does not confirm it")
            return None
        self.added.append(Added(trial.colour, p_value, gained, ()))
        self.say(f"{trial.colour.label}: the noise is correlated")
        return trial

    def _noise_is_odd(self, fit: Fit) -> bool:
        """Are the intensities far from what the signals themselves show from sample to sample?"""
        return fit.likelihood - likelihood(fit.ready, self._of_sensors(fit)) > ASKS

    def _loud(self, fit: Fit) -> dict[str, float]:
        """Inputs whose matched intensity is many times what was stated or their readings show, and
        how many, where the likelihood insists on it."""
        guess, inputs = first_guess(fit.ready, self.run), reached(self.model)[0]
        times = {n: fit.intensities[n] / guess[n] for n in inputs if n in fit.intensities}
        found = {}
        for name, ratio in times.items():
            own = {**fit.intensities, name: guess[name]}
            if ratio > LOUD and fit.likelihood - likelihood(fit.ready, own) > ASKS:
                found[name] = ratio
        return found

    def _of_sensors(self, fit: Fit) -> dict[str, float]:
        """Intensities of inputs and states no larger than the signals' noise from sample to sample
        says; those of readings as they are."""
        guess = first_guess(fit.ready, self.run)
        kept = {*fit.ready.readings, *({fit.colour.state} if fit.colour else ())}
        return {
            name: value if name in kept else min(guess[name], value)
            for name, value in fit.intensities.items()
        }

    def _confirmed(self, current: Fit, better: Fit) -> float | None:
        """Held-out gain of log-likelihood per reading, if it exceeds its own error."""
        before, after = (_densities(f, held_out(f, self.folds)) for f in (current, better))
        if current.shifts != better.shifts:  # the first readings are of one of them alone
            lost = ~(forgotten(current) & forgotten(better))
            before[lost] = after[lost] = np.nan
        part = stretches(len(before), BLOCKS)
        gains = np.bincount(part, np.nan_to_num(after - before))
        error = float(np.sqrt(len(gains)) * np.std(gains, ddof=1))
        total = float(gains.sum())
        count = int(np.isfinite(current.found.innovations).sum())
        return total / count if total > HELD_OUT * error else None

    def _weeded(self, fit: Fit) -> Fit:
        """Without effects that are nothing any more beside what came later."""
        from scipy.special import chdtrc

        if fit.answers is None or len(self.added) < 2:
            return fit
        H = fit.answers.H
        covariance = np.linalg.inv(np.einsum("kij,kil->jl", H, H))
        kept = []
        for (candidate, value), where in zip(fit.added, fit.answers.columns, strict=True):
            squared = float(value @ np.linalg.solve(covariance[where, where], value))
            if chdtrc(candidate.size, squared) <= self.limit:
                kept.append((candidate, value))
        if len(kept) == len(fit.added):
            return fit
        gone = [c for c, _ in fit.added if all(c is not k for k, _ in kept)]
        self.added = [a for a in self.added if a.candidate not in gone]
        for candidate in gone:
            self._refuse(candidate.label, "no longer needed beside what came later")
        return fitted(fit.base, self.run, fit.found.smoothed, added=kept, colour=fit.colour,
                      start=fit.intensities)  # fmt: skip

    def _refuse(self, label: str, why: str) -> None:
        if (label, why) not in self.refused:
            self.refused.append((label, why))


def held_out(fit: Fit, folds: NDArray[np.int_]) -> Array:
    """Innovations (N, m), each block with numbers of the effects from the other folds.

    To first order in how far those numbers differ; the intensities are those of the whole record.
    """
    nu = fit.found.innovations
    if fit.answers is None:
        return nu
    H, z, L = fit.answers.H, fit.answers.z, fit.answers.L
    found = np.empty_like(nu)
    for fold in np.unique(folds):
        hidden = folds == fold
        seen_H, seen_z = H[~hidden], z[~hidden]
        information = np.einsum("kij,kil->jl", seen_H, seen_H)
        shift = np.linalg.solve(information, np.einsum("kij,ki->j", seen_H, seen_z))
        moved = np.einsum("kij,kjl,l->ki", L[hidden], H[hidden], shift)
        found[hidden] = nu[hidden] - moved
    return found


def _densities(fit: Fit, innovations: Array) -> Array:
    """Log-density of every complete reading (N,); NaN where something is missing."""
    whole = np.isfinite(innovations).all(axis=1)
    S, nu = fit.found.S[whole], innovations[whole]
    squares = np.sum(nu * np.linalg.solve(S, nu[:, :, None])[:, :, 0], axis=1)
    found = np.full((len(innovations), innovations.shape[1]), np.nan)
    found[whole] = -0.5 * (squares + np.linalg.slogdet(S)[1])[:, None] / innovations.shape[1]
    return np.asarray(fit.by_reading(found).sum(axis=1))
