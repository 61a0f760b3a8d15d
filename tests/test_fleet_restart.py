"""Restart and workers of `casest fleet`: the same bytes, whoever worked and whatever broke."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import time
from pathlib import Path

import fleets
import pytest

from casest.cli import run
from casest.dataset import partitions
from casest.tasks import task

#: Files of a data set, each of which is a partition, and sensors in each.
FILES, EACH = 12, 1000
SMALL = EACH * fleets.POSES * 3


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """A data set, and the files that an undisturbed run leaves."""
    folder = tmp_path_factory.mktemp("line")
    fleets.dataset(folder / "in", files=FILES, each=EACH)
    return folder / "in", undisturbed(folder)


def undisturbed(folder):
    finished(folder / "in", folder / "out")
    found = fleets.content(folder / "out")
    assert sum(name.startswith("results/") for name in found) == FILES
    return found


def words(dataset, out, *more):
    return [str(w) for w in (*fleets.WORDS, dataset, "-o", out, *fleets.NORM, *more)]


def started(dataset, out, *more):
    """Begin the command in a process of its own, which hands its partitions out slowly."""
    told = fleets.command(*words(dataset, out, *more), numbers=SMALL, slowly=True)
    return subprocess.Popen(told, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finished(dataset, out):
    """Run the command to its end, in this process alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(partitions, "NUMBERS", SMALL)
        assert run(words(dataset, out, "--processes", 1)) == 0


def results_of(out):
    return [*Path(out).glob("results/*.parquet")]


def after_the_first_result(out, going):
    """Wait until one partition is done, and not yet all."""
    until = time.monotonic() + 60
    while not results_of(out) and going.poll() is None:
        assert time.monotonic() < until
        time.sleep(0.005)


def children(process):
    """Processes that run tasks: those started with spawn, not what watches over shared memory."""
    threads = Path(f"/proc/{process.pid}/task").glob("*/children")
    listed = [k for thread in threads for k in thread.read_text().split()]
    return [int(k) for k in listed if b"spawn_main" in Path(f"/proc/{k}/cmdline").read_bytes()]


@pytest.mark.long
def test_a_worker_killed_in_the_middle_is_said_and_the_same_command_goes_on(line, tmp_path):
    dataset, expected = line
    going = started(dataset, tmp_path / "out", "--processes", 2)
    after_the_first_result(tmp_path / "out", going)
    os.kill(children(going)[0], signal.SIGKILL)
    _, error = going.communicate(timeout=60)
    assert going.returncode == 1
    assert "a worker process was killed" in error
    assert f"of {FILES} partitions are done and stay" in error
    kept = {p: p.stat().st_mtime_ns for p in results_of(tmp_path / "out")}
    assert 0 < len(kept) < FILES
    finished(dataset, tmp_path / "out")
    assert fleets.content(tmp_path / "out") == expected
    assert all(p.stat().st_mtime_ns == at for p, at in kept.items())


@pytest.mark.parametrize(
    "how", [pytest.param(signal.SIGKILL, marks=pytest.mark.long), signal.SIGINT]
)
def test_the_command_ended_in_the_middle_goes_on(line, tmp_path, how):
    dataset, expected = line
    going = started(dataset, tmp_path / "out", "--processes", 1)
    after_the_first_result(tmp_path / "out", going)
    going.send_signal(how)
    _, error = going.communicate(timeout=60)
    done = len(results_of(tmp_path / "out"))
    assert 0 < done < FILES
    assert not (tmp_path / "out" / "fleet.json").exists()
    if how == signal.SIGINT:
        assert going.returncode == 130
        assert f"interrupted; {done} of {FILES} partitions are done and stay in {tmp_path}" in error
    finished(dataset, tmp_path / "out")
    assert fleets.content(tmp_path / "out") == expected


def test_only_what_is_missing_or_has_changed_is_done_again(line, tmp_path, monkeypatch):
    dataset, expected = line
    monkeypatch.setattr(partitions, "NUMBERS", SMALL)
    told = words(dataset, tmp_path / "out", "--processes", 1)
    assert run(told) == 0
    done = sorted(results_of(tmp_path / "out"))
    done[2].unlink()
    asked = []

    def counted(job, partition):
        asked.append(partition.number)
        return task.run(job, partition)

    monkeypatch.setattr("casest.tasks.executors.run", counted)
    assert run(told) == 0
    assert asked == [2]
    assert fleets.content(tmp_path / "out") == expected
    file = sorted(dataset.iterdir())[5]
    os.utime(file)  # written again, whatever it holds
    assert run(told) == 0
    assert asked == [2, 5]
    assert fleets.content(tmp_path / "out") == expected


