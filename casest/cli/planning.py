"""`plan`: which measurement next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from casest.cli.assignments import Assignment, Assignments
from casest.cli.correcting import names_a_model
from casest.cli.flags import flag, taking
from casest.cli.loading import declared_model
from casest.cli.options import FOLDER, ModelOptions, ReadingOptions, Words
from casest.cli.shared import commands, echo, progress, typed, write
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model
    from casest.plan.candidates.candidates import Candidates, Noise
    from casest.plan.goals import Goal, Measures
    from casest.plan.planning import Planned, Task
    from casest.results.plan import Plan


@dataclass(frozen=True, slots=True)
class PossibleOptions:
    """What can be measured."""

    candidates: str | None = flag(
        None,
        "--candidates",
        type=click.Path(),
        metavar="FILE",
        help="Table of what can be measured, in the model's signals; `cost` is what each costs.",
    )
    vary: Assignments = flag(
        (),
        "--vary",
        of=Assignment,
        metavar="NAME=VALUES",
        help="What can be set: temperature=20,40,60 or 'tilt=20:60:10 deg'.",
    )
    step: float = flag(
        15.0, "--step", type=float, show_default=True, help="Degrees between tilts of a pose."
    )
    reach: float | None = flag(
        None, "--reach", type=float, metavar="DEGREES", help="Furthest tilt from z up."
    )
    duration: float | None = flag(None, "--duration", type=float, help="Seconds of a run.")


@dataclass(frozen=True, slots=True)
class PlanOptions:
    """Options of `plan`."""

    model: ModelOptions = field(default_factory=ModelOptions)
    values: Assignments = flag(
        (), "--value", of=Assignment, metavar="NAME=VALUE", help="What an unknown is about."
    )
    noise: Assignments = flag(
        (),
        "--sensor-noise",
        of=Assignment,
        metavar="SIGNAL=STD",
        help="Standard deviation of one reading, in the model's unit.",
    )
    possible: PossibleOptions = field(default_factory=PossibleOptions)
    reading: ReadingOptions = field(default_factory=ReadingOptions)
    separate: bool = flag(
        False, "--separate", help="After close: what tells the causes apart that it left open."
    )
    count: int | None = flag(None, "--count", type=int, metavar="N", help="How many to plan.")
    until: Words = flag(
        (),
        "--until",
        metavar="'NAME<STD UNIT'",
        help="As many as it takes: 'offset<0.001 m/s^2', 'corrected<0.01'.",
    )
    most: int = flag(200, "--most", type=int, show_default=True, help="At most, with --until.")
    criterion: str = flag(
        "D",
        "--criterion",
        metavar="D|A|E|G|NAME",
        show_default=True,
        help="Volume, sum, worst combination, corrected readings, or one unknown.",
    )
    output: Path | None = flag(
        None,
        "-o",
        "--output",
        type=FOLDER,
        metavar="DIR",
        help="Folder for plan.json, plan.csv and plan.html.",
    )
    as_json: bool = flag(False, "--json", help="Print plan.json instead of text.")


@dataclass(frozen=True)
class Situation:
    """What a plan begins with: the model, what is known of it, the noise."""

    name: str
    model: Model
    values: Mapping[str, Any]
    noise: Noise
    units: Mapping[str, str]
    names: tuple[str, ...] = ()
    information: Any = None
    after: str | None = None
    content: Mapping[str, Any] = field(default_factory=dict)


@commands.command()
@click.argument("given", metavar="RESULT|MODEL", type=click.Path(path_type=Path))
@taking(PlanOptions)
def plan(given: Path, options: PlanOptions) -> int:
    """Which measurement next: poses, runs or rows of a table that bring the most.

    After a RESULT of calibrate or close (its folder), or of a MODEL before any data.
    """
    from casest.report.text.plan import plan_text
    from casest.results.file import as_json
    from casest.results.plan import plan_rows

    if options.count is not None and options.until:
        raise UsageError("--count and --until: one of the two says how many")
    progress(f"planning for {given}")
    situation = (
        _of_model(str(given), options) if names_a_model(given) else _of_result(given, options)
    )
    make = separating if options.separate else planned_result
    result = make(situation, options)
    if options.output:
        from casest.report.html import plan_page

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


def _of_model(name: str, options: PlanOptions) -> Situation:
    """A model before any data: its declared starts, or --value."""
    from casest.data.run import Run
    from casest.results.units import unit_table
    from casest.simulation.record import truth

    model = declared_model(name, options.model)
    given = dict(given.of(model) for given in options.values)
    values = truth(model, {n: model.having(**{n: v})[n].array for n, v in given.items()})
    units = {s.name: s.unit for s in model.signals}
    empty = Run.raw("planned", {s.name: _no_rows(s.size) for s in model.signals}, units=units)
    return Situation(name, model, values, _noise(model, options), unit_table(model, [empty]))


def _no_rows(size: int) -> Any:
    import numpy as np

    return np.zeros((0, size))


def _of_result(path: Path, options: PlanOptions) -> Situation:
    """What a saved result knows."""
    from casest.saved.planning import started

    for name in ("constants", "free", "fix", "shared", "per_run", "effects"):
        if getattr(options.model, name):
            raise UsageError(
                f"{path} is a result, and has its model: leave --{name.replace('_', '-')} out"
                if name != "constants"
                else f"{path} is a result, and has its model: leave --set out"
            )
    if options.values:
        raise UsageError(f"{path} is a result, and has its values: leave --value out")
    start = started(path)
    noise = _noise(start.model, options, start.sigma, start.over)
    return Situation(
        str(start.content["model"]),
        start.model,
        start.values,
        noise,
        start.table,
        start.names,
        start.information,
        str(path),
        start.content,
    )


def _noise(model: Model, options: PlanOptions, sigma: Any = None, over: float = 1.0) -> Noise:
    """The noise as stated, else that of the result, else of size one."""
    import numpy as np

    from casest.plan.candidates.candidates import Noise

    stated = dict(given.number() for given in options.noise)
    readings = {s.name for s in model.readings}
    for name, std in stated.items():
        if name not in readings:
            raise UsageError(
                f"--sensor-noise {name}={std:g}: {model.name} reads {', '.join(sorted(readings))}"
            )
        if not 0 < std < float("inf"):
            raise UsageError(f"--sensor-noise {name}={std:g}: a standard deviation above 0")
    if sigma is None or stated:
        return Noise(np.ones(len(model.axes)), stated, known=bool(stated))
    return Noise(sigma * np.sqrt(max(over, 1.0)), {})


def planned_result(situation: Situation, options: PlanOptions) -> Plan:
    """Candidates, goals, the plan."""
    import numpy as np

    from casest.plan.candidates.finding import candidates
    from casest.plan.planning import task
    from casest.results.plan import plan_result

    model = situation.model
    found = candidates(model, situation.values, situation.noise, _possible(situation, options))
    known = np.zeros((len(found.names), len(found.names)))
    if situation.information is not None:
        own = [found.names.index(name) for name in situation.names]
        known[np.ix_(own, own)] = situation.information
    given = task(found.factors, known, found.names, situation.name)
    _refuse_hidden(given, situation, found)
    goals, planned = _planned(given, _measures(situation, found), options, situation)
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
        covered=_covered(situation) if found.up is not None else None,
        command=typed(),
    )


def separating(situation: Situation, options: PlanOptions) -> Plan:
    """Candidates as each cause has them, and the plan that tells the causes apart."""
    from casest.plan.candidates.finding import candidates
    from casest.plan.rivals.rivals import Rival, open_causes, refitted
    from casest.plan.rivals.separating import separated, separation
    from casest.results.plan import separation_result

    if options.until or options.criterion != "D":
        raise UsageError("--separate has a goal of its own: leave --until and --criterion out")
    if situation.after is None:
        raise UsageError(f"--separate: {situation.name} is a model; give a result of close")
    base, labels = open_causes(situation.content, situation.model)
    if len(labels) < 2:
        raise UsageError(
            f"{situation.after}: its record left no two causes open; plan for precision instead "
            "(without --separate)"
        )
    runs = _records(situation)
    if runs is None:
        raise UsageError(
            f"{situation.after}: the record that it was made from is not where it was, and the "
            "causes are fitted to it again"
        )
    progress(f"fitting {', '.join(labels)}")
    rivals = refitted(base, situation.values, runs, labels, situation.noise.residual)
    possible = _with_columns(_possible(situation, options), situation, rivals, runs)

    def make(rival: Rival) -> Candidates:
        return candidates(rival.model, rival.values, situation.noise, possible)

    found = separation(rivals, situation.noise, make, situation.name, possible.rate)
    planned = separated(found, options.count, options.most, situation.name)
    named = {r.label for r in rivals}
    left = [label for label in labels if label not in named]
    return separation_result(
        situation.model,
        found,
        planned,
        model_name=situation.name,
        after=situation.after,
        noise=situation.noise,
        units=situation.units,
        notes=[f"not planned for: {', '.join(left)}"] if left else [],
        covered=_covered(situation) if found.candidates.up is not None else None,
        command=typed(),
    )


def _with_columns(possible: Any, situation: Situation, rivals: Any, runs: Any) -> Any:
    """Values of the columns that a rival reads: as typed, else as the record has them."""
    from dataclasses import replace

    import numpy as np

    from casest.effects.placing import prepared
    from casest.plan.candidates.varied import values_of

    own = {s.name for s in situation.model.signals}
    extras = {s.name: s.unit for r in rivals for s in r.model.signals if s.name not in own}
    typed_ones = dict(possible.varied)
    also = {}
    for name, unit in extras.items():
        if name in typed_ones:
            also[name] = values_of(name, typed_ones.pop(name), unit)
            continue
        seen = np.concatenate([run.signals[name][:, 0] for run in prepared(situation.model, runs)])
        also[name] = np.unique(np.quantile(seen, [0.0, 0.5, 1.0]))[:, None]
    return replace(possible, varied=typed_ones, also=also)


def _possible(situation: Situation, options: PlanOptions) -> Any:
    from casest.plan.candidates.finding import Possible

    said = options.possible
    table = _table(situation.model, said.candidates, options.reading) if said.candidates else None
    return Possible(
        dict(given.pair() for given in said.vary),
        said.step,
        said.reach,
        said.duration,
        options.reading.rate,
        table,
    )


def _table(model: Model, file: str, reading: ReadingOptions) -> tuple[Run, ...]:
    """Rows of a file with the signals that are not predicted."""
    from casest.data import load_runs

    needed = [s for s in model.signals if s.name != model.traced.measured]
    return load_runs([file], needed, **reading.keywords())


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


def _measures(situation: Situation, found: Candidates) -> Measures:
    from casest.plan.corrected import corrected_slopes
    from casest.plan.goals import Measures

    model, slopes = situation.model, None
    if found.run is not None:
        slopes = corrected_slopes(model, situation.values, found.run)
    name = model.traced.corrected or ""
    units = {n: situation.units.get(n, "rad") for n in found.names}
    return Measures(found.names, units, name, situation.units.get(name, ""), slopes)


def _planned(
    given: Task, measures: Measures, options: PlanOptions, situation: Situation
) -> tuple[list[Goal], Planned]:
    from casest.plan.planning import criterion_of, planned, until

    if options.until:
        if not situation.noise.known:
            name = situation.model.readings[0].name
            raise UsageError(f"--until: how many depends on the noise: --sensor-noise {name}=STD")
        if options.most < 1:
            raise UsageError(f"--most {options.most}: at least one")
        goals = [measures.goal(text) for text in options.until]
        return goals, until(given, goals, options.most)
    columns = None
    if options.criterion == "G":
        columns = measures.columns("corrected", "--criterion G")[0]
    elif options.criterion not in ("D", "A", "E"):
        columns = measures.columns(options.criterion, f"--criterion {options.criterion}")[0]
    count = _count(given) if options.count is None else options.count
    if count < 1:
        raise UsageError(f"--count {count}: at least one")
    return [], planned(given, criterion_of(given, options.criterion, columns), count)


def _count(given: Task) -> int:
    """Twice as many numbers as unknowns."""
    return -(-2 * len(given.scale) // int(given.factors.shape[1]))


def _covered(situation: Situation) -> Any:
    """Directions of up (N, 3) in the records that the result was made from, if they are there."""
    from casest.errors import CasestError
    from casest.plan.candidates.poses import upward

    runs = _records(situation)
    try:
        return None if runs is None else upward(situation.model, situation.values, runs)
    except CasestError:  # a reading that has no pose: nothing is drawn
        return None


def _records(situation: Situation) -> tuple[Run, ...] | None:
    """The records that a result was made from, read as they were; None where they are gone."""
    from casest.data import load_runs
    from casest.errors import CasestError
    from casest.report.next_command import typed_words

    words = typed_words(situation.content.get("reproduce", {}).get("command", ""))
    if words is None:
        return None

    def given(flag: str) -> Assignments:
        return tuple(Assignment(flag, v) for f, v in words.options if f == flag and v)

    flags = {flag for flag, _ in words.options}
    rate = next((float(v) for f, v in words.options if f == "--rate" and v), None)
    reading = ReadingOptions(
        given("--columns"), given("--unit"), given("--scale"), rate, "--at-rest" in flags
    )
    try:
        data = list(situation.content["data"])
        return load_runs(data, situation.model.signals, **reading.keywords())
    except (CasestError, OSError, ValueError):  # moved or changed since
        return None
