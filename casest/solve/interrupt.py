"""Ctrl-C ends a search where it stands: the best point so far is kept, and not trusted.

CasADi swallows the exception inside IPOPT's callbacks, so the signal is remembered instead and
solvers look at it. A second Ctrl-C interrupts as usual.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_stop = threading.Event()


def stopped() -> bool:
    """Has Ctrl-C been pressed within `interruptible`?"""
    return _stop.is_set()


@contextmanager
def interruptible() -> Iterator[None]:
    """Within it Ctrl-C makes solvers stop; only the main thread gets signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def remember(_number: int, _frame: Any) -> None:
        if _stop.is_set():
            raise KeyboardInterrupt
        _stop.set()

    before = signal.signal(signal.SIGINT, remember)
    try:
        yield
    finally:
        _stop.clear()
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)
