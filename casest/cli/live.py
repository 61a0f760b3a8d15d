"""`plan --live`: which pose is next while one measures, until the goal is reached."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casest.cli.options import ReadingOptions
from casest.cli.shared import echo
from casest.errors import CasestError, NotTrusted, UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.plan.candidates.candidates import Candidates, Noise
    from casest.plan.goals import Goal, Measures
    from casest.plan.planning import Task

#: Equations for each unknown from which on a fit moves the values that slopes are taken at.
ENOUGH = 1.3


@dataclass
class Session:
    """What is known so far: values, poses taken; and what each pose is chosen for."""

    model: Any
    values: Any
    noise: Noise
    known: Any
    possible: Any
    reading: ReadingOptions
    goals: tuple[str, ...]
    fits: bool
    taken: int = 0
    text: str = ""
    said: list[str] = field(default_factory=list)

    def arrived(self, text: str) -> bool:
        """Take in what has come; is the goal reached?"""
        self.text += text
        run = self._poses()
        if run is None or len(run) == self.taken:
            return False
        self.taken = len(run)
        if self.fits:
            self._refit(run)
        return self.tell(run)

    def _poses(self) -> Run | None:
        """The poses in what has come so far: rest intervals, or rows."""
        from casest.data import load_runs

        whole = self.text[: self.text.rfind("\n") + 1]
        if whole.count("\n") < 2:
            return None
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "live.csv"
            path.write_text(whole, encoding="utf-8")
            try:
                runs = load_runs([path], self.model.signals, **self.reading.keywords())
            except CasestError as error:
                if "rest" in str(error):  # none yet
                    return None
                raise type(error)(str(error).replace(str(path), "--live")) from None
        return runs[-1]

    def _refit(self, run: Run) -> None:
        from casest.estimate.calibrate import attempt

        unknowns = sum(p.shape.coordinates for p in self.model.parameters)
        if len(run) * len(self.model.axes) < ENOUGH * unknowns:
            return
        try:
            found = attempt(self.model, [run], intervals=False)
        except (NotTrusted, UsageError):
            return
        if found.certificate.trusted:
            self.values = found.values

    def tell(self, run: Run | None) -> bool:
        """Say what the poses have brought, and which is next; are all goals reached?"""
        from casest.plan.planning import task

        found = self._candidates()
        n = len(found.names)
        known = self.known if self.known is not None else _zeros(n)
        if run is not None:
            known = known + self._brought(run)
        given = task(found.factors, known, found.names, self.model.name)
        measures = self.measures(found)
        goals = [measures.goal(text) for text in self.goals]
        now = given.covariance(())
        done = bool(goals) and now is not None and all(g.std(now) <= g.limit for g in goals)
        best, ratio = _next(given, goals)
        head = f"{self.taken} poses" if self.taken != 1 else "1 pose"
        parts = [head, *(_reached(g, now) for g in goals)]
        if now is None:
            parts.append(f"{_rank(given)} of {n} unknowns determined")
        if not done:
            parts.append(f"next: {found.words[best]}{ratio}")
        echo("; ".join(parts))
        return done

    def _candidates(self) -> Candidates:
        from casest.plan.candidates.finding import candidates

        return candidates(self.model, self.values, self.noise, self.possible)

    def _brought(self, run: Run) -> Any:
        """Information of the poses taken."""
        from casest.plan.candidates.candidates import factors_of

        own = factors_of(self.model, self.values, run, self.noise)
        rows = own.reshape(-1, own.shape[2])
        return rows.T @ rows

    def measures(self, found: Candidates) -> Measures:
        """What goals can be about."""
        raise NotImplementedError


def _zeros(n: int) -> Any:
    import numpy as np

    return np.zeros((n, n))


def _rank(given: Task) -> int:
    import numpy as np

    return int(np.linalg.matrix_rank(given.known, hermitian=True))


def _next(given: Task, goals: list[Goal]) -> tuple[int, str]:
    """The candidate that brings most, and by how much the standard deviations fall with it."""
    import numpy as np

    from casest.plan.design.criteria import inverse
    from casest.plan.planning import criterion_of

    columns = np.hstack([g.scaled for g in goals]) if goals else None
    criterion = criterion_of(given, "D", columns)
    C = inverse(given.start)
    after = criterion.after(C, given.factors)
    best = int(np.argmin(after))
    if given.covariance(()) is None:
        return best, ""
    share = criterion.ratio(float(after[best]), criterion.value(C), len(given.scale))
    return best, f" (std ×{share:.2f})"


def _reached(goal: Goal, covariance: Any) -> str:
    unit = f" {goal.unit}" if goal.unit not in ("", "1") else ""
    now = "undetermined" if covariance is None else f"{goal.std(covariance):.2g}{unit}"
    return f"{goal.name} {now} (goal {goal.limit:g}{unit})"
