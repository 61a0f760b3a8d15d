"""`casest fleet` against `calibrate_many` in memory: triads of 24 poses and 9 unknowns.

Run `python benchmarks/fleet.py [SENSORS …]` (10⁵ and 10⁶ unless told; 10⁷ takes 6 GB of disk).
A data set is written first, 100 000 sensors in a file. Then in turns, seconds of the processor (so
that other work on the machine counts less): `calibrate_many` on arrays, with and without `misfit`,
and the command from Parquet to Parquet in a process of its own, whose start is counted; its largest
memory; and what two processes take together, beside two commands at the same time with half of the
files each. The machine's speed changes from minute to minute; so what the command spends is also
compared within its own process with `calibrate_many` of the same readings, called once more without
`misfit` and taken off again. Last, what a sensor costs whose readings are sent to a
Dask worker rather than read by it.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter, process_time, sleep
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from many import GRAVITY, MODEL, POSES, readings

from casest.fleet.calibrate_many import calibrate_many

EACH, TURNS, ROWS = 100_000, 3, 50_000
CODE = "import sys; from casest.cli import main; main(sys.argv[1:])"
#: The same in one process; prints seconds of the processor: without and with `misfit` in
#: `calibrate_many`, and all that the command spends.
WITHIN = """
import contextlib, io, sys
from time import process_time
from casest.cli import run
from casest.tasks import task
calibrate, spent = task.calibrate_many, [0.0, 0.0]
def timed(*given, misfit, **how):
    moments = [process_time()]
    for asked in (False, misfit):
        found = calibrate(*given, misfit=asked, **how)
        moments.append(process_time())
    for k in range(2):
        spent[k] += moments[k + 1] - moments[k]
    return found
task.calibrate_many = timed
with contextlib.redirect_stdout(io.StringIO()):
    code = run(sys.argv[1:])
print(*spent, process_time() - spent[0])
sys.exit(code)
"""


def table(v: Any, first: int) -> Any:
    """One row for each sensor, a list for each axis."""
    ends = pa.array(np.arange(len(v) + 1) * POSES, pa.int32())
    lists = {
        f"v{axis} [m/s^2]": pa.ListArray.from_arrays(
            ends, pa.array(np.ascontiguousarray(v[:, :, k]).ravel())
        )
        for k, axis in enumerate("xyz")
    }
    return pa.table({"sensor": [f"S{first + k:09}" for k in range(len(v))], **lists})


def write(folder: Path, sensors: int) -> None:
    """A data set of so many sensors."""
    folder.mkdir()
    for k in range(0, sensors, EACH):
        part = table(readings(min(EACH, sensors - k), seed=k), k)
        pq.write_table(part, folder / f"part-{k // EACH:05}.parquet", row_group_size=ROWS)


def command(dataset: Path, out: Path, processes: int) -> tuple[float, float, float]:
    """Seconds of the processor, seconds, and largest memory of one process in MB."""
    return commands([dataset], [out], processes)


def commands(
    datasets: Sequence[Path], outs: Sequence[Path], processes: int
) -> tuple[float, float, float]:
    """The same of several commands at the same time."""
    before, began, going = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter(), []
    for dataset, out in zip(datasets, outs, strict=True):
        shutil.rmtree(out, ignore_errors=True)
        words = ["fleet", "norm-triangular", dataset, "-o", out, "--set", f"norm={GRAVITY} m/s^2"]
        argv = [sys.executable, "-c", CODE, *map(str, words), "--processes", str(processes)]
        going.append(subprocess.Popen(argv, stdout=subprocess.DEVNULL))
    most = 0.0
    while any(one.poll() is None for one in going):
        most = max(most, *(largest_of(one.pid) for one in going))
        sleep(0.05)
    assert not any(one.returncode for one in going)
    after, took = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter() - began
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return spent, took, most


def within(dataset: Path, out: Path) -> tuple[float, float]:
    """Shares of what the command spends that `calibrate_many` takes, without and with `misfit`."""
    shutil.rmtree(out, ignore_errors=True)
    words = ["fleet", "norm-triangular", dataset, "-o", out, "--set", f"norm={GRAVITY} m/s^2"]
    argv = [sys.executable, "-c", WITHIN, *map(str, words), "--processes", "1"]
    said = subprocess.run(argv, check=True, capture_output=True, text=True).stdout
    plain, asked, all_of_it = map(float, said.split())
    return plain / all_of_it, asked / all_of_it


def halves(dataset: Path) -> list[Path]:
    """Two folders with every other file of a data set each, as links."""
    found = [dataset.parent / f"half-{k}" for k in range(2)]
    for k, file in enumerate(sorted(dataset.iterdir())):
        found[k % 2].mkdir(exist_ok=True)
        (found[k % 2] / file.name).symlink_to(file)
    return found


def largest_of(command: int) -> float:
    """Most memory that a process, or one that it started, has held so far, MB."""
    found = [0.0]
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            said = dict(line.split(":", 1) for line in status.read_text().splitlines())
        except (OSError, ValueError):  # it has ended
            continue
        if "VmHWM" in said and command in (int(said["Pid"]), int(said["PPid"])):
            found.append(int(said["VmHWM"].split()[0]) / 1024)
    return max(found)


def in_memory(v: Any, misfit: bool) -> float:
    """Sensors per second of the processor."""
    began = process_time()
    calibrate_many(MODEL, {"v": v}, misfit=misfit)
    return len(v) / (process_time() - began)


def over_the_wire(v: Any) -> tuple[float, float]:
    """µs for each sensor to send its readings to a Dask worker, and for a memory copy of them."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        client.submit(len, v[:10]).result()
        took = []
        for k in range(TURNS):
            part = v.copy() + k  # Dask knows what it has sent before
            began = perf_counter()
            client.submit(len, client.scatter(part, direct=True)).result()
            took.append(perf_counter() - began)
    began = perf_counter()
    v.copy()
    return 1e6 * min(took) / len(v), 1e6 * (perf_counter() - began) / len(v)


