"""The verdict of a closed loop in words, and what hangs on causes that are not told apart."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from msgspec import UNSET

from casest.data.timing import UNUSED
from casest.declaration.effect import NOISE
from casest.diagnose.formula.search import NAME as FORMULA
from casest.diagnose.found import HELD_OUT_DATA
from casest.diagnose.levels import LEVELS
from casest.effects import CATALOGUE
from casest.effects.placing import MISSING, UNTIMED
from casest.results.closing import Closed, Effect, Shifts, Unexplained
from casest.results.fitted import NoiseModel, Samples, worse_elsewhere
from casest.results.result import Parameter
from casest.results.rounding import percent

#: Samples that resemble each other from which on noise may as well be a lag or a hysteresis.
COLOURED = 5
#: Correlation of neighbours below which errors go to and fro: one tells a tenth of the next.
TO_AND_FRO = -0.32
#: Effects, each with its parameter, of which a sign says something of the two instruments.
BELOW_ZERO = {
    ("low_pass", "tau"): "the reading leads, what it is compared with is the slower one",
    ("hysteresis", "k"): "the reading leads: what it is compared with has the play, "
    "or friction adds to what is measured",
}
#: Effects from which on, where a misfit remains, they are a description more than causes.
MANY = 4
#: Share by which errors of a record that was given are larger than before where that is said.
WORSE = 0.01
#: Names that are said of many.
FEW = 3
#: Measurements that would tell causes apart, of which so many are named.
NAMED = 4


def sentence(result: Closed) -> str:
    """The verdict in one sentence."""
    names = list(map(_named, result.effects))
    if result.verdict is None:
        held_out = "no verdict: nothing can be held out"
        return held_out if result.trusted else "no trustworthy estimate"
    untried = _untried(result)
    if result.verdict == "adequate":
        rows = sum(s.samples for s in result.samples)
        few = "" if rows >= LEVELS.series else f"{rows} rows"
        said = f"nothing that {few or 'these data'} can show is missing"
        if not names and not result.smallest_detectable:
            said = f"nothing is found; {len(result.not_tried)} effects do not apply here"
        elif _without_bends(result):
            said = "nothing that was tried is missing; bends were not (see below)"
        noise = f"; {', '.join(names)} belong to the noise" if names else ""
        over = result.noise.correlated_over_samples or 1
        if over >= COLOURED:
            noise += f"; the noise has a colour (alike over {over:.0f} samples)"
        elif _goes_to_and_fro(result.noise):
            noise += f"; the noise has a colour ({_to_and_fro(result.noise)})"
        elif result.noise.of_inputs > LEVELS.most:
            noise += f"; what is left is {_of_inputs(result.noise)}"
        worse = worse_elsewhere(result.holdout, result.holdout_over_fit)
        return f"adequate: {said}{noise}{worse}{untried}"
    if result.verdict == "extended":
        left = _remaining_noise(result.noise, result.samples)
        missing = f"{_missing(result.effects)}{_elsewhere(result)}"
        bends = "; bends were not tried (see below)" if _without_bends(result) else ""
        return f"extended: {missing}; what is left is {left}{bends}{untried}"
    found = f"beside {', '.join(map(_with_rivals, result.effects))} " if names else ""
    many = ""
    if len(names) >= MANY:
        many = f"; {len(names)} effects together may stand for one that is not among them"
    which = _which(result.unexplained)
    return f"unexplained: {found}a misfit remains{which}{many}{_elsewhere(result)}"


def _without_bends(result: Closed) -> bool:
    """Does the model name no place on which a bend of the input could act?"""
    return any(s.reason.endswith(MISSING["input"]) for s in result.not_tried)


def _elsewhere(result: Closed) -> str:
    """That what was held out, or a record that was given, is foretold worse with what was added, or
    than what was fitted."""
    before, after = result.before.rmse_holdout, result.after.rmse_holdout
    if not result.effects or before is None or after is None or after <= (1 + WORSE) * before:
        return worse_elsewhere(result.holdout, result.holdout_over_fit)
    given = "what was held out" if result.holdout is UNSET else ", ".join(result.holdout)
    return f", but {given} is foretold worse with it"


def _which(left: Unexplained) -> str:
    """What is known of a misfit: where it is, or what explains it alike."""
    if left.in_rows:
        why = f"at {left.at_ends}" if left.at_ends else "which the others speak against"
        return f" in {left.in_rows}, {why}"
    share, alike = left.share or 0.0, f"{_several(left.one_of)} explain" if left.one_of else ""
    if not alike or share < LEVELS.share * (left.fraction or 0.0):
        return " that no candidate explains"
    part = share < LEVELS.most * (left.fraction or 0.0)
    return f", of which {alike} {percent(share)}" if part else f" that {alike} alike"


def _missing(effects: Sequence[Effect]) -> str:
    """What was missing, beside what explains as much in its place: a formula that the loop found
    says what it looks like, and is no cause."""
    causes = [e for e in effects if e.name != FORMULA]
    verb = "were" if len(causes) > 1 or [e.name for e in causes] == ["outliers"] else "was"
    said = f"{', '.join(map(_with_rivals, causes))} {verb} missing"
    if len(causes) == len(effects):
        return said
    more = (
        f"{said}, and a formula describes what else was"
        if causes
        else ("a formula describes what was missing")
    )
    return f"{more}, of unknown cause"


def _named(effect: Effect) -> str:
    return effect.name + (f" ({effect.column})" if effect.column else "")


def _with_rivals(effect: Effect) -> str:
    """An effect, or what it is not told apart from."""
    rivals = " or ".join(effect.indistinguishable_from)
    return f"{_named(effect)} (or {rivals})" if rivals else _named(effect)


def _several(causes: Sequence[str]) -> str:
    """Causes by name, the first of many."""
    if len(causes) < 2:
        return f"{causes[0]} and other shapes"
    first = causes[: NAMED - 1]
    more = len(causes) - len(first)
    others = f", or {more} other{'s' * (more > 1)}," if more else ""
    return (", " if more else " or ").join(first) + others


def _remaining_noise(noise: NoiseModel, samples: Sequence[Samples]) -> str:
    """What noise is called that resembles itself over so many samples, and of how few it is."""
    over, count = noise.correlated_over_samples or 1, sum(s.samples for s in samples)
    if over >= COLOURED:
        return f"coloured noise (alike over {over:.0f} samples), or a lag"
    if _goes_to_and_fro(noise):
        return f"coloured noise ({_to_and_fro(noise)})"
    if noise.of_inputs > LEVELS.most:
        return _of_inputs(noise)
    return "noise" if count >= LEVELS.series else f"noise as far as {count} rows can tell"


def _of_inputs(noise: NoiseModel) -> str:
    said = f"{percent(noise.of_inputs)} of it goes with rows before and after"
    return f"noise of the inputs, or an average ({said})"


def _goes_to_and_fro(noise: NoiseModel) -> bool:
    """Is an error followed by one of the other sign, as where a reading was differentiated, or is
    late by a part of a sample?"""
    chance, rho = noise.colour_p_value, noise.lag1_correlation
    told = chance is not None and chance < LEVELS.misfit
    return told and rho is not None and rho < TO_AND_FRO


def _to_and_fro(noise: NoiseModel) -> str:
    return f"errors go to and fro: of neighbours ρ = {noise.lag1_correlation:.2f}"


def consequence(result: Closed) -> str:
    """What a reader of the values before would have got wrong, a sentence; empty where little."""
    far = {name: largest(z) for name, z in result.moved.items()}
    name, most = max(far.items(), key=lambda one: one[1], default=("", 0.0))
    if not result.effects or most < 1:
        return ""
    what = "it" if len(result.effects) == 1 else "them"
    size = f"{most:.0f}" if most >= 10 else f"{most:.2g}"
    said = f"{name} is off by {size} of its printed standard deviations"
    return f"Fitted without {what}, {said}. "


def largest(z: Any) -> float:
    """The largest size in nested lists of numbers; 0 where there is none."""
    if isinstance(z, list):
        return max(map(largest, z), default=0.0)
    return 0.0 if z is None else abs(float(z))


class _Named(Protocol):
    @property
    def name(self) -> str: ...


_N = TypeVar("_N", bound=_Named)


def of_the_user(named: Sequence[_N]) -> list[_N]:
    """Those that are not shipped: what the user gave."""
    shipped = {e.name for e in CATALOGUE}
    return [n for n in named if n.name.partition("(")[0].partition("@")[0] not in shipped]


def _untried(result: Closed) -> str:
    """The user's own effects that could not be tried, and a time that was left aside."""
    own = of_the_user(result.not_tried)
    names = [s.name for s in own if not s.reason.startswith("column ")]
    said = f"; {', '.join(names)} could not be tried" if names else ""
    return said + "; its time was not used (see below)" * any(UNUSED in n for n in result.notes)


