"""Data sets of many triads, in each of the forms that `casest fleet` reads."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

GRAVITY, SIGMA, POSES = 9.80665, 0.01, 24
WORDS = ["fleet", "norm-triangular"]
NORM = ["--set", f"norm={GRAVITY} m/s^2"]


def readings(count, seed=0, poses=POSES, noise=SIGMA):
    """Readings (S, N, 3) of sensors with offsets of ±0.5, gains ±3 %, skew ±1°."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((count, poses, 3))
    u *= GRAVITY / np.linalg.norm(u, axis=2, keepdims=True)
    M = np.eye(3) + rng.uniform(-0.03, 0.03, (count, 3, 1)) * np.eye(3)
    M += np.tril(rng.uniform(-0.017, 0.017, (count, 3, 3)), -1)
    v = np.einsum("sij,snj->sni", M, u) + rng.uniform(-0.5, 0.5, (count, 1, 3))
    return v + noise * rng.standard_normal(v.shape)


def names(count, first=0):
    return [f"S{k:06}" for k in range(first, first + count)]


def wide(v, sensors):
    """One row for each sensor, a list for each axis."""
    ends = pa.array(np.arange(len(v) + 1) * v.shape[1], pa.int32())
    flat = {f"v{axis} [m/s^2]": np.ascontiguousarray(v[:, :, k]) for k, axis in enumerate("xyz")}
    lists = {n: pa.ListArray.from_arrays(ends, pa.array(x.ravel())) for n, x in flat.items()}
    return pa.table({"sensor": sensors, **lists})


def vectors(v, sensors):
    """One row for each sensor, one list of vectors."""
    lists = pa.array([own.tolist() for own in v])
    field = pa.field("v", lists.type, metadata={"unit": "m/s^2"})
    return pa.table([pa.array(sensors), lists], schema=pa.schema([("sensor", pa.string()), field]))


def long(v, sensors):
    """One row for each reading."""
    columns = {f"v{axis} [m/s^2]": v[:, :, k].ravel() for k, axis in enumerate("xyz")}
    return pa.table({"sensor": np.repeat(sensors, v.shape[1]), **columns})


def dataset(folder: Path, files=2, each=40, form=wide, seed=0, **how):
    """A folder of files, and all readings (S, N, 3)."""
    folder.mkdir(exist_ok=True)
    v = readings(files * each, seed)
    for k in range(files):
        own = slice(k * each, (k + 1) * each)
        pq.write_table(form(v[own], names(each, k * each)), folder / f"part-{k}.parquet", **how)
    return v


def results(folder):
    return pq.read_table(Path(folder) / "results")


def rejected(folder):
    return pq.read_table(Path(folder) / "rejected.parquet").to_pylist()


def content(folder):
    """Bytes of every file below a folder, by name."""
    folder = Path(folder)
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


#: A partition is handed out every PAUSE seconds: whoever watches sees some done, and some not yet.
PAUSE = 0.2
SLOWLY = f"""
import time
import casest.tasks.folder as folder

class Slowly(list):
    def __iter__(self):
        for one in list.__iter__(self):
            time.sleep({PAUSE})
            yield one

missing = folder.missing
folder.missing = lambda *given: Slowly(missing(*given))
"""


def command(*words, numbers=None, slowly=False):
    """A command line in a process of its own; `numbers` in a partition, where they matter."""
    small = f"import casest.dataset.partitions as p; p.NUMBERS = {numbers}\n" if numbers else ""
    paused = SLOWLY if slowly else ""
    code = f"{small}{paused}\nfrom casest.cli import main; main({[str(w) for w in words]!r})"
    return [sys.executable, "-c", code]
