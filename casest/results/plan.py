"""What `casest plan` leaves: `plan.json` and `plan.csv`, which text and page read too."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace as replaced

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.plan.candidates.attitudes import words
from casest.plan.candidates.candidates import TIME, Candidates, Noise
from casest.plan.goals import Goal
from casest.plan.planning import Planned
from casest.results.file import plain
from casest.results.result import Number, Reproduced, Result, reproduced

if TYPE_CHECKING:
    from casest.plan.rivals.separating import Separation

#: What the criteria mean.
CRITERIA = {
    "D": "the volume of the ellipsoid of uncertainty",
    "A": "the sum of the variances, each unknown in units of what one measurement says of it",
    "E": "the worst combination of unknowns",
    "G": "the corrected quantity where it is worst",
}


class Measurement(Struct, frozen=True):
    """One measurement: in words, in the model's signals, and what it brings.

    signals: the expected values, in the model's units. settings: of a run. up: direction of up in
    the sensor's frame. determined: unknowns that are, with all before it. std_ratio: the geometric
    mean of the unknowns' standard deviations, as a share of what it was before this one; null while
    something is undetermined. std: of each unknown after it. told_apart: the chance, with all
    before it, that the two causes that are hardest to tell apart are.
    """

    number: int
    words: str
    signals: dict[str, Any]
    settings: dict[str, Any]
    up: list[float] | None
    cost: float
    std_ratio: Number
    std: dict[str, Number]
    told_apart: Number | UnsetType = UNSET


class Unknown(Struct, frozen=True):
    """Standard deviation of one unknown before and after the plan."""

    before: Number
    after: Number
    unit: str


class Reached(Struct, frozen=True):
    """A goal, and the standard deviation that the plan leaves."""

    name: str
    limit: float
    unit: str
    before: Number
    after: Number


class ToldApart(Struct, frozen=True):
    """Were `true` the cause: the chance that the plan refutes `against`, refitted to it all.

    growth: expected, of 2 log of their likelihoods' ratio; lead: that of the record; limit: from
    which on they are told apart.
    """

    true: str
    against: str
    chance: float
    growth: float
    lead: float
    limit: float


class NotToldApart(Struct, frozen=True):
    """Two causes that the plan leaves one: `chance` of the best plan for them alone, null where
    they are one under all that can be measured; `why`, a sentence."""

    one: str
    other: str
    chance: Number
    why: str


class BestPossible(Struct, frozen=True):
    """Certificate: standard deviations (of the criterion) that no design of as many measurements
    goes below, as a share of the plan's; goals are never reached with fewer than `at_least`."""

    share_of_std: float
    at_least: int | UnsetType | None = UNSET


class PlanNoise(Struct, frozen=True):
    """Noise that was reckoned with: of one residual, or of readings by signal. `stated` is false
    where nobody knew it: standard deviations are then multiples of it."""

    sigma: list[float]
    unit: str
    readings: dict[str, float]
    stated: bool


class Plan(Result, frozen=True, kw_only=True, dict=True):
    """The content of `plan.json`.

    Beside the file: `declared`, the model's own name; `covered`, directions of up of poses that
    there are already, (N, 3).
    """

    unwritten = ("declared", "covered", "emptiest")

    after: str | None
    kind: str
    criterion: str
    goals: list[Reached]
    count: int
    cost: float
    candidates: int
    measurements: list[Measurement]
    unknowns: dict[str, Unknown]
    separates: list[ToldApart] | UnsetType = UNSET
    together: list[NotToldApart] | UnsetType = UNSET
    budget: float | UnsetType = UNSET
    robust: str | UnsetType = UNSET
    best_possible: BestPossible
    noise: PlanNoise
    units: dict[str, str]
    notes: list[str]
    reproduce: Reproduced
    declared: str
    covered: list[list[float]]
    emptiest: str

    @property
    def things(self) -> str:
        """What is planned, in the plural."""
        return {"pose": "poses", "run": "runs", TIME: "readings"}.get(self.kind, "measurements")


