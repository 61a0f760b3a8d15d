"""Reports of `casest observe` and `casest filter`: what a trajectory shows, and states along it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

import numpy as np

from casest.declaration.shapes import Array
from casest.report.html.figures import BAND, Figures, axis, panel
from casest.report.html.fitted import reproduction
from casest.report.html.frame import whole
from casest.report.html.numbers import alike, number, printed, printed_unit, two_digits
from casest.report.html.page import paragraph, points, section, table, tag
from casest.report.html.spectra import autocorrelation
from casest.results.observability import (
    Observability,
    ObservedMotion,
    ObservedParameters,
    ObservedStructure,
    Structural,
    combination_words,
    could_reach,
    weak_directions,
    window_words,
)
from casest.results.rounding import rounded
from casest.results.states import States, intensity_spread, verdict_words
from casest.results.trajectory import Innovations, Trajectory

#: Samples that are drawn of one curve with its band.
DRAWN = 20_000


def observe_page(result: Observability) -> str:
    """`report.html` of `casest observe`, of a trajectory or of a calibration's data."""
    figures = Figures()
    body = [
        _directions(result),
        _constant_inputs(result) if isinstance(result, ObservedStructure) else "",
        _deviations(result),
        _windows(result, figures) if isinstance(result, ObservedMotion) else "",
        reproduction(result.reproduce),
    ]
    trusted = result.trusted if isinstance(result, ObservedParameters) else True
    said = observe_sentence(result)
    return whole(result.model, said, "", body, figures, result.data, trusted=trusted,
                 look="good" if result.observable else "bad")  # fmt: skip


def observe_sentence(result: Observability) -> str:
    """The verdict: how many unknowns these data determine."""
    rank, unknowns = result.rank, result.unknowns
    if isinstance(result, ObservedStructure):
        if result.observable:
            return f"Observable: suitable data determine all {unknowns} unknowns."
        return f"Not observable: no data determine more than {rank} of {unknowns} unknowns."
    if result.observable:
        weakly = len(weak_directions(result))
        but = f", {weakly} combination{'s' * (weakly > 1)} of them weakly" if weakly else ""
        return f"Observable: these data determine all {unknowns} unknowns{but}."
    return f"Not observable: these data determine {rank} of {unknowns} unknowns."


def _directions(result: Observability) -> str:
    weak = [_sentence(words) for words in weak_directions(result)]
    if not result.unobservable and not weak:
        return section("hidden", "What is hidden", paragraph("Nothing: no combination is lost."))
    tolerance = "" if isinstance(result, ObservedParameters) else result.tolerance
    return section(
        "hidden",
        "What is hidden",
        points(result.unobservable),
        tag("h3", "Weak combinations") + points(weak) if weak else "",
        paragraph(_sentence(could_reach(result))) if could_reach(result) else "",
        _combinations(result.structural) if isinstance(result, ObservedStructure) else "",
        paragraph(_sentence(tolerance), "soft") if tolerance else "",
    )


def _combinations(found: Structural) -> str:
    known = combination_words(found)
    return paragraph(_sentence(known)) if known else ""


def _sentence(words: str) -> str:
    return words[0].upper() + words[1:] + "."


def _constant_inputs(result: ObservedStructure) -> str:
    """What the motion must change to show everything."""
    held = result.constant_inputs
    if held.rank == result.rank:
        return ""
    inputs = " and ".join(f"`{name}`" for name in held.inputs)
    said = f"Rank {held.rank} of {result.unknowns} while {inputs} stay as they are."
    hidden = points(held.unobservable)
    known = _combinations(held)
    return section("constant", "With constant inputs", paragraph(said), hidden, known)


def _deviations(result: Observability) -> str:
    if not result.std:
        return ""
    units, rows = result.units if isinstance(result, ObservedMotion) else {}, []
    for name, std in result.std.items():
        values = np.array(std, dtype=object)
        for index, value in np.ndenumerate(values):
            if value == 0 and index:  # an entry that the shape holds at zero
                continue
            label = f"`{name}[{','.join(map(str, index))}]`" if index else f"`{name}`"
            shown = "not determined" if value is None else two_digits(value)
            rows.append([label, shown, printed_unit(units.get(name, ""))])
    said = "One standard deviation that these data allow, before any prior knowledge."
    shown = table(["unknown", "± std", "unit"], rows, [1])
    return section("parameters", "How well", paragraph(said), shown)


def _windows(result: ObservedMotion, figures: Figures) -> str:
    rows = [[str(k + 1), number(v)] for k, v in enumerate(result.eigenvalues)]
    shown = table(["direction", "eigenvalue over the largest"], rows, [1])
    pictures = [_stds_along(result, figures), _eigenvalue_along(result, figures)]
    return section("eigenvalues", "Where along the record", *pictures, shown)


