"""How much memory there is; and that what is freed stays with the process, where the C library can be told so."""

from __future__ import annotations

import ctypes
import functools
import math
import sys
from pathlib import Path

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3  # <malloc.h>
_HELD, _PAD = 1 << 30, 1 << 26  # bytes


@functools.cache
def keep_freed_memory() -> None:
    """Stop glibc from giving every large tensor's memory back to the system, to be faulted in anew page by page.

    A network of small layers on a CPU makes and drops tensors of some megabytes all the time; kept memory makes it
    about a third faster. For commands, which own their process; elsewhere than on glibc it does nothing.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return
    mallopt(_M_MMAP_THRESHOLD, _HELD)
    mallopt(_M_TRIM_THRESHOLD, _HELD)
    mallopt(_M_TOP_PAD, _PAD)


def available_memory(group: Path = Path("/sys/fs/cgroup")) -> float:
    """Bytes that may still be taken: what the machine has free and, in a container, its limit; inf where untold.

    Args:
        group: of the process's control group, version 2. The files that it has read count as used there; those that
            lie idle make room when room is needed.
    """
    free = math.inf
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                free = 1024.0 * int(line.split()[1])
        limit = (group / "memory.max").read_text().strip()
        if limit != "max":
            statistics = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
            used = float((group / "memory.current").read_text()) - float(statistics.get("inactive_file", 0))
            free = min(free, float(limit) - used)
    except OSError:  # another system, or no control groups
        pass
    return max(free, 0.0)
