"""Writes down what happens in a search, and tells people."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ray.tune import Callback
from tqdm import tqdm

from worldmodel.tuning import journal
from worldmodel.tuning.journal import Status


class Watcher(Callback):
    """Told by Ray of every trial's start, scores, deaths and end.

    Args:
        results: the journal.
        count: trials of the search.
        steps: of a whole run.
    """

    def __init__(self, results: Path, count: int, steps: int) -> None:
        self._results, self._count, self._steps = results, count, steps
        self._bar: Any = None
        self._before: dict[int, journal.Trial] = {}
        self._best: tuple[float, int] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_bar": None, "_before": {}, "_best": None}

    def setup(  # what Ray calls it with
        self, stop: Any = None, num_samples: int | None = None, total_num_samples: int | None = None, **info: Any
    ) -> None:
        """The search begins or goes on."""
        self._before = {trial.number: trial for trial in journal.trials(self._results)}
        ended = [trial for trial in self._before.values() if trial.status in journal.ENDED]
        self._bar = tqdm(total=self._count, initial=len(ended), desc="tune", unit="trial", dynamic_ncols=True)
        for trial in self._before.values():
            self._see(trial.number, trial.step, trial.score)

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """A process has taken the trial up, not for the first time perhaps."""
        number, point = _number(trial), {k: v for k, v in trial.config.items() if k != "number"}
        if number in self._before and self._before[number].point != point:
            del self._before[number]
        journal.append(self._results, {"kind": "begin", "trial": number, "point": point})

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        """A validation, or the news that the trial diverged."""
        if result["diverged"]:
            return
        told = ("step", "score", *journal.PARTS, "seconds", "host", "pid")
        line = {name: result[name] for name in told if name in result}
        journal.append(self._results, {"kind": "score", "trial": _number(trial), **line})
        self._see(_number(trial), result["step"], result["score"])

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """The trial's process has died and will be replaced."""
        reason = _reason(trial)
        journal.append(self._results, {"kind": "death", "trial": _number(trial), "reason": reason})
        self._say(f"trial {_number(trial)} died ({reason}); it goes on from its last checkpoint")

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """It has died once too often."""
        self._end(trial, "failed", _reason(trial))

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """It is at its end, or was stopped."""
        last = trial.last_result
        if not last.get("done"):
            return  # the search itself was interrupted
        if last.get("diverged"):
            self._end(trial, "diverged", str(last.get("reason", "")))
        else:
            self._end(trial, "finished" if last.get("step") == self._steps else "stopped", "")

    def on_experiment_end(self, trials: list[Any], **info: Any) -> None:
        """The search is over or interrupted."""
        if self._bar is not None:
            self._bar.close()

    def _end(self, trial: Any, status: Status, reason: str) -> None:
        number, step = _number(trial), trial.last_result.get("step", 0)
        before = self._before.get(number)
        if before is not None and before.status in journal.ENDED:  # it only told its scores again
            status, reason = before.status, before.reason
        elif self._bar is not None:
            self._bar.update()
            score = trial.last_result.get("score")
            scored = f", {score:.2f} dB" if score and status in ("finished", "stopped") else ""
            self._say(f"trial {number} {status} at step {step} of {self._steps}{scored}{reason and f' ({reason})'}")
        journal.append(self._results, {"kind": "end", "trial": number, "status": status, "reason": reason})

    def _see(self, number: int, step: int, score: float | None) -> None:
        if score is None:
            return
        if step == self._steps and (self._best is None or score > self._best[0]):
            self._best = (score, number)
        if self._bar is not None:
            best = "" if self._best is None else f"best {self._best[0]:.2f} dB (trial {self._best[1]}), "
            self._bar.set_postfix_str(f"{best}trial {number} {score:.2f} dB at step {step}")

    def _say(self, line: str) -> None:
        if self._bar is not None:
            self._bar.write(line)


def _number(trial: Any) -> int:
    return int(trial.config["number"])


def _reason(trial: Any) -> str:
    """What Ray says last about an error: the kind of exception and its message, or how the process died."""
    path = trial.error_file
    lines = (
        [line for line in Path(path).read_text().splitlines() if line.strip()] if path and Path(path).exists() else []
    )
    return lines[-1].strip().split(". ")[0][:200] if lines else "unknown"
