"""The tables of a PEtab problem (format 1): what is estimated, and what was read when."""

from __future__ import annotations

import csv
import keyword
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from casest.errors import DataError, library
from casest.petab.equations import Equations, sbml, written_equations
from casest.petab.formula import name_of, number_of, python_of, replaced

#: Columns of a table that are looked at, and those that may be left out.
MEASUREMENTS = ("observableId", "simulationConditionId", "time", "measurement")
OBSERVABLES = ("observableId", "observableFormula", "noiseFormula")
PARAMETERS = ("parameterId", "lowerBound", "upperBound", "nominalValue", "estimate")
#: Transformations of readings.
TRANSFORMED = {"": "{}", "lin": "{}", "log": "log({})", "log10": "log10({})"}

Row = Mapping[str, str]


@dataclass(frozen=True)
class Unknown:
    """A parameter of the table: `value` where it begins, or is held; bounds of one to estimate."""

    value: float
    bounds: tuple[float, float] | None


@dataclass(frozen=True)
class Observable:
    """Formulas of what is read and of its noise, as a table has them; `scale` as TRANSFORMED."""

    formula: str
    noise: str
    scale: str


@dataclass(frozen=True)
class Measured:
    """One reading: of which observable, in which condition, when; parameters of both formulas."""

    observable: str
    condition: str
    time: float
    value: float
    given: tuple[str, ...]
    noise: tuple[str, ...]
    row: int


@dataclass
class Tables:
    """All of a problem. `notes`: what was not read and matters little."""

    name: str
    equations: Equations
    unknowns: dict[str, Unknown]
    conditions: dict[str, dict[str, str]]
    observables: dict[str, Observable]
    measurements: list[Measured]
    notes: list[str] = field(default_factory=list)


def is_petab(path: str) -> bool:
    """Does this file's name say that it may be a PEtab problem?"""
    return Path(path).suffix.lower() in (".yaml", ".yml")


def tables(path: Path, equations: Path | None = None) -> Tables:
    """A problem from its YAML file; `equations` written by hand in place of its SBML."""
    content = _yaml(path)
    version = str(content.get("format_version", "1"))
    if version.partition(".")[0] != "1":
        raise DataError(f"{path}: PEtab of version {version} is not read; version 1 is")
    problems = content.get("problems")
    if not isinstance(problems, list) or len(problems) != 1:
        raise DataError(f"{path}: holds no problems: or several; one is read")
    problem = problems[0]
    model = _equations(path, problem, equations)
    notes: list[str] = []
    found = Tables(
        _named(path.stem),
        model,
        _unknowns(_rows(path, content.get("parameter_file"), PARAMETERS), notes),
        _conditions(_rows(path, problem.get("condition_files"), ("conditionId",))),
        _observables(_rows(path, problem.get("observable_files"), OBSERVABLES)),
        list(_measurements(_rows(path, problem.get("measurement_files"), MEASUREMENTS))),
        notes,
    )
    _check(found, path)
    return found


def _named(stem: str) -> str:
    """A name for the declaration: that of the file, as far as it can be one."""
    name = re.sub(r"\W", "_", stem, flags=re.ASCII).strip("_")
    return name if name.isidentifier() and not keyword.iskeyword(name) else f"problem_{name}"


def _check(found: Tables, path: Path) -> None:
    if not found.measurements:
        raise DataError(f"{path}: its tables hold no measurement")
    for m in found.measurements:
        if m.observable not in found.observables:
            raise DataError(f"{path}: measurement {m.row} is of {m.observable}, which no table has")
        if m.condition not in found.conditions:
            raise DataError(f"{path}: measurement {m.row}: no table has condition {m.condition}")


