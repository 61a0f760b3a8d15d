"""What looks at other samples than a residual's own: memory, late signals, the rest before.

Each is a stage: what it takes at every sample is computed first, then what it gives, with its
slopes in the parameters, and that takes the place of a symbol in what comes after. A memory is run
through sample by sample; a signal at another time is taken from its record by splines; a turn is
integrated over the raw record between two rests; differential equations are integrated from sample
to sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casest.data.curves import Curve
from casest.data.run import Index, Run, Series
from casest.declaration.effect import Attached
from casest.declaration.flow import Flow
from casest.declaration.model import Model
from casest.declaration.physics import SX
from casest.declaration.shapes import Array
from casest.declaration.tracing import ON_THE_WAY, Word, sample_symbol
from casest.engine import Columns, Replay
from casest.errors import DataError, DeclarationError
from casest.leastsquares.flow import Course, Integrator, Mesh
from casest.leastsquares.memory import Memory
from casest.leastsquares.rests import LastTurns, Rests, before, followed, needing


@dataclass(frozen=True)
class Record:
    """What effects look at of a run: the record that its samples were taken from.

    `samples` (N, k) are the model's signals there, `places` those of the run's own samples.
    """

    run: Run
    samples: Array
    time: Array
    places: Index | slice
    rests: Rests | None = None

    @classmethod
    def of(cls, model: Model, run: Run) -> Record:
        """The whole record where the samples are its own still, else the samples alone."""
        whole, places = _origin(model, run)
        if whole.time is None and model.traced.integrates:
            why = next((n for n in whole.notes if n.startswith("time not used")), "")
            raise DataError(
                f"{whole.file or whole.name}: differential equations need a time for every row, in "
                f"order: {why or 'give a time column (--columns t=NAME) or --rate'}"
            )
        if whole.time is None:
            raise DataError(
                f"{run.file or run.name}: {_who(model)} needs time: give a time column or "
                "--rate (--columns t=NAME, --rate HZ)"
            )
        if model.traced.integrates:
            _refuse_going_back(whole)
        samples = np.hstack([np.asarray(whole.signals[s.name], float) for s in model.columns])
        samples = np.asfortranarray(samples)  # they are read column by column
        rests = Rests.of(model, whole) if model.resting else None
        return cls(whole, samples, np.asarray(whole.time, float), places, rests)

    def at(self, name: str, wanted: Array, *, rotation: bool) -> tuple[Array, Array]:
        """A signal and its rate (N, k) at a time for each sample of the record."""
        return self._curve(name, rotation).at(wanted, self._pieces(name, wanted, rotation))

    def tells(self, name: str, wanted: Array, *, rotation: bool) -> NDArray[np.bool_]:
        """At which of these times, one for each sample, the signal was recorded."""
        return self._curve(name, rotation).tells(wanted, self._pieces(name, wanted, rotation))

    def _curve(self, name: str, rotation: bool) -> Curve:
        curves = self.run.curves
        if name not in curves:
            own = Series("", self.time, self.run.signals[name], self.run.block)
            one = self.run.elsewhere.get(name, own)
            made = Curve.through(one.time, one.values, one.block, rotation=rotation)
            curves[name] = made
        found: Curve = curves[name]
        return found

    def _pieces(self, name: str, wanted: Array, rotation: bool) -> NDArray[np.int_]:
        """Within its own record a signal crosses no gap; another file's has gaps of its own."""
        curve = self._curve(name, rotation)
        return curve.nearest(wanted) if name in self.run.elsewhere else curve.stretch


def _who(model: Model) -> str:
    return model.name if model.resting else "an effect that looks at other samples"


def _refuse_going_back(run: Run) -> None:
    """Times of equations grow from row to row."""
    time = np.asarray(run.time, float)
    back = np.flatnonzero(~(np.diff(time) > 0))
    if back.size:
        k = int(back[0])
        raise DataError(
            f"{run.file or run.name}: the time goes from {time[k]:.6g} to {time[k + 1]:.6g} s in "
            f"row {int(run.rows[k + 1])}: put the rows in order, one for each time"
        )


def _origin(model: Model, run: Run) -> tuple[Run, Index | slice]:
    """The record that a run was taken from, and where; itself where a signal was changed since.

    But for the measured one: what is measured leads to no prediction.
    """
    whole, places = run.whole, run.places
    if whole is None or places is None or len(places) != len(run):
        return run, slice(None)
    for name in (s.name for s in model.signals if s.name not in model.traced.readings):
        own, there = run.signals[name], whole.signals.get(name)
        if there is None or not np.array_equal(there[places], own, equal_nan=True):
            return run, slice(None)
    return whole, places


