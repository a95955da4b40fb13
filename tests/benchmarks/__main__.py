"""`python -m tests.benchmarks`: run the benchmarks, print a table, write `bench.json`."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from envs.command import run
from envs.errors import UsageError
from envs.files import written_aside
from tests.benchmarks.child import BenchmarkFailed
from tests.benchmarks.machine import facts
from tests.benchmarks.result import Result, table
from tests.benchmarks.series import SERIES
from tests.benchmarks.suite import BENCHMARKS


@dataclass(frozen=True)
class BenchConfig:
    """Measure speed and memory against the plain ways of doing the same, in one run on one machine.

    Writes a list of {name, value, unit, against, ratio}; a ratio says how many times better we are. The machine's facts
    go into a file beside it. Leave the machine alone meanwhile.
    """

    out: Path = Path("build/bench.json")
    """Where the results go."""
    only: tuple[str, ...] = ()
    """Names of the benchmarks to run; all when not given, but for series, which are long."""
    quick: bool = False
    """Tiny sizes, to see whether everything runs; the numbers mean nothing."""
    list: bool = False
    """Only say which benchmarks there are."""

    def __post_init__(self) -> None:
        for name in self.only:
            if name not in (*BENCHMARKS, *SERIES):
                raise UsageError(f"no benchmark '{name}'; there are {', '.join((*BENCHMARKS, *SERIES))}")


def main(config: BenchConfig) -> None:
    """Run them one after the other; exit code 1 when one failed."""
    if config.list:
        for name, benchmark in (BENCHMARKS | SERIES).items():
            print(f"{name:<20} {benchmark.__doc__}")
        return
    machine: dict[str, Any] = facts() | {"quick": config.quick, "seconds": {}}
    results: list[Result] = []
    failed: list[str] = []
    for name in config.only or BENCHMARKS:
        print(f"{name} ...", file=sys.stderr, flush=True)
        start = time.monotonic()
        try:
            results += SERIES[name](config.quick) if name in SERIES else [BENCHMARKS[name](config.quick)]
        except BenchmarkFailed as failure:
            failed.append(name)
            print(f"{name} failed: {failure}", file=sys.stderr)
        machine["seconds"][name] = round(time.monotonic() - start, 1)
    config.out.parent.mkdir(parents=True, exist_ok=True)
    beside = config.out.with_name(f"{config.out.stem}-machine.json")
    write(config.out, [asdict(result) for result in results])
    write(beside, machine)
    print(table(results))
    print(f"written: {config.out}, {beside}" + ("; quick sizes, not to be quoted" if config.quick else ""))
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
        sys.exit(1)


def write(path: Path, content: Any) -> None:
    """Write JSON, whole or not at all."""
    with written_aside(path) as aside:
        aside.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    run(BenchConfig, main)
