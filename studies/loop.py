"""Does closing the loop find what is missing, and nothing else? Worlds with known causes.

    make study-loop       # python studies/loop.py: hours, on two cores
    python studies/loop.py --quick
    python studies/loop.py --only 'null/wheel'   # tasks whose name contains this pattern

Each world is kept in `out/loop.jsonl`, so that an interrupted study goes on where it stopped; the
table is written to `studies/loop.md`. Data come from `tests/worlds.py`, which shares no code with
the catalogue. The oracle is a fit that knows the effect; what an effect could show is computed from
readings without noise. Seeds below 10 000 are the study's; the loop was tuned on others.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import loop_table  # noqa: E402
import resumed  # noqa: E402
import simulators as sim  # noqa: E402
import worlds  # noqa: E402

from casest import Model, Run, effect, param, signal  # noqa: E402
from casest.declaration.physics import cos, exp, tanh  # noqa: E402
from casest.declaration.shapes import each  # noqa: E402
from casest.diagnose import detectability, loop  # noqa: E402
from casest.diagnose.cross_validation import cross_fitted, rms  # noqa: E402
from casest.effects import CATALOGUE  # noqa: E402
from casest.effects.placing import prepared  # noqa: E402
from casest.estimate.estimate import Estimate  # noqa: E402
from casest.leastsquares.problem import Problem  # noqa: E402
from casest.results.find import find_model  # noqa: E402
from casest.solve.trust_region import trust_region  # noqa: E402

KEPT, TABLE = ROOT / "out" / "loop.jsonl", ROOT / "studies" / "loop.md"
BY_NAME = {e.name: e for e in CATALOGUE}

#: Place -> effect -> medium size; small is a fifth of it, large four times as much.
SIZES: dict[str, dict[str, float]] = {
    "wheel": {
        "imbalance": 0.3,
        "speed_polynomial": 0.002,
        "quadratic": 0.0005,
        "signed_quadratic": 0.0005,
        "cubic": 1.2e-05,
        "signed_cubic": 1e-05,
        "cross_quadratic": 0.0013,
        "bias_drift": 0.0025,
        "bias_step": 0.04,
        "temperature_bias": 0.01,
        "temperature_gain": 0.0007,
        "channel_bias": 1.6,
        "channel_gain": 0.2,
        "axis_delay": 0.003,
        "low_pass": 0.002,
        "saturation": 0.06,
        "dead_zone": 0.03,
        "vibration": 0.018,
        "lever_arm": 0.002,
        "axis_wobble": 0.018,
        "hysteresis": 0.03,
        "reference_drift": 0.0002,
    },
    "table": {
        "signed_quadratic": 0.001,
        "cubic": 8e-05,
        "signed_cubic": 0.0003,
        "cross_quadratic": 0.0004,
        "bias_drift": 4e-05,
        "bias_step": 0.02,
        "temperature_bias": 0.008,
        "temperature_gain": 0.0012,
        "channel_bias": 3.0,
        "channel_gain": 0.15,
        "saturation": 0.06,
        "dead_zone": 0.03,
        "table_angle": 0.002,
        "reference_drift": 5e-06,
    },
    "norm": {
        "quadratic": 1e-3,
        "signed_quadratic": 2e-3,
        "cubic": 1.5e-4,
        "signed_cubic": 1e-4,
        "cross_quadratic": 1e-3,
        "cross_axis": 4e-3,
        "dead_zone": 0.03,
        "bias_drift": 2e-4,
        "bias_step": 0.03,
        "temperature_bias": 0.015,
        "temperature_gain": 3e-3,
        "channel_bias": 2.0,
        "channel_gain": 0.4,
        "reference_drift": 1.5e-5,
    },
}
STEPS = {"small": 0.2, "medium": 1.0, "large": 4.0}
#: Two at once.
PAIRS: tuple[tuple[str, str, str], ...] = (
    ("wheel", "imbalance", "temperature_bias"),
    ("wheel", "imbalance", "quadratic"),
    ("wheel", "speed_polynomial", "vibration"),
    ("wheel", "lever_arm", "bias_drift"),
    ("wheel", "axis_wobble", "temperature_gain"),
    ("table", "cubic", "temperature_bias"),
    ("table", "table_angle", "bias_step"),
    ("table", "cross_quadratic", "channel_bias"),
    ("norm", "cubic", "temperature_bias"),
    ("norm", "quadratic", "channel_bias"),
    ("norm", "cross_quadratic", "bias_step"),
)
#: Effects of no catalogue: place -> name -> size.
ELSEWHERE = {
    "wheel": {
        "warm_exp": 0.01,
        "warm_tanh": 0.03,
        "product": 0.02,
        "sixth": 0.03,
    },
    "table": {"warm_exp": 0.03, "warm_tanh": 0.05, "product": 0.04},
    "norm": {"warm_exp": 0.03, "warm_tanh": 0.05, "product": 0.04},
}
#: What a formula for each must name.
WORDS = {name: words for name, (_, words) in worlds.ELSEWHERE.items()}
#: Share of a column's square below which the data do not determine what is left of it.
NULL = 1e-9
#: Effects that one mounting of the wheel hides.
HIDDEN = {"cross_axis": 0.02, "radius": 0.02, "time_delay": 0.01}
#: Worlds with nothing in them: place -> (weight, options); with every noise, 20 seeds a weight.
NOTHING: dict[str, tuple[tuple[int, dict[str, Any]], ...]] = {
    "wheel": ((2, {}), (1, {"seconds": 12.0, "rate": 50.0}), (0, {"seconds": 60.0, "rate": 200.0})),
    "table": ((2, {}), (1, {"positions": 24, "samples": 1}), (1, {"positions": 30, "samples": 20})),
    "norm": (
        (1, {"poses": 72}),
        (1, {"poses": 24}),
        (1, {"poses": 30, "model": "norm-diagonal"}),
        (1, {"poses": 36, "count": 1}),
    ),
}


# -- what to do ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Task:
    """One world: group/place/what/size/seed is its name."""

    group: str
    place: str
    what: str
    size: str
    seed: int
    effects: Mapping[str, float] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        more = ",".join(f"{k}={v}" for k, v in self.options.items() if k != "kind")
        return "/".join([self.group, self.place, self.what, self.size or more, str(self.seed)])


def tasks(seeds: int, nothing: int, first: int = 0) -> list[Task]:
    """Every world: `seeds` of each with an effect, `nothing` of each kind of those without."""
    own = range(first, first + seeds)
    found = [
        Task("one", place, what, step, seed, {what: size * factor}, _options(what))
        for place, sizes in SIZES.items()
        for what, size in sizes.items()
        for step, factor in STEPS.items()
        for seed in own
    ]
    for place, a, b in PAIRS:
        effects = {a: 3 * SIZES[place][a], b: 3 * SIZES[place][b]}
        found += [Task("two", place, f"{a}+{b}", "", seed, effects) for seed in own]
    found += [
        Task("elsewhere", place, what, "", seed, {what: size})
        for place, sizes in ELSEWHERE.items()
        for what, size in sizes.items()
        for seed in own
    ]
    found += [
        Task("hidden", "wheel", what, "", seed, {what: size})
        for what, size in HIDDEN.items()
        for seed in own
    ]
    return found + _nulls(nothing, first)


def _options(what: str) -> dict[str, Any]:
    return {"model": "norm-diagonal"} if what == "cross_axis" else {}


def _nulls(count: int, first: int) -> list[Task]:
    found = []
    for place, variants in NOTHING.items():
        for weight, options in variants:
            # A long record is one world of each noise.
            seeds = range(first, first + max(count * weight, 1 + count // 10))
            found += [
                Task("null", place, kind, "", seed, {}, {**options, "kind": kind})
                for kind in worlds.NOISES
                for seed in seeds
            ]
    return found


# -- one world -------------------------------------------------------------------------------------


def run_of(world: worlds.World, rng: np.random.Generator) -> Run:
    """The world's record; means of rests carry the scatter that was seen within them."""
    n = len(world.block)
    units: dict[str, str | None] = {name: world.units.get(name) for name in world.signals}
    run = Run.raw(world.model, dict(world.signals), units=units, time=world.time)
    spread = {}
    if world.count > 1:
        freedom = world.count - 1
        spread = {world.read: world.sigma * np.sqrt(rng.chisquare(freedom, (n, 3)) / freedom)}
    return replace(
        run,
        columns=dict(world.columns),
        column_units={c: "degC" if c == "temperature" else None for c in world.columns},
        block=world.block,
        count=np.full(n, world.count),
        spread=spread,
    )


