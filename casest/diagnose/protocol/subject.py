"""What is searched: it knows its model, what could be missing there, and how to refit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import Any, Protocol

from casest.declaration.shapes import Array
from casest.diagnose.evidence.linear import Linear
from casest.diagnose.evidence.score import Evidence, Trial
from casest.diagnose.protocol.state import F, Kept, Ranking


class Subject(Protocol[F]):
    """What is searched. Fits are values; `what` of a trial is the subject's own.

    One that knows no grids, axes, descriptions or wishes of the user leaves those questions be.
    """

    def linear(self, fit: F) -> Linear:
        """The fit as a linear problem."""
        ...

    def linear_in(self, fit: F, other: F) -> Linear:
        """Another fit as a linear problem, its residuals in the units of this one's."""
        return self.linear(other)

    def compared(self, less: F, fit: F) -> tuple[Linear, Linear]:
        """A fit without what another has more, and that one, to be compared row by row."""
        return self.linear(less), self.linear(fit)

    def trials(self, fit: F) -> Sequence[Trial]:
        """All that could be missing, in its columns; of what has a grid, one for each value."""
        ...

    def shown(self, fit: F) -> Sequence[Trial]:
        """What is refitted whatever its columns promise."""
        return ()

    def everywhere(self, what: Any) -> bool:
        """Is it an influence that is there in every row, and no event or threshold?"""
        return False

    def jittered(
        self, fit: F, trials: Sequence[Trial]
    ) -> Sequence[Sequence[tuple[Linear, Mapping[int, Array]]]]:
        """For each noisy input a few draws: the fit as a linear problem, and the trials' columns by
        their identity, where the input has as much more noise as would be all of the residual's."""
        return ()

    def noise_in(
        self, before: F, after: F
    ) -> Sequence[Sequence[tuple[float, Array, Array, Array]]]:
        """For each noisy input a few draws: how much of its noise, and what that adds to the
        residuals (N, m) of two fits."""
        return ()

    def gain_backward(self, fit: F, trial: Trial) -> float:
        """What the mirror image of a memory, about its own delay, gains beside a fit: noise of the
        inputs has no more of it. Infinite where there is no saying."""
        return inf

    def gained_backward(self, before: F, after: F) -> float:
        """The same of the one memory that a fit has more than another, at its value there."""
        return inf

    def nearer(self, fit: F, trial: Trial, scale: float) -> Sequence[Trial]:
        """Variants of a trial around its value on a grid."""
        return ()

    def on_axes(self, fit: F, trial: Trial, axes: Sequence[int]) -> Trial:
        """The trial on some of its axes only."""
        return trial

    def refit(self, fit: F, added: Sequence[Trial]) -> F | str:
        """The fit with these in the model; or why there is none."""
        ...

    def rises(self, less: F, fits: Sequence[F]) -> list[float]:
        """2 log of the likelihood of each fit over that of one with less in it."""
        ...

    def rises_beside_a_wander(self, less: F, fits: Sequence[F]) -> list[float]:
        """The same where an offset may wander that is slow in no residual; none where it cannot."""
        return []

    def certified(self, fit: F) -> F | str:
        """The fit, proved; or why it is refused."""
        return fit

    def without(self, fit: F, what: Any) -> F | None:
        """The fit without something that was added."""
        ...

    def unlike(self, fit: F) -> str:
        """Why an effect in a fit is not what its name says there; else empty."""
        return ""

    def instead(self, fit: F, what: Any, added: Sequence[Trial]) -> F | str:
        """The fit with these in the place of something that was added, from where it is."""
        return ""

    def wider(self, fit: F, what: Any) -> tuple[Any, F] | None:
        """Something that was added on some axes only, and the fit with it on all of them."""
        return None

    def better_axes(self, fit: F, what: Any) -> tuple[Any, F] | None:
        """The same where it cannot be on all of them: on those that are worth it by now."""
        return None

    def apart(self, fit: F, kept: Kept) -> tuple[Linear, Trial] | None:
        """The linear problem as if a cause were not there, and the cause as a trial of it."""
        ...

    def asked(self, what: Any) -> bool:
        """Did the user say that it is there?"""
        return False

    def formula(self, fit: F, ranking: Ranking) -> Evidence | None:
        """The best description outside the catalogue."""
        return None
