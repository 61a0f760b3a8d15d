"""`plan.json` of a motion: inputs to fly, what they make observable, how much of each limit they
take."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence

import numpy as np
from msgspec import Struct

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.plan.goals import Goal
from casest.plan.motion.planning import MotionPlan
from casest.plan.motion.until import std_of
from casest.results.file import plain
from casest.results.plan import Reached
from casest.results.result import Number, Reproduced, Result, reproduced

#: What the criteria mean, of a motion.
CRITERIA = {
    "D": "the volume of the ellipsoid of uncertainty",
    "A": "the sum of the variances, each state in units of what was known of it beforehand",
    "E": "the worst combination of states, in units of what was known of them beforehand",
}


class Kept(Struct, frozen=True):
    """A limit in words, and the share of it that the motion takes."""

    name: str
    words: str
    share: float


class Seen(Struct, frozen=True):
    """Standard deviation that the readings alone allow for one state at the beginning: of the
    planned motion, and of a random one with inputs in the same limits (null: not determined)."""

    planned: Number
    random: Number
    unit: str


class PlannedMotion(Result, frozen=True, kw_only=True, dict=True):
    """The content of `plan.json` of a motion; `run` and `states` are what is drawn and written.

    ratio: the geometric mean of the standard deviations over those of the random motion, null
    where one of the two does not determine every state. goals: of `--until`; too_short: a duration
    at which no motion was found that reaches them. elsewhere: of each other beginning that it was
    planned for (`--robust`), the geometric mean of the standard deviations as a multiple.
    """

    unwritten = ("run", "states", "names")

    kind: str
    criterion: str
    robust: str | None
    duration: float
    rate: float
    rank: int
    unknowns: int
    unobservable: list[str]
    random_rank: int
    limits: list[Kept]
    std: dict[str, Seen]
    ratio: Number
    goals: list[Reached]
    too_short: Number
    elsewhere: list[float]
    notes: list[str]
    reproduce: Reproduced
    run: Run
    states: Array
    names: tuple[str, ...]


def motion_result(
    model: Dynamics,
    found: MotionPlan,
    *,
    model_name: str,
    criterion: str,
    robust: str | None,
    rate: float,
    notes: tuple[str, ...],
    command: str,
    goals: Sequence[Goal] = (),
    shorter: float | None = None,
) -> PlannedMotion:
    """What `plan` of an estimator in motion leaves."""
    planned, random = found.motion.seen, found.random.seen
    stds = zip(model.names, planned.std, random.std, model.state_units, strict=True)
    both = np.isfinite(planned.std).all() and np.isfinite(random.std).all()
    ratio = float(np.exp(np.mean(np.log(planned.std / random.std)))) if both else np.nan
    time = np.asarray(found.motion.run.time)
    return PlannedMotion(
        model=model_name,
        kind="motion",
        criterion=criterion,
        robust=robust,
        duration=float(time[-1]),
        rate=rate,
        rank=planned.rank,
        unknowns=planned.unknowns,
        unobservable=list(planned.unobservable),
        random_rank=random.rank,
        limits=[Kept(x.name, str(x), found.motion.shares[x.name]) for x in found.limits],
        std={name: Seen(plain(a), plain(b), unit) for name, a, b, unit in stds},
        ratio=plain(ratio),
        goals=[Reached(g.name, g.limit, g.unit, None, std_of(planned.std, g)) for g in goals],
        too_short=shorter,
        elsewhere=list(found.elsewhere),
        notes=list(notes),
        reproduce=reproduced(command, ()),
        run=found.motion.run,
        states=found.motion.states,
        names=model.names,
    )


def motion_headline(result: PlannedMotion) -> str:
    """What the plan is, in one line."""
    if result.rank < result.unknowns:
        return (
            f"{result.model}: no motion within these limits was found that shows every state: "
            f"{result.rank} of {result.unknowns}"
        )
    return (
        f"{result.model}: a motion of {result.duration:g} s within these limits that shows all "
        f"{result.unknowns} states"
    )


def goal_words(goals: Sequence[Reached]) -> Iterator[str]:
    """What is asked, and what the plan leaves."""
    for goal in goals:
        unit = "" if goal.unit == "1" else f" {goal.unit}"
        yield f"goal {goal.name} < {goal.limit:.4g}{unit}: {goal.after:.3g}{unit} after"


def motion_words(result: PlannedMotion) -> Iterator[str]:
    """What is hidden, what the motion is beside a random one, what is no certificate, notes."""
    yield from result.unobservable
    if result.ratio is not None:
        yield (
            f"standard deviations are {result.ratio:.2g} times those of a random motion with "
            "inputs in the same limits (geometric mean)"
        )
    elif result.random_rank < result.rank:
        yield f"a random motion in the same limits shows {result.random_rank} states"
    yield from goal_words(result.goals)
    if result.goals:
        yield (
            f"no motion of {result.too_short:.3g} s was found that reaches "
            f"{'it' if len(result.goals) == 1 else 'them'}; another search may find one"
        )
    else:
        said = CRITERIA.get(result.criterion, result.criterion)
        yield f"the best that a search found for {said}; another optimum may be better"
    if result.elsewhere:
        how = "averaged over" if result.robust == "average" else "for the worst of"
        yield (
            f"planned {how} {len(result.elsewhere) + 1} beginnings that the states may have: "
            f"standard deviations are {min(result.elsewhere):.2g} to {max(result.elsewhere):.2g} "
            "times those above at the others; limits are kept from the likeliest"
        )
    yield from result.notes


def motion_rows(result: PlannedMotion) -> str:
    """`plan.csv`: time, inputs to fly, the readings to expect; with units.

    `casest simulate --input` takes it, and `casest observe`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    run, head, columns = result.run, ["t [s]"], [np.asarray(result.run.time)[:, None]]
    for name, values in run.signals.items():
        if name == "t":
            continue
        unit = run.units.get(name)
        own = f" [{unit}]" if unit and unit != "1" else ""
        size = values.shape[1]
        ends = [""] if size == 1 else list("xyz") if size == 3 else [f"[{k}]" for k in range(size)]
        head += [f"{name}{end}{own}" for end in ends]
        columns.append(values)
    writer.writerow(head)
    for row in np.hstack(columns):
        writer.writerow([f"{x:.9g}" for x in row])
    return text.getvalue()
