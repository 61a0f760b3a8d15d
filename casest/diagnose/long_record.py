"""The loop over a record that need not fit in memory: searched in some samples, judged by all.

Which causes there are, the loop asks evenly chosen samples of a long record, which hold the rows
that it looks at in any case. What they say is fitted to the whole, and judged there by sums over
pieces, added in the order of the record: held-out squares, and the score of every other cause
(C. R. Rao, 1948), whose scatter from piece to piece is that of the noise, whatever its colour.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casest.data.run import Run
from casest.declaration.effect import OVER_TIME, TAILS, Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose import loop
from casest.diagnose.candidates.candidates import Skipped
from casest.diagnose.closing import Closing
from casest.diagnose.evidence.held_out import standard_errors
from casest.diagnose.found import Found, Undecided
from casest.diagnose.levels import LEVELS
from casest.diagnose.record_scores import Score, scores
from casest.diagnose.sensor import Sensor
from casest.effects import CATALOGUE
from casest.effects.placing import with_columns
from casest.engine.threads import one_thread
from casest.errors import NotTrusted
from casest.estimate.calibrate import attempt
from casest.estimate.estimate import Estimate
from casest.leastsquares.problem import Problem

#: Samples that causes are looked for in, at most.
SEARCHED = 100_000
#: Why some effects are not tried where not every sample is looked at.
NEIGHBOURS = "it looks at neighbouring samples, of which one in {} is looked at; close a stretch"
WEIGHTS = "it weighs every residual by itself, for which a long record has no room"
#: Why a cause that was found is not kept.
NOT_CONFIRMED = "held-out parts of the whole record do not confirm it"


@dataclass(frozen=True)
class Errors:
    """Of one fit to the whole: root mean squares, fitted and held out, and those by axis (m,).

    `pieces` (P,) are the held-out squares of each piece of the record.
    """

    fit: float
    held_out: float
    by_axis: Array
    pieces: Array


@dataclass(frozen=True)
class LongClosing:
    """A closing whose estimates are of the whole record, and whose runs are the samples that were
    looked at, one in `every`; errors of the whole, where that is more; scores of other causes."""

    closing: Closing
    every: int
    before: Errors | None
    after: Errors | None
    scores: tuple[Score, ...]


def close_long(
    model: Model,
    run: Run,
    *,
    catalogue: Sequence[Effect] = CATALOGUE,
    start: Mapping[str, Any] | None = None,
    known: Collection[str] = (),
    seed: int = 0,
    say: Callable[[str], None] = lambda _: None,
) -> LongClosing:
    """Close the loop over one long record, in memory that does not grow with it.

    A record of SEARCHED samples at most is closed as any other. Raises NotTrusted as `loop.close`.
    """
    whole, every = with_columns([run])[0], spacing(len(run))
    few = looked_at(whole, every)
    tried, skipped = _tried(catalogue, every)
    before = None if every == 1 else attempt(model, [run], start=start, seed=seed)
    if before is not None and before.certificate.trusted:
        start = before.values
    try:
        found = loop.close(
            model, [few], catalogue=tried, start=start, known=known, seed=seed, say=say
        )
    except NotTrusted as error:
        error.estimate = error.estimate if before is None else before
        raise
    if before is not None:
        say("fitting what was found to the whole record")
        found = _of_the_whole(found, before, whole, seed, skipped)
    say("asking the whole record")
    with np.errstate(all="ignore"), one_thread():
        return _judged(found, whole, every, known, tried, seed)


def spacing(count: int) -> int:
    """One sample in so many is looked at; the rows of the loop are among them."""
    rows = -(-count // LEVELS.rows)
    even = (k for k in range(1, rows) if rows % k == 0 and count <= k * SEARCHED)
    return next(even, rows)


def looked_at(run: Run, every: int) -> Run:
    """One sample in so many, in memory, as a record of its own."""
    found = run.take(slice(None, None, every))
    signals = {name: np.array(v) for name, v in found.signals.items()}
    columns: Any = {name: np.array(v) for name, v in found.columns.items()}
    time = None if found.time is None else np.array(found.time)
    block = np.array(found.block)
    return replace(found, signals=signals, columns=columns, time=time, block=block,
                   whole=None, places=None)  # fmt: skip


def _tried(
    catalogue: Sequence[Effect], every: int
) -> tuple[tuple[Effect, ...], tuple[Skipped, ...]]:
    """What can be asked where one sample in so many is looked at, and what cannot."""
    if every == 1:
        return tuple(catalogue), ()
    over = [e for e in catalogue if e.kind in OVER_TIME]
    tails = [e for e in catalogue if e.seen_in == TAILS]
    skipped = [Skipped(e.name, NEIGHBOURS.format(every)) for e in over]
    skipped += [Skipped(e.name, WEIGHTS) for e in tails]
    return tuple(e for e in catalogue if e not in over + tails), tuple(skipped)


def _of_the_whole(
    found: Closing, before: Estimate, whole: Run, seed: int, skipped: tuple[Skipped, ...]
) -> Closing:
    """The closing with estimates of the whole record."""
    found = replace(found, skipped=(*skipped, *found.skipped))
    if found.after.model is found.before.model:
        return replace(found, before=before, after=before)
    after = attempt(found.after.model, [whole], start=found.after.values, seed=seed)
    if after.certificate.trusted:
        return replace(found, before=before, after=after)
    why = f"its fit to the whole record is refused: {after.certificate.reasons[0]}"
    return _without_effects(replace(found, before=before), why)


def _without_effects(found: Closing, why: str) -> Closing:
    """The declared model: what was found in some samples is not in all of them."""
    refused = tuple(Skipped(f.candidate.label, why) for f in found.effects)
    return replace(found, after=found.before, after_held_out=found.before_held_out, effects=(),
                   refused=(*refused, *found.refused))  # fmt: skip


def _judged(
    found: Closing,
    whole: Run,
    every: int,
    known: Collection[str],
    catalogue: Sequence[Effect],
    seed: int,
) -> LongClosing:
    """With errors of the whole record, and the scores of what is not in the model."""
    sensor = Sensor(found.before.model, found.runs, tuple(catalogue), frozenset(known), seed)
    if every == 1:
        return LongClosing(found, every, None, None, tuple(scores(sensor, found.after, whole)))
    before = after = held_out(found.before, whole, seed)
    if found.effects:
        after = held_out(found.after, whole, seed)
        if not _confirmed(before, after):
            found, after = _without_effects(found, NOT_CONFIRMED), before
    every_score = scores(sensor, found.after, whole)
    if not found.effects and found.undecided is None:
        added = _with_what_all_show(found, every_score, whole, seed)
        better = held_out(added.after, whole, seed) if added is not found else before
        if _confirmed(before, better):
            found, after = added, better
            every_score = scores(sensor, found.after, whole)
    return LongClosing(_open(found, every_score), every, before, after, tuple(every_score))


def _confirmed(before: Errors, after: Errors) -> bool:
    """Are pieces foretold better, from piece to piece?"""
    return standard_errors(before.pieces - after.pieces) > LEVELS.confirmed


def _with_what_all_show(
    found: Closing, every_score: Sequence[Score], whole: Run, seed: int
) -> Closing:
    """With the cause that leads clearly, if there is one and its fit is trusted."""
    strong = sorted((s for s in every_score if s.chance < LEVELS.misfit), key=lambda s: -s.lead)
    if not strong or any(s.lead > strong[0].lead - LEVELS.clear for s in strong[1:]):
        return found
    what = strong[0].what.free()
    model = what.added_to(found.before.model)
    after = attempt(model, [whole], start=found.before.values, seed=seed)
    if not after.certificate.trusted:
        why = f"its fit to the whole record is refused: {after.certificate.reasons[0]}"
        return replace(found, refused=(Skipped(what.label, why), *found.refused))
    gain = strong[0].share * found.before.noise.sigma**2
    names = tuple(p.name for p in what.parameters(model))
    effect = Found(what, strong[0].chance, float(gain), names)
    return replace(found, after=after, effects=(effect,))


def _open(found: Closing, every_score: Sequence[Score]) -> Closing:
    """What all samples show and is not in the model: that something is missing is certain, which
    cause it is is not."""
    strong = sorted((s for s in every_score if s.chance < LEVELS.misfit), key=lambda s: -s.lead)
    if not strong or found.undecided is not None:
        return found
    near = [s for s in strong if s.lead > strong[0].lead - LEVELS.clear]
    names = tuple(s.label for s in near[: LEVELS.contenders])
    return replace(found, undecided=Undecided(names, near[0].share))


# -- held out --------------------------------------------------------------------------------------


def held_out(estimate: Estimate, whole: Run, seed: int = 0) -> Errors:
    """Errors of a fit to the whole; each piece foretold by the other folds, to which the fit is
    moved by one step of Gauss and Newton: it is near, and what it misses is of second order."""
    problem = Problem(estimate.model, (whole,))
    point = problem.point(estimate.values)
    pieces = [Problem(estimate.model, (own,)) for own in _pieces(whole)]
    folds = _folds(len(pieces), seed)
    own = [piece.of_runs(point) for piece in pieces]
    total, free = problem.normal(point), _free(estimate)
    fitted, squares = 0.0, np.zeros((len(pieces), len(estimate.model.axes)))
    for fold in range(LEVELS.refits):
        chosen = np.flatnonzero(folds == fold)
        matrix = total.matrix - sum(own[k].matrix for k in chosen)
        slope = total.gradient - sum(own[k].gradient for k in chosen)
        moved = problem.moved(point, _step(matrix, slope, free))
        for k in chosen:
            fitted += 2 * own[k].cost
            for _, _, residual in pieces[k].residual_blocks(moved):
                squares[k] += np.sum(residual**2, axis=0)
    count = len(whole)
    return Errors(
        float(np.sqrt(fitted / (count * squares.shape[1]))),
        float(np.sqrt(squares.sum() / (count * squares.shape[1]))),
        np.sqrt(squares.sum(axis=0) / count),
        squares.sum(axis=1),
    )


def _free(estimate: Estimate) -> Array:
    """Which unknowns are on no bound."""
    lower, upper = estimate.problem.bounds
    x = estimate.point.x
    return np.asarray((x > lower) & (x < upper))


def _step(matrix: Array, slope: Array, free: Array) -> Array:
    """To the minimum of the others' squares."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    own = np.ix_(free, free)
    scaled = (matrix / np.outer(size, size))[own]
    step = np.zeros(len(slope))
    step[free] = -np.linalg.lstsq(scaled, (slope / size)[free], rcond=1e-12)[0] / size[free]
    return step


def _folds(pieces: int, seed: int) -> NDArray[np.int_]:
    """The fold of each piece: every one of them once in each group of neighbours."""
    rng = np.random.default_rng(seed)
    order = [rng.permutation(LEVELS.refits) for _ in range(-(-pieces // LEVELS.refits))]
    return np.concatenate(order)[:pieces]


def _pieces(run: Run) -> Iterator[Run]:
    """The stretches of a record that are held out, as views."""
    edges = np.arange(LEVELS.pieces + 1) * len(run) // LEVELS.pieces
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        signals = {name: values[a:b] for name, values in run.signals.items()}
        time = None if run.time is None else run.time[a:b]
        yield Run.raw(run.name, signals, units=run.units, time=time, file=run.file)
