"""`casest simulate`: a record of a declared model whose truth is known, for planning and teaching.

An explicit model predicts its readings from the other signals, which come from a file, from a rate
and a duration (time alone), or as random attitudes. An implicit one (a known length) is given
random directions, and the readings that correct to them. Data made by the formula that is fitted
prove that a fit works, and nothing about a sensor.
"""

from __future__ import annotations

import csv
import difflib
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casest import __version__
from casest.correction.inverse import Correction
from casest.data import load_runs
from casest.data.run import Run
from casest.data.write import make_folder, write_atomically
from casest.declaration.effect import NOISE, Effect
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Signal
from casest.declaration.tracing import function_of
from casest.effects.placing import placed_in, prepared, with_numbers
from casest.errors import UsageError
from casest.leastsquares.problem import Problem
from casest.results.file import plain


def with_effects(
    model: Model, run: Run, wanted: Sequence[str], catalogue: Sequence[Effect]
) -> Model:
    """The model with effects by name, `temperature_bias(temp)` where one reads a column."""
    known = {e.name: e for e in catalogue}
    for text in wanted:
        found = re.fullmatch(r"(\w+)(?:\((\w+)\))?", text)
        if found is None or found[1] not in known:
            near = difflib.get_close_matches(text, known, n=1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise UsageError(
                f"--effect {text}: no such effect; {hint}`casest list` names them, --effects adds "
                "yours"
            )
        effect = known[found[1]]
        if effect.on == NOISE:
            raise UsageError(
                f"--effect {text}: it describes noise and makes none; add the noise to the "
                "readings yourself"
            )
        if effect.kind == "time":
            model = model.with_effect(effect, on=found[2])
            continue
        columns = _columns_of(effect, found[2], model, run)
        effect = with_numbers(placed_in(effect, model), columns, prepared(model, (run,)), model)
        model = model.with_effect(effect, columns=dict(columns))
    return model


def _columns_of(
    effect: Effect, named: str | None, model: Model, run: Run
) -> tuple[tuple[str, str], ...]:
    """The column that the effect reads: as named, else the only one that there is."""
    inner = {*model.quantities, *(s.name for s in model.signals), *run.columns}
    inner |= set() if run.time is None else {"t"}
    wanted = [s.name for s in effect.extras if s.name not in inner]
    if not wanted:
        return ()
    there = sorted(set(run.columns) - {s.name for s in model.signals})
    if named is None and len(there) != 1:
        which = f"the record has {', '.join(there)}" if there else "give --input FILE with one"
        raise UsageError(
            f"--effect {effect.name}: it follows a column; say which, {effect.name}(COLUMN); "
            f"{which}"
        )
    return tuple((name, named or there[0]) for name in wanted)


def truth(model: Model, given: Mapping[str, Any]) -> dict[str, Array]:
    """Value of every unknown: as given, else its declared start; effects at their typical size."""
    unknown = {p.name for p in model.parameters}
    wrong = [name for name in given if name not in unknown]
    if wrong:
        raise UsageError(f"--value {wrong[0]}: unknowns are {', '.join(sorted(unknown))}")
    values: dict[str, Array] = {}
    typical = {f"{a.label}.{name}": size for a in model.effects for name, size in a.effect.typical}
    for p in model.parameters:
        value = p.shape.unpack(p.start_value()) if not p.shape.curved else p.shape.default()
        if p.name in typical:
            value = np.full(np.shape(value), typical[p.name])
        if p.name in given:
            value = np.broadcast_to(np.asarray(given[p.name], dtype=float), np.shape(value))
        values[p.name] = np.asarray(value, dtype=float)
    return values


def times(duration: float | None, rate: float | None) -> Array:
    """Times of the samples, s."""
    if duration is None or rate is None:
        raise UsageError("say --duration and --rate, or give the other signals with --input FILE")
    if not (duration > 0 and rate > 0 and np.isfinite(duration * rate)):
        raise UsageError(f"--duration {duration:g} --rate {rate:g}: both must be positive")
    return np.arange(0.0, duration, 1 / rate)


def without_data(
    model: Model,
    *,
    duration: float | None,
    rate: float | None,
    directions: int | None,
    rng: np.random.Generator,
) -> Run:
    """A run of signals that need no record: time, random attitudes; readings still zero."""
    needed = [s for s in model.signals if s.name not in model.traced.readings]
    given = [s.name for s in needed if s.kind != "rotation" and (s.unit != "s" or s.size > 1)]
    if given and not model.implicit:
        raise UsageError(f"{model.name} needs {', '.join(given)}: give --input FILE with them")
    if model.implicit or any(s.kind == "rotation" for s in needed):
        if directions is None:
            raise UsageError(
                f"{model.name} says what readings correct to, not where the sensor points: give "
                "--directions N for N random ones" + (", or --input" if not model.implicit else "")
            )
        if directions < 1:
            raise UsageError(f"--directions {directions}: at least one")
        count, time = directions, None
    else:
        time = times(duration, rate)
        count = len(time)
    signals = {}
    for s in model.signals:
        if s.kind == "rotation":
            signals[s.name] = _rotations(count, rng)
        elif time is not None and s.unit == "s" and s.size == 1:
            signals[s.name] = time[:, None]
        else:
            signals[s.name] = np.zeros((count, s.size))
    units = {s.name: s.unit for s in model.signals}
    return Run.raw("simulated", signals, units=units, time=time)


def with_record(model: Model, file: str, arguments: Mapping[str, Any]) -> Run:
    """A run with the signals of a file, and readings of zero where it has none."""
    measured = model.traced.readings
    if model.implicit:
        raise UsageError(f"{model.name}: give --directions N instead of --input")
    needed = [s for s in model.signals if s.name not in measured]
    runs = load_runs([file], needed, **arguments)
    if len(runs) > 1:
        raise UsageError(f"{file}: {len(runs)} runs; give one")
    run, own = runs[0], [model[name] for name in measured]
    signals = {**run.signals, **{s.name: np.zeros((len(run), s.size)) for s in own}}
    units = {**run.units, **{s.name: s.unit for s in own}}
    made = Run.raw("simulated", signals, units=units, time=run.time)
    return replace(made, columns=run.columns, column_units=run.column_units)


def _rotations(count: int, rng: np.random.Generator) -> Array:
    """Rotation matrices (count, 9), row by row, uniform on the sphere of quaternions."""
    w, x, y, z = (q := rng.standard_normal((4, count))) / np.linalg.norm(q, axis=0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([entry for row in rows for entry in row], axis=1)


def simulated(
    model: Model, run: Run, values: Mapping[str, Array], noise: float, rng: np.random.Generator
) -> dict[str, Array]:
    """Readings (N, m) of the measured signals, with white noise of std `noise`."""
    if not (noise >= 0 and np.isfinite(noise)):
        raise UsageError(f"--noise {noise:g}: a standard deviation, not negative")
    run = prepared(model, (run,))[0]
    if model.implicit:
        clean = _of_directions(model, run, values, rng)
    else:
        clean = _predicted(model, run, values)
    if not all(np.all(np.isfinite(v)) for v in clean.values()):
        zero = [name for name, value in values.items() if not np.any(value)]
        way = f"{', '.join(zero)} are 0" if len(zero) > 1 else f"{zero[0]} is 0" if zero else ""
        raise UsageError(
            f"{model.name}: the readings are not finite with these values{way and f' ({way})'}; "
            f"give others: --value {zero[0] if zero else 'NAME'}=…"
        )
    return {name: v + noise * rng.standard_normal(v.shape) for name, v in clean.items()}


def _predicted(model: Model, run: Run, values: Mapping[str, Array]) -> dict[str, Array]:
    """What is left of readings zero and one tells the prediction: ± (reading − prediction).

    Of differential equations states and what is read of them.
    """
    left = []
    if model.traced.integrates:
        problem = Problem(model, (run,))
        found = problem.evaluate(problem.point(dict(values)), {"p": model.along.predicted})[0][0]
        sizes = [model[name].size for name in model.traced.readings]
        parts = np.split(found[:, :, 0], np.cumsum(sizes)[:-1], axis=1)
        return dict(zip(model.traced.readings, parts, strict=True))
    name = str(model.traced.measured)
    for level in (0.0, 1.0):
        signals = {**run.signals, name: np.full_like(run.signals[name], level)}
        problem = Problem(model, (_with(run, signals),))
        left.append(problem.residuals(problem.point(dict(values)))[0])
    return {name: np.asarray(-left[0] / (left[1] - left[0]))}


def _with(run: Run, signals: Mapping[str, Array]) -> Run:
    made = Run.raw(run.name, dict(signals), units=run.units, time=run.time)
    return replace(made, columns=run.columns, column_units=run.column_units)


def _of_directions(
    model: Model, run: Run, values: Mapping[str, Array], rng: np.random.Generator
) -> dict[str, Array]:
    """Readings that correct to random directions of the known length."""
    plain_signals = [s for s in model.signals if s.kind == "plain" and s.size == 3]
    length = _known_length(model, values)
    if length is None or len(plain_signals) != 1:
        raise UsageError(
            f"{model.name} is implicit, and no constant of it is the length of what is corrected: "
            "its readings cannot be simulated"
        )
    name = plain_signals[0].name
    target = rng.standard_normal((len(run), 3))
    target *= length / np.linalg.norm(target, axis=1, keepdims=True)
    function = Correction(model).as_function()[1]
    point = np.concatenate(model.point(dict(values)))
    v = ca.SX.sym("v", 3)
    at = {name: v}
    sample = ca.vertcat(*[at.get(s.name, ca.SX.zeros(s.size)) for s in model.signals])
    value = function(ca.SX(ca.DM(point)), sample)
    f = ca.Function("c", [v], [ca.densify(value), ca.densify(ca.jacobian(value, v))])
    readings = np.zeros_like(target)
    for k, wanted in enumerate(target):
        for _ in range(50):
            here, slope = (np.array(part) for part in f(readings[k]))
            step = np.linalg.solve(slope, wanted - here.ravel())
            readings[k] += step
            if np.linalg.norm(step) <= 1e-14 * (1 + np.linalg.norm(readings[k])):
                break
    return {name: readings}


def _known_length(model: Model, values: Mapping[str, Array]) -> float | None:
    """The constant that is the length of what is corrected: the residual says so, being zero then.

    It is tried at random readings, with each constant in turn set to the length that they have.
    """
    corrected = model.traced.corrected
    if corrected is None or model.traced.quantities[corrected].value.shape != (3, 1):
        return None
    point = np.concatenate(model.point(dict(values)))
    sample = np.random.default_rng(0).standard_normal(sum(s.size for s in model.signals))

    def tried(**lengths: float) -> tuple[float, float]:
        """Size of the residual, and length of what is corrected."""
        of = model.having(**lengths)
        corrected_now = of.traced.quantities[corrected].value
        outputs = {"residual": of.traced.expression, "corrected": corrected_now}
        found = function_of(of, outputs)(point, sample)
        return float(ca.norm_2(found[0])), float(ca.norm_2(found[1]))

    length = tried()[1]
    for c in (c for c in model.constants if not c.dims):
        near, far = tried(**{c.name: length})[0], tried(**{c.name: 2 * length})[0]
        if near < 1e-9 * far:
            return float(c.array)
    return None


def written(
    folder: Path,
    model: Model,
    run: Run,
    values: Mapping[str, Array],
    noise: float,
    sensors: Mapping[str, list[float]],
    seed: int,
    command: str,
) -> tuple[Path, Path]:
    """`record.csv` and `truth.json` in the folder; `sensors` is the noise of single signals."""
    text = record_text(model.signals, run)
    content = {
        "casest": __version__,
        "model": model.name,
        "command": command,
        "seed": seed,
        "noise": noise,
        "sensor_noise": dict(sensors),
        "parameters": {n: plain(v) for n, v in values.items()},
        "constants": {c.name: plain(c.array) for c in model.constants},
        "effects": [a.label for a in model.effects],
    }
    record, truth_file = folder / "record.csv", folder / "truth.json"
    make_folder(folder)
    write_atomically(record, text)
    write_atomically(truth_file, json.dumps(content, indent=1) + "\n")
    return record, truth_file


def record_text(declared: Sequence[Signal], run: Run) -> str:
    """The table of a run: time, declared signals with their units, every other column."""
    head, columns = [], []
    if run.time is not None and "t" not in run.signals:
        head.append("t [s]")
        columns.append(run.time)
    for s in declared:
        unit = f" [{s.unit}]" if s.unit else ""
        if s.name in run.columns:
            continue
        for k, label in enumerate(_labels(s.name, s.size, s.kind)):
            head.append(label + ("" if s.kind == "rotation" else unit))
            columns.append(_numbers(run.signals[s.name], s.kind)[:, k])
    for column, found in run.columns.items():
        head.append(column)
        columns.append(np.asarray(found))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for row in zip(*columns, strict=True):
        writer.writerow([f"{x:.12g}" if isinstance(x, float) else x for x in row])
    return text.getvalue()


def _labels(name: str, size: int, kind: str) -> list[str]:
    if kind == "rotation":
        return ["qw", "qx", "qy", "qz"]
    if size == 1:
        return [name]
    if size == 3:
        return [f"{name}{axis}" for axis in "xyz"]
    return [f"{name}[{k}]" for k in range(size)]


def _numbers(value: Array, kind: str) -> Array:
    if kind != "rotation":
        return value
    from scipy.spatial.transform import Rotation

    q = Rotation.from_matrix(value.reshape(-1, 3, 3)).as_quat()
    return np.asarray(q[:, [3, 0, 1, 2]])
