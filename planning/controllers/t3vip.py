"""Servoing by T3VIP: plan in predicted point clouds."""

from __future__ import annotations

import torch
from numpy.typing import NDArray

from planning.controllers.base import Observation
from planning.controllers.learned import LearnedController
from planning.costs import discounted_distance
from planning.icem import CostFunction
from worldmodel.tracking import HandTrack


class T3VIPController(LearnedController):
    """Brings the TCP to a point by the predicted motion of the hand's pixels in space."""

    name = "t3vip"

    def imagine(self, observation: Observation) -> CostFunction:
        state = self.observed()
        points, tcp = self.seen_points(observation), self.tcp_in_camera(observation)
        goal, intrinsics = self.tensor(self.camera.to_camera(self.goal.point_world)), self.tensor(self.camera.K)

        @torch.inference_mode()
        def cost(sequences: NDArray) -> NDArray:
            actions = self.tensor(self.aggregated(sequences))  # (N, h, A)
            future = state  # one past for all futures: the first step encodes it once
            track = HandTrack.start(points, tcp, intrinsics, len(sequences), self.radius)
            distances = []
            for step in range(actions.shape[1]):
                last = step + 1 == actions.shape[1]  # nobody looks at its picture
                future, prediction = self.model.step(future, actions[:, step], paint=False, picture=not last)
                track = track.advance(prediction.transform, prediction.masks[:, :1])
                distances.append((track.tcp - goal).norm(dim=-1))
            return discounted_distance(torch.stack(distances, dim=1).cpu().numpy())

        return cost
