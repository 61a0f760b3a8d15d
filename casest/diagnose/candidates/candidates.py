"""Which effects could be missing: the catalogue at every place and column where it applies."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.dimensions import check_units
from casest.declaration.effect import NOISE, OVER_TIME, RATE, RATES, RECORDED, Effect, label_of
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.declaration.symbols import Constant, Parameter
from casest.declaration.tracing import reached_parameters
from casest.diagnose.candidates.repeated import Reads, reads_of
from casest.effects import shipped
from casest.effects.placing import angles, placed_in, with_numbers
from casest.errors import CasestError, UsageError
from casest.leastsquares.kinds import noises
from casest.units import known, size

#: Columns whose name or unit says that they are temperatures.
_TEMPERATURE = re.compile(r"temp|(^|_)t_?(deg)?c$|celsius|kelvin", re.IGNORECASE)
_DEGREES = {"degC", "K", "kelvin", "degree_Celsius", "°C"}
#: What is searched over first and fitted then: an effect is smooth in it, or bends with it.
SMOOTH = ("frequency", "timescale", "memory", "lag", "level", "floor", "threshold", "band")
#: Where effects act that go with what a sensor gives.
READINGS = ("input", "output")
#: What an effect that bends over a column calls its second size.
BEND = "bend"
#: Which columns an effect asks for: temperatures, others, both.
WARM = {"temperature": (True,), "other": (False,), "any": (True, False)}
#: Columns that number things instead of measuring them.
_LABELS = re.compile(
    r"^(run|pose|index|(first_|last_)?row|count|sample|seq|id|nr|no)$", re.IGNORECASE
)
#: Columns that are called as the uncertainty of another is.
_UNCERTAIN = re.compile(
    r"(^|[_ ])(err|errors?|std|stdev|sd|sigma|unc|uncert|uncertainty)([_ ]|$)", re.IGNORECASE
)
#: Columns that are called as a clock is.
_CLOCK = re.compile(
    r"time|clock|tick|epoch|utc|milli|micro|(^|_)(t|s|sec|seconds|ms|us|ns)$", re.IGNORECASE
)


@dataclass(frozen=True)
class Candidate:
    """One effect at one place: `freed` names a constant instead, for one that is wrong.

    `trials` says at how many grid values of its profile it was tried, for the p-value.
    """

    effect: Effect | None
    columns: tuple[tuple[str, str], ...] = ()
    freed: str = ""
    #: Values that it is held at, of what it is searched over; so many were looked through.
    held: tuple[tuple[str, float], ...] = ()
    trials: int = 1
    #: What the effect declares to act on, where it acts on a reading of several instead.
    declared_on: str = ""
    #: The model that it was tried on, and that model with it: tracing takes longer than scoring.
    traced: tuple[Model, Model] | None = field(default=None, compare=False, repr=False)

    @property
    def name(self) -> str:
        """The bare catalogue name, or that of the constant."""
        return self.freed or (self.effect.name if self.effect else "")

    @property
    def column(self) -> str | None:
        """The column that it reads besides time."""
        return self.columns[0][1] if self.columns else None

    @property
    def on(self) -> str:
        """The quantity or signal it acts on."""
        return self.freed or (self.effect.on if self.effect else "")

    @property
    def label(self) -> str:
        """Name and column, as in the parameters' names: `temperature_bias(temp)`."""
        if self.effect is not None and self.effect.kind in ("time", "rate"):
            return label_of(self.effect, self.on, dict(self.columns), moved=False)
        moved = bool(self.declared_on)
        if self.effect is not None and moved:
            return label_of(self.effect, self.on, dict(self.columns), moved=True)
        return self.name + (f"({self.column})" if self.column else "")

    def among(self, names: Collection[str]) -> bool:
        """Is it called so, with its column or without?"""
        return self.name in names or self.label in names or self.label.split("@")[0] in names

    def added_to(self, model: Model) -> Model:
        """The model with it. Raises where it does not apply."""
        if self.freed:
            return model.freed(self.freed)
        if not self.held:
            return self.traced_on(model)
        assert self.effect is not None
        return self._attached_to(model, self.effect.holding(**dict(self.held)))

    def traced_on(self, model: Model) -> Model:
        """The model with it, nothing held."""
        if self.traced is not None and self.traced[0] is model:
            return self.traced[1]
        if self.freed:
            return model.freed(self.freed)
        assert self.effect is not None
        return self._attached_to(model, self.effect)

    def _attached_to(self, model: Model, effect: Effect) -> Model:
        if not self.declared_on:
            return model.with_effect(effect, columns=dict(self.columns))
        declared = replace(effect, on=self.declared_on)
        return model.with_effect(declared, on=effect.on, columns=dict(self.columns))

    def on_model(self, model: Model) -> Candidate:
        """The candidate that remembers the model with it. Raises where it does not apply."""
        return replace(self, traced=(model, replace(self, traced=None).traced_on(model)))

    def free(self) -> Candidate:
        """With its frequency or time constant unknown again, from where it was found."""
        if self.effect is None:
            return self
        smooth = {n for n, kind in self.effect.profile if kind in SMOOTH}
        begun = {n: v for n, v in self.held if n in smooth}
        if not begun:
            return self
        left = tuple((n, v) for n, v in self.held if n not in smooth)
        return replace(self, effect=self.effect.starting(**begun), held=left, traced=None)

    def all_held(self, model: Model) -> bool:
        """Is nothing of it unknown but what is held? Raises where it does not apply."""
        return bool(self.held) and not self.parameters(self.traced_on(model))

    def parameters(self, extended: Model) -> list[Parameter]:
        """Its unknowns in the extended model."""
        own = extended.unknowns_of(self.label)
        own -= {f"{self.label}.{name}" for name, _ in self.held}
        return [p for p in extended.parameters if p.name in own or p.name == self.freed]


