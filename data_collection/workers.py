"""Workers that collect episodes, wherever they are, and their supervisor: who dies or hangs is named and replaced."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from data_collection.writer import shard_path
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


class Worker(ABC):
    """A process, here or elsewhere, and the episode it is at; `str` tells people which one it is.

    Args:
        name: of its place in the crew.
        timeout: seconds that an episode may take.
        episode: the first one.
    """

    def __init__(self, name: str, timeout: float, episode: int) -> None:
        self.name, self.episode = name, episode
        self._timeout = timeout
        self.be_patient(START_SECONDS, "it was not ready")

    def be_patient(self, seconds: float, otherwise: str = "the episode was not done") -> None:
        """From now on it may be silent for so long; `otherwise` is what to say of it then."""
        self.deadline = time.monotonic() + seconds
        self._fault = f"hung: {otherwise} in {seconds:g} s"

    @property
    def overdue(self) -> bool:
        """Whether it has been silent for too long."""
        return time.monotonic() >= self.deadline

    def hung(self) -> tuple[str, str]:
        """The news of a worker that is overdue."""
        return "failed", self._fault

    def begin(self, episode: int) -> None:
        """Have it collect an episode, after the one that it has just done."""
        self.episode = episode
        self.be_patient(self._timeout)

    @abstractmethod
    def news(self) -> tuple[str, str] | None:
        """What became of the episode: ("collected" | "failed" | "usage", detail); None while it is under way."""

    @abstractmethod
    def stop(self) -> None:
        """End it now, whatever it is doing."""


Hired = TypeVar("Hired", bound=Worker)


class WorkerPool(ABC, Generic[Hired]):
    """Where workers come from."""

    @abstractmethod
    def hire(self, name: str, episode: int) -> Hired:
        """A new worker that begins with this episode."""

    @abstractmethod
    def wait(self, crew: list[Hired]) -> list[Hired]:
        """The workers that said something, ended, or ran out of time; waits until there is one."""


def collect_episodes(
    pool: WorkerPool[Hired], folder: Path, episodes: Sequence[int], workers: int
) -> Iterator[Collected | WorkerLost]:
    """Collect episodes with several workers; yields what happens, in the order in which it happens.

    Args:
        pool: of workers for one run.
        folder: where the shards go.
        episodes: the numbers to collect.
        workers: how many.

    Raises:
        UsageError: the environment cannot be used, or an episode failed `MAX_FAILURES` times.
    """
    pending = deque(episodes)
    failures: Counter[int] = Counter()
    crew: list[Hired] = []
    try:
        for slot in range(min(workers, len(pending))):
            crew.append(pool.hire(f"worker {slot}", pending.popleft()))
        while crew:
            for worker in pool.wait(crew):
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
                    crew.append(pool.hire(worker.name, pending.popleft()))
    finally:
        for worker in crew:
            worker.stop()


def log_failure(said: str, trace: str, worker: str, folder: Path) -> str:
    """What an exception in a worker said, and where it came from, which goes into the folder's log."""
    log = folder / ERROR_LOG
    with log.open("a") as file:
        file.write(f"{worker}:\n{trace}\n")
    return f"{said} (see {log})"
