"""Measured records closed: what was traced, what was refused, and what each record can support.

    make study-records       # python studies/records.py, with the records in ../shared/data

Every row is `casest close` on a record that nobody here made (sources beside the records; another
place: CASEST_DATA; nine headings are printed in a paper). The table is written to
`studies/records.md`. The last column is a person's judgement of the verdict, not the program's.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from casest.cli import run

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import test_headings as ren_and_liu  # noqa: E402

DATA = Path(os.environ.get("CASEST_DATA", ROOT.parent / "shared" / "data"))
TABLE = ROOT / "studies" / "records.md"
AT_REST = str(ROOT / "examples" / "at_rest.py")
#: The same model of raw counts; a compass on a turn table.
COUNTS, COMPASS = "at_rest_counts.py", "compass.py"

HEAD = """# Measured records

Made by `make study-records` (`python studies/records.py`): each row is one `casest close`. Errors
are root mean squares in the unit of the reading, before → after, held-out ones cross-fitted. The
last column is a person's judgement of what the record can support.
"""


@dataclass(frozen=True)
class Record:
    """One record: how it is closed, and what is to be said of the verdict."""

    name: str
    model: str
    file: str
    options: tuple[str, ...]
    judgement: str


def _mpu9150(unit: str) -> Record:
    return Record(
        f"MPU-9150 {unit}, rest positions",
        "norm-diagonal",
        f"mpu9150-mikoff/{unit}.log",
        (
            "--columns",
            "v=0,1,2",
            "--unit",
            "v=m/s^2",
            "--rate",
            "100",
            "--at-rest",
            "--set",
            "norm=9.80665",
        ),
        "Supported: held-out positions are foretold several times better with the skew of the "
        "axes, which the declared model lacks. What is left beside it cannot be named by so few "
        "positions.",
    )


def _qmc(which: str) -> Record:
    return Record(
        f"QMC5883L, turned by hand, {which}",
        "norm-triangular",
        f"qmc5883l-tomisuarez/{which}_raw_data.csv",
        ("--columns", "v=mx,my,mz", "--unit", "v=count", "--set", "norm=1", "--rate", "50"),
        "A misfit of 6 % of the radius that no effect explains well: the field was not the same "
        "everywhere, or the hand's iron moved. A cubic that a few samples ask for is not taken.",
    )


def _headings(which: str, judgement: str) -> Record:
    return Record(
        f"Ren & Liu, Table IV: nine headings {which} calibration",
        COMPASS,
        f"{which}.csv",
        ("--effects", COMPASS),
        judgement,
    )


RECORDS = (
    *map(_mpu9150, ("imu0", "imu1", "imu2")),
    Record(
        "Ferraris session, six positions (NilsPod)",
        "norm-diagonal",
        "imucal/example_ferraris_session.csv",
        ("--columns", "v=acc_x,acc_y,acc_z", "--unit", "v=m/s^2", "--rate", "102.4", "--at-rest",
         "--set", "norm=9.80665"),
        "Right to refuse: six unknowns from six positions leave none to hold out.",
    ),
    Record(
        "psim, gyro at rest in a cold test (TVC)",
        AT_REST,
        "psim-thermal/TVCtest3_7_20.csv",
        ("--columns", "v=gyrox,gyroy,gyroz", "--unit", "v=rad/s", "--scale",
         "temp=int16/256+25", "--unit", "temp=degC"),
        "Time and temperature are correlated by -0.999 here: whichever is kept, the other is "
        "named beside it. That x and y change and z does not is supported; the cause is not.",
    ),
    Record(
        "MPU-6050 at rest, gyro",
        COUNTS,
        "mpu6050-tomisuarez/imu_static_test.csv",
        ("--columns", "v=gx,gy,gz", "--unit", "v=count", "--rate", "100"),
        "A narrow line; a slow change that may be a drift or a step is left open. "
        "Together 0.2 % of the rms.",
    ),
    Record(
        "MPU-6050 at rest, accelerometer",
        COUNTS,
        "mpu6050-tomisuarez/imu_static_test.csv",
        ("--columns", "v=ax,ay,az", "--unit", "v=count", "--rate", "100"),
        "Nothing but noise; an axis with nothing in it stays as declared.",
    ),
    *map(_qmc, ("noisy", "filtered")),
    _headings(
        "before",
        "The first harmonic, the user's own effect, halves the error: F(2, 6) = 13.5, p = 0.006. "
        "Nine readings say that much of an effect that is asked for, and no more.",
    ),
    _headings("after", "Nothing beyond the readings' own repeatability, 0.57 degrees."),
)  # fmt: skip


def closed(record: Record) -> dict[str, Any]:
    """The result of the command line on a record."""
    with tempfile.TemporaryDirectory() as folder:
        made = _written(Path(folder))
        model, data = made.get(record.model, record.model), made.get(record.file)
        options = [made.get(word, word) for word in record.options]
        words = ["close", model, data or str(DATA / record.file), *options, "-o", folder]
        code = run(words)
        found = json.loads((Path(folder) / "result.json").read_text(encoding="utf-8"))
    return found | {"exit": code}


def _written(folder: Path) -> dict[str, str]:
    """Models and tables that are no files of their own: name -> path."""
    counts = Path(AT_REST).read_text(encoding="utf-8").replace("rad/s", "count")
    texts = {COUNTS: counts, COMPASS: ren_and_liu.COMPASS}
    texts |= {f"{which}.csv": ren_and_liu.table_of(which) for which in ren_and_liu.HEADINGS}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return {name: str(folder / name) for name in texts}


def row(record: Record, found: dict[str, Any]) -> str:
    """One line of the table."""
    both = [found[k]["rmse_holdout"] for k in ("before", "after")]
    errors = ["-" if e is None else f"{e:.4g}" for e in both]
    fits = [f"{found[k]['rmse_fit']:.4g}" for k in ("before", "after")]
    unit = found["noise"]["unit"]
    refused = list(dict.fromkeys(r["name"] for r in found["refused"]))
    cells = [
        record.name,
        Path(record.model).stem,
        f"{fits[0]} → {fits[1]}",
        f"{errors[0]} → {errors[1]}",
        unit,
        found["verdict"] or "none",
        "; ".join(_effects(found)) or "-",
        ", ".join(refused) or "-",
        record.judgement,
    ]
    return "| " + " | ".join(cells) + " |"


def _effects(found: dict[str, Any]) -> Iterator[str]:
    for e in found["effects"]:
        name = e["name"] + (f"({e['column']})" if e["column"] else "")
        alike = [*e["indistinguishable_from"], *e["less_likely"]]
        yield name + (f" (or {', '.join(alike)})" if alike else "")


def main() -> None:
    """Close every record and write the table."""
    columns = ["record", "model", "fit", "held-out", "unit", "verdict", "traced", "refused",
               "what the record can support"]  # fmt: skip
    lines = [HEAD, f"| {' | '.join(columns)} |", "| --- " * len(columns) + "|"]
    for record in RECORDS:
        print(record.name, flush=True)
        lines.append(row(record, closed(record)))
    TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"written: {TABLE}")


if __name__ == "__main__":
    main()