def _yaml(path: Path) -> Mapping[str, Any]:
    yaml = library("ruamel.yaml", "petab", f"{path}: a PEtab problem")
    try:
        found = yaml.YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    except (yaml.error.YAMLError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: is no YAML ({str(error).splitlines()[0]})") from None
    if not isinstance(found, dict) or "problems" not in found:
        raise DataError(f"{path}: is no PEtab problem: it has no entry `problems`")
    return found


def _equations(path: Path, problem: Mapping[str, Any], equations: Path | None) -> Equations:
    if equations is not None:
        return written_equations(equations)
    files = problem.get("sbml_files") or []
    if len(files) != 1:
        raise DataError(
            f"{path}: names {len(files) or 'no'} SBML files: give --equations FILE with lines "
            "A' = -k1*A and A(0) = a0"
        )
    return sbml(path.parent / str(files[0]))


def _rows(path: Path, files: Any, needed: tuple[str, ...]) -> list[Row]:
    """The rows of one or several tables, every cell a text without blanks around it."""
    found: list[Row] = []
    for name in [files] if isinstance(files, str) else files or []:
        file = path.parent / str(name)
        try:
            with file.open(encoding="utf-8", newline="") as text:
                rows = list(csv.DictReader(text, delimiter="\t"))
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise DataError(f"{file}: cannot be read ({error})") from None
        for row in rows[:1]:
            for column in needed:
                if column not in row:
                    raise DataError(f"{file}: has no column {column}")
        found += [{k: (v or "").strip() for k, v in row.items() if k is not None} for row in rows]
    return found


def _unknowns(rows: list[Row], notes: list[str]) -> dict[str, Unknown]:
    found = {}
    for row in rows:
        name = name_of(row["parameterId"], "the table of parameters")
        value, lower, upper = (
            number_of(row[c]) for c in ("nominalValue", "lowerBound", "upperBound")
        )
        wanted = (number_of(row["estimate"]) or 0.0) != 0
        if wanted and (lower is None or upper is None):
            raise DataError(f"the table of parameters: {name} has no bounds")
        if value is None and not (wanted and lower is not None and upper is not None):
            raise DataError(f"the table of parameters: {name} has no nominalValue")
        if value is None:
            assert lower is not None
            assert upper is not None
            value = (lower * upper) ** 0.5 if lower > 0 else 0.5 * (lower + upper)
        bounds = (lower, upper) if wanted and lower is not None and upper is not None else None
        found[name] = Unknown(value, bounds)
        if row.get("objectivePriorType"):
            notes.append(f"what is known beforehand of {name} (objectivePriorType) is not read")
    return found


def _conditions(rows: list[Row]) -> dict[str, dict[str, str]]:
    """What each condition says of which name: a number or another name."""
    found: dict[str, dict[str, str]] = {}
    for row in rows:
        own = {k: v for k, v in row.items() if k not in ("conditionId", "conditionName")}
        where = f"condition {row['conditionId']}"
        found[row["conditionId"]] = {
            name_of(k, where): repr(number_of(v)) if number_of(v) is not None else name_of(v, where)
            for k, v in own.items()
            if v and v.lower() != "nan"
        }
    return found


def _observables(rows: list[Row]) -> dict[str, Observable]:
    found = {}
    for row in rows:
        name = name_of(row["observableId"], "the table of observables")
        scale = row.get("observableTransformation", "")
        if scale not in TRANSFORMED:
            raise DataError(f"observable {name}: observableTransformation {scale!r} is not read")
        if row.get("noiseDistribution", "normal") not in ("", "normal"):
            raise DataError(
                f"observable {name}: noise of distribution {row['noiseDistribution']} is not read: "
                "least squares is for normal noise"
            )
        found[name] = Observable(row["observableFormula"], row["noiseFormula"], scale)
    return found


def _measurements(rows: list[Row]) -> Iterator[Measured]:
    for k, row in enumerate(rows):
        where = f"measurement {k}"
        if row.get("preequilibrationConditionId"):
            raise DataError(
                f"{where}: begins where condition {row['preequilibrationConditionId']} settles "
                "(preequilibrationConditionId), which is not read"
            )
        time, value = number_of(row["time"]), number_of(row["measurement"])
        if time is None:
            raise DataError(
                f"{where}: the time {row['time']!r} is no number: what is read when all has "
                "settled (inf) is not read"
            )
        if value is None:
            raise DataError(f"{where}: {row['measurement']!r} is no number")
        given, noise = (
            tuple(part.strip() for part in row.get(c, "").split(";") if part.strip())
            for c in ("observableParameters", "noiseParameters")
        )
        yield Measured(
            row["observableId"], row["simulationConditionId"], time, value, given, noise, k
        )


def filled(formula: str, kind: str, observable: str, given: tuple[str, ...]) -> str:
    """A formula of an observable as Python, with what a measurement gives for its placeholders."""
    where = f"observable {observable}"
    put = {}
    for k, text in enumerate(given, 1):
        number = number_of(text)
        put[f"{kind}Parameter{k}_{observable}"] = (
            name_of(text, where) if number is None else repr(number)
        )
    found = python_of(formula, where)
    return replaced(found, put) if put else found
