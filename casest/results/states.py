"""What `casest filter` leaves: states along a trajectory, and whether the noise is as declared."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from msgspec import UNSET, Struct, UnsetType

from casest.data.run import Run
from casest.dynamics import Dynamics
from casest.dynamics.course import Course, followed
from casest.dynamics.inputs import uncertain, unstated
from casest.dynamics.intensities import Tuned, intensities, units
from casest.dynamics.moving_horizon import Horizon, moving_horizon
from casest.dynamics.transition import Pace
from casest.results.file import plain
from casest.results.fitted import DeclaredIn, declared_in
from casest.results.observability import assumed, too_short
from casest.results.result import Number, Reproduced, Result, reproduced
from casest.results.trajectory import Innovations, Trajectory, trajectory_of, weakly_told

#: Rows of states.csv that are written at once.
ROWS = 8192
#: Between these shares of what is expected innovations are called as large as expected.
SMALLEST, LARGEST = 0.8, 1.25
#: Squared errors that may be below this share of what is claimed: it is said.
CLAIMED = 0.95
#: Filter and smoother disagree at the end by more than so many standard deviations: it is said.
PARTED = 1.0


class FinalState(Struct, frozen=True):
    """A state at the end of the record, as all of it says, and how well the smoother knows it along
    the way."""

    value: list[Number]
    std: list[Number]
    smoothed_std_median: list[Number]
    unit: str


class UsedIntensities(Struct, frozen=True):
    """Noise intensities: declared and used ones, how sure those are that the data gave."""

    how: str
    declared: dict[str, Number]
    used: dict[str, Number]
    spread: dict[str, Number]
    units: dict[str, str]
    declared_normalised_mean: Number


class UsedStep(Struct, frozen=True):
    """What a filter's step on a device takes: the usual time between two samples of the record, s,
    and the noise intensities that go with it."""

    period: Number
    intensities: dict[str, Number]


class UsedHorizon(Struct, frozen=True):
    """A moving horizon: its steps; at how many samples the bound of each number acts; windows that
    did not settle, and the rounds that a window takes, on average."""

    steps: int
    at_lower: dict[str, int]
    at_upper: dict[str, int]
    unsettled: int
    rounds: Number


class States(Result, frozen=True, kw_only=True, dict=True):
    """The content of `filter.json`; `filtered`: states and covariances.

    `allan`: what a record at rest said, per signal. `settled`: else the states are approximate, and
    their std too small. `as_expected`: are the innovations as large as the noise intensities say?
    """

    unwritten = ("as_expected", "filtered")

    notes: list[str]
    samples: int
    settled: bool
    states: dict[str, FinalState]
    intensities: UsedIntensities
    innovations: Innovations
    step: UsedStep
    declared_in: DeclaredIn
    allan: Mapping[str, Any] | UnsetType = UNSET
    horizon: UsedHorizon | UnsetType = UNSET
    data: list[str]
    reproduce: Reproduced
    as_expected: bool
    filtered: Course

    @cached_property
    def trajectory(self) -> Trajectory:
        """States and innovations along the record."""
        return trajectory_of(self.filtered)


def follow(
    model: Dynamics,
    run: Run,
    tuned: Tuned | None = None,
    *,
    allan: Mapping[str, Any] | None = None,
    horizon: int | None = None,
    data: Sequence[str] = (),
    command: str = "",
) -> States:
    """States over time by the Kalman filter, and whether the innovations are as expected.

    `tuned`: the same model with other noise intensities, used in place of the declared ones, which
    are shown beside them; `allan`: what a record at rest said of them; `horizon`: by so many steps
    at once, in place of the filter.
    """

    def states(of: Dynamics, smooth: bool = True) -> Course:
        return moving_horizon(of, run, horizon) if horizon else followed(of, run, smooth=smooth)

    # Noise that is only stated (--sensor-noise) leaves nothing to show beside it.
    declared = states(model, smooth=tuned is None) if model.says_noise or not tuned else None
    found = states(tuned.model) if tuned else declared
    assert found is not None
    mean, m = _normalised_mean(found), found.innovations.shape[1]
    return States(
        model=found.model.name,
        notes=[
            *assumed(run),
            *_taken_for_motion(found.model, run),
            *_bounded(found),
            *(_of_windows(found) if isinstance(found, Horizon) else _of_the_record(found)),
            *(_too_short(run, found.model.size) or weakly_told(found)),
        ],
        samples=len(found.time),
        settled=found.settled,
        states=_final(found),
        intensities=UsedIntensities(
            tuned.how if tuned else "as declared",
            _plain_values(intensities(model, run)) if declared else {},
            _plain_values(intensities(found.model, run)),
            _plain_values(tuned.spread) if tuned else {},
            units(found.model),
            plain(_normalised_mean(declared)) if declared else None,
        ),
        innovations=Innovations(
            plain(np.sqrt(np.nanmean(found.innovations**2, axis=0))),
            plain(mean),
            m,
            int(np.sum(~np.isfinite(found.normalised_innovations))),
            plain(_lag1(found.innovations)),
        ),
        step=_step(found.model, run),
        declared_in=declared_in(model),
        allan=allan or UNSET,
        horizon=_used(found) if isinstance(found, Horizon) else UNSET,
        data=list(data),
        reproduce=reproduced(command, data),
        as_expected=bool(SMALLEST < mean / m < LARGEST),
        filtered=found,
    )


def _step(model: Dynamics, run: Run) -> UsedStep:
    """A reading's variance is its intensity over the time between two: of one with a clock of its
    own that is not the time between two samples."""
    pace = Pace.of(model, run)
    used = intensities(model, run)
    for name in model.measured_signals:
        used[name] *= pace.usual / pace.periods.get(name, pace.usual)
    return UsedStep(plain(pace.usual), _plain_values(used))


def _final(found: Course) -> dict[str, FinalState]:
    x, std = found.end
    return {
        name: FinalState(
            plain(x[where]),
            plain(std[where]),
            plain(_median_std(found, where)),
            found.model[name].unit,
        )
        for name, where in found.model.slices().items()
    }


def _plain_values(values: Mapping[str, float]) -> dict[str, Number]:
    return {name: plain(value) for name, value in values.items()}


def _used(found: Horizon) -> UsedHorizon:
    at = np.count_nonzero(found.multipliers > 0, axis=0)
    names = found.model.names
    return UsedHorizon(
        found.horizon,
        {name: int(count) for name, count in zip(names, at[0], strict=True) if count},
        {name: int(count) for name, count in zip(names, at[1], strict=True) if count},
        int(np.count_nonzero(found.unsettled)),
        plain(float(np.mean(found.rounds))),
    )


def _of_windows(found: Horizon) -> list[str]:
    """What a moving horizon says otherwise than filter and smoother, and where it is in doubt."""
    said = [
        f"states by a moving horizon of {found.horizon} steps; smoothed ones are by so many "
        "samples after each"
    ]
    used = _used(found)
    for which, counts in (("lower", used.at_lower), ("upper", used.at_upper)):
        said += [
            f"the {which} bound of {name} acts at {count} of {len(found.time)} samples"
            for name, count in counts.items()
        ]
    if used.unsettled:
        said.append(
            f"{used.unsettled} of {len(found.time)} windows did not settle: their states are "
            "approximate; a longer --horizon, a nearer start or a smaller std at the beginning may "
            "help"
        )
    return said


def _of_the_record(found: Course) -> list[str]:
    return [*_unsettled(found), *_parted(found), *_cautious(found)]


def _cautious(found: Course) -> list[str]:
    """Where what noise of inputs does is counted for more than it is."""
    if not found.least < CLAIMED:
        return []
    noisy = " and ".join(uncertain(found.model))
    return [
        f"noise of {noisy} acts on what this record does not tell of the states, and is counted as "
        "if that were new at every sample: squared errors of all states together may be as small "
        f"as {100 * found.least:.0f} % of what their covariance says (casest observe names what is "
        "not told)"
    ]


def _bounded(found: Course) -> list[str]:
    """Declared bounds that a filter, which does not know them, has left."""
    lower, upper = found.model.bounds
    outside = np.count_nonzero((found.x < lower) | (found.x > upper), axis=0)
    return [
        f"{name} leaves its bounds at {count} of {len(found.time)} samples, which a filter does "
        "not keep: --horizon 20 does"
        for name, count in zip(found.model.names, outside, strict=True)
        if count
    ]


def _unsettled(found: Course) -> list[str]:
    if found.settled:
        return []
    return [
        "the smoother's rounds did not settle: its states are those of one pass; nearer start "
        "values or a smaller std at the beginning may help"
    ]


def _taken_for_motion(model: Dynamics, run: Run) -> list[str]:
    """Noise of inputs that nobody stated, which a filter counts as motion."""
    units = {s.name: s.unit or "1" for s in model.signals}
    return [
        f"{name} shows noise of {std:.3g} {units[name]} that is not stated: it is taken for "
        f"motion, and what the filter is sure of may be too much (--sensor-noise {name}={std:.2g})"
        for name, std in unstated(model, run).items()
    ]


def _parted(found: Course) -> list[str]:
    """Where the filter ends elsewhere than the smoother, which has the same readings there."""
    x, std = found.end
    off = np.abs(found.x[-1] - x) / np.maximum(std, 1e-150)
    worst = int(np.argmax(off))
    if not off[worst] > PARTED:
        return []
    return [
        f"the filter ends {off[worst]:.2g} standard deviations of {found.model.names[worst]} away "
        "from what the whole record says, since it linearised at what it knew at the time: the "
        "states above and smoothed_* in states.csv are the record's, its innovations are the "
        "filter's; a nearer start, or a smaller std at the beginning, brings both together"
    ]


def _too_short(run: Run, unknowns: int) -> list[str]:
    words = too_short(run, unknowns)
    return [f"{w}; the states are mostly what was declared of the start" for w in words]


def _normalised_mean(found: Course) -> float:
    """Mean of νᵀS⁻¹ν after the first tenth, which belongs to the start values."""
    normalised = found.normalised_innovations
    whole = normalised[np.isfinite(normalised)]
    later = whole[len(whole) // 10 :]
    return float(np.mean(later)) if len(later) else float("nan")


def _median_std(found: Course, where: slice) -> Any:
    return np.median(found.smoothed_std[:, where], axis=0)


def _lag1(innovations: Any) -> Any:
    """Correlation of neighbouring innovations, each component: zero for the right filter."""
    r = np.where(np.isfinite(innovations), innovations, 0.0)
    return np.sum(r[1:] * r[:-1], axis=0) / np.maximum(np.sum(r**2, axis=0), 1e-300)


def states_csv(found: Course) -> Iterator[str]:
    """Filtered and smoothed states with standard deviations, a row per sample, in pieces."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names, own_units = found.model.names, found.model.state_units
    head = ["t [s]"]
    for kind in ("", "std_", "smoothed_", "smoothed_std_"):
        head += [f"{kind}{n} [{u}]" for n, u in zip(names, own_units, strict=True)]
    writer.writerow(head)
    columns = found.time[:, None], found.x, found.std, found.smoothed, found.smoothed_std
    for k in range(0, len(found.time), ROWS):
        table = np.hstack([own[k : k + ROWS] for own in columns])
        writer.writerows([[repr(v) for v in row] for row in table.tolist()])
        yield text.getvalue()
        text.seek(0)
        text.truncate()


def intensity_spread(spread: Mapping[str, Number], name: str) -> str:
    """How sure an intensity is, where the data gave it."""
    if name not in spread:
        return ""
    share = spread[name]
    if share is None:
        return "(not determined)"
    return f"± {100 * share:.2g} %" if share < 0.5 else f"(within a factor of {np.exp(share):.2g})"


def verdict_words(result: States) -> str:
    """How large the innovations are beside what the noise intensities say."""
    if result.as_expected:
        return "as large as the noise intensities say"
    mean = result.innovations.normalised_mean or float("nan")
    times = f"{mean / result.innovations.expected:.2g} times as large (squared) as the noise "
    if _parted(result.filtered):
        return (
            f"{times}intensities say; that the filter linearised away from where the record leads "
            "may be all there is to it"
        )
    return f"{times}intensities say: match them (--sensor-noise, --rest or --noise ml)"
