"""Measuring in a process of its own, on cores of its own: no subject warms, fills or sets up the next one's process."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
CORES = 2
"""What subjects that use several cores are given, wherever there are more."""
LAST_LINES = 12


class BenchmarkFailed(Exception):
    """A subject ended with an error; says what it printed last."""


def measure(subject: str, cores: int = CORES, environment: Mapping[str, str] | None = None, **arguments: Any) -> Any:
    """Run a subject and return what it returns.

    Args:
        subject: "module.function" in `tests.benchmarks.subjects`.
        cores: it is pinned to so many, or as many as there are.
        environment: more environment variables.
        arguments: of the function; JSON.

    Raises:
        BenchmarkFailed: it raised, or died.
    """
    chosen = sorted(os.sched_getaffinity(0))[-cores:]
    threads = {f"{library}_NUM_THREADS": str(len(chosen)) for library in ("OMP", "MKL", "OPENBLAS")}
    variables = {**os.environ, **threads, "LP_NUM_THREADS": "0", **(environment or {})}
    with tempfile.TemporaryDirectory() as folder:
        answer, printed = Path(folder) / "answer.json", Path(folder) / "printed.txt"
        command = [sys.executable, "-m", "tests.benchmarks.child", subject, json.dumps(arguments), str(answer)]
        command.append(",".join(map(str, chosen)))
        # Into a file: helpers of a killed subject would keep a pipe open, and us waiting.
        with printed.open("w") as output:
            ended = subprocess.run(
                command, cwd=ROOT, env=variables, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
            )
        if ended.returncode != 0 or not answer.exists():
            last = "\n".join(printed.read_text(errors="replace").strip().splitlines()[-LAST_LINES:])
            raise BenchmarkFailed(f"{subject} ended with code {ended.returncode}:\n{last}")
        return json.loads(answer.read_text())


def main(subject: str, arguments: str, answer: str, cores: str) -> None:
    """The child's side: pin, import, measure, answer."""
    os.sched_setaffinity(0, {int(core) for core in cores.split(",")})
    module, function = subject.rsplit(".", 1)
    measured = getattr(importlib.import_module(f"tests.benchmarks.subjects.{module}"), function)
    Path(answer).write_text(json.dumps(measured(**json.loads(arguments))))


if __name__ == "__main__":
    main(*sys.argv[1:])
