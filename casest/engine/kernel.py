"""Least-squares sums compiled by the machine's C compiler, where there is one.

Built once per content (source, compiler, flags, processor) and kept in the user's cache folder
(`cache`); two processes that build at once each write a file of their own and rename it. A file
that is not whole, or that another user may have written, is built again. Whatever goes wrong, the
replay with NumPy takes over without a word: the numbers agree to rounding.

Environment: CASEST_KERNEL=off switches it off, =always builds it for small data too;
CASEST_CACHE names the folder; CC the compiler.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from casest.engine.cache import kernel_folder, own_file
from casest.engine.emit import source, source_of_sum, source_of_values
from casest.engine.operations import Floats
from casest.engine.replay import Columns, Entry, Replay

T = TypeVar("T")
U = TypeVar("U")

#: A kernel is built for at least this many samples: below, compiling costs more than it saves.
WORTHWHILE = 5_000
#: The same for what is evaluated once or twice in a fit, and has up to SMALL instructions: the time
#: that compilers take grows faster than their number.
SELDOM, SMALL = 10_000, 1_000
#: Samples summed on their own, to keep rounding small and to share the work between cores.
PIECE = 32_768
#: Pieces whose sums are kept side by side until they are added.
PIECES = 4096
#: The first set that compiles and runs is used. No -ffast-math: it would hide what is not finite.
_FLAGS = (
    # -O3 would unroll whole chunks: three times as long to compile, and no quicker.
    ["-O2", "-ftree-loop-vectorize", "-fvect-cost-model=unlimited", "-march=native",
     "-mprefer-vector-width=512", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast",
     "-DSIMD_MATH",
     # Otherwise sin and cos of one angle become a call of sincos, which is scalar.
     "-fno-builtin-sin", "-fno-builtin-cos", "-lmvec"],
    ["-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"],
    ["-O2"],
)  # fmt: skip


#: Values of single samples: no contraction, so that the digits are those of NumPy.
_SAME_DIGITS = (
    ["-O2", "-ftree-loop-vectorize", "-fvect-cost-model=unlimited", "-march=native",
     "-mprefer-vector-width=512", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off"],
    ["-O2", "-ffp-contract=off"],
)  # fmt: skip
#: Samples, in all calls together, from which on values of single samples are compiled.
OFTEN = 100_000

#: Samples from which on a kernel is built for a model that is only tried.
TRIED = 100_000
_tried: ContextVar[bool] = ContextVar("tried", default=False)


@contextmanager
def only_tried(yes: bool = True) -> Iterator[None]:
    """While many models are tried, none is compiled unless the record is very long.

    Within it, `only_tried(False)`: what is to be proved is evaluated often, and compiled.
    """
    token = _tried.set(yes)
    try:
        yield
    finally:
        _tried.reset(token)


class Kernel:
    """Compiled `cost`, `normal` and `values` of one function; sums as `normal` lays them out."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self.count = ctypes.c_int.in_dll(library, "casest_normal_count").value

    def cost(self, parameters: Floats, samples: Columns, weights: Floats | None) -> float:
        """Σ w r² over all samples."""
        return float(self._summed("casest_cost", 1, parameters, samples, weights)[0])

    def products(self, parameters: Floats, samples: Columns, weights: Floats | None) -> Floats:
        """Upper triangles of Σ w a aᵀ of every component, one after the other."""
        return self._summed("casest_normal", self.count, parameters, samples, weights)

    def values(self, parameters: Floats, samples: Columns, entries: int) -> Floats:
        """Every entry of every sample, (entries, N)."""
        return self._each("casest_values_all", parameters, samples, entries)

    def residuals(self, parameters: Floats, samples: Columns, count: int) -> Floats:
        """Every residual of every sample, (count, N)."""
        return self._each("casest_values_residual", parameters, samples, count)

    def records(
        self, parameters: Floats, samples: Columns, width: int, *, full: bool = False
    ) -> Floats:
        """All outputs of every sample, (N, width), as dense ones one after the other; `full`: is
        none of their entries zero for good?"""
        result = (np.empty if full else np.zeros)((len(samples), width))
        self._call("casest_records", parameters, samples, slice(0, len(samples)), None, result)
        return result

    def sums(self, parameters: Floats, samples: Columns) -> Floats:
        """Each entry of an output, added over all samples."""
        return self._summed("casest_sum", self.count, parameters, samples, None)

    def _each(self, name: str, parameters: Floats, samples: Columns, entries: int) -> Floats:
        result = np.empty((entries, len(samples)))
        self._call(name, parameters, samples, slice(0, len(samples)), None, result)
        return result

    def _summed(
        self,
        name: str,
        count: int,
        parameters: Floats,
        samples: Columns,
        weights: Floats | None,
    ) -> Floats:
        """Sums over pieces, then over PIECES of them, each in its order: the same digits on any
        number of cores, in memory that does not grow with the record."""
        starts, total = range(0, len(samples), PIECE), np.zeros(count)
        for first in range(0, len(starts), PIECES):
            own = starts[first : first + PIECES]
            parts = np.zeros((len(own), count))

            def piece(k: int, own: range = own, parts: Floats = parts) -> None:
                span = slice(own[k], min(own[k] + PIECE, len(samples)))
                self._call(name, parameters, samples, span, weights, parts[k])

            if len(own) > 2 and workers() > 1:
                list(_threads(workers()).map(piece, range(len(own))))
            else:
                for k in range(len(own)):
                    piece(k)
            total = parts.sum(axis=0) if not first else total + parts.sum(axis=0)
        return np.asarray(total)

    def _call(
        self,
        name: str,
        parameters: Floats,
        samples: Columns,
        span: slice,
        weights: Floats | None,
        result: Floats,
    ) -> None:
        """Let the function `name` fill `result` from the samples of a slice."""
        parameters = np.ascontiguousarray(parameters, dtype=float)
        first, steps, _held = _places(samples, span)
        w = None if weights is None else np.ascontiguousarray(weights[span], dtype=float)
        getattr(self._library, name)(
            ctypes.c_void_p(parameters.ctypes.data),
            (ctypes.c_void_p * max(len(first), 1))(*first),
            (ctypes.c_ssize_t * max(len(steps), 1))(*steps),
            ctypes.c_ssize_t(span.stop - span.start),
            None if w is None else ctypes.c_void_p(w.ctypes.data),
            ctypes.c_void_p(result.ctypes.data),
        )


