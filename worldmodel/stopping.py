"""Being asked to stop, and time to save before that."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Yields a list that the signals come into as they come: SIGTERM and Ctrl-C. A second one stops us at once."""
    stops: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    heard = [number for number, handler in before.items() if handler is not signal.SIG_IGN]

    def hear(number: int, frame: object) -> None:
        stops.append(number)
        signal.signal(number, before[number])  # type: ignore[index]

    try:
        for number in heard:
            signal.signal(number, hear)
    except ValueError:  # not in the main thread: nobody can signal us
        yield stops
        return
    try:
        yield stops
    finally:
        for number in heard:
            signal.signal(number, before[number])
