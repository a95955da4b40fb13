"""Scripted play: reaches, pushes, grasps and fixtures strung together as a curious person at the controls would.

Every second skill is free reaching, so that positions and velocities cover the whole workspace; between them the policy
manipulates the fixtures and blocks in a random order, one after the other, without repeating itself before all have had
their turn. It looks into the simulator; the data that it makes does not.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from data_collection.policies import play_skills as skills
from data_collection.policies.play_motion import (
    Array,
    Follower,
    expected_steps,
    hand_orientation,
    rotation_between,
)
from data_collection.policies.play_scene import Scene
from envs.errors import UsageError
from envs.tabletop import TabletopEnv
from envs.tabletop.table import BLOCKS

WEIGHTS = {"drawer": 1.3, "door": 1.4, "switch": 1.2, "button": 0.9} | dict.fromkeys(BLOCKS, 1.2)  # sooner or later
REACHES = (0.1, 0.55, 0.35)  # probability of 0, 1 and 2 reaches after a manipulation
STALLED, STALLED_STEPS = 0.001, 10  # m a step, steps: a hand that does not get on any more


class PlayPolicy:
    """Plays with a tabletop environment; privileged. Skills that fail are abandoned after a while."""

    def reset(self, env: gymnasium.Env, rng: np.random.Generator) -> None:
        """Start an episode.

        Raises:
            UsageError: not a tabletop.
        """
        if not isinstance(env.unwrapped, TabletopEnv):
            raise UsageError(f"policy 'play' cannot act in {type(env.unwrapped).__name__}; use --env tabletop")
        self._rng = rng
        self._scene = Scene(env)
        self._scale = np.asarray(self._scene.env.ACTION_SCALE[:6], dtype=np.float64)
        self._follower = Follower(self._scale, rng)
        self._things: list[str] = []
        self._reaches = int(rng.integers(0, 3))
        self._skill: skills.Skill = iter(())
        self._steps = self._stalled = self._patience = 0
        self._reached_at: int | None = None
        self._last_tcp = self._scene.tcp
        self._next_waypoint()

    def act(self, obs: dict[str, Any]) -> NDArray[Any]:
        """The next action (7,) in [-1, 1]; `obs` is not looked at."""
        if self._arrived():
            self._next_waypoint()
        self._steps += 1
        motion = self._follower.act(self._error(), self._waypoint.speed, self._waypoint.noise)
        return np.append(motion, self._waypoint.gripper).astype(np.float32)

    def _error(self) -> Array:
        """From the target pose to the waypoint: (6,) metres, then rotation vector in the world, radians."""
        target = self._scene.env.target_pose
        turn = rotation_between(target.quaternion, self._orientation)
        return np.concatenate([self._waypoint.position - target.position, turn])

    def _arrived(self) -> bool:
        """Whether to go on: reached and dwelt there, or missed; a missed waypoint may end the skill."""
        waypoint, tcp = self._waypoint, self._scene.tcp
        offset, moved = waypoint.position - tcp, tcp - self._last_tcp
        self._last_tcp = tcp
        near = offset @ offset < waypoint.tolerance**2
        if self._reached_at is None and near and np.linalg.norm(self._error()[3:]) < waypoint.turn_tolerance:
            self._reached_at = self._steps
        if self._reached_at is not None:
            return self._steps - self._reached_at >= waypoint.dwell
        self._stalled = self._stalled + 1 if moved @ moved < STALLED**2 and not near else 0
        if self._steps < self._patience and self._stalled < STALLED_STEPS:
            return False
        if waypoint.required:
            self._skill = iter(())
        return True

    def _next_waypoint(self) -> None:
        waypoint = next(self._skill, None)
        while waypoint is None:
            self._skill = self._next_skill()
            waypoint = next(self._skill, None)
        waypoint.position = np.clip(waypoint.position, self._scene.low, self._scene.high)
        self._waypoint = waypoint
        if waypoint.yaw is None:
            self._orientation = self._scene.env.target_pose.quaternion
        else:
            self._orientation = hand_orientation(waypoint.yaw, waypoint.tilt)
        error = self._error()
        if np.isinf(waypoint.turn_tolerance):
            error[3:] = 0.0  # nobody waits for the turn
        self._patience = expected_steps(error, self._scale, waypoint.speed) + waypoint.patience
        self._steps, self._stalled, self._reached_at = 0, 0, None

    def _next_skill(self) -> skills.Skill:
        if self._reaches > 0:
            self._reaches -= 1
            skill = skills.reach(self._scene, self._rng)
        else:
            if not self._things:
                shares = np.array(list(WEIGHTS.values())) / sum(WEIGHTS.values())
                self._things = list(self._rng.choice(list(WEIGHTS), len(WEIGHTS), replace=False, p=shares))
            self._reaches = int(self._rng.choice(3, p=REACHES))
            skill = skills.manipulation(self._scene, self._rng, self._things.pop(0))
        return skills.around_the_edge(self._scene, skill)
