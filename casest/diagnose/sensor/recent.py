"""What was computed of the last few fits: computing takes longer than asking again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class Recent(Generic[K, V]):
    """Values of the last keys that were asked about; a key is known by identity."""

    def __init__(self, most: int = 4) -> None:
        self._most = most
        self._known: list[tuple[K, V]] = []

    def of(self, key: K, computed: Callable[[], V]) -> V:
        """The value of a key, computed where it is not known any more."""
        others = [pair for pair in self._known if pair[0] is not key]
        own = [pair for pair in self._known if pair[0] is key] or [(key, computed())]
        self._known = [*others, *own][-self._most :]
        return own[0][1]
