"""A loop over samples in C, for matrices of any size: NumPy's calls on small ones take longer.

Compiling is done once so much has been computed without; what is in the cache folder already is
used at once. Environment: as for the kernels.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence

from casest.engine.kernel import library
from casest.engine.operations import Floats

#: Steps from which on a compiler is worthwhile.
WORTHWHILE = 20_000
_FLAGS = [["-O3", "-march=native", "-ffp-contract=off"], ["-O2", "-ffp-contract=off"]]


class Compiled:
    """A C function (double *…, long …), compiled when it is worthwhile."""

    def __init__(self, name: str, source: str) -> None:
        self.name, self.source = name, source
        self._library: ctypes.CDLL | None = None
        self._seen = 0
        self._looked = self._built = False

    def ready(self, count: int) -> bool:
        """Can it be called for so many steps?"""
        wish = os.environ.get("CASEST_KERNEL", "auto")
        if wish == "off":
            return False
        self._seen += count
        due = wish == "always" or self._seen > WORTHWHILE
        if self._library is None and (due > self._built or not self._looked):
            self._looked, self._built = True, due
            self._library = library(self.source, _FLAGS, build=due)
        return self._library is not None

    def __call__(self, arrays: Sequence[Floats], sizes: Sequence[int]) -> None:
        """With contiguous arrays, some of which it fills, and numbers."""
        given = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
        getattr(self._library, self.name)(*given, *map(ctypes.c_long, sizes))
