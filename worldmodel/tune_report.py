"""Command `tune-report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from envs import command as command_line
from worldmodel.tuning.report import FILES, write_report


@dataclass(frozen=True)
class ReportOptions:
    """Write the report of a search of `tune-worldmodel`, finished or not, anew."""

    out: tyro.conf.Positional[Path]
    """Folder of the search."""


def main(options: ReportOptions) -> None:
    """Write the report and show its tables."""
    write_report(options.out)
    print((options.out / "report.md").read_text())
    for name in FILES:
        if (options.out / name).exists():
            print(options.out / name)


def command() -> None:
    """Entry point of `tune-report`."""
    command_line.run(ReportOptions, main)


if __name__ == "__main__":
    command()
