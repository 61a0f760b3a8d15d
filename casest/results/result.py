"""What every result shares: a frozen value that is built once, and written as JSON as it stands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from msgspec import UNSET, Struct, UnsetType, to_builtins
from msgspec.structs import replace

from casest import __version__
from casest.data.logs import parts_of
from casest.results.file import digest, is_file, plain, versions

#: A number, or None where there is none; and as many as a parameter has, nested by its shape.
Number = float | None
Numbers = Any


class Reproduced(Struct, frozen=True):
    """What it takes to get a result again: the command, versions, the files' digests."""

    command: str
    python: str
    casadi: str
    numpy: str
    scipy: str
    sha256: dict[str, str]


def reproduced(command: str, data: Sequence[str]) -> Reproduced:
    """The command that made a result, versions and digests of its files (data frames are none)."""
    files = [part for name in data for part in parts_of(name)]
    return Reproduced(command, **versions(), sha256={f: digest(f) for f in files if is_file(f)})


class Result(Struct, frozen=True, kw_only=True, dict=True):
    """A result: its fields are what the JSON file holds, in that order, but for the `unwritten`.

    A field that is UNSET is absent from the file; what is not finite becomes null there.
    """

    unwritten: ClassVar[tuple[str, ...]] = ()

    casest: str = __version__
    model: str

    def content(self) -> dict[str, Any]:
        """What is written as JSON: dictionaries, lists, texts and numbers."""
        written = replace(self, **dict.fromkeys(self.unwritten, UNSET))
        found: dict[str, Any] = plain(to_builtins(written, enc_hook=plain))
        return found


class Parameter(Struct, frozen=True, kw_only=True):
    """Value, standard deviations, interval and unit of a parameter, each shaped like it."""

    value: Numbers
    std: Numbers
    plain_std: Numbers = UNSET
    robust_std: Numbers = UNSET
    interval95: Numbers = UNSET
    unit: str | list[str]


class Certificate(Struct, frozen=True):
    """Whether a fit is trusted, and why; how that was found."""

    trusted: bool
    reasons: list[str]
    step_left_in_std: Number | UnsetType = UNSET
    relative_curvature: Number | UnsetType = UNSET
    agreeing_starts: list[int] | UnsetType = UNSET
    at_bound: list[str] | UnsetType = UNSET


class Explained(Struct, frozen=True):
    """Something that was not done, and why."""

    name: str
    reason: str
