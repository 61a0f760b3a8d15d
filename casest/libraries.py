"""Libraries that are installed only where they are wanted: extras of the package."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from casest.errors import UsageError


def library(name: str, extra: str, what: str = "this") -> Any:
    """Return the module `name`; where it is missing, UsageError says how `extra` is installed."""
    try:
        return import_module(name)
    except ImportError:
        top = name.partition(".")[0]
        raise UsageError(f"{what} needs the library {top}: pip install 'casest[{extra}]'") from None