def _stds_along(result: ObservedMotion, figures: Figures) -> str:
    """One small panel for every number of the state; those of one state on one scale."""
    windows = result.windows
    end, panels = np.array(windows.end_s, dtype=float), []
    across = axis("end of the window", "s", float(end.min()), float(end.max()), room=0.02)
    for state, unit in result.units.items():
        names = [n for n in windows.std if n == state or n.startswith(f"{state}[")]
        every = np.array([[*windows.std[n], windows.known[n]] for n in names], dtype=float)
        low, high = float(every.min()), float(every.max())
        for name in names:
            line = figures.series("line", "after", end, exact=True, y=np.array(windows.std[name]))
            known = windows.known[name]
            since = windows.better_from_s[name]
            told = "not halved" if since is None else f"halved at {number(since)} s"
            upright = axis(f"± {name}", unit, low, high, log=True, room=0.08)
            panels.append(
                panel(f"{name}: {told}", across, upright, [line],
                      bands=[{"low": known, "high": known}], height=140)
            )  # fmt: skip
    caption = (
        "Standard deviations along the record:",
        f"of each number of the state by one window of {number(windows.length_s)} s alone and what "
        "was known beforehand (dashed), which stays where the motion shows nothing of it. Those of "
        "one state have one scale.",
    )
    return figures.add("windows-std", caption, panels, two=True)


def _eigenvalue_along(result: ObservedMotion, figures: Figures) -> str:
    """The direction that a window tells least of."""
    windows = result.windows
    end = np.array(windows.end_s, dtype=float)
    values = np.array(windows.smallest_eigenvalue, dtype=float)
    most = max(float(values.max(initial=0.0)), 1.0)
    positive = values[values > most * 1e-16]
    least = float(positive.min(initial=most))
    drawn = panel(
        "smallest eigenvalue",
        axis("end of the window", "s", float(end.min()), float(end.max()), room=0.02),
        axis("information over prior", "1", least, most, log=True, room=0.05),
        [figures.series("line", "after", end, exact=True, y=np.maximum(values, least))],
        bands=[{"low": 1.0, "high": 1.0}] if least < 1 <= most else [],
        height=200,
    )
    caption = (
        "The least observable direction:",
        f"smallest eigenvalue of the Gramian over windows of {number(windows.length_s)} s, in "
        "units of what was known beforehand. Above 1 (dashed) one window alone teaches more than "
        f"that of every direction. {_sentence(window_words(windows))}",
    )
    return figures.add("windows", caption, [drawn])


# -- filter ----------------------------------------------------------------------------------------


def filter_page(result: States) -> str:
    """`report.html` of `casest filter`."""
    figures, along = Figures(), result.trajectory
    innovations = innovation_figures(along, result.innovations, figures)
    body = [
        _final(result),
        section("states", "States", *state_figures(along, figures)),
        section("innovations", "Innovations", *innovations),
        _intensities(result),
        conventions(along),
        reproduction(result.reproduce),
    ]
    said, _, cure = verdict_words(result).partition(": ")
    said = re.sub(r"\d\S*e[-+]\d+", lambda m: printed(m[0]), said)
    cure = re.sub(r"--\w[\w-]*( ml)?", lambda m: f"`{m[0]}`", cure)
    under = (
        f"{result.samples} samples; a filter that fits has innovations of the size it expects, "
        "and none of them foretells the next." + (f" {_sentence(cure)}" if cure else "")
    )
    return whole(result.model, f"Innovations are {said}.", under, body, figures, result.data,
                 look="good" if result.as_expected else "doubtful")  # fmt: skip


def state_figures(along: Trajectory, figures: Figures) -> Iterator[str]:
    """Each state with its band, filtered beside smoothed."""
    t, every = _thin(along.time)
    smooth = along.smoothed_std
    pairs = (
        ("filter", "before", along.x, along.std),
        ("smoother", "after", along.smoothed, smooth),
    )
    for state in along.states:
        panels = []
        for k in range(state.where.start, state.where.stop):
            low, high = _range([x[::every, k] for _, _, x, _ in pairs], smooth[::every, k])
            for kind, look, x, std in pairs:
                value, half = x[::every, k], BAND * std[::every, k]
                drawn = [
                    figures.series("ribbon", look, t, low=value - half, high=value + half),
                    figures.series("line", look, t, y=value),
                ]
                title = f"{along.names[k]}, {kind}"
                across = axis("time", "s", float(t[0]), float(t[-1]))
                upright = axis(along.names[k], along.units[k], low, high, room=0.06)
                panels.append(panel(title, across, upright, drawn))
        caption = (f"{state.name}.", "Shaded: the band of 95 % that filter and smoother claim.")
        yield figures.add(f"state-{state.name}", caption, panels, two=True, zoom=True)


