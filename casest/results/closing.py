"""What a closed loop leaves: `result.json` and `residuals.csv` in their fixed form."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import asdict, replace

from casest.declaration.effect import Attached
from casest.declaration.shapes import Array
from casest.diagnose.closing import Closing
from casest.diagnose.cross_validation import rms
from casest.diagnose.detectability import (
    beyond_their_ends,
    detectable,
    inputs_that_may_be_noisy,
    invisible,
    noise_of_inputs_in,
)
from casest.diagnose.formula.terms import source
from casest.diagnose.found import Found
from casest.diagnose.levels import LEVELS
from casest.estimate.estimate import Estimate
from casest.estimate.held_out import ALONE, happened_once, times_worse
from casest.leastsquares.kinds import noises, whitened
from casest.leastsquares.problem import Problem
from casest.results.application import formula_of
from casest.results.file import plain
from casest.results.fitted import (
    Fitted,
    JudgedSection,
    NoiseModel,
    attachment,
    correlation_of,
    fitted_content,
    noise_of,
)
from casest.results.residuals import Residuals, residuals_of, side_of
from casest.results.result import Certificate, Explained, Number, Numbers, Parameter
from casest.results.uncertainty import covariance_of, freedom_of, inputs_of
from casest.results.units import resolved, unit_table
from casest.results.values import parameter_table

#: Largest shift of each declared parameter.
Shifts = dict[str, float]


class Effect(Struct, frozen=True, kw_only=True):
    """An effect that was added, with the evidence.

    `columns`, `numbers` and `file` are there where it can be attached again.
    """

    name: str
    on: str | None
    column: str | None
    parameters: dict[str, Parameter]
    p_value: Number
    holdout_gain: Number
    formula: str
    indistinguishable_from: list[str]
    less_likely: list[str]
    would_separate: list[str]
    instead_would_move: dict[str, Shifts]
    columns: dict[str, str] | UnsetType = UNSET
    numbers: dict[str, float] | UnsetType = UNSET
    file: str | UnsetType = UNSET
    sha256: str | UnsetType = UNSET


class Hidden(Struct, frozen=True):
    """An effect that these data cannot show, and what a typical size of it would do unseen."""

    name: str
    column: str | None
    typical: dict[str, float]
    units: dict[str, str]
    would_move: Shifts
    share_left: Number
    shown_by: str


class Unexplained(Struct, frozen=True):
    """What is left: share of the held-out variance, where; causes of which none was added.

    `described_by`: effects that a slow course looks like, and that name no cause; `in_rows`: the
    few rows that most of it is in, in words; `at_ends`: of what they are the outermost; `share`: of
    the held-out variance, that `one_of` explain, null where there are none.
    """

    fraction: Number
    where: str
    one_of: list[str]
    would_move: dict[str, Shifts]
    would_separate: list[str]
    described_by: list[str] = []
    in_rows: str = ""
    at_ends: str = ""
    share: Number = None


class Detectable(Struct, frozen=True):
    """The smallest size of an effect's parameter that would nearly always have been found."""

    name: str
    parameter: str
    size: Number
    unit: str


class WholeScore(Struct, frozen=True):
    """What a whole record says of a cause that was not added: the chance of as much in noise, the
    share of the squares that it would take away, its sizes to first order."""

    name: str
    p_value: Number
    share: Number
    parameters: dict[str, Number]
    std: dict[str, Number]


class WholeRecord(Struct, frozen=True):
    """Of a record that need not fit in memory: its samples, and one in how many was looked at."""

    samples: int
    looked_at_every: int
    scores: list[WholeScore]


class Closed(Fitted, frozen=True, kw_only=True, dict=True):
    """The content of `result.json` of `close`.

    `holdout`: the files of another record that held-out errors are those of, where one was given;
    `holdout_over_fit`: how many times those of the fit they are, where that is no chance.
    Beside the file: `docs`, what each added effect says of itself; `closing`, what the loop left.
    """

    unwritten = (*Fitted.unwritten, "docs", "closing")

    noise: NoiseModel
    before: JudgedSection
    after: JudgedSection
    effects: list[Effect]
    invisible: list[Hidden]
    unexplained: Unexplained
    moved: dict[str, Numbers]
    smallest_detectable: list[Detectable]
    refused: list[Explained]
    not_tried: list[Explained]
    whole_record: WholeRecord | UnsetType = UNSET
    holdout: list[str] | UnsetType = UNSET
    holdout_over_fit: float | UnsetType = UNSET
    docs: dict[str, str]
    closing: Closing

    @cached_property
    def residuals(self) -> Residuals:
        """What is drawn of the residuals: before and after, or of one fit if nothing was added."""
        closing, runs = self.closing, self.closing.runs
        fits = [("before", "before", closing.before), ("after", "after", closing.after)]
        if not closing.effects:
            fits = [("residual", "after", closing.after)]
        sides = [side_of(*fit, _judged_alike(fit[2], closing)) for fit in fits]
        return residuals_of(sides, closing.after, runs, noise_of(self.noise))