@dataclass(frozen=True)
class Skipped:
    """An effect that could not be tried, and why."""

    name: str
    reason: str


#: Columns that measure something (is it a temperature?), and those that cannot be used.
Channels = tuple[dict[str, bool], list[Skipped]]


def candidates(
    model: Model,
    runs: Sequence[Run],
    catalogue: Sequence[Effect],
    known: Channels | None = None,
) -> tuple[list[Candidate], list[Skipped]]:
    """All that can be tried on these data, and what cannot with the reason.

    `runs` come from `prepared`; `known` are their channels, which hang on what the model reads.
    """
    found: list[Candidate] = []
    skipped: list[Skipped] = []
    measured, unusable = known or channels_of(model, runs)
    # A reading follows its own residual: its noise is in both.
    unfit = {*(s.name for s in unusable), *model.traced.readings}
    turning = [n for n in angles(model, runs) if n not in unfit]
    states = [s for s in model.rates.values() if not model.quantities[s].dims]
    skipped += unusable
    for effect in _placed(model, catalogue):
        if effect.on == NOISE:
            continue
        moved = effect.on if effect.on in READINGS and model.resting else ""
        try:
            several = _on_readings(effect, model) if moved else [placed_in(effect, model)]
        except CasestError as error:
            skipped.append(Skipped(effect.name, str(error)))
            continue
        every = [(p, c) for p in several for c in _columns_for(p, measured, turning, states)]
        for placed, columns in every:
            candidate = Candidate(placed, columns, declared_on=moved)
            try:
                told = with_numbers(placed, columns, runs, model)
                candidate = replace(candidate, effect=told)
                _refuse_two_values(candidate, runs)
                if any(c.label == candidate.label and c.effect == told for c in found):
                    continue  # of the catalogue, and asked for with its column
                found.append(_tried(candidate, model, runs))
            except CasestError as error:
                why = Skipped(effect.name if moved else candidate.label, str(error))
                skipped += [] if any(s.name == why.name for s in skipped) and moved else [why]
    for constant in model.constants:
        if constant.frozen is None and _may_be_wrong(constant, model):
            found.append(Candidate(None, freed=constant.name))
    return found, skipped


