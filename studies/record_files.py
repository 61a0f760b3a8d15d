"""Tables that are made from the measured records: cut, in one unit, with an integrated angle."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import test_headings as ren_and_liu  # noqa: E402

Array = NDArray[np.float64]

DATA = Path(os.environ.get("CASEST_DATA", ROOT.parent / "shared" / "data"))
AT_REST = ROOT / "examples" / "at_rest.py"
#: s into the log at which the copter of log171 hits the ground: its yaw leaps by 90 degrees.
FELL = 238.0


def table(name: str, header: str, rows: Array, folder: Path) -> Path:
    """A file of comma-separated values."""
    path = folder / name
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    return path


def _numbers(file: str, headed_by: str | None = None) -> Array:
    """The rows below the header line that begins with `headed_by`, or below the first line."""
    lines = (DATA / file).read_text(encoding="utf-8-sig").splitlines()
    first = next((i for i, s in enumerate(lines) if headed_by and s.startswith(headed_by)), 0)
    return np.genfromtxt(lines[first + 1 :], delimiter=",")


def _in_the_air(which: str) -> Callable[[Path], Path]:
    def made(folder: Path) -> Path:
        file = f"ardupilot-log171/{which}_all.csv"
        header = (DATA / file).read_text(encoding="utf-8").split("\n", 1)[0]
        rows = _numbers(file)
        return table(f"{which}_flight.csv", header, rows[rows[:, 0] < FELL], folder)

    return made


def _turned(folder: Path) -> Path:
    """Acceleration, and the angle that the gyro's x gives, bias from the first 3 s taken off."""
    counts = _numbers("mpu6050-tomisuarez/imu_90_x_rot.csv", "ax,")
    rate = np.deg2rad((counts[:, 3] - counts[:300, 3].mean()) / 131)
    t = np.arange(len(counts)) / 100
    rows = np.column_stack([t, counts[:, :3] / 16384, np.cumsum(rate) / 100])
    return table("turned.csv", "t [s],a_x [g],a_y [g],a_z [g],theta [rad]", rows, folder)


def _cold(folder: Path) -> Path:
    """Minutes, the chamber (F4, degF in the file) and the unit's own thermometer, read by hand."""
    text = (DATA / "psim-thermal/ETUColdTest3_7_20.csv").read_text(encoding="utf-8-sig")
    cells = [line.split(",")[:5] for line in text.splitlines()[1:]]
    read = [c for c in cells if all(word.strip() for word in c)]
    clock = [60 * int(h) + int(m) for h, m in (c[0].split(":") for c in read)]
    t = 60.0 * (np.array(clock) - clock[0])
    rows = np.column_stack([t, [float(c[3]) for c in read], [float(c[4]) for c in read]])
    return table("cold.csv", "t [s],chamber [degF],reads [degC]", rows, folder)


def _house(folder: Path) -> Path:
    hours = _numbers("buildings/building_1.csv")
    rows = np.column_stack([3600 * hours[:, 0], hours[:, 1:]])
    header = "t [s],sun [kW/m^2],outside [degC],inside [degC],supply [degC]"
    return table("house.csv", header, rows, folder)


def _gyro(source: str, name: str, columns: tuple[int, ...], unit: str) -> Callable[[Path], Path]:
    """Time and rate of one instrument, its columns called after the signal `name`."""

    def made(folder: Path) -> Path:
        rows = _numbers(source)[:, list(columns)]
        rows = rows[np.isfinite(rows).all(axis=1)]
        rows = rows[np.r_[True, np.diff(rows[:, 0]) > 0]]
        header = "t [s]," + ",".join(f"{name}_{axis} [{unit}]" for axis in "xyz")
        return table(f"{Path(source).stem}_{name}.csv", header, rows, folder)

    return made


def _on_one_clock(first: str, second: str, name: str) -> Callable[[Path], Path]:
    """Two instruments in one table, as if their clocks had begun together."""

    def made(folder: Path) -> Path:
        a, b = (
            np.loadtxt(MADE[part](folder), delimiter=",", skiprows=1) for part in (first, second)
        )
        a = a[(a[:, 0] >= b[0, 0]) & (a[:, 0] <= b[-1, 0])]
        later = np.column_stack([np.interp(a[:, 0], b[:, 0], column) for column in b[:, 1:].T])
        units = "deg/s" if first == "bno_w.csv" else "rad/s"
        header = "t [s]" + "".join(f",w_{axis} [{units}]" for axis in "xyz")
        header += "".join(f",u_{axis} [rad/s]" for axis in "xyz")
        return table(name, header, np.column_stack([a, later]), folder)

    return made


def _text(name: str, text: str) -> Callable[[Path], Path]:
    def made(folder: Path) -> Path:
        (folder / name).write_text(text, encoding="utf-8")
        return folder / name

    return made


#: What is no file of its own: name -> what writes it into a folder.
MADE: dict[str, Callable[[Path], Path]] = {
    "at_rest_counts.py": _text(
        "at_rest_counts.py", AT_REST.read_text(encoding="utf-8").replace("rad/s", "count")
    ),
    "compass.py": _text("compass.py", ren_and_liu.COMPASS),
    **{f"{which}_flight.csv": _in_the_air(which) for which in ("MAG", "MAG2", "MAG3")},
    **{
        f"{which}.csv": _text(f"{which}.csv", ren_and_liu.table_of(which))
        for which in ren_and_liu.HEADINGS
    },
    "turned.csv": _turned,
    "cold.csv": _cold,
    "house.csv": _house,
    "mcu_w.csv": _gyro("twistnsync/twist_mcu.csv", "w", (0, 1, 2, 3), "rad/s"),
    "phone_u.csv": _gyro("twistnsync/twist_phone.csv", "u", (0, 1, 2, 3), "rad/s"),
    "bno_w.csv": _gyro("swing-project/lag_bno055.csv", "w", (0, 4, 5, 6), "deg/s"),
    "twist.csv": _on_one_clock("mcu_w.csv", "phone_u.csv", "twist.csv"),
    "swing.csv": _on_one_clock("bno_w.csv", "iphone_u.csv", "swing.csv"),
    "iphone_u.csv": _gyro("swing-project/lag_iphone.csv", "u", (7, 8, 9, 10), "rad/s"),
}


def found(word: str, folder: Path) -> str:
    """A word of a command line with the file in its place; `a+b` is two files."""
    if "+" in word and all(part in MADE for part in word.split("+")):
        return "+".join(found(part, folder) for part in word.split("+"))
    if word in MADE:
        return str(MADE[word](folder))
    return str(DATA / word) if (DATA / word).is_file() else word