def closing_result(
    closing: Closing,
    *,
    model_name: str,
    data: Sequence[str],
    command: str = "",
    held_out: tuple[Sequence[Array], Sequence[Array]] | None = None,
    apart: Sequence[str] = (),
) -> Closed:
    """What `close` leaves: see the design, 10.

    `held_out` are residuals before and after on a record of its own, in the files `apart`; else the
    cross-fitted ones.
    """
    left, shared = closing.misfit, fitted_content(closing.after, model_name, data, command)
    units: dict[str, str] = shared["units"]
    before, after = held_out or (closing.before_held_out, closing.after_held_out)
    fitted = _section(closing.after, closing, after)
    averaged = closing.averaged if inputs_that_may_be_noisy(closing) else 0.0
    shared["noise"] = NoiseModel(**asdict(shared["noise"]), **left.noise, of_inputs=averaged)
    shared["notes"] += [*beyond_their_ends(closing), *noise_of_inputs_in(closing)]
    if held_out and (once := happened_once(closing.after)):
        shared["notes"].append(f"{', '.join(once)}: {ALONE}")
    worse = times_worse(closing.after, after) if held_out else None
    return Closed(
        **shared,
        holdout_over_fit=UNSET if worse is None else worse,
        verdict=closing.verdict,
        before=_section(closing.before, closing, before),
        after=replace(
            fitted,
            correlation=correlation_of(closing.after),
            covariance=covariance_of(closing.after),
            inputs=inputs_of(closing.after),
            degrees_of_freedom=freedom_of(closing.after),
        ),
        effects=[_effect(f, closing) for f in closing.effects],
        invisible=_invisible(closing, units),
        unexplained=_unexplained(closing),
        misfit=None,
        moved=_moved(closing),
        smallest_detectable=[
            Detectable(d.name, d.parameter, plain(d.size), resolved(d.unit, units))
            for d in detectable(closing)
        ],
        refused=[Explained(s.name, s.reason) for s in closing.refused],
        not_tried=[Explained(s.name, s.reason) for s in closing.skipped],
        holdout=list(apart) or UNSET,
        docs={f.candidate.name: getattr(f.candidate.effect, "doc", "") for f in closing.effects},
        closing=closing,
    )


def _invisible(closing: Closing, units: Mapping[str, str]) -> list[Hidden]:
    return [
        Hidden(
            name=i.name,
            column=i.column,
            typical={k: plain(v) for k, v in i.typical.items()},
            units={k: resolved(u, units) for k, u in i.units.items()},
            would_move={k: plain(v) for k, v in i.would_move.items()},
            share_left=plain(i.share),
            shown_by=i.shown_by,
        )
        for i in invisible(closing)
    ]


def _judged_alike(estimate: Estimate, closing: Closing) -> Problem:
    """Its problem; where residuals are counted in deviations, in those that are left at last."""
    model = estimate.model.having(**noises(closing.after.model))
    return whitened(Problem(model, closing.runs), estimate.point)


def _section(estimate: Estimate, closing: Closing, held_out: Sequence[Array]) -> JudgedSection:
    residuals = _judged_alike(estimate, closing).told_residuals(estimate.point)
    axes, certificate = estimate.model.axes, estimate.certificate
    return JudgedSection(
        rmse_fit=plain(rms(residuals)),
        rmse_holdout=plain(rms(held_out)),
        rmse_holdout_by_axis={
            axis: plain(rms([r[:, [k]] for r in held_out])) for k, axis in enumerate(axes)
        },
        certificate=Certificate(certificate.trusted, list(certificate.reasons)),
        parameters=parameter_table(estimate, unit_table(estimate.model, closing.runs)),
    )


def _effect(found: Found, closing: Closing) -> Effect:
    table = unit_table(closing.after.model, closing.runs)
    everything = parameter_table(closing.after, table)
    candidate, attached, alike = found.candidate, _attached(found, closing), _alike(found, closing)
    effect = Effect(
        name=candidate.name,
        on=candidate.on,
        column=candidate.column,
        parameters={n.removeprefix(candidate.label + "."): everything[n] for n in found.names},
        p_value=plain(found.p_value),
        holdout_gain=plain(found.gain),
        formula=_formula(found, attached),
        indistinguishable_from=alike[: LEVELS.nearest],
        less_likely=alike[LEVELS.nearest :],
        would_separate=_measurements(alike[: LEVELS.nearest], closing),
        instead_would_move={
            label: _shifts(found.rivals[label], closing) for label in alike[: LEVELS.nearest]
        },
    )
    return effect if attached is None else replace(effect, **asdict(attachment(attached)))