def _may_be_wrong(constant: Constant, model: Model) -> bool:
    """Is it one number, or several that are nothing as they stand?

    Of a model that looks from rest to rest no noise, and nothing that brings rows of its own.
    """
    if constant.chosen or (constant.dims and constant.array.any()):
        return False
    if not model.resting:
        return not constant.dims
    if constant.name in noises(model):
        return False
    wide = model.freed(constant.name)
    stages = [stage.entered for stage in wide.staged.stages]
    reached = ca.vertcat(wide.staged.expression, *stages)
    return wide.axes == model.axes and constant.name in reached_parameters(
        wide, wide.staged, reached
    )


def _on_readings(effect: Effect, model: Model) -> list[Effect]:
    """The effect on each sensor's reading: what several sensors give at once has no one place."""
    if effect.kind in OVER_TIME or effect.otherwise is not None:
        raise UsageError("from rest to rest there is no sequence of readings that it could follow")
    return [replace(effect, on=s.name) for s in model.signals if s.kind == "plain" and s.size > 1]


def _placed(model: Model, catalogue: Sequence[Effect]) -> list[Effect]:
    """The catalogue, what delays a recorded signal once for each that the body reads, and what acts
    on a rate once for each that may lack something."""
    followed = {column for a in model.effects for _, column in a.columns}
    signals = [name for name in model.recorded if name not in followed]
    found: list[Effect] = []
    for effect in catalogue:
        places: dict[str, Sequence[str]] = {RECORDED: signals, RATES: list(model.rates)}
        several = places.get(effect.on, (effect.on,))
        found += [replace(effect, on=on) for on in several]
    return found


def _columns_for(
    effect: Effect, channels: Mapping[str, bool], turning: Sequence[str], states: Sequence[str]
) -> list[tuple[tuple[str, str], ...]]:
    """For effects that say for which argument a column is looked for: every one that may be it.

    `=temp` for the one of that name. `turning`: angles, also those that the model declares;
    `states`: those that may drive another.
    """
    if not effect.columns:
        return [()]
    ((argument, kind),) = effect.columns
    if kind.startswith("="):
        every = dict.fromkeys([*channels, *turning])
        return [((argument, name),) for name in every if kind == "=" + name]
    own = effect.on.removeprefix(RATE)
    if kind in ("itself", "state"):
        return [
            ((argument, n),)
            for n in ([own] if kind == "itself" else states)
            if kind == "itself" or n != own
        ]
    if kind == "angle":
        return [((argument, name),) for name in turning if name != effect.on]
    fits = WARM.get(kind, ())
    return [((argument, name),) for name, is_warm in channels.items() if is_warm in fits]


def usable_columns(model: Model, runs: Sequence[Run]) -> list[str]:
    """Columns that measure something and are no signal of the model's. `runs` are prepared."""
    return list(channels_of(model, runs)[0])


def channels_of(model: Model, runs: Sequence[Run], asked: Collection[str] = ()) -> Channels:
    """The columns of these runs that a model does not read itself."""
    return channels(read_by(model), runs, reads_of(model, runs), asked)


def read_by(model: Model) -> frozenset[str]:
    """What a model reads itself. A column that an effect of the catalogue reads may be the cause of
    another one as well; what a formula reads is in it."""
    followed = {column for attached in model.effects for column in dict(attached.columns).values()}
    return frozenset({s.name for s in model.signals} - followed | {"t"})


