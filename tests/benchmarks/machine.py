"""What machine the numbers are from."""

from __future__ import annotations

import os
import platform
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tests.benchmarks.child import CORES, BenchmarkFailed
from tests.benchmarks.suite import opengl

PACKAGES = ("torch", "mujoco", "robosuite", "numpy", "gymnasium")


def facts() -> dict[str, Any]:
    """Processor, cores, memory, OpenGL, versions, and how busy the machine was before we began."""
    try:
        drawing = opengl()
    except BenchmarkFailed:
        drawing = "none works"
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)),
        "cores_used_at_most": CORES,
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "load_before": round(os.getloadavg()[0], 2),
        "opengl": drawing,
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {package: version(package) for package in PACKAGES},
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def _cpu() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()
