"""`plan` of an estimator in motion: inputs to fly."""

from __future__ import annotations

from typing import TYPE_CHECKING

from casest.cli.loading import moving_model
from casest.cli.plan_options import PlanOptions
from casest.cli.shared import echo, progress, typed, write
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.dynamics import Dynamics
    from casest.plan.motion.limits import Limit
    from casest.plan.motion.program import Task

#: Pieces of an input, nodes of a motion at least, and pieces at most.
PIECES, NODES, MOST = 30, 30, 400


def flying(name: str, options: PlanOptions) -> int:
    """The motion that shows all states best; exit code 2 where none was found that shows them."""
    import numpy as np

    from casest.plan.motion.planning import planned_motion
    from casest.report.text.motion_plan import motion_text
    from casest.results.file import as_json
    from casest.results.motion_plan import motion_result, motion_rows

    refuse_others(name, options)
    task, rate = task_of(name, options)
    progress(f"planning a motion for {name}")
    found = planned_motion(
        task, rate, np.random.default_rng(options.flying.seed), searches=options.flying.searches
    )
    result = motion_result(
        task.model,
        found,
        model_name=name,
        criterion=options.criterion,
        robust=None,
        rate=rate,
        notes=(),
        command=typed(),
    )
    if options.output:
        from casest.report.html.motion_plan import motion_page

        write(options.output / "plan.csv", motion_rows(result))
        write(options.output / "plan.json", as_json(result.content()))
        write(options.output / "plan.html", motion_page(result))
    if options.as_json:
        echo(as_json(result.content()), nl=False)
        return 0
    echo(motion_text(result))
    if options.output:
        echo(f"\nWritten: {options.output}/plan.html, plan.json, plan.csv")
    return 0


def refuse_others(name: str, options: PlanOptions, counted: bool = False) -> None:
    """Refuse options of poses, runs and rows; `counted`: readings are counted all the same."""
    given = {
        "--candidates": options.possible.candidates,
        "--vary": options.possible.vary,
        "--reach": options.possible.reach,
        "--count": None if counted else options.count,
        "--until": options.until,
        "--budget": options.budget,
        "--separate": options.separate,
        "--live": options.live.source,
        "--columns": options.reading.columns,
        "--unit": options.reading.units,
        "--at-rest": options.reading.at_rest,
        "--free": options.model.free,
        "--fix": options.model.fix,
        "--effects": options.model.effects,
        "--prior": options.model.prior,
    }
    if not counted and options.robust:
        raise UsageError("--robust: what a motion shows is told for the states that it begins with")
    for flag, value in given.items():
        if value not in (None, (), False):
            raise UsageError(
                f"{flag} is of measurements that are counted; of {name} a motion is planned: "
                "--duration, --rate and --limit say what it may be"
            )


def task_of(name: str, options: PlanOptions) -> tuple[Task, float]:
    """The model with its noise, limits, grid; and samples per second."""
    from casest.plan.motion.criteria import Wanted
    from casest.plan.motion.grid import Grid
    from casest.plan.motion.program import Task

    duration, rate = options.possible.duration, options.reading.rate
    pieces = PIECES if options.flying.pieces is None else options.flying.pieces
    if duration is None or rate is None:
        raise UsageError(f"{name} is an estimator in motion: say --duration and --rate")
    for flag, value in (("--duration", duration), ("--rate", rate)):
        if not 0 < value < float("inf"):
            raise UsageError(f"{flag} {value:g}: a number above zero")
    if not 1 <= pieces <= MOST:
        raise UsageError(f"--pieces {pieces}: from 1 to {MOST}")
    if duration * rate < 2 * pieces:
        raise UsageError(
            f"--duration {duration:g} --rate {rate:g}: {int(duration * rate)} samples for {pieces} "
            "pieces of inputs; at least two for each: fewer --pieces, or a higher --rate"
        )
    if options.flying.searches < 1:
        raise UsageError(f"--searches {options.flying.searches}: at least one")
    model = _noisy(moving_model(name, options.model.constants, options.motion), options, rate)
    values = dict(given.numbers() for given in options.values)
    model = model.beginning(**values)
    limits = input_limits(model, options)
    held = _held(model)
    grid = Grid.of(duration, pieces, NODES, held)
    wanted = Wanted.of(model, options.criterion)
    return Task(model, wanted, limits, grid, model.noise_at(1 / rate)), rate


def input_limits(model: Dynamics, options: PlanOptions) -> tuple[Limit, ...]:
    """Limits as they are typed."""
    from casest.plan.motion.limits import limits_of

    said = []
    for text in options.flying.limits:
        name, equals, value = text.partition("=")
        if not (name.strip() and equals and value.strip()):
            raise UsageError(f"--limit {text}: write it as --limit 'omega=30 deg/s'")
        said.append((name.strip(), value))
    return limits_of(model, said)


def _held(model: Dynamics) -> bool:
    """Are inputs held between their changes? All are, or none is."""
    signals = [s for s in model.signals if s.name in model.input_signals]
    turned = [s.name for s in signals if s.kind == "rotation"]
    if turned:
        raise UsageError(f"{model.name}: attitudes {turned[0]} cannot be planned as an input")
    if not signals:
        raise UsageError(f"{model.name} has no input: its motion is what it is")
    held = {s.held for s in signals}
    if len(held) > 1:
        raise UsageError(f"{model.name}: some inputs are held and some not; a motion has one kind")
    return held.pop()


def _noisy(model: Dynamics, options: PlanOptions, rate: float) -> Dynamics:
    """With --sensor-noise, of readings `rate` times a second."""
    import numpy as np

    from casest.data.run import Run
    from casest.dynamics.intensities import with_stated

    time = np.arange(3) / rate
    signals = {s.name: np.zeros((3, s.size)) for s in model.signals}
    units = {s.name: s.unit for s in model.signals}
    blank = Run.raw("planned", signals, units=units, time=time)
    return with_stated(model, blank, dict(given.number() for given in options.noise))
