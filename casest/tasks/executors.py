"""Who runs the tasks: processes on this machine, or Dask. There is no scheduler of our own.

An executor takes the job and its partitions, and yields the numbers of those that are done, in any
order. What it is told twice, it may do twice: a task writes the same bytes each time.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from multiprocessing import get_context
from typing import Any, Protocol

from casest.dataset.partitions import Partition
from casest.errors import CasestError, UsageError, last_line, library
from casest.tasks.job import Job
from casest.tasks.task import run

#: Tasks that wait for each worker: more would only fill the memory of who hands them out.
WAITING = 3
#: Seconds in which a scheduler must answer.
PATIENCE = 10.0


class Stopped(CasestError):
    """Not all partitions are done; those that are stay, and the same command goes on."""


class Executor(Protocol):
    """Runs tasks."""

    def __call__(self, job: Job, partitions: Iterable[Partition]) -> Iterator[int]:
        """Numbers of partitions, each as it is done."""
        ...


def here(job: Job, partitions: Iterable[Partition]) -> Iterator[int]:
    """One after the other, in this process."""
    for partition in partitions:
        yield run(job, partition)


@dataclass(frozen=True)
class Processes:
    """`count` processes on this machine, that start empty: nothing is shared but the files."""

    count: int

    def __call__(self, job: Job, partitions: Iterable[Partition]) -> Iterator[int]:
        """Numbers of partitions, each as it is done."""
        sent = pickle.dumps(job)
        pool = ProcessPoolExecutor(
            self.count, mp_context=get_context("spawn"), initializer=_begin, initargs=(sent,)
        )
        try:
            yield from _windowed(pool, partitions, self.count * WAITING)
        except BrokenProcessPool:
            raise Stopped(
                "a worker process was killed, by somebody or for want of memory (fewer "
                "--processes need less)"
            ) from None
        finally:
            _end(pool)


@dataclass(frozen=True)
class Dask:
    """Workers of a Dask scheduler."""

    client: Any

    def __call__(self, job: Job, partitions: Iterable[Partition]) -> Iterator[int]:
        """Numbers of partitions, each as it is done."""
        from distributed import as_completed

        sent = self.client.scatter(pickle.dumps(job), broadcast=True, hash=True)
        rest = iter(partitions)
        workers = max(1, len(self.client.scheduler_info()["workers"]))

        def submitted(partition: Partition) -> Any:
            return self.client.submit(remote, sent, partition, key=f"casest-{job.key(partition)}")

        first = [submitted(p) for p in islice(rest, workers * WAITING)]
        going = as_completed(first, loop=self.client.loop)
        for future in going:
            try:
                yield future.result()
            except CasestError:
                raise
            except Exception as error:
                text = f"{type(error).__name__}: {last_line(error)}"
                raise Stopped(f"a Dask worker did not finish ({text})") from None
            for partition in islice(rest, 1):
                going.add(submitted(partition))


@contextmanager
def dask(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """A Dask client: of the scheduler at an address, or of one started here with some workers.

    Raises UsageError where no scheduler answers there.
    """
    asked = f"--scheduler {scheduler}" if scheduler else f"--workers {workers}"
    distributed = library("distributed", "fleet", asked)
    if scheduler:
        try:
            client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise UsageError(
                f"--scheduler {scheduler}: no scheduler answers there within {PATIENCE:g} s "
                f"({last_line(error)}); start one with `dask scheduler`, and give its tcp://…"
            ) from None
        with client:
            yield client
        return
    with _unheard():
        started = distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=":0",
            silence_logs=logging.CRITICAL,
        )
    with (
        started as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextmanager
def _unheard() -> Iterator[None]:
    """Processes that are started within it do not hear Ctrl-C: it is their parent's to answer."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def remote(sent: bytes, partition: Partition) -> int:
    """A task as another process runs it: the job is unpickled, and its model traced, once there."""
    return run(_job(sent), partition)


@lru_cache(maxsize=4)
def _job(sent: bytes) -> Job:
    job: Job = pickle.loads(sent)
    return job


_sent = b""


def _begin(sent: bytes) -> None:
    """What each process does first. Ctrl-C is its parent's to answer."""
    global _sent
    _sent = sent
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _next(partition: Partition) -> int:
    return remote(_sent, partition)


def _windowed(
    pool: ProcessPoolExecutor, partitions: Iterable[Partition], width: int
) -> Iterator[int]:
    """Hand tasks out as others are done."""
    rest = iter(partitions)
    going: set[Future[int]] = {pool.submit(_next, p) for p in islice(rest, width)}
    while going:
        done, going = wait(going, return_when=FIRST_COMPLETED)
        for future in done:
            yield future.result()
            going |= {pool.submit(_next, p) for p in islice(rest, 1)}


def _end(pool: ProcessPoolExecutor) -> None:
    """At once, whatever is going on: what is half done has no name yet."""
    processes = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()
    for process in processes:
        process.join()
