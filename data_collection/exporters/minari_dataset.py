"""A dataset as Minari has them: https://minari.farama.org, format hdf5.

<root>/<name>/data/{main_data.hdf5, metadata.json}; an episode of T actions has
  observations  rgb (T+1, 3, H, W) uint8, depth (T+1, H, W) float32 metres, proprio (T+1, P) float32
  actions       (T, A) float32          rewards (T,); bounds as the shards tell, or the environment if it is of ours
  terminations, truncations (T,)        in the last step one of them is true: the first after a terminal state
  infos         our other columns: state, and the optional ones that the dataset has, (T+1, ...) each
  metadata      `rgbd`: camera, action_aggregation, action_scale, control_rate, and the rest of our attributes
"""

from __future__ import annotations

import copy
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from data_collection.attributes import FROM_CAMERA
from data_collection.dataset import RGBDDataset
from data_collection.environments import KNOWN_ENVS, known_env
from data_collection.schema import COLUMNS
from envs.errors import UsageError
from envs.files import written_aside

FIELDS = ("rgb", "depth", "proprio", "action", "reward")
"""The columns that Minari has a field for."""
LEFT_OUT = ("schema", *FROM_CAMERA, "versions", "imported_from")
"""Attributes that repeat what the camera says, or are about single files."""


def export_minari(
    dataset: RGBDDataset,
    name: str,
    root: Path | None = None,
    author: str | None = None,
    on_episode: Callable[[], object] = lambda: None,
) -> Path:
    """Write a Minari dataset, whole or not at all.

    Minari stores pictures (H, W, 3) of uint8 as JPEG, which costs a small picture most of its detail. Colour is
    therefore exported channels first, which Minari stores as it is.

    Args:
        dataset: what to export, read episode by episode.
        name: Minari's id, (namespace/)name-v0.
        root: folder of Minari datasets; Minari's own (MINARI_DATASETS_PATH, or ~/.minari/datasets) when None.
        author: of the data, if it shall be told.
        on_episode: called after every episode.

    Returns:
        the folder of the Minari dataset.

    Raises:
        UsageError: Minari is not installed, the name is not one, or it is taken.
    """
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.dataset.minari_storage import MinariStorage
        from minari.storage.datasets_root_dir import get_dataset_path
    except ImportError as error:
        raise UsageError(f"Minari cannot be imported ({error}); install it with: pip install 'minari<0.5.4'") from error
    try:
        parse_dataset_id(name)
    except (ValueError, TypeError) as error:
        raise UsageError(f"--name {name} is no name for Minari; give one like tabletop/play-c-v0") from error
    root = (root or get_dataset_path()).resolve()  # Minari cannot write to a relative folder
    target = root / name
    if target.exists():
        raise UsageError(f"{target} is there already; give another --name, or remove it with: minari delete {name}")
    aside = root / f".{name.replace('/', '-')}.{os.getpid()}.tmp"  # Minari does not look into hidden folders
    aside.mkdir(parents=True)
    try:
        spaces = observation_space(dataset), action_space(dataset)
        storage = MinariStorage.new(aside / "data", *spaces, env_spec=_env_spec(dataset))
        storage.update_metadata(_metadata(dataset, name, author, minari.__version__))
        for number in range(dataset.episodes):
            storage.update_episodes([EpisodeBuffer(**episode_buffer(dataset, number))])
            on_episode()
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(aside, target)
    except BaseException:
        shutil.rmtree(aside, ignore_errors=True)
        raise
    _name_spaces(root, target)
    return target


def observation_space(dataset: RGBDDataset) -> gymnasium.spaces.Dict:
    """The space of the exported observations."""
    camera = dataset.camera
    size = camera.height, camera.width
    return gymnasium.spaces.Dict(
        rgb=gymnasium.spaces.Box(0, 255, (3, *size), np.uint8),
        depth=gymnasium.spaces.Box(np.float32(camera.near), np.float32(camera.far), size, np.float32),
        proprio=_box(dataset.episode(0)["proprio"].shape[1]),
    )


def action_space(dataset: RGBDDataset) -> gymnasium.spaces.Box:
    """The space of the actions; without bounds where neither the shards tell them nor their environment is of ours."""
    bounds, env_id, size = dataset.attrs.get("action_bounds", ()), dataset.attrs["env_id"], dataset.action_dim
    if np.shape(bounds) == (2, size):
        return gymnasium.spaces.Box(*np.asarray(bounds, np.float32), dtype=np.float32)
    if known_env(env_id) and env_id not in KNOWN_ENVS:  # what is imported may be called dexhand, too
        return gymnasium.spaces.Box(-1, 1, (size,), np.float32)
    return _box(size)


def episode_buffer(dataset: RGBDDataset, number: int) -> dict[str, Any]:
    """One episode as the fields of Minari's `EpisodeBuffer`."""
    columns = dataset.episode(number)
    steps = len(columns["action"]) - 1
    camera, last = dataset.camera, np.arange(steps) == steps - 1
    terminated = dataset.episode_terminated[number]
    infos = {name: columns[name] for name in COLUMNS if name in columns and name not in FIELDS}
    if "segmentation" in infos:
        infos["segmentation"] = infos["segmentation"].astype(np.int16)  # bytes would become JPEG
    return {
        "observations": {
            "rgb": np.ascontiguousarray(columns["rgb"].transpose(0, 3, 1, 2)),
            "depth": np.clip(dataset.depth_metres(columns["depth"]), np.float32(camera.near), np.float32(camera.far)),
            "proprio": columns["proprio"],
        },
        "actions": columns["action"][:-1],
        "rewards": columns["reward"][:-1],
        "terminations": last & terminated,
        "truncations": last & ~terminated,
        "infos": infos,
    }


def _box(numbers: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-np.inf, np.inf, (numbers,), np.float32)


def _env_spec(dataset: RGBDDataset) -> gymnasium.envs.registration.EnvSpec | None:
    """Of the environment that the data comes from, so that Minari can make it again; None for the real world."""
    try:
        spec = copy.deepcopy(gymnasium.spec(dataset.attrs["env_id"]))  # the registry keeps its own
    except (gymnasium.error.Error, ModuleNotFoundError):
        return None
    spec.kwargs = {**spec.kwargs, **dataset.attrs["env_kwargs"]}
    return spec


def _metadata(dataset: RGBDDataset, name: str, author: str | None, version: str) -> dict[str, Any]:
    ours = {
        key: value.tolist() if isinstance(value, np.ndarray) else value
        for key, value in dataset.attrs.items()
        if key not in LEFT_OUT
    }
    ours["content_hash"] = dataset.content_hash
    metadata: dict[str, Any] = {
        "dataset_id": name,
        "minari_version": version,
        "algorithm_name": str(dataset.attrs["policy"]),
        "description": f"RGB-D episodes of {dataset.attrs['env_id']}; rgb is channels first, depth in metres",
        "rgbd": ours,
    }
    return {**metadata, "author": {author}} if author else metadata


def _name_spaces(root: Path, target: Path) -> None:
    """Mark the folders between the root and the dataset as Minari's namespaces."""
    for folder in target.parents:
        if folder == root:
            return
        mark = folder / "namespace_metadata.json"
        if not mark.exists():
            with written_aside(mark) as aside:
                aside.write_text("{}")
