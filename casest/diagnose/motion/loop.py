"""The loop in motion: filter, look at innovations, add what is missing, judge on held-out time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.data.splits import interleaved_blocks
from casest.declaration.shapes import Array
from casest.diagnose.levels import LEVELS
from casest.diagnose.motion.candidates import candidates, prepared
from casest.diagnose.motion.fit import (
    Fit,
    coloured,
    fitted,
    forgotten,
    plausible,
    rise,
    unbounded,
)
from casest.diagnose.motion.innovations import Innovations
from casest.diagnose.motion.sensitivity import sensitivity
from casest.diagnose.motion.visibility import Visible, visible
from casest.diagnose.motion.whiteness import Whiteness, whiteness
from casest.diagnose.protocol import Kept, State, search, with_rivals
from casest.dynamics.declare import Dynamics
from casest.dynamics.filter import filtered
from casest.dynamics.likelihood import first_guess, likelihood
from casest.effects.moving import Candidate, Colour
from casest.errors import DataError

#: Innovations that are so many times those of a filter that follows the readings: it is lost.
LOST = 10.0


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
    tried: tuple[Candidate, ...]
    first: tuple[Visible, ...]
    left: Whiteness
    held_out: tuple[Array, Array]
    #: Causes of which one is there, and none was confirmed on held-out time.
    undecided: tuple[str, ...]
    #: Whose noise would have to be far above what is plausible, and how many times.
    loud: Mapping[str, float]

    @property
    def coloured(self) -> bool:
        """Are the innovations not white after the loop?"""
        return self.left.p_value < LEVELS.coloured

    @property
    def misfit(self) -> bool:
        """Are they not, or white only by noise that is not plausible, or is a cause open?"""
        return self.coloured or bool(self.loud) or bool(self.undecided)

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
    if len(run) < LEVELS.shortest:
        raise DataError(
            f"{run.file or run.name}: {len(run)} samples are too few to hold some of them out; "
            f"closing the loop needs {LEVELS.shortest} at least"
        )
    folds = interleaved_blocks(run, LEVELS.pieces, LEVELS.refits)
    run = prepared(model, run)
    before = fitted(model, run, filtered(model, run).smoothed)
    subject = Innovations(run, tuple(candidates(model, run)))
    with np.errstate(all="ignore"):
        state = _begun(subject, before, say)
        state, undecided = _searched(subject, state, folds, say)
        current, colour = _coloured(state.fit, run, folds, say)
        if colour is not None:
            state = search(subject, current, say, state)
            state, undecided = _searched(subject, state, folds, say)
        state = with_rivals(subject, state)
    plain = [c for c in subject.tried if not c.held]
    found = sensitivity(model, [], plain, before.run, before.found)
    added = tuple(_added(k, state) for k in state.kept)
    one, two = (f.by_reading(held_out(f, folds)) for f in (before, state.fit))
    return MotionClosing(
        model,
        run,
        before,
        state.fit.with_spread(),
        (*added, *([colour] if colour is not None else [])),
        _refused(state),
        subject.tried,
        visible(found, plain),
        _left(state.fit),
        (one, two),
        undecided,
        _loud(state.fit),
    )


def _searched(
    subject: Innovations,
    state: State[Fit],
    folds: NDArray[np.int_],
    say: Callable[[str], None],
) -> tuple[State[Fit], tuple[str, ...]]:
    """With causes that shrink the innovations nowhere but where they begin, as a step does that a
    state soon follows: what they are worth is that the noise need not allow for them any more.

    Confirmed by the density of held-out time; else by name, if a refit keeps what they promise.
    """
    for _ in range(LEVELS.rounds):
        strong = [e for e in state.open if e.p_value < LEVELS.coloured and len(e.trials) == 1]
        names = []
        for evidence in strong[: LEVELS.nearest]:
            what, better = evidence.trials[0].what, subject.refit(state.fit, evidence.trials)
            if isinstance(better, str):
                continue
            gain = 2 * rise(better, state.fit)
            score = evidence.score - evidence.gain + gain
            if score < LEVELS.strong:
                continue
            if _confirmed(state.fit, better, folds) is not None:
                say(f"{what.label}: held-out time is more likely")
                kept = Kept(what, replace(evidence, gain=gain, score=score), {})
                state = replace(state, fit=better, kept=(*state.kept, kept))
                state = search(subject, better, say, state)
                break
            names.append(_where(what))
        else:
            return state, tuple(dict.fromkeys(names))
    return state, ()


def _where(candidate: Candidate) -> str:
    """`bias_step of a (when = 17.3)`."""
    held = ", ".join(f"{name} = {value:.4g}" for name, value in candidate.held)
    return candidate.label + (f" ({held})" if held else "")


def _begun(subject: Innovations, before: Fit, say: Callable[[str], None]) -> State[Fit]:
    """The search from the declared model. Where that is lost by what it lacks, its noise may first
    be as large as it takes to follow the readings: far from them no straight line leads back."""
    run = before.run
    if _loud(before):
        free = fitted(before.base, run, filtered(before.base, run).smoothed, bounded=False)
        if _rms(before) > LOST * _rms(free):
            state = search(subject, free, say)
            fit = state.fit
            fit = fitted(fit.base, subject.run, fit.found.smoothed, added=fit.added)
            return search(subject, fit, say, state)
    return search(subject, before, say)


def _rms(fit: Fit) -> float:
    return float(np.sqrt(np.nanmean(fit.found.innovations[forgotten(fit)] ** 2)))


def _added(kept: Kept, state: State[Fit]) -> Added:
    there = {k.what.label for k in state.kept}
    alike = [r.what.label for r in kept.rivals if r.what.label not in there]
    count = int(np.isfinite(state.fit.found.innovations).sum())
    gained = 0.5 * kept.evidence.gain / count
    return Added(kept.what, kept.evidence.p_value, gained, tuple(alike[: LEVELS.nearest]))


def _refused(state: State[Fit]) -> tuple[tuple[str, str], ...]:
    """What was not added, each once, with the first reason."""
    added = {k.what.label for k in state.kept}
    said = {r.what.label: r.why for r in reversed(state.refused) if r.what.label not in added}
    return tuple(said.items())


def _left(fit: Fit) -> Whiteness:
    """Are the innovations white?"""
    found = sensitivity(fit.base, fit.added, [], fit.run, fit.found)
    return whiteness(found.z[np.isfinite(fit.found.innovations).all(axis=1)])


def _coloured(
    fit: Fit, run: Run, folds: NDArray[np.int_], say: Callable[[str], None]
) -> tuple[Fit, Added | None]:
    """The fit with correlated noise on an output, if the innovations ask for it."""
    if not (_left(fit).p_value < LEVELS.suspect or _noise_is_odd(fit, run)):
        return fit, None
    from scipy.special import chdtrc

    trial = coloured(fit, run)
    risen = max(rise(trial, fit), 0.0)
    p_value = min(1.0, 4 * float(chdtrc(2, 2 * risen)))
    gained = _confirmed(fit, trial, folds)
    if p_value > LEVELS.misfit or trial.colour is None or gained is None:
        return fit, None
    say(f"{trial.colour.label}: the noise is correlated")
    whole = fitted(fit.base, run, fit.found.smoothed, added=fit.added, colour=trial.colour,
                   start=trial.intensities)  # fmt: skip
    return whole, Added(trial.colour, p_value, gained, ())


def _noise_is_odd(fit: Fit, run: Run) -> bool:
    """Are the intensities far from what the signals themselves show from sample to sample?"""
    guess = first_guess(fit.ready, run)
    kept = {*fit.ready.readings}
    own = {
        name: value if name in kept else min(guess[name], value)
        for name, value in fit.intensities.items()
    }
    return bool(fit.likelihood - likelihood(fit.ready, own) > LEVELS.insists)


def _loud(fit: Fit) -> dict[str, float]:
    """What would have to be many times as noisy as is plausible, and how many, where the likelihood
    insists on it."""
    most = plausible(fit.base, fit.ready, fit.run)
    at_the_end = [n for n, q in most.items() if fit.intensities[n] > 0.99 * q]
    if not at_the_end:
        return {}
    asked, risen = unbounded(fit, fit.run)
    if risen - fit.likelihood < LEVELS.insists:
        return {}
    return {n: LEVELS.loud * asked[n] / most[n] for n in at_the_end if asked[n] > most[n]}


def _confirmed(current: Fit, better: Fit, folds: NDArray[np.int_]) -> float | None:
    """Held-out gain of log-likelihood per reading, if it exceeds its own error."""
    before, after = (_densities(f, held_out(f, folds)) for f in (current, better))
    if current.shifts != better.shifts:  # the first readings are of one of them alone
        lost = ~(forgotten(current) & forgotten(better))
        before[lost] = after[lost] = np.nan
    part = np.arange(len(before)) * LEVELS.pieces // len(before)
    gains = np.bincount(part, np.nan_to_num(after - before))
    error = float(np.sqrt(len(gains)) * np.std(gains, ddof=1))
    total = float(gains.sum())
    count = int(np.isfinite(current.found.innovations).sum())
    return total / count if total > LEVELS.confirmed * error else None


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
