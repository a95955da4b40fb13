"""Servoing by T3VIP: plan in predicted point clouds."""

from __future__ import annotations

from collections.abc import Callable

import torch
from numpy.typing import NDArray
from torch import Tensor

from planning.controllers.base import Observation
from planning.controllers.learned import LearnedController
from planning.costs import discounted_distance
from planning.icem import CostFunction
from worldmodel.tracking import HandTrack


class T3VIPController(LearnedController):
    """Brings the point to its goal by the predicted motion, in space, of the pixels around it."""

    name = "t3vip"

    def imagine(self, observation: Observation) -> CostFunction:
        foresee = self.foresight(observation)
        goal = self.in_camera(self.goal.point_world)

        def cost(sequences: NDArray) -> NDArray:
            points = foresee(sequences)
            distances = (points - goal).norm(dim=-1)
            if self.reach:
                effector = self.in_camera(self.effector.path(observation, sequences, self.hold))  # (N, h, 3)
                distances = distances + self.reach.cost(effector, points, goal)
            return discounted_distance(distances.cpu().numpy())

        return cost

    def foresight(self, observation: Observation) -> Callable[[NDArray], Tensor]:
        """Where the model sees the point go from this observation on, as a function of sequences of moves.

        Returns:
            (N, h, axes) moves, each held for a frame gap -> (N, h, 3) metres, camera frame, after each.
        """
        state = self.observed()
        body = self.seen_points(observation).flatten(1)[:, self.designated[-1].to(self.device)].T  # (M, 3)
        point, intrinsics = self.in_camera(self.follower.point), self.tensor(self.camera.K)

        @torch.inference_mode()
        def foresee(sequences: NDArray) -> Tensor:
            count = len(sequences)
            actions = self.tensor(self.aggregated(sequences))  # (N, h, A)
            future = state  # one past for all futures: the first step encodes it once
            track = HandTrack(
                point.expand(count, 3), body.expand(count, *body.shape), intrinsics, self.follower.least_foreground
            )
            points = []
            for step in range(actions.shape[1]):
                last = step + 1 == actions.shape[1]  # nobody looks at its picture
                future, prediction = self.model.step(future, actions[:, step], paint=False, picture=not last)
                track = track.advance(prediction.transform, prediction.masks[:, :1])
                points.append(track.tcp)
            return torch.stack(points, dim=1)

        return foresee
