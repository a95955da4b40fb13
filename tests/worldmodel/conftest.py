"""A square that moves before a wall, known exactly without a simulator: a camera, clips of it, and models for them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch._dynamo.utils import counters

from data_collection.dataset import RGBDDataset
from data_collection.schema import quantise_depth
from data_collection.writer import write_shard
from envs.camera import CameraModel
from worldmodel.clips import ClipSource
from worldmodel.compilation import can_compile
from worldmodel.config import ModelConfig, ModelContext
from worldmodel.t3vip import T3VIP

AGGREGATION = ("sum", "sum", "sum", "rotate", "rotate", "rotate", "last")
SCALE = (0.02, 0.02, 0.02, 0.05, 0.05, 0.05, 1.0)
WALL_M, HALF_SIDE_M = 2.5, 0.2
SMALL = {"width": 0.25, "lstm_kernel": 3, "masks": 4}


def make_camera(width: int = 24, height: int = 16, near: float = 1.0, far: float = 3.0) -> CameraModel:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [110, 10, 40], degrees=True).as_matrix()
    pose[:3, 3] = [0.4, -1.0, 0.7]
    return CameraModel.from_fovy(width, height, 40.0, pose, near, far)


def square_episode(camera: CameraModel, rng: np.random.Generator, rows: int) -> dict[str, np.ndarray]:
    """An episode's columns. Actions 0 to 2 shift the square along the camera's axes, 5 turns it about the optical
    axis, the others do nothing; the column `state` holds centre (camera frame, metres) and angle."""
    actions = (0.7 * rng.uniform(-1, 1, 7) + 0.3 * rng.uniform(-1, 1, (rows, 7))).astype(np.float32)
    actions[-1] = 0
    start = np.array([*rng.uniform([-0.3, -0.15, 1.4], [0.3, 0.15, 1.6]), rng.uniform(-0.5, 0.5)])
    moves = actions[:-1, [0, 1, 2, 5]] * np.array(SCALE)[[0, 1, 2, 5]]
    states = start + np.concatenate([np.zeros((1, 4)), np.cumsum(moves, axis=0)])
    rays = camera.unproject(np.ones((camera.height, camera.width)))
    colour = rng.uniform(0.5, 1.0, 3)
    wall = np.stack([rays[..., 0], rays[..., 1], -rays[..., 0]], axis=-1) * 0.5 + 0.4
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("rgb", "depth", "segmentation", "body_pose")}
    for *centre, angle in states:
        local = (rays * centre[2] - centre)[..., :2] @ Rotation.from_euler("z", angle).as_matrix()[:2, :2]
        square = (np.abs(local) < HALF_SIDE_M).all(-1)
        paint = colour * (0.8 + local[..., :1])
        columns["rgb"].append((255 * np.where(square[..., None], paint, wall).clip(0, 1)).astype(np.uint8))
        columns["depth"].append(quantise_depth(np.where(square, centre[2], WALL_M), camera.near, camera.far))
        columns["segmentation"].append(square.astype(np.uint8))
        turn = Rotation.from_matrix(camera.world_T_camera[:3, :3]) * Rotation.from_euler("z", angle)
        pose = np.concatenate([camera.to_world(centre), turn.as_quat()[[3, 0, 1, 2]]])
        columns["body_pose"].append(np.stack([[0, 0, 0, 1, 0, 0, 0], pose]).astype(np.float32))
    stacked = {name: np.stack(values) for name, values in columns.items()}
    proprio = np.zeros((rows, 15), np.float32)
    proprio[:, :3] = camera.to_world(states[:, :3])
    return {**stacked, "action": actions, "proprio": proprio, "state": states, "reward": np.zeros(rows, np.float32)}


def write_squares(
    folder: Path,
    lengths: Sequence[int] = (16, 20, 9, 16, 16, 16),
    camera: CameraModel | None = None,
    seed: int = 0,
    **attrs: Any,
) -> Path:
    """A dataset of episodes with these numbers of rows, two shards of it where there are two episodes."""
    camera = camera or make_camera()
    rng = np.random.default_rng(seed)
    episodes = [square_episode(camera, rng, rows) for rows in lengths]
    described = {
        "env_id": "some/Squares-v0",
        "env_kwargs": {},
        "policy": "random",
        "seed": seed,
        "control_rate": 30.0,
        "camera": camera.to_dict(),
        "action_aggregation": list(AGGREGATION),
        "action_scale": list(SCALE),
        "body_names": ["world", "square"],
        "hand_body_ids": [1],
        "versions": {},
        "gl_renderer": "none",
    } | attrs
    half = (len(episodes) + 1) // 2
    folder.mkdir(parents=True, exist_ok=True)
    for number, first in enumerate(range(0, len(episodes), half)):
        some = episodes[first : first + half]
        write_shard(folder / f"shard-{number:05d}.h5", some, described, range(first, first + len(some)))
    return folder


def build_model(camera: CameraModel | None = None, seed: int = 0, moving: bool = True, **config: Any) -> T3VIP:
    """A small model; `moving` gives its untrained transforms motions of some pixels instead of nearly none."""
    torch.manual_seed(seed)
    context = ModelContext(
        env_id="some/Squares-v0",
        camera=(camera or make_camera()).to_json(),
        action_dim=7,
        frame_gap=3,
        control_rate=30.0,
        action_aggregation=AGGREGATION,
        action_scale=SCALE,
        action_mean=(0.0,) * 7,
        action_std=(1.0,) * 7,
    )
    model = T3VIP(ModelConfig(**{**SMALL, **config}), context)
    if moving:
        torch.nn.init.normal_(model.transforms.last.weight, std=0.05)
    return model.eval()


@pytest.fixture(autouse=True, scope="package")
def eager() -> Iterator[None]:
    """Tests do not wait for the compiler, but for those that compare with it."""
    with torch.compiler.set_stance("force_eager"):
        yield


@pytest.fixture
def both_ways() -> Callable[..., tuple[Any, Any]]:
    """Calls a function as it is, then with the functions in it compiled, so many of them; returns both results."""
    if not can_compile():
        pytest.skip("no C++ compiler")

    def call(function: Callable[[], Any], functions: int) -> tuple[Any, Any]:
        torch.compiler.reset()
        counters.clear()
        plain = function()
        assert not counters["stats"]["unique_graphs"]
        with torch.compiler.set_stance("default"):
            compiled = function()
        assert counters["stats"]["unique_graphs"] >= functions
        return plain, compiled

    return call


@pytest.fixture(scope="session")
def camera() -> CameraModel:
    return make_camera()


@pytest.fixture(scope="session")
def tiny_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six short episodes with ground truth, one of them too short for a clip of four frames; not to be changed."""
    return write_squares(tmp_path_factory.mktemp("squares") / "data")


@pytest.fixture(scope="session")
def source(tiny_dataset: Path) -> ClipSource:
    return ClipSource(RGBDDataset(tiny_dataset), 3)


@pytest.fixture(scope="session")
def random_vgg() -> dict[str, torch.Tensor]:
    """Weights for a PerceptualNetwork that has seen nothing."""
    generator = torch.Generator().manual_seed(0)
    widths = (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
    weights = {f"linear{i}": torch.rand(c, generator=generator) / c for i, c in enumerate((64, 128, 256, 512, 512))}
    for i, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
        weights[f"conv{i}.weight"] = torch.randn((outputs, inputs, 3, 3), generator=generator) / (9 * inputs) ** 0.5
        weights[f"conv{i}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
    return weights


@pytest.fixture(scope="session")
def write_dataset() -> Callable[..., Path]:
    return write_squares


@pytest.fixture
def make_model() -> Callable[..., T3VIP]:
    return build_model


@pytest.fixture
def camera_of() -> Callable[..., CameraModel]:
    return make_camera
