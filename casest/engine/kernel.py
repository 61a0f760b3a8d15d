"""Least-squares sums compiled by the machine's C compiler, where there is one.

Built once per content (source, compiler, flags, processor) and kept in the user's cache folder;
two processes that build at once each write a file of their own and rename it. Whatever goes wrong,
the replay with NumPy takes over without a word: the numbers agree to rounding.

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
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path

import numpy as np

from casest.engine.emit import source, source_of_sum
from casest.engine.replay import Columns, Entry, Floats, Replay

#: A kernel is built for at least this many samples: below, compiling costs more than it saves.
WORTHWHILE = 5_000
#: The same for what is evaluated once or twice in a fit.
SELDOM = 200_000
#: Samples summed on their own, to keep rounding small and to share the work between cores.
PIECE = 32_768
#: The first set that compiles and runs is used. No -ffast-math: it would hide what is not finite.
_FLAGS = (
    ["-O3", "-march=native", "-mprefer-vector-width=512", "-fno-math-errno", "-fno-trapping-math",
     "-ffp-contract=fast", "-DSIMD_MATH",
     # Otherwise sin and cos of one angle become a call of sincos, which is scalar.
     "-fno-builtin-sin", "-fno-builtin-cos", "-lmvec"],
    ["-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"],
    ["-O2"],
)  # fmt: skip
_POINTER = ctypes.POINTER(ctypes.c_double)


#: Samples from which on a kernel is built for a model that is only tried.
TRIED = 400_000
_impatient: ContextVar[bool] = ContextVar("impatient", default=False)


@contextmanager
def patient() -> Iterator[None]:
    """While many models are tried, none is compiled unless the record is very long."""
    token = _impatient.set(True)
    try:
        yield
    finally:
        _impatient.reset(token)


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

    def sums(self, parameters: Floats, samples: Columns) -> Floats:
        """Each entry of an output, added over all samples."""
        return self._summed("casest_sum", self.count, parameters, samples, None)

    def _each(self, name: str, parameters: Floats, samples: Columns, entries: int) -> Floats:
        result = np.empty((entries, len(samples)))
        self._call(name, parameters, samples, None, result)
        return result

    def _summed(
        self,
        name: str,
        count: int,
        parameters: Floats,
        samples: Columns,
        weights: Floats | None,
    ) -> Floats:
        """Sums over pieces, added in their order: the same digits on any number of cores."""
        starts = range(0, len(samples), PIECE)
        parts = np.zeros((len(starts), count))

        def piece(k: int) -> None:
            span = slice(starts[k], min(starts[k] + PIECE, len(samples)))
            w = None if weights is None else weights[span]
            self._call(name, parameters, samples[span], w, parts[k])

        if len(starts) > 2 and _cores() > 1:
            list(_threads().map(piece, range(len(starts))))
        else:
            for k in range(len(starts)):
                piece(k)
        return np.asarray(parts.sum(axis=0))

    def _call(
        self,
        name: str,
        parameters: Floats,
        samples: Columns,
        weights: Floats | None,
        result: Floats,
    ) -> None:
        parameters = np.ascontiguousarray(parameters, dtype=float)
        columns = [_usable(column) for column in samples.columns]
        k = len(columns)
        pointers = (_POINTER * max(k, 1))(*(ctypes.cast(c.ctypes.data, _POINTER) for c in columns))
        strides = (ctypes.c_ssize_t * max(k, 1))(*(c.strides[0] // 8 for c in columns))
        w = None
        if weights is not None:
            weights = np.ascontiguousarray(weights, dtype=float)
            w = weights.ctypes.data_as(_POINTER)
        getattr(self._library, name)(
            parameters.ctypes.data_as(_POINTER),
            pointers,
            strides,
            ctypes.c_ssize_t(len(samples)),
            w,
            result.ctypes.data_as(_POINTER),
        )


def _usable(column: Floats) -> Floats:
    """The column as it is where the kernel can read it, else a copy."""
    plain = column.dtype == np.float64 and column.dtype.isnative
    if plain and column.strides[0] % 8 == 0 and column.flags.aligned:
        return column
    return np.ascontiguousarray(column, dtype=np.float64)


def kernel_for(
    replay: Replay, layout: Callable[[Replay], list[list[Entry]]], samples: int
) -> Kernel | None:
    """The compiled kernel of a replayed function; None where NumPy has to do.

    `layout` lists for each residual its entries of the Jacobian and then itself.
    """
    return _kernel(replay, -1, samples, WORTHWHILE, lambda: source(replay, layout(replay)))


def kernel_of_sum(replay: Replay, output: int, samples: int) -> Kernel | None:
    """The compiled sum of one output of a replayed function; None where NumPy has to do."""
    return _kernel(replay, output, samples, SELDOM, lambda: source_of_sum(replay, output))


def _kernel(
    replay: Replay, which: int, samples: int, enough: int, text: Callable[[], str]
) -> Kernel | None:
    wish = os.environ.get("CASEST_KERNEL", "auto")
    if wish == "off":
        return None
    if which not in replay.kernels:
        if samples < (TRIED if _impatient.get() else enough) and wish != "always":
            return None
        replay.kernels[which] = _made(text())
    found: Kernel | None = replay.kernels[which]
    return found


def _made(text: str) -> Kernel | None:
    compiler = _compiler()
    if compiler is None:
        return None
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        for flags in _FLAGS:
            key = "\n".join([text, compiler, _version(compiler), _processor(), *flags])
            path = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.so"
            if path.exists() or _compiled(compiler, text, flags, path):
                return Kernel(ctypes.CDLL(str(path)))
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
    return None


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
        os.replace(made, path)
        return True


@lru_cache(maxsize=1)
def _compiler() -> str | None:
    named = os.environ.get("CC")
    for name in [named] if named else ["cc", "gcc", "clang"]:
        found = shutil.which(name) if name else None
        if found:
            return found
    return None


@lru_cache(maxsize=4)
def _version(compiler: str) -> str:
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


def cache_folder() -> Path:
    """Where compiled kernels are kept."""
    named = os.environ.get("CASEST_CACHE")
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "casest"


@lru_cache(maxsize=1)
def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), thread_name_prefix="casest")
