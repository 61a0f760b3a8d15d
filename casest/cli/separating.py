"""`plan --separate`: what tells causes apart that a record left open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from casest.cli.plan_options import PlanOptions
from casest.cli.shared import progress, typed
from casest.cli.situation import Situation, covered, possible_of, records_of
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model
    from casest.plan.candidates.candidates import Candidates
    from casest.plan.rivals.rivals import Rival
    from casest.results.plan import Plan


def separating(situation: Situation, options: PlanOptions) -> Plan:
    """Candidates as each cause has them, and the plan that tells the causes apart."""
    from casest.diagnose.levels import LEVELS
    from casest.plan.candidates.finding import candidates
    from casest.plan.rivals.separating import separated, separation
    from casest.results.plan import separation_result

    after = _result_of(situation, options)
    base, labels, rivals, runs = _rivals(situation, options)
    possible = _with_columns(possible_of(situation, options), base, rivals, runs)

    def make(rival: Rival) -> Candidates:
        return candidates(rival.model, rival.values, situation.noise, possible)

    apart = 0.0 if options.show else LEVELS.apart
    found = separation(
        rivals, situation.noise, make, situation.name, possible.rate, options.most, apart
    )
    planned = separated(found, options.count, options.most, situation.name)
    left = [label for label in labels if label not in found.labels]
    return separation_result(
        situation.model,
        found,
        planned,
        model_name=situation.name,
        after=after,
        noise=situation.noise,
        units=_units(situation, rivals, runs),
        notes=[*([f"not planned for: {', '.join(left)}"] if left else []), _AFTERWARDS],
        covered=covered(situation) if found.candidates.up is not None else None,
        command=typed(),
    )


def _result_of(situation: Situation, options: PlanOptions) -> str:
    """The result that is planned after; UsageError where there is none, or what else is asked."""
    asked = "--separate" if options.separate else "--show"
    if options.separate and options.show:
        raise UsageError("--separate and --show: one of the two says what is told apart")
    if options.until or options.criterion != "D":
        raise UsageError(f"{asked} has a goal of its own: leave --until and --criterion out")
    if options.robust or options.budget is not None:
        raise UsageError(f"{asked} tells causes apart: leave --robust and --budget out")
    if situation.after is None:
        raise UsageError(f"{asked}: {situation.name} is a model; give a result of close")
    return situation.after


def _rivals(
    situation: Situation, options: PlanOptions
) -> tuple[Model, list[str], list[Rival], tuple[Run, ...]]:
    """The model without what is in doubt, the causes by name, each fitted to the record."""
    from casest.plan.rivals.rivals import open_causes, refitted
    from casest.plan.rivals.shown import shown_or_not

    base, labels = (situation.model, []) if options.show else open_causes(
        situation.content, situation.model
    )  # fmt: skip
    if options.separate and len(labels) < 2:
        raise UsageError(
            f"{situation.after}: its record left no two causes open; plan for precision instead "
            "(without --separate)"
        )
    runs = records_of(situation, base)
    if runs is None:
        raise UsageError(
            f"{situation.after}: the record that it was made from is not where it was, and the "
            "causes are fitted to it again"
        )
    values, sigma = situation.values, situation.noise.residual
    progress(f"fitting {', '.join(labels) or options.show}")
    if options.show:
        return base, labels, shown_or_not(base, values, runs, options.show, sigma), runs
    return base, labels, refitted(base, values, runs, labels, sigma), runs


#: What to do with what is measured.
_AFTERWARDS = "append what is measured to the record, as further rows, and close it again"


def _units(situation: Situation, rivals: Sequence[Rival], runs: Sequence[Run]) -> dict[str, str]:
    """Of signals, unknowns, and the columns that a cause reads."""
    read = {s.name: s.unit or "" for r in rivals for s in r.model.signals}
    logged = {name: unit for name, unit in runs[0].column_units.items() if unit and name in read}
    return {**read, **logged, **situation.units}


def _with_columns(possible: Any, base: Model, rivals: Any, runs: Any) -> Any:
    """Values of the columns that a rival reads: as typed, else as the record has them."""
    from dataclasses import replace

    import numpy as np

    from casest.effects.placing import prepared
    from casest.plan.candidates.varied import values_of

    own = {s.name for s in replace(base, effects=()).signals}
    extras = {s.name: s.unit for r in rivals for s in r.model.signals if s.name not in own}
    typed_ones = dict(possible.varied)
    also = {}
    for name, unit in extras.items():
        if name in typed_ones:
            also[name] = values_of(name, typed_ones.pop(name), unit)
            continue
        seen = np.concatenate([run.signals[name][:, 0] for run in prepared(base, runs)])
        also[name] = np.unique(np.quantile(seen, [0.0, 0.5, 1.0]))[:, None]
    return replace(possible, varied=typed_ones, also=also)
