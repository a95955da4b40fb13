"""Getting ready for the next step while this one is computed."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Ahead(Generic[Item]):
    """Calls a function of a step's number one step ahead, in a thread of its own.

    Args:
        read: of the number alone.
        end: from this number on nothing is read ahead.
    """

    def __init__(self, read: Callable[[int], Item], end: int) -> None:
        self._read, self._end = read, end
        self._thread = ThreadPoolExecutor(1, "ahead")
        self._step = -1
        self._next: Future[Item] | None = None

    def __call__(self, step: int) -> Item:
        """What the function gives for this step; anything that it raises is raised here."""
        item = self._next.result() if self._next is not None and self._step == step else self._read(step)
        self._step, self._next = step + 1, None
        if self._step < self._end:
            self._next = self._thread.submit(self._read, self._step)
        return item
