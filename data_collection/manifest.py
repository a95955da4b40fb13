"""`dataset.json`: what a dataset's episodes are, so that the same command can go on with it."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_collection.policies.stable_baselines import without_folder
from data_collection.schema import SCHEMA_VERSION
from envs.errors import UsageError
from envs.files import write_json

MANIFEST_NAME = "dataset.json"


@dataclass(frozen=True)
class Manifest:
    """Everything that fixes the content of every episode, and how many there shall be."""

    env_id: str
    env_kwargs: dict[str, Any]
    policy: str
    seed: int
    steps: int
    """Actions in an episode."""
    ground_truth: bool
    episodes: int
    """Episodes asked for; more may be asked for later."""
    schema: int = SCHEMA_VERSION

    def save(self, folder: Path) -> None:
        write_json(folder / MANIFEST_NAME, dataclasses.asdict(self))

    def check_continues(self, before: Manifest, folder: Path) -> None:
        """Check that this run may add episodes to a folder that another began.

        Raises:
            UsageError: it would make other episodes; names the first field that differs.
        """
        for field in dataclasses.fields(self):
            if field.name == "episodes":
                continue
            asked, there = getattr(self, field.name), getattr(before, field.name)
            if field.name == "policy" and without_folder(asked) == without_folder(there):
                continue
            if asked != there:
                raise UsageError(
                    f"{folder} was collected with {field.name} = {there!r}, not {asked!r}; "
                    "run with the same options to go on with it, or choose another --out"
                )


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest of a folder; None where there is none.

    Raises:
        UsageError: it cannot be read.
    """
    path = folder / MANIFEST_NAME
    if not path.exists():
        return None
    try:
        return Manifest(**json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise UsageError(f"{path} is not a dataset manifest ({error}); collect into another folder") from error
