"""`plan.json` of an experiment on differential equations: inputs, times of readings, what they
bring."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence

import numpy as np
from msgspec import Struct

from casest.declaration.shapes import Array
from casest.plan.goals import Goal
from casest.plan.motion.experiment import Experiment
from casest.plan.motion.planning import readings
from casest.plan.motion.until import std_of, stds
from casest.results.file import plain
from casest.results.motion_plan import CRITERIA, goal_words
from casest.results.plan import BestPossible, Reached, Unknown
from casest.results.result import Reproduced, Result, reproduced


class Held(Struct, frozen=True):
    """An input: its value from each of these times on."""

    unit: str
    since: list[float]
    value: list[list[float]]


class PlannedExperiment(Result, frozen=True, kw_only=True, dict=True):
    """The content of `plan.json` of an experiment.

    times, s: when to read; best_possible: of the standard deviations with other times and the same
    inputs. evenly: those of as many readings spread evenly, as a multiple. expected (N, m): the
    readings that are to be expected, of the values that are thought likely. goals: of `--until`;
    too_few: so many readings with which no plan was found that reaches them.
    """

    unwritten = ("columns",)

    after: str | None
    kind: str
    criterion: str
    robust: str | None
    duration: float
    count: int
    candidates: int
    times: list[float]
    inputs: dict[str, Held]
    unknowns: dict[str, Unknown]
    evenly: float
    goals: list[Reached]
    too_few: int | None
    best_possible: BestPossible
    notes: list[str]
    reproduce: Reproduced
    columns: tuple[list[str], Array]


def experiment_result(
    found: Experiment,
    *,
    model_name: str,
    after: str | None,
    criterion: str,
    robust: str | None,
    notes: tuple[str, ...],
    command: str,
    goals: Sequence[Goal] = (),
    too_few: int | None = None,
) -> PlannedExperiment:
    """What `plan` of differential equations leaves."""
    task, time = found.task, found.task.grid.time
    model, free = task.model, task.wanted.free
    units = {s.name: s.unit or "" for s in model.signals}
    knots = [float(t) for t in task.grid.knots]
    inputs = {
        name: Held(units[name], knots, plain(found.u[:, own])) for name, own in task.columns.items()
    }
    before = None if found.before is None else np.sqrt(np.diag(found.before))
    after_ = np.sqrt(np.diag(found.after))
    return PlannedExperiment(
        model=model_name,
        after=after,
        kind="experiment",
        criterion=criterion,
        robust=robust,
        duration=float(time[-1]),
        count=len(found.nodes),
        candidates=len(time),
        times=[float(time[k]) for k in found.nodes],
        inputs=inputs,
        unknowns={
            model.names[i]: Unknown(
                None if before is None else plain(before[k]),
                plain(after_[k]),
                model.state_units[i],
            )
            for k, i in enumerate(free)
        },
        evenly=found.even,
        goals=[Reached(g.name, g.limit, g.unit, None, std_of(stds(found), g)) for g in goals],
        too_few=too_few,
        best_possible=BestPossible(found.share),
        notes=list(notes),
        reproduce=reproduced(command, ()),
        columns=_columns(found),
    )


def _columns(found: Experiment) -> tuple[list[str], Array]:
    """Names and values (N, c) of `plan.csv`: a row where an input changes or a reading is due."""
    task, units = found.task, {s.name: s.unit for s in found.task.model.signals}
    time, x = task.grid.time, task.states(found.u)
    every = task.grid.at(time) @ found.u
    signals = {name: every[:, own] for name, own in task.columns.items()}
    said = readings(task.model, x, signals)
    read = np.isin(np.arange(len(time)), found.nodes)
    changes = np.isin(time, task.grid.knots) if task.wide else np.zeros(len(time), bool)
    rows = np.flatnonzero(read | changes)
    head, columns = ["t [s]"], [time[rows, None]]
    for name, values in [*signals.items(), *said.items()]:
        shown = values[rows].copy()
        if name in said:
            shown[~read[rows]] = np.nan
        unit = units[name]
        own = f" [{unit}]" if unit and unit != "1" else ""
        ends = [""] if shown.shape[1] == 1 else [f"[{k}]" for k in range(shown.shape[1])]
        head += [f"{name}{end}{own}" for end in ends]
        columns.append(shown)
    return head, np.hstack(columns)


def experiment_rows(result: PlannedExperiment) -> str:
    """`plan.csv`: time, inputs from there on, readings to expect (empty where none is due)."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    head, values = result.columns
    writer.writerow(head)
    for row in values:
        writer.writerow(["" if np.isnan(x) else f"{x:.9g}" for x in row])
    return text.getvalue()


def experiment_headline(result: PlannedExperiment) -> str:
    """What the plan is, in one line."""
    one = "reading" if result.count == 1 else "readings"
    inputs = f" and {' and '.join(result.inputs)}" if result.inputs else ""
    return f"{result.model}: when to make {result.count} {one}{inputs}, in {result.duration:g} s"


def input_words(name: str, held: Held) -> str:
    """`T [K]: 579 from 0 s, 300 from 0.125 s`; what stays the same is not said again."""
    said, last = [], None
    for t, value in zip(held.since, held.value, strict=True):
        number = ", ".join(f"{x:.4g}" for x in value)
        if number != last:
            said.append(f"{number} from {t:.4g} s")
        last = number
    unit = f" [{held.unit}]" if held.unit and held.unit != "1" else ""
    return f"{name}{unit}: {'; '.join(said)}"


def experiment_words(result: PlannedExperiment) -> Iterator[str]:
    """The certificate, what is none, notes."""
    yield from goal_words(result.goals)
    if result.too_few:
        yield f"no plan of {result.too_few} readings was found that reaches this"
    said = "what is asked" if result.goals else CRITERIA.get(result.criterion, result.criterion)
    share = 100 * result.best_possible.share_of_std
    yield (
        f"certified: with these inputs no {result.count} of the {result.candidates} times have "
        f"standard deviations below {share:.4g} % of these ({said})"
    )
    if result.evenly > 1.005:
        yield f"as many readings spread evenly: {result.evenly:.3g} times the standard deviations"
    if result.inputs:
        yield "the inputs are the best that a search found; another optimum may be better"
    if result.robust:
        over = "averaged over" if result.robust == "average" else "for the worst of"
        yield f"planned {over} values that the unknowns may have, not for the likeliest alone"
    yield from result.notes