def refusals(result: Closed) -> Iterator[str]:
    """What was not added, and why."""
    for r in result.refused:
        what = "nothing was" if r.name == HELD_OUT_DATA else f"{r.name} was not"
        yield f"{what} added: {r.reason}"


def untried(result: Closed) -> Iterator[str]:
    """What was not tried: the user's own with the reason, what the declaration lacks with the way
    out, the others by name."""
    own = of_the_user(result.not_tried)
    together: dict[str, list[str]] = {}
    for s in own:
        together.setdefault(s.reason, []).append(s.name)
    for reason, names in together.items():
        verb = "were" if len(names) > 1 else "was"
        yield f"{', '.join(names)} {verb} not tried: {reason}"
    left = {s.name: s.reason for s in result.not_tried if s not in own}
    for why in (*MISSING.values(), UNTIMED):
        names = [name for name, reason in left.items() if reason.endswith(why)]
        if names:
            yield f"not tried: {_few(names)}: {left[names[0]]}"
        left = {name: reason for name, reason in left.items() if name not in names}
    if left:
        yield f"not tried, why is in result.json: {_few(list(left))}"


def _few(names: Sequence[str]) -> str:
    """The first of many names, and how many more there are."""
    if len(names) <= FEW + 1:
        return ", ".join(names)
    return f"{', '.join(names[:FEW])} and {len(names) - FEW} more"