@dataclass(frozen=True)
class Staged:
    """Residual and Jacobian of a model that looks at other samples, by itself or by its effects.

    `states`: of each run those along its record (N, k), where they are known already and no slope
    of theirs is asked for.
    """

    model: Model
    runs: tuple[Run, ...]
    whitening: tuple[Array, ...] | None = None
    states: tuple[Array, ...] | None = None

    @cached_property
    def _records(self) -> tuple[Record, ...]:
        return tuple(Record.of(self.model, run) for run in self.runs)

    def rows(
        self, parameters: Array, samples: Array, r: int, own: tuple[int, ...] | None = None
    ) -> tuple[Array, Array]:
        """Residuals (N, m) and Jacobians (N, m, n) of the samples of run r.

        Effects follow the record that the samples were taken from, block by block. `own`: the
        coordinates that slopes are taken in, where not in all.
        """
        last, places = _programs(self.model, own)[-1], self._records[r].places
        given, moved = self._given(parameters, r, own)
        found = _chained(last, parameters, samples, given[places], moved[:, places])
        present = self.present(r)
        if present is not None:
            for part in found:
                part[~present] = 0.0
        if self.whitening is not None:
            found = (
                _multiplied(self.whitening[r], found[0]),
                _multiplied(self.whitening[r], found[1]),
            )
        return found

    def slopes_in_readings(self, parameters: Array, r: int) -> tuple[Array, Array, Array]:
        """∂r/∂s (N, m, k) in the means of a rest, in those of the rest before, and in all readings
        of the turn between at once."""
        record, last = self._records[r], _in_readings(self.model)
        given = self._given(parameters, r, ())[0]
        own, through = last.residual(parameters, np.hstack([record.samples, given]))
        prior, between = np.zeros_like(own), np.zeros_like(own)
        for first, taken in last.before:
            slope = taken(parameters, np.hstack([record.samples, given]))[0]
            prior[1:] += through[1:, :, first : first + slope.shape[1]] @ slope[:-1]
        for first, taken in last.turned:
            assert record.rests is not None
            nothing = np.zeros((len(record.rests.samples), given.shape[1]))
            rate, slope = taken(parameters, np.hstack([record.rests.samples, nothing]))
            moved = followed(rate[:, :, 0], slope, record.rests)[1]
            between += through[:, :, first : first + moved.shape[1]] @ moved
        if record.rests is not None:
            present = record.rests.linked[:, None] | ~needing(self.model)
            for part in (own, prior, between):
                part[~present] = 0.0
        return own, prior, between

    def origin(self, r: int) -> tuple[Run, Index | slice]:
        """The record that the samples of run r were taken from, and their places in it."""
        return self._records[r].run, self._records[r].places

    def lost(self, r: int) -> NDArray[np.int_]:
        """Rests that were reached too fast, by number."""
        rests = self._records[r].rests
        return np.zeros(0, np.int_) if rests is None else np.flatnonzero(rests.lost)

    def present(self, r: int) -> NDArray[np.bool_] | None:
        """Which residuals (N, m) there are; None where all are.

        What compares a rest with the one before has nothing to say of a first one, and what follows
        a late signal nothing of times at which nobody recorded that.
        """
        if r not in self._present:
            self._present[r] = self._there(r)
        return self._present[r]

    @cached_property
    def _present(self) -> dict[int, NDArray[np.bool_] | None]:
        return {}

    def _there(self, r: int) -> NDArray[np.bool_] | None:
        record, axes = self._records[r], len(self.model.axes)
        there = np.repeat(self._told(record)[:, None], axes, axis=1)
        if record.rests is not None:
            there &= record.rests.linked[:, None] | ~needing(self.model)
        there = there[record.places]
        if self.model.traced.integrates and self.model.traced.readings:
            readings = [self.runs[r].signals[name] for name in self.model.traced.readings]
            there = there & ~np.isnan(np.hstack(readings))
        return None if there.all() else there

    def _told(self, record: Record) -> NDArray[np.bool_]:
        """Samples (N,) at whose time all late signals were recorded.

        Late by what their delay is where it begins: were it what it is just now, each step of a
        search would be judged by other samples.
        """
        told = np.ones(len(record.time), bool)
        for stage in _programs(self.model)[:-1]:
            if stage.attached is None or stage.attached.kind != "time":
                continue
            begun = {p.name: float(p.start_value().ravel()[0]) for p in stage.attached.parameters}
            if not any(begun.values()):
                continue
            name = stage.attached.on
            wanted = stage.taken(self._at(begun), record.time[:, None])[0][:, 0, 0]
            told &= record.tells(name, wanted, rotation=self.model[name].kind == "rotation")
        return told

    def _at(self, values: Mapping[str, float]) -> Array:
        """Parameters with some scalar values, and nothing of the others."""
        traced, place = self.model.staged, 0
        found = np.zeros(traced.coordinates.numel() + traced.references.numel())
        for p in self.model.parameters:
            if p.name in values:
                found[place] = values[p.name]
            place += p.shape.coordinates
        return found

    @cached_property
    def _meshes(self) -> dict[tuple[int, int], Mesh]:
        """Steps of each run in each stage, kept from one evaluation to the next."""
        return {}

    def given(
        self, parameters: Array, r: int, own: tuple[int, ...] | None = None
    ) -> tuple[Array, Array]:
        """What the stages give at the samples of run r (N, k), side by side, and its slopes."""
        (found, moved), places = self._given(parameters, r, own), self._records[r].places
        return found[places], moved[:, places].transpose(1, 0, 2)

    def followed(self, parameters: Array, r: int) -> Array:
        """States of differential equations along the record of run r, (N, k)."""
        given, place, found = self._given(parameters, r, ())[0], 0, []
        for stage in self.model.staged.stages:
            if isinstance(stage, Flow):
                found.append(given[:, place : place + stage.given.numel()])
            place += stage.given.numel()
        return np.hstack([given[:, :0], *found])

    @cached_property
    def _turns(self) -> dict[Word, LastTurns]:
        return {word: LastTurns() for word in ON_THE_WAY}

    def _given(self, parameters: Array, r: int, own: tuple[int, ...] | None) -> tuple[Array, Array]:
        """The same at all samples of the record, slopes (k, N, n); what was asked last is kept."""
        asked = (r, own, parameters.tobytes())
        if own == () and self._last.get("asked") == (r, None, parameters.tobytes()):
            given, moved = self._last["found"]  # with slopes that nobody asks for now
            return given, moved[:, :, :0]
        if self._last.get("asked") != asked:
            self._last["found"] = self._followed(parameters, r, own)
            self._last["asked"] = asked
        found: tuple[Array, Array] = self._last["found"]
        return found

    @cached_property
    def _last(self) -> dict[str, Any]:
        return {}

    def _followed(
        self, parameters: Array, r: int, own: tuple[int, ...] | None
    ) -> tuple[Array, Array]:
        *stages, _ = _programs(self.model, own)
        record, followed = self._records[r], 0
        count = self.model.staged.coordinates.numel() if own is None else len(own)
        ends = np.cumsum([0, *(int(stage.given.numel()) for stage in self.model.staged.stages)])
        found = np.empty((len(record.samples), ends[-1]))
        moved = np.empty((ends[-1], len(found), count))  # those of a number lie together
        for k, stage in enumerate(stages):
            given, before = found[:, : ends[k]], moved[: ends[k]]
            if stage.word:
                more = self._of_word(stage, parameters, record, given, before)
            elif stage.flow is not None and self.states is not None:
                known = self.states[r][:, followed : followed + stage.flow.sizes[0]]
                more, followed = (known, np.zeros((*known.shape, count))), followed + known.shape[1]
            elif stage.flow is not None:
                taken = given[:, :0], np.zeros((len(given), 0, count))
                if stage.flow.sizes[1]:
                    taken = _chained(stage, parameters, record.samples, given, before)
                mesh = self._meshes.setdefault((r, k), Mesh())
                more = stage.flow.along(parameters, Course(record.time, *taken), mesh)
            elif stage.memory is None:
                more = self._late(stage, parameters, record)
            else:
                taken = _chained(stage, parameters, record.samples, given, before)
                more = stage.memory.along(parameters, *taken, record.time, record.run.block)
            found[:, ends[k] : ends[k + 1]] = more[0]
            here, slopes = moved[ends[k] : ends[k + 1]], more[1].transpose(1, 0, 2)
            if len(stage.columns) == count:
                here[:] = slopes
            else:
                here[:] = 0.0
                here[:, :, list(stage.columns)] = slopes
        return found, moved

    def _of_word(
        self, stage: Program, parameters: Array, record: Record, given: Array, slopes: Array
    ) -> tuple[Array, Array]:
        """What a word of the body gives at every rest, and its slopes."""
        assert record.rests is not None
        if stage.word == "before":
            return before(*_chained(stage, parameters, record.samples, given, slopes))
        asked = id(record), stage.columns, parameters[list(stage.turning)].tobytes()
        last = self._turns[stage.word]
        if last.asked != asked:
            nothing = np.zeros((len(record.rests.samples), given.shape[1]))
            rate, sloped = stage.taken(parameters, np.hstack([record.rests.samples, nothing]))
            last.keep(asked, followed(rate[:, :, 0], sloped, record.rests))
        return last.found

    def stopped(self, parameters: Array, r: int) -> str:
        """What could not be followed from which time on, in words; empty where all was."""
        given, place = self.given(parameters, r, ())[0], 0
        time = self._records[r].time[self._records[r].places]
        for stage in self.model.staged.stages:
            own = given[:, place : place + stage.given.numel()]
            place += stage.given.numel()
            bad = np.flatnonzero(~np.isfinite(own).all(axis=1))
            if isinstance(stage, Flow) and bad.size:
                k = max(int(bad[0]) - 1, 0)
                there = ", ".join(
                    f"{n} = {v:.4g}" for n, v in zip(stage.names, own[k], strict=True)
                )
                return (
                    f"the equations cannot be followed beyond t = {time[k]:.6g} s, where {there}: "
                    "a rate is not finite there, grows without bound, is too stiff, or jumps and "
                    "holds it there, as dry friction does at rest"
                )
        return ""

    def late(self, parameters: Array, r: int) -> dict[str, Array]:
        """Signals (N, k) of run r that are taken at another time, as it was recorded there."""
        record = self._records[r]
        return {
            stage.attached.on: self._late(stage, parameters, record)[0][record.places]
            for stage in _programs(self.model, ())[:-1]
            if stage.attached is not None and stage.attached.kind == "time"
        }

    def _late(self, stage: Program, parameters: Array, record: Record) -> tuple[Array, Array]:
        """A signal at the times at which the effect says that it is taken, and its slopes in the
        stage's columns."""
        assert stage.attached is not None
        name = stage.attached.on
        wanted, slope = stage.taken(parameters, record.time[:, None])
        rotation = self.model[name].kind == "rotation"
        value, rate = record.at(name, wanted[:, 0, 0], rotation=rotation)
        return value, rate[:, :, None] * slope


