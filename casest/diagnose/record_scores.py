"""What the whole of a long record says of every cause beside a fit: scores, by sums over pieces.

The score of a cause (C. R. Rao, 1948) is the slope of the squares in its unknowns where it is
absent, as far as the declared unknowns cannot take its place. Hotelling's T² asks whether its mean
over the pieces of the record is zero, with the scatter that the pieces have, so that noise of any
colour that is short beside a piece is not taken for it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.effect import OVER_TIME
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.slopes import slope_of
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol.ranking import ranked
from casest.diagnose.sensor import Sensor
from casest.engine import Columns, Replay
from casest.engine.kernel import in_order
from casest.errors import CasestError
from casest.estimate.estimate import Estimate
from casest.fleet.common import Sums
from casest.leastsquares.problem import Point, Problem

#: Samples whose slopes in all causes are held at once.
PIECE = 4096


@dataclass(frozen=True)
class Score:
    """What the whole record says of a cause that is not in the model.

    lead: T² less what its unknowns cost (Schwarz); chance: of a score as large in noise, all causes
    counted; share: of the residual's squares that it would take away; sizes (q,) of its unknowns by
    name, to first order.
    """

    what: Candidate
    lead: float
    chance: float
    share: float
    names: tuple[str, ...]
    sizes: Array
    stds: Array

    @property
    def label(self) -> str:
        """Name and column."""
        return self.what.label


def scores(sensor: Sensor, estimate: Estimate, whole: Run) -> list[Score]:
    """What the whole says of every cause beside a fit, the least likely to be chance first.

    Each in the variant that the samples that were looked at prefer. What looks at neighbouring
    samples is left out.
    """
    fit = sensor.fitted(estimate.model, estimate.values)
    if fit is None or estimate.model.sequential:
        return []
    asked = []
    for evidence in ranked(sensor, fit).found:
        (trial,) = evidence.trials
        kind = trial.what.effect.kind if trial.what.effect is not None else "quantity"
        if kind not in (*OVER_TIME, "rate", "noise"):
            asked.append((trial.what, trial.variants))
    problem = Problem(estimate.model, (whole,))
    found = _scored(problem, problem.point(estimate.values), asked)
    return sorted(found, key=lambda s: (s.chance, -s.share))


def _scored(
    problem: Problem, point: Point, asked: Sequence[tuple[Candidate, float]]
) -> list[Score]:
    """Those that the unknowns leave something of."""
    slopes = _Slopes.of(problem.model, [what for what, _ in asked])
    placed = [(*a, s) for a, s in zip(asked, slopes.spans, strict=True) if s is not None]
    if not placed:
        return []
    sums, found = slopes.summed(problem, point), []
    for (what, variants, span), own in zip(placed, sums.own, strict=True):
        score = sums.score(span, own)
        if score is not None:
            statistic, chance = score[0].chance()
            chance = min(1.0, chance * variants * len(placed))
            cost = len(own) * np.log(problem.residual_count) + 2 * np.log(variants)
            size, covariance = score[0].size
            parameters = what.parameters(what.traced_on(problem.model))
            names = tuple(name for p in parameters for name in p.entry_names)
            stds = np.sqrt(np.diag(covariance))
            lead = statistic - float(cost)
            found.append(Score(what, lead, chance, score[1], names, size, stds))
    return found


@dataclass(frozen=True)
class _Slopes:
    """Residual, its slopes in the unknowns and in all causes, of one sample; where each cause's
    are among them."""

    replay: Replay
    signals: tuple[str, ...]
    unknowns: int
    spans: tuple[slice | None, ...]

    @classmethod
    def of(cls, model: Model, asked: Sequence[Candidate]) -> _Slopes:
        """Of these causes at nothing; those that do not apply have no span."""
        base, signals = model.traced, list(model.columns)
        symbols = {s.name: base.symbols[s.name] for s in signals}
        slopes, spans = [], list[slice | None]()
        place = base.coordinates.numel() + 1
        for what in asked:
            try:
                slope, _, more = slope_of(what, model, symbols)
            except CasestError:
                spans.append(None)
                continue
            signals += more
            slopes.append(slope)
            spans.append(slice(place, place + slope.shape[1]))
            place += slope.shape[1]
        J = ca.jacobian(base.expression, base.coordinates)
        both = ca.horzcat(J, base.expression, *slopes)
        sample = ca.vertcat(*[flat(symbols[s.name]) for s in signals])
        inputs = [ca.vertcat(base.coordinates, base.references), sample]
        replay = Replay(ca.Function("scores", inputs, [both], ["parameters", "sample"], ["A"]))
        return cls(replay, tuple(s.name for s in signals), J.shape[1], tuple(spans))

    def summed(self, problem: Problem, point: Point) -> _Sums:
        """Over the whole record, piece by piece, in its order."""
        parameters, (run,) = problem.parameters(point, 0), problem.runs
        samples = Columns([run.signals[name] for name in self.signals])
        edges = np.arange(LEVELS.pieces + 1) * len(run) // LEVELS.pieces
        pieces = [slice(a, b) for a, b in itertools.pairwise(edges.tolist()) if b > a]
        found = list(in_order(lambda span: self._of(parameters, samples[span]), pieces))
        pulls = np.stack([pull for pull, _, _ in found])
        return _Sums(
            self.unknowns,
            pulls,
            np.sum([beside for _, beside, _ in found], axis=0),
            [np.sum(parts, axis=0) for parts in zip(*[own for _, _, own in found], strict=True)],
        )

    def _of(self, parameters: Array, samples: Columns) -> tuple[Array, Array, list[Array]]:
        """Of one piece: Aᵀr (K,), JᵀA (n, K), and GᵀG of each cause."""
        row, column = self.replay.sparsity[0]
        n, K = self.unknowns, self.replay.shapes[0][1]
        pull, beside = np.zeros(K), np.zeros((n, K))
        spans = [span for span in self.spans if span is not None]
        own = [np.zeros((span.stop - span.start,) * 2) for span in spans]
        for axis in range(self.replay.shapes[0][0]):
            entries = np.flatnonzero(row == axis)
            columns = column[entries]
            plan = self.replay.plan([(0, int(k)) for k in entries])
            base, rest = np.flatnonzero(columns <= n), np.searchsorted(columns, n)
            within = [
                (k, slice(*np.searchsorted(columns, [span.start, span.stop])))
                for k, span in enumerate(spans)
            ]
            for _, values in plan.blocks(parameters, samples, PIECE):
                first = values[base] @ values.T
                beside[np.ix_(columns[base[:-1]], columns)] += first[:-1]
                pull[columns] += first[rest]
                for k, place in within:
                    part, there = values[place], columns[place] - spans[k].start
                    own[k][np.ix_(there, there)] += part @ part.T
        return pull, beside, own


@dataclass(frozen=True)
class _Sums:
    """Over the record: `pulls` (P, K) of Aᵀr piece by piece, JᵀA (n, K), GᵀG of each cause, where
    A = [J r G]."""

    unknowns: int
    pulls: Array
    beside: Array
    own: list[Array]

    def score(self, span: slice, own: Array) -> tuple[Sums, float] | None:
        """Of the cause in these columns, beside the unknowns; and the share of the squares that it
        takes away. None where the unknowns do all that it does."""
        n = self.unknowns
        JJ, JG = self.beside[:, :n], self.beside[:, span]
        size = np.sqrt(np.maximum(np.diag(JJ), 1e-300))
        solved = np.linalg.lstsq(JJ / np.outer(size, size), JG / size[:, None], rcond=1e-12)[0]
        absorbed = solved / size[:, None]
        information = own - JG.T @ absorbed
        if not np.all(np.diag(information) > LEVELS.survives**2 * np.diag(own)):
            return None
        pulls = -(self.pulls[:, span] - self.pulls[:, :n] @ absorbed)
        sums = Sums(len(pulls), pulls.sum(axis=0), pulls.T @ pulls, information)
        gain = float(sums.score @ sums.size[0])
        return sums, gain / max(float(self.pulls[:, n].sum()), 1e-300)