def main() -> None:
    """One line for each size; then two processes, and the wire."""
    sizes = [int(word) for word in sys.argv[1:]] or [EACH, 10 * EACH]
    v = readings(50_000)
    in_memory(v[:5_000], True)
    with tempfile.TemporaryDirectory() as place:
        for size in sizes:
            dataset, out = Path(place) / "in", Path(place) / "out"
            write(dataset, size)
            turns = TURNS if size <= EACH else 1
            rates = [[], [], []]
            for turn in range(turns + 1):
                for _ in range(TURNS):
                    rates[0].append(in_memory(v, False))
                    rates[1].append(in_memory(v, True))
                if turn < turns:
                    spent, took, memory = command(dataset, out, 1)
                    rates[2].append(size / spent)
            plain, asked, fleet = (float(np.median(r)) for r in rates)
            print(
                f"{size} sensors: in memory {plain:.0f}/s, with misfit {asked:.0f}/s; Parquet to "
                f"Parquet {fleet:.0f}/s per core, {fleet / plain:.2f} and {fleet / asked:.2f} of "
                f"it; {took:.1f} s, {memory:.0f} MB",
                flush=True,
            )
            shares = within(dataset, out)
            print(f"  within one process: {shares[0]:.2f} and {shares[1]:.2f} of it", flush=True)
            if size > EACH:
                one = spent
                spent, took, memory = command(dataset, out, 2)
                apart = halves(dataset)
                own, _, _ = commands(apart, [half.with_suffix(".out") for half in apart], 1)
                print(
                    f"  two processes: {took:.1f} s, {spent:.1f} s of the processor, "
                    f"{one / spent:.2f} of the rate per core of one, {own / spent:.2f} of two "
                    f"commands at the same time; at most {memory:.0f} MB",
                    flush=True,
                )
                for half in apart:
                    shutil.rmtree(half)
            shutil.rmtree(dataset)
    wire, copy = over_the_wire(v)
    print(f"over the wire {wire:.2f} µs a sensor of {v[0].nbytes} bytes; a copy {copy:.2f} µs")


if __name__ == "__main__":
    main()
