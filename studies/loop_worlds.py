"""Does closing the loop find what real sensors do, and does what it finds hold on a second record?

    make study-worlds     # python studies/loop_worlds.py
    python studies/loop_worlds.py --quick                     # two worlds of each kind
    python studies/loop_worlds.py --first 5000 --seeds 10     # other seeds
    python studies/loop_worlds.py --only creep --workers 1    # kinds whose name contains this

Sensors of users' own and shipped ones with the effects of `studies/sensors`, which shares no
code with the catalogue and no formula where physics has more to it; each once more without. Each
world is kept in `out/loop_worlds.jsonl`, so that an interrupted study goes on where it stopped;
the table is written to `studies/loop_worlds.md`. `--table` writes it from what is there.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "studies"))

import own_models  # noqa: E402
import resumed  # noqa: E402
import sensors  # noqa: E402
import worlds_table  # noqa: E402
from sensors import KINDS  # noqa: E402
from sensors.world import World  # noqa: E402

from casest import Closing, Estimate, Model, NotTrusted, Run, close, effect, param, signal  # noqa: E402
from casest.effects.placing import prepared  # noqa: E402
from casest.estimate.held_out import lasting  # noqa: E402
from casest.leastsquares.problem import Problem  # noqa: E402
from casest.results.find import find_model  # noqa: E402
from casest.solve.trust_region import trust_region  # noqa: E402

KEPT, TABLE = ROOT / "out" / "loop_worlds.jsonl", ROOT / "studies" / "loop_worlds.md"
#: Effects that are a property of the noise or describe a course: they claim no cause.
DESCRIBING = {"outliers", "bias_wander", "reference_wander", "bias_course", "bias_ramp"}


# -- a world as casest sees it ---------------------------------------------------------------------


def model_of(world: World) -> Model:
    """The declared model."""
    own = getattr(own_models, world.model, None)
    return (own or find_model(world.model)).having(**world.constants)


def run_of(world: World, reading: Any = None) -> Run:
    """The world's record; with another reading where one is given."""
    signals = {name: np.asarray(values, float) for name, values in world.signals.items()}
    if reading is not None:
        signals[world.read] = reading
    n = len(world.time)
    units: dict[str, str | None] = {name: world.units.get(name) for name in signals}
    run = Run.raw(world.model, signals, units=units, time=world.time)
    block = np.zeros(n, np.int_) if world.block is None else world.block
    units = dict(world.column_units)
    run = replace(run, columns=dict(world.columns), column_units=units, block=block)
    if world.count == 1:
        return run
    freedom = world.count - 1
    scatter = np.random.default_rng(n).chisquare(freedom, (n, 3))
    spread = {world.read: world.sigma * np.sqrt(scatter / freedom)}
    return replace(run, block=np.arange(n), count=np.full(n, world.count), spread=spread)


def knowing(model: Model, world: World) -> Model:
    """The model with what truly happens to the reading, in parts of unknown sizes."""
    axes, parts = world.clean.shape[1], len(world.parts)

    @effect(on=world.read)
    def known(reading, hidden=signal(axes * parts), *, k=param(parts if parts > 1 else None)):
        sizes = [k] if parts == 1 else [k[p] for p in range(parts)]
        return reading - sum(k * hidden[axes * p : axes * (p + 1)] for p, k in enumerate(sizes))

    return model.with_effect(known)


def told(run: Run, world: World) -> Run:
    """The record with what truly happens to its reading: for the oracle alone."""
    return replace(run, signals={**run.signals, "hidden": np.hstack(world.parts)})


# -- residuals -------------------------------------------------------------------------------------


def residual(model: Model, values: Any, run: Run) -> Any:
    """Residuals (N, m) of a record that these values were not fitted to, or were."""
    problem = Problem(model, prepared(model, (run,)))
    with np.errstate(all="ignore"):
        return problem.residuals(problem.point(values))[0]


def rms(x: Any) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def fitted(model: Model, run: Run, start: Any) -> tuple[float, Any]:
    """Least squares from a good start: cost and values."""
    problem = Problem(model, prepared(model, (run,)))
    found = trust_region(problem, problem.point(start), tolerance=1e-9)
    return found.cost, problem.values(found.point)


def carried(estimate: Estimate) -> tuple[Model, Any]:
    """What holds on another record too: without what happened in the first one alone."""
    model = lasting(estimate)
    return model, model.among(estimate.values)


