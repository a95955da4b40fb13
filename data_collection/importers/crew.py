"""Parts of a source to shards of a dataset, by several processes."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import traceback
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from data_collection.importers.source import Damaged, Part, Source
from data_collection.writer import shard_path, write_shard
from envs.errors import UsageError

ORIGIN = "imported_from"
"""Attribute of an imported shard: the name of the part and its notes."""


@dataclass(frozen=True)
class Outcome:
    """What became of a part."""

    index: int
    name: str
    damage: str | None = None
    """Why it is no episode; None if it is one."""
    notes: tuple[str, ...] = ()
    frames: int = 0

    def line(self) -> str:
        """What is to be said about it, in one line; empty if nothing is."""
        said = f"skipped: {self.damage}" if self.damage is not None else "; ".join(self.notes)
        return f"episode {self.index} ({self.name}): {said}" if said else ""


def import_part(source: Source, attrs: Mapping[str, Any], folder: Path, part: Part) -> Outcome:
    """Read a part and write its shard, or say why it cannot be.

    Args:
        source: what it is a part of.
        attrs: attributes of the shard, as `write_shard` takes them.
        folder: of the dataset.
        part: which.

    Raises:
        UsageError: the shard cannot be written.
    """
    try:
        episode = source.read(part)
    except Damaged as damage:
        return Outcome(part.index, part.name, str(damage))
    origin = {ORIGIN: {"part": part.name, "notes": list(episode.notes)}}
    path = shard_path(folder, part.index)
    try:
        write_shard(path, [episode.columns], {**attrs, **origin}, [part.index])
    except OSError as error:
        raise UsageError(f"cannot write {path} ({error}); make room and run the same command again") from error
    return Outcome(part.index, part.name, None, episode.notes, len(episode.columns["action"]))


def import_parts(
    source: Source, attrs: Mapping[str, Any], folder: Path, parts: Sequence[Part], workers: int
) -> Iterator[Outcome]:
    """Import parts, with one process in this one, with more in as many others; yields what becomes of each.

    A process that is killed costs the part that it was at, which is reported as damaged and may be tried again.

    Raises:
        UsageError: a shard cannot be written.
    """
    if min(workers, len(parts)) <= 1:
        for part in parts:
            yield import_part(source, attrs, folder, part)
        return
    pending = deque(parts)
    crew: list[_Worker] = []
    try:
        for _ in range(min(workers, len(parts))):
            crew.append(_Worker(source, attrs, folder, pending.popleft()))
        while crew:
            ready = wait([handle for worker in crew for handle in (worker.connection, worker.process.sentinel)])
            for worker in [w for w in crew if w.connection in ready or w.process.sentinel in ready]:
                yield worker.outcome()
                alive = worker.process.is_alive()
                if alive and pending:
                    worker.begin(pending.popleft())
                    continue
                worker.stop()
                crew.remove(worker)
                if pending:
                    crew.append(_Worker(source, attrs, folder, pending.popleft()))
    finally:
        for worker in crew:
            worker.stop()


class _Worker:
    """One process and the part it is at."""

    def __init__(self, source: Source, attrs: Mapping[str, Any], folder: Path, part: Part) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=work, args=(source, dict(attrs), folder, theirs), daemon=True)
        self.process.start()
        theirs.close()
        self.begin(part)

    def begin(self, part: Part) -> None:
        self.part = part
        with contextlib.suppress(BrokenPipeError):  # it has just died: its sentinel tells
            self.connection.send(part)

    def outcome(self) -> Outcome:
        with contextlib.suppress(EOFError, ConnectionResetError):
            if self.connection.poll():
                kind, answer = self.connection.recv()
                if kind == "usage":
                    raise UsageError(answer)
                if kind == "bug":
                    raise RuntimeError(f"importing {self.part.name} failed:\n{answer}")
                return answer
        self.process.join()
        code = self.process.exitcode or 0
        how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return Outcome(self.part.index, self.part.name, f"the process that read it was {how}; try again")

    def stop(self) -> None:
        """End the process now; what it was writing stays aside."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def work(source: Source, attrs: dict[str, Any], folder: Path, supervisor: Connection) -> None:
    """A worker's life: receive a part, import it, say what became of it; end when the supervisor is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the supervisor decides
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            part = supervisor.recv()
            try:
                supervisor.send(("done", import_part(source, attrs, folder, part)))
            except UsageError as error:
                supervisor.send(("usage", str(error)))
            except (BrokenPipeError, ConnectionResetError):
                raise
            except Exception:
                supervisor.send(("bug", traceback.format_exc()))
