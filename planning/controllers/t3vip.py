"""Servoing by T3VIP: plan in predicted point clouds."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from data_collection.actions import aggregate_actions
from envs.camera import CameraModel
from planning.controllers.base import Goal, Observation, PlanningController, tcp_position
from planning.costs import discounted_distance, env_action
from planning.icem import ICEM, CostFunction
from worldmodel.tracking import HAND_RADIUS, HandTrack


class T3VIPController(PlanningController):
    """Brings the TCP to a point by the predicted motion of the hand's pixels.

    Of the world it is given RGB-D frames, proprioception (for where the TCP is now, and the gripper's command), the
    camera's geometry and the goal. The model gets frames and actions only.

    Args:
        model: a world model (`worldmodel.load_model`) with `observe`, `step` and `frame_gap`.
        camera: geometry of the camera that takes the frames.
        planner: searches sequences of translations, each held for `frame_gap` control steps.
        context_frames: frames that the model is shown before every plan.
        radius: metres around the TCP that are taken for the hand.
    """

    name = "t3vip"

    def __init__(
        self,
        model: Any,
        camera: CameraModel,
        planner: ICEM,
        context_frames: int = 2,
        radius: float = HAND_RADIUS,
    ) -> None:
        super().__init__(planner, model.frame_gap, model.action_dim)
        self.model, self.camera, self.radius = model, camera, radius
        self.context_frames = context_frames
        parameter = next(iter(model.parameters()), None)
        self.device = torch.device("cpu") if parameter is None else parameter.device

    def reset(self, observation: Observation, goal: Goal) -> None:
        super().reset(observation, goal)
        self._frames: deque[Observation] = deque(maxlen=self.context_frames)
        self._executed: deque[NDArray] = deque(maxlen=self.context_frames - 1)
        self._goal_camera = self.camera.to_camera(goal.point_world)

    def decide(self, observation: Observation) -> NDArray:
        if not self._frames:  # nothing came before: the first frame, standing still
            self._frames.extend([observation] * (self.context_frames - 1))
            self._executed.extend([self.aggregated(np.zeros(3))] * (self.context_frames - 1))
        self._frames.append(observation)
        move = super().decide(observation)
        self._executed.append(self.aggregated(move))
        return move

    def aggregated(self, moves: NDArray) -> NDArray[np.float32]:
        """The actions (..., action_dim) of the model for translations (..., 3), each held for a frame gap."""
        actions = env_action(moves, self.gripper, self.action_dim)
        held = np.repeat(actions[..., None, :], self.hold, axis=-2)
        return aggregate_actions(held, self.model.context.action_aggregation, self.model.context.action_scale)

    def imagine(self, observation: Observation) -> CostFunction:
        with torch.inference_mode():
            state = self.model.observe(*self._context())
        points = self._tensor(self.camera.unproject(observation["depth"])).permute(2, 0, 1)
        tcp = self._tensor(self.camera.to_camera(tcp_position(observation)))
        goal, intrinsics = self._tensor(self._goal_camera), self._tensor(self.camera.K)

        @torch.inference_mode()
        def cost(sequences: NDArray) -> NDArray:
            actions = self._tensor(self.aggregated(sequences))  # (N, h, A)
            future = state  # one past for all futures: the first step encodes it once
            track = HandTrack.start(points, tcp, intrinsics, len(sequences), self.radius)
            distances = []
            for step in range(actions.shape[1]):
                future, prediction = self.model.step(future, actions[:, step], paint=False)
                track = track.advance(prediction.transform, prediction.masks[:, :1])
                distances.append((track.tcp - goal).norm(dim=-1))
            return discounted_distance(torch.stack(distances, dim=1).cpu().numpy())

        return cost

    def _context(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        rgb = self._tensor(np.stack([frame["rgb"] for frame in self._frames])) / 255
        depth = self._tensor(np.stack([frame["depth"] for frame in self._frames]))
        actions = np.reshape(np.array(self._executed, np.float32), (-1, self.action_dim))
        return rgb.permute(0, 3, 1, 2)[None], depth[None, :, None], self._tensor(actions)[None]

    def _tensor(self, array: NDArray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(array, np.float32), device=self.device)
