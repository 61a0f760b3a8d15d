"""Measured records closed, and judged by what each can support.

    make study-records       # python studies/records.py, with the records in ../shared/data

Every row is `casest close` on a record that nobody here made (sources beside the records; another
place: CASEST_DATA; nine headings are printed in a paper). What is right to say of each is written
as data in `record_rows.py`, from computations with NumPy and SciPy alone; the judgement is computed
from it. `--only NAME` closes the records whose name has NAME in it, `--json FILE` keeps each row as
it is done, and goes on where it was left. The table of all is written to `studies/records.md`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from record_files import DATA, ROOT, found
from record_rows import OF_NOISE, RECORDS, Record

from casest import CasestError, Run, load_runs
from casest.cli import run
from casest.effects.placing import prepared
from casest.estimate.held_out import residuals
from casest.leastsquares.problem import Problem
from casest.leastsquares.weights import weighted
from casest.results.find import find_model
from casest.saved.model import saved_model
from casest.solve.trust_region import trust_region

TABLE = ROOT / "studies" / "records.md"
#: s of processor time that a record may take; a row that takes longer is wrong.
LIMIT = 120.0
#: s until a record is given up, its stretches included, whatever else the machine does.
PATIENCE = 4 * LIMIT
#: Stretches of a record, each held out whole once.
STRETCHES = 10
#: Share of the held-out errors, the largest, that is left away: bad samples.
LEFT_AWAY = 0.005

HEAD = """# Measured records

Made by `make study-records` (`python studies/records.py`): each row is one `casest close`, of at
most {limit:.0f} s of processor time. Errors are root mean squares in the unit of the reading,
before → after: of casest's own folds, and of {stretches} stretches of the record (of poses: groups
of neighbours), each held out whole and predicted by a fit of the model, as it was declared and as
it was closed, to all others; the largest {away:.1%} of these errors are left away (bad samples).
What a record can support was computed with NumPy and SciPy alone; the judgement is computed from
that (`studies/record_rows.py`): *right*, *unhelpful* (true, but a cause that the record shows is
not named, or too much is left) or *wrong*. Of a field that sways, a cycled cell with hysteresis, a
wheel and a rate table no measured record is at hand.

{right} of {all} right, {unhelpful} unhelpful, {wrong} wrong.
"""
COLUMNS = ["record", "what it can support", "verdict", "claimed", "casest's folds",
           "whole stretches", "unit", "seconds", "judged"]  # fmt: skip

Row = dict[str, Any]


def closed(record: Record) -> Row:
    """What the command line says of a record, and the errors on stretches held out whole."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file, model = found(record.file, folder), found(record.model, folder)
        options = [found(word, folder) for word in record.words[3:]]
        began = time.process_time()
        code = run(["close", model, file, *options, "-o", name])
        seconds = time.process_time() - began
        if not (folder / "result.json").is_file():
            return {"name": record.name, "error": f"exit code {code}", "seconds": seconds}
        result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        if "before" not in result:
            (why, *_) = result["estimate"]["certificate"]["reasons"]
            return {"name": record.name, "error": f"refused: {why}", "seconds": seconds}
        row = {"name": record.name, "seconds": seconds, **_said(result)}
        declared = find_model(model)
        runs = prepared(declared, load_runs([file], declared.signals, **record.reading))
        return row | {"stretches": _on_stretches(result, model, runs)}


def _said(result: Row) -> Row:
    """The parts of result.json that are judged."""
    left = result.get("unexplained") or {}
    effects = [
        {
            "name": e["name"],
            "label": e["name"] + (f"({e['column']})" if e["column"] else ""),
            "rivals": [*e["indistinguishable_from"], *e["less_likely"]],
            "values": {name: p["value"] for name, p in e["parameters"].items()},
        }
        for e in result["effects"]
    ]
    return {
        "verdict": result["verdict"],
        "effects": effects,
        "one_of": left.get("one_of") or [],
        "left": left.get("fraction"),
        "unit": result["noise"]["unit"],
        "folds": [result[k]["rmse_holdout"] for k in ("before", "after")],
        "fit": [result[k]["rmse_fit"] for k in ("before", "after")],
    }