@dataclass(frozen=True)
class Program:
    """What is computed of one stage: what it takes, and how it goes on from it.

    Of an effect on a signal's time that is the time asked for. The last of a model's is its
    residual, with no effect behind it. A `word` of the body has no effect either. `columns`: the
    coordinates in which what it gives has slopes; `turning`: the parameters that a turn depends on.
    `read`: from where to where it reads what the stages before give, `through` the columns of that.
    """

    attached: Attached | None
    taken: Replay
    read: tuple[int, int] = (0, 0)
    memory: Memory | None = None
    word: Word = ""
    columns: tuple[int, ...] = ()
    turning: tuple[int, ...] = ()
    flow: Integrator | None = None
    through: tuple[tuple[int, ...], ...] = ()


@lru_cache(maxsize=64)
def _programs(model: Model, own: tuple[int, ...] | None = None) -> tuple[Program, ...]:
    traced, found, given = model.staged, [], ca.SX(0, 1)
    coordinates = traced.coordinates if own is None else traced.coordinates[list(own)]
    parameters = ca.vertcat(traced.coordinates, traced.references)

    def slopes(expression: SX, *of: SX) -> list[SX]:
        return [ca.densify(expression), *(ca.jacobian(expression, x) for x in of)]

    every = tuple(range(coordinates.numel()))
    reach: list[tuple[int, ...]] = []  # of each number that a stage gives

    def program(attached: Attached | None, expression: SX, **how: Any) -> Program:
        sample = ca.vertcat(sample_symbol(model, traced), given)
        reached = _reaching(expression, given) if every else ()
        read = (min(reached), max(reached) + 1) if reached else (0, 0)
        outputs = slopes(expression, coordinates, given[slice(*read)])
        taken = _replay("stage", [parameters, sample], outputs)
        through = tuple(reach[slice(*read)])
        return Program(attached, taken, read, columns=every, through=through, **how)

    for stage in traced.stages:
        if isinstance(stage, Flow):
            fed = ca.depends_on(stage.taken, ca.vertcat(coordinates, given))
            found.append(program(None, stage.taken, flow=Integrator(traced, stage, own, fed)))
        elif stage.word in ON_THE_WAY:
            if ca.depends_on(stage.taken, ca.vertcat(given, ca.SX.sym("none"))):
                raise DeclarationError(
                    f"model {model.name}: what turns between rests cannot read what was before"
                )
            columns, turning = (_reaching(stage.taken, x) for x in (coordinates, parameters))
            sample = ca.vertcat(sample_symbol(model, traced), given)
            outputs = slopes(stage.taken, coordinates[list(columns)])
            rate = _replay("rate", [parameters, sample], outputs)
            found.append(Program(None, rate, word=stage.word, columns=columns, turning=turning))
        elif stage.word:
            found.append(program(None, stage.taken, word=stage.word))
        elif stage.attached is not None and stage.attached.kind == "time":
            t = ca.SX.sym("t")
            moment = ca.SX(stage.attached.apply(t, traced.symbols))
            columns = _reaching(moment, coordinates)
            outputs = slopes(moment, coordinates[list(columns)])
            f = _replay("moment", [parameters, t], outputs)
            found.append(Program(stage.attached, f, columns=columns))
        else:
            memory = Memory(model, stage, own)
            found.append(program(stage.attached, stage.taken, memory=memory))
        reach += [found[-1].columns] * stage.given.numel()
        given = ca.vertcat(given, stage.given)
    return (*found, program(traced.stages[-1].attached, traced.expression))


