"""Pushes as in Omnipush: straight, 12 frames long, of random directions, through a point near the object's middle.

After a push the tip backs off, goes round the object beside it on the table, and pushes again. The policy looks into
the simulator to know where the object is; the data that it makes does not.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from data_collection.policies.push_plan import Array, choose_push, way_round
from envs.errors import UsageError
from envs.planar_push import PlanarPushEnv

PUSH_STEPS = 12  # control steps; frames of a push of Omnipush
STRIDE = 0.0125  # m a control step on the way round: no faster than pushes of 0.4 s, so a gap of 3 stays within 4 px


class PushPolicy:
    """Pushes the object of a planar pushing environment about; privileged."""

    NAME = "push"

    def reset(self, env: gymnasium.Env, rng: np.random.Generator) -> None:
        """Start an episode.

        Raises:
            UsageError: not a planar pushing environment.
        """
        if not isinstance(env.unwrapped, PlanarPushEnv):
            stranger = type(env.unwrapped).__name__
            raise UsageError(f"policy '{self.NAME}' cannot act in {stranger}; use --env planar-push")
        self._env, self._rng = env.unwrapped, rng
        self._last_direction: Array | None = None
        self._plan: Iterator[NDArray[np.float32]] = iter(())

    def act(self, obs: dict[str, Any]) -> NDArray[Any]:
        """The next action (3,) in [-1, 1]; `obs` is not looked at."""
        action = next(self._plan, None)
        while action is None:
            self._plan = self._next_push()
            action = next(self._plan, None)
        return action

    def _next_push(self) -> Iterator[NDArray[np.float32]]:
        push = choose_push(self._env, self._rng)
        heading = float(np.arctan2(push.direction[1], push.direction[0]))
        for waypoint in way_round(self._env, push, self._last_direction, STRIDE):
            yield self._move(waypoint, heading)
        self._last_direction = push.direction
        for share in np.arange(1, PUSH_STEPS + 1) / PUSH_STEPS:
            yield self._move(push.start + share * (push.end - push.start), heading)

    def _move(self, place: Array, heading: float) -> NDArray[np.float32]:
        action = np.append(place - self._env.tip_target, heading) / self._env.ACTION_SCALE
        return np.clip(action, -1, 1).astype(np.float32)
