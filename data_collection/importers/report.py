"""`import.json`: what was imported, from where, with which options, and what was wrong with it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from data_collection.importers.crew import ORIGIN, Outcome
from data_collection.importers.source import Part
from data_collection.schema import SHARD_PATTERN, DamagedShard, read_shard
from envs.errors import UsageError
from envs.files import write_json

REPORT_NAME = "import.json"
LINES_SHOWN = 20


@dataclass
class Report:
    """What is known of an import; grows while it runs."""

    options: Mapping[str, Any]
    """What fixes the content of every episode."""
    source: str
    """Where it was read from this time."""
    parts: int
    """Episodes that the source has, whole or not."""
    notes: Sequence[str] = ()
    """What is odd about the source as a whole."""
    outcomes: dict[int, Outcome] = field(default_factory=dict)

    @property
    def imported(self) -> list[Outcome]:
        """The parts that are episodes, in order."""
        return [outcome for _, outcome in sorted(self.outcomes.items()) if outcome.damage is None]

    @property
    def damaged(self) -> list[Outcome]:
        """The parts that could not be imported, in order."""
        return [outcome for _, outcome in sorted(self.outcomes.items()) if outcome.damage is not None]

    def save(self, folder: Path, complete: bool) -> None:
        """Write it beside the shards.

        Args:
            folder: of the dataset.
            complete: whether all that was asked for was tried.
        """
        episodes = [
            {
                "episode": outcome.index,
                "source": outcome.name,
                "status": "imported" if outcome.damage is None else "damaged",
                "frames": outcome.frames,
                "report": list(outcome.notes) if outcome.damage is None else [outcome.damage],
            }
            for _, outcome in sorted(self.outcomes.items())
        ]
        content = {
            "options": dict(self.options),
            "source": self.source,
            "complete": complete,
            "found": self.parts,
            "imported": len(self.imported),
            "damaged": len(self.damaged),
            "frames": sum(outcome.frames for outcome in self.imported),
            "notes": list(self.notes),
            "episodes": episodes,
        }
        write_json(folder / REPORT_NAME, content)

    def summary(self, folder: Path) -> str:
        """What to tell the user at the end."""
        imported, damaged = self.imported, self.damaged
        odd = [outcome for outcome in imported if outcome.notes]
        frames = sum(outcome.frames for outcome in imported)
        lines = [f"{len(imported)} episodes, {frames} frames in {folder}; {len(damaged)} damaged, skipped"]
        lines += [f"note: {note}" for note in self.notes]
        lines += [outcome.line() for outcome in (damaged + odd)[:LINES_SHOWN]]
        if len(damaged) + len(odd) > LINES_SHOWN:
            lines.append(f"... and {len(damaged) + len(odd) - LINES_SHOWN} more lines")
        return "\n".join([*lines, f"report in {folder / REPORT_NAME}; look at the data with: inspect-dataset {folder}"])


def check_continues(options: Mapping[str, Any], folder: Path) -> None:
    """Check that an import may go on in a folder.

    Raises:
        UsageError: what is there was imported with other options, or was not imported.
    """
    path = folder / REPORT_NAME
    if not path.exists():
        if any(folder.glob(SHARD_PATTERN)):
            raise UsageError(f"{folder} has shards but no {REPORT_NAME}; choose another folder to import into")
        return
    try:
        before = dict(json.loads(path.read_text())["options"])
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{path} is no report of an import ({error}); choose another folder") from error
    for name, asked in options.items():
        if before.get(name) != asked:
            raise UsageError(
                f"{folder} was imported with {name} = {before.get(name)!r}, not {asked!r}; run with the same options "
                "to go on with it, or choose another folder"
            )


def read_finished(folder: Path, parts: Sequence[Part]) -> dict[int, Outcome]:
    """The parts that are episodes already, from their shards.

    Raises:
        UsageError: a shard is damaged, or is not of this source.
    """
    finished = {}
    for path in sorted(folder.glob(SHARD_PATTERN)):
        shard = read_shard(path)
        origin = shard.attrs.get(ORIGIN)
        if not isinstance(origin, dict) or len(shard.ep_index) != 1:
            raise DamagedShard(path, f"no attribute '{ORIGIN}': not imported")
        index = int(shard.ep_index[0])
        there = parts[index].name if index < len(parts) else f"past its {len(parts)} episodes"
        if there != origin["part"]:
            raise UsageError(
                f"{path} holds {origin['part']}, but there it is {there} in the source; import from the same source, "
                "or into another folder"
            )
        finished[index] = Outcome(index, origin["part"], None, tuple(origin["notes"]), shard.rows)
    return finished
