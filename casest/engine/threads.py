"""One BLAS thread: the matrices are small, and threads that wait for each other burn the cores.

On two busy cores a factorisation of 54 000 rows took five times as long with OpenBLAS's two threads
as with one.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[Any]:
    """A context in which linear algebra runs in the calling thread alone."""
    limited: AbstractContextManager[Any] = _controller().limit(limits=1, user_api="blas")
    return limited


def pools() -> list[dict[str, Any]]:
    """Libraries of linear algebra that are loaded, as threadpoolctl describes them."""
    found: list[dict[str, Any]] = _controller().info()
    return found
