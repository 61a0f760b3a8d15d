"""Reports of `casest observe` and `casest filter`: what a trajectory shows, and states along it."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics import Dynamics
from casest.dynamics.filter import Filtered
from casest.report.html.figures import Figures, axis, panel
from casest.report.html.fitted import reproduction
from casest.report.html.frame import whole
from casest.report.html.numbers import alike, number, printed, printed_unit
from casest.report.html.page import paragraph, points, section, table, tag
from casest.report.html.spectra import autocorrelation
from casest.report.html.story import BAND
from casest.results.observability import could_reach, window_words
from casest.results.states import filter_verdict, intensity_spread

#: Samples that are drawn of one curve with its band.
DRAWN = 20_000


def observe_page(content: Mapping[str, Any]) -> str:
    """`report.html` of `casest observe`, of a trajectory or of a calibration's data."""
    figures = Figures()
    body = [
        _directions(content),
        _constant_inputs(content),
        _deviations(content),
        _windows(content, figures),
        reproduction(content),
    ]
    return whole(content["model"], observe_sentence(content), "", body, content, figures)


def observe_sentence(content: Mapping[str, Any]) -> str:
    """The verdict: how many unknowns these data determine."""
    rank, unknowns = content["rank"], content["unknowns"]
    if "structural" in content:
        if rank == unknowns:
            return f"Observable: suitable data determine all {unknowns} unknowns."
        return f"Not observable: no data determine more than {rank} of {unknowns} unknowns."
    if rank == unknowns:
        return f"Observable: these data determine all {unknowns} unknowns."
    return f"Not observable: these data determine {rank} of {unknowns} unknowns."


def _directions(content: Mapping[str, Any]) -> str:
    weak = [
        f"{w['direction']}: {number(w['inflation'])} times less certain than each alone."
        for w in content.get("weak") or []
    ]
    if not content["unobservable"] and not weak:
        return section("hidden", "What is hidden", paragraph("Nothing: no combination is lost."))
    return section(
        "hidden",
        "What is hidden",
        points(content["unobservable"]),
        tag("h3", "Weak combinations") + points(weak) if weak else "",
        paragraph(_sentence(could_reach(content))) if could_reach(content) else "",
        paragraph(_sentence(content["tolerance"]), "soft") if content.get("tolerance") else "",
    )


def _sentence(words: str) -> str:
    return words[0].upper() + words[1:] + "."


def _constant_inputs(content: Mapping[str, Any]) -> str:
    """What the motion must change to show everything."""
    held = content.get("constant_inputs")
    if not held or held["rank"] == content["rank"]:
        return ""
    inputs = " and ".join(f"`{name}`" for name in held["inputs"])
    said = f"Rank {held['rank']} of {content['unknowns']} while {inputs} stay as they are."
    hidden = points(held["unobservable"])
    return section("constant", "With constant inputs", paragraph(said), hidden)


def _deviations(content: Mapping[str, Any]) -> str:
    if not content["std"]:
        return ""
    units, rows = content.get("units", {}), []
    for name, std in content["std"].items():
        values = np.array(std, dtype=object)
        for index, value in np.ndenumerate(values):
            if value == 0 and index:  # an entry that the shape holds at zero
                continue
            label = f"`{name}[{','.join(map(str, index))}]`" if index else f"`{name}`"
            shown = "not determined" if value is None else number(value)
            rows.append([label, shown, printed_unit(units.get(name, ""))])
    said = "One standard deviation that these data allow, before any prior knowledge."
    shown = table(["unknown", "± std", "unit"], rows, [1])
    return section("parameters", "How well", paragraph(said), shown)


