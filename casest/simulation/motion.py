"""`casest simulate` of an estimator in motion: a record along a trajectory, its truth beside it.

Inputs and outputs get the noise that the intensities say, the states that of their own driving; an
effect of the catalogue of motion makes a sensor read otherwise than the declared model thinks.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casest import __version__
from casest.data import load_runs
from casest.data.run import Run
from casest.data.write import make_folder, write_atomically
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.diagnose.motion.candidates import candidates, prepared
from casest.dynamics.declare import Dynamics
from casest.dynamics.samples import over_samples, replay
from casest.dynamics.transition import checked_time, usual
from casest.effects.moving import COLOURED, TIME_DELAY, Body, Candidate, Colour, Numbers, extended
from casest.errors import UsageError
from casest.results.file import plain
from casest.simulation.record import record_text
from casest.simulation.trajectory import Course, course_along, input_names, random_course

#: Correlation time of coloured noise that nobody says, in samples; its std in those of a reading.
COLOUR_TIME, COLOUR_STD = 25.0, 1.0


@dataclass(frozen=True)
class Simulated:
    """A record, the true states (N, n) at its samples, and what was put into it.

    `noise`: std of one reading of every signal (of the median sample), `effects`: their numbers.
    """

    model: Dynamics
    run: Run
    states: Array
    noise: Mapping[str, float]
    effects: Mapping[str, Any]


def inputs_of(model: Dynamics, file: str, arguments: Mapping[str, Any]) -> Run:
    """The inputs of a record, which become the true ones."""
    needed = [s for s in model.signals if s.name in input_names(model)]
    runs = load_runs([file], needed, **arguments)
    if len(runs) > 1:
        raise UsageError(f"{file}: {len(runs)} runs; give one")
    checked_time(runs[0])
    return runs[0]


def simulated_motion(
    model: Dynamics,
    t: Array,
    rng: np.random.Generator,
    *,
    inputs: Mapping[str, Array] | None = None,
    noise: float | None = None,
    effects: Sequence[str] = (),
    values: Mapping[str, Any] | None = None,
) -> Simulated:
    """A record at times t (N,), s, along `inputs` (N, size) or a smooth random motion.

    States begin at their declared start and are driven by their declared intensities; signals get
    white noise of their intensity over the time between samples. `noise`: std of every output
    instead, 0 for none. `effects`: `"lever_arm(v)"`, of a typical size unless `values` says
    `v_lever_arm`; `values` of states are their start. Raises UsageError for a name that is none.
    """
    if noise is not None and not (noise >= 0 and np.isfinite(noise)):
        raise UsageError(f"--noise {noise:g}: a standard deviation, not negative")
    values = dict(values or {})
    model = model.beginning(**{s.name: values.pop(s.name) for s in model.states
                               if s.name in values})  # fmt: skip
    early = _longest_delay(model, values)
    if inputs is None:
        course = random_course(model, t, rng, early=early)
    else:
        course = course_along(model, t, inputs, rng, early=early)
    std = _stds(model, t, noise)
    clean = _run(model, t, course.inputs(t) | _outputs(model, course, t))
    chosen = [_chosen(model, clean, text, std) for text in effects]
    placed = _placed(chosen, values, clean)
    signals = _sensed(model, course, t, placed)
    for name, own in std.items():
        signals[name] = signals[name] + own[:, None] * rng.standard_normal(signals[name].shape)
    for kind, value in placed:
        if isinstance(kind, Colour):
            tau, size = value
            signals[kind.on] = signals[kind.on] + _coloured(t, kind.size, tau, size, rng)
    told = {kind.state: _numbers(kind, value) for kind, value in placed}
    middle = {name: float(np.median(own)) for name, own in std.items()}
    return Simulated(model, _run(model, t, signals), course.states(t), middle, told)


def _run(model: Dynamics, t: Array, signals: Mapping[str, Array]) -> Run:
    ordered = {s.name: signals[s.name] for s in model.signals}
    return Run.raw("simulated", ordered, units={s.name: s.unit for s in model.signals}, time=t)


def _stds(model: Dynamics, t: Array, noise: float | None) -> dict[str, Array]:
    """Standard deviation of each reading of each signal, (N,)."""
    period = usual(np.diff(t))
    intensities = {n: q for n, q in model.sensors.items() if q}
    intensities |= {n: model.intensity_of(n, period) for n in model.measured_signals}
    found = {name: np.full(len(t), np.sqrt(q / period)) for name, q in intensities.items()}
    if noise is not None:
        found |= {name: np.full(len(t), noise) for name in model.measured_signals}
    return found


# -- effects -----------------------------------------------------------------------------------

_Kind = Candidate | Colour


def _chosen(model: Dynamics, run: Run, text: str, std: Mapping[str, Array]) -> _Kind:
    """The effect that `lever_arm(v)` names; the signal may be left out where there is one."""
    colours = [_colour(model, name, run, std) for name in model.measured_signals]
    ready = prepared(model, run)
    every: list[_Kind] = [*map(_freed, candidates(model, ready)), *colours]
    said = re.fullmatch(r"(\w+)(?:\((\w+)\))?", text)
    found = [c for c in every if said and _name(c) == said[1] and said[2] in (None, c.on)]
    if len(found) == 1:
        return found[0]
    names = ", ".join(f"{_name(c)}({c.on})" for c in (found or every))
    what = "which of" if found else "no such effect; there are"
    raise UsageError(f"--effect {text}: {what} {names}{'?' if found else ''}")


def _freed(candidate: Candidate) -> Candidate:
    """With what it is searched over among its numbers."""
    return candidate.free([name for name, _ in candidate.held])[0]


def _usual(numbers: Numbers, run: Run) -> Array:
    """A typical size; of a moment the middle of the record, of a frequency a twentieth of its
    rate."""
    assert run.time is not None
    if numbers.name == "when":
        value = float(np.mean(run.time[[0, -1]]) - run.time[0])
    elif numbers.name == "frequency":
        value = float(2 * np.pi * 0.05 / np.median(np.diff(run.time)))
    else:
        value = numbers.typical if np.isfinite(numbers.typical) else 0.01
    return np.full(numbers.size, value)


def _colour(model: Dynamics, name: str, run: Run, std: Mapping[str, Array]) -> Colour:
    signal = next(s for s in model.signals if s.name == name)
    assert run.time is not None
    tau = COLOUR_TIME * float(np.median(np.diff(run.time)))
    size = COLOUR_STD * float(np.median(std[name]))
    return Colour(name, signal.size, signal.unit or "1", tau, size)


def _name(kind: _Kind) -> str:
    return COLOURED if isinstance(kind, Colour) else kind.effect.name


def _placed(
    chosen: Sequence[_Kind], values: Mapping[str, Any], run: Run
) -> list[tuple[_Kind, Array]]:
    """Each effect with its numbers; of noise with a colour (correlation time, std)."""
    rest, placed = dict(values), list[tuple[_Kind, Array]]()
    for kind in chosen:
        if isinstance(kind, Colour):
            pair = [rest.pop(f"{kind.state}.{word}", usual) for word, usual in
                    (("correlation_time", kind.tau), ("std", kind.std))]  # fmt: skip
            placed.append((kind, np.array(pair, float).ravel()))
            if len(placed[-1][1]) != 2 or not (placed[-1][1] > 0).all():
                raise UsageError(f"--value {kind.state}: correlation time and std are positive")
            continue
        parts = [_given(kind, n, rest, run) for n in kind.numbers]
        placed.append((kind, np.concatenate(parts)))
    if rest:
        known = [w for kind, _ in placed for w in _value_names(kind)]
        more = f" and {', '.join(known)}" if known else ""
        raise UsageError(f"--value {next(iter(rest))}: there are the states{more}")
    return placed


def _given(kind: Candidate, numbers: Numbers, rest: dict[str, Any], run: Run) -> Array:
    """What --value says of some numbers of an effect, which it takes out of the rest."""
    name = _named(kind, numbers)
    value = np.asarray(rest.pop(name, _usual(numbers, run)), float)
    if value.size not in (1, numbers.size):
        raise UsageError(f"--value {name}: {value.size} numbers, {kind.label} has {numbers.size}")
    return np.array(np.broadcast_to(value.ravel(), (numbers.size,)))


def _named(kind: Candidate, numbers: Numbers) -> str:
    """`omega_bias`; `v_bias_step.when` where there are several sorts of numbers."""
    return kind.state if len(kind.numbers) == 1 else f"{kind.state}.{numbers.name}"


def _value_names(kind: _Kind) -> list[str]:
    if isinstance(kind, Candidate):
        return [_named(kind, n) for n in kind.numbers]
    return [f"{kind.state}.correlation_time", f"{kind.state}.std"]


def _numbers(kind: _Kind, value: Array) -> Any:
    if not isinstance(kind, Candidate):
        pair = {"correlation_time": plain(value[0]), "std": plain(value[1])}
        return {**pair, "unit": kind.unit}
    own = kind.named(value)
    if len(own) == 1:
        (numbers,) = kind.numbers
        return {numbers.name: plain(value), "unit": numbers.unit}
    return {n.name: {"value": plain(own[n.name]), "unit": n.unit} for n in kind.numbers}


def _longest_delay(model: Dynamics, values: Mapping[str, Any]) -> float:
    """How long before the record the truth must be known, s."""
    late = {f"{s.name}_{TIME_DELAY.name}" for s in model.signals}
    given = [np.max(np.asarray(v, float), initial=0.0) for n, v in values.items() if n in late]
    return float(max([1.0, *given]))


def _sensed(
    model: Dynamics, course: Course, t: Array, placed: Sequence[tuple[_Kind, Array]]
) -> dict[str, Array]:
    """What sensors read without noise, (N, size) each."""
    of_mean = [(kind, value) for kind, value in placed if isinstance(kind, Candidate)]
    delays = {k: float(v[0]) for k, v in of_mean if k.in_time}
    changed = [(k, v) for k, v in of_mean if k.place == "output" and k not in delays]
    there = extended(model, changed)
    signals = course.inputs(t)
    for kind, value in of_mean:
        if kind.place == "input":
            signals[kind.on] = _misread(kind, value, {**signals, "t": (t - t[0])[:, None]})
    signals |= _outputs(there, course, t)
    for kind, late in delays.items():
        if not -(t[1] - t[0]) <= late < t[-1] - t[0]:
            raise UsageError(f"--value {kind.state}={late:g}: not within the record")
        signals[kind.on] = _outputs(there, course, np.minimum(t - late, t[-1]))[kind.on]
    return signals


def _outputs(model: Dynamics, course: Course, t: Array) -> dict[str, Array]:
    """Every output at any times of the course."""
    traced = model.traced
    given = {"t": (t - t[0])[:, None], **course.inputs(t)}
    zeros = {s.name: np.zeros((len(t), s.size)) for s in model.signals}
    sample = ca.vertcat(traced.x, *[flat(traced.symbols[s.name]) for s in model.signals])
    columns = [(zeros | given)[s.name] for s in model.signals]
    states = np.ascontiguousarray(course.states(t))
    (h,) = over_samples(replay(sample, [traced.h]), [states, *map(np.ascontiguousarray, columns)])
    found, place = {}, 0
    for name, o in zip(traced.measured, traced.outputs, strict=True):
        found[name] = h[:, place : place + o.predicted.numel(), 0]
        place += o.predicted.numel()
    return found


def _misread(kind: Candidate, value: Array, true: Mapping[str, Array]) -> Array:
    """What an input reads (N, size) so that the effect gives the true one back."""
    read = {s.name: ca.SX.sym(s.name, s.size) for s in kind.reads}
    own = true[kind.on]
    y, k = ca.SX.sym("y", own.shape[1]), ca.SX(ca.DM(value))
    if kind.attached is None:  # linear in the reading
        back = kind.changed(y, k, Body())
        zero, slope = ca.Function("back", [y], [ca.densify(back), ca.jacobian(back, y)])(0)
        return np.linalg.solve(slope.full(), (own - zero.full().T).T).T
    sensed = ca.densify(kind.sensed(y, k, Body(read={**read, kind.on: y})))
    columns = [true[name] for name in read]
    function = ca.Function("sensed", [y, *read.values()], [sensed]).map(len(own))
    return np.asarray(function(own.T, *[c.T for c in columns]).full().T)


def _coloured(t: Array, size: int, tau: float, std: float, rng: np.random.Generator) -> Array:
    """Exponentially correlated noise, (N, size)."""
    keep = np.exp(-np.diff(t) / tau)
    found = std * rng.standard_normal((len(t), size))
    found[1:] *= np.sqrt(1 - keep**2)[:, None]
    for k, share in enumerate(keep):
        found[k + 1] += share * found[k]
    return found


# -- files -------------------------------------------------------------------------------------


def written_motion(
    folder: Path, made: Simulated, seed: int, command: str
) -> tuple[Path, Path, Path]:
    """`record.csv`, `truth.json`, and `truth.csv` with the states over time, in the folder."""
    model = made.model
    content = {
        "casest": __version__,
        "model": model.name,
        "command": command,
        "seed": seed,
        "noise": {
            "readings": {n: {"std": plain(s), "unit": _unit(model, n)}
                         for n, s in made.noise.items()},
            "driving": {s.name: {"intensity": plain(s.intensity), "unit": f"({s.unit})^2/s"}
                        for s in model.states},
        },
        "states": {
            name: {"start": plain(made.states[0, where]), "end": plain(made.states[-1, where]),
                   "unit": model[name].unit}
            for name, where in model.slices().items()
        },
        "parameters": dict(made.effects),
        "constants": {c.name: plain(c.array) for c in model.constants},
        "effects": list(made.effects),
    }  # fmt: skip
    paths = folder / "record.csv", folder / "truth.json", folder / "truth.csv"
    make_folder(folder)
    time = np.asarray(made.run.time)
    heads = [f"{n} [{u}]" for n, u in zip(model.names, model.state_units, strict=True)]
    write_atomically(paths[0], record_text(model.signals, made.run))
    write_atomically(paths[1], json.dumps(content, indent=1) + "\n")
    rows = [",".join(["t [s]", *heads])]
    rows += [",".join(f"{x:.12g}" for x in row) for row in np.column_stack([time, made.states])]
    write_atomically(paths[2], "\n".join(rows) + "\n")
    return paths


def _unit(model: Dynamics, name: str) -> str:
    return next(s.unit or "1" for s in model.signals if s.name == name)