def test_results_of_input_that_is_gone_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(partitions, "NUMBERS", 100)
    fleets.dataset(tmp_path / "in", files=3, each=10)
    told = words(tmp_path / "in", tmp_path / "out", "--processes", 1)
    assert run(told) == 0
    (tmp_path / "in" / "part-1.parquet").unlink()
    assert run(told) == 0
    sensors = fleets.results(tmp_path / "out")["sensor"].to_pylist()
    assert sorted(sensors) == fleets.names(10) + fleets.names(10, 20)


@pytest.mark.long
def test_a_full_disk_is_said_and_the_same_command_goes_on(line, tmp_path):
    """A limit on the size of files fails each write as a full disk does."""
    import resource

    dataset, expected = line

    def no_room():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    told = fleets.command(*words(dataset, tmp_path / "out", "--processes", 1), numbers=SMALL)
    alone = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        told, capture_output=True, text=True, preexec_fn=no_room, check=False, env=alone
    )
    assert done.returncode == 1
    assert "cannot be written (File too large)" in done.stderr
    assert not results_of(tmp_path / "out")
    finished(dataset, tmp_path / "out")
    assert fleets.content(tmp_path / "out") == expected


# -- Dask ------------------------------------------------------------------------------------------


def test_no_scheduler_at_an_address_is_said_before_any_work(line, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("casest.tasks.executors.PATIENCE", 0.5)
    out = tmp_path / "out"
    assert run(words(line[0], out, "--scheduler", "tcp://127.0.0.1:9")) == 1
    said = capsys.readouterr().err
    assert "--scheduler tcp://127.0.0.1:9: no scheduler answers there within 0.5 s" in said
    assert not out.exists()
    assert run(words("line", out, "--scheduler", "tcp://127.0.0.1:9")) == 1
    assert "its workers may be in another folder; give line as /" in capsys.readouterr().err


@pytest.mark.long
def test_a_dask_worker_killed_in_the_middle_costs_nothing_but_time(line, tmp_path):
    """And two Dask workers write the bytes of one process."""
    dataset, expected = line
    going = started(dataset, tmp_path / "out", "--workers", 2)
    after_the_first_result(tmp_path / "out", going)
    os.kill(children(going)[0], signal.SIGKILL)
    _, error = going.communicate(timeout=100)
    assert going.returncode == 0, error
    assert "Dask dashboard: http://" in error
    assert fleets.content(tmp_path / "out") == expected


def test_what_a_worker_is_sent_pickles(line, tmp_path):
    from casest.cli.fleets import FleetOptions, planned
    from casest.results.find import find_model

    model = find_model("norm-triangular").having(norm=fleets.GRAVITY)
    plan, job = planned(model, str(line[0]), FleetOptions(output=tmp_path))
    again = pickle.loads(pickle.dumps((job, plan)))
    assert again == (job, plan)
    assert again[0].key(plan.partitions[0]) == job.key(plan.partitions[0])


@pytest.mark.long
def test_a_model_of_ones_own_file_reaches_every_worker(tmp_path):
    file = tmp_path / "own_triad.py"
    file.write_text(
        "from casest import Residual, model, norm_2, param, quantity, signal\n\n\n@model\n"
        'def own_triad(v=signal(3, "m/s^2"), *, offset=param(3, "m/s^2")):\n'
        '    """Three axes with an offset each."""\n'
        '    length = quantity("length", norm_2(v - offset), "m/s^2")\n'
        '    return Residual(implicit=length - 9.80665, unit="m/s^2", axes=("norm",))\n'
    )
    fleets.dataset(tmp_path / "in", files=2, each=150)
    told = ["fleet", file, tmp_path / "in", "-o", tmp_path / "out", "--processes", 2]
    subprocess.run(fleets.command(*told, numbers=SMALL), check=True, capture_output=True)
    found = fleets.results(tmp_path / "out")
    assert len(found) == 2 * 150
    assert {"offset[0]", "offset[2]_std"} <= set(found.column_names)
