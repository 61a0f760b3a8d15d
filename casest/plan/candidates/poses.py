"""Poses at rest: what an implicit model reads as the sensor is turned, or an attitude that is told.

A model at rest is zero wherever a vector known in the reference frame has been turned into the
sensor's: so one reading that satisfies it, turned, gives all others. Whether that holds is tried.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from casest.correction.inverse import Correction, invertible
from casest.data.run import Run
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.tracing import function_of
from casest.errors import UsageError
from casest.plan.candidates.attitudes import Frame, attitude_words, attitudes, directions, words
from casest.plan.candidates.candidates import Candidates, Noise, blank, predicted
from casest.plan.candidates.rows import of_run

#: Steps to a reading that satisfies the model, and starts from which they are made.
STEPS, STARTS = 100, 20
#: Residual of a turned reading, as a share of its length, up to which it satisfies the model.
ZERO = 1e-7


def rotation_signal(model: Model) -> str | None:
    """The signal that is an attitude, where there is one."""
    return next((s.name for s in model.signals if s.kind == "rotation"), None)


def at_rest(model: Model) -> bool:
    """Does the model compare a corrected vector, or several, with what is known of it at rest?"""
    corrected = model.traced.corrected
    if not model.implicit or corrected is None:
        return False
    return bool(model.traced.quantities[corrected].value.numel() % 3 == 0)


def poses(
    model: Model,
    values: Mapping[str, Any],
    noise: Noise,
    *,
    step: float,
    reach: float | None,
    others: Mapping[str, Array],
) -> Candidates:
    """Poses of a model at rest. `others` are values of further signals, one row each."""
    known = known_vectors(model, values, {name: rows[0] for name, rows in others.items()})
    frame = _frame(model, len(known))
    if len(known) == 1:
        up = directions(step, reach)
        target = np.linalg.norm(known[0]) * up
        said = [words(u, frame) for u in up]
    else:
        R = attitudes(step, reach)
        target = np.hstack([np.einsum("nji,j->ni", R, block) for block in known])
        up, said = R[:, 2], [attitude_words(each, frame) for each in R]
    rows = len(next(iter(others.values()))) if others else 1
    target, up = np.repeat(target, rows, axis=0), np.repeat(up, rows, axis=0)
    said = [each for each in said for _ in range(rows)]
    beside = {name: np.tile(value, (len(target) // rows, 1)) for name, value in others.items()}
    readings = _readings(model, values, target, beside)
    run = blank(model, len(target), {**beside, **readings})
    said = [_beside(text, beside, i, model) for i, text in enumerate(said)]
    return of_run(model, values, noise, run, said, np.ones(len(target)), up, "pose")


def told_attitudes(
    model: Model,
    values: Mapping[str, Any],
    noise: Noise,
    *,
    step: float,
    reach: float | None,
    others: Mapping[str, Array],
) -> Candidates:
    """Poses of a model that is told the attitude."""
    name = str(rotation_signal(model))
    R = attitudes(step, reach)
    frame = Frame("along Z", "against Z", "along X")
    said = [attitude_words(each, frame) for each in R]
    rows = len(next(iter(others.values()))) if others else 1
    R, said = np.repeat(R, rows, axis=0), [each for each in said for _ in range(rows)]
    beside = {n: np.tile(value, (len(R) // rows, 1)) for n, value in others.items()}
    run = predicted(model, values, blank(model, len(R), {**beside, name: R.reshape(-1, 9)}))
    said = [_beside(text, beside, i, model) for i, text in enumerate(said)]
    return of_run(model, values, noise, run, said, np.ones(len(R)), R[:, 2], "pose")


def upward(model: Model, values: Mapping[str, Any], runs: Sequence[Run]) -> Array:
    """Directions of up (N, 3), in the sensor's frame, of the samples of records at rest."""
    name = rotation_signal(model)
    if name is not None:
        return np.vstack([run.signals[name].reshape(-1, 3, 3)[:, 2] for run in runs])
    corrected = Correction(invertible(model)[0])
    found = np.vstack([corrected(run, values)[:, :3] for run in runs])
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _beside(text: str, beside: Mapping[str, Array], i: int, model: Model) -> str:
    said = [f"{n} {_number(value[i])}{_unit(model, n)}" for n, value in beside.items()]
    return "; ".join([text, *said])


def _number(value: Array) -> str:
    return ", ".join(f"{x:g}" for x in value)


def _unit(model: Model, name: str) -> str:
    unit = model[name].unit if name in model.symbols else ""
    return f" {unit}" if unit and unit != "1" else ""


def _frame(model: Model, blocks: int) -> Frame:
    """Words for up: an accelerometer's, or those of whatever vector is known."""
    units = " ".join(filter(None, (s.unit for s in model.readings)))
    constants = " ".join(c.unit for c in model.constants)
    if blocks == 1 and any(u in f"{units} {constants}".split() for u in MAGNETIC):
        return Frame("along the field", "against the field")
    return Frame(ahead="north")


