"""The folder of an evaluation: its settings, and one line per finished episode, so that a killed run goes on.

DIR/config.json       what the episodes depend on
DIR/episodes.jsonl    one Record per line, appended and synced as each episode ends
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from envs.errors import UsageError
from envs.files import write_json
from planning.episode import Record

CONFIG_NAME, EPISODES_NAME = "config.json", "episodes.jsonl"
EpisodeKey = tuple[str, int, int]
"""Model, setup, repeat."""


class EpisodeLog:
    """The records of an evaluation's folder, old and new.

    Args:
        folder: made if missing.
        settings: what an episode's outcome depends on; must be those of the folder if it holds episodes already.

    Raises:
        UsageError: the folder holds episodes of other settings, or lines that are no records.
    """

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / EPISODES_NAME
        self.records: dict[EpisodeKey, Record] = {}
        if self._path.exists():
            self._read()
        config, settings = folder / CONFIG_NAME, json.loads(json.dumps(settings))
        if self.records and config.exists():
            self._agree(config, settings)
        write_json(config, settings)

    def append(self, record: Record) -> None:
        """Add a finished episode; it is on the disk when this returns."""
        with self._path.open("a") as lines:
            lines.write(json.dumps(record.to_dict()) + "\n")
            lines.flush()
            os.fsync(lines.fileno())
        self.records[record.model, record.setup, record.repeat] = record

    def _agree(self, path: Path, settings: dict[str, Any]) -> None:
        """Models may be added to a folder; all else must stay, or the episodes could not be compared.

        The weights of the other models that the folder holds episodes of are taken over into the settings.
        """
        try:
            before = json.loads(path.read_text())
        except ValueError as error:
            raise UsageError(f"{path} is no JSON ({error}); give another --out") from error
        for key in sorted(before.keys() | settings.keys() - {"checkpoints"}):
            if key != "checkpoints" and before.get(key) != settings.get(key):
                raise UsageError(
                    f"{path.parent} holds episodes with {key} {before.get(key)!r}, not {settings.get(key)!r};"
                    " give another --out, or the same options"
                )
        held = {model for model, _, _ in self.records}
        for model, weights in before.get("checkpoints", {}).items():
            if model in held and settings["checkpoints"].setdefault(model, weights) != weights:
                raise UsageError(
                    f"{path.parent} holds episodes of another {model} checkpoint; give another --out, or that one"
                )

    def _read(self) -> None:
        """Take in the finished episodes; a last line that a killed process left unfinished is cut off."""
        text = self._path.read_text()
        whole = text[: text.rfind("\n") + 1]
        if whole != text:
            with self._path.open("r+") as lines:
                lines.truncate(len(whole.encode()))
        for number, line in enumerate(whole.splitlines(), 1):
            try:
                record = Record(**json.loads(line))
            except (ValueError, TypeError) as error:
                raise UsageError(f"{self._path}, line {number} is no episode ({error}); remove that line") from error
            self.records[record.model, record.setup, record.repeat] = record
