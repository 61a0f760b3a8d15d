"""Several saved results side by side: each parameter with its intervals, and whether they agree."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from scipy.special import fdtrc

from casest import units
from casest.data.logs import file_name
from casest.declaration.shapes import Array
from casest.errors import UnitError, UsageError
from casest.results.file import load_result, plain, result_file
from casest.results.result import Number, Result
from casest.results.saved import SavedResult, saved_result
from casest.results.values import Entry

#: Chance of a difference where there is none, over all numbers of one page.
LEVEL = 0.01


class Placed(Struct, frozen=True):
    """One result: its name on the page, where it lies, what it says; `at` orders it, if it does."""

    label: str
    path: str
    model: str
    trusted: bool
    verdict: str | None
    data: list[str]
    noise: Number
    unit: str
    at: Number = None

    @property
    def said(self) -> str:
        """What is said of the estimate."""
        trusted = "trusted" if self.trusted else "NOT TRUSTED"
        return f"{trusted}, {self.verdict}" if self.verdict else trusted


class Value(Struct, frozen=True):
    """One number in one result: value, standard deviation, ends of the 95 % interval."""

    value: Number
    std: Number
    low: Number
    high: Number


class Across(Struct, frozen=True):
    """One number over all results; null where one has none.

    `mean` is weighted by the inverse variances, `spread` the standard deviation between results;
    `p_value` is Welch's test that all are one; `furthest` names the result that is furthest off.
    """

    name: str
    unit: str
    values: list[Value | None]
    mean: Number
    mean_std: Number
    spread: Number
    p_value: Number
    furthest: str


class SideBySide(Result, frozen=True, kw_only=True, dict=True):
    """The content of `report.json`. `over` names the numbers or dates that order the results."""

    results: list[Placed]
    over: str | None
    level: float
    numbers: list[Across]

    @property
    def differing(self) -> list[Across]:
        """Numbers that differ by more than their standard deviations explain, furthest first."""
        tested = [(n.p_value, n.name, n) for n in self.numbers if n.p_value is not None]
        return [
            n for p, _, n in sorted(tested, key=lambda t: t[:2]) if p < self.level / len(tested)
        ]

    @property
    def sentence(self) -> str:
        """How many numbers differ by more than chance, the furthest first."""
        count, found = len(self.results), self.differing
        if count == 1:
            return f"One result of {self.model}"
        head = f"{count} results of {self.model}"
        tested = sum(n.p_value is not None for n in self.numbers)
        if not found:
            return f"{head} agree in all {tested} numbers that they share"
        names = ", ".join(n.name for n in found[:4]) + (" …" if len(found) > 4 else "")
        return f"{head} differ in {len(found)} of {tested} numbers by more than chance: {names}"


def side_by_side(paths: Sequence[Path]) -> SideBySide:
    """Read saved results and compare what they have in common.

    Refused estimates are shown and not compared. Raises DataError where one is no result,
    UsageError where no two have a number in common, UnitError where a unit cannot be converted.
    """
    saved = [saved_result(path) for path in paths]
    freedom = [_freedom(load_result(path)) for path in paths]
    labels = _labels(paths)
    at, over = _order(labels)
    placed = [
        Placed(label, str(path), s.model, s.trusted, s.verdict, s.data, *_noise(path), where)
        for label, path, s, where in zip(labels, paths, saved, at, strict=True)
    ]
    rank = sorted(range(len(paths)), key=lambda k: at[k] or 0.0) if over else range(len(paths))
    numbers = _numbers([saved[k] for k in rank], [freedom[k] for k in rank],
                       [labels[k] for k in rank])  # fmt: skip
    models = list(dict.fromkeys(s.model for s in saved))
    if not numbers or (len(saved) > 1 and all(n.p_value is None for n in numbers)):
        raise UsageError(
            f"these results have no number in common that two of them are sure of: they are of "
            f"{', '.join(models)}, {sum(s.trusted for s in saved)} of {len(saved)} trusted"
        )
    return SideBySide(
        model=", ".join(models),
        results=[placed[k] for k in rank],
        over=over,
        level=LEVEL,
        numbers=numbers,
    )


def _labels(paths: Sequence[Path]) -> list[str]:
    """What differs between the names of the folders."""
    folders = [Path(os.path.abspath(result_file(p))).parent.parts for p in paths]
    files = [result_file(p).stem for p in paths]
    own = files if len(set(files)) == len(files) and "result" not in files else None
    same = next((k for k in range(12) if len({p[-k - 1 :][:1] for p in folders}) > 1), 0)
    for depth in range(same + 1, 12):  # what all end with says nothing
        names = ["/".join(parts[-depth : len(parts) - same]) for parts in folders]
        if len(set(names)) == len(names):
            return own or names
    if len(set(map(str, paths))) < len(paths):
        raise UsageError("a result is given twice: name each once")
    return own or [str(p) for p in paths]


def _order(labels: Sequence[str]) -> tuple[list[float | None], str | None]:
    """Numbers or dates in the labels, where each holds one and nothing else differs."""
    if len(labels) > 1:
        try:
            days = [datetime.fromisoformat(_date(x)).timestamp() / 86400 for x in labels]
            return [d - min(days) for d in days], "days since the first"
        except ValueError:
            pass
        found = [re.findall(r"[-+]?\d+(?:\.\d+)?", x) for x in labels]
        rest = {re.sub(r"[-+]?\d+(?:\.\d+)?", "#", x) for x in labels}
        if len(rest) == 1 and all(len(f) == 1 for f in found):
            return [float(f[0]) for f in found], f"# in {rest.pop()}"
    return [None] * len(labels), None


def _date(label: str) -> str:
    found = re.search(r"\d{4}-\d\d-\d\d(?:[T_ ]\d\d[:\-]?\d\d(?:[:\-]?\d\d)?)?", label)
    if found is None:
        raise ValueError
    day, _, time = found[0].replace("_", "T").replace(" ", "T").partition("T")
    return f"{day}T{time.replace('-', ':')}" if time else day


def _noise(path: Path) -> tuple[float | None, str]:
    noise = load_result(path).get("noise") or {}
    sigma = noise.get("sigma") or [None]
    return sigma[0], str(noise.get("unit", ""))


def _freedom(content: dict[str, Any]) -> float:
    """Degrees of freedom of the standard deviations, as far as the result says it."""
    noise = content.get("noise") or {}
    count = noise.get("degrees_of_freedom") or np.inf
    return float(max(count / max(noise.get("correlated_over_samples") or 1.0, 1.0), 1.0))


def _numbers(
    saved: Sequence[SavedResult], freedom: Sequence[float], labels: Sequence[str]
) -> list[Across]:
    """Every number that any result has, in the order of the first that has it."""
    own = [{e.name: e for e in s.entries} for s in saved]
    names = list(dict.fromkeys(name for one in own for name in one))
    found = []
    for name in names:
        unit = next(one[name].unit for one in own if name in one)
        values = [
            _value(one[name], unit, label) if name in one else None
            for one, label in zip(own, labels, strict=True)
        ]
        sure = [v is not None and s.trusted for v, s in zip(values, saved, strict=True)]
        found.append(_across(name, unit, values, np.array(sure), freedom, labels))
    return found


def _value(entry: Entry, unit: str, label: str) -> Value:
    """The number in the unit that it has in the first result."""
    try:
        same = entry.unit == unit or "[" in entry.unit + unit
        factor = 1.0 if same else units.conversion(entry.unit or "1", unit or "1")[0]
    except UnitError as error:
        raise UnitError(f"{label}: {entry.name} is in {entry.unit or '1'}: {error}") from None
    ends = entry.value - entry.below, entry.value + entry.above
    return Value(*(plain(factor * x) for x in (entry.value, entry.std, *ends)))


def _across(
    name: str,
    unit: str,
    values: list[Value | None],
    sure: Array,
    freedom: Sequence[float],
    labels: Sequence[str],
) -> Across:
    x = np.array([v.value if v and v.value is not None else np.nan for v in values])
    s = np.array([v.std if v and v.std else np.nan for v in values])
    used = sure & np.isfinite(x) & np.isfinite(s)
    if used.sum() < 2:
        return Across(name, unit, values, None, None, None, None, "")
    mean, mean_std, p_value = welch(x[used], s[used], np.asarray(freedom)[used])
    z = np.abs(x - mean) / s
    furthest = labels[int(np.nanargmax(np.where(used, z, np.nan)))]
    spread = float(np.std(x[used], ddof=1))
    return Across(
        name, unit, values, plain(mean), plain(mean_std), spread, plain(p_value), furthest
    )


def welch(x: Array, std: Array, freedom: Array) -> tuple[float, float, float]:
    """Weighted mean of estimates (k,), its standard deviation, and the chance that all are one.

    B. L. Welch, "On the comparison of several mean values: an alternative approach", Biometrika
    38, 1951: the weights are estimated too, with `freedom` (k,) degrees of freedom each.
    """
    k, weight = len(x), 1 / std**2
    total = weight.sum()
    mean = float((weight * x).sum() / total)
    share = float(np.sum((1 - weight / total) ** 2 / freedom))
    squares = float((weight * (x - mean) ** 2).sum()) / (k - 1)
    F = squares / (1 + 2 * (k - 2) / (k**2 - 1) * share)
    second = (k**2 - 1) / (3 * share) if share > 0 else 1e12
    return mean, float(total**-0.5), float(fdtrc(k - 1, second, F))


def name_of_data(placed: Placed) -> str:
    """Files of a result, without their folders."""
    return ", ".join(file_name(d) for d in placed.data)