def _reaching(expression: SX, variables: SX) -> tuple[int, ...]:
    """Numbers of the variables that an expression depends on."""
    return tuple(sorted(set(ca.jacobian(expression, variables).sparsity().get_col())))


@dataclass(frozen=True)
class Readings:
    """Slopes in the readings of a rest: of the residual, also in what the stages give, and of what
    each word `before` takes, with the place of what it gives; each rate that turns, and its."""

    residual: Replay
    before: tuple[tuple[int, Replay], ...]
    turned: tuple[tuple[int, Replay], ...]


@lru_cache(maxsize=64)
def _in_readings(model: Model) -> Readings:
    traced = model.staged
    parameters = ca.vertcat(traced.coordinates, traced.references)
    reading, given = sample_symbol(model, traced), ca.vertcat(*(s.given for s in traced.stages))
    sample = ca.vertcat(reading, given)

    def slope(expression: SX, *of: SX) -> Replay:
        outputs = [ca.densify(ca.jacobian(expression, x)) for x in of]
        return _replay("slope", [parameters, sample], outputs)

    before, turned, place = [], [], 0
    for stage in traced.stages:
        if stage.word == "before":
            before.append((place, slope(stage.taken, reading)))
        if stage.word in ON_THE_WAY:
            both = [ca.densify(stage.taken), ca.densify(ca.jacobian(stage.taken, reading))]
            turned.append((place, _replay("rate", [parameters, sample], both)))
        place += stage.given.numel()
    return Readings(slope(traced.expression, reading, given), tuple(before), tuple(turned))


