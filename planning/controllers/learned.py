"""What controllers with a world model share: what the model is shown, and how planned moves become its actions."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from data_collection.actions import aggregate_actions
from envs.camera import CameraModel
from envs.errors import UsageError
from planning.controllers.base import Goal, Observation, PlanningController
from planning.icem import ICEM
from worldmodel.interface import camera_mismatch
from worldmodel.models import KINDS


class LearnedController(PlanningController):
    """Plans with a world model, which is shown frames and actions, nothing else.

    Of the world a controller of this kind is given RGB-D frames, proprioception (for where the end-effector is now, and
    the gripper's command), the camera's geometry and the goal. A subclass says in `imagine` what it makes of the
    model's predictions.

    Args:
        model: a world model (`worldmodel.load_model`) with `observe`, `step` and `frame_gap`.
        camera: geometry of the camera that takes the frames; but for its pose, the one that the model was trained with.
        planner: searches sequences of moves, each held for `frame_gap` control steps.
        context_frames: frames that the model is shown before every plan.
        options: effector, follower, reach; see `PlanningController`.

    Raises:
        UsageError: the model is of another kind, was trained with another camera, takes other actions than the
            effector's, or is to be shown no frame; in an episode: colours are not uint8.

    Attributes:
        kinds: of models that it can plan with; all, unless a subclass says otherwise.
        frames: the last frames that the model is shown, the newest last.
        designated: for each of them the pixels (M,) that show the body of the designated point, counted row by row.
    """

    kinds: tuple[str, ...] = tuple(KINDS)

    def __init__(
        self,
        model: Any,
        camera: CameraModel,
        planner: ICEM,
        context_frames: int = 2,
        **options: Any,
    ) -> None:
        if context_frames < 1:
            raise UsageError(f"context_frames is {context_frames}; show the model 1 frame or more")
        if model.kind not in self.kinds:
            raise UsageError(
                f"the model is a {model.kind}, but {type(self).__name__} plans with {' or '.join(self.kinds)};"
                " give a model of that kind"
            )
        difference = camera_mismatch(camera, model.camera)
        if difference is not None:
            raise UsageError(
                f"the camera has {difference}, which the {model.kind} was trained on; give a model of this camera, or"
                " an environment with the model's"
            )
        super().__init__(planner, model.frame_gap, **options)
        if model.action_dim != self.effector.action_dim:
            raise UsageError(
                f"the {model.kind} takes actions of {model.action_dim} numbers, those of the"
                f" {type(self.effector).__name__} have {self.effector.action_dim}; give the effector of its environment"
            )
        self.model, self.camera = model, camera
        self.context_frames = context_frames
        parameter = next(iter(model.parameters()), None)
        self.device = torch.device("cpu") if parameter is None else parameter.device

    def reset(self, observation: Observation, goal: Goal) -> None:
        super().reset(observation, goal)
        self.frames: deque[Observation] = deque(maxlen=self.context_frames)
        self.designated: deque[torch.Tensor] = deque(maxlen=self.context_frames)
        self.executed: deque[NDArray] = deque(maxlen=self.context_frames - 1)

    def decide(self, observation: Observation) -> NDArray:
        self.watch(observation)
        move = super().decide(observation)
        self.executed.append(self.aggregated(move))
        return move

    def watch(self, observation: Observation) -> None:
        """Take in a frame that the model is to be shown."""
        if observation["rgb"].dtype != np.uint8:
            raise UsageError(f"observation['rgb'] is {observation['rgb'].dtype}; give uint8 colours of 0 to 255")
        pixels = self.follower.pixels(observation, self.camera)
        if not self.frames:  # nothing came before: the first frame, standing still
            before = self.context_frames - 1
            self.frames.extend([observation] * before)
            self.designated.extend([pixels] * before)
            self.executed.extend([self.aggregated(np.zeros(self.effector.axes))] * before)
        self.frames.append(observation)
        self.designated.append(pixels)

    def aggregated(self, moves: NDArray) -> NDArray[np.float32]:
        """The actions (..., action_dim) of the model for moves (..., axes), each held for a frame gap."""
        return self.held(self.effector.action(moves))

    def held(self, actions: NDArray) -> NDArray[np.float32]:
        """The actions (..., action_dim) of the model for those of the environment, each held for a frame gap."""
        repeated = np.repeat(actions[..., None, :], self.hold, axis=-2)
        return aggregate_actions(repeated, self.model.context.action_aggregation, self.model.context.action_scale)

    def observed(self) -> Any:
        """The model's state after the frames so far."""
        rgb = self.tensor(np.stack([frame["rgb"] for frame in self.frames])) / 255
        depth = self.tensor(np.stack([frame["depth"] for frame in self.frames]))
        actions = np.reshape(np.array(self.executed, np.float32), (-1, self.model.action_dim))
        with torch.inference_mode():
            return self.model.observe(rgb.permute(0, 3, 1, 2)[None], depth[None, :, None], self.tensor(actions)[None])

    def seen_points(self, observation: Observation) -> torch.Tensor:
        """What the camera sees, (3, H, W), metres, camera frame."""
        return self.tensor(self.camera.unproject(observation["depth"])).permute(2, 0, 1)

    def in_camera(self, points: NDArray) -> torch.Tensor:
        """Points (..., 3) of the world in the camera frame, metres."""
        return self.tensor(self.camera.to_camera(points))

    def tensor(self, array: NDArray) -> torch.Tensor:
        """Float32, where the model is."""
        return torch.as_tensor(np.asarray(array, np.float32), device=self.device)
