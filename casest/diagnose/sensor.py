"""A sensor's residuals as what the loop searches: models with effects, refitted and proved."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from casest.data.run import Run
from casest.declaration.effect import NOISE, OVER_TIME, Effect, effect
from casest.declaration.model import Model
from casest.declaration.physics import SX
from casest.declaration.shapes import Array, each
from casest.declaration.symbols import param
from casest.diagnose.candidates.axes import axes_of
from casest.diagnose.candidates.candidates import Candidate, Skipped, candidates
from casest.diagnose.candidates.grid import Seen, nearer, on_grid
from casest.diagnose.candidates.slopes import rows_of, slopes
from casest.diagnose.cross_validation import undetermined
from casest.diagnose.evidence.likelihood import Likelihood
from casest.diagnose.evidence.linear import Index, Linear, Parts, parts_of, spans_of
from casest.diagnose.evidence.score import Evidence, Trial
from casest.diagnose.formula.search import NAME, described, readable, with_sizes
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol import Kept, Ranking, Rival
from casest.effects import shipped
from casest.effects.lateness import likely_lag
from casest.effects.on_axes import restricted
from casest.effects.placing import placed_in
from casest.engine.kernel import only_tried
from casest.errors import CasestError
from casest.estimate.calibrate import attempt
from casest.estimate.estimate import Estimate
from casest.leastsquares.problem import Point, Problem
from casest.leastsquares.weights import robust_scale, weighted
from casest.solve.trust_region import trust_region

#: What survives of an implicit residual's slopes, in noise over reading, at least.
BEYOND = 5.0
#: Samples of a block up to which it is a pose.
LONGEST_POSE = 32
#: Models whose candidates are remembered.
REMEMBERED = 4
#: Iterations of a fit that begins at the fit to everything, and gain (in σ²) that ends it.
ITERATIONS, ENOUGH = 30, 1e-3
#: Iterations of a fit that is to stay, and standard deviations that a step may be long there.
LONG, RESTLESS = 100, 1e-2


@dataclass(frozen=True)
class Fit:
    """A model fitted to all runs: values, residuals (N, m) per run, σ from their middle."""

    model: Model
    values: Mapping[str, Array]
    residuals: tuple[Array, ...] = field(repr=False)
    noise: float
    unknowns: int


@effect(on="output")
def _shift(y: SX, *, k: SX = param(each, "[y]")) -> SX:
    """An offset: its slope is that of the residual in what the sensor gives."""
    return y + k


@dataclass(frozen=True)
class Sensor:
    """A model, its runs (prepared) and what may be missing: the loop's subject."""

    model: Model
    runs: tuple[Run, ...]
    catalogue: tuple[Effect, ...]
    known: frozenset[str] = frozenset()
    seed: int = 0
    #: Candidates on the models that were asked about last: tracing takes longer than scoring.
    remembered: list[tuple[Model, tuple[list[Candidate], list[Skipped]]]] = field(
        default_factory=list, repr=False
    )

    linears: list[tuple[Fit, Linear]] = field(default_factory=list, repr=False)
    looked: list[tuple[Fit, Seen]] = field(default_factory=list, repr=False)
    shown_in: list[tuple[Fit, list[Trial]]] = field(default_factory=list, repr=False)

    # -- fits ----------------------------------------------------------------------------------

    def fitted(self, model: Model, values: Mapping[str, Array]) -> Fit | None:
        """Fit to everything from these values; None where it goes astray."""
        problem = weighted(Problem(model, self.runs), values)
        count = max(problem.residual_count, 1)
        point = problem.point(values)
        for _ in range(2 if problem.weights is not None else 1):
            found = trust_region(
                problem, point, max_iterations=ITERATIONS, tolerance=ENOUGH / count
            )
            point = found.point
            problem = weighted(problem, problem.values(point))
        residuals = problem.residuals(point)
        if not all(np.all(np.isfinite(r)) for r in residuals):
            return None
        freedom = max(problem.residual_count - problem.unknowns, 1)
        noise = robust_scale(residuals) * float(np.sqrt(count / freedom))
        return Fit(model, problem.values(point), tuple(residuals), noise, problem.unknowns)

    def proved(self, fit: Fit) -> Estimate:
        """An estimate whose trust is known; its intervals are left for the end."""
        with only_tried(False):
            return attempt(fit.model, self.runs, start=fit.values, seed=self.seed, intervals=False)

    # -- the loop's questions --------------------------------------------------------------------

    def linear(self, fit: Fit) -> Linear:
        """Residuals and slopes in the rows that are looked at."""
        for known, linear in self.linears:
            if known is fit:
                return linear
        residual, J = self._rows(*self._problem(fit))
        linear = Linear(residual, J, self._spans, self._parts(fit), self._least(fit))
        self.linears.append((fit, linear))
        del self.linears[:-REMEMBERED]
        return linear

    def _least(self, fit: Fit) -> float:
        """Slopes of an implicit residual contain the residual: what survives must be more."""
        if not fit.model.implicit:
            return LEVELS.survives
        names = [
            s.name
            for s in fit.model.signals
            if s.name != "t" and s.kind == "plain" and s.name not in self.runs[0].columns
        ]
        sizes = [
            float(np.sqrt(np.mean(np.concatenate([r.signals[n] for r in self.runs]) ** 2)))
            for n in names
        ]
        return max(LEVELS.survives, BEYOND * fit.noise / max(min(sizes, default=np.inf), 1e-300))

    def _problem(self, fit: Fit) -> tuple[Problem, Point]:
        problem = weighted(Problem(fit.model, self.runs), fit.values)
        return problem, problem.point(fit.values)

    @cached_property
    def rows(self) -> list[Index]:
        """Rows of each run that are looked at."""
        return rows_of(self.runs, LEVELS.rows)

    def _rows(self, problem: Problem, point: Point) -> tuple[Array, Array]:
        axes = len(problem.model.axes)
        offsets = np.cumsum([0, *map(len, self.rows)])
        r, J = np.zeros((offsets[-1], axes)), np.zeros((offsets[-1], axes, problem.unknowns))
        for block in problem.blocks(point):
            rows = self.rows[block.run]
            inside = (rows >= block.span.start) & (rows < block.span.stop)
            here, chosen = offsets[block.run] + np.flatnonzero(inside), rows[inside]
            local = chosen - block.span.start
            root = np.ones((1, 1)) if block.weights is None else np.sqrt(block.weights[local])
            r[here] = block.residual[local] * root
            own = np.zeros((len(here), axes, problem.unknowns))
            own[:, :, block.x] = block.jacobian[local]
            J[here] = own * root[:, :, None]
        return r, np.nan_to_num(J)

    @cached_property
    def _numbers(self) -> tuple[Index, Index]:
        """Block and run of each row."""
        blocks = [run.block[rows] for run, rows in zip(self.runs, self.rows, strict=True)]
        runs = [np.full(len(rows), k) for k, rows in enumerate(self.rows)]
        return np.concatenate(blocks), np.concatenate(runs)

    @cached_property
    def _spans(self) -> tuple[slice, ...]:
        """Where the noise may have a colour: in single readings with a time."""
        total = sum(map(len, self.rows))
        in_time = all(run.time is not None and not run.spread for run in self.runs)
        return spans_of(*self._numbers) if in_time and total >= LEVELS.series else ()

    def _parts(self, fit: Fit) -> Parts:
        return parts_of(*self._numbers, self._met(fit))

    def _met(self, fit: Fit) -> Array:
        """What the sensor met in each row (N, q): the corrected quantity, or the prediction."""
        traced = fit.model.traced
        name = traced.corrected
        value = fit.model.quantities[name].value if name else traced.predicted
        if value is None:
            return np.zeros((len(self._numbers[0]), 1))
        problem, point = self._problem(fit)
        if problem.sequential:  # what it met is what it met without a memory as well
            return self._met(self._instant(fit))
        found = problem.evaluate(point, {"q": value})
        parts = [
            f[0].reshape(len(f[0]), -1)[rows] for f, rows in zip(found, self.rows, strict=True)
        ]
        return np.asarray(np.nan_to_num(np.concatenate(parts)))

    def _instant(self, fit: Fit) -> Fit:
        """The fit without what looks at other samples."""
        kept = tuple(a for a in fit.model.effects if a.kind not in OVER_TIME)
        model = replace(fit.model, effects=kept)
        own = {p.name for p in model.parameters}
        return replace(fit, model=model, values={n: v for n, v in fit.values.items() if n in own})

    def seen(self, fit: Fit, linear: Linear) -> Seen:
        """What grids are laid over."""
        for known, seen in self.looked:
            if known is fit:
                return seen
        self.looked.append((fit, self._seen(fit, linear)))
        del self.looked[:-REMEMBERED]
        return self.looked[-1][1]

    def _seen(self, fit: Fit, linear: Linear) -> Seen:
        problem, point = self._problem(fit)
        shift = self._shift(fit)
        push = -linear.residual
        if shift is not None:
            push = np.einsum("nmq,nm->nq", shift[1], linear.residual)
        reading = None
        if fit.model.traced.predicted is not None and not problem.sequential:
            found = problem.evaluate(point, {"p": fit.model.traced.predicted})
            reading = np.concatenate(
                [f[0][:, :, 0][rows] for f, rows in zip(found, self.rows, strict=True)]
            )
        times = [run.time for run in self.runs]
        time = None
        if all(t is not None for t in times):
            time = np.concatenate(
                [np.asarray(t)[rows] for t, rows in zip(times, self.rows, strict=True)]
            )
        return Seen(push, reading, time, linear)

    def found(self, fit: Fit) -> tuple[list[Candidate], list[Skipped]]:
        """What could be missing, and what does not apply here."""
        for model, found in self.remembered:
            if model is fit.model:
                return found
        catalogue = [e for e in self.catalogue if self._in_time or e.kind not in OVER_TIME]
        self.remembered.append((fit.model, candidates(fit.model, self.runs, catalogue)))
        del self.remembered[:-REMEMBERED]
        return self.remembered[-1][1]

    @cached_property
    def _in_time(self) -> bool:
        """Do samples follow each other? In poses each begins anew, and nothing comes late."""
        blocks = sum(len(np.unique(run.block)) for run in self.runs)
        return sum(map(len, self.runs)) >= LONGEST_POSE * blocks

    def trials(self, fit: Fit) -> list[Trial]:
        """Every candidate in its columns, over its grid."""
        for known, trials in self.shown_in:
            if known is fit:
                return trials
        seen = self.seen(fit, self.linear(fit))
        expanded = [
            c for one in self.found(fit)[0] for c in on_grid(one, seen, self._likely(fit, one))
        ]
        self.shown_in.append((fit, self.trials_of(fit, expanded)))
        del self.shown_in[:-1]
        return self.shown_in[-1][1]

    def _likely(self, fit: Fit, candidate: Candidate) -> float:
        """A lag that two records show by how lively each of them is."""
        if candidate.effect is None or candidate.effect.kind != "time":
            return 0.0
        name, measured = candidate.on, fit.model.traced.measured
        rotation = any(s.name == name and s.kind == "rotation" for s in fit.model.signals)
        return likely_lag(self.runs, measured or "", name, within=True, rotation=rotation)

    def shown(self, fit: Fit) -> list[Trial]:
        """Long lags that the records show by themselves: a slope does not reach as far."""
        times = [run.time for run in self.runs if run.time is not None and len(run) > 1]
        step = float(np.median(np.diff(times[0]))) if times else np.inf
        found = []
        for candidate in self.found(fit)[0]:
            lag = self._likely(fit, candidate)
            if abs(lag) > 2 * step:
                found.append(replace(candidate, held=(("delay", lag),), trials=len(times[0])))
        return self.trials_of(fit, found)

    def trials_of(self, fit: Fit, several: Sequence[Candidate]) -> list[Trial]:
        """These candidates in their columns, without those that have none here."""
        problem, point = self._problem(fit)
        found = []
        for candidate, columns in slopes(problem, point, several, self.rows):
            if isinstance(columns, CasestError):
                continue
            axes = self._axes(fit, candidate, columns.shape[2])
            describes = _describes(candidate) and not self.asked(candidate)
            family, trials = candidate.label, candidate.trials
            found.append(Trial(candidate, family, columns, trials, axes, describes))
        return found

    def _axes(self, fit: Fit, candidate: Candidate, count: int) -> Index | None:
        own = candidate.parameters(candidate.traced_on(fit.model))
        size = axes_of(own)
        return np.tile(np.arange(size), len(own)) if size > 1 and size * len(own) == count else None

    def nearer(self, fit: Fit, trial: Trial, scale: float) -> list[Trial]:
        """Values of a grid around the trial's."""
        if not trial.what.held:
            return []
        around = nearer(trial.what, self.seen(fit, self.linear(fit)), scale)
        return self.trials_of(fit, around)

    def on_axes(self, fit: Fit, trial: Trial, axes: Sequence[int]) -> Trial:
        """The trial on some of its axes."""
        candidate: Candidate = trial.what
        assert candidate.effect is not None
        assert trial.axes is not None
        less = replace(candidate, effect=restricted(candidate.effect, axes, fit.model), traced=None)
        own = np.isin(trial.axes, list(axes))
        return replace(trial, what=less, columns=trial.columns[:, :, own], axes=None)

    def refit(self, fit: Fit, added: Sequence[Trial]) -> Fit | str:
        """The fit with these effects, from their first-order sizes, if it can be trusted."""
        try:
            first = [t.what.free() if _is_lag(t.what) else t.what for t in added]
            found = self._with(fit, first, fit.values)
            if found is not None and any(t.what.free() is not t.what for t in added):
                # From the sizes at the value of the grid: at nothing, no slope tells a frequency.
                found = self._with(fit, [t.what.free() for t in added], found.values)
            plain = [_plain(t.what) for t in added]
            if found is not None and any(p is not None for p in plain):
                simple = [p or t.what.free() for p, t in zip(plain, added, strict=True)]
                found = _simpler(found, self._with(fit, simple, fit.values))
        except (CasestError, np.linalg.LinAlgError) as error:
            return f"its refit fails: {error}"
        return "its refit fails: the residual is not finite" if found is None else found

    def _with(
        self, fit: Fit, added: Sequence[Candidate], values: Mapping[str, Array]
    ) -> Fit | None:
        model = fit.model
        for candidate in added:
            model = candidate.added_to(model)
        own = {p.name for p in model.parameters}
        begun = {n: v for n, v in values.items() if n in own}
        return self.fitted(model, {**self._nulls(model, begun), **begun})

    def gain(self, fit: Fit, better: Fit, evidence: Evidence) -> float:
        """2 log of the likelihood of a refit over that of the fit, each with a noise of its own."""
        refit = Likelihood(self.linear(better)).beside(start=evidence.explained.spectrum)
        return evidence.gain + evidence.explained.cost - refit.cost

    def rise(self, less: Fit, fit: Fit) -> float:
        """2 log of the likelihood of a fit over that of one with less in it."""
        costs = [Likelihood(self.linear(f)).beside().cost for f in (less, fit)]
        return costs[0] - costs[1]

    def certified(self, fit: Fit) -> Fit | str:
        """The fit, if the data determine it and it is at rest; or why it is refused.

        The last one is proved.
        """
        problem, _ = self._problem(fit)
        found = trust_region(problem, problem.point(fit.values), max_iterations=LONG)
        values = problem.values(found.point)
        why = undetermined(problem, values)
        normal = problem.normal(found.point)
        step = np.linalg.lstsq(normal.matrix, normal.gradient, rcond=1e-12)[0]
        length = float(np.sqrt(max(float(step @ normal.gradient), 0.0)))
        if not why and length > RESTLESS * fit.noise:
            why = "not a stationary point"
        return f"its fit is refused: {why}" if why else replace(fit, values=values)

    def _nulls(self, model: Model, values: Mapping[str, Array]) -> dict[str, Array]:
        problem = Problem(model, self.runs)
        start = problem.start()
        return {n: v for n, v in problem.values(start).items() if n not in values}

    def without(self, fit: Fit, what: Candidate) -> Fit | None:
        """The fit without an effect that was added."""
        if what.freed:
            return None
        own = fit.model.unknowns_of(what.label)
        left = tuple(a for a in fit.model.effects if a.label != what.label)
        values = {n: v for n, v in fit.values.items() if n not in own}
        return self.fitted(replace(fit.model, effects=left), values)

    def wider(self, fit: Fit, what: Candidate) -> tuple[Candidate, Fit] | None:
        """An effect that was added on some axes only, and the fit with it on all of them."""
        base = self.without(fit, what)
        if base is None or what.effect is None:
            return None
        whole = next((c for c in self.found(base)[0] if c.label == what.label), None)
        if whole is None or what.parameters(fit.model) == whole.parameters(
            whole.traced_on(base.model)
        ):
            return None
        whole = replace(whole, held=what.held, trials=what.trials)
        found = self.refit(base, [Trial(whole, whole.label, np.zeros((0, 0, 0)))])
        return None if isinstance(found, str) else (whole, found)

    def apart(self, fit: Fit, kept: Kept) -> tuple[Linear, Trial] | None:
        """The linear problem as if an effect were not there, and the effect as a trial of it."""
        what: Candidate = kept.what
        problem, _ = self._problem(fit)
        names = {p.name for p in what.parameters(fit.model)}
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
        own = fit.model.unknowns_of(what.label)
        if what.freed:
            model = fit.model.having(**{what.freed: float(self.model[what.freed].array)})
            own = {what.freed}
        else:
            left = tuple(a for a in fit.model.effects if a.label != what.label)
            model = replace(fit.model, effects=left)
        values = {n: v for n, v in fit.values.items() if n not in own}
        problem = Problem(model, self.runs)
        residuals = problem.residuals(problem.point(values))
        weights = self._problem(fit)[0].weights
        if weights is not None:
            residuals = tuple(r * np.sqrt(w) for r, w in zip(residuals, weights, strict=True))
        return np.concatenate([r[rows] for r, rows in zip(residuals, self.rows, strict=True)])

    def asked(self, what: Candidate) -> bool:
        """Is it the user's own, or named as there?"""
        if what.effect is None:
            return what.freed in self.known
        return what.among(self.known) or what.name in self._own

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
            reasons = [s.reason for s in skipped if name in (s.name, s.name.partition("(")[0])]
            why = reasons[0] if reasons else "the data have no column that it could follow"
            absent.append(Skipped(name, why))
        return silent, absent

    def final(self, fit: Fit, what: Candidate) -> Candidate:
        """The candidate as it stands in the model."""
        attached = next((a for a in fit.model.effects if a.label == what.label), None)
        if attached is None:
            return what
        made = attached.effect
        if what.label == NAME:
            own = {p.name.rpartition(".")[2]: p.name for p in attached.parameters}
            made = with_sizes(made, {k: float(fit.values[n]) for k, n in own.items()})
        return replace(what, effect=made, held=(), traced=None)

    def moved_by(self, fit: Fit, rival: Rival) -> dict[str, Array]:
        """How far the declared parameters would move, were a rival there instead."""
        other: Fit = rival.fit
        return {n: other.values[n] - v for n, v in fit.values.items() if n in other.values}

    def label(self, what: Candidate) -> str:
        """Name and column."""
        return what.label

    def formula(self, fit: Fit, ranking: Ranking) -> Evidence | None:
        """The best description; None where there is one, or nothing to be added to."""
        problem, point = self._problem(fit)
        found = self._shift(fit)
        if found is None or problem.sequential or any(a.label == NAME for a in fit.model.effects):
            return None
        on, slope = found
        read = readable(problem, point, slope, on, self.rows)
        return described(read, ranking.likelihood, ranking.none, ranking.families)

    def _shift(self, fit: Fit) -> tuple[str, Array] | None:
        """What the sensor gives, and the residual's slope (N, m, axes) in a shift of it."""
        problem, point = self._problem(fit)
        try:
            probe = Candidate(placed_in(_shift, fit.model))
        except CasestError:
            return None
        ((_, slope),) = slopes(problem, point, [probe], self.rows)
        return None if isinstance(slope, CasestError) else (probe.on, slope)


def _is_lag(candidate: Candidate) -> bool:
    """Is it nothing but a time, which cannot be held?"""
    return candidate.effect is not None and candidate.effect.kind == "time"


def _describes(candidate: Candidate) -> bool:
    """Is it a course of unknown cause?"""
    return candidate.effect is not None and candidate.effect.describes


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


def _simpler(full: Fit, plain: Fit | None) -> Fit:
    """The one that is worth more by Schwarz's criterion."""
    if plain is None:
        return full
    n = sum(r.size for r in full.residuals)
    worth = [
        n * np.log(sum(float(np.sum(r**2)) for r in f.residuals)) + f.unknowns * np.log(n)
        for f in (full, plain)
    ]
    return plain if worth[1] < worth[0] else full