def _on_stretches(result: Row, declared: str, runs: tuple[Run, ...]) -> list[float | None]:
    """Root mean square error on whole stretches: of the declared model, and of the closed one."""
    bare = {**result, "effects": [], "after": result["before"], "model": declared}
    bare["scopes"] = {n: s for n, s in result["scopes"].items() if n in _names(result["before"])}
    errors: list[float | None] = []
    for one in (bare, result):
        try:
            errors.append(held_out(*saved_model(one), runs))
        except (CasestError, np.linalg.LinAlgError) as error:
            print(f"  whole stretches: {error}", file=sys.stderr)
            errors.append(None)
    return errors


def _names(state: Row) -> set[str]:
    return set(state["parameters"])


def held_out(model: Any, values: Any, runs: tuple[Run, ...]) -> float:
    """Root mean square error on stretches of the runs, each predicted by a fit to the others."""
    rows = []
    for k, whole in enumerate(runs):
        for stretch in stretches(whole):
            inside = np.zeros(len(whole), dtype=bool)
            inside[stretch] = True
            others = (*runs[:k], _apart(whole, ~inside), *runs[k + 1 :])
            fit = weighted(Problem(model, others), values)
            point = trust_region(fit, fit.point(values)).point
            rows.append(residuals(model, fit.values(point), None, whole.take(inside)).ravel())
    return _rms(np.concatenate(rows))


def _rms(errors: Any) -> float:
    """Root mean square without the largest: three readings of -8e6 would hide all others."""
    sizes = np.sort(np.abs(errors[np.isfinite(errors)]))
    return float(np.sqrt(np.mean(sizes[: len(sizes) - int(LEFT_AWAY * len(sizes))] ** 2)))


def stretches(whole: Run) -> list[Any]:
    """The samples in STRETCHES parts of equal length; of few poses, in as many groups."""
    return np.array_split(np.arange(len(whole)), min(STRETCHES, len(whole)))


def _apart(whole: Run, kept: Any) -> Run:
    """What is left of a run, the two sides of the gap being stretches of their own."""
    gap = np.cumsum(np.r_[False, kept[1:] & ~kept[:-1]])
    taken = whole.take(kept)
    return replace(taken, block=taken.block + gap[kept] * (int(whole.block.max()) + 1))


def judged(record: Record, row: Row) -> str:
    """Right, unhelpful or wrong, and why."""
    if "error" in row:
        return f"wrong: error: {row['error']}"
    for why in _wrong(record, row):
        return f"wrong: {why}"
    for why in _unhelpful(record, row):
        return f"unhelpful: {why}"
    return "right"


def _wrong(record: Record, row: Row) -> Iterator[str]:
    right, claims = record.right, [e for e in row["effects"] if e["name"] not in OF_NOISE]
    allowed = right.may.union(right.rivals, *right.named)
    for e in claims:
        if e["name"] not in allowed:
            yield f"{e['label']} is claimed"
    if row["verdict"] not in right.verdicts and row["verdict"] != "unexplained":
        yield f"verdict {row['verdict'] or 'none'}"
    for e in claims:
        beside = {_bare(name) for name in e["rivals"]} | {o["name"] for o in claims if o is not e}
        if e["name"] in right.rivals and not beside & right.rivals:
            yield f"{e['label']} alone, where others explain the record alike"
    # What is slow comes later by a delay and a low pass's time constant together.
    besides = sum(e["values"].get("tau", 0.0) for e in claims if e["name"] == "low_pass")
    for e in claims:
        for name, (low, high) in right.values.items():
            sizes = np.abs(np.atleast_1d(e["values"].get(name, []))) + besides
            if sizes.size and not ((low <= sizes) & (sizes <= high)).all():
                yield f"{e['label']}: {name} = {', '.join(f'{s:.4g}' for s in sizes)}"


