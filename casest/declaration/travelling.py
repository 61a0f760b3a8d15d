"""Models and effects on their way to another process: declaration and arrays, never symbols.

CasADi's symbols do not pickle; a model is traced anew where it arrives. Its functions go by the
name under which their module has them (`@model` puts a model in the place of the function, which
holds it). A user's own file is no module that another process could import: its source goes along,
and is run there once.
"""

from __future__ import annotations

import hashlib
import linecache
import sys
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from casest.errors import DeclarationError, UsageError, last_line

#: Modules made from a user's file, which have no other name.
OWN = "casest_user_"


@dataclass(frozen=True)
class Reference:
    """Where a function is: module, name in it, and the fields that lead on from there."""

    module: str
    path: tuple[str, ...]
    #: File and text of a module that cannot be imported by name.
    file: str = ""
    source: str = ""

    def found(self) -> Any:
        """The function itself."""
        here: Any = _own(self.module, self.file, self.source) if self.source else _named(self)
        for name in self.path:
            here = getattr(here, name)
        return here


def reduced(declared: Any) -> tuple[Any, ...]:
    """For `__reduce__` of a frozen dataclass that holds functions: its class and its fields."""
    content = {f.name: _packed(getattr(declared, f.name)) for f in fields(declared)}
    return _restored, (type(declared), content)


def fingerprint(declared: Any) -> str:
    """SHA-256 of a declaration: names, shapes, numbers, and the sources of its functions."""
    whole = hashlib.sha256()
    for part in _spelled(declared):
        whole.update(part.encode())
        whole.update(b"\0")
    return whole.hexdigest()


def _restored(kind: type, content: dict[str, Any]) -> Any:
    return kind(**{name: _unpacked(value) for name, value in content.items()})


def _packed(value: Any) -> Any:
    """Functions, also those in tuples, as references."""
    if isinstance(value, FunctionType):
        return reference(value)
    return tuple(map(_packed, value)) if type(value) is tuple else value


def _unpacked(value: Any) -> Any:
    if isinstance(value, Reference):
        return value.found()
    return tuple(map(_unpacked, value)) if type(value) is tuple else value


def reference(function: FunctionType) -> Reference:
    """How another process finds a function. UsageError where it has no name of its own there."""
    module = sys.modules.get(function.__module__)
    path = None if module is None else _path(module, function)
    if module is None or path is None:
        raise UsageError(
            f"{function.__qualname__} of {function.__module__} cannot be sent to another process: "
            "it is made inside another function; declare it at the top level of its file"
        )
    if not (module.__name__.startswith(OWN) or module.__name__ == "__main__"):
        return Reference(module.__name__, path)
    return Reference(_plain(module), path, *_text(module))


def _path(module: ModuleType, function: FunctionType) -> tuple[str, ...] | None:
    """Names that lead from a module to the function; None where none do."""
    first = function.__qualname__
    for name in (first, *(n for n in vars(module) if n != first)):
        held = vars(module).get(name)
        if held is function:
            return (name,)
        if (rest := _within(held, function)) is not None:
            return (name, *rest)
    return None


def _within(held: Any, function: FunctionType) -> tuple[str, ...] | None:
    """The same from a model or effect that holds it, or holds another that does."""
    if not is_dataclass(held) or isinstance(held, type):
        return None
    for f in fields(held):
        value = getattr(held, f.name)
        if value is function:
            return (f.name,)
        if type(value) is type(held) and (rest := _within(value, function)) is not None:
            return (f.name, *rest)
    return None


def _plain(module: ModuleType) -> str:
    """What its file is called, without what tells it from others of that name."""
    return str(getattr(module, "casest_origin", module.__name__))


def _text(module: ModuleType) -> tuple[str, str]:
    """File and source of a module that was run from a file."""
    if hasattr(module, "casest_source"):
        return str(module.__file__), str(module.casest_source)
    file = getattr(module, "__file__", None)
    try:
        return str(file), Path(file or "").read_text(encoding="utf-8")
    except OSError:
        raise UsageError(
            "a model declared at a prompt cannot be sent to another process: put it into a file"
        ) from None


def _named(wanted: Reference) -> ModuleType:
    __import__(wanted.module)
    return sys.modules[wanted.module]


def _own(origin: str, file: str, source: str) -> ModuleType:
    """The module of a user's source: the one that is loaded already, else run now."""
    loaded = sys.modules.get(origin)
    if loaded is not None and _loaded_from(loaded) == source:
        return loaded
    name = f"{origin if origin.startswith(OWN) else OWN + origin.strip('_')}_{_digest(source)[:12]}"
    if name not in sys.modules:
        sys.modules[name] = _run(name, origin, file, source)
    return sys.modules[name]


def _loaded_from(module: ModuleType) -> str | None:
    """The source of a user's module in this process."""
    try:
        return _text(module)[1]
    except (UsageError, UnicodeDecodeError):
        return None


def _run(name: str, origin: str, file: str, source: str) -> ModuleType:
    made = ModuleType(name)
    vars(made).update(__file__=file, casest_origin=origin, casest_source=source)
    sys.modules[name] = made  # a dataclass in it looks itself up there
    # Tracing quotes lines of the file, which may not be on this machine.
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    folder = str(Path(file).parent)
    sys.path.insert(0, folder)
    try:
        exec(compile(source, file, "exec"), vars(made))
    except Exception as error:
        del sys.modules[name]
        raise DeclarationError(f"{file}, sent to another process: {last_line(error)}") from None
    finally:
        sys.path.remove(folder)
    return made


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _spelled(value: Any) -> Iterator[str]:
    """What a value is made of, in words that are the same in every process."""
    if isinstance(value, FunctionType):
        found = reference(value)
        yield from (found.module, *found.path, _source_digest(found))
    elif is_dataclass(value) and not isinstance(value, type):
        yield type(value).__name__
        for f in fields(value):
            yield f.name
            yield from _spelled(getattr(value, f.name))
    elif isinstance(value, tuple | list):
        yield f"{len(value)}"
        for one in value:
            yield from _spelled(one)
    elif isinstance(value, dict):
        yield from _spelled(sorted(value.items()))
    else:
        yield repr(value)


def _source_digest(found: Reference) -> str:
    """Of the file that a function stands in."""
    return _digest(found.source) if found.source else _file_digest(found.module)


@lru_cache(maxsize=256)
def _file_digest(module: str) -> str:
    file = getattr(sys.modules[module], "__file__", None)
    return _digest(Path(file).read_text(encoding="utf-8")) if file else module
