"""What a search is made of: causes ranked, refitted, kept, refused; a state of it is a value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Generic, TypeVar

from casest.diagnose.evidence.held_inputs import Held
from casest.diagnose.evidence.held_out import Fall
from casest.diagnose.evidence.likelihood import Explained, Likelihood
from casest.diagnose.evidence.linear import Linear
from casest.diagnose.evidence.score import Evidence, Trial
from casest.diagnose.levels import LEVELS

F = TypeVar("F")


@dataclass(frozen=True)
class Ranking:
    """Causes by what they are worth, beside one fit; the best of each family, best first.

    `most`: of each family that takes most of the squares the trial that takes most, whatever its
    likelihood says.
    """

    linear: Linear
    likelihood: Likelihood = field(repr=False)
    none: Explained = field(repr=False)
    found: tuple[Evidence, ...]
    families: int
    order: Mapping[str, int] = field(default_factory=dict, repr=False)
    most: tuple[Trial, ...] = ()

    def says(self, evidence: Evidence) -> bool:
        """Strong evidence in a series; in poses the F test, shared among all that was tried."""
        if not self.linear.series:
            return evidence.p_value < LEVELS.chance
        return evidence.score > LEVELS.strong and self.stands_out(evidence)

    def stands_out(self, evidence: Evidence) -> bool:
        """Of the errors that levels have in common, where inputs are held."""
        return self._held is None or self._held.says(evidence.trials)

    @cached_property
    def _held(self) -> Held | None:
        return None if self.linear.plateaus is None else Held(self.linear, self.families)

    @property
    def causes(self) -> tuple[Evidence, ...]:
        """Those that have a name of their own."""
        return tuple(e for e in self.found if not e.trials[0].describes)

    @cached_property
    def followed(self) -> tuple[Evidence, ...]:
        """What follows a column that is no cause by itself: something there is missing all the
        same."""
        described = [e for e in self.found if e.trials[0].describes and e.trials[0].what.column]
        return tuple(e for e in described if self.says(e))

    @property
    def courses(self) -> tuple[Evidence, ...]:
        """Courses of unknown cause, whatever evidence there is for them."""
        described = (e for e in self.found if e.trials[0].describes)
        return tuple(e for e in described if not e.trials[0].what.column)

    @property
    def descriptions(self) -> tuple[Evidence, ...]:
        """Courses of unknown cause that there is evidence for, and none for a better one."""
        found = [e for e in self.found if e.trials[0].describes and e.score > LEVELS.strong]
        return tuple(e for e in found if e.score > found[0].score - LEVELS.clear)


@dataclass(frozen=True)
class Refit(Generic[F]):
    """A cause in the model, fitted, and the fit `before` it: `evidence` with the score of this fit;
    `falls` if they are not those of its columns."""

    before: F
    fit: F
    evidence: Evidence
    falls: dict[str, Fall] | None = None


@dataclass(frozen=True)
class Rival:
    """A cause that is not told apart from one that was added, and the fit with it instead."""

    what: Any
    fit: Any = field(repr=False)


@dataclass(frozen=True)
class Kept:
    """A cause that was added, its evidence when it was, what held-out parts said, its rivals."""

    what: Any
    evidence: Evidence
    falls: dict[str, Fall]
    rivals: tuple[Rival, ...] = ()


#: End the reasons against what is not what its name says, at the sizes of its refit, or tells what
#: the model tells itself.
ANOTHER = "it is another effect"
STANDS_IN = "its columns stand in their place"
#: Follows them where another cause came with it.
BESIDE = " (beside "
#: And against what the largest readings in a burst of noise make.
LOUDER = "noise is louder where it is, and readings there differ from each other by as much"


@dataclass(frozen=True)
class Refused:
    """What explained much but was not added, and why."""

    what: Any
    why: str

    @property
    def another(self) -> bool:
        """Is it not what its name says? Of a pair nobody knows which of the two is not."""
        return BESIDE not in self.why and (ANOTHER in self.why or STANDS_IN in self.why)


@dataclass(frozen=True)
class Round(Generic[F]):
    """A fit that was looked at: with these causes in it, and by their columns alone, all others."""

    fit: F
    causes: tuple[Any, ...]
    ranking: Ranking = field(repr=False)


@dataclass(frozen=True)
class State(Generic[F]):
    """A search as it stands: the fit, what it has been given, what was refused.

    `open`: causes of which one is there, but not one to add; `torn`: their refits, where each would
    do more harm than none if it is the wrong one; `rounds`: what this search has looked at; `gone`:
    what was added and went again, by label.
    """

    fit: F
    kept: tuple[Kept, ...] = ()
    refused: tuple[Refused, ...] = ()
    open: tuple[Evidence, ...] = ()
    torn: tuple[Refit[F], ...] = ()
    first: Ranking | None = None
    last: Ranking | None = None
    rounds: tuple[Round[F], ...] = field(default=(), repr=False)
    gone: frozenset[str] = frozenset()

    def refusing(self, what: Any, why: str) -> State[F]:
        """The state with a refusal, which is said once."""
        if any(r.what == what and r.why == why for r in self.refused):
            return self
        return replace(self, refused=(*self.refused, Refused(what, why)))

    def dropping(self, kept: Kept, why: str) -> State[F]:
        """The state without a cause that was added, whose fit is another's to say."""
        others = tuple(k for k in self.kept if k is not kept)
        gone = self.gone | {kept.what.label}
        return replace(self, kept=others, gone=gone).refusing(kept.what, why)

    def unlike(self, evidence: Evidence) -> bool:
        """Is it a cause that is not what its name says, or has one that is a burst of noise? It
        explains nothing under that name."""
        labels = {t.what.label for t in evidence.trials}
        alone = len(labels) == 1
        named = (r for r in self.refused if r.what.label in labels)
        return any(r.why == LOUDER or (alone and r.another) for r in named)

    def failing(self, evidence: Evidence, why: str) -> State[F]:
        """The state that says of each of these causes why there is no refit with them."""
        state = self
        for trial in evidence.trials:
            others = [f for f in evidence.families if f != trial.family]
            beside = f"{BESIDE}{', '.join(others)})" if others else ""
            state = state.refusing(trial.what, why + beside)
        return state
