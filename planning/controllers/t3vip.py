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
    """Brings the point to its goal by the predicted motion, in space, of the pixels around it."""

    name = "t3vip"

    def imagine(self, observation: Observation) -> CostFunction:
        state = self.observed()
        body = self.seen_points(observation).flatten(1)[:, self.designated[-1].to(self.device)].T  # (M, 3)
        point, goal = self.in_camera(self.follower.point), self.in_camera(self.goal.point_world)
        intrinsics = self.tensor(self.camera.K)

        @torch.inference_mode()
        def cost(sequences: NDArray) -> NDArray:
            count = len(sequences)
            actions = self.tensor(self.aggregated(sequences))  # (N, h, A)
            effector = self.in_camera(self.effector.path(observation, sequences, self.hold))  # (N, h, 3)
            future = state  # one past for all futures: the first step encodes it once
            track = HandTrack(
                point.expand(count, 3), body.expand(count, *body.shape), intrinsics, self.follower.least_foreground
            )
            distances = []
            for step in range(actions.shape[1]):
                last = step + 1 == actions.shape[1]  # nobody looks at its picture
                future, prediction = self.model.step(future, actions[:, step], paint=False, picture=not last)
                track = track.advance(prediction.transform, prediction.masks[:, :1])
                distance = (track.tcp - goal).norm(dim=-1)
                if self.reach:
                    distance = distance + self.reach.cost(effector[:, step], track.tcp, goal)
                distances.append(distance)
            return discounted_distance(torch.stack(distances, dim=1).cpu().numpy())

        return cost
