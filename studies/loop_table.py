"""The table of `studies/loop.py`: figures beside their goals, every effect, every noise."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import beta, norm

Record = dict[str, Any]
#: Visible: the oracle's held-out gain and the noncentrality of its score are at least these.
GAIN, NONCENTRALITY = 0.02, 45.0
#: Effects on the noise: a property of it, and no effect.
OF_NOISE = {"outliers", "bias_wander"}


def upper(hits: int, count: int) -> float:
    """Clopper-Pearson's upper 95 % bound (one-sided) of a share."""
    return 1.0 if hits >= count else float(beta.ppf(0.95, hits + 1, count - hits))


def named(record: Record) -> list[Record]:
    """What was found, without what is a property of the noise."""
    return [f for f in record["found"] if f["label"] not in OF_NOISE]


def visible(record: Record) -> bool:
    """Could it have been found?"""
    gain = 1 - record["oracle"] / record["before"]
    return bool(gain >= GAIN and record["noncentrality"] >= NONCENTRALITY)


def is_named(found: Record, wanted: Iterable[str]) -> bool:
    """By its name, or among the two nearest that are not told apart."""
    return bool({found["label"], *found["alike"][:2]} & set(wanted))


def found_first(record: Record) -> bool:
    """Is the first effect found the one that the world has?"""
    found = named(record)
    return bool(found) and is_named(found[0], record["wanted"])


def wrong(record: Record) -> bool:
    """Is anything named that the world does not have?"""
    return any(not is_named(f, record["wanted"]) for f in named(record))


def wrongly_named(record: Record) -> bool:
    """Is anything named without the word that it may as well be what the world has?"""
    wanted = set(record["wanted"])
    return any(not wanted & {f["label"], *f["alike"]} for f in named(record))


def both(record: Record) -> bool:
    """Is every effect of the world named?"""
    return all(any(is_named(f, [w]) for f in named(record)) for w in record["wanted"])


def further_off(record: Record) -> bool:
    """Are the declared parameters further off than before, by more than their scatter (99.9 %)?"""
    growth = record["error_after"] - record["error_before"]
    return bool(growth > norm.ppf(0.999) * scatter(record))


def scatter(record: Record) -> float:
    """Standard deviation of the difference of two errors of the declared parameters.

    Both are root mean squares of k numbers that noise moves by one standard deviation, or by as
    many as the oracle's: √(2/k) of those.
    """
    return float(np.sqrt(2 / record["truths"]) * max(1.0, record["error_oracle"]))


def worse(record: Record) -> bool:
    """Is it the model that has them further off: by a scatter or more without any noise?"""
    growth = record["clean_after"] - record["clean_before"]
    return further_off(record) and bool(growth > scatter(record))


def fluke(record: Record) -> bool:
    """Is it noise that looked like an effect, and has them further off?"""
    return further_off(record) and not worse(record)


def share_removed(record: Record) -> float:
    """Of the held-out excess that the oracle explains, how much is gone."""
    squares = [record[k] ** 2 for k in ("before", "after", "oracle")]
    return float((squares[0] - squares[1]) / (squares[0] - squares[2]))


def says(record: Record, words: dict[str, tuple[str, ...]]) -> bool:
    """Does a formula or a column name what the effect of no catalogue follows?"""
    what = record["what"]
    text = " ".join(f"{f['label']} {f['column']} {f['formula']}" for f in named(record))
    return any(word in text for word in words[what])


# -- lines -----------------------------------------------------------------------------------------


def table(records: Sequence[Record], words: dict[str, tuple[str, ...]]) -> str:
    """Markdown: the figures with their goals, then the single effects, then those without."""
    good = [r for r in records if "failed" not in r]
    groups = {g: [r for r in good if r["group"] == g] for g in _groups(records)}
    lines = [
        "# Closing the loop: worlds with known causes",
        "",
        "Made by `make study-loop` (`python studies/loop.py`). Data come from `tests/worlds.py`,",
        "which shares no code with the catalogue; the oracle is a fit that knows the effect.",
        "Visible: the oracle lowers the held-out rmse by at least 2 %, and without noise the",
        "declared model leaves at least 45 σ². Held-out errors are cross-fitted, over the same",
        "folds for all. Errors of the declared parameters are of the independent combinations of",
        "them that the oracle's data determine, root mean square, in its standard deviations.",
        "Named: by name, or among the two nearest that are not told apart. A weaker effect's",
        "wrong name is one without the word that it may as well be the one which the world has.",
        "Further off, beyond noise: by more than 3.1 standard deviations of the difference, and by",
        "one or more where the same two models are fitted to readings without noise.",
        "",
        f"{len(records)} worlds, {len(records) - len(good)} where the loop stopped with an error.",
        "",
        "| figure | worlds | found | goal |",
        "| --- | --- | --- | --- |",
        *_figures(groups, words),
        "",
        *_each("one", "Effects of the catalogue, one at a time", groups.get("one", []), _of_one),
        *_each("two", "Two at once", groups.get("two", []), _of_two),
        *_nothing(groups.get("null", [])),
        *_failures(records),
    ]
    return "\n".join(lines) + "\n"


def _groups(records: Sequence[Record]) -> list[str]:
    return list(dict.fromkeys(r["group"] for r in records))


