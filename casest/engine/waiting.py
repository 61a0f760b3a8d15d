"""What is kept for a next call, so much in all: beyond it the oldest go.

A closed loop makes a plan for each cause that it tries, and whatever keeps such a model would keep
its blocks of samples.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from typing import Any, Generic, TypeVar
from weakref import WeakMethod, ref

T = TypeVar("T")


class Waiting(Generic[T]):
    """Things of so many bytes that wait for another call, of whatever owners, at most `most` bytes.

    Referred to weakly: what waits still goes when its owner goes.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        #: By identity, the one used longest ago first: the thing, its bytes, who lets go of it.
        self._waiting: OrderedDict[int, tuple[ref[T], int, WeakMethod[Any]]] = OrderedDict()
        self._counted = 0  # no less than the bytes of those that are still there
        self._lock = Lock()

    def keep(self, thing: T, size: int, let_go: Callable[[T], None]) -> None:
        """Count a thing of `size` bytes among those that wait; its owner's method lets go of it."""
        with self._lock:
            found = self._waiting.get(id(thing))
            if found is not None and found[0]() is thing:
                self._waiting.move_to_end(id(thing))
                return
            self._waiting[id(thing)] = ref(thing), size, WeakMethod(let_go)
            self._waiting.move_to_end(id(thing))
            self._counted += size
            if self._counted > self.most:
                self._let_go()

    def _let_go(self) -> None:
        """The oldest, down to half, so that the next need not count again; never the newest."""
        there = {key: own for key, own in self._waiting.items() if own[0]() is not None}
        self._counted = sum(size for _, size, _ in there.values())
        self._waiting = OrderedDict(there)
        for key in list(there)[:-1]:
            if self._counted <= self.most // 2:
                return
            kept, size, let_go = self._waiting.pop(key)
            self._counted -= size
            thing, owner = kept(), let_go()
            if thing is not None and owner is not None:
                owner(thing)


#: Blocks of samples of all plans.
WAITING: Waiting[Any] = Waiting(128 * 2**20)
