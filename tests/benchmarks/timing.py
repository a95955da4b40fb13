"""How long something takes, and how much memory."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

MMAP_EVERYTHING = {"MALLOC_MMAP_THRESHOLD_": "65536"}
"""Environment in which glibc gives large blocks back when they are freed: a process's size is then what it uses."""


def median_seconds(work: Callable[[], Any], repeats: int, warmup: int = 1) -> float:
    """Median wall time of a call, seconds, after `warmup` calls that do not count."""
    for _ in range(warmup):
        work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def peak_mebibytes(work: Callable[[], Any]) -> float:
    """By how much a call makes this process grow at its peak, MiB, after one call that does not count (Linux)."""
    work()
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew from here
    before = _status_kib("VmRSS")
    work()
    return max((_status_kib("VmHWM") - before) / 1024, 0.1)


def _status_kib(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1])
    raise RuntimeError(f"/proc/self/status has no {field}: memory can be measured on Linux only")
