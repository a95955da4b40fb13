"""Control steps a second of the collector."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from data_collection.collect import Config
from data_collection.process_workers import ProcessPool
from data_collection.workers import Collected, collect_episodes


def collected_steps(workers: int, episodes: int, steps: int) -> float:
    """Steps a second of scripted play on the tabletop, written to the disk.

    Counts from each worker's first episode to the last one that all workers were still busy beside: neither starting
    up nor running out of work is part of it.
    """
    if episodes < 2 * workers:
        raise ValueError(f"{episodes} episodes are too few for {workers} workers; give at least {2 * workers}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        manifest = Config(folder, episodes=episodes, steps=steps, workers=workers).manifest()
        ends = []
        for event in collect_episodes(ProcessPool(manifest, folder, 300.0), folder, range(episodes), workers):
            if not isinstance(event, Collected):
                raise RuntimeError(f"episode {event.episode} was lost: {event.reason}")
            ends.append(time.perf_counter())
    first, last = workers - 1, episodes - workers
    return (last - first) * steps / (ends[last] - ends[first])
