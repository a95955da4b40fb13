"""Servoing by a model of pictures (SV2P, SNA, CDNA): plan with pixels that the predicted kernels move."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from envs.camera import CameraModel
from planning.controllers.base import Goal, Observation, tcp_position
from planning.controllers.learned import LearnedController
from planning.costs import discounted_distance
from planning.icem import ICEM, CostFunction
from worldmodel.pixel_tracking import PixelTrack, uniform_pixels
from worldmodel.tracking import hand_pixels


class PixelController(LearnedController):
    """Brings the TCP to a pixel by the predicted motion of the hand's pixels in the picture.

    Depth and the measured TCP serve to find the pixels of the hand, the same that T3VIP follows, and the pixel of the
    TCP. The goal is a pixel; the point in space behind it is withheld.

    Args:
        name: of the model.
        model, camera, planner, options: see `LearnedController`.
    """

    def __init__(self, name: str, model: Any, camera: CameraModel, planner: ICEM, **options: Any) -> None:
        super().__init__(model, camera, planner, **options)
        self.name = name

    def reset(self, observation: Observation, goal: Goal) -> None:
        super().reset(observation, Goal(np.full(3, np.nan), goal.pixel))

    def imagine(self, observation: Observation) -> CostFunction:
        state = self.observed()
        start = PixelTrack.start(self.designated(observation), self.designated(self.frames[0]))
        # The TCP is no pixel of the hand, it keeps a constant offset from their mean. As the hand's mean is to be that
        # much beside the goal, the goal moves instead.
        tcp = self.tensor(self.camera.project(self.camera.to_camera(tcp_position(observation))))
        target = self.tensor(self.goal.pixel) - (tcp - start.expected_position()[0])

        @torch.inference_mode()
        def cost(sequences: NDArray) -> NDArray:
            actions = self.tensor(self.aggregated(sequences))  # (N, h, A)
            future, track = state, start
            distances = []
            for step in range(actions.shape[1]):
                last = step + 1 == actions.shape[1]  # nobody looks at its picture
                future, prediction = self.model.step(future, actions[:, step], paint=False, picture=not last)
                track = track.advance(prediction)
                distances.append(track.expected_distance(target))
            return discounted_distance(torch.stack(distances, dim=1).cpu().numpy())

        return cost

    def designated(self, observation: Observation) -> torch.Tensor:
        """A uniform distribution (H, W) over the pixels of the hand."""
        hand = hand_pixels(self.seen_points(observation), self.tcp_in_camera(observation), self.radius)
        return uniform_pixels(hand, self.camera.height, self.camera.width)
