"""What was measured on batches of clips, kept on the disk so that a killed evaluation goes on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from envs.files import written_aside
from worldmodel.scores import Statistics


class Shelf:
    """Statistics of one subject, a file a batch.

    Args:
        folder: for all subjects of an evaluation; None keeps nothing.
        subject: all that the measurements depend on: those of another subject are not found.
    """

    def __init__(self, folder: Path | None = None, subject: Mapping[str, Any] | None = None) -> None:
        self._folder: Path | None = None
        if folder is not None:
            digest = hashlib.sha256(json.dumps(subject, sort_keys=True).encode()).hexdigest()
            self._folder = folder / digest[:16]

    def find(self, batch: int) -> Statistics | None:
        """What has been measured on a batch, if anything has."""
        if self._folder is None:
            return None
        try:
            return load_file(self._path(self._folder, batch))
        except (SafetensorError, OSError):  # not there, or damaged: it is to be measured
            return None

    def put(self, batch: int, measured: Statistics) -> Statistics:
        """Keep what was measured on a batch; returns it."""
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            with written_aside(self._path(self._folder, batch)) as aside:
                save_file({name: value.cpu().contiguous() for name, value in measured.items()}, aside)
        return measured

    @staticmethod
    def _path(folder: Path, batch: int) -> Path:
        return folder / f"{batch:05d}.safetensors"


NOTHING_KEPT = Shelf()
"""For measurements that are quickly made again."""
