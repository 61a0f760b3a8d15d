"""What `casest filter` prints: states at the end, noise intensities, the innovations' verdict."""

from __future__ import annotations

from casest.report.text.layout import note_lines, wrapped
from casest.results.result import Number
from casest.results.rounding import rounded
from casest.results.states import States, intensity_spread, verdict_words


def filter_text(result: States) -> str:
    """Final states and the innovations' verdict."""
    lines = [f"{result.model}: {result.samples} samples"]
    lines += [] if result.settled else ["", "  not settled: ± is too small, and may be by far"]
    lines += ["", "  at the end of the record:"]
    for name, s in result.states.items():
        for k, (x, spread) in enumerate(zip(s.value, s.std, strict=True)):
            label = name if len(s.value) == 1 else f"{name}[{k}]"
            value, std = rounded(_number(x), _number(spread))
            lines.append(f"    {label:<14} {value:>12} ± {std:<10} {s.unit}")
    lines += ["", *intensity_lines(result)]
    lines += ["", f"  innovations are {verdict_words(result)}"]
    if missing := result.innovations.missing_readings:
        lines.append(f"  {missing} samples without a complete reading")
    return "\n".join(wrapped([*lines, *note_lines(result.notes)]))


def _number(value: Number) -> float:
    return float("nan") if value is None else value


def intensity_lines(result: States) -> list[str]:
    """Noise intensities, declared ones beside those that were used."""
    said, expected = result.intensities, result.innovations.expected
    declared, used = said.declared, said.used
    same = declared == used
    lines = ["  noise intensities " + ("as declared:" if same else f"{said.how}:")]
    if not same:
        lines.append(f"    {'':<14} {'declared':>12} {'used':>12}")
    for name in dict.fromkeys([*declared, *used]):
        columns = [declared.get(name)] if same else [declared.get(name), used.get(name)]
        shown = " ".join(f"{'-' if not v else format(v, '.3g'):>12}" for v in columns)
        share = "" if same else intensity_spread(said.spread, name)
        lines.append(f"    {name:<14} {shown} {said.units[name]}{share and ' ' + share}")
    means = [said.declared_normalised_mean]
    means += [] if same else [result.innovations.normalised_mean]
    shown = " ".join(f"{'-' if v is None else format(v, '.3g'):>12}" for v in means)
    return [*lines, f"    {'innovations²':<14} {shown} ({expected} expected)"]
