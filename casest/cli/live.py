"""`plan --live`: which pose is next while one measures, until the goal is reached."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casest.cli.options import ReadingOptions
from casest.cli.plan_options import PlanOptions
from casest.cli.shared import echo
from casest.cli.situation import Situation, measures_of, possible_of
from casest.errors import CasestError, NotTrusted, UsageError

if TYPE_CHECKING:
    from casest.data.run import Run
    from casest.declaration.model import Model
    from casest.plan.candidates.candidates import Candidates, Noise
    from casest.plan.goals import Goal
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
    units: Mapping[str, str]
    goals: tuple[str, ...]
    fits: bool
    taken: int = 0
    text: str = ""
    thing: str = "pose"

    @property
    def counted(self) -> str:
        """`24 poses`."""
        return f"{self.taken} {self.thing}{'' if self.taken == 1 else 's'}"

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
        measures = measures_of(self, found)
        goals = [measures.goal(text) for text in self.goals]
        now = given.covariance(())
        done = bool(goals) and now is not None and all(g.std(now) <= g.limit for g in goals)
        best, ratio = _next(given, goals)
        if found.kind not in ("pose", "sample"):
            raise UsageError(
                f"--live counts poses and rows; {self.model.name} is measured in runs: plan each "
                "without --live"
            )
        self.thing = "pose" if found.up is not None else "reading"
        parts = [self.counted, *(_reached(g, now) for g in goals)]
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


def follow(session: Session, source: str, idle: float, baud: int) -> bool:
    """Tell which pose is next each time one has been taken; is the goal reached at the end?"""
    from casest.plan.live import arriving

    if session.tell(None):
        return True
    for text in arriving(source, idle, baud):
        if text and session.arrived(text):
            echo("reached: stop here")
            return True
    echo(f"nothing more came; {session.counted} {'was' if session.taken == 1 else 'were'} taken")
    return False


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


def living(situation: Situation, options: PlanOptions, source: str) -> int:
    """Which pose is next while one measures; exit code 0 where it ends, reached or not."""
    if options.robust or options.budget is not None:
        raise UsageError("--live says what is next as it comes: leave --robust and --budget out")
    if (
        options.separate
        or options.show
        or options.count is not None
        or options.output
        or options.as_json
    ):
        raise UsageError("--live says what is next as it comes: leave --count, -o and --json out")
    if options.until and not situation.noise.known:
        name = situation.model.readings[0].name
        raise UsageError(f"--until: how well depends on the noise: --sensor-noise {name}=STD")
    known = situation.information
    if known is not None and len(known) != _unknowns(situation.model):
        raise UsageError(
            f"{situation.after}: what each run has for itself is unknown in a new one: give the "
            "MODEL to --live"
        )
    session = Session(
        situation.model,
        situation.values,
        situation.noise,
        known,
        possible_of(situation, options),
        options.reading,
        situation.units,
        options.until,
        fits=known is None,
    )
    follow(session, source, options.live.idle, options.live.baud)
    return 0


def _unknowns(model: Model) -> int:
    return sum(p.shape.coordinates for p in model.parameters)
