"""Effects that look at other samples than a residual's own: memory, and signals that come late.

Each is a stage: what it takes at every sample is computed first, then what it gives, with its
slopes in the parameters, and that takes the place of a symbol in what comes after. A memory is run
through sample by sample; a signal at another time is taken from its record by splines.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from casest.data.curves import Curve
from casest.data.run import Run
from casest.declaration.effect import Attached
from casest.declaration.model import Model
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import sample_symbol
from casest.engine import Replay
from casest.errors import DataError
from casest.leastsquares.memory import Memory


@dataclass(frozen=True)
class Staged:
    """Residual and Jacobian of an explicit model with effects that look at other samples."""

    model: Model
    runs: tuple[Run, ...]

    @cached_property
    def _curves(self) -> dict[tuple[int, str], Curve]:
        return {}

    def rows(
        self, parameters: Array, samples: Array, r: int, own: tuple[int, ...] | None = None
    ) -> tuple[Array, Array]:
        """Residuals (N, m) and Jacobians (N, m, n) of run r, block by block of its record.

        `own`: the coordinates that slopes are taken in, where not in all.
        """
        *stages, last = _programs(self.model, own)
        time = _time(self.runs[r])
        given = np.zeros((len(samples), 0))
        count = self.model.staged.coordinates.numel() if own is None else len(own)
        slopes = np.zeros((len(samples), 0, count))
        for stage in stages:
            if stage.moment is not None:
                more = self._late(stage.attached, stage.moment, parameters, r, time)
            else:
                assert stage.memory is not None
                taken = _chained(stage.taken, parameters, samples, given, slopes)
                more = stage.memory.along(parameters, *taken, time, self.runs[r].block)
            given = np.concatenate([given, more[0]], axis=1)
            slopes = np.concatenate([slopes, more[1]], axis=1)
        return _chained(last.taken, parameters, samples, given, slopes)

    def _late(
        self, attached: Attached, moment: Replay, parameters: Array, r: int, time: Array
    ) -> tuple[Array, Array]:
        """A signal at the times at which the effect says that it is taken, and its slopes."""
        at, slope = moment(parameters, time[:, None])
        wanted, curve = at[:, 0, 0], self._curve(r, attached.on, time)
        # Within its own record a signal crosses no gap; another file's has gaps of its own.
        apart = attached.on in self.runs[r].elsewhere
        value, rate = curve.at(wanted, curve.nearest(wanted) if apart else curve.stretch)
        return value, rate[:, :, None] * slope

    def _curve(self, r: int, name: str, time: Array) -> Curve:
        if (r, name) not in self._curves:
            run, rotation = self.runs[r], self.model[name].kind == "rotation"
            other = run.elsewhere.get(name)
            if other is not None:
                made = Curve.through(other.time, other.values, other.block, rotation=rotation)
            else:
                made = Curve.through(time, run.signals[name], run.block, rotation=rotation)
            self._curves[r, name] = made
        return self._curves[r, name]


@dataclass(frozen=True)
class Program:
    """What is computed of one stage: what it takes, and how it goes on from it.

    The last of a model's is its residual, with no effect behind it.
    """

    attached: Attached
    taken: Replay
    moment: Replay | None = None
    memory: Memory | None = None


@lru_cache(maxsize=64)
def _programs(model: Model, own: tuple[int, ...] | None = None) -> tuple[Program, ...]:
    traced, found, given = model.staged, [], ca.SX(0, 1)
    coordinates = traced.coordinates if own is None else traced.coordinates[list(own)]
    parameters = ca.vertcat(traced.coordinates, traced.references)

    def slopes(expression: SX, *of: SX) -> list[SX]:
        return [ca.densify(expression), *(ca.jacobian(expression, x) for x in of)]

    def replay(expression: SX) -> Replay:
        sample = ca.vertcat(sample_symbol(model, traced), given)
        outputs = slopes(expression, coordinates, given)
        return _replay("stage", [parameters, sample], outputs)

    for stage in traced.stages:
        if stage.attached.kind == "time":
            t = ca.SX.sym("t")
            moment = ca.SX(stage.attached.apply(t, traced.symbols))
            outputs = slopes(moment, coordinates)
            f = _replay("moment", [parameters, t], outputs)
            found.append(Program(stage.attached, f, moment=f))
        else:
            memory = Memory(model, stage, own)
            found.append(Program(stage.attached, replay(stage.taken), memory=memory))
        given = ca.vertcat(given, stage.given)
    return (*found, Program(traced.stages[-1].attached, replay(traced.expression)))


def _replay(name: str, inputs: list[SX], outputs: list[SX]) -> Replay:
    names = [f"out{k}" for k in range(len(outputs))]
    return Replay(ca.Function(name, inputs, outputs, ["parameters", "sample"], names))


def _time(run: Run) -> Array:
    if run.time is None:
        raise DataError(
            f"{run.file or run.name}: an effect that looks at other samples needs time: give a "
            "time column or --rate"
        )
    return run.time


def _chained(
    taken: Replay, parameters: Array, samples: Array, given: Array, slopes: Array
) -> tuple[Array, Array]:
    """Values (N, m) and slopes in the parameters (N, m, n), also by way of the stages before."""
    value, direct, through = taken(parameters, np.hstack([samples, given]))
    return value[:, :, 0], direct + through @ slopes if given.size else direct
