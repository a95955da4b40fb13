"""Files that are whole or not there: written aside, synced, renamed. And a lock that a killed process releases."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from envs.errors import UsageError

LOCK_NAME = ".lock"
ASIDE = re.compile(r".+\.\d+\.tmp")  # what `written_aside` calls a file, with the number of its process


@contextlib.contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Give the path of a temporary file that takes the place of `path` when the block ends well.

    The temporary name, NAME.<pid>.tmp, carries the process id, so that two processes never write into the same file. An
    exception in the block removes it; what a killed process leaves, `remove_leftovers` clears. What is no file, such as
    /dev/stdout, has no other to take its place: it is written to itself.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        yield path
        return
    aside = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        yield aside
        _sync(aside)
        os.replace(aside, path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    _sync(path.parent)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write `content` as JSON, atomically."""
    with written_aside(path) as aside:
        aside.write_text(json.dumps(content, indent=2) + "\n")


def remove_leftovers(folder: Path) -> list[str]:
    """Remove the temporary files of killed writers, and nothing else that ends in `.tmp`.

    Hold the folder's lock before calling, and know that it is a folder of ours.

    Returns:
        the names of what was removed.
    """
    leftovers = sorted(path for path in folder.iterdir() if ASIDE.fullmatch(path.name) and path.is_file())
    for leftover in leftovers:
        leftover.unlink(missing_ok=True)
    return [leftover.name for leftover in leftovers]


@contextlib.contextmanager
def locked(folder: Path, patience: float = 0.0) -> Iterator[int]:
    """Be the only process that writes in `folder`; the kernel frees the lock when the process dies.

    Args:
        folder: to write in.
        patience: seconds to wait for another process to end.

    Yields:
        The lock's file descriptor: a child process that inherits it holds the lock too.

    Raises:
        UsageError: another process holds it.
    """
    handle = os.open(folder / LOCK_NAME, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o644)
    deadline = time.monotonic() + patience
    try:
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() >= deadline:
                    raise UsageError(
                        f"another process is writing to {folder}; wait for it to end, or choose another folder"
                    ) from error
                time.sleep(0.2)
        yield handle
    finally:
        os.close(handle)


def _sync(path: Path) -> None:
    """Have the kernel put a file or a folder's entries on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
