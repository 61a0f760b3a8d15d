"""`plan`: which measurement next."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from casest.cli.correcting import names_a_model
from casest.cli.experimenting import equations_of, experimenting
from casest.cli.flags import Kind, refuse, taking
from casest.cli.flying import flying
from casest.cli.live import living
from casest.cli.loading import in_motion
from casest.cli.plan_options import PlanOptions
from casest.cli.separating import separating
from casest.cli.shared import commands, echo, progress, typed, write
from casest.cli.situation import (
    Situation,
    covered,
    measures_of,
    of_model,
    of_result,
    possible_of,
)
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.plan.candidates.candidates import Candidates
    from casest.plan.design.criteria import Criterion
    from casest.plan.goals import Goal, Measures
    from casest.plan.planning import Planned, Task
    from casest.results.plan import Plan


@commands.command()
@click.argument("given", metavar="RESULT|MODEL", type=click.Path(path_type=Path))
@taking(PlanOptions)
def plan(given: Path, options: PlanOptions) -> int:
    """Which measurement next: poses, runs or rows of a table that bring the most; or a motion.

    After a RESULT of calibrate or close (its folder), or of a MODEL before any data.
    """
    from casest.report.text.plan import plan_text
    from casest.results.file import as_json
    from casest.results.plan import plan_rows

    said = {
        "--count": options.count,
        "--until": options.until or None,
        "--budget": options.budget,
    }
    several = [name for name, value in said.items() if value is not None]
    if len(several) > 1:
        raise UsageError(f"{several[0]} and {several[1]}: one of the two says how many")
    if names_a_model(given) and in_motion(str(given)):
        return flying(str(given), options)
    equations = equations_of(given, options)
    if equations is not None:
        return experimenting(str(given), *equations, options)
    refuse(options, Kind.MOVING, f"is for estimators in motion; {given} is none")
    progress(f"planning for {given}")
    situation = of_model(str(given), options) if names_a_model(given) else of_result(given, options)
    if options.live.source:
        return living(situation, options, options.live.source)
    make = separating if options.separate or options.show else planned_result
    result = make(situation, options)
    if options.output:
        from casest.report.html.plan import plan_page

        write(options.output / "plan.csv", plan_rows(result, situation.model))
        write(options.output / "plan.json", as_json(result.content()))
        write(options.output / "plan.html", plan_page(result))
    if options.as_json:
        echo(as_json(result.content()), nl=False)
        return 0
    echo(plan_text(result))
    if options.output:
        echo(f"\nWritten: {options.output}/plan.html, plan.json, plan.csv")
    return 0


def planned_result(situation: Situation, options: PlanOptions) -> Plan:
    """Candidates, goals, the plan."""
    import numpy as np

    from casest.plan.candidates.finding import candidates
    from casest.plan.planning import task
    from casest.results.plan import plan_result

    model = situation.model
    found = candidates(model, situation.values, situation.noise, possible_of(situation, options))
    known = np.zeros((len(found.names), len(found.names)))
    if situation.information is not None:
        own = [found.names.index(name) for name in situation.names]
        known[np.ix_(own, own)] = situation.information
    given = task(found.factors, known, found.names, situation.name, found.once)
    _refuse_hidden(given, situation, found)
    goals, planned = _planned(given, found, options, situation)
    notes = (
        []
        if situation.noise.known
        else [
            "the noise is unknown: standard deviations are multiples of it; --sensor-noise "
            f"{model.readings[0].name}=STD says it"
        ]
    )
    return plan_result(
        model,
        found,
        planned,
        model_name=situation.name,
        after=situation.after,
        criterion=" and ".join(map(str, goals)) if goals else options.criterion,
        goals=goals,
        noise=situation.noise,
        units=situation.units,
        notes=notes,
        covered=covered(situation) if found.up is not None else None,
        command=typed(),
        budget=options.budget,
        robust=options.robust,
    )


def _refuse_hidden(given: Task, situation: Situation, found: Candidates) -> None:
    """Refuse candidates that together leave something undetermined, and name it."""
    from casest.plan.planning import undetermined
    from casest.plan.words import combination

    if (null := undetermined(given)).shape[1]:
        raise UsageError(
            f"{situation.name}: none of these {len(found)} candidates, nor all of them, determine "
            f"every unknown: {combination(null[:, 0] / given.scale, given.scale, found.names)}; "
            "vary something else, or hold one of them (--fix)"
        )


def _planned(
    given: Task, found: Candidates, options: PlanOptions, situation: Situation
) -> tuple[list[Goal], Planned]:
    from casest.plan.budget import bought
    from casest.plan.planning import criterion_of, planned, until

    measures = measures_of(situation, found)
    if options.until:
        if options.robust:
            raise UsageError("--robust goes with --count, not with --until")
        return _until(given, measures, options, situation, until)
    columns = None
    if options.criterion == "G":
        columns = measures.columns("corrected", "--criterion G")[0]
    elif options.criterion not in ("D", "A", "E"):
        columns = measures.columns(options.criterion, f"--criterion {options.criterion}")[0]
    criterion = criterion_of(given, options.criterion, columns)
    if options.budget is not None:
        if options.robust:
            raise UsageError("--robust goes with --count, not with --budget")
        if given.once:
            raise UsageError("--budget: each time can be read once; say how many (--count)")
        return [], bought(given, criterion, found.cost, options.budget)
    count = _count(given) if options.count is None else options.count
    if count < 1:
        raise UsageError(f"--count {count}: at least one")
    if options.robust:
        return [], _robustly(given, criterion, count, options, situation)
    return [], planned(given, criterion, count)


def _until(
    given: Task, measures: Measures, options: PlanOptions, situation: Situation, until: Any
) -> tuple[list[Goal], Planned]:
    if not situation.noise.known:
        name = situation.model.readings[0].name
        raise UsageError(f"--until: how many depends on the noise: --sensor-noise {name}=STD")
    if options.most < 1:
        raise UsageError(f"--most {options.most}: at least one")
    goals = [measures.goal(text) for text in options.until]
    return goals, until(given, goals, options.most)


def _robustly(
    given: Task, criterion: Criterion, count: int, options: PlanOptions, situation: Situation
) -> Planned:
    """For values drawn from the covariance of a result."""
    import numpy as np

    from casest.plan.candidates.finding import candidates
    from casest.plan.robust import planned_robustly, possible_values

    if situation.information is None:
        raise UsageError(
            f"--robust: nothing says how uncertain the unknowns of {situation.name} are: plan from "
            "a result of calibrate"
        )
    possible = possible_of(situation, options)

    def make(values: Mapping[str, Any]) -> Candidates:
        return candidates(situation.model, values, situation.noise, possible)

    drawn = possible_values(
        situation.model,
        situation.values,
        situation.names,
        situation.information,
        np.random.default_rng(options.flying.seed),
    )
    worst = options.robust == "worst"
    return planned_robustly(given, make, drawn, criterion, count, worst)


def _count(given: Task) -> int:
    """Twice as many numbers as unknowns."""
    return -(-2 * len(given.scale) // int(given.factors.shape[1]))
