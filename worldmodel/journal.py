"""What a training run says of itself as it goes: metrics.jsonl and TensorBoard's files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from envs.files import written_aside
from worldmodel.scores import number


class Journal:
    """Open it at the step that a run starts or resumes from; close it at the end.

    Lines of steps that a killed process took after its last checkpoint are dropped: they will be written again.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self.path = folder / "metrics.jsonl"
        _forget_after(step, self.path)
        # TensorBoard forgets from purge_step on; what was told of the checkpoint itself stays.
        self.board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def write(self, kind: str, step: int, values: Mapping[str, Any]) -> None:
        """One line; of a list (one value per predicted step) TensorBoard is shown the last."""
        with self.path.open("a") as file:
            file.write(json.dumps({"kind": kind, "step": step, **finite(values)}, allow_nan=False) + "\n")
        for name, value in values.items():
            self.board.add_scalar(f"{kind}/{name}", value[-1] if isinstance(value, list) else value, step)

    def close(self) -> None:
        """Write what TensorBoard's writer still holds."""
        self.board.close()


def finite(values: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers and lists of them for JSON, which knows no NaN and no infinity: None in their place."""
    return {
        name: [number(v) for v in value] if isinstance(value, list) else number(value) for name, value in values.items()
    }


def _forget_after(step: int, path: Path) -> None:
    if not path.exists():
        return
    lines = path.read_text().splitlines(keepends=True)
    kept = [line for line in lines if _step_of(line) <= step]
    if kept != lines:
        with written_aside(path) as aside:
            aside.write_text("".join(kept))


def _step_of(line: str) -> float:
    """Of a line of metrics; inf for one that a kill has torn."""
    try:
        return float(json.loads(line)["step"]) if line.endswith("\n") else math.inf
    except ValueError:
        return math.inf
