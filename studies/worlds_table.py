"""The table of `studies/loop_worlds.py`: figures beside their goals, then every kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.stats import beta, norm

Record = dict[str, Any]
#: Visible: without noise the declared model leaves as much, in σ² in all and in σ² per residual
#: (2 % of the error).
NONCENTRALITY, SHARE = 45.0, 0.04
#: A second record's error is worse, or as good as the oracle's, by more than this.
WORSE, AS_GOOD = 1.01, 1.1


def visible(r: Record) -> bool:
    """Could it have been found?"""
    each = r["noncentrality"] / (r["samples"] * r["axes"])
    return bool(r["there"] and r["noncentrality"] >= NONCENTRALITY and each >= SHARE)


def causes(r: Record) -> list[Record]:
    """What was found, without what only describes."""
    return [f for f in r["found"] if not f["describes"]]


def is_right(found: Record, r: Record) -> bool:
    """By its name, or among the two nearest that are not told apart."""
    names = {found["label"], found["name"], *found["alike"][:2]}
    names |= {name.partition("(")[0] for name in found["alike"][:2]}
    return bool(names & set(r["right"]))


def is_named(r: Record) -> bool:
    """Is the first thing that is found the one that is there, or a description of it?"""
    first = (causes(r) or r["found"])[:1]
    every = [f for f in r["found"] if f["describes"]]
    said = {*r.get("described", ())} & {*r["right"]}
    return bool(said) or any(is_right(f, r) for f in [*first, *every])


def wrong(r: Record) -> bool:
    """Is a cause or a formula claimed that is not there?"""
    return any(not (r["there"] and is_right(f, r)) for f in causes(r))


def harmed(r: Record) -> bool:
    """Are the declared parameters further off than before, beyond their scatter (99.9 %)?

    The error is the root mean square of k parameters' standard deviations, of which the difference
    of two scatters by √(2/k), or as many times more as the oracle's own is larger.
    """
    scale = np.sqrt(r["samples"] * r["axes"] / r["truths"])
    spread = np.sqrt(2 / r["truths"]) * max(1.0, scale * r["off_oracle"])
    return bool(scale * (r["off_after"] - r["off_before"]) > norm.ppf(0.999) * spread)


def worse(r: Record) -> bool:
    """Is the closed model worse than the declared one on the second record?"""
    return bool(not r["later_after"] <= WORSE * r["later_before"])


def transfers(r: Record) -> bool:
    """Is it as good there as the oracle?"""
    return bool(r["later_after"] <= AS_GOOD * r["later_oracle"])


def share(words: str, records: Sequence[Record], test: Callable[[Record], bool], goal: str) -> str:
    """A line: how many, with the one-sided 95 % bound on the side of the goal."""
    n = len(records)
    if not n:
        return f"| {words} | 0 | | {goal} |"
    hits = sum(map(test, records))
    if goal.startswith("≥"):
        bound = f"above {100 * beta.ppf(0.05, hits, n - hits + 1) if hits else 0:.1f} %"
    else:
        bound = f"below {100 * beta.ppf(0.95, hits + 1, n - hits) if hits < n else 100:.1f} %"
    return f"| {words} | {n} | {hits}: {100 * hits / n:.1f} %, {bound} | {goal} |"


def table(records: Sequence[Record]) -> str:
    """Markdown: the figures with their goals, then each kind."""
    good = [r for r in records if "verdict" in r]
    seeds = [r["seed"] for r in records]
    without = [r for r in good if not r["there"]]
    seen = [r for r in good if visible(r)]
    unseen = [r for r in good if r["there"] and not visible(r)]
    lines = [
        "# Closing the loop: what real sensors do",
        "",
        "Made by `make study-worlds` (`python studies/loop_worlds.py`). Sensors of users' own and",
        "shipped ones from `studies/sensors`, which shares no code with the catalogue; each",
        "world has a second record of the same sensor, moved differently. The oracle is the",
        "declared model with what truly happens to the reading, to a scale that it fits. Visible:",
        "without noise the declared model leaves at least 45 σ², and 0.04 σ² per residual (2 % of",
        "the error). Named: first, or among the two nearest that are not told apart. Harmed: the",
        "declared parameters, by what they predict of the record without the effect, are further",
        "off than before by more than their scatter (99.9 %). On the second record nothing is",
        "fitted; what happened in the first alone (a step, a pulse, a drift) is not carried there.",
        f"Seeds {min(seeds)} to {max(seeds)}.",
        "",
        "| figure | worlds | found | goal |",
        "| --- | --- | --- | --- |",
        share("visible, named", seen, is_named, "≥ 95 %"),
        share("visible, called adequate", seen, lambda r: r["verdict"] == "adequate", "≤ 1 %"),
        share("visible, also a wrong name", seen, wrong, ""),
        share("without effect, a cause or a formula claimed", without, wrong, "≤ 1 %"),
        share("without effect, adequate", without, lambda r: r["verdict"] == "adequate", ""),
        share("weaker, a wrong name", unseen, wrong, ""),
        share("weaker, named all the same", unseen, is_named, ""),
        share("declared parameters harmed", good, harmed, "0"),
        share("second record: worse than the declared model by 1 %", good, worse, "0"),
        share("visible, second record: within 1.1 of the oracle's", seen, transfers, "≥ 95 %"),
        share("all, second record: within 1.1 of the oracle's", good, transfers, "≥ 95 %"),
        *_seconds(good),
        "",
        *_each(good),
        *_stopped(records),
    ]
    return "\n".join(lines) + "\n"


def _seconds(records: Sequence[Record]) -> list[str]:
    if not records:
        return []
    s = np.array([r["seconds"] for r in records])
    found = f"{np.median(s):.1f}, {np.quantile(s, 0.95):.1f}, {s.max():.1f}"
    return [f"| seconds per close: median, 95 %, worst | {len(s)} | {found} | worst ≤ 10 |"]


def _each(records: Sequence[Record]) -> list[str]:
    lines = [
        "## Each kind",
        "",
        "Second record: medians of the error, of visible ones, in standard deviations of the",
        "noise. Said: what was claimed that is wrong.",
        "",
        "| kind | right | visible | named | adequate | wrong too | harmed | worse | within 1.1 | "
        "declared, closed, oracle's | weaker: wrong | without: claimed | said |",
        "| --- " * 13 + "|",
    ]
    for kind in dict.fromkeys(r["kind"] for r in records):
        own = [r for r in records if r["kind"] == kind]
        lines.append(f"| {kind} | {', '.join(own[0]['right'])} | {_row(own)} |")
    return [*lines, ""]


def _row(own: list[Record]) -> str:
    seen = [r for r in own if visible(r)]
    weak = [r for r in own if r["there"] and not visible(r)]
    without = [r for r in own if not r["there"]]
    errors = [
        f"{np.median([r['later_' + k] for r in seen]):.2f}" if seen else ""
        for k in ("before", "after", "oracle")
    ]
    false = [f["label"] for r in own if wrong(r) for f in causes(r) if not _right(f, r)]
    counts = {name: false.count(name) for name in sorted(set(false), key=false.count)[::-1]}
    cells = [
        len(seen),
        sum(map(is_named, seen)),
        sum(r["verdict"] == "adequate" for r in seen),
        sum(map(wrong, seen)),
        sum(map(harmed, own)),
        sum(map(worse, own)),
        sum(map(transfers, seen)),
        ", ".join(errors),
        f"{sum(map(wrong, weak))} of {len(weak)}",
        f"{sum(map(wrong, without))} of {len(without)}",
        ", ".join(f"{name} {n}" for name, n in counts.items()),
    ]
    return " | ".join(map(str, cells))


def _right(found: Record, r: Record) -> bool:
    return bool(r["there"] and is_right(found, r))


def _stopped(records: Sequence[Record]) -> list[str]:
    stopped = [r for r in records if "verdict" not in r]
    if not stopped:
        return []
    lines = ["## Without an answer", ""]
    lines += [f"* `{r['name']}`: {r.get('refused') or r.get('failed')}" for r in stopped]
    return [*lines, ""]