def _windows(content: Mapping[str, Any], figures: Figures) -> str:
    windows = content.get("windows")
    if not windows:
        return ""
    end = np.array(windows["end_s"], dtype=float)
    curves = windows.get("eigenvalues") or [[v] for v in windows["smallest_eigenvalue"]]
    values = np.array(curves, dtype=float)
    positive = values[values > 0]
    least = max(float(positive.min(initial=np.inf)), float(positive.max(initial=1.0)) * 1e-16)
    most = float(positive.max(initial=1.0))
    lines = [
        figures.series(
            "line", "before" if k else "after", end, exact=True, y=np.maximum(column, least)
        )
        for k, column in reversed(list(enumerate(values.T)))
    ]
    drawn = panel(
        "eigenvalues" if values.shape[1] > 1 else "smallest eigenvalue",
        axis("end of the window", "s", float(end.min()), float(end.max()), room=0.02),
        axis("information over prior", "1", least, most, log=True, room=0.05),
        lines,
        bands=[{"low": 1.0, "high": 1.0}] if least < 1 <= most else [],
        height=240,
    )
    caption = (
        "Observability along the record:",
        f"eigenvalues of the Gramian over windows of {number(windows['length_s'])} s, the smallest "
        "in its own colour, in units of what was known beforehand. Above 1 (dashed) one window "
        f"alone teaches more than that. {_sentence(window_words(windows))}",
    )
    picture = figures.add("windows", caption, [drawn])
    scaled = content.get("eigenvalues") or []
    rows = [[str(k + 1), number(v)] for k, v in enumerate(scaled)]
    shown = table(["direction", "eigenvalue over the largest"], rows, [1]) if rows else ""
    return section("eigenvalues", "Where along the record", picture, shown)


# -- filter ----------------------------------------------------------------------------------------


def filter_page(found: Filtered, content: Mapping[str, Any]) -> str:
    """`report.html` of `casest filter`."""
    figures = Figures()
    body = [
        section("states", "States", *state_figures(found, figures)),
        _final(content),
        section("innovations", "Innovations", *innovation_figures(found, content, figures)),
        _intensities(content),
        conventions(found.model),
        reproduction(content),
    ]
    said = filter_verdict(content)
    said = re.sub(r"\d\S*e[-+]\d+", lambda m: printed(m[0]), said)
    verdict = f"Innovations are {said}."
    under = (
        f"{content['samples']} samples; a filter that fits has innovations of the size it expects, "
        "and none of them foretells the next."
    )
    return whole(content["model"], verdict, under, body, content, figures)


def state_figures(found: Filtered, figures: Figures) -> Iterator[str]:
    """Each state with its band, filtered beside smoothed."""
    t, every = _thin(found.time)
    smooth = np.sqrt(np.diagonal(found.smoothed_P, axis1=1, axis2=2))
    pairs = (
        ("filter", "before", found.x, found.std),
        ("smoother", "after", found.smoothed, smooth),
    )
    for name, where in found.model.slices().items():
        panels = []
        for k in range(where.start, where.stop):
            low, high = _range([x[::every, k] for _, _, x, _ in pairs], smooth[::every, k])
            for kind, look, x, std in pairs:
                value, half = x[::every, k], BAND * std[::every, k]
                drawn = [
                    figures.series("ribbon", look, t, low=value - half, high=value + half),
                    figures.series("line", look, t, y=value),
                ]
                title = f"{found.model.names[k]}, {kind}"
                across = axis("time", "s", float(t[0]), float(t[-1]))
                upright = axis(
                    found.model.names[k], found.model.state_units[k], low, high, room=0.06
                )
                panels.append(panel(title, across, upright, drawn))
        caption = (f"{name}.", "Shaded: the band of 95 % that filter and smoother claim.")
        yield figures.add(f"state-{name}", caption, panels, two=True, zoom=True)


