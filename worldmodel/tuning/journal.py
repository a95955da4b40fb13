"""`results.jsonl`: everything that happened in a search, a line each, and what it comes to.

    {"kind": "begin", "trial": 3, "point": {...}}         a process took it up, for the first time or again
    {"kind": "score", "trial": 3, "step": 178, "score": 41.2, ...}
    {"kind": "death", "trial": 3, "reason": "..."}                      its process died; it starts again
    {"kind": "end", "trial": 3, "status": "stopped", "reason": ""}

A line may come twice where a search was killed and went on; the later one counts. The last one may be torn.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

Status = Literal["running", "finished", "stopped", "diverged", "failed"]
ENDED: tuple[Status, ...] = ("finished", "stopped", "diverged")
"""Of trials that no search takes any further; one that `failed` is tried again."""
JOURNAL = "results.jsonl"
PARTS = ("psnr", "depth_psnr", "flow_error_moving", "tracking_error")
"""Told with a score: the two that it is the sum of, dB, and with ground truth the motion that it does not see."""


@dataclass
class Trial:
    """What is known of a trial."""

    number: int
    """0 has the preset's own values."""
    point: dict[str, float] = field(default_factory=dict)
    scores: dict[int, float] = field(default_factory=dict)
    """Step -> score, dB."""
    parts: dict[int, dict[str, float]] = field(default_factory=dict)
    """Step -> those of `PARTS` that are known."""
    status: Status = "running"
    """`stopped` at a rung; `diverged`: its losses or scores were no numbers; `failed`: died too often."""
    deaths: int = 0
    reason: str = ""
    """Of a trial that diverged or failed."""

    @property
    def step(self) -> int:
        """How far it is known to have come."""
        return max(self.scores, default=0)

    @property
    def score(self) -> float | None:
        """Its last."""
        return self.scores[self.step] if self.scores else None


def append(path: Path, line: dict[str, Any]) -> None:
    """Add a line; one that a killed writer has torn is closed first."""
    with path.open("ab+") as file:
        if file.tell():
            file.seek(-1, 2)
            torn = file.read(1) != b"\n"
        else:
            torn = False
        file.write((b"\n" if torn else b"") + json.dumps(line).encode() + b"\n")


def read(path: Path) -> list[dict[str, Any]]:
    """The lines that are whole, in the order in which they were written."""
    lines: list[dict[str, Any]] = []
    for text in path.read_text().splitlines() if path.exists() else ():
        try:
            line = json.loads(text)
        except ValueError:
            continue
        if isinstance(line, dict) and isinstance(line.get("trial"), int):
            lines.append(line)
    return lines


def trials(path: Path) -> list[Trial]:
    """All trials by number."""
    known: dict[int, Trial] = {}
    for line in read(path):
        trial = known.setdefault(line["trial"], Trial(line["trial"]))
        kind = line.get("kind")
        if kind == "begin":
            if line["point"] != trial.point:  # a search that lost its state drew anew
                trial = known[trial.number] = Trial(trial.number, line["point"])
            if trial.status not in ENDED:  # else it only tells its scores again
                trial.status = "running"
        elif kind == "score":
            step = int(line["step"])
            trial.scores[step] = float(line["score"])
            trial.parts[step] = {name: float(line[name]) for name in PARTS if name in line}
        elif kind == "death":
            trial.deaths += 1
        elif kind == "end":
            trial.status, trial.reason = line["status"], line.get("reason", "")
    return [known[number] for number in sorted(known)]