def _unexplained(closing: Closing) -> Unexplained:
    """What is left, and causes of which none was added: the parameters hang on which it is."""
    left = closing.undecided if closing.undecided and closing.undecided.explains else None
    names = left.names if left else ()
    moves = left.moves if left else {}
    return Unexplained(
        plain(np.nan if closing.verdict is None else closing.misfit.fraction),
        closing.misfit.where,
        list(names),
        {label: _shifts(moves[label], closing) for label in names if label in moves},
        _measurements(names, closing) if len(names) > 1 else [],
        list(closing.misfit.described),
        closing.misfit.rows,
        closing.misfit.ends,
        plain(left.share) if left else None,
    )


def _alike(found: Found, closing: Closing) -> list[str]:
    """What explains the data as well, but for what has been added beside it since."""
    added = {f.candidate.label for f in closing.effects}
    return [label for label in found.indistinguishable_from if label not in added]


def _shifts(rival: Mapping[str, Array], closing: Closing) -> Shifts:
    """Largest shift of each declared parameter that is more than its standard deviation."""
    found = {}
    for name, shift in rival.items():
        if name in closing.after.std and np.any(np.abs(shift) > closing.after.std[name]):
            found[name] = plain(np.max(np.abs(shift)))
    return found


def _attached(found: Found, closing: Closing) -> Attached | None:
    labels = {a.label: a for a in closing.after.model.effects}
    return labels.get(found.candidate.label)


def _formula(found: Found, attached: Attached | None) -> str:
    """What the effect does, with the name of its column."""
    if attached is None:
        effect = found.candidate.effect
        return effect.formula if effect else f"{found.candidate.freed} is an unknown"
    return formula_of(attached)


def _measurements(labels: Sequence[str], closing: Closing) -> list[str]:
    """What would show each of these effects."""
    by_label = {s.candidate.label: s.candidate for s in closing.visible}
    said = []
    for label in labels:
        other = by_label.get(label)
        if other is not None and other.effect is not None and other.effect.shown_by:
            said.append(f"{label}: {other.effect.shown_by}")
    return said


def _moved(closing: Closing) -> dict[str, Any]:
    """How far each declared parameter moved, in its own standard deviations before."""
    moved = {}
    for name, value in closing.before.values.items():
        if name in closing.after.values:
            with np.errstate(all="ignore"):
                z = (closing.after.values[name] - value) / closing.before.std[name]
            moved[name] = plain(np.where(np.isfinite(z), z, np.nan))
    return moved


# -- files -----------------------------------------------------------------------------------------


def formula_source(closing: Closing) -> str:
    """Python text of the formula that was found, for `--effects`; empty where there is none."""
    return "".join(source(a.effect) for a in closing.after.model.effects)


def with_formula_in(result: Closed, path: Path, source: str) -> Closed:
    """The result that says where the formula's source will be, with the digest of its text."""
    file, sha256 = str(path.resolve()), hashlib.sha256(source.encode()).hexdigest()
    written = [bool(getattr(f.candidate.effect, "source", "")) for f in result.closing.effects]
    effects = [
        replace(e, file=file, sha256=sha256) if own else e
        for e, own in zip(result.effects, written, strict=True)
    ]
    return replace(result, effects=effects)


def residual_rows(
    closing: Closing,
    held_out: tuple[Sequence[Any], Sequence[Array], Sequence[Array]] | None = None,
) -> str:
    """`residuals.csv`: `fit` rows from the fit to everything, `holdout` rows cross-fitted.

    `held_out`: runs, residuals before and after of a record of its own, in place of the latter.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["file", "run", "row", "t", "axis", "split", "before", "after"])
    axes = closing.before.model.axes
    fits = [
        _judged_alike(e, closing).told_residuals(e.point) for e in (closing.before, closing.after)
    ]
    hidden = held_out or (closing.runs, closing.before_held_out, closing.after_held_out)
    for split, runs, before, after in (("fit", closing.runs, *fits), ("holdout", *hidden)):
        for run, b, a in zip(runs, before, after, strict=True):
            for k in range(len(run)):
                t = "" if run.time is None else repr(float(run.time[k]))
                for j, axis in enumerate(axes):
                    pair = repr(float(b[k, j])), repr(float(a[k, j]))
                    row = [run.file, run.name, int(run.rows[k]), t, axis, split, *pair]
                    writer.writerow(row)
    return text.getvalue()