def judged(gain: str) -> str:
    """By how much an effect makes held-out data better predicted, and how that is counted."""
    return (
        f"The mean square error on held-out data falls by {gain}, residuals "
        f"beyond {LEVELS.far:g} standard deviations of the noise counted as {LEVELS.far:g}."
    )


def sided(effect: Effect) -> Iterator[str]:
    """On which side of two instruments a cause is, where its sign says so."""
    for name, parameter in effect.parameters.items():
        meaning = BELOW_ZERO.get((effect.name, name))
        if meaning is not None and _first_of(parameter.value) < 0:
            yield f"{name} is below zero: {meaning}"


def chained(effects: Sequence[Effect]) -> Iterator[str]:
    """Where several act on one thing."""
    places = Counter(e.on for e in effects if e.on not in (None, NOISE))
    for place in (p for p, count in places.items() if count > 1):
        yield f"effects on {place} act one after the other, each on what the last one leaves"


def instead(effect: Effect, parameters: Mapping[str, Parameter]) -> Iterator[str]:
    """What hangs on which of the causes it is."""
    for label, shifts in effect.instead_would_move.items():
        if shifts:
            words = _moved_by(shifts, parameters)
            yield f"were it {label} instead, the parameters would move: {words}"


def undecided(
    left: Unexplained, parameters: Mapping[str, Parameter], command: str = ""
) -> Iterator[str]:
    """Causes of which none was added: what each would do, what would tell them apart."""
    for label, shifts in left.would_move.items():
        if shifts:
            yield f"{label} would move the parameters: {_moved_by(shifts, parameters)}"
    yield from (f"to tell {words}" for words in left.would_separate[:NAMED])
    if name := to_be_asked(left, command):
        yield f"who knows which of them is there says so, as --effects {shlex.quote(name)}"


def to_be_asked(left: Unexplained, command: str) -> str:
    """A shipped effect, the likeliest, of those that none was added of, as `--effects` takes it;
    empty where there is none that explains what counts, or where the `command` asked for some."""
    shipped = set() if "--effects" in command else {e.name for e in CATALOGUE}
    enough = (left.share or 0.0) >= LEVELS.share
    labels = left.one_of if enough else left.would_move
    asked = (label for label in labels if label.partition("(")[0] in shipped)
    return next(asked, "")


def _moved_by(shifts: Shifts, parameters: Mapping[str, Parameter]) -> str:
    """`offset by 0.05 m/s^2, …`."""
    return ", ".join(
        f"{name} by {size:.2g} {_first(parameters[name].unit)}".removesuffix(" 1").rstrip()
        for name, size in shifts.items()
    )


def _first_of(value: Any) -> float:
    return _first_of(value[0]) if isinstance(value, list) else float(value or 0.0)


def _first(unit: Any) -> str:
    return _first(unit[0]) if isinstance(unit, list) else str(unit)