def _thin(time: Array) -> tuple[Array, int]:
    every = -(-len(time) // DRAWN)
    return time[::every], every


def _range(values: Sequence[Array], std: Array) -> tuple[float, float]:
    """Range of what the smoother says with its band, and of the filter without its beginning."""
    settled = values[0][len(values[0]) // 10 :]
    low = min(float(settled.min()), float((values[1] - BAND * std).min()))
    high = max(float(settled.max()), float((values[1] + BAND * std).max()))
    return low, high


def _final(result: States) -> str:
    rows = []
    for name, s in result.states.items():
        for k, (value, std) in enumerate(zip(s.value, s.std, strict=True)):
            label = f"`{name}[{k}]`" if len(s.value) > 1 else f"`{name}`"
            middle = two_digits(s.smoothed_std_median[k])
            known = math.nan if std is None else std
            shown = map(printed, rounded(math.nan if value is None else value, known))
            rows.append([label, *shown, middle, printed_unit(s.unit)])
    head = ["state", "at the end", "± std", "smoothed ± std (median)", "unit"]
    return section("parameters", "At the end of the record", table(head, rows, [1, 2, 3]))


def innovation_figures(along: Trajectory, said: Innovations, figures: Figures) -> Iterator[str]:
    """Each reading's surprise with the band that the filter expects, and its autocorrelation."""
    missing, sizes = said.missing_readings, alike(np.array(said.rms, float).tolist())
    rows = [
        [f"`{name}`", size, number(rho), printed_unit(unit)]
        for (name, unit), size, rho in zip(
            along.readings, sizes, said.lag1_correlation, strict=True
        )
    ]
    yield table(["reading", "innovation, rms", "correlation of neighbours", "unit"], rows, [1, 2])
    yield paragraph(
        f"Normalised squared innovation: {number(said.normalised_mean)} on average, "
        f"{said.expected} expected." + (f" {missing} samples lack a reading." if missing else "")
    )
    t, every = _thin(along.time)
    half = BAND * along.expected_std[::every]
    panels = []
    for k, (name, unit) in enumerate(along.readings):
        y = along.innovations[::every, k]
        peak = float(np.nanmax(np.abs(y[len(y) // 10 :]), initial=0.0)) or 1.0
        # Both are seen, unless the band is many times as wide as what it should hold.
        top = max(1.1 * peak, min(1.3 * float(np.nanmedian(half[:, k])), 6 * peak))
        drawn = [
            figures.series("ribbon", "band", t, low=-half[:, k], high=half[:, k]),
            figures.series("line", "after", t, y=y),
        ]
        across = axis("time", "s", float(t[0]), float(t[-1]))
        panels.append(panel(name, across, axis("innovation", unit, -top, top), drawn))
    caption = ("Innovations.", "Shaded: where 95 % lie if the noise intensities are right.")
    yield figures.add("over-time", caption, panels, zoom=True)
    yield _whiteness(along, figures)


def _whiteness(along: Trajectory, figures: Figures) -> str:
    if len(along.time) < 20:
        return ""
    rho, count = autocorrelation((along.run,), (along.innovations,))
    half, lags = BAND / float(np.sqrt(count)), np.arange(1.0, len(rho) + 1)
    panels = []
    for k, (name, _) in enumerate(along.readings):
        low, high = min(float(rho[:, k].min()), -2 * half), max(float(rho[:, k].max()), 2 * half)
        across = axis("lag, in samples", "1", 0.0, len(rho) + 1.0)
        upright = axis("autocorrelation", "1", low, high, room=0.06)
        stems = figures.series("stems", "after", lags, y=rho[:, k])
        bands = [{"low": -half, "high": half}]
        panels.append(panel(name, across, upright, [stems], bands=bands, height=155))
    caption = (
        "Autocorrelation of the innovations.",
        "Shaded: where white noise lies at 95 of 100 lags.",
    )
    return figures.add("autocorrelation", caption, panels)


def _intensities(result: States) -> str:
    """Declared noise intensities beside those that were used."""
    said, expected = result.intensities, result.innovations.expected
    declared, used, spread = said.declared, said.used, said.spread
    rows = []
    for name in dict.fromkeys([*declared, *used]):
        values = ["—" if not v else number(v) for v in (declared.get(name), used.get(name))]
        sure = intensity_spread(spread, name).strip("()")
        rows.append([f"`{name}`", *values, sure, printed_unit(said.units[name])])
    means = [said.declared_normalised_mean, result.innovations.normalised_mean]
    rows.append(["innovations²", *map(number, means), f"{expected} expected", ""])
    head = ["noise intensity of", "declared", "used", "", "unit"]
    shown = table(head, rows, [1, 2])
    return section("intensities", "Noise intensities", paragraph(_sentence(said.how)), shown)


def conventions(along: Trajectory) -> str:
    """What the declaration says of itself, and the noise that drives its states."""
    parts = along.convention.split("\n\n")
    said = [paragraph(part.replace("\n", " ")) for part in parts if part]
    rows = [
        [f"`{s.name}`", number(s.std), number(s.intensity), printed_unit(s.unit)]
        for s in along.states
    ]
    head = ["state", "± std at the beginning", "noise intensity, unit²/s", "unit"]
    return section("apply", "Conventions", *said, table(head, rows, [1, 2]))
