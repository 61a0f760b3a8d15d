"""A sensor's residuals as what the loop searches: models with effects, refitted and proved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.effect import OVER_TIME, Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.evidence.likelihood import Likelihood
from casest.diagnose.evidence.linear import Linear
from casest.diagnose.evidence.rises import rises
from casest.diagnose.evidence.score import Evidence, Trial, judged, on_fewer_axes
from casest.diagnose.evidence.wandering import wandering_cost
from casest.diagnose.formula.search import NAME, described, readable, with_sizes
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol import Kept, Ranking, Subject
from casest.diagnose.sensor.driven import driven
from casest.diagnose.sensor.fits import (
    Fit,
    certified,
    fitted,
    problem_of,
    simpler,
    starts,
)
from casest.diagnose.sensor.jitter import Draw, in_refit, jittered
from casest.diagnose.sensor.mirrored import gain_backward
from casest.diagnose.sensor.recent import Recent
from casest.diagnose.sensor.rows import Rows
from casest.diagnose.sensor.to_both_sides import to_both_sides
from casest.diagnose.sensor.tried import Tried, on_axes
from casest.diagnose.sensor.twins import bend
from casest.diagnose.sensor.unlike import (
    another,
    at_one_input,
    between_levels,
    smooth,
    stands_in,
    too_slow,
    within_rounding,
)
from casest.engine.kernel import only_tried
from casest.errors import CasestError
from casest.estimate.calibrate import attempt
from casest.estimate.estimate import Estimate
from casest.leastsquares.kinds import whitened
from casest.leastsquares.problem import Problem

#: Why there is no refit.
NOT_FINITE = "its refit fails: the residual is not finite"
#: Half waves over all runs of an offset that wanders: what is faster is noise.
WANDER = 12


@dataclass(frozen=True)
class Sensor(Subject[Fit]):
    """A model, its runs (prepared) and what may be missing: the loop's subject."""

    model: Model
    runs: tuple[Run, ...]
    catalogue: tuple[Effect, ...]
    known: frozenset[str] = frozenset()
    seed: int = 0

    @cached_property
    def rows(self) -> Rows:
        """What is looked at."""
        return Rows(self.runs)

    @cached_property
    def tried(self) -> Tried:
        """What may be missing."""
        return Tried(self.rows, self.catalogue, self.known)

    @cached_property
    def _without(self) -> Recent[Fit, dict[str, Fit | None]]:
        return Recent()

    @cached_property
    def _beside(self) -> Recent[Fit, dict[str, tuple[Fit, Trial, Evidence, Likelihood] | None]]:
        return Recent(2)

    @cached_property
    def _widened(self) -> Recent[Fit, dict[tuple[str, bool], tuple[Candidate, Fit] | None]]:
        return Recent()

    @cached_property
    def _certified(self) -> Recent[Fit, Fit | str]:
        return Recent(16)

    @cached_property
    def _backward(self) -> Recent[Fit, dict[tuple[str, Any], float]]:
        return Recent()

    @cached_property
    def _on_rates(self) -> Recent[Fit, dict[str, Fit | str]]:
        return Recent()

    def fitted(self, model: Model, values: Mapping[str, Array]) -> Fit | None:
        """Fit to everything from these values; None where it goes astray."""
        return fitted(model, self.runs, values)

    def proved(self, fit: Fit) -> Estimate:
        """An estimate whose trust is known; its intervals are left for the end."""
        with only_tried(False):
            model = fit.model.at_true_values
            return attempt(model, self.runs, start=fit.values, seed=self.seed, intervals=False)

    def linear(self, fit: Fit) -> Linear:
        """Residuals and slopes in the rows that are looked at."""
        return self.rows.linear(fit)

    def trials(self, fit: Fit) -> list[Trial]:
        """Every candidate in its columns, over its grid."""
        return self.tried.trials(fit)

    def shown(self, fit: Fit) -> list[Trial]:
        """Where a slope does not reach as far: long lags that the records show by themselves, and
        what rates may lack, since a trajectory bends in it."""
        rates = [t for t in self.trials(fit) if _on_rate(t.what)]
        return [*self.tried.shown(fit), *rates]

    def everywhere(self, what: Candidate) -> bool:
        """What acts at once, at no moment or level of its own."""
        effect = what.effect
        if effect is None or effect.kind in OVER_TIME:
            return False
        return not {"time", "level", "floor"} & set(dict(effect.profile).values())

    def jittered(self, fit: Fit, trials: Sequence[Trial]) -> Sequence[Sequence[Draw]]:
        """The same where inputs have more noise."""
        return jittered(self.rows, fit, trials)

    def noise_in(
        self, before: Fit, after: Fit
    ) -> Sequence[Sequence[tuple[float, Array, Array, Array]]]:
        """What noise of each input adds to the residuals of two fits."""
        return in_refit(self.rows, before, after)

    def gain_backward(self, fit: Fit, trial: Trial) -> float:
        """What the mirror image of a memory, about its own delay, gains beside a fit."""
        known, what = self._backward.of(fit, dict), trial.what
        if (what.label, what.held) not in known:
            known[what.label, what.held] = gain_backward(self.rows, fit, what)
        return known[what.label, what.held]

    def gained_backward(self, before: Fit, after: Fit) -> float:
        """The same of the one memory that a fit has more than another, at its value there."""
        there = {a.label for a in before.model.effects}
        added = [a for a in after.model.effects if a.label not in there]
        if len(added) != 1 or len(after.model.effects) != len(there) + 1:
            return np.inf
        label = added[0].label
        what = next((c for c in self.tried.found(before)[0] if c.label == label), None)
        if what is None or what.effect is None:
            return np.inf
        names = {n: f"{label}.{n}" for n, _ in what.effect.profile}
        held = [(n, float(np.ravel(after.values.get(full, 0.0))[0])) for n, full in names.items()]
        return gain_backward(self.rows, before, replace(what, held=tuple(held)))

    def nearer(self, fit: Fit, trial: Trial, scale: float) -> list[Trial]:
        """Values of a grid around the trial's."""
        return self.tried.nearer(fit, trial, scale)

    def on_axes(self, fit: Fit, trial: Trial, axes: Sequence[int]) -> Trial:
        """The trial on some of its axes."""
        return on_axes(fit, trial, axes)

    def asked(self, what: Candidate) -> bool:
        """Is it the user's own, or named as there?"""
        return self.tried.asked(what)

    def refit(self, fit: Fit, added: Sequence[Trial]) -> Fit | str:
        """The fit with these effects, from their first-order sizes, if it can be trusted."""
        if len(added) == 1 and _on_rate(added[0].what):  # asked for twice
            known = self._on_rates.of(fit, dict)
            label = added[0].what.label
            if label not in known:
                known[label] = self._refit(fit, added)
            return known[label]
        return self._refit(fit, added)

    def _refit(self, fit: Fit, added: Sequence[Trial]) -> Fit | str:
        try:
            found = self._at_grid(fit, [t.what for t in added])
            if found is not None and any(t.what.free() is not t.what for t in added):
                # From the sizes at the value of the grid: at nothing, no slope tells a frequency.
                found = self._with(fit, [t.what.free() for t in added], found.values)
            plain = [_plain(t.what) for t in added]
            if found is not None and any(p is not None for p in plain):
                simple = [p or t.what.free() for p, t in zip(plain, added, strict=True)]
                cut = self._with(fit, simple, fit.values)
                # Few rows do not tell a kink from a bend, but readings that stand still.
                found = simpler(found, cut) if self.linear(fit).series else cut
        except (CasestError, np.linalg.LinAlgError) as error:
            return f"its refit fails: {error}"
        if found is None:
            return NOT_FINITE
        return self._unlike(fit, found, added) or found

    def _unlike(self, before: Fit, after: Fit, trials: Sequence[Trial]) -> str:
        """Why a refit is not what its names say, or is what the model says itself; else empty."""
        spans = [float(np.ptp(run.time)) for run in self.runs if run.time is not None]
        added = [t.what for t in trials]
        found = [what for what in added if not self.asked(what)]
        why = (
            too_slow(after.values, added, spans)
            or another(after.model, after.values, self.model)[1]
            or stands_in(before, after, found, self.rows)
            or (found and within_rounding(before, after, self.runs))
            or driven(before, after, added, self.rows)
            or to_both_sides(before, after, added, self.rows)
            or smooth(self.linear(before), self.linear(after), found, self.rows.met(before))
        )
        bends = [t for t in trials if bend(t.what)] if self.linear(before).series else []
        if bends and not why:
            settled = self.rows.settled(before)
            levels = (between_levels(t, self.linear(before), settled) for t in bends)
            why = next(filter(None, levels), "")
        for what in (w for w in added if _plain(w) is not None):
            beyond = self._residual_without(after, what) - self.linear(after).residual
            why = why or at_one_input(what, beyond, self.linear(after).deviation)
        return why

    def _at_grid(self, fit: Fit, added: Sequence[Candidate]) -> Fit | None:
        """The fit beside these effects as they are held. A lag is held by nothing but its start."""
        model, held = fit.model, dict[str, Array]()
        for what in added:
            alone = what.all_held(fit.model)
            model = (what.free() if alone else what).added_to(model)
            if alone and not _is_lag(what):
                new = [p for p in what.free().parameters(model) if p.name not in fit.values]
                sizes = {f"{what.label}.{n}": v for n, v in what.held}
                held |= {p.name: np.full(p.shape.dims, sizes[p.name]) for p in new}
        begun = starts(model, self.runs, fit.values)
        begun = {name: value for name, value in begun.items() if name not in held}
        found = self.fitted(model.having(**held), begun)
        return found if found is None else replace(found, values={**found.values, **held})

    def _with(
        self, fit: Fit, added: Sequence[Candidate], values: Mapping[str, Array]
    ) -> Fit | None:
        model = fit.model
        for candidate in added:
            model = candidate.added_to(model)
        return self.fitted(model, starts(model, self.runs, values))

    def rises(self, less: Fit, fits: Sequence[Fit]) -> list[float]:
        """2 log of the likelihood of each fit over that of one with less in it."""
        return rises(self.linear(less), [self.linear(fit) for fit in fits])

    def rises_beside_a_wander(self, less: Fit, fits: Sequence[Fit]) -> list[float]:
        """The same where the offset of a length may wander; none of other readings, or a table."""
        linears = [self.linear(fit) for fit in fits]
        linear, shift = self.linear(less), self.tried.shift(less)
        same = {x.residual.shape for x in linears} == {linear.residual.shape}
        if not (same and linear.coloured) or shift is None or linear.residual.shape[1] > 1:
            return []
        slope = shift[1]
        if np.ptp(slope, axis=0).max() < LEVELS.survives * np.abs(slope).max():
            return []  # a reading of its own, in which the offset's noise is as slow as it is
        waves = max(2, WANDER // len(self.runs))
        shapes = self.rows.cosines(waves) / np.sqrt(
            np.tile(np.arange(1, waves + 1), len(self.runs))
        )
        course = (slope[:, :, :, None] * shapes[:, None, None, :]).reshape(*slope.shape[:2], -1)
        return rises(linear, linears, lambda likelihood: wandering_cost(likelihood, course))

    def certified(self, fit: Fit) -> Fit | str:
        """The fit, if the data determine it and it is at rest; or why it is refused."""
        return self._certified.of(fit, lambda: certified(fit, self.runs))

    def without(self, fit: Fit, what: Candidate) -> Fit | None:
        """The fit without an effect that was added."""
        known = self._without.of(fit, dict)
        if what.label not in known:
            less = self._less(fit, what)
            known[what.label] = self.fitted(less.model, less.values)
        return known[what.label]

    def _less(self, fit: Fit, what: Candidate) -> Fit:
        """A cause taken out, all else where it is: a constant that was freed is held again."""
        if not what.freed:
            return _less(fit, what)
        held = self.model[what.freed].array
        model = fit.model.having(**{what.freed: held if held.ndim else float(held)})
        values = {n: v for n, v in fit.values.items() if n != what.freed}
        return replace(fit, model=model, values=values)

    def unlike(self, fit: Fit) -> str:
        """Why an effect in a fit is not what its name says there; else empty."""
        return another(fit.model, fit.values, self.model)[1]

    def instead(self, fit: Fit, what: Candidate, added: Sequence[Trial]) -> Fit | str:
        """The fit with these in the place of an effect that was added, from where it is."""
        return self._refit(self._less(fit, what), added)

    def replaced(self, fit: Fit, what: Candidate, other: Candidate, seen: Fit) -> Fit | None:
        """The fit with another effect in the place of one that was added, as it was fitted there
        when the rest of the model may have been another."""
        labels = {a.label for a in fit.model.effects} - {what.label} | {other.label}
        if {a.label for a in seen.model.effects} == labels:
            return seen
        less = self._less(fit, what)
        own = [a for a in seen.model.effects if a.label == other.label]
        model = replace(less.model, effects=(*less.model.effects, *own))
        return self.fitted(model, starts(model, self.runs, {**seen.values, **less.values}))

    def wider(self, fit: Fit, what: Candidate) -> tuple[Candidate, Fit] | None:
        """An effect that was added on some axes only, and the fit with it on all of them.

        If the data determine each of them there: what they do not would lead the fit anywhere.
        """
        # Asked for after every round, though most rounds leave the fit as it is.
        known = self._widened.of(fit, dict)
        if (what.label, True) not in known:
            known[what.label, True] = self._wider(fit, what)
        return known[what.label, True]

    def _wider(self, fit: Fit, what: Candidate) -> tuple[Candidate, Fit] | None:
        found = self._anew(fit, what)
        if found is None:
            return None
        base, trial, evidence, _ = found
        if evidence.freedom < trial.columns.shape[2]:
            return None
        refit = self.refit(base, [trial])
        return None if isinstance(refit, str) else (trial.what, refit)

    def better_axes(self, fit: Fit, what: Candidate) -> tuple[Candidate, Fit] | None:
        """The same where it cannot be on all of them: on those that are worth it by now."""
        known = self._widened.of(fit, dict)
        if (what.label, False) not in known:
            known[what.label, False] = self._on_better_axes(fit, what)
        return known[what.label, False]

    def _on_better_axes(self, fit: Fit, what: Candidate) -> tuple[Candidate, Fit] | None:
        found = self._anew(fit, what)
        if found is None:
            return None
        base, trial, evidence, likelihood = found
        axes = on_fewer_axes(evidence, likelihood)
        if axes is None:
            return None
        less = self.on_axes(base, trial, axes)
        refit = self.refit(base, [less])
        return None if isinstance(refit, str) else (less.what, refit)

    def _anew(self, fit: Fit, what: Candidate) -> tuple[Fit, Trial, Evidence, Likelihood] | None:
        """The fit without an effect, and that on all axes as a trial beside it."""
        known = self._beside.of(fit, dict)
        if what.label not in known:
            known[what.label] = self._looked_at_anew(fit, what)
        return known[what.label]

    def _looked_at_anew(
        self, fit: Fit, what: Candidate
    ) -> tuple[Fit, Trial, Evidence, Likelihood] | None:
        # Whether there is more of it hangs on the model alone; the fit without it is dear.
        whole = None if what.freed else self._whole(fit, _less(fit, what), what)
        base = None if whole is None else self.without(fit, what)
        if base is None or whole is None:
            return None
        likelihood = Likelihood(self.linear(base))
        trials = self.tried.of(base, [whole])
        evidence = judged(trials, likelihood, likelihood.beside(), families=1) if trials else None
        return None if evidence is None else (base, trials[0], evidence, likelihood)

    def _whole(self, fit: Fit, base: Fit, what: Candidate) -> Candidate | None:
        """An effect of the fit on all axes, beside the base; None where it is that already."""
        whole = self.tried.like(base, what)
        if whole is None:
            return None
        if what.parameters(fit.model) == whole.parameters(whole.traced_on(base.model)):
            return None
        return replace(whole, held=what.held, trials=what.trials)

    def apart(self, fit: Fit, kept: Kept) -> tuple[Linear, Trial] | None:
        """The linear problem as if an effect were not there, and the effect as a trial of it."""
        what: Candidate = kept.what
        problem, _ = problem_of(fit, self.runs)
        names = {p.name for p in what.free().parameters(fit.model)}  # a lag is its delay alone
        own = [(s.x, s.parameter.name) for s in problem.slots if s.parameter.name in names]
        if not own:
            return None
        linear = self.linear(fit)
        everything = np.concatenate([np.arange(x.start, x.stop) for x, _ in own])
        profile = dict(what.effect.profile) if what.effect else {}
        sizes = [x for x, name in own if name.rpartition(".")[2] not in profile] or [
            x for x, _ in own
        ]
        columns = linear.slopes[:, :, np.concatenate([np.arange(x.start, x.stop) for x in sizes])]
        part = self._residual_without(fit, what) - linear.residual
        variants = max(t.variants for t in kept.evidence.trials if t.family == what.label)
        trial = Trial(what, what.label, columns, variants)
        return linear.without(np.delete(linear.slopes, everything, axis=2), part), trial

    def _residual_without(self, fit: Fit, what: Candidate) -> Array:
        """Residuals (N, m) of the model without an effect, at the values of the fit."""
        less = self._less(fit, what)
        problem = Problem(less.model, self.runs)
        point = problem.point(less.values)
        residuals = whitened(problem, point).residuals(point)
        weights = problem_of(fit, self.runs)[0].weights
        if weights is not None:
            residuals = tuple(r * np.sqrt(w) for r, w in zip(residuals, weights, strict=True))
        return self.rows.of(residuals)

    def final(self, fit: Fit, what: Candidate) -> Candidate:
        """The candidate as it stands in the model."""
        attached = next((a for a in fit.model.effects if a.label == what.label), None)
        if attached is None:
            return what
        made = attached.effect
        if made.source:
            own = {p.name.rpartition(".")[2]: p.name for p in attached.parameters}
            made = with_sizes(made, {k: float(fit.values[n]) for k, n in own.items()})
        if what.declared_on:
            made = replace(made, on=what.on)
        return replace(what, effect=made, held=(), traced=None)

    def moved_by(self, fit: Fit, other: Fit) -> dict[str, Array]:
        """How far the declared parameters would move, were this the fit."""
        return {n: other.values[n] - v for n, v in fit.values.items() if n in other.values}

    def formula(self, fit: Fit, ranking: Ranking) -> Evidence | None:
        """The best description; None where there is one, or nothing to be added to."""
        problem, point = problem_of(fit, self.runs)
        found, there = self.tried.shift(fit), {a.label for a in fit.model.effects}
        if found is None or problem.sequential or NAME in there:
            return None
        on, slope = found
        read = readable(problem, point, slope, on, self.rows.index)
        return described(read, ranking.likelihood, ranking.none, ranking.families)


def _less(fit: Fit, what: Candidate) -> Fit:
    """An effect taken out, all else where it is."""
    left = [a for a in fit.model.effects if a.label != what.label]
    while True:
        model = replace(fit.model, effects=tuple(left))
        # A lag of a column that only this effect read goes with it.
        gone = {s.name for s in fit.model.signals} - {s.name for s in model.signals}
        kept = [a for a in left if a.on not in gone]
        if len(kept) == len(left):
            break
        left = kept
    names = {p.name for p in model.parameters}
    return replace(fit, model=model, values={n: v for n, v in fit.values.items() if n in names})


def _is_lag(candidate: Candidate) -> bool:
    """Is it nothing but a time, which cannot be held?"""
    return candidate.effect is not None and candidate.effect.kind == "time"


def _on_rate(candidate: Candidate) -> bool:
    """Does it act on the rate of a state?"""
    return candidate.effect is not None and candidate.effect.kind == "rate"


def _plain(candidate: Candidate) -> Candidate | None:
    """What it mostly is in practice: with fewer unknowns, nothing held."""
    effect = candidate.effect
    if effect is None or not effect.plain:
        return None
    names = {n for n, _ in effect.declarations}
    if not set(dict(effect.plain)) <= names:
        return None
    begun = effect.starting(**dict(candidate.held)).holding(**dict(effect.plain))
    return replace(candidate, effect=begun, held=(), traced=None)
