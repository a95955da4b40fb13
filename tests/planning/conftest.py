"""A world model that is exact by construction, and a world for it that consists of arrays only."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from envs.camera import CameraModel
from planning.controllers import Goal
from worldmodel.kernels import KernelPrediction

AGGREGATION = ("sum", "sum", "sum", "rotate", "rotate", "rotate", "last")
SCALE = (0.02, 0.02, 0.02, 0.05, 0.05, 0.05, 1.0)


@dataclass
class ExactModel:
    """Every pixel moves as the action says, turned into the camera's frame. Remembers what it was shown.

    `channels` reorders the action's numbers first, to spoil the model.
    """

    camera: CameraModel
    frame_gap: int = 3
    action_dim: int = 7
    channels: tuple[int, ...] = tuple(range(7))
    shown: list[tuple[torch.Tensor, ...]] = field(default_factory=list)
    asked: list[torch.Tensor] = field(default_factory=list)
    kind: str = "t3vip"

    def __post_init__(self) -> None:
        self.context = SimpleNamespace(
            env_id="t3vip/TabletopC-v0",
            action_aggregation=AGGREGATION,
            action_scale=SCALE,
            frame_gap=self.frame_gap,
            control_rate=30.0,
        )

    def parameters(self) -> Any:
        return iter(())

    def state_dict(self) -> dict:
        return {}

    def to(self, device: str) -> ExactModel:
        return self

    def eval(self) -> ExactModel:
        return self

    def observe(self, rgb, depth, actions):
        self.shown.append((rgb, depth, actions))
        assert rgb.shape[0] == depth.shape[0] == actions.shape[0] == 1
        assert rgb.shape[1] == depth.shape[1] == actions.shape[1] + 1
        assert rgb.dtype == depth.dtype == actions.dtype == torch.float32
        return None  # one past for all futures

    def step(self, state, action, latent=None, paint=True, picture=True):
        self.asked.append(action)
        count = len(action)
        assert action.shape == (count, self.action_dim) and state in (None, count)
        return count, self.predict(self.shift(action))

    def shift(self, action):
        """Metres in the camera's frame, (N, 3)."""
        rotation = torch.tensor(self.camera.world_T_camera[:3, :3].tolist())
        return 0.02 * action[:, self.channels][:, :3] @ rotation

    def predict(self, shift):
        count = len(shift)
        transform = torch.cat([torch.eye(3).expand(count, 3, 3), shift[:, :, None]], dim=2)
        field_ = transform[..., None, None].expand(count, 3, 4, self.camera.height, self.camera.width)
        masks = torch.zeros(count, 2, self.camera.height, self.camera.width)  # all that is seen moves
        return SimpleNamespace(transform=field_, masks=masks)


class ExactPixelModel(ExactModel):
    """Shifts the picture as the action says, which it knows of an arm that is 4.2 m away; one kernel does it all."""

    reach = 4  # pixels; farther than an action moves anything

    def __init__(self, camera: CameraModel, kind: str = "sv2p", **options: Any) -> None:
        super().__init__(camera, frame_gap=1, kind=kind, **options)

    def predict(self, shift):
        pixels = shift[:, :2] * float(self.camera.K[0, 0]) / 4.2  # (N, 2)
        places = torch.arange(-self.reach, self.reach + 1.0)
        # The entry right of the centre brings a pixel from the right: to move by +d the weight is at -d, linearly.
        u, v = ((1 - (places + pixels[:, axis, None]).abs()).clamp(min=0) for axis in (0, 1))
        masks = torch.zeros(len(shift), 3, self.camera.height, self.camera.width)
        masks[:, 1] = 1
        return KernelPrediction(None, masks, None, (v[:, :, None] * u[:, None])[:, None])


class ArrayWorld:
    """A point that does as it is told, seen by a still camera; nothing of a simulator."""

    def __init__(self, camera: CameraModel, start: np.ndarray) -> None:
        self.camera, self.tcp, self.steps = camera, np.array(start, float), 0

    def observation(self) -> dict[str, np.ndarray]:
        size = (self.camera.height, self.camera.width)
        proprio = np.zeros(15, np.float32)
        proprio[:3], proprio[14] = self.tcp, -1
        depth = np.full(size, self.camera.to_camera(self.tcp)[2], np.float32)
        return {"rgb": np.full((*size, 3), self.steps % 256, np.uint8), "depth": depth, "proprio": proprio}

    def step(self, action: np.ndarray) -> dict[str, np.ndarray]:
        assert action.shape == (7,) and np.abs(action).max() <= 1
        self.tcp += 0.02 * action[:3]
        self.steps += 1
        return self.observation()


@pytest.fixture
def camera() -> CameraModel:
    """CALVIN's: 10 degrees, from 4.2 m."""
    forward = -np.array([2.897, -2.137, 2.163])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = np.array([0, 0, 0.5]) - 4.2 * forward
    return CameraModel.from_fovy(64, 64, 10.0, pose, 3.5, 5.5)


@pytest.fixture
def world(camera) -> ArrayWorld:
    return ArrayWorld(camera, np.array([0.05, -0.1, 0.5]))


@pytest.fixture
def goal(camera, world) -> Goal:
    point = world.tcp + np.array([0.2, 0.1, -0.15])
    return Goal(point, camera.project(camera.to_camera(point)))


@pytest.fixture
def exact_model(camera) -> ExactModel:
    return ExactModel(camera)


@pytest.fixture
def make_exact_model():
    return ExactModel


@pytest.fixture
def pixel_model(camera) -> ExactPixelModel:
    return ExactPixelModel(camera)


@pytest.fixture
def make_pixel_model():
    return ExactPixelModel
