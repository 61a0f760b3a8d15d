"""Measured records cut in two: closed on one half, does the model foretell the other?

    make study-halves        # python studies/halves.py, with the records in ../shared/data

Every record of `record_rows.py` that is a series in one file, and three magnetometers of BROAD by
the length of the field alone. Each half is a file of its own, with a clock that begins anew, and
`casest close HALF --holdout OTHER` says the error there before and after. `--json FILE` keeps each
row as it is done, and goes on where it was left. The table goes to `studies/halves.md`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from record_files import DATA, ROOT, found
from record_rows import RECORDS, Record, Right

from casest.cli import run

TABLE = ROOT / "studies" / "halves.md"
#: Poses, records of two files, and what the half says nothing of: 34 readings of a thermometer,
#: nine headings, two records that take minutes.
WITHOUT = ("rest positions", "Ferraris", "headings", "two files", "thermometer", "twistnsync")
#: Error on the other half, after over before, from which on it is worse by more than chance.
WORSE = 1.005
FIELD = {name: f"broad/{name}.csv" for name in ("mag01", "mag26", "mag32s")}

HEAD = """# Measured records, closed on one half

Made by `make study-halves` (`python studies/halves.py`): each record is cut in two, `casest close`
sees one half, and foretells the other, a file with a clock of its own: root mean square errors
there, in the unit of the reading, of the declared and of the closed model.

{closed} halves gave a trusted model, to {changed} of them a cause was added; of these the
other half was foretold better (by 0.5 % and more) in {better}, alike in {alike}, worse in {worse}.
{refused} were refused.

| record | half | verdict | added | before → after, the other half | seconds |
| --- | --- | --- | --- | --- | --- |
"""


def records() -> list[Record]:
    """What is cut in two."""
    several = [r for r in RECORDS if not any(word in r.name for word in WITHOUT)]
    columns = {"columns": {"t": ("t",), "v": ("m_x", "m_y", "m_z")}}
    for name, file in FIELD.items():
        options = ("--set", "norm=50 uT")
        label = f"BROAD {name}, length of the field"
        several.append(Record(label, "norm-triangular", file, "", Right(()), columns, options))
    return several


def halves(file: str, folder: Path) -> tuple[Path, Path]:
    """Two files with the same head and each half of the rows."""
    lines = Path(file).read_text(encoding="utf-8-sig").splitlines()
    first = next(i for i, line in enumerate(lines) if line[:1] in "-+.0123456789" and line)
    head, rows = lines[:first], [line for line in lines[first:] if line.strip()]
    found = folder / "first.csv", folder / "second.csv"
    for path, part in zip(found, (rows[: len(rows) // 2], rows[len(rows) // 2 :]), strict=True):
        path.write_text("\n".join([*head, *part]) + "\n", encoding="utf-8")
    return found


def closed(record: Record, second: bool) -> dict[str, Any]:
    """What is said of one half, and the errors on the other."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        one, other = halves(found(record.file, folder), folder)[:: -1 if second else 1]
        words = ["close", found(record.model, folder), str(one)]
        words += [found(word, folder) for word in record.words[3:]]
        began, said = time.process_time(), io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            run([*words, "--holdout", str(other), "-o", name])
        row = {"name": record.name, "half": "second" if second else "first",
               "seconds": time.process_time() - began}  # fmt: skip
        if not (folder / "result.json").is_file():
            return row | {"refused": said.getvalue().strip().splitlines()[-1]}
        result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    if "before" not in result:
        return row | {"refused": result["estimate"]["certificate"]["reasons"][0]}
    added = [e["name"] + (f"({e['column']})" if e["column"] else "") for e in result["effects"]]
    errors = [result[k]["rmse_holdout"] for k in ("before", "after")]
    return row | {"verdict": result["verdict"], "added": added, "errors": errors}


def table(rows: list[dict[str, Any]]) -> str:
    """All halves that were closed."""
    trusted = [r for r in rows if "errors" in r]
    changed = [r for r in trusted if set(r["added"]) - {"outliers"}]
    ratios = [r["errors"][1] / r["errors"][0] for r in changed]
    head = HEAD.format(
        closed=len(trusted),
        changed=len(changed),
        better=sum(x < 1 / WORSE for x in ratios),
        worse=sum(x > WORSE for x in ratios),
        alike=sum(1 / WORSE <= x <= WORSE for x in ratios),
        refused=len(rows) - len(trusted),
    )
    lines = []
    for r in rows:
        said = r.get("verdict") or f"refused: {r.get('refused', '')[:60]}"
        errors = " → ".join(f"{e:.4g}" for e in r.get("errors", [])) or "-"
        added = ", ".join(r.get("added", [])) or "-"
        cells = (r["name"], r["half"], said, added, errors, f"{r['seconds']:.1f}")
        lines.append(f"| {' | '.join(cells)} |")
    return head + "\n".join(lines) + "\n"


def main() -> None:
    """Close every half and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", metavar="NAME", default="", help="records with this in the name")
    parser.add_argument("--json", metavar="FILE", type=Path, help="keep rows here, and go on")
    asked = parser.parse_args()
    kept = asked.json.read_text().splitlines() if asked.json and asked.json.is_file() else []
    rows = [json.loads(line) for line in kept]
    done = {(r["name"], r["half"]) for r in rows}
    for record in records():
        for second in (False, True):
            half = "second" if second else "first"
            if asked.only not in record.name or (record.name, half) in done:
                continue
            rows.append(closed(record, second))
            print(record.name, half, rows[-1].get("errors", "refused"), flush=True)
            if asked.json:
                with asked.json.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
    if asked.only:
        print(table([r for r in rows if asked.only in r["name"]]))
    else:
        TABLE.write_text(table(rows), encoding="utf-8")
        print(f"written: {TABLE}")


if __name__ == "__main__":
    if not DATA.is_dir():
        sys.exit(f"{DATA} is not there: name the folder of measured records in CASEST_DATA")
    main()
