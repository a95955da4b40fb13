"""What a dataset covers: ranges of its columns, the workspace reached, and what moved."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_collection.dataset import RGBDDataset
from data_collection.environments import KNOWN_ENVS, known_env
from data_collection.goal_statistics import goal_statistics
from data_collection.requirements import WORKSPACE

VOXEL = 0.05  # metres: edge of the cells in which workspace coverage is counted

BY_NUMBER = ("action", "proprio", "scene_obs")
"""Columns of a few numbers a row, each with a meaning of its own."""
SCENE_PARTS: dict[str, tuple[int, float]] = {
    "slider": (0, 0.02),
    "drawer": (1, 0.02),
    "button": (2, 0.003),
    "switch": (3, 0.01),
    "bulb": (4, 0.5),
    "led": (5, 0.5),
}
"""Part -> (its place in a tabletop's scene_obs, by how much it must move in an episode to count as moved)."""
BLOCKS: dict[str, int] = {"block_red": 6, "block_blue": 12, "block_pink": 18}
"""Block -> where its position (3) and Euler angles (3) start in a tabletop's scene_obs."""
BLOCK_MOVED = 0.02  # metres


def describe(dataset: RGBDDataset) -> dict[str, Any]:
    """Counts, ranges and shares of a dataset, ready for JSON."""
    lengths = dataset.episode_lengths
    rows = int(lengths.sum())
    report: dict[str, Any] = {
        "env_id": dataset.attrs["env_id"],
        "policy": dataset.attrs["policy"],
        "seed": dataset.attrs["seed"],
        "episodes": dataset.episodes,
        "frames": rows,
        "steps": rows - dataset.episodes,
        "episode_steps": {"min": int(lengths.min()) - 1, "max": int(lengths.max()) - 1},
        "hours": round((rows - dataset.episodes) / dataset.attrs["control_rate"] / 3600, 3),
        "image_size": [dataset.camera.height, dataset.camera.width],
        "bytes": sum(path.stat().st_size for path in dataset.files),
        "versions": dataset.makers,
        "content_hash": dataset.content_hash,
        "columns": column_ranges(dataset),
    }
    proprio, env = dataset.load("proprio"), known_env(str(dataset.attrs["env_id"]))
    if np.shape(dataset.attrs.get("workspace", ())) == WORKSPACE and proprio.shape[1] >= 3:
        report["workspace"] = workspace_coverage(proprio[:, :3], np.asarray(dataset.attrs["workspace"]))
    if "scene_obs" in dataset.columns and env is KNOWN_ENVS["tabletop"]:
        report["moved"] = moved_shares(dataset.load("scene_obs"), dataset.episode_slices)
    if "scene_obs" in dataset.columns and env is KNOWN_ENVS["dexhand"]:
        report["goals"] = goal_statistics(dataset.load("scene_obs"), dataset.episode_slices)
    return report


def column_ranges(dataset: RGBDDataset) -> dict[str, dict[str, Any]]:
    """Shape, dtype and range of the columns; depth in metres, what is in `BY_NUMBER` number by number.

    The others are read episode by episode: there may be more pictures and states than fit in memory.
    """
    ranges = {name: _range_by_number(dataset.load(name)) for name in BY_NUMBER if name in dataset.columns}
    others = [name for name in dataset.columns if name not in ranges]
    ends: dict[str, list[Any]] = {name: [] for name in others}
    for episode in dataset.stream(others):
        for name, values in episode.items():
            ends[name] += [values.min(), values.max()]
            shape = [int(dataset.episode_lengths.sum()), *values.shape[1:]]
            ranges[name] = {"shape": shape, "dtype": str(values.dtype)}
    for name in others:
        low, high = np.min(ends[name]), np.max(ends[name])
        if name == "depth":
            near, far = dataset.depth_metres(np.array([low, high]))
            ranges[name] |= {"unit": "m", "min": round(float(near), 4), "max": round(float(far), 4)}
        else:
            ranges[name] |= {"min": float(low), "max": float(high)}
    return {name: ranges[name] for name in dataset.columns}


def _range_by_number(values: NDArray[Any]) -> dict[str, Any]:
    return {
        "shape": list(values.shape),
        "dtype": str(values.dtype),
        "min": np.round(values.min(axis=0), 4).tolist(),
        "max": np.round(values.max(axis=0), 4).tolist(),
        "std": np.round(values.std(axis=0, dtype=np.float64), 4).tolist(),
    }


def workspace_coverage(tcp: NDArray[Any], workspace: NDArray[Any]) -> dict[str, Any]:
    """How much of the workspace the end-effector has been to.

    Args:
        tcp: (N, 3) positions in the world, metres.
        workspace: (2, 3) low and high corner, metres.
    """
    low, high = workspace
    cells = np.maximum(1, np.round((high - low) / VOXEL)).astype(int)
    cell = np.minimum(((tcp - low) / (high - low) * cells).astype(np.int64), cells - 1)
    inside = ((tcp >= low) & (tcp <= high)).all(axis=1)
    counts = np.bincount(np.ravel_multi_index(tuple(cell[inside].T), tuple(cells)), minlength=int(np.prod(cells)))
    visited = counts > 0
    shares = counts[visited] / max(1, counts.sum())
    return {
        "cell_m": VOXEL,
        "cells": cells.tolist(),
        "share_of_cells_visited": round(float(visited.mean()), 4),
        "share_of_frames_inside": round(float(inside.mean()), 4),
        # 1 where all cells are visited equally often: the exponential of the entropy, as a share of the cells
        "evenness": round(float(np.exp(-(shares * np.log(shares)).sum()) / len(counts)) if len(shares) else 0.0, 4),
        "span_m": np.round(np.ptp(tcp, axis=0), 3).tolist(),
    }


def moved_shares(scene_obs: NDArray[Any], slices: NDArray[np.int64]) -> dict[str, float]:
    """In which share of the episodes each fixture and block of a tabletop moved.

    Args:
        scene_obs: (N, 24), CALVIN's layout.
        slices: (E, 2) first row and row past the last of each episode.
    """
    moved: dict[str, list[bool]] = {name: [] for name in (*SCENE_PARTS, *BLOCKS)}
    for start, stop in slices:
        episode = scene_obs[start:stop]
        for name, (place, least) in SCENE_PARTS.items():
            moved[name].append(bool(np.ptp(episode[:, place]) >= least))
        for name, place in BLOCKS.items():
            position = episode[:, place : place + 3]
            moved[name].append(bool(np.linalg.norm(position - position[0], axis=1).max() >= BLOCK_MOVED))
    return {name: round(float(np.mean(episodes)), 4) for name, episodes in moved.items()}
