"""What closing the loop leaves: the estimates, what was added and why, what was refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

from casest.closing.adequacy import Misfit, misfit
from casest.closing.candidates import Candidate, Skipped
from casest.closing.crossfit import Folds
from casest.closing.score import Score
from casest.data.run import Run
from casest.declaring.shapes import Array
from casest.estimate import Estimate

#: What is refused where nothing can be held out.
HELD_OUT_DATA = "held-out data"
#: Effects that are a property of the noise, and leave a model adequate.
OF_NOISE = frozenset({"outliers", "bias_wander"})


@dataclass(frozen=True)
class Found:
    """An effect that was added, with the evidence: a score, but for one on the noise.

    `rivals`: what the data do not tell apart from it, nearest first, each with how far the declared
    parameters would move were it the cause instead.
    """

    candidate: Candidate
    score: Score | None
    p_value: float
    gain: float
    names: tuple[str, ...] = ()
    rivals: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)

    @property
    def indistinguishable_from(self) -> tuple[str, ...]:
        """Names of the rivals."""
        return tuple(self.rivals)


@dataclass(frozen=True)
class Undecided:
    """Something is missing, and these causes explain it alike; what is added hangs on which it is.

    `share` of the held-out mean square that any of them would take away; `moves`: how far each
    would move the declared parameters, where that is known.
    """

    names: tuple[str, ...]
    share: float
    moves: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)


@dataclass(frozen=True)
class Closing:
    """What the loop leaves: the estimate before and after, what was added, what was refused."""

    before: Estimate
    after: Estimate
    before_held_out: tuple[Array, ...]
    after_held_out: tuple[Array, ...]
    effects: tuple[Found, ...]
    skipped: tuple[Skipped, ...]
    refused: tuple[Skipped, ...]
    folds: Folds
    remaining: tuple[Score, ...]
    first: tuple[Score, ...]
    runs: tuple[Run, ...]
    noise: float = 0.0
    undecided: Undecided | None = None

    @cached_property
    def misfit(self) -> Misfit:
        """What is left after the loop, tested beside the noise as it is."""
        left = misfit(self)
        if self.undecided is None:
            return left
        names = self.undecided.names
        several = " and other shapes" if len(names) == 1 else ""
        where = f"which {' or '.join(names)}{several} explain alike"
        fraction = max(left.fraction, self.undecided.share)
        return replace(left, significant=True, fraction=fraction, where=where)

    @property
    def verdict(self) -> str | None:
        """adequate, extended or unexplained; None where nothing can be told.

        That is without a trusted estimate, and where nothing could be held out.
        """
        if not self.after.certificate.trusted or not self.folds.count:
            return None
        if self.misfit.significant:
            return "unexplained"
        named = {f.candidate.name for f in self.effects}
        return "extended" if named - OF_NOISE else "adequate"