def model_of(world: worlds.World) -> Model:
    """The declared model."""
    model = find_model(world.model)
    return model.having(norm=sim.GRAVITY) if world.model.startswith("norm") else model


@effect(on="output")
def warm_exp(y, temperature, *, k=param(each), at=0.0):
    return y + k * exp((temperature - at) / 1.5)


@effect(on="output")
def warm_tanh(y, temperature, *, k=param(each), at=0.0):
    return y + k * tanh((temperature - at) / 0.7)


@effect(on="output")
def product(y, temperature, supply, *, k=param(each), at=0.0, other=0.0):
    return y + k * (temperature - at) * (supply - other) / 0.01


@effect(on="output")
def sixth(y, angle=signal(), *, k=param(each)):
    return y + k * cos(6 * angle + 0.4)


#: What the oracle knows of effects of no catalogue.
KNOWN = {e.name: e for e in (warm_exp, warm_tanh, product, sixth)}


def oracle_of(model: Model, world: worlds.World, effects: Mapping[str, float]) -> Model:
    """The model with the effects that the world has, and what they need to be known by."""
    for name, size in effects.items():
        if name == "radius":
            model = model.freed("radius")
            continue
        if name in KNOWN:
            model = model.with_effect(_at_home(_knowing(KNOWN[name], world, size), model))
            continue
        chosen = _at_home(BY_NAME[name], model)
        columns = {}
        if name.startswith(("temperature", "channel")):
            columns = {"channel": "temperature" if name.startswith("temp") else "supply"}
        model = model.with_effect(_knowing(chosen, world, size), columns=columns)
    return model


