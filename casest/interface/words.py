"""Errors and remarks as a Python caller can act on them: arguments in place of options."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from casest.errors import CasestError

_VALUE = r"(\w[\w.]*)=([^\s;,)]*[^\s;,):](?:,[^\s;,)]*[^\s;,):])*)"
#: An option of the command line, and what Python says instead.
_WORDS = (
    (rf"--columns {_VALUE}", r'columns={"\1": "\2"}'),
    (rf"--unit {_VALUE}", r'units={"\1": "\2"}'),
    (rf"--scale {_VALUE}", r'scales={"\1": "\2"}'),
    (rf"--(?:fix|set) {_VALUE}", r"model.having(\1=\2)"),
    (rf"--start {_VALUE}", r'start={"\1": \2}'),
    (r"--free (\w+)", r'model.freed("\1")'),
    (r"--rate HZ", "rate=HZ"),
    (r"--rate (\d[\d.]*)", r"rate=\1"),
    (r"--(columns|rate|start|solver|seed)\b", r"\1=…"),
    (r"--unit\b", "units=…"),
    (r"--scale\b", "scales=…"),
    (r"--at-rest\b", "at_rest=True"),
    (r"`casest close`", "`casest.close`"),
)


def in_python(text: str) -> str:
    """The text with options of the command line as arguments."""
    for option, argument in _WORDS:
        text = re.sub(option, argument, text)
    return text


@contextmanager
def as_python_says() -> Iterator[None]:
    """Errors within it name arguments, not options."""
    try:
        yield
    except CasestError as error:
        error.args = (in_python(str(error)), *error.args[1:])
        raise
