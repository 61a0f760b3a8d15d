"""The speed of the wheel, half a turn at a time, against the cubic law (Pedersini, Fig. 3).

The speeds come from the readings alone and know nothing of the law; so what the law lacks is seen
as a slow wave in the residual. What comes and goes within a turn (an unbalanced wheel) is mostly
averaged out. Drawing needs matplotlib.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import casest_problems.wheel as paper
from casest import Estimate, NotTrusted, UsageError

Array = NDArray[np.float64]

#: Fewer half turns than this show nothing that a cubic would not follow.
FEWEST = 8
#: Blue and vermilion of Okabe and Ito, told apart by every kind of eye.
DOTS, LINE = "#0072B2", "#D55E00"


@dataclass(frozen=True)
class HalfTurns:
    """One run: mean speed of each half turn as read, and as the fitted cubic has it (rad/s).

    `times` (n,) in s are the middles of the half turns; `curve` (n,) is the cubic there.
    """

    run: str
    times: Array
    speeds: Array
    curve: Array

    @property
    def residual(self) -> Array:
        """Speeds as read minus those of the cubic, rad/s."""
        return self.speeds - self.curve

    @property
    def structure(self) -> float:
        """Correlation of the residual with itself one turn later, between −1 and 1.

        Noise alone leaves about 0 ± 1.2/√n: neighbours share a boundary, whose error makes one too
        slow and the other too fast, but two half turns apart share none. A law that does not hold
        brings it towards 1.
        """
        rest = self.residual - self.residual.mean()
        return float(rest[2:] @ rest[:-2] / (rest @ rest))


def half_turn_speeds(t: Array, v: Array) -> tuple[Array, Array]:
    """(times, speeds): middle (s) and mean speed (rad/s, positive) of each half turn.

    From readings v (N, 3) at t (N,), and from no law of motion. Raises NotTrusted where nothing
    turns, or less than about five turns are seen.
    """
    # This law's phase only tells where a turn is over; what it lacks is put back below.
    phase = paper.find_motion(t, v).phase(t)
    phase = phase * np.sign(phase[-1] - phase[0])
    inner, z = _circle(phase, v)
    t, phase = t[inner], phase[inner]
    first = np.flatnonzero(np.diff(np.floor(phase / np.pi), prepend=-np.inf) > 0)
    if len(first) < FEWEST + 3:
        raise NotTrusted(
            f"wheel: {max(len(first) - 2, 0)} half turns are too few to look at their speeds; "
            f"at least {FEWEST + 1} are needed"
        )
    counts = np.diff(np.append(first, len(t)))
    left = np.add.reduceat(z * np.exp(-1j * phase), first)
    # Averages over the half turns' middles: nothing is known of where the first and last begin.
    middle = (np.add.reduceat(t, first) / counts)[1:-1]
    back = (np.add.reduceat(phase, first) / counts)[1:-1]
    angle = back + np.unwrap(np.angle(left[1:-1]))
    return 0.5 * (middle[1:] + middle[:-1]), np.abs(np.diff(angle) / np.diff(middle))


def _circle(phase: Array, v: Array) -> tuple[Any, Any]:
    """(samples, z): complex numbers going once round the unit circle a turn, but for both ends.

    Each sample's level is the mean over the turn around it, so that the centripetal part, slow as
    it is, goes without a law for it. What is left lies on an ellipse, which is made a circle.
    """
    turn = 2 * np.pi
    sums = np.vstack([np.zeros(3), np.cumsum(v, axis=0)])
    inner = (phase > phase[0] + turn / 2) & (phase < phase[-1] - turn / 2)
    index = np.arange(len(phase) + 1)
    ends = np.append(phase, 2 * phase[-1] - phase[-2])
    # Fractions of a sample count: a turn of few samples would else be too long or too short.
    here = phase[inner] + 0.5 * np.gradient(phase)[inner]
    low, high = (np.interp(here + side * turn / 2, ends, index) for side in (-1, 1))
    columns = [np.interp(high, index, s) - np.interp(low, index, s) for s in sums.T]
    rest = v[inner] - np.column_stack(columns) / (high - low)[:, None]
    limit = 4 * np.median(np.abs(rest), axis=0) + 1e-300  # a knock is no turning
    u = np.linalg.svd(np.clip(rest, -limit, limit), full_matrices=False)[0]
    z = u[:, 0] + 1j * u[:, 1]
    # The circle may be run through backwards; the phase runs forwards.
    forwards, backwards = (abs(np.sum(w * np.exp(-1j * phase[inner]))) for w in (z, z.conj()))
    return inner, z if forwards >= backwards else z.conj()


def half_turns(estimate: Estimate) -> list[HalfTurns]:
    """Speeds as read and as fitted, for each run of a fitted wheel."""
    if "speed" not in estimate.values:
        raise UsageError(
            f"{estimate.model.name} has no unknown `speed`: only a wheel's can be drawn"
        )
    runs = estimate.problem.runs
    cubics = np.reshape(estimate.values["speed"], (-1, 4))
    found = []
    for run, cubic in zip(runs, np.broadcast_to(cubics, (len(runs), 4)), strict=True):
        times, speeds = half_turn_speeds(run.signals["t"][:, 0], run.signals["v"])
        curve = np.abs(np.polynomial.polynomial.polyval(times, cubic))
        found.append(HalfTurns(run.name, times, speeds, curve))
    return found


def draw_half_turns(estimate: Estimate, path: str | Path) -> list[HalfTurns]:
    """Write the picture to `path` (PNG, PDF, SVG), two panels a run; return what is drawn."""
    found = half_turns(estimate)
    figure = _figure(len(found))
    panels = figure.subplots(2, len(found), squeeze=False, sharex="col", height_ratios=(1, 2))
    for (above, below), turns in zip(panels.T, found, strict=True):
        _draw_residual(above, turns)
        _draw_speeds(below, turns)
    _label(panels)
    figure.savefig(path, dpi=100)
    return found


def _figure(runs: int) -> Any:
    """An empty figure that needs no display."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UsageError("pictures need matplotlib: pip install matplotlib") from error
    return Figure(figsize=(1.2 + 5.2 * runs, 5.2), layout="constrained")


def _draw_residual(axes: Any, turns: HalfTurns) -> None:
    rest = 1e3 * turns.residual
    axes.plot(turns.times, rest, ".", color=DOTS, markersize=3)
    axes.axhline(0, color=LINE, linewidth=1)
    axes.set_title(
        f"{turns.run}: residual's σ {rest.std():.3g} mrad/s, largest {np.abs(rest).max():.3g}, "
        f"\ncorrelation a turn later {turns.structure:.2f}",
        fontsize=10,
    )


def _draw_speeds(axes: Any, turns: HalfTurns) -> None:
    axes.plot(turns.times, turns.speeds, ".", color=DOTS, markersize=4, label="half turns, as read")
    axes.plot(turns.times, turns.curve, color=LINE, linewidth=1.2, label="fitted cubic")
    axes.set_xlabel("time t [s]")
    axes.legend(frameon=False)


def _label(panels: Sequence[Any]) -> None:
    for row in panels:
        for axes in row:
            axes.grid(alpha=0.3)
    panels[0][0].set_ylabel("as read − cubic\n[mrad/s]")
    panels[1][0].set_ylabel("mean speed of a half turn [rad/s]")