def channels(
    used: Collection[str], runs: Sequence[Run], reads: Reads, asked: Collection[str] = ()
) -> Channels:
    """The same of columns that are not `used`, and are nothing once more that is read: unless
    somebody has `asked` for one by name."""
    found: dict[str, bool] = {}
    skipped: list[Skipped] = []
    times = [run.time for run in runs if run.time is not None]
    clock = {"t": np.concatenate(times)} if len(times) == len(runs) > 0 else {}
    values: dict[str, Array] = {}
    for name in runs[0].columns if runs else ():
        if name in used or _LABELS.match(name):
            continue
        if any(name not in run.signals for run in runs):
            skipped.append(Skipped(name, "column is not numeric in every file"))
            continue
        x = np.concatenate([run.signals[name][:, 0] for run in runs])
        # An angle that grows with time still turns.
        others = {**clock, **values} if _CLOCK.search(name) else values
        why = _useless(x, others)
        if not why and name not in asked:
            why = _named(name) or reads.again(x)
        if why:
            skipped.append(Skipped(name, why))
            continue
        values[name] = x
        unit = runs[0].column_units.get(name) or ""
        found[name] = _is_temperature(name, unit)
    return found, skipped


def _is_temperature(name: str, unit: str) -> bool:
    """A unit that says something else is believed, whatever the name (tempo in s)."""
    if unit and known(unit) and "count" not in unit and size(unit)[1] != size("K")[1]:
        return False
    return bool(_TEMPERATURE.search(name)) or unit in _DEGREES


def _named(name: str) -> str:
    """Why a column of that name is no influence; else empty."""
    if _UNCERTAIN.search(name):
        return "column is named as the uncertainty of another is, which is no influence"
    return ""


def _useless(x: Array, others: Mapping[str, Array]) -> str:
    """Why a column can explain nothing, in words; else empty."""
    if not np.all(np.isfinite(x)):
        return f"column has {int(np.sum(~np.isfinite(x)))} values that are not finite"
    if np.ptp(x) <= 1e-12 * np.abs(x).max(initial=1e-300):
        return "column is constant"
    for other, y in others.items():
        if np.ptp(y) > 0 and abs(np.corrcoef(x, y)[0, 1]) > 1 - 1e-10:
            return f"column is a copy of {other} (up to scale and offset)"
    return ""


def _tried(candidate: Candidate, model: Model, runs: Sequence[Run]) -> Candidate:
    """The candidate on the model. Raises where it does not apply here."""
    if any(a.label == candidate.label for a in model.effects):
        raise UsageError("already in the model")
    candidate = candidate.on_model(model)
    effect, extended = candidate.effect, candidate.added_to(model)
    for s in extended.signals:
        if any(s.name not in run.signals for run in runs):
            raise UsageError(f"the data have no {s.name!r}")
    _refuse_more_than_data(extended, runs)
    if effect is None:
        return candidate
    if not shipped(effect):
        check_units(extended)
    # In the form that it takes in this model.
    own = replace(extended.effects[-1].effect, on=effect.on)
    return replace(candidate, effect=own)


def _refuse_two_values(candidate: Candidate, runs: Sequence[Run]) -> None:
    """What bends over a column of two values is what goes along it."""
    effect = candidate.effect
    bends = effect is not None and shipped(effect) and BEND in dict(effect.declarations)
    if not bends or any(candidate.column not in run.signals for run in runs):
        return  # none that was recorded
    several = [np.unique(run.signals[str(candidate.column)]) for run in runs]
    if len(np.unique(np.concatenate(several))) < 3:
        raise UsageError("the column has two values: what bends over it is what goes along it")


def _refuse_more_than_data(extended: Model, runs: Sequence[Run]) -> None:
    """As many unknowns as residuals fit anything, and leave no noise to judge it by."""
    unknowns = sum(
        p.shape.coordinates * (len(runs) if p.scope == "run" else 1) for p in extended.parameters
    )
    residuals = sum(map(len, runs)) * len(extended.axes)
    if unknowns >= residuals:
        raise UsageError(f"with it there are {unknowns} unknowns for {residuals} residuals")
