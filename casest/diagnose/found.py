"""What was found: an effect with its evidence, or causes that explain alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from casest.declaration.effect import RANDOM_WALK
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.levels import LEVELS

#: What is refused where nothing can be held out.
HELD_OUT_DATA = "held-out data"


@dataclass(frozen=True)
class Found:
    """An effect that was added, with the evidence.

    `gain`: fall of the held-out mean square; `rivals`: what the data do not tell apart from it,
    nearest first, each with how far the declared parameters would move were it the cause.
    """

    candidate: Candidate
    p_value: float
    gain: float
    names: tuple[str, ...] = ()
    rivals: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)

    @property
    def of_noise(self) -> bool:
        """Is it a property of the noise, which leaves a model adequate?"""
        return self.candidate.effect is not None and self.candidate.effect.kind == "noise"

    @property
    def wanders(self) -> bool:
        """Is it an offset that was declared to walk at random?"""
        return self.candidate.effect is not None and self.candidate.effect.seen_in == RANDOM_WALK

    @property
    def indistinguishable_from(self) -> tuple[str, ...]:
        """Names of the rivals."""
        return tuple(self.rivals)


@dataclass(frozen=True)
class Undecided:
    """Something is missing, and what it is hangs on more than the data say.

    `share` of the mean square that the first would take away; `moves`: how far each would move the
    declared parameters, of those that were refitted.
    """

    names: tuple[str, ...]
    share: float
    moves: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)

    @property
    def explains(self) -> bool:
        """Would any of them take away what can be printed? A likelihood may ask for what does not,
        where noise is coloured or held-out parts deny it."""
        return bool(self.moves) or self.share >= LEVELS.told_share


@dataclass(frozen=True)
class Course:
    """A slow course in what is left, what it looks like, and its share of the variance; 0: unknown,
    and then it is no evidence by itself."""

    what: Candidate
    share: float = 0.0