def _knowing(chosen: Any, world: worlds.World, size: float) -> Any:
    """Numbers that the oracle is told: moments, levels, means; a frequency to begin with."""
    names = {n for n, _ in chosen.declarations}
    t, told = world.time, {}
    if "at" in names:
        column = "supply" if chosen.name.startswith("channel") else "temperature"
        told["at"] = float(world.columns[column].mean())
    if "other" in names:
        told["other"] = float(world.columns["supply"].mean())
    if "duration" in names:
        told["duration"] = float(np.ptp(t))
    if "when" in names:
        told["when"] = 0.37 * float(t[-1])
    if "level" in names:
        told["level"] = float(np.abs(world.clean).max())
    chosen = chosen.holding(**told)
    return chosen.starting(frequency=2 * np.pi * 17.3) if "frequency" in names else chosen


def _at_home(chosen: Any, model: Model) -> Any:
    """ "input" and "output" by the model's own names."""
    traced = model.traced
    predicted = [q.name for q in model.quantities.values() if q.value is traced.residual.predicted]
    home = {"input": traced.corrected, "output": (predicted or [traced.corrected])[0]}
    return replace(chosen, on=home.get(chosen.on, chosen.on))


def labels_of(world: worlds.World, effects: Mapping[str, float]) -> list[str]:
    """What the loop should name."""
    column = {"temperature": "temperature", "channel": "supply"}
    return [
        f"{name}({column[name.partition('_')[0]]})" if name.partition("_")[0] in column else name
        for name in effects
    ]


def one_world(task: Task) -> dict[str, Any]:
    """Close the loop on one world and compare it with what an oracle makes of it."""
    identity = [task.seed, *task.group.encode(), *task.place.encode(), *task.what.encode()]
    identity += list(task.size.encode())
    world = worlds.made(task.place, identity, task.effects, **task.options)
    run, model = run_of(world, np.random.default_rng(identity)), model_of(world)
    record = {"name": task.name, **asdict(task), "residuals": len(run) * len(model.axes)}
    began = time.perf_counter()
    try:
        closing = loop.close(model, [run])
    except Exception as error:  # a study goes on; the table counts these
        return record | {"failed": f"{type(error).__name__}: {error}"}
    record["seconds"] = time.perf_counter() - began
    record["found"] = [
        {
            "label": f.candidate.label,
            "column": f.candidate.column,
            "on": f.candidate.on,
            "formula": f.candidate.effect.formula if f.candidate.effect else "",
            "alike": list(f.indistinguishable_from),
            "p": f.p_value,
        }
        for f in closing.effects
    ]
    record["wanted"] = labels_of(world, task.effects)
    record["refused"] = sorted({s.name for s in closing.refused})
    record["invisible"] = [i.name for i in detectability.invisible(closing)]
    record["one_of"] = list(closing.undecided.names) if closing.undecided else []
    record["before"], record["after"] = rms(closing.before_held_out), rms(closing.after_held_out)
    record["trusted"] = closing.after.certificate.trusted
    if task.effects:
        record |= _against_oracle(task, world, model, closing)
    return record


