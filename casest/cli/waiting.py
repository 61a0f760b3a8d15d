"""What is going on, on a terminal, while something takes longer than a second."""

from __future__ import annotations

import shutil
import sys
import threading
import time

from casest.escaping import one_line

PATIENCE = 1.0  # s before anything is said
_TICK = 0.5  # s between two looks at the clock


class Waiting:
    """One line that says what is going on and for how long; wiped away when it is over.

    Nothing is written where standard error is no terminal, nor before PATIENCE seconds.
    """

    def __init__(self) -> None:
        self._words = ""
        self._begin = 0.0
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._width = 0

    def say(self, words: str) -> None:
        """What is going on from now on; the clock starts with the first words."""
        self._words = one_line(words)
        if self._thread is None and sys.stderr is not None and sys.stderr.isatty():
            self._begin, self._width = time.monotonic(), 0
            self._over.clear()
            self._thread = threading.Thread(target=self._watch, daemon=True)
            self._thread.start()

    def done(self) -> None:
        """Wipe the line away: what is printed next stands alone."""
        if self._thread is None:
            return
        self._over.set()
        self._thread.join()
        self._thread = None
        if self._width:
            self._write(" " * self._width)

    def _watch(self) -> None:
        while not self._over.wait(_TICK):
            seconds = time.monotonic() - self._begin
            if seconds >= PATIENCE:
                self._show(f"casest: {self._words} … {seconds:.0f} s")

    def _show(self, text: str) -> None:
        room = shutil.get_terminal_size().columns - 1
        text = text if len(text) <= room else text[: room - 1] + "…"
        self._width = max(self._width, len(text))
        self._write(text.ljust(self._width))

    def _write(self, text: str) -> None:
        sys.stderr.write(f"\r{text}\r")
        sys.stderr.flush()
