"""`plan` of differential equations: piecewise constant inputs, and when to read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casest.cli.flying import goals_of, input_limits, refuse_others
from casest.cli.plan_options import PlanOptions
from casest.cli.shared import echo, progress, typed, write
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.declaration.shapes import Array
    from casest.dynamics import Dynamics
    from casest.plan.goals import Goal
    from casest.plan.motion.criteria import Wanted
    from casest.plan.motion.experiment import Experiment
    from casest.plan.motion.program import Task
    from casest.saved.planning import Start

#: Pieces of an input; beginnings that are averaged over.
PIECES, DRAWN = 8, 8


def experimenting(name: str, declared: Dynamics, start: Start | None, options: PlanOptions) -> int:
    """Inputs and times of readings of an experiment; exit code 0."""
    from casest.report.text.experiment import experiment_text
    from casest.results.experiment import experiment_result, experiment_rows
    from casest.results.file import as_json

    refuse_others(name, options, counted=True)
    if options.flying.searches != 1:
        raise UsageError("--searches is of a motion; an experiment begins at the best of 20")
    model, known, noted = _known(declared, start, options)
    goals = goals_of(model, options)
    task = _task(name, model, known, options, start, goals)
    found, too_few = _planned(name, task, goals, options)
    result = experiment_result(
        found,
        model_name=name,
        after=None if start is None else str(start.content["model"]),
        criterion=options.criterion,
        robust=options.robust,
        notes=noted,
        command=typed(),
        goals=goals,
        too_few=too_few,
    )
    if options.output:
        from casest.report.html.experiment import experiment_page

        write(options.output / "plan.csv", experiment_rows(result))
        write(options.output / "plan.json", as_json(result.content()))
        write(options.output / "plan.html", experiment_page(result))
    if options.as_json:
        echo(as_json(result.content()), nl=False)
        return 0
    echo(experiment_text(result))
    if options.output:
        echo(f"\nWritten: {options.output}/plan.html, plan.json, plan.csv")
    return 0


def _planned(
    name: str, task: Task, goals: list[Goal], options: PlanOptions
) -> tuple[Experiment, int | None]:
    """The experiment, and with goals so many readings that do not reach them."""
    import numpy as np

    from casest.plan.motion.experiment import planned_experiment
    from casest.plan.motion.until import fewest

    worst = options.robust == "worst"
    starts = _possible(task, options, np.random.default_rng(options.flying.seed))

    def make(count: int) -> Experiment:
        progress(f"planning an experiment of {count} readings for {name}")
        rng = np.random.default_rng(options.flying.seed)
        return planned_experiment(task, count, rng, starts, worst)

    if goals:
        return fewest(make, goals, min(len(task.grid.time), options.most))
    return make(options.count if options.count is not None else _count(task)), None


def equations_of(given: Path, options: PlanOptions) -> tuple[Dynamics, Start | None] | None:
    """The declared equations of a model or of a saved result; None where it has none."""
    from casest.cli.correcting import names_a_model
    from casest.cli.loading import moving_model
    from casest.dynamics import Dynamics
    from casest.dynamics.equations import Equations
    from casest.results.find import find_any
    from casest.saved.planning import started

    if names_a_model(given):
        found = find_any(str(given))
        if not isinstance(found, Dynamics) or found.driven_by_noise:
            return None
        return moving_model(str(given), options.model.constants, options.motion), None
    start = started(given)
    if not isinstance(start.model.function, Equations):
        return None
    if start.model.effects:
        added = ", ".join(a.label for a in start.model.effects)
        raise UsageError(
            f"{given}: {added} was added to the equations; declare it in them to plan an experiment"
        )
    return _as_fitted(start.model.function.declared, start, options, given), start


def _as_fitted(declared: Dynamics, start: Start, options: PlanOptions, given: Path) -> Dynamics:
    """The equations with the values of a result."""
    import numpy as np

    if options.model.constants or options.values:
        raise UsageError(f"{given} is a result, and has its values: leave --set and --value out")
    model = start.model
    constants = {c.name: model[c.name].array for c in declared.constants}
    beginnings = {}
    for s in declared.states:
        name = s.name if s.of is not None else s.beginning
        value = start.values[name] if name in start.values else model[name].array
        beginnings[s.name] = np.asarray(value, float).ravel()
    return declared.having(**constants).beginning(**beginnings)


def _known(
    declared: Dynamics, start: Start | None, options: PlanOptions
) -> tuple[Dynamics, Array | None, tuple[str, ...]]:
    """The model, information about its unknowns (n, n) in their own units, and what to note."""
    import numpy as np

    values = dict(given.numbers() for given in options.values)
    if start is None:
        model = declared.beginning(**values)
        stated = {given.pair()[0] for given in options.motion.stds}
        known = [
            1 / s.std**2 if s.stated or s.name in stated else 0.0
            for s in model.states
            for _ in range(s.size)
        ]
        return model, np.diag(known), ()
    names = list(declared.names)
    missing = [name for name in start.names if name not in names]
    if missing:
        raise UsageError(f"{declared.name}: {missing[0]} of the result is not in its equations")
    known_ = np.zeros((len(names), len(names)))
    own = [names.index(name) for name in start.names]
    known_[np.ix_(own, own)] = start.information
    return declared, known_, ()


def _task(
    name: str,
    model: Dynamics,
    known: Any,
    options: PlanOptions,
    start: Start | None,
    goals: list[Goal],
) -> Task:
    """Limits, grid and noise of the experiment."""
    from casest.plan.motion.grid import Grid
    from casest.plan.motion.program import Task

    duration, rate = options.possible.duration, options.reading.rate
    if duration is None or rate is None:
        raise UsageError(
            f"{name} follows differential equations: say --duration, and with --rate how often one "
            "can read"
        )
    for flag, value in (("--duration", duration), ("--rate", rate)):
        if not 0 < value < float("inf"):
            raise UsageError(f"{flag} {value:g}: a number above zero")
    limits = input_limits(model, options)
    pieces = options.flying.pieces or (PIECES if model.input_signals else 1)
    steps = round(duration * rate)
    if abs(steps - duration * rate) > 1e-6 * steps or steps % pieces or steps < 1:
        raise UsageError(
            f"--duration {duration:g} --rate {rate:g}: {duration * rate:g} steps between readings "
            f"for {pieces} pieces of the inputs; a whole number for each (--pieces)"
        )
    wanted = _wanted(model, options, known, goals)
    grid = Grid.of(duration, pieces, steps, True)
    return Task(model, wanted, limits, grid, _noise(model, options, start))


def _wanted(model: Dynamics, options: PlanOptions, known: Any, goals: list[Goal]) -> Wanted:
    """What is to be best, unknowns in units of what is known of them, else of their size."""
    import numpy as np

    from casest.plan.motion.criteria import VAGUE, Wanted

    wanted = Wanted.for_goals(model, goals) if goals else Wanted.of(model, options.criterion)
    free = list(wanted.free)
    scaled = (known * np.outer(wanted.scale, wanted.scale))[np.ix_(free, free)]
    return replace(wanted, known=scaled + VAGUE * np.eye(len(free)))


def _noise(model: Dynamics, options: PlanOptions, start: Start | None) -> Any:
    """Covariance (m, m) of one reading of all outputs."""
    import numpy as np

    from casest.interface.sensor_noise import one_number

    t = model.traced
    stated: dict[str, float] = dict(one_number(given, model.signals) for given in options.noise)
    for name, said in stated.items():
        if name not in t.measured:
            raise UsageError(f"--sensor-noise {name}=…: {model.name} reads {', '.join(t.measured)}")
        if not 0 < said < float("inf"):
            raise UsageError(f"--sensor-noise {name}={said:g}: a standard deviation is above zero")
    found: list[Array] = []
    for name, output in zip(t.measured, t.outputs, strict=True):
        std: float | None = stated.get(name)
        if std is None and start is not None:
            place = len(np.concatenate([np.zeros(0), *found]))
            every = np.broadcast_to(start.sigma, (int(t.reading.numel()),))
            unit = every[place : place + output.predicted.numel()]
            declared = output.std if isinstance(output.std, float) else 1.0
            weighted = start.model.traced.residual.std is not None
            found.append(np.asarray(unit * (declared if weighted else 1.0)))
            continue
        if std is None and isinstance(output.std, float):
            std = output.std
        if std is None and output.intensity is not None:
            std = float(np.sqrt(output.intensity))
        if std is None:
            raise UsageError(
                f"{model.name}: how noisy is one reading of {name}? --sensor-noise {name}=STD"
            )
        found.append(np.full(output.predicted.numel(), std))
    return np.diag(np.concatenate(found) ** 2)


def _possible(task: Task, options: PlanOptions, rng: Any) -> list[Any]:
    """Values that the unknowns may have, (n,) each; none where a plan is not to be robust."""
    import numpy as np

    if options.robust is None:
        return []
    wanted, model = task.wanted, task.model
    values, axes = np.linalg.eigh(wanted.known)
    sure = values > 1e-6
    if not sure.any():
        raise UsageError(
            f"--robust: nothing says how uncertain the unknowns of {model.name} are: --std "
            f"{model.names[wanted.free[0]]}=NUMBER, or plan from a result"
        )
    root, (lower, upper) = axes[:, sure] / np.sqrt(values[sure]), model.bounds
    free, found = list(wanted.free), []
    for _ in range(DRAWN):
        here = model.start.copy()
        here[free] += (root @ rng.standard_normal(int(sure.sum()))) * wanted.scale[free]
        found.append(np.clip(here, lower, upper))
    return found


def _count(task: Task) -> int:
    """Twice as many numbers as unknowns, no more than times to read at."""
    each = len(task.noise)
    return int(min(-(-2 * len(task.wanted.free) // each), len(task.grid.time)))