def _multiplied(matrix: Array, values: Array) -> Array:
    """Residuals (N, m) or slopes (N, m, n) of all samples of a run, combined."""
    count = values.shape[0] * values.shape[1]
    return np.asarray((matrix @ values.reshape(count, -1)).reshape(values.shape))


def _replay(name: str, inputs: list[SX], outputs: list[SX]) -> Replay:
    names = [f"out{k}" for k in range(len(outputs))]
    return Replay(ca.Function(name, inputs, outputs, ["parameters", "sample"], names))


def _chained(
    stage: Program, parameters: Array, samples: Array, given: Array, slopes: Array
) -> tuple[Array, Array]:
    """Values (N, m) and slopes in the parameters (N, m, n), also by way of the stages before, whose
    slopes are (k, N, n)."""
    taken, first = stage.taken, stage.read[0]
    value, direct = (np.zeros((len(samples), *shape)) for shape in taken.shapes[:2])
    own, (row, column) = taken.sparsity[1], taken.sparsity[2]
    for span, (v, d, through) in taken.blocks(parameters, Columns([samples, given])):
        value[span, :, 0] = v.T
        direct[span, own[0], own[1]] = d.T
        for i, j, slope in zip(row, column, through, strict=True):
            columns, before = stage.through[j], slopes[first + j, span]
            if len(columns) == direct.shape[2]:
                direct[span, i] += slope[:, None] * before
            else:
                for c in columns:
                    direct[span, i, c] += slope * before[:, c]
    return value[:, :, 0], direct