def plan_result(
    model: Model,
    found: Candidates,
    planned: Planned,
    *,
    model_name: str,
    after: str | None,
    criterion: str,
    goals: Sequence[Goal],
    noise: Noise,
    units: Mapping[str, str],
    notes: Sequence[str] = (),
    covered: Array | None = None,
    data: Sequence[str] = (),
    command: str = "",
    budget: float | None = None,
    robust: str | None = None,
) -> Plan:
    """What `plan` leaves. `units` are those of signals and of unknowns."""
    first, last = planned.covariances[0], planned.covariances[-1]
    before, end = _stds(first, len(found.names)), _stds(last, len(found.names))
    return Plan(
        model=model_name,
        after=after,
        kind=found.kind,
        criterion=criterion,
        goals=[
            Reached(g.name, g.limit, g.unit, _goal_std(g, first), _goal_std(g, last)) for g in goals
        ],
        count=len(planned.chosen),
        cost=float(found.cost[list(planned.chosen)].sum()) if planned.chosen else 0.0,
        candidates=len(found),
        measurements=[_measurement(model, found, planned, k) for k in range(len(planned.chosen))],
        unknowns={
            name: Unknown(plain(before[i]), plain(end[i]), units.get(name, ""))
            for i, name in enumerate(found.names)
        },
        best_possible=BestPossible(
            planned.share, UNSET if planned.at_least is None else planned.at_least
        ),
        noise=PlanNoise(
            plain(noise.residual), units.get("residual", ""), dict(noise.readings), noise.known
        ),
        units={n: u for n, u in units.items() if n in found.signals or n in found.settings},
        budget=UNSET if budget is None else budget,
        robust=UNSET if robust is None else robust,
        notes=list(notes),
        reproduce=reproduced(command, data),
        declared=model.name,
        covered=[] if covered is None else plain(covered),
        emptiest=_emptiest(found, planned, covered),
    )


def separation_result(
    model: Model,
    found: Separation,
    planned: Planned,
    *,
    model_name: str,
    after: str,
    noise: Noise,
    units: Mapping[str, str],
    notes: Sequence[str] = (),
    covered: Array | None = None,
    command: str = "",
) -> Plan:
    """What `plan --separate` leaves."""
    candidates, chosen = found.candidates, planned.chosen
    blank = Planned(chosen, (None,) * (len(chosen) + 1), planned.share, planned.at_least)
    made = plan_result(
        model,
        replace(candidates, names=()),
        blank,
        model_name=model_name,
        after=after,
        criterion="causes told apart",
        goals=[],
        noise=noise,
        units=units,
        notes=notes,
        covered=covered,
        command=command,
    )
    powers = [min(found.powers(chosen[: k + 1])) for k in range(len(chosen))]
    growths, last = found.growths(chosen), found.powers(chosen)
    told = [
        ToldApart(p.true, p.against, chance, float(growth), p.lead, p.limit(growth))
        for p, chance, growth in zip(found.pairs, last, growths, strict=True)
    ]
    measured = [
        replaced(m, told_apart=power) for m, power in zip(made.measurements, powers, strict=True)
    ]
    together = [NotToldApart(t.one, t.other, t.chance, str(t)) for t in found.together]
    return replaced(made, measurements=measured, separates=told, together=together)


def _emptiest(found: Candidates, planned: Planned, covered: Array | None) -> str:
    """The possible direction furthest from all that is covered or planned."""
    if found.up is None or not planned.chosen:
        return ""
    there = found.up[list(planned.chosen)]
    there = there if covered is None else np.vstack([there, covered])
    nearest = np.degrees(np.arccos(np.clip(np.max(found.up @ there.T, axis=1), -1, 1)))
    i = int(np.argmax(nearest))
    return f"Furthest from all of them, by {nearest[i]:.0f}°: {words(found.up[i])}."


def _stds(covariance: Array | None, n: int) -> Array:
    return np.full(n, np.nan) if covariance is None else np.sqrt(np.diag(covariance))


def _goal_std(goal: Goal, covariance: Array | None) -> Number:
    return None if covariance is None else plain(goal.std(covariance))


def _measurement(model: Model, found: Candidates, planned: Planned, k: int) -> Measurement:
    i = planned.chosen[k]
    before, after = planned.covariances[k], planned.covariances[k + 1]
    stds = _stds(after, len(found.names))
    ratio = np.nan
    if before is not None and after is not None:
        ratio = float(np.exp(np.mean(np.log(stds / _stds(before, len(stds))))))
    return Measurement(
        k + 1,
        found.words[i],
        {n: _number(rows[i]) for n, rows in found.signals.items()},
        {n: _number(rows[i]) for n, rows in found.settings.items()},
        None if found.up is None else plain(found.up[i]),
        float(found.cost[i]),
        plain(ratio),
        dict(zip(found.names, plain(stds), strict=True)),
    )


def _number(row: Array) -> Any:
    return float(row[0]) if row.size == 1 else plain(row)