def _unhelpful(record: Record, row: Row) -> Iterator[str]:
    right = record.right
    known = {e["name"] for e in row["effects"]}
    known |= {_bare(name) for e in row["effects"] for name in e["rivals"]}
    known |= {_bare(name) for name in row["one_of"]}
    for group in right.named:
        if not known & group:
            yield f"{' or '.join(sorted(group))} is not named"
    if row["verdict"] not in right.verdicts:
        yield f"verdict {row['verdict']}"
    after = row["stretches"][1] if row["stretches"][1] is not None else row["folds"][1]
    # Of causes that explain a record alike none need be claimed, and then nothing is taken away.
    torn = {_bare(name) for name in row["one_of"]} & right.rivals
    if right.within is not None and not torn and (after is None or after > right.within):
        yield f"{_number(after)} is left on stretches held out, {right.within:g} would be possible"


def _bare(label: str) -> str:
    """The name of an effect without its column or place."""
    return label.partition("(")[0].partition("@")[0]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def line(record: Record, row: Row) -> str:
    """One line of the table."""
    effects = "; ".join(
        e["label"] + (f" (or {', '.join(e['rivals'])})" if e["rivals"] else "")
        for e in row.get("effects", [])
    )
    one_of = f"one of {', '.join(row['one_of'])}" if row.get("one_of") else ""
    errors = [
        " → ".join(map(_number, row[key])) if key in row else "-" for key in ("folds", "stretches")
    ]
    verdict = "error" if "error" in row else row["verdict"] or "none"
    claimed = "; ".join(filter(None, (effects, one_of))) or "-"
    cells = [record.name, record.supports, verdict, claimed, *errors, row.get("unit", "-"),
             f"{row['seconds']:.1f}", judged(record, row)]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def table(rows: dict[str, Row]) -> str:
    """The table of all rows that were done."""
    done = [(r, rows[r.name]) for r in RECORDS if r.name in rows]
    verdicts = [judged(record, row).partition(":")[0] for record, row in done]
    count = {word: verdicts.count(word) for word in ("right", "unhelpful", "wrong")}
    head = HEAD.format(limit=LIMIT, away=LEFT_AWAY, stretches=STRETCHES, all=len(done), **count)
    lines = [head, f"| {' | '.join(COLUMNS)} |", "| --- " * len(COLUMNS) + "|"]
    return "\n".join(lines + [line(record, row) for record, row in done]) + "\n"


def apart(record: Record) -> Row:
    """A record closed in a process of its own: what takes too long or breaks is a row too."""
    began = time.monotonic()
    words = [sys.executable, __file__, "--row", record.name]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE, cwd=ROOT)
        row: Row = json.loads(done.stdout.splitlines()[-1])
        if row.get("error", "").startswith("exit code"):
            row["error"] = (done.stderr.strip().splitlines() or [row["error"]])[-1]
    except subprocess.TimeoutExpired:
        return {
            "name": record.name,
            "error": f"not done after {PATIENCE:.0f} s",
            "seconds": PATIENCE,
        }
    except (IndexError, ValueError):
        said = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        return {"name": record.name, "error": said, "seconds": time.monotonic() - began}
    if row["seconds"] > LIMIT:
        row["error"] = f"{row['seconds']:.0f} s, more than {LIMIT:.0f}"
    return row


def _stored(file: Path | None, rows: dict[str, Row]) -> None:
    if file:
        file.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def main() -> None:
    """Close every record and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", metavar="NAME", help="records whose name has this in it")
    parser.add_argument("--json", metavar="FILE", type=Path, help="keep rows here, and go on")
    parser.add_argument("--row", metavar="NAME", help="close this one record; its row as JSON")
    asked = parser.parse_args()
    if asked.row:
        record = next(r for r in RECORDS if r.name == asked.row)
        print("\n" + json.dumps(closed(record)))
        return
    file: Path | None = asked.json
    rows: dict[str, Row] = json.loads(file.read_text()) if file and file.is_file() else {}
    for record in RECORDS:
        if record.name not in rows and (asked.only or "") in record.name:
            print(f"{record.name} …", end=" ", flush=True)
            rows[record.name] = apart(record)
            _stored(file, rows)
            print(judged(record, rows[record.name]), flush=True)
    if asked.only:
        print(table({n: r for n, r in rows.items() if asked.only in n}))
    else:
        TABLE.write_text(table(rows), encoding="utf-8")
        print(f"written: {TABLE}")


if __name__ == "__main__":
    if not DATA.is_dir():
        sys.exit(f"{DATA} is not there: name the folder of measured records in CASEST_DATA")
    main()
