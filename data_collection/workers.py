"""Worker processes that collect episodes, and their supervisor: whoever dies or hangs is named and replaced."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
import traceback
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from data_collection.environments import describe_env, make_env
from data_collection.manifest import Manifest
from data_collection.policies import make_policy
from data_collection.rollout import collect_episode
from data_collection.writer import shard_path, write_shard
from envs.errors import UsageError

MAX_FAILURES = 3
START_SECONDS = 300.0  # to import everything and make the environment, on a busy machine
ERROR_LOG = "errors.log"
ONE_THREAD = {"LP_NUM_THREADS": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Each worker is one core's worth: without these, Mesa and BLAS start a thread per core in every worker."""


@dataclass(frozen=True)
class Collected:
    """An episode is on the disk."""

    episode: int


@dataclass(frozen=True)
class WorkerLost:
    """A worker died, hung or failed; its episode will be tried again by another."""

    worker: str
    episode: int
    reason: str


class _Orphaned(Exception):
    """The supervisor is gone."""


def collect_episodes(
    manifest: Manifest, folder: Path, episodes: Sequence[int], workers: int, timeout: float
) -> Iterator[Collected | WorkerLost]:
    """Collect episodes with several processes; yields what happens, in the order in which it happens.

    Args:
        manifest: what an episode is.
        folder: where the shards go.
        episodes: the numbers to collect.
        workers: processes.
        timeout: seconds an episode may take.

    Raises:
        UsageError: the environment cannot be used, or an episode failed `MAX_FAILURES` times.
    """
    pending = deque(episodes)
    failures: Counter[int] = Counter()
    crew: list[_Worker] = []
    try:
        for slot in range(min(workers, len(pending))):
            crew.append(_Worker(f"worker {slot}", manifest, folder, timeout, pending.popleft()))
        while crew:
            for worker in _wait_for_news(crew):
                message = worker.news()
                if message is None:
                    continue
                kind, detail = message
                if kind == "usage":
                    raise UsageError(detail)
                if kind == "collected" or shard_path(folder, worker.episode).exists():
                    yield Collected(worker.episode)
                else:
                    failures[worker.episode] += 1
                    pending.appendleft(worker.episode)
                    yield WorkerLost(str(worker), worker.episode, detail)
                    if failures[worker.episode] == MAX_FAILURES:
                        raise UsageError(
                            f"episode {worker.episode} failed {MAX_FAILURES} times, last: {detail}; "
                            "mend the cause and run the same command again to go on"
                        )
                if kind == "collected" and pending:
                    worker.begin(pending.popleft())
                    continue
                worker.stop()
                crew.remove(worker)
                if pending:
                    crew.append(_Worker(worker.name, manifest, folder, timeout, pending.popleft()))
    finally:
        for worker in crew:
            worker.stop()


def _wait_for_news(crew: list[_Worker]) -> list[_Worker]:
    """The workers that said something, ended, or ran out of time; waits until there is one."""
    first_deadline = min(worker.deadline for worker in crew)
    handles: list[Any] = [handle for worker in crew for handle in (worker.connection, worker.process.sentinel)]
    ready = set(wait(handles, timeout=max(0.0, first_deadline - time.monotonic())))
    now = time.monotonic()
    return [w for w in crew if {w.connection, w.process.sentinel} & ready or now >= w.deadline]


class _Worker:
    """One process and the episode it is at."""

    def __init__(self, name: str, manifest: Manifest, folder: Path, timeout: float, episode: int) -> None:
        self.name, self._timeout = name, timeout
        context = multiprocessing.get_context("spawn")  # GL contexts do not survive a fork
        self.connection, theirs = context.Pipe()
        arguments = (manifest, folder, theirs, os.getpid())
        self.process = context.Process(target=work, args=arguments, name=name, daemon=True)
        with _environment(ONE_THREAD):
            self.process.start()
        theirs.close()
        self.begin(episode)
        self._be_patient(START_SECONDS)

    def __str__(self) -> str:
        return f"{self.name} (pid {self.process.pid})"

    def begin(self, episode: int) -> None:
        self.episode = episode
        self._be_patient(self._timeout)
        with contextlib.suppress(BrokenPipeError):  # it has just died: its sentinel tells
            self.connection.send(episode)

    def _be_patient(self, seconds: float) -> None:
        self._patience, self.deadline = seconds, time.monotonic() + seconds

    def news(self) -> tuple[str, str] | None:
        """What became of the episode: ("collected" | "failed" | "usage", detail); None while it is under way."""
        with contextlib.suppress(EOFError, ConnectionResetError):
            if self.connection.poll():
                kind, detail = self.connection.recv()
                if kind != "ready":
                    return kind, detail
                self._be_patient(self._timeout)
                return None
        if not self.process.is_alive() or time.monotonic() < self.deadline:
            self.process.join(timeout=5.0)  # the pipe may break a moment before the process ends
            if not self.process.is_alive():
                return "failed", _describe_exit(self.process.exitcode)
            return None
        return "failed", f"hung: the episode was not done in {self._patience:g} s"

    def stop(self) -> None:
        """End the process now; SIGKILL, because a hung or stopped one heeds nothing else."""
        self.process.kill()
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
            env = make_env(manifest.env_id, manifest.env_kwargs, manifest.ground_truth)
            attrs = describe_env(env, manifest.env_id, manifest.env_kwargs)
            attrs |= {"policy": manifest.policy, "seed": manifest.seed}
            supervisor.send(("ready", ""))
            while True:
                episode = supervisor.recv()
                policy = make_policy(manifest.policy)
                columns = collect_episode(
                    env, policy, manifest.steps, manifest.seed, episode, manifest.ground_truth, check_supervisor
                )
                check_supervisor()
                write_shard(shard_path(folder, episode), [columns], attrs, [episode])
                supervisor.send(("collected", ""))
        except UsageError as error:
            supervisor.send(("usage", str(error)))
        except (_Orphaned, EOFError, BrokenPipeError, ConnectionResetError):
            raise
        except Exception as error:
            with (folder / ERROR_LOG).open("a") as log:
                log.write(f"{multiprocessing.current_process().name}:\n{traceback.format_exc()}\n")
            supervisor.send(("failed", f"{type(error).__name__}: {error} (see {folder / ERROR_LOG})"))


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