def _thin(time: Array) -> tuple[Array, int]:
    every = -(-len(time) // DRAWN)
    return time[::every], every


def _range(values: Sequence[Array], std: Array) -> tuple[float, float]:
    """Range of what the smoother says with its band, and of the filter without its beginning."""
    settled = values[0][len(values[0]) // 10 :]
    low = min(float(settled.min()), float((values[1] - BAND * std).min()))
    high = max(float(settled.max()), float((values[1] + BAND * std).max()))
    return low, high


def _final(content: Mapping[str, Any]) -> str:
    rows = []
    for name, s in content["states"].items():
        for k, (value, std) in enumerate(zip(s["value"], s["std"], strict=True)):
            label = f"`{name}[{k}]`" if len(s["value"]) > 1 else f"`{name}`"
            middle = number(s["smoothed_std_median"][k])
            rows.append([label, number(value, 5), number(std, 2), middle, printed_unit(s["unit"])])
    head = ["state", "at the end", "± std", "smoothed ± std (median)", "unit"]
    return section("parameters", "At the end of the record", table(head, rows, [1, 2, 3]))


def innovation_figures(
    found: Filtered, content: Mapping[str, Any], figures: Figures
) -> Iterator[str]:
    """Each reading's surprise with the band that the filter expects, and its autocorrelation."""
    said = content["innovations"]
    names, units = _outputs(found)
    missing = said["missing_readings"]
    sizes = alike([float(v) for v in said["rms"]])
    rows = [
        [f"`{n}`", size, number(rho), printed_unit(u)]
        for n, u, size, rho in zip(names, units, sizes, said["lag1_correlation"], strict=True)
    ]
    yield table(["reading", "innovation, rms", "correlation of neighbours", "unit"], rows, [1, 2])
    yield paragraph(
        f"Normalised squared innovation: {number(said['normalised_mean'])} on average, "
        f"{said['expected']} expected." + (f" {missing} samples lack a reading." if missing else "")
    )
    t, every = _thin(found.time)
    half = BAND * np.sqrt(np.diagonal(found.S, axis1=1, axis2=2))[::every]
    panels = []
    for k, (name, unit) in enumerate(zip(names, units, strict=True)):
        y = found.innovations[::every, k]
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
    yield _whiteness(found, names, figures)


def _whiteness(found: Filtered, names: Sequence[str], figures: Figures) -> str:
    run = Run.raw("innovations", {"y": found.innovations}, units={"y": None}, time=found.time)
    if len(found.time) < 20:
        return ""
    rho, count = autocorrelation((run,), (found.innovations,))
    half, lags = BAND / float(np.sqrt(count)), np.arange(1.0, len(rho) + 1)
    panels = []
    for k, name in enumerate(names):
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


def _outputs(found: Filtered) -> tuple[list[str], list[str]]:
    """Name and unit of each reading's components."""
    names: list[str] = []
    units: list[str] = []
    for name in found.model.measured_signals:
        signal = next(s for s in found.model.signals if s.name == name)
        several = signal.size > 1
        names += [f"{name}[{k}]" for k in range(signal.size)] if several else [name]
        units += [signal.unit or "1"] * signal.size
    return names, units


def _intensities(content: Mapping[str, Any]) -> str:
    """Declared noise intensities beside those that were used."""
    said, expected = content["intensities"], content["innovations"]["expected"]
    declared, used, spread = said["declared"], said["used"], said["spread"]
    rows = []
    for name in dict.fromkeys([*declared, *used]):
        values = ["—" if not v else number(v) for v in (declared.get(name), used.get(name))]
        sure = intensity_spread(spread, name).strip("()")
        rows.append([f"`{name}`", *values, sure, printed_unit(said["units"][name])])
    means = [said["declared_normalised_mean"], content["innovations"]["normalised_mean"]]
    rows.append(["innovations²", *map(number, means), f"{expected} expected", ""])
    head = ["noise intensity of", "declared", "used", "", "unit"]
    shown = table(head, rows, [1, 2])
    return section("intensities", "Noise intensities", paragraph(_sentence(said["how"])), shown)


def conventions(model: Dynamics) -> str:
    """What the declaration says of itself, and the noise that drives its states."""
    words = inspect.getdoc(model.function) or ""
    said = [paragraph(part.replace("\n", " ")) for part in words.split("\n\n") if part]
    rows = [
        [f"`{s.name}`", number(s.std), number(s.intensity), printed_unit(s.unit)]
        for s in model.states
    ]
    head = ["state", "± std at the beginning", "noise intensity, unit²/s", "unit"]
    return section("apply", "Conventions", *said, table(head, rows, [1, 2]))
