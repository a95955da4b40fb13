"""Command `run-study`: the paper's tables on data of ours."""

from __future__ import annotations

import json

from envs import command as command_line
from envs.errors import UsageError
from envs.files import locked, write_json, written_aside
from worldmodel.study import report
from worldmodel.study.options import StudyOptions
from worldmodel.study.results import collect
from worldmodel.study.scoring import check_lengths, score, scores_of
from worldmodel.study.training import progress_of, train

PATIENCE_S = 60.0
"""How long to wait for the trainer of a study that was stopped to save and end."""


def main(options: StudyOptions) -> None:
    """Train and score what is not trained and scored yet; write the report after each model."""
    check_lengths(options)
    options.out.mkdir(parents=True, exist_ok=True)
    with locked(options.out, PATIENCE_S) as lock:
        _claim(options)
        _write(options)  # now, not hours later: is each run that is there one of this study?
        for number, contestant in enumerate(options.chosen, 1):
            print(f"\n{contestant.title}, frame gap {contestant.gap} ({number} of {len(options.chosen)})", flush=True)
            progress = progress_of(options, contestant)
            if progress is None or not progress.whole:
                progress = train(options, contestant, lock)
            print(f"trained: {progress.step} steps in {progress.seconds / 60:.1f} minutes", flush=True)
            if scores_of(options, contestant) is None:
                score(options, contestant)
            _write(options)
    print(f"\n{(options.out / 'study.md').read_text()}")
    for name in ("study.json", "study.md", "curves.png", "bars.png"):
        print(options.out / name)


def _claim(options: StudyOptions) -> None:
    """A folder holds one study."""
    path = options.out / "study.json"
    if not path.exists():
        return
    try:
        held = json.loads(path.read_text())["study"]
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{path} is damaged ({error}); remove it: it is written anew from what is there") from error
    if held != options.study:
        raise UsageError(f"{options.out} holds the study '{held}', not '{options.study}'; give another --out")


def _write(options: StudyOptions) -> None:
    document = collect(options)
    write_json(options.out / "study.json", document)
    with written_aside(options.out / "study.md") as aside:
        aside.write_text(report.markdown(document))
    if document["models"]:
        from worldmodel.study import figures  # half a second: only where a figure is drawn

        figures.draw_curves(document, options.out / "curves.png")
        figures.draw_bars(document, options.out / "bars.png")


def command() -> None:
    """Entry point of `run-study`."""
    command_line.run(StudyOptions, main)


if __name__ == "__main__":
    command()
