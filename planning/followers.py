"""How a controller knows where its point is now, and which pixels show the body that it belongs to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from envs.camera import CameraModel
from envs.errors import UsageError
from planning.effectors import Effector, Observation
from planning.goals import Goal
from planning.point_tracker import PointTracker
from worldmodel.tracking import HandTrack, SurfaceTrack, Track, hand_pixels

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """What a point that is followed by its looks lies on."""

    extent: float
    """metres around the point that the tracked piece of surface extends at the most"""
    step: float
    """metres of depth from pixel to pixel beyond which the surface ends"""
    colour: float
    """how far colours, in [0, 1], may be from that at the point before the surface ends; 1 for any"""
    radius: float
    """metres around the point within which pixels say how the body moves"""


class Follower(ABC):
    """Follows the designated point by observations.

    Attributes:
        point: (3,) metres, world frame, where the point is now.
    """

    point: Array

    @abstractmethod
    def reset(self, observation: Observation, goal: Goal) -> None:
        """Start an episode with its first observation."""

    @abstractmethod
    def observe(self, observation: Observation) -> None:
        """Take in the observation of every control step, the first one again included."""

    @abstractmethod
    def pixels(self, observation: Observation, camera: CameraModel) -> torch.Tensor:
        """The pixels (M,) int64, counted row by row, that show the body of the point in the last observation."""

    @staticmethod
    @abstractmethod
    def track(body: torch.Tensor, point: torch.Tensor, K: torch.Tensor, futures: int) -> Track:
        """The point (3,), by what those pixels show (M, 3), in N futures; camera frame, metres. `K`: intrinsics."""


class EffectorFollower(Follower):
    """The point is the end-effector's own: proprioception says where it is.

    What moves among the pixels near it is the end-effector, so its motion is set apart from what stands still there.

    Args:
        effector: whose.
    """

    def __init__(self, effector: Effector) -> None:
        self.effector = effector

    def reset(self, observation: Observation, goal: Goal) -> None:
        if goal.designated is not None:
            raise UsageError("a point is designated, but the controller moves its own; give it a SurfaceFollower")
        self.observe(observation)

    def observe(self, observation: Observation) -> None:
        self.point = self.effector.position(observation)

    def pixels(self, observation: Observation, camera: CameraModel) -> torch.Tensor:
        seen = torch.as_tensor(camera.unproject(observation["depth"]).astype(np.float32)).permute(2, 0, 1)
        tcp = camera.to_camera(self.effector.position(observation)).astype(np.float32)
        return hand_pixels(seen, torch.as_tensor(tcp))

    @staticmethod
    def track(body: torch.Tensor, point: torch.Tensor, K: torch.Tensor, futures: int) -> Track:
        return HandTrack.start(body, point, K, futures)


class SurfaceFollower(Follower):
    """The point lies on a thing and is followed by its looks.

    Args:
        camera: that takes the frames.
        surface: of the thing.
    """

    def __init__(self, camera: CameraModel, surface: Surface) -> None:
        self.camera, self.surface = camera, surface
        self.tracker = PointTracker(camera, surface.extent, surface.step, surface.colour)

    def reset(self, observation: Observation, goal: Goal) -> None:
        if goal.designated is None:
            raise UsageError("no point is designated; give the goal one that the camera sees")
        self.tracker.reset(observation["rgb"], observation["depth"], goal.designated)

    def observe(self, observation: Observation) -> None:
        self.tracker.update(observation["rgb"], observation["depth"])

    @property
    def point(self) -> Array:  # type: ignore[override]
        return self.tracker.point

    def pixels(self, observation: Observation, camera: CameraModel) -> torch.Tensor:
        places = camera.project(camera.to_camera(self.tracker.around(self.surface.radius)))
        u, v = (
            np.rint(places[:, i]).clip(0, size - 1).astype(np.int64)
            for i, size in ((0, camera.width), (1, camera.height))
        )
        return torch.as_tensor(np.unique(v * camera.width + u))

    @staticmethod
    def track(body: torch.Tensor, point: torch.Tensor, K: torch.Tensor, futures: int) -> Track:
        return SurfaceTrack.start(body, point, K, futures)
