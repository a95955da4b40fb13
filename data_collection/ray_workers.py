"""Workers that are actors on a Ray cluster: they make shards, and this process writes them.

A shard travels as the bytes of its file, an eighth of its episode's size, so that nobody but this process needs to see
the dataset's folder, and a file is the same wherever it was made.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
import tempfile
import time
import traceback
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import ray
from ray.exceptions import ActorDiedError, ActorUnavailableError, RayError

from data_collection.episodes import EpisodeMaker
from data_collection.manifest import Manifest
from data_collection.workers import ONE_THREAD, START_SECONDS, Worker, WorkerPool, log_failure
from data_collection.writer import shard_path
from envs.errors import UsageError
from envs.files import written_aside

POLL_S = 5.0


class Answer(NamedTuple):
    """What an actor says."""

    kind: str
    """"placed", "ready", "collected", "usage" or "failed"."""
    detail: str = ""
    shard: bytes = b""
    """The file of a collected episode."""
    trace: str = ""
    """Where a failure came from."""


class Collector:
    """The life of an actor, which has a process of its own on some machine."""

    def __init__(self, manifest: Manifest) -> None:
        self._manifest = manifest
        self._maker: EpisodeMaker | None = None

    def where(self) -> Answer:
        """Where it has been placed: process, machine, and the cluster's name for that."""
        node = ray.get_runtime_context().get_node_id()
        return Answer("placed", f"pid {os.getpid()} on {socket.gethostname()}, node {node[:8]}")

    def collect(self, episode: int | None) -> Answer:
        """Make an episode; None only makes the environment."""
        try:
            if self._maker is None:
                self._maker = EpisodeMaker(self._manifest)
            if episode is None:
                return Answer("ready")
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "shard.h5"
                self._maker.write(episode, path)
                return Answer("collected", shard=path.read_bytes())
        except UsageError as error:
            return Answer("usage", str(error))
        except Exception as error:
            return Answer("failed", f"{type(error).__name__}: {error}", trace=traceback.format_exc())


class RayPool(WorkerPool["RayWorker"]):
    """Places actors on the cluster that this process is connected to, one CPU each, spread over its machines.

    Args:
        manifest: what an episode is.
        folder: where the shards go; this process alone needs to see it.
        timeout: seconds that an episode may take.
    """

    def __init__(self, manifest: Manifest, folder: Path, timeout: float) -> None:
        self._manifest, self._folder, self._timeout = manifest, folder, timeout
        self._actor = ray.remote(Collector).options(
            num_cpus=1, scheduling_strategy="SPREAD", runtime_env={"env_vars": ONE_THREAD}
        )

    @property
    def cpus(self) -> int:
        """CPUs that the cluster has, busy ones included."""
        return int(ray.cluster_resources().get("CPU", 0))

    def hire(self, name: str, episode: int) -> RayWorker:
        return RayWorker(name, lambda: self._actor.remote(self._manifest), self._folder, self._timeout, episode)

    def wait(self, crew: list[RayWorker]) -> list[RayWorker]:
        """As everywhere.

        Raises:
            UsageError: for long nobody has found a free CPU.
        """
        while True:
            first_deadline = min(worker.deadline for worker in crew)
            patience = min(POLL_S, max(0.0, first_deadline - time.monotonic()))
            said, _ = ray.wait([worker.answer for worker in crew], timeout=patience)
            news = [worker for worker in crew if worker.answer in said or worker.overdue]
            if news:
                return news
            if all(worker.waits_for_place > START_SECONDS for worker in crew):
                raise UsageError(
                    f"no CPU of the Ray cluster was free in {START_SECONDS:g} s; look at it with ray status, and run "
                    "the same command again to go on"
                )


class RayWorker(Worker):
    """An actor and what it has been asked, the oldest first."""

    def __init__(self, name: str, new_actor: Callable[[], Any], folder: Path, timeout: float, episode: int) -> None:
        super().__init__(name, timeout, episode)
        self.place = ""
        self._new_actor, self._folder, self._hired = new_actor, folder, time.monotonic()
        self._start()

    def _start(self) -> None:
        actor = self._actor = self._new_actor()
        self._asked = deque([actor.where.remote(), actor.collect.remote(None), actor.collect.remote(self.episode)])
        self.deadline = math.inf  # it may wait for a free CPU

    def __str__(self) -> str:
        return f"{self.name} ({self.place or 'not placed yet'})"

    @property
    def answer(self) -> Any:
        """The reference to what it will say next."""
        return self._asked[0]

    @property
    def waits_for_place(self) -> float:
        """Seconds for which it has been without a CPU; 0 when it has one."""
        return 0.0 if self.place else time.monotonic() - self._hired

    def begin(self, episode: int) -> None:
        super().begin(episode)
        self._asked.append(self._actor.collect.remote(episode))

    def news(self) -> tuple[str, str] | None:
        if not ray.wait([self.answer], timeout=0)[0]:
            return self.hung() if self.overdue else None
        try:
            answer: Answer = ray.get(self._asked.popleft())
        except RayError as error:
            if _is_out_of_reach(error) and 0 < self.waits_for_place < START_SECONDS:
                self._start()  # it was given to a machine that had gone: nothing is lost
                return None
            return "failed", _describe_death(error)
        if answer.kind == "placed":
            self.place = answer.detail
            self.be_patient(START_SECONDS, "it was not ready")
            return None
        if answer.kind == "ready":
            self.be_patient(self._timeout)
            return None
        if answer.kind == "collected":
            self._write(answer.shard)
        if answer.kind == "failed":
            return "failed", log_failure(answer.detail, answer.trace, str(self), self._folder)
        return answer.kind, answer.detail

    def _write(self, shard: bytes) -> None:
        path = shard_path(self._folder, self.episode)
        try:
            with written_aside(path) as aside:
                aside.write_bytes(shard)
        except OSError as error:
            raise UsageError(
                f"{path} cannot be written ({error}); make room, and run the same command again"
            ) from error

    def stop(self) -> None:
        with contextlib.suppress(RayError):
            ray.kill(self._actor)


def _describe_death(error: RayError) -> str:
    if _is_out_of_reach(error):
        return "its machine cannot be reached any more"
    if isinstance(error, ActorDiedError) and not error.actor_init_failed:
        return "its process died"
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[-1] if isinstance(error, ActorDiedError) else lines[0]}"


def _is_out_of_reach(error: RayError) -> bool:
    return isinstance(error, ActorUnavailableError) or "its node has died" in str(error)