def off(model: Model, values: Any, world: World) -> float:
    """How far the declared parameters are off, by what they predict without the effect, in sigma.

    Parameters that mean something else beside the effect count as true; of several readings that
    are right by convention the nearest counts.
    """
    given = {**world.truth, **{n: values[n] for n in world.compared}}
    return min(rms(residual(model, given, run_of(world, p))) for p in world.plain) / world.sigma


# -- one world -------------------------------------------------------------------------------------


def one_world(kind: str, seed: int, there: bool) -> dict[str, Any]:
    """Close the loop on one record, and look at the second with what was found."""
    first, second = sensors.made(kind, seed, there=there)
    run, model = run_of(first), model_of(first)
    record: dict[str, Any] = {"name": named(kind, seed, there), "kind": kind, "seed": seed}
    record |= {"there": there, "model": first.model, "samples": len(run)}
    record |= {"right": list(KINDS[kind].right), "axes": len(model.axes)}
    began = time.perf_counter()
    try:
        closing = close(model, [run])
    except NotTrusted as error:
        return record | {"refused": str(error), "seconds": time.perf_counter() - began}
    except Exception as error:  # a study goes on; the table names these
        return record | {"failed": f"{type(error).__name__}: {error}"}
    record["seconds"] = time.perf_counter() - began
    return record | said(closing) | _judged(closing, first, second)


def said(closing: Closing) -> dict[str, Any]:
    """What the loop claims."""
    found = [
        {
            "name": f.candidate.name,
            "label": f.candidate.label,
            "alike": list(f.indistinguishable_from),
            "formula": f.candidate.effect.formula if f.candidate.effect else "",
            "describes": f.candidate.name in DESCRIBING
            or bool(getattr(f.candidate.effect, "describes", False)),
        }
        for f in closing.effects
    ]
    one_of = list(closing.undecided.names) if closing.undecided else []
    return {
        "verdict": closing.verdict,
        "found": found,
        "one_of": one_of,
        "described": list(closing.misfit.described),
        "share": float(closing.misfit.fraction),
    }


def _judged(closing: Closing, first: World, second: World) -> dict[str, Any]:
    """Noncentrality; errors of the declared parameters and on the second record, in sigma."""
    declared, run, later = closing.before.model, run_of(first), run_of(second)
    start = {**closing.before.values, **first.truth}
    cost, _ = fitted(declared, run_of(first, first.clean), start)
    oracle, values = declared, closing.before.values
    if np.abs(first.hidden).max() > 1e-9 * first.sigma:
        oracle = knowing(declared, first)
        _, values = fitted(oracle, told(run, first), start)
    after, kept = carried(closing.after)
    truths = sum(declared[name].shape.size for name in first.compared)
    return {
        "noncentrality": 2 * cost / first.sigma**2,
        "truths": int(truths),
        "off_before": off(declared, closing.before.values, first),
        "off_after": off(declared, closing.after.values, first),
        "off_oracle": off(declared, values, first),
        "later_before": rms(residual(declared, closing.before.values, later)) / second.sigma,
        "later_after": rms(residual(after, kept, later)) / second.sigma,
        "later_oracle": rms(residual(oracle, values, told(later, second))) / second.sigma,
    }


def named(kind: str, seed: int, there: bool) -> str:
    """The name of a world."""
    return f"{kind}/{'there' if there else 'not there'}/{seed}"


# -- all of them -----------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is left, write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two worlds of each kind")
    parser.add_argument("--only", default="", help="regular expression that a name contains")
    parser.add_argument("--seeds", type=int, default=40, help="worlds of each kind, and without")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kept", type=Path, default=KEPT)
    parser.add_argument("--out", type=Path, default=TABLE)
    parser.add_argument("--table", action="store_true", help="write the table of what is there")
    options = parser.parse_args(arguments)
    seeds = range(options.first, options.first + (2 if options.quick else options.seeds))
    every = [(k, s, there) for s in seeds for k in KINDS for there in (True, False)]
    every = [task for task in every if re.search(options.only, named(*task))]
    done = {r["name"]: r for r in resumed.kept(options.kept)}
    left = [task for task in every if named(*task) not in done]
    if not options.table:
        print(f"{len(every)} worlds, {len(left)} to do")
        made = resumed.done(one_world, left, options.kept, options.workers)
        done |= {r["name"]: r for r in made}
    records = [done[named(*task)] for task in every if named(*task) in done]
    options.out.write_text(worlds_table.table(records), encoding="utf-8")
    print(f"written: {options.out}")


if __name__ == "__main__":
    main()
