"""What a closed loop over a long record leaves: errors of all its samples, and scores there."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from casest.diagnose.long_record import Errors, LongClosing
from casest.diagnose.record_scores import Score
from casest.results.closing import Closed, WholeRecord, WholeScore, closing_result
from casest.results.file import plain
from casest.results.fitted import JudgedSection


def long_closing_result(
    found: LongClosing, *, model_name: str, data: Sequence[str], command: str = ""
) -> Closed:
    """As of a record in memory, but for errors, which are of all samples, and `whole_record`."""
    closing = found.closing
    result = closing_result(closing, model_name=model_name, data=data, command=command)
    whole = WholeRecord(len(closing.after.problem.runs[0]), found.every,
                        [_score(s) for s in found.scores])  # fmt: skip
    result = replace(result, whole_record=whole)
    if found.before is None or found.after is None:
        return result
    notes = [
        f"causes were looked for in one of {found.every} samples, and scored in all of them; "
        f"values, their standard deviations and the errors are those of all {whole.samples}"
    ]
    return replace(
        result,
        before=_section(result.before, found.before),
        after=_section(result.after, found.after),
        notes=[*result.notes, *notes],
    )


def _section(section: JudgedSection, errors: Errors) -> JudgedSection:
    axes = zip(section.rmse_holdout_by_axis, errors.by_axis.tolist(), strict=True)
    return replace(
        section,
        rmse_fit=plain(errors.fit),
        rmse_holdout=plain(errors.held_out),
        rmse_holdout_by_axis={axis: plain(value) for axis, value in axes},
    )


def _score(score: Score) -> WholeScore:
    names = [name.removeprefix(f"{score.label}.") for name in score.names]
    return WholeScore(
        score.label,
        plain(score.chance),
        plain(score.share),
        dict(zip(names, plain(score.sizes), strict=True)),
        dict(zip(names, plain(score.stds), strict=True)),
    )
