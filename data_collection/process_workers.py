"""Workers that are processes of this machine."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Iterator
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from data_collection.episodes import EpisodeMaker
from data_collection.manifest import Manifest
from data_collection.workers import ONE_THREAD, Worker, WorkerPool, log_failure
from data_collection.writer import shard_path
from envs.errors import UsageError


class _Orphaned(Exception):
    """The supervisor is gone."""


class ProcessPool(WorkerPool["ProcessWorker"]):
    """Starts processes, which write their shards themselves.

    Args:
        manifest: what an episode is.
        folder: where the shards go.
        timeout: seconds that an episode may take.
    """

    def __init__(self, manifest: Manifest, folder: Path, timeout: float) -> None:
        self._manifest, self._folder, self._timeout = manifest, folder, timeout

    def hire(self, name: str, episode: int) -> ProcessWorker:
        return ProcessWorker(name, self._manifest, self._folder, self._timeout, episode)

    def wait(self, crew: list[ProcessWorker]) -> list[ProcessWorker]:
        first_deadline = min(worker.deadline for worker in crew)
        handles: list[Any] = [handle for worker in crew for handle in (worker.connection, worker.process.sentinel)]
        ready = set(wait(handles, timeout=max(0.0, first_deadline - time.monotonic())))
        return [w for w in crew if {w.connection, w.process.sentinel} & ready or w.overdue]


class ProcessWorker(Worker):
    """A process that this one started."""

    def __init__(self, name: str, manifest: Manifest, folder: Path, timeout: float, episode: int) -> None:
        context = multiprocessing.get_context("spawn")  # GL contexts do not survive a fork
        self.connection, theirs = context.Pipe()
        arguments = (manifest, folder, theirs, os.getpid())
        self.process = context.Process(target=work, args=arguments, name=name, daemon=True)
        with _environment(ONE_THREAD):
            self.process.start()
        theirs.close()
        super().__init__(name, timeout, episode)
        self._send(episode)

    def __str__(self) -> str:
        return f"{self.name} (pid {self.process.pid})"

    def begin(self, episode: int) -> None:
        super().begin(episode)
        self._send(episode)

    def _send(self, episode: int) -> None:
        with contextlib.suppress(BrokenPipeError):  # it has just died: its sentinel tells
            self.connection.send(episode)

    def news(self) -> tuple[str, str] | None:
        with contextlib.suppress(EOFError, ConnectionResetError):
            if self.connection.poll():
                kind, detail = self.connection.recv()
                if kind != "ready":
                    return kind, detail
                self.be_patient(self._timeout)
                return None
        if not self.process.is_alive() or not self.overdue:
            self.process.join(timeout=5.0)  # the pipe may break a moment before the process ends
            if not self.process.is_alive():
                return "failed", _describe_exit(self.process.exitcode)
            return None
        return self.hung()

    def stop(self) -> None:
        self.process.kill()  # SIGKILL, because a hung or stopped one heeds nothing else
        self.process.join()
        self.connection.close()


def work(manifest: Manifest, folder: Path, supervisor: Connection, supervisor_pid: int) -> None:
    """A worker's life: receive the number of an episode, collect it, write its shard, say so."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the supervisor decides

    def check_supervisor() -> None:
        if os.getppid() != supervisor_pid:
            raise _Orphaned

    with contextlib.suppress(_Orphaned, EOFError, BrokenPipeError, ConnectionResetError):
        try:
            maker = EpisodeMaker(manifest)
            supervisor.send(("ready", ""))
            while True:
                episode = supervisor.recv()
                maker.write(episode, shard_path(folder, episode), check_supervisor)
                supervisor.send(("collected", ""))
        except UsageError as error:
            supervisor.send(("usage", str(error)))
        except (_Orphaned, EOFError, BrokenPipeError, ConnectionResetError):
            raise
        except Exception as error:
            said, name = f"{type(error).__name__}: {error}", multiprocessing.current_process().name
            supervisor.send(("failed", log_failure(said, traceback.format_exc(), name, folder)))


@contextlib.contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Environment variables that only the processes started in the block inherit."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _describe_exit(code: int | None) -> str:
    if code is not None and code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return f"exited with code {code}"
