"""`plan` of an estimator in motion: inputs to fly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from casest.cli.loading import moving_model
from casest.cli.plan_options import PlanOptions
from casest.cli.shared import echo, progress, typed, write
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.dynamics import Dynamics
    from casest.plan.goals import Goal
    from casest.plan.motion.limits import Limit
    from casest.plan.motion.planning import MotionPlan
    from casest.plan.motion.program import Task

#: Pieces of an input, nodes of a motion at least, and pieces at most.
PIECES, NODES, MOST = 30, 30, 400


def flying(name: str, options: PlanOptions) -> int:
    """The motion that shows all states best, or the shortest that reaches a goal; exit code 0."""
    from casest.report.text.motion_plan import motion_text
    from casest.results.file import as_json
    from casest.results.motion_plan import motion_result, motion_rows

    refuse_others(name, options)
    model, rate = model_of(name, options)
    goals = goals_of(model, options)
    found, shorter = _planned(name, model, rate, goals, options)
    result = motion_result(
        model,
        found,
        model_name=name,
        criterion=options.criterion,
        robust=options.robust,
        rate=rate,
        goals=goals,
        shorter=shorter,
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


def _planned(
    name: str, model: Dynamics, rate: float, goals: list[Goal], options: PlanOptions
) -> tuple[MotionPlan, float | None]:
    """The motion, and with goals a duration at which none was found that reaches them."""
    import numpy as np

    from casest.plan.motion.planning import planned_motion
    from casest.plan.motion.until import shortest

    duration, pieces = _checked(name, rate, options)
    starts = _possible(model, options)

    def make(seconds: float) -> MotionPlan:
        progress(f"planning a motion of {seconds:.4g} s for {name}")
        return planned_motion(
            task_of(model, rate, seconds, pieces, goals, options),
            rate,
            np.random.default_rng(options.flying.seed),
            starts=starts,
            worst=options.robust == "worst",
            searches=options.flying.searches,
        )

    if not goals:
        return make(duration), None
    return shortest(lambda s: make(round(s * rate) / rate), goals, 2 * pieces / rate, duration)


def goals_of(model: Dynamics, options: PlanOptions) -> list[Goal]:
    """Goals as they are typed, of what is unknown at the beginning."""
    from casest.plan.goals import Measures

    if not options.until:
        return []
    if options.robust:
        raise UsageError("--robust goes with a --duration or a --count, not with --until")
    names = [s.name for s in model.states if not s.known for _ in range(s.size)]
    if not names:
        raise UsageError(f"{model.name}: every state is known: there is nothing to plan for")
    units = dict(zip(model.names, model.state_units, strict=True))
    goals = [Measures(model.names, units).goal(text) for text in options.until]
    for goal in goals:
        if goal.name.partition("[")[0] not in names:
            raise UsageError(f"--until '{goal}': {goal.name} is known from the beginning")
    return goals


#: Beginnings that are drawn for --robust, on both sides of the likeliest.
DRAWN = 2


def _possible(model: Dynamics, options: PlanOptions) -> list[Any]:
    """Beginnings (n,) that the states may have beside the likeliest; none without --robust."""
    import numpy as np

    from casest.plan.motion.planning import bent

    if options.robust is None:
        return []
    if not bent(model):
        raise UsageError(
            f"--robust: what a motion of {model.name} shows is the same wherever its states begin; "
            "leave it out"
        )
    lower, upper = model.bounds
    rng, found = np.random.default_rng(options.flying.seed), []
    root = np.sqrt(np.diag(model.start_covariance))
    for _ in range(DRAWN):
        off = root * rng.standard_normal(len(root))
        found += [np.clip(model.start + sign * off, lower, upper) for sign in (1, -1)]
    return found


def refuse_others(name: str, options: PlanOptions, counted: bool = False) -> None:
    """Refuse options of poses, runs and rows; `counted`: readings are counted all the same."""
    given = {
        "--candidates": options.possible.candidates,
        "--vary": options.possible.vary,
        "--reach": options.possible.reach,
        "--count": None if counted else options.count,
        "--budget": options.budget,
        "--separate": options.separate,
        "--show": options.show,
        "--live": options.live.source,
        "--columns": options.reading.columns,
        "--unit": options.reading.units,
        "--at-rest": options.reading.at_rest,
        "--free": options.model.free,
        "--fix": options.model.fix,
        "--effects": options.model.effects,
        "--prior": options.model.prior,
    }
    for flag, value in given.items():
        if value not in (None, (), False):
            raise UsageError(
                f"{flag} is of measurements that are counted; of {name} a motion is planned: "
                "--duration, --rate and --limit say what it may be"
            )


def model_of(name: str, options: PlanOptions) -> tuple[Dynamics, float]:
    """The model with its noise and beginning, and samples per second."""
    rate = options.reading.rate
    if options.possible.duration is None or rate is None:
        raise UsageError(f"{name} is an estimator in motion: say --duration and --rate")
    for flag, value in (("--duration", options.possible.duration), ("--rate", rate)):
        if not 0 < value < float("inf"):
            raise UsageError(f"{flag} {value:g}: a number above zero")
    model = _noisy(moving_model(name, options.model.constants, options.motion), options, rate)
    return model.beginning(**dict(given.numbers() for given in options.values)), rate


def _checked(name: str, rate: float, options: PlanOptions) -> tuple[float, int]:
    """Seconds and pieces of inputs."""
    duration = float(options.possible.duration or 0.0)
    pieces = PIECES if options.flying.pieces is None else options.flying.pieces
    if not 1 <= pieces <= MOST:
        raise UsageError(f"--pieces {pieces}: from 1 to {MOST}")
    if duration * rate < 2 * pieces:
        raise UsageError(
            f"--duration {duration:g} --rate {rate:g}: {int(duration * rate)} samples for {pieces} "
            "pieces of inputs; at least two for each: fewer --pieces, or a higher --rate"
        )
    if options.flying.searches < 1:
        raise UsageError(f"--searches {options.flying.searches}: at least one")
    return duration, pieces


def task_of(
    model: Dynamics,
    rate: float,
    duration: float,
    pieces: int,
    goals: Sequence[Goal],
    options: PlanOptions,
) -> Task:
    """The search for a motion of so many seconds."""
    from casest.plan.motion.criteria import Wanted
    from casest.plan.motion.grid import Grid
    from casest.plan.motion.program import Task

    limits = input_limits(model, options)
    grid = Grid.of(duration, pieces, NODES, _held(model))
    wanted = Wanted.for_goals(model, goals) if goals else Wanted.of(model, options.criterion)
    return Task(model, wanted, limits, grid, model.noise_at(1 / rate))


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
    from casest.interface.sensor_noise import one_number

    time = np.arange(3) / rate
    signals = {s.name: np.zeros((3, s.size)) for s in model.signals}
    units = {s.name: s.unit for s in model.signals}
    blank = Run.raw("planned", signals, units=units, time=time)
    return with_stated(
        model, blank, dict(one_number(given, model.signals) for given in options.noise)
    )