def headline(result: Plan) -> str:
    """What the plan is, in one line."""
    after = f" after {result.after}" if result.after else ""
    if not result.count:
        return f"{result.declared}{after}: nothing to measure: every goal is reached already"
    one = result.things[:-1] if result.count == 1 else result.things
    if result.separates:
        causes = " from ".join(" or ".join(group) for group in _groups(result))
        chance = min(t.chance for t in result.separates)
        tell = "tells" if result.count == 1 else "tell"
        told = f"that {tell} {causes} in {100 * chance:.0f} %"
        return f"{result.declared}{after}: {result.count} {one} next {told}"
    order = "as time goes" if result.kind == TIME else "those first that bring most"
    return f"{result.declared}{after}: {result.count} {one} next, {order}"


def _groups(result: Plan) -> list[list[str]]:
    """Causes that are told apart, those beside each other that stay one."""
    told = [label for t in result.separates or () for label in (t.true, t.against)]
    one = {frozenset((t.one, t.other)) for t in result.together or ()}
    groups = list[list[str]]()
    for label in dict.fromkeys(told):
        own = next((g for g in groups if any(frozenset((label, x)) in one for x in g)), None)
        if own is None:
            groups.append([label])
        else:
            own.append(label)
    return groups


def plan_words(result: Plan) -> Iterator[str]:
    """Goals, the certificate, notes: a sentence each."""
    for told in result.separates or ():
        yield (
            f"were {told.true} the cause, {told.against} would be refuted in "
            f"{100 * told.chance:.0f} %"
        )
    for both in result.together or ():
        yield both.why
    for goal in result.goals:
        unit = "" if goal.unit == "1" else f" {goal.unit}"
        before = "undetermined" if goal.before is None else f"{goal.before:.3g}"
        after = f"{goal.after:.3g}" if goal.after is not None else "undetermined"
        yield f"goal {goal.name} < {goal.limit:g}{unit}: {before} before, {after}{unit} after"
    best = result.best_possible
    if result.count and result.separates:
        yield (
            f"certified: for no {result.count} {result.things} of these {result.candidates} does "
            "2 log of the likelihoods' ratio grow by more than "
            f"{best.share_of_std**-2:.4g} times as much"
        )
    elif result.count:
        which = f"no {result.count} {result.things} of these {result.candidates} have"
        if result.budget is not UNSET:
            which = (
                f"nothing that costs {result.budget:g} (this: {result.cost:g}), of these "
                f"{result.candidates} {result.things}, has"
            )
        yield (
            f"certified: {which} standard deviations below {100 * best.share_of_std:.4g} % of "
            f"these ({CRITERIA.get(result.criterion, result.criterion)})"
        )
    if result.robust is not UNSET:
        how = "averaged over" if result.robust == "average" else "for the worst of"
        yield (
            f"planned and certified {how} values that the unknowns may have; standard deviations "
            "are those at the likeliest"
        )
    if best.at_least and result.goals:
        yield f"fewer than {best.at_least} {result.things} cannot reach the goal, however chosen"
    yield from result.notes


def plan_rows(result: Plan, model: Model) -> str:
    """`plan.csv`: number, words, direction of up, and the model's signals with their units.

    It can be given as --candidates again.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    if not result.measurements:
        writer.writerow(["number", "words"])
        return text.getvalue()
    first = result.measurements[0]
    head = ["number", "words"] + (["up_x", "up_y", "up_z"] if first.up else [])
    rotations = {s.name for s in model.signals if s.kind == "rotation"}
    for name, value in [*first.signals.items(), *first.settings.items()]:
        head += _labels(name, value, result.units.get(name, ""), name in rotations)
    writer.writerow(head)
    for m in result.measurements:
        row: list[Any] = [m.number, m.words, *(f"{x:.6f}" for x in m.up or [])]
        for name, value in [*m.signals.items(), *m.settings.items()]:
            row += [f"{x:.9g}" for x in _flat(value, name in rotations)]
        writer.writerow(row)
    return text.getvalue()


def _labels(name: str, value: Any, unit: str, rotation: bool) -> list[str]:
    if rotation:
        return ["qw", "qx", "qy", "qz"]
    own = f" [{unit}]" if unit and "[" not in unit and unit != "1" else ""
    if not isinstance(value, list):
        return [f"{name}{own}"]
    ends = list("xyz") if len(value) == 3 else [f"[{k}]" for k in range(len(value))]
    return [f"{name}{end}{own}" for end in ends]


def _flat(value: Any, rotation: bool) -> list[float]:
    if rotation:
        from scipy.spatial.transform import Rotation

        q = Rotation.from_matrix(np.reshape(value, (3, 3))).as_quat()
        return [float(x) for x in q[[3, 0, 1, 2]]]
    return value if isinstance(value, list) else [value]