def _figures(groups: dict[str, list[Record]], words: dict[str, tuple[str, ...]]) -> list[str]:
    null, one, two = (groups.get(g, []) for g in ("null", "one", "two"))
    seen, weak = [r for r in one if visible(r)], [r for r in one if not visible(r)]
    clear = [r for r in seen + two if visible(r)]
    lines = [
        _share("without effect, one reported", null, lambda r: bool(named(r)), "≤ 1 %", bound=True),
        _share("visible, named first", seen, found_first, "≥ 95 %"),
        _share("weaker, a wrong name", weak, wrongly_named, "≤ 2 %"),
        _share("weaker, found all the same", weak, found_first, ""),
        _share("visible, also a wrong name", seen, wrong, ""),
        _share("two at once, both named", two, both, "≥ 85 %"),
    ]
    if clear:
        ratio = np.array([r["after"] / r["oracle"] for r in clear])
        error = np.array([r["error_after"] / r["error_oracle"] for r in clear])
        low, high = np.median(ratio), np.quantile(ratio, 0.95)
        lines += [
            f"| held-out rmse after / oracle's: median | {len(clear)} | {low:.4f} | ≤ 1.01 |",
            f"| held-out rmse after / oracle's: 95 % | {len(clear)} | {high:.4f} | ≤ 1.03 |",
            f"| error of declared parameters after / oracle's: median | {len(clear)} "
            f"| {np.median(error):.3f} | ≤ 1.2 |",
        ]
    every = one + two + groups.get("elsewhere", [])
    lines += [
        _share("declared parameters further off than before, beyond noise", every, worse, "0"),
        _share("further off, by noise that looked like an effect", every, fluke, ""),
    ]
    other = [r for r in groups.get("elsewhere", []) if visible(r)]
    lines += [
        _share("in no catalogue: ≥ 80 % removed", other, lambda r: share_removed(r) >= 0.8, "all"),
        _share("in no catalogue: named what it follows", other, lambda r: says(r, words), "all"),
    ]
    hidden = groups.get("hidden", [])
    lines += [
        _share("invisible, found all the same", hidden, lambda r: bool(named(r)), "0"),
        _share("invisible, listed", hidden, lambda r: r["what"] in r["invisible"], "all"),
    ]
    return lines


def _kinds(records: Sequence[Record]) -> dict[tuple[str, ...], list[Record]]:
    """Worlds that differ in their seed only."""
    kinds: dict[tuple[str, ...], list[Record]] = {}
    for r in records:
        kinds.setdefault((r["group"], r["place"], r["what"], r["size"]), []).append(r)
    return kinds


def _share(
    words: str, records: Sequence[Any], test: Callable[[Any], bool], goal: str, bound=False
) -> str:
    if not records:
        return f"| {words} | 0 | | {goal} |"
    hits = sum(map(test, records))
    more = f", below {100 * upper(hits, len(records)):.2f} % (95 %)" if bound else ""
    return (
        f"| {words} | {len(records)} | {hits}: {100 * hits / len(records):.1f} %{more} | {goal} |"
    )


def _each(
    group: str, title: str, records: Sequence[Record], row: Callable[[list[Record]], str]
) -> list[str]:
    if not records:
        return []
    head = {
        "one": "visible | named first | wrong name | noncentrality | oracle's gain | rmse after / "
        "oracle's | error before, after, oracle's",
        "two": "both named | wrong name | rmse after / oracle's | error before, after, oracle's",
    }[group]
    lines = [f"## {title}", "", f"| place | effect | size | worlds | {head} |"]
    lines.append("| --- " * (5 + head.count("|")) + "|")
    for (_, place, what, size), own in _kinds(records).items():
        lines.append(f"| {place} | {what} | {size} | {len(own)} | {row(own)} |")
    return [*lines, ""]


def _of_one(own: list[Record]) -> str:
    gain = np.median([1 - r["oracle"] / r["before"] for r in own])
    return " | ".join(
        [
            str(sum(map(visible, own))),
            str(sum(map(found_first, own))),
            str(sum(map(wrongly_named, own))),
            f"{np.median([r['noncentrality'] for r in own]):.3g}",
            f"{100 * gain:.2g} %",
            _after(own),
        ]
    )


def _of_two(own: list[Record]) -> str:
    return " | ".join([str(sum(map(both, own))), str(sum(map(wrong, own))), _after(own)])


def _after(own: list[Record]) -> str:
    ratio = np.median([r["after"] / r["oracle"] for r in own])
    errors = [np.median([r[f"error_{k}"] for r in own]) for k in ("before", "after", "oracle")]
    return f"{ratio:.3f} | " + ", ".join(f"{e:.3g}" for e in errors)


def _nothing(records: Sequence[Record]) -> list[str]:
    if not records:
        return []
    lines = ["## Without effect", "", "| place | noise | worlds | residuals | reported |"]
    lines.append("| --- | --- | --- | --- | --- |")
    kinds: dict[tuple[str, str], list[Record]] = {}
    for r in records:
        kinds.setdefault((r["place"], r["what"]), []).append(r)
    for (place, what), own in kinds.items():
        said = [f["label"] for r in own for f in named(r)]
        sizes = [r["residuals"] for r in own]
        lines.append(
            f"| {place} | {what} | {len(own)} | {min(sizes)}-{max(sizes)} | "
            f"{sum(bool(named(r)) for r in own)} {', '.join(said)} |"
        )
    seconds = np.array([r["seconds"] for r in records])
    long = [r["seconds"] for r in records if r["residuals"] >= 36_000]
    lines += ["", f"Seconds per world: {np.median(seconds):.2f} (median)"]
    if long:
        lines[-1] += f"; wheel of 12 000 samples: {np.median(long):.2f} (median), {max(long):.2f}"
    return [*lines, ""]


def _failures(records: Sequence[Record]) -> list[str]:
    failed = [f"* `{r['name']}`: {r['failed']}" for r in records if "failed" in r]
    return ["## Stopped with an error", "", *failed, ""] if failed else []
