"""Each cause must earn its place again beside those that came later."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from casest.diagnose.evidence.by_row import chance_by_row, chance_together
from casest.diagnose.evidence.input_noise import at_most
from casest.diagnose.evidence.likelihood import Likelihood
from casest.diagnose.evidence.linear import alike
from casest.diagnose.evidence.score import p_value, worth
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol.confirming import falls_of_refit
from casest.diagnose.protocol.refits import TOGETHER, feigned_between
from casest.diagnose.protocol.state import F, Kept, State
from casest.diagnose.protocol.subject import Subject

#: Why a cause that was added goes again.
LATER = "no longer needed beside what came later"


def on_all_axes(subject: Subject[F], state: State[F], *, needed: bool) -> State[F]:
    """Axes that were nothing beside what was still missing may be something now.

    Where they are not `needed`, what is found on some axes is on all that the data determine: an
    axis set to nothing because it is not seen would leave the other unknowns off, and too sure.
    """
    for k, kept in enumerate(state.kept):
        found = _certified(subject, subject.wider(state.fit, kept.what))
        if found is None and needed:
            found = _certified(subject, subject.better_axes(state.fit, kept.what))
        if found is None:
            continue
        what, fit = found
        less, all_ = alike([subject.linear(state.fit), subject.linear(fit)])
        more = all_.basis.shape[1] - less.basis.shape[1]
        if more < 1:
            continue
        gain = subject.rises(state.fit, [fit])[0]
        if not needed or worth(gain, more, 0.0, Likelihood(less)) > LEVELS.strong:
            trials = tuple(replace(t, what=what) if t.what == kept.what else t
                           for t in kept.evidence.trials)  # fmt: skip
            evidence = replace(kept.evidence, trials=trials)
            several = list(state.kept)
            several[k] = replace(kept, what=what, evidence=evidence)
            state = replace(state, fit=fit, kept=tuple(several))
    return state


def _certified(subject: Subject[F], found: tuple[Any, F] | None) -> tuple[Any, F] | None:
    return None if found is None or isinstance(subject.certified(found[1]), str) else found


def eliminated(subject: Subject[F], state: State[F]) -> State[F]:
    """Each cause must earn its place again beside the others; the weakest goes first.

    Also the last one, where another has gone: of a pair each was judged beside the other. And in
    poses and tables, where nothing else is found, by how neighbours go together.
    """
    count, poses = len(state.kept), not subject.linear(state.fit).coloured
    while len(state.kept) > 1 or (state.kept and (len(state.kept) < count or poses)):
        weak = []
        for kept in state.kept:
            base = subject.without(state.fit, kept.what)
            found = None if base is None else _beside_the_others(subject, state, kept, base)
            # Another that is more than its name says where this one goes does its work besides.
            if found is not None and base is not None and not subject.unlike(base):
                weak.append((*found, kept, base))
        if len(state.kept) == count == 1:  # the rest of it was asked when it was added
            weak = [w for w in weak if w[1] == TOGETHER]
        if not weak:
            return state
        _, why, gone, fit = min(weak, key=lambda w: w[0])
        state = replace(state.dropping(gone, why), fit=fit)
        if why == TOGETHER:
            state = replace(state, open=(gone.evidence, *state.open))
    return state


def chance_alone(subject: Subject[F], state: State[F], kept: Kept) -> float:
    """p of a cause beside all others, by its refit: of a pair the evidence is both's. Where another
    does its work without it, and is not what its name says there, that of when it was added."""
    if len(state.kept) == len(kept.evidence.trials) == 1:
        return kept.evidence.p_value
    base = subject.without(state.fit, kept.what)
    if base is None or subject.unlike(base):
        return kept.evidence.p_value
    return _alone(subject, state, kept, base)[1]


def chance_in_rows(subject: Subject[F], state: State[F], kept: Kept, over: float) -> float:
    """p of a cause beside all others in rows that have no time, where the noise is alike `over` so
    many of them; 0 where it is a series, or has no fit without the cause."""
    base = subject.without(state.fit, kept.what)
    linear = subject.linear(state.fit)
    if base is None or linear.coloured or over <= 1:
        return 0.0
    before, after = alike([subject.linear(base), linear])
    chance = chance_together(before, after, over)
    return float(min(1.0, chance * np.exp(_alone(subject, state, kept, base)[2])))


def on_its_own(subject: Subject[F], state: State[F], kept: Kept) -> tuple[float, float] | None:
    """Score and p of a cause beside all others, less what noise of the inputs may have of it; None
    where there is no fit without it."""
    base = subject.without(state.fit, kept.what)
    if base is None:
        return None
    feigned = feigned_between(subject, base, state.fit) or 0.0
    count = subject.linear(state.fit).residual.size
    return _alone(subject, state, kept, base, at_most(feigned, count))[:2]


def _alone(
    subject: Subject[F], state: State[F], kept: Kept, base: F, feigned: float = 0.0
) -> tuple[float, float, float]:
    """Score and p of a cause beside the others, `base` being the fit without it, and the log of
    what was looked through for it."""
    linear, whole = alike([subject.linear(base), subject.linear(state.fit)])
    none, gain = Likelihood(linear), subject.rises(base, [state.fit])[0] - feigned
    freedom = max(whole.basis.shape[1] - linear.basis.shape[1], 1)
    families = _looked_through(subject, state, kept)
    trials = kept.evidence.trials
    own = [t.variants for t in trials if t.what == kept.what] or [t.variants for t in trials]
    searched = float(np.log(max(own) * families))
    score, chance = (f(gain, freedom, searched, none) for f in (worth, p_value))
    return score, chance, searched


def _looked_through(subject: Subject[F], state: State[F], kept: Kept) -> int:
    """Among how many its chance is shared: of what was asked for those that were."""
    if state.first is None:
        return 1
    if not subject.asked(kept.what):
        return state.first.families
    asked = max(1, sum(subject.asked(e.trials[0].what) for e in state.first.found))
    own = next((t for t in kept.evidence.trials if t.what == kept.what), None)
    return asked if own is None else asked * own.choices


def _beside_the_others(
    subject: Subject[F], state: State[F], kept: Kept, base: F
) -> tuple[float, str] | None:
    """What a cause is worth that does not earn its place as the last one, and why; None if it does.

    `base` is the fit without it.
    """
    linear, whole = subject.linear(base), subject.linear_in(base, state.fit)
    score, chance, searched = _alone(subject, state, kept, base)
    why = LATER
    strong = score > LEVELS.strong if linear.series else chance < LEVELS.chance
    same = linear.residual.shape == whole.residual.shape
    if strong and same and not linear.coloured and not subject.asked(kept.what):
        together = chance_by_row(linear, whole, together=True)
        if together * np.exp(min(searched, 700.0)) >= LEVELS.chance:
            strong, why = False, TOGETHER
    if strong and (subject.asked(kept.what) or not same):
        return None  # rows that moved in time are others
    # What was confirmed once stays, unless some held-out part is clearly worse with it.
    seen = falls_of_refit(linear, whole)
    worse = any(f.t < -LEVELS.confirmed for f in seen.values()) if linear.series else False
    return None if strong and seen["pieces"].ratio < 1 and not worse else (score, why)
