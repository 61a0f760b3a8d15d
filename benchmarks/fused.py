"""The hand-written C kernel of fused_wheel.c, compiled with everything that makes it quick."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

SOURCE = Path(__file__).with_name("fused_wheel.c")
FLAGS = ["-O3", "-march=native", "-mprefer-vector-width=512", "-ffast-math"]
# Otherwise sin and cos of one angle become one scalar call.
FLAGS += ["-fno-builtin-sin", "-fno-builtin-cos", "-shared", "-fPIC", "-std=gnu11"]


def compiled(folder: Path) -> Any:
    """The library's function, or None where it cannot be built."""
    compiler = shutil.which(os.environ.get("CC") or "cc")
    if compiler is None:
        return None
    library = folder / "fused_wheel.so"
    words = [compiler, *FLAGS, str(SOURCE), "-o", str(library), "-lmvec", "-lm"]
    if subprocess.run(words, check=False).returncode:
        return None
    return ctypes.CDLL(str(library)).fused_wheel


class Fused:
    """(JᵀJ, Jᵀr, rᵀr) of the wheel from the C function `kernel`."""

    def __init__(self, kernel: Any, t: Any, v: Any) -> None:
        self.kernel, self.t = kernel, np.ascontiguousarray(t)
        self.v = np.ascontiguousarray(v.T)

    def __call__(self, x: Any) -> tuple[Any, Any, float]:
        """Sums at the unknowns x (15,)."""
        parts, x = np.zeros((3, 12, 12)), np.ascontiguousarray(x)
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in (x, self.t, self.v)]
        end = ctypes.c_long(len(self.t)), ctypes.c_void_p(parts.ctypes.data)
        self.kernel(*pointers, *end)
        whole = np.zeros((16, 16))
        for i in range(3):
            columns = [i, 3 + i, *range(6, 16)]
            whole[np.ix_(columns, columns)] += np.triu(parts[i]) + np.triu(parts[i], 1).T
        return whole[:15, :15], whole[:15, 15], float(whole[15, 15])
