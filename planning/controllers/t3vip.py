"""Servoing by T3VIP: plan in predicted point clouds."""

from __future__ import annotations

from collections.abc import Callable

import torch
from numpy.typing import NDArray

from planning.controllers.base import Observation
from planning.controllers.learned import LearnedController
from planning.costs import discounted_distance
from planning.icem import CostFunction
from worldmodel.tracking import Track


class T3VIPController(LearnedController):
    """Brings the point to its goal by the predicted motion, in space, of the pixels around it."""

    kinds = ("t3vip",)

    def imagine(self, observation: Observation) -> CostFunction:
        foresee = self.foresight(observation)
        goal = self.in_camera(self.goal.point_world)

        def cost(sequences: NDArray) -> NDArray:
            tracks = foresee(sequences)
            distances = torch.stack([track.expected_distance(goal) for track in tracks], dim=1)  # (N, h)
            if self.reach:
                effector = self.in_camera(self.effector.path(observation, sequences, self.hold))  # (N, h, 3)
                places = torch.stack([track.expected_position() for track in tracks], dim=1)
                distances = distances + self.reach.cost(effector, places, goal)
            return discounted_distance(distances.cpu().numpy())

        return cost

    def foresight(self, observation: Observation) -> Callable[[NDArray], list[Track]]:
        """Where the model sees the point go from this observation on, as a function of sequences of moves.

        Returns:
            (N, h, axes) moves, each held for a frame gap -> the point in N futures after each of h moves.
        """
        state = self.observed()
        body = self.seen_points(observation).flatten(1)[:, self.designated[-1].to(self.device)].T  # (M, 3)
        point, intrinsics = self.in_camera(self.follower.point), self.tensor(self.camera.K)

        @torch.inference_mode()
        def foresee(sequences: NDArray) -> list[Track]:
            actions = self.tensor(self.aggregated(sequences))  # (N, h, A)
            future = state  # one past for all futures: the first step encodes it once
            track = self.follower.track(body, point, intrinsics, len(sequences))
            tracks = []
            for step in range(actions.shape[1]):
                last = step + 1 == actions.shape[1]  # nobody looks at its picture
                future, prediction = self.model.step(future, actions[:, step], paint=False, picture=not last)
                track = track.advance(prediction.transform, prediction.masks[:, :1])
                tracks.append(track)
            return tracks

        return foresee