def _against_oracle(
    task: Task, world: worlds.World, model: Model, closing: loop.Closing
) -> dict[str, Any]:
    """Noncentrality; the oracle's held-out error; errors of the declared parameters.

    With noise, and of the same models fitted to readings without. These are root mean squares of
    the independent combinations of the parameters that the oracle's data determine, in the
    oracle's standard deviations.
    """
    runs = closing.runs
    clean = (replace(runs[0], signals={**runs[0].signals, world.read: world.clean}),)
    cost, bare = _without_noise(closing.before, clean)
    told: dict[str, Any] = {"noncentrality": 2 * cost / world.sigma**2}
    oracle = oracle_of(model, world, task.effects)
    problem = Problem(oracle, prepared(oracle, runs))
    point = _nearest(problem, problem.point({**closing.before.values, **world.truth}))
    values = problem.values(point)
    told["oracle"] = rms(cross_fitted(oracle, problem.runs, values, closing.folds))
    seen = _seen(problem, point, tuple(world.truth)) / world.sigma
    told["truths"] = len(seen)
    for name, found in (
        ("error_before", closing.before.values),
        ("error_after", closing.after.values),
        ("error_oracle", values),
        ("clean_before", bare),
        ("clean_after", _without_noise(closing.after, clean)[1] if closing.effects else bare),
    ):
        off = problem.point({**values, **_only(found, world)}).x
        off -= problem.point({**values, **world.truth}).x
        told[name] = float(np.sqrt(np.mean((seen @ off) ** 2)))
    return told


def _without_noise(estimate: Estimate, clean: tuple[Run, ...]) -> tuple[float, Any]:
    """Cost and values of the same model fitted to readings that have no noise."""
    problem = Problem(estimate.model, clean)
    fit = trust_region(problem, problem.point(estimate.values), tolerance=1e-9)
    return fit.cost, problem.values(fit.point)


def _nearest(problem: Problem, start: Any) -> Any:
    """The optimum; where it is a valley, the place in it that is next to the start, the truth."""
    point = trust_region(problem, start, tolerance=1e-9).point
    matrix, scale = _scaled(problem.normal(point).matrix)
    if np.linalg.eigvalsh(matrix)[0] > NULL:
        return point
    point = start
    for _ in range(20):
        normal = problem.normal(point)
        matrix, scale = _scaled(normal.matrix)
        step = np.linalg.pinv(matrix, rcond=NULL, hermitian=True) @ (normal.gradient / scale)
        point = problem.moved(point, -step / scale)
    return point


def _scaled(matrix: Any) -> tuple[Any, Any]:
    """With ones on the diagonal; by what it was divided."""
    scale = np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
    return matrix / np.outer(scale, scale), scale


def _only(values: Mapping[str, Any], world: worlds.World) -> dict[str, Any]:
    return {name: values[name] for name in world.truth}


def _seen(problem: Problem, point: Any, names: tuple[str, ...]) -> Any:
    """Combinations of the named parameters that the data determine, of unit variance for σ = 1.

    Whatever the other unknowns are: the root of the Schur complement of JᵀJ. What the oracle's
    data cannot determine either (a lever arm along the radius is a change of gain) has no row.
    """
    matrix, scale = _scaled(problem.normal(point).matrix)
    own = np.zeros(len(matrix), dtype=bool)
    for slot in problem.slots:
        own[slot.x] = slot.parameter.name in names
    across = matrix[np.ix_(own, ~own)]
    others = np.linalg.pinv(matrix[np.ix_(~own, ~own)], rcond=NULL, hermitian=True)
    size, way = np.linalg.eigh(matrix[np.ix_(own, own)] - across @ others @ across.T)
    rows = np.zeros((int(np.sum(size > NULL)), len(matrix)))
    rows[:, own] = (np.sqrt(np.maximum(size, 0)) * way).T[size > NULL] * scale[own]
    return rows


# -- all of them -----------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one seed of each, few without effect")
    parser.add_argument("--only", default="", help="regular expression that a task's name contains")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--nothing", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed: 10000 and up for tuning")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kept", type=Path, default=KEPT)
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args(arguments)
    seeds, nothing = (1, 2) if options.quick else (options.seeds, options.nothing)
    every = [
        task for task in tasks(seeds, nothing, options.first) if re.search(options.only, task.name)
    ]
    done = {r["name"]: r for r in resumed.kept(options.kept)}
    left = [task for task in every if task.name not in done]
    print(f"{len(every)} worlds, {len(left)} to do")
    made = resumed.done(one_world, [(task,) for task in left], options.kept, options.workers)
    done |= {r["name"]: r for r in made}
    records = [done[task.name] for task in every]
    options.table.write_text(loop_table.table(records, WORDS), encoding="utf-8")
    print(f"written: {options.table}")


if __name__ == "__main__":
    main()
