"""Command `tune-worldmodel`."""

from __future__ import annotations

from envs import command as command_line
from envs.files import locked
from worldmodel.tuning.options import TuneOptions
from worldmodel.tuning.report import write_report
from worldmodel.tuning.search import search, settle, unfinished


def main(options: TuneOptions) -> None:
    """Search, then write the report and the winner's options."""
    if options.searcher != "random":
        from worldmodel.tuning.searchers import check_searcher

        check_searcher(options.searcher)
    options.budgets  # noqa: B018  refuse options before anything is written
    options.out.mkdir(parents=True, exist_ok=True)
    with locked(options.out):
        data = [settle(options)]
        if unfinished(options, retried=True):
            search(options, data.pop())  # to hand it over, not to keep a second copy
        stopped = unfinished(options)
        write_report(options.out)
    print((options.out / "report.md").read_text())
    if stopped:
        print("the same command goes on from here")
        raise KeyboardInterrupt


def command() -> None:
    """Entry point of `tune-worldmodel`."""
    command_line.run(TuneOptions, main)


if __name__ == "__main__":
    command()
