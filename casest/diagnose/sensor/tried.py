"""What may be missing, in its columns beside a fit, over the grids of what is searched."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from casest.data.checks import full_scales
from casest.declaration.effect import NOISE, OVER_TIME, Effect, effect
from casest.declaration.model import Model
from casest.declaration.physics import SX
from casest.declaration.shapes import Array, each
from casest.declaration.symbols import param
from casest.diagnose.candidates.axes import axes_of
from casest.diagnose.candidates.candidates import (
    Candidate,
    Channels,
    Skipped,
    candidates,
    channels_of,
    read_by,
)
from casest.diagnose.candidates.grid import Seen, nearer, on_grid
from casest.diagnose.candidates.motion_columns import columns_of_motion
from casest.diagnose.candidates.slopes import slopes
from casest.diagnose.evidence.linear import Index
from casest.diagnose.evidence.score import Trial
from casest.diagnose.levels import LEVELS
from casest.diagnose.sensor.fits import Fit, problem_of
from casest.diagnose.sensor.recent import Recent
from casest.diagnose.sensor.rows import Rows
from casest.diagnose.sensor.twins import bend, twins
from casest.effects import shipped
from casest.effects.kinds import foreign, readings
from casest.effects.lateness import comes_again, likely_lag
from casest.effects.on_axes import restricted
from casest.effects.placing import UNTIMED, placed_in
from casest.errors import CasestError

#: Why what remembers is not tried.
BEGUN_ANEW = "each pose begins anew: nothing is remembered from the one before"
#: And why what is asked for is not.
NO_COLUMN = "the data have no column that it could follow"
#: Samples of a block up to which it is a pose.
LONGEST_POSE = 32


@effect(on="output")
def offset(y: SX, *, k: SX = param(each, "[y]")) -> SX:
    """An offset: its slope is that of the residual in what the sensor gives."""
    return y + k


@dataclass(frozen=True)
class Tried:
    """The catalogue on the rows that are looked at; `known`: what the user says is there."""

    rows: Rows
    catalogue: tuple[Effect, ...]
    known: frozenset[str]
    _found: Recent[Model, tuple[list[Candidate], list[Skipped]]] = field(
        default_factory=lambda: Recent(16), repr=False
    )
    #: By what a model reads itself.
    _channels: dict[frozenset[str], Channels] = field(default_factory=dict, repr=False)
    #: Of each signal that may be late: the records say it, whatever the fit.
    _lags: dict[tuple[str, str], tuple[float, float]] = field(default_factory=dict, repr=False)
    #: Beside the first fit that is looked at: what is declared.
    _twins: list[dict[str, str]] = field(default_factory=list, repr=False)
    _looked: Recent[Fit, Seen] = field(default_factory=Recent, repr=False)
    _trials: Recent[Fit, list[Trial]] = field(default_factory=lambda: Recent(1), repr=False)

    def found(self, fit: Fit) -> tuple[list[Candidate], list[Skipped]]:
        """What could be missing, and what does not apply here."""
        catalogue, skipped = self._in_order
        found, unfit = self._found.of(fit.model, lambda: self._known_here(fit.model, catalogue))
        if not self._twins:
            problem, point = problem_of(fit, self.rows.runs)
            bends = slopes(problem, point, [c for c in found if bend(c)], self.rows.index)
            columns = [(c, s) for c, s in bends if not isinstance(s, CasestError)]
            self._twins.append(twins(self.rows.linear(fit), columns))
        same = {k: v for k, v in self._twins[0].items() if k not in self.known}
        skipped = [*skipped, *unfit]
        skipped += (Skipped(k, f"does here what {v} does") for k, v in same.items())
        return [c for c in found if c.label not in same], skipped

    @cached_property
    def _in_order(self) -> tuple[list[Effect], list[Skipped]]:
        """The catalogue without what looks at the rows before, where nothing tells them."""
        untimed = any(run.time is None for run in self.rows.runs)
        if self._in_time and not untimed:
            return list(self.catalogue), []
        why = UNTIMED if untimed else BEGUN_ANEW
        left = {e.name for e in self.catalogue if e.kind in OVER_TIME}
        if why == UNTIMED:
            others = ((e.name, e.otherwise) for e in self.catalogue)
            left |= {name for name, o in others if o is not None and o.kind in OVER_TIME}
        kept = [e for e in self.catalogue if e.name not in left]
        return kept, [Skipped(e.name, why) for e in self.catalogue if e.name in left]

    def _known_here(
        self, model: Model, catalogue: Sequence[Effect]
    ) -> tuple[list[Candidate], list[Skipped]]:
        """Without what no such sensor has, unless it is asked for."""
        found, skipped = candidates(model, self.rows.runs, catalogue, self._read(model))
        units = [self.rows.runs[0].units.get(name) for name in readings(model)]
        asked = (c for c in found if c.effect is not None and not self.asked(c))
        why = {c.label: foreign(c.effect, units) for c in asked if c.effect is not None}
        skipped += [Skipped(label, reason) for label, reason in why.items() if reason]
        return [c for c in found if not why.get(c.label)], skipped

    def like(self, fit: Fit, what: Candidate) -> Candidate | None:
        """The candidate of that label, as it could be missing in a fit."""
        own = [e for e in self.catalogue if e.name == what.name]
        if what.effect is None:
            return None
        several, _ = candidates(fit.model, self.rows.runs, own, self._read(fit.model))
        return next((c for c in several if c.label == what.label), None)

    def _read(self, model: Model) -> Channels:
        own = read_by(model)
        if own not in self._channels:
            self._channels[own] = channels_of(model, self.rows.runs, self._asked_columns)
        return self._channels[own]

    def trials(self, fit: Fit) -> list[Trial]:
        """Every candidate in its columns, over its grid."""
        return self._trials.of(fit, lambda: self.of(fit, self._expanded(fit)))

    def _expanded(self, fit: Fit) -> list[Candidate]:
        seen = self.seen(fit)
        return [c for one in self.found(fit)[0] for c in on_grid(one, seen, *self._late(fit, one))]

    def shown(self, fit: Fit) -> list[Trial]:
        """Long lags and full scales that the records show by themselves: a slope does not reach as
        far as the one, and what is cut off has spoilt the fit without the other."""
        times = [run.time for run in self.rows.runs if run.time is not None and len(run) > 1]
        step = float(np.median(np.diff(times[0]))) if times else np.inf
        found = []
        for candidate in self.found(fit)[0]:
            lag, _ = self._late(fit, candidate)
            if abs(lag) > 2 * step:
                found.append(replace(candidate, held=(("delay", lag),), trials=len(times[0])))
            profile = dict(candidate.effect.profile) if candidate.effect else {}
            if set(profile.values()) == {"level"}:
                held = ([(name, level) for name in profile] for level in self._full_scales(fit))
                found += [replace(candidate, held=tuple(h)) for h in held]
        return self.of(fit, found)

    def _full_scales(self, fit: Fit) -> set[float]:
        """Sizes at which readings stand still while the input goes on."""
        measured = fit.model.traced.measured
        if not measured or fit.model.implicit:
            return set()
        names = [s.name for s in fit.model.signals if s.kind == "plain" and s.name != "t"]
        given = [n for n in names if n not in fit.model.traced.readings]
        signals = {n: np.concatenate([run.signals[n] for run in self.rows.runs]) for n in names}
        beside = np.column_stack([signals[n] for n in given]) if given else None
        return {abs(extreme) for _, _, extreme, _ in full_scales(signals[measured], beside)}

    def of(self, fit: Fit, several: Sequence[Candidate]) -> list[Trial]:
        """These candidates in their columns, without those that have none here."""
        problem, point = problem_of(fit, self.rows.runs)
        found, motion = [], columns_of_motion(fit.model, self.rows.runs)
        for candidate, columns in slopes(problem, point, several, self.rows.index):
            if isinstance(columns, CasestError) or self._scales(fit, candidate, columns):
                continue
            axes = _axes(fit, candidate, columns.shape[2])
            describes = self._describes(candidate, motion) and not self.asked(candidate)
            family, trials = candidate.label, candidate.trials
            secant = candidate.all_held(fit.model)
            kinds = dict(candidate.effect.profile).values() if candidate.effect else ()
            trial = Trial(candidate, family, columns, trials, axes, describes, secant=secant)
            found.append(replace(trial, event=not {"time", "onset"}.isdisjoint(kinds)))
        return found

    def _scales(self, fit: Fit, candidate: Candidate, columns: Array) -> bool:
        """Does a gain of a reading, from rest to rest, do nothing beside the unknowns but scale
        what is left? At rest that is the reading's own noise."""
        if not candidate.declared_on:
            return False
        own = candidate.parameters(candidate.traced_on(fit.model))
        linear = self.rows.linear(fit)
        X = columns.reshape(linear.residual.size, -1)
        X = X - linear.basis @ (linear.basis.T @ X)
        most = LEVELS.over_noise * float(np.linalg.norm(linear.residual))
        return not any(p.unit for p in own) and bool(np.linalg.norm(X, axis=0).max() < most)

    @staticmethod
    def _describes(candidate: Candidate, motion: Collection[str]) -> bool:
        """Does it say what an error looks like, and name no cause?"""
        effect = candidate.effect
        if effect is None or effect.describes:
            return effect is not None
        follows = (kind == "other" for _, kind in effect.columns)
        return any(follows) and candidate.column in motion

    def nearer(self, fit: Fit, trial: Trial, scale: float) -> list[Trial]:
        """Values of a grid around the trial's."""
        if not trial.what.held:
            return []
        around = nearer(trial.what, self.seen(fit), scale)
        return self.of(fit, around)

    def seen(self, fit: Fit) -> Seen:
        """What grids are laid over."""
        return self._looked.of(fit, lambda: self._seen(fit))

    def _seen(self, fit: Fit) -> Seen:
        problem, point = problem_of(fit, self.rows.runs)
        shift, linear = self.shift(fit), self.rows.linear(fit)
        push = -linear.residual
        if shift is not None:
            push = np.einsum("nmq,nm->nq", shift[1], linear.residual)
        reading = time = None
        traced = fit.model.along
        if traced.predicted is not None and (traced.integrates or not problem.sequential):
            found = problem.evaluate(point, {"p": traced.predicted})
            reading = self.rows.of([f[0][:, :, 0] for f in found])
        times = [run.time for run in self.rows.runs if run.time is not None]
        if len(times) == len(self.rows.runs):
            time = self.rows.of(times)
        slope = None if shift is None else shift[1]
        met = self.rows.met(fit)
        return Seen(push, reading, time, linear, slope, met if np.ptp(met) > 0 else None)

    def shift(self, fit: Fit) -> tuple[str, Array] | None:
        """What the sensor gives, and the residual's slope (N, m, axes) in a shift of it."""
        return self.slope(fit, offset)

    def slope(self, fit: Fit, probing: Effect) -> tuple[str, Array] | None:
        """What an effect acts on, and the residual's slope (N, m, k) in its unknowns."""
        problem, point = problem_of(fit, self.rows.runs)
        try:
            probe = Candidate(placed_in(probing, fit.model))
        except CasestError:
            return None
        ((_, slope),) = slopes(problem, point, [probe], self.rows.index)
        return None if isinstance(slope, CasestError) else (probe.on, slope)

    @cached_property
    def _in_time(self) -> bool:
        """Do samples follow each other? In poses each begins anew, and nothing comes late."""
        blocks = sum(len(np.unique(run.block)) for run in self.rows.runs)
        return sum(map(len, self.rows.runs)) >= LONGEST_POSE * blocks

    def _late(self, fit: Fit, candidate: Candidate) -> tuple[float, float]:
        """A lag that two records show by how lively each of them is, and the period in which what
        is late comes again; in s."""
        if candidate.effect is None or candidate.effect.kind != "time":
            return 0.0, np.inf
        name, measured, runs = candidate.on, fit.model.traced.measured or "", self.rows.runs
        if (name, measured) not in self._lags:
            rotation = any(s.name == name and s.kind == "rotation" for s in fit.model.signals)
            lag = likely_lag(runs, measured, name, within=True, rotation=rotation)
            self._lags[name, measured] = lag, comes_again(runs, name, rotation=rotation)
        return self._lags[name, measured]

    def asked(self, what: Candidate) -> bool:
        """Is it the user's own, or named as there?"""
        if what.effect is None:
            return what.freed in self.known
        return what.among(self.known) or what.name in self._own

    @cached_property
    def _asked_columns(self) -> frozenset[str]:
        """`current` of `channel_bias(current)`."""
        return frozenset(name.partition("(")[2].removesuffix(")") for name in self.known)

    @cached_property
    def _own(self) -> frozenset[str]:
        """Names of effects that are the user's."""
        return frozenset(e.name for e in self.catalogue if not shipped(e))

    def unseen(self, fit: Fit, shown: Collection[str]) -> tuple[list[Skipped], list[Skipped]]:
        """What is asked for and these data cannot show; and what of it does not apply to them."""
        found, skipped = self.found(fit)
        hidden = [c for c in found if self.asked(c) and c.label not in shown]
        silent = [Skipped(c.label, "these data cannot show it") for c in hidden]
        of_noise = {e.name for e in self.catalogue if e.on == NOISE}
        tried = {name for c in found for name in (c.name, c.label)}
        absent = []
        for name in sorted(self.known - of_noise - tried):
            reasons = [s.reason for s in skipped if _bare(s.name) == _bare(name)]
            column = name.partition("(")[2].removesuffix(")")
            own = any(s.name == column for s in fit.model.signals)
            none = f"the model reads {column} itself" if own else NO_COLUMN
            why = reasons[0] if reasons else none
            absent.append(Skipped(name, why))
        return silent, absent


def _bare(name: str) -> str:
    """An effect's name without what it follows."""
    return name.partition("(")[0]


def _axes(fit: Fit, candidate: Candidate, count: int) -> Index | None:
    own = candidate.parameters(candidate.traced_on(fit.model))
    size = axes_of(own)
    return np.tile(np.arange(size), len(own)) if size > 1 and size * len(own) == count else None


def on_axes(fit: Fit, trial: Trial, axes: Sequence[int]) -> Trial:
    """The trial on some of its axes."""
    candidate: Candidate = trial.what
    assert candidate.effect is not None
    assert trial.axes is not None
    less = replace(candidate, effect=restricted(candidate.effect, axes, fit.model), traced=None)
    own = np.isin(trial.axes, list(axes))
    columns = trial.columns[:, :, own]
    return replace(trial, what=less, columns=columns, axes=None, among=trial.choices)