def _places(samples: Columns, span: slice) -> tuple[list[int], list[int], list[Floats]]:
    """Where each column's slice begins, its stride in numbers, and what must outlive the call."""
    if samples.plain is None:
        samples.plain = _plain(samples)
    if samples.plain:
        first = [start + span.start * 8 * step for start, step in samples.plain]
        return first, [step for _, step in samples.plain], samples.columns
    copies = [np.ascontiguousarray(c[span], dtype=np.float64) for c in samples.columns]
    return [c.ctypes.data for c in copies], [1] * len(copies), copies


def _plain(samples: Columns) -> list[tuple[int, int]]:
    """Address and stride (in numbers) of every column; empty if C cannot read one as it lies."""
    for c in samples.columns:
        if not (c.dtype == np.float64 and c.strides[0] % 8 == 0 and c.flags.aligned):
            return []
    return [(c.ctypes.data, c.strides[0] // 8) for c in samples.columns]


def kernel_for(
    replay: Replay, layout: Callable[[Replay], list[list[Entry]]], samples: int
) -> Kernel | None:
    """The compiled kernel of a replayed function; None where NumPy has to do.

    `layout` lists for each residual its entries of the Jacobian and then itself.
    """
    return _kernel(replay, -1, samples, WORTHWHILE, lambda: source(replay, layout(replay)))


def kernel_of_sum(replay: Replay, output: int, samples: int) -> Kernel | None:
    """The compiled sum of one output of a replayed function; None where NumPy has to do."""
    size = len(replay.plan(replay.entries(output)).steps)
    enough = round(SELDOM * max(1.0, size / SMALL) ** 2)
    return _kernel(replay, output, samples, enough, lambda: source_of_sum(replay, output))


def _kernel(
    replay: Replay, which: int, samples: int, enough: int, text: Callable[[], str]
) -> Kernel | None:
    wish = os.environ.get("CASEST_KERNEL", "auto")
    if _tried.get():
        enough = max(enough, TRIED)
    if wish == "off":
        return None
    if which not in replay.kernels:
        if samples < enough and wish != "always":
            return None
        replay.kernels[which] = _made(text())
    found: Kernel | None = replay.kernels[which]
    return found


def evaluated(replay: Replay, parameters: Floats, samples: Columns) -> list[Floats]:
    """Each output of every sample, dense: (N, rows, columns), with the digits of the replay but for
    the last of a sine and its like.

    Compiled where so many samples were asked for, in all calls together, that it is worthwhile.
    """
    kernel = _values_kernel(replay, len(samples))
    if kernel is None or not len(samples):
        return replay(parameters, samples)
    parameters, samples = replay.check(parameters, samples)
    ends = np.cumsum([0, *(rows * columns for rows, columns in replay.shapes)]).tolist()
    full = sum(len(rows) for rows, _ in replay.sparsity) == ends[-1]
    whole = kernel.records(parameters, samples, ends[-1], full=full)
    places = zip(pairwise(ends), replay.shapes, strict=True)
    return [whole[:, a:b].reshape(-1, *shape) for (a, b), shape in places]


@dataclass
class _Values:
    """How many samples were asked for, what was tried, and what came of it."""

    seen: int = 0
    looked: bool = False
    built: bool = False
    kernel: Kernel | None = None


def _values_kernel(replay: Replay, samples: int) -> Kernel | None:
    own: _Values = replay.made.setdefault(evaluated, _Values())
    own.seen += samples
    wish = os.environ.get("CASEST_KERNEL", "auto")
    if wish == "off":
        return None
    due = wish == "always" or own.seen > (10 * TRIED if _tried.get() else OFTEN)
    if own.kernel is None and (due > own.built or (own.seen > WORTHWHILE and not own.looked)):
        own.looked, own.built = True, due
        found = library(source_of_values(replay), _SAME_DIGITS, build=due)
        own.kernel = None if found is None else Kernel(found)
    return own.kernel


def _made(text: str) -> Kernel | None:
    found = library(text, _FLAGS)
    return None if found is None else Kernel(found)


def library(text: str, flag_sets: Sequence[list[str]], *, build: bool = True) -> ctypes.CDLL | None:
    """C source as a loaded library: from the cache folder, or compiled with the first flags that
    work (with `build`); None where neither can be."""
    compiler = compiler_found()
    if compiler is None:
        return None
    try:
        folder = kernel_folder()
        if folder is None:
            return None
        machine = [compiler, compiler_version(compiler), _processor()]
        paths = [folder / f"{_key([text, *machine, *flags])}.so" for flags in flag_sets]
        for path in paths:
            if own_file(path) and _whole(path):
                return ctypes.CDLL(str(path))
        for flags, path in zip(flag_sets if build else [], paths, strict=False):
            if _compiled(compiler, text, flags, path):
                return ctypes.CDLL(str(path))
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
    return None


def compiles() -> bool:
    """Can a kernel be compiled, kept and loaded here?"""
    return library("int casest_compiles(void) { return 1; }\n", _FLAGS) is not None


def _key(parts: list[str]) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]


def _whole(path: Path) -> bool:
    """Is the file there, ending with the digest of the rest? To load half of one ends the process.

    A loader reads only what the file's own tables list, and never sees the digest.
    """
    try:
        content = path.read_bytes()
    except OSError:
        return False
    return hashlib.sha256(content[:-32]).digest() == content[-32:]


def _compiled(compiler: str, text: str, flags: list[str], path: Path) -> bool:
    """Compile next to `path` and rename: another process sees all of the file or nothing."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        written, made = Path(folder) / "kernel.c", Path(folder) / "kernel.so"
        written.write_text(text)
        options = [f for f in flags if not f.startswith("-l")]
        libraries = [f for f in flags if f.startswith("-l")]
        words = [compiler, "-shared", "-fPIC", "-std=gnu11", "-w", *options]
        words += [str(written), "-o", str(made), *libraries, "-lm"]
        done = subprocess.run(words, capture_output=True, timeout=120, check=False)
        if done.returncode != 0:
            return False
        with made.open("r+b") as file:
            digest = hashlib.sha256(file.read()).digest()
            file.write(digest)
        os.chmod(made, 0o700)
        os.replace(made, path)
        return True


def compiler_found() -> str | None:
    """Path of the C compiler: CC, else cc, gcc or clang; None where there is none."""
    named = os.environ.get("CC")
    for name in [named] if named else ["cc", "gcc", "clang"]:
        found = shutil.which(name) if name else None
        if found:
            return found
    return None


@lru_cache(maxsize=4)
def compiler_version(compiler: str) -> str:
    """The first line of what the compiler says of itself."""
    done = subprocess.run([compiler, "--version"], capture_output=True, timeout=20, check=False)
    return done.stdout.decode(errors="replace").partition("\n")[0]


@lru_cache(maxsize=1)
def _processor() -> str:
    """What -march=native depends on: a cache on a shared disk must not serve another machine."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()} {platform.node()}"
    wanted = ("model name", "flags", "Features", "CPU part")
    return "\n".join(sorted({line for line in lines if line.startswith(wanted)}))


@lru_cache(maxsize=1)
def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def workers() -> int:
    """How many threads add up a record: as many as there are cores, unless told."""
    return _told.get() or _cores()


@contextmanager
def by_workers(count: int | None) -> Iterator[None]:
    """Within it a record is added up by so many threads (None: one for each core)."""
    before = _told.set(count)
    try:
        yield
    finally:
        _told.reset(before)


def in_order(task: Callable[[T], U], items: Sequence[T]) -> Iterator[U]:
    """What a task makes of each item, in their order, whoever works."""
    return iter(map(task, items) if workers() == 1 else _threads(workers()).map(task, items))


_told: ContextVar[int | None] = ContextVar("workers", default=None)


@lru_cache(maxsize=2)
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="casest")


if hasattr(os, "register_at_fork"):
    # A forked process has none of its parent's threads, and would wait for them for ever.
    os.register_at_fork(after_in_child=_threads.cache_clear)