#: Units of a magnetic flux density.
MAGNETIC = ("T", "mT", "uT", "nT", "gauss", "mgauss")


def known_vectors(
    model: Model, values: Mapping[str, Any], others: Mapping[str, Array]
) -> list[Array]:
    """What is corrected as the sensor lies with z up: vectors (3,), the first along z.

    UsageError where the model is not satisfied wherever the sensor is turned.
    """
    tried = _Tried(model, values, others)
    found = tried.satisfying()
    blocks = tried.corrected(found).reshape(-1, 3)
    first = blocks[0] / np.linalg.norm(blocks[0])
    side = np.eye(3)[int(np.argmin(np.abs(first)))] if len(blocks) == 1 else blocks[1]
    y = np.cross(first, side)
    y /= np.linalg.norm(y)
    R = np.array([np.cross(y, first), y, first])
    lying = [R @ block for block in blocks]
    rng = np.random.default_rng(1)
    for _ in range(3):
        Q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        Q *= np.linalg.det(Q)
        reading = tried.reading(np.concatenate([Q @ block for block in lying]))
        if not np.linalg.norm(tried.residual(reading)) < ZERO * np.linalg.norm(reading):
            raise UsageError(
                f"{model.name}: its poses cannot be guessed (a turned sensor does not satisfy it); "
                "give what can be measured: --candidates FILE"
            )
    return lying


class _Tried:
    """The model as functions of one reading."""

    def __init__(self, model: Model, values: Mapping[str, Any], others: Mapping[str, Array]):
        self.model = invertible(model)[0]
        traced = model.traced
        corrected = ca.densify(ca.vec(traced.quantities[str(traced.corrected)].value))
        outputs = {"r": traced.expression, "c": corrected}
        self.point = np.concatenate([np.zeros(0), *model.point(dict(values))])
        self.sizes = [s.size for s in model.readings]
        reading = ca.SX.sym("reading", sum(self.sizes))
        parts = dict(
            zip((s.name for s in model.readings), _split(reading, self.sizes), strict=True)
        )
        given = {name: ca.DM(value) for name, value in others.items()}
        sample = ca.vertcat(
            *[parts.get(s.name, given.get(s.name, ca.DM.zeros(s.size))) for s in model.signals]
        )
        r, c = function_of(model, outputs)(ca.DM(self.point), sample)
        self.f = ca.Function(
            "at", [reading], [r, ca.jacobian(r, reading), c, ca.jacobian(c, reading)]
        )

    def residual(self, reading: Array) -> Array:
        return np.array(self.f(reading)[0]).ravel()

    def corrected(self, reading: Array) -> Array:
        return np.array(self.f(reading)[2]).ravel()

    def satisfying(self) -> Array:
        """A reading with residual zero, by Gauss-Newton steps from several starts."""
        rng = np.random.default_rng(0)
        for size in (1.0, 10.0, 50.0, 1000.0) * (STARTS // 4):
            x = size * rng.standard_normal(sum(self.sizes))
            for _ in range(STEPS):
                r, J = (np.array(part) for part in self.f(x)[:2])
                if not (np.isfinite(r).all() and np.isfinite(J).all()):
                    break
                if np.linalg.norm(r) <= 1e-11 * np.linalg.norm(x):
                    return x
                x = x - np.linalg.lstsq(J, r.ravel(), rcond=None)[0]
        raise UsageError(
            f"{self.model.name}: no reading satisfies it with these values; give others: --value"
        )

    def reading(self, target: Array) -> Array:
        """The reading that corrects to the target, by Newton's method."""
        x = np.array(target, dtype=float)
        for _ in range(STEPS):
            c, J = (np.array(part) for part in self.f(x)[2:])
            step = np.linalg.lstsq(J, target - c.ravel(), rcond=None)[0]
            x = x + step
            if np.linalg.norm(step) <= 1e-13 * (1 + np.linalg.norm(x)):
                break
        return x


def _readings(
    model: Model, values: Mapping[str, Any], target: Array, beside: Mapping[str, Array]
) -> dict[str, Array]:
    """Readings (N, size) of each signal that correct to the targets."""
    alike: dict[tuple[float, ...], list[int]] = {}
    for i in range(len(target)):
        alike.setdefault(tuple(x for value in beside.values() for x in value[i]), []).append(i)
    rows = np.zeros((len(target), sum(s.size for s in model.readings)))
    for places in alike.values():
        tried = _Tried(model, values, {name: value[places[0]] for name, value in beside.items()})
        rows[places] = [tried.reading(target[i]) for i in places]
    ends = np.cumsum([s.size for s in model.readings])[:-1]
    parts = np.split(rows, ends, axis=1)
    return dict(zip((s.name for s in model.readings), parts, strict=True))


def _split(symbol: Any, sizes: list[int]) -> list[Any]:
    return list(ca.vertsplit(symbol, [0, *np.cumsum(sizes).tolist()]))
