"""Servoing by a model of pictures (SV2P, SNA, CDNA): plan with pixels that the predicted kernels move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from planning.controllers.base import Goal, Observation
from planning.controllers.learned import LearnedController
from planning.costs import discounted_distance
from planning.icem import CostFunction
from worldmodel.pixel_tracking import PixelTrack, uniform_pixels

PIXEL_MODELS = ("sv2p", "sna", "cdna")
"""The world models that predict pictures only. A controller that plans with one knows its goal as a pixel."""


class PixelController(LearnedController):
    """Brings the point to a pixel by the predicted motion, in the picture, of the pixels around it.

    Depth and where the point is now serve to find the pixels of its body, the same that T3VIP follows, and the pixel of
    the point. The goal is a pixel; the point in space behind it is withheld.

    Args:
        model, camera, planner, options: see `LearnedController`.
    """

    kinds, knows = PIXEL_MODELS, "pixel"

    def reset(self, observation: Observation, goal: Goal) -> None:
        super().reset(observation, replace(goal, point_world=np.full(3, np.nan)))

    def way(self) -> NDArray[np.float64]:
        """To where the ray through the goal's pixel is as high as the point."""
        camera, point = self.camera, self.follower.point
        eye = camera.world_T_camera[:3, 3]
        along = camera.to_world(np.linalg.solve(camera.K, np.append(self.goal.pixel, 1.0))) - eye
        flat = abs(along[2]) < 1e-6  # a ray that meets no table
        return np.zeros(3) if flat else eye + (point[2] - eye[2]) / along[2] * along - point

    def imagine(self, observation: Observation) -> CostFunction:
        state = self.observed()
        start = PixelTrack.start(self.distribution(self.designated[-1]), self.distribution(self.designated[0]))
        point, goal = self.pixel(self.follower.point), self.tensor(self.goal.pixel)
        offset = point - start.expected_position()[0]  # of a point that is none of the pixels
        per_metre = float(self.camera.K[0, 0] / self.camera.to_camera(self.follower.point)[2])  # pixels

        @torch.inference_mode()
        def cost(sequences: NDArray) -> NDArray:
            actions = self.tensor(self.aggregated(sequences))  # (N, h, A)
            if self.reach:
                effector = self.pixel(self.effector.path(observation, sequences, self.hold))  # (N, h, 2)
            future, track = state, start
            distances = []
            for step in range(actions.shape[1]):
                last = step + 1 == actions.shape[1]  # nobody looks at its picture
                future, prediction = self.model.step(future, actions[:, step], paint=False, picture=not last)
                track = track.advance(prediction)
                if self.reach:
                    distance = track.expected_distance(goal - offset)
                    place = track.expected_position() + offset
                    distance = distance + self.reach.cost(effector[:, step], place, goal, per_metre)
                else:
                    # The hand goes as far as what the kernels move of its pixels, some of which show the table. (Their
                    # expected distance would be least beside the goal, too: they lie lopsidedly about their mean.)
                    distance = (point + track.shift - goal).norm(dim=1)
                distances.append(distance)
            return discounted_distance(torch.stack(distances, dim=1).cpu().numpy())

        return cost

    def distribution(self, pixels: torch.Tensor) -> torch.Tensor:
        """A uniform distribution (H, W) over pixels (M,)."""
        return uniform_pixels(pixels.to(self.device), self.camera.height, self.camera.width)

    def pixel(self, points: NDArray) -> torch.Tensor:
        """Where points (..., 3) of the world appear in the picture, (..., 2)."""
        return self.tensor(self.camera.project(self.camera.to_camera(points)))
