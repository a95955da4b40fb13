"""Ray, started or found quietly: the one engine that spreads trials and episodes over processes and machines."""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from envs.errors import UsageError

REACH_S = 5.0
"""How long to wait for a cluster's address to answer; Ray itself would try for minutes."""
TRIES = 3
"""Ray gives a cluster of its own 30 s to start, which a busy machine may exceed."""
QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent anywhere
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # a task without GPUs leaves CUDA_VISIBLE_DEVICES alone; Ray's new way
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",  # not a word of Ray's own when a process or a machine dies: we say it
    "RAY_agent_register_timeout_ms": "300000",  # a busy machine needs more than the usual 30 s
    "RAY_worker_niceness": "0",  # as nice as this process, not by 15 nicer than whatever else runs
    # Where memory runs out the kernel kills a worker, a death like others. Ray's own watch would end all of Ray Tune.
    "RAY_memory_monitor_refresh_ms": "0",
}


@contextmanager
def connect(address: str | None, cpus: int | None) -> Iterator[None]:
    """Be connected to a Ray cluster.

    Without an address, a cluster of this machine alone is started and ended with the block, and it dies with this
    process even if that is killed. There is no dashboard, and what workers print does not come here.

    Args:
        address: `HOST:PORT` of a running cluster's head, `auto` for the one that runs on this machine, or None.
        cpus: how many CPUs a cluster of our own has; None for all of this machine. A running one has what it has.

    Raises:
        UsageError: there is no cluster at that address.
    """
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    if address is not None:
        _check(address)
    import ray  # takes seconds: only for those who use it

    handler = signal.getsignal(signal.SIGTERM)
    codes: list[Any] = []

    def on_sigterm(number: int, frame: FrameType | None) -> None:
        assert callable(handler)
        try:
            handler(number, frame)
        except SystemExit as stop:
            codes.append(stop.code)
            raise

    for attempt in range(1, TRIES + 1):
        try:
            if address is None:
                ray.init(
                    "local", num_cpus=cpus, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR
                )
            else:
                ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
            break
        except Exception as error:  # Ray raises plain ones here
            ray.shutdown()
            if address is None and attempt < TRIES:
                continue
            where = "Ray does not start here" if address is None else f"cannot join the Ray cluster at '{address}'"
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            remedy = "see what ray start --head says, or leave out --ray"
            if address is not None and os.environ.get("RAY_AUTH_MODE") is None:
                remedy += "; if it wants a token, which Ray sends nowhere unasked, set RAY_AUTH_MODE=token"
            raise UsageError(f"{where} ({reason}); {remedy}") from error
    handles = callable(handler) and threading.current_thread() is threading.main_thread()
    if handles:
        signal.signal(signal.SIGTERM, on_sigterm)  # a cluster of our own has put its handler in that place
    try:
        yield
    except SystemExit:
        if codes:  # where the signal comes while Ray waits, Ray makes its exit code a 1
            raise SystemExit(codes[-1]) from None
        raise
    finally:
        if handles:
            signal.signal(signal.SIGTERM, handler)
        ray.shutdown()


def _check(address: str) -> None:
    if address == "auto":
        return
    host, separator, port = address.rpartition(":")
    if not separator or not host or not port.isdigit() or "/" in address:
        raise UsageError(f"ray is '{address}'; give HOST:PORT as `ray start --head` says, or auto for this machine's")
    try:
        socket.create_connection((host, int(port)), timeout=REACH_S).close()
    except (OSError, OverflowError) as error:
        raise UsageError(
            f"no Ray cluster answers at '{address}' ({error}); start one with ray start --head, or leave out --ray"
        ) from error
