"""Ctrl-C: it ends what is going on, wherever it is pressed, and nobody swallows it.

Python raises KeyboardInterrupt between two of its own instructions. Inside a callback from another
library that is no safe place: CasADi drops the exception and searches on. So around such calls it
is held back, and the callbacks ask whether it `waits`. The command line remembers it besides, so
that nothing is written, and no success reported, after it was pressed.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_waiting = threading.Event()
_pressed = threading.Event()


def waits() -> bool:
    """Has Ctrl-C been pressed where it is `held_back`?"""
    return _waiting.is_set()


@contextmanager
def held_back() -> Iterator[None]:
    """Within it Ctrl-C is remembered; it takes effect at the end. A second one does at once."""
    before = signal.getsignal(signal.SIGINT)
    if not callable(before) or threading.current_thread() is not threading.main_thread():
        yield  # signals reach the main thread alone, and nobody who ignores them
        return
    pressed = False

    def remember(number: int, frame: Any) -> None:
        nonlocal pressed
        again, pressed = pressed, True
        _waiting.set()
        if again:
            before(number, frame)

    signal.signal(signal.SIGINT, remember)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        _waiting.clear()
        if pressed:
            before(signal.SIGINT, None)


def remember() -> None:
    """For a program of its own: Ctrl-C raises KeyboardInterrupt, and is known if that is lost.

    A second one ends the process as the system does, even within another library's code.
    """
    if callable(signal.getsignal(signal.SIGINT)):  # else started with Ctrl-C switched off
        signal.signal(signal.SIGINT, _interrupt)
        sys.unraisablehook = _again


def _again(lost: sys.UnraisableHookArgs) -> None:
    """Where Python can only drop an exception (a finaliser, a weak reference), Ctrl-C is repeated.

    A moment later: raised in this very function it would be dropped once more.
    """
    if not isinstance(lost.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    signal.signal(signal.SIGINT, _interrupt)
    repeat = threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT))
    repeat.daemon = True
    repeat.start()


def _interrupt(_number: int, _frame: Any) -> None:
    _pressed.set()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    raise KeyboardInterrupt


def too_late() -> None:
    """From here on Ctrl-C changes nothing; KeyboardInterrupt if it was pressed before."""
    if signal.getsignal(signal.SIGINT) is _interrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if _pressed.is_set():
        raise KeyboardInterrupt
