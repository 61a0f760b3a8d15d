"""`casest filter`: the states along a trajectory, and whether the noise is as declared."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from casest import __version__
from casest.data.run import Run
from casest.dynamics import Dynamics
from casest.dynamics.filter import Filtered, filtered
from casest.dynamics.intensities import Tuned, intensities, units
from casest.results.file import plain
from casest.results.observability import assumed, note_lines, number_or_not, too_short, wrapped


def follow(
    model: Dynamics, run: Run, tuned: Tuned | None = None
) -> tuple[dict[str, Any], Filtered]:
    """States over time by the Kalman filter, and whether the innovations are as expected.

    `tuned`: the same model with other noise intensities, used in place of the declared ones, which
    are shown beside them.
    """
    declared = filtered(model, run, smooth=tuned is None)
    found = filtered(tuned.model, run) if tuned else declared
    model, before = found.model, model
    mean, normalised = _normalised_mean(found), found.normalised_innovations
    m = found.innovations.shape[1]
    final = {
        name: {
            "value": plain(found.x[-1][where]),
            "std": plain(found.std[-1][where]),
            "smoothed_std_median": plain(_median_std(found, where)),
            "unit": model[name].unit,
        }
        for name, where in model.slices().items()
    }
    return {
        "casest": __version__,
        "model": model.name,
        "notes": [*assumed(run), *_unsettled(found), *_too_short(run, model.size)],
        "samples": len(found.time),
        "states": final,
        "intensities": {
            "how": tuned.how if tuned else "as declared",
            "declared": _plain_values(intensities(before)),
            "used": _plain_values(intensities(model)),
            "spread": _plain_values(tuned.spread) if tuned else {},
            "units": units(model),
            "declared_normalised_mean": plain(_normalised_mean(declared)),
        },
        "innovations": {
            "rms": plain(np.sqrt(np.nanmean(found.innovations**2, axis=0))),
            "normalised_mean": plain(mean),
            "expected": m,
            "missing_readings": int(np.sum(~np.isfinite(normalised))),
            "lag1_correlation": plain(_lag1(found.innovations)),
        },
    }, found


def _plain_values(values: Mapping[str, float]) -> dict[str, Any]:
    return {name: plain(value) for name, value in values.items()}


def _unsettled(found: Filtered) -> list[str]:
    if found.settled:
        return []
    return [
        "the smoother's rounds did not settle: its states are those of one pass; nearer start "
        "values or a smaller std at the beginning may help"
    ]


def _too_short(run: Run, unknowns: int) -> list[str]:
    words = too_short(run, unknowns)
    return [f"{w}; the states are mostly what was declared of the start" for w in words]


def _normalised_mean(found: Filtered) -> float:
    """Mean of νᵀS⁻¹ν after the first tenth, which belongs to the start values."""
    normalised = found.normalised_innovations
    whole = normalised[np.isfinite(normalised)]
    later = whole[len(whole) // 10 :]
    return float(np.mean(later)) if len(later) else float("nan")


def _median_std(found: Filtered, where: slice) -> Any:
    std = np.sqrt(np.diagonal(found.smoothed_P, axis1=1, axis2=2))[:, where]
    return np.median(std, axis=0)


def _lag1(innovations: Any) -> Any:
    """Correlation of neighbouring innovations, each component: zero for the right filter."""
    r = np.where(np.isfinite(innovations), innovations, 0.0)
    return np.sum(r[1:] * r[:-1], axis=0) / np.maximum(np.sum(r**2, axis=0), 1e-300)


def states_csv(found: Filtered) -> str:
    """Filtered and smoothed states with standard deviations, a row per sample."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names, own_units = found.model.names, found.model.state_units
    head = ["t [s]"]
    for kind in ("", "std_", "smoothed_", "smoothed_std_"):
        head += [f"{kind}{n} [{u}]" for n, u in zip(names, own_units, strict=True)]
    writer.writerow(head)
    smooth_std = np.sqrt(np.diagonal(found.smoothed_P, axis1=1, axis2=2))
    table = np.hstack([found.time[:, None], found.x, found.std, found.smoothed, smooth_std])
    writer.writerows([[repr(float(v)) for v in row] for row in table])
    return text.getvalue()


def filter_text(content: Mapping[str, Any]) -> str:
    """Final states and the innovations' verdict."""
    lines = [f"{content['model']}: {content['samples']} samples", "", "  at the end of the record:"]
    for name, s in content["states"].items():
        for k, (value, std) in enumerate(zip(s["value"], s["std"], strict=True)):
            label = name if len(s["value"]) == 1 else f"{name}[{k}]"
            lines.append(f"    {label:<14} {value:>12.5g} ± {std:<10.2g} {s['unit']}")
    lines += ["", *intensity_lines(content)]
    i = content["innovations"]
    lines += ["", f"  innovations are {filter_verdict(content)}"]
    if i["missing_readings"]:
        lines.append(f"  {i['missing_readings']} samples without a complete reading")
    return "\n".join(wrapped([*lines, *note_lines(content)]))


def intensity_lines(content: Mapping[str, Any]) -> list[str]:
    """Noise intensities, declared ones beside those that were used."""
    said, expected = content["intensities"], content["innovations"]["expected"]
    declared, used, spread = said["declared"], said["used"], said["spread"]
    same = declared == used
    lines = ["  noise intensities " + ("as declared:" if same else f"{said['how']}:")]
    if not same:
        lines.append(f"    {'':<14} {'declared':>12} {'used':>12}")
    for name in dict.fromkeys([*declared, *used]):
        columns = [declared.get(name)] if same else [declared.get(name), used.get(name)]
        shown = " ".join(f"{'-' if not v else format(v, '.3g'):>12}" for v in columns)
        share = "" if same else intensity_spread(spread, name)
        lines.append(f"    {name:<14} {shown} {said['units'][name]}{share and ' ' + share}")
    means = [said["declared_normalised_mean"]]
    means += [] if same else [content["innovations"]["normalised_mean"]]
    shown = " ".join(f"{number_or_not(v):>12}" for v in means)
    return [*lines, f"    {'innovations²':<14} {shown} ({expected} expected)"]


def intensity_spread(spread: Mapping[str, Any], name: str) -> str:
    """How sure an intensity is, where the data gave it."""
    if name not in spread:
        return ""
    share = spread[name]
    if share is None:
        return "(not determined)"
    return f"± {100 * share:.2g} %" if share < 0.5 else f"(within a factor of {np.exp(share):.2g})"


def filter_verdict(content: Mapping[str, Any]) -> str:
    """How large the innovations are beside what the noise intensities say."""
    said = content["innovations"]
    ratio = (said["normalised_mean"] or float("nan")) / said["expected"]
    if 0.8 < ratio < 1.25:
        return "as large as the noise intensities say"
    return (
        f"{ratio:.2g} times as large (squared) as the noise intensities say: match them "
        "(--sensor-noise, --rest or --noise ml)"
    )
