"""What a controller knows of the body that it moves: where proprioception says it is, and how it is told to move."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from envs.errors import UsageError
from envs.planar_push import control as push_control
from envs.planar_push.scene import TIP_HEIGHT
from envs.tabletop import control as arm_control
from planning.costs import env_action
from planning.observations import Observation

Array = NDArray[np.float64]

TCP = slice(0, 3)  # position of the end-effector in `proprio` of the tabletop, metres, world
GRIPPER = 14  # last gripper command in it
PROPRIO = 15


class Effector(ABC):
    """An end-effector, and what a controller may tell it.

    A move is what is planned: how far to go along the world's x and y, or x, y and z. Controllers with a world model
    also plan moves of any other kind, of joints for example, where no `Reach` draws the end-effector to a thing: the
    model knows where those lead.

    Attributes:
        axes: numbers in a move.
        action_dim: numbers in an action of the environment.
        limit: the largest number in a planned move.
        metres: that a move of 1 goes in one control step; where moves are along the world's axes.
        low, high: corners (3,) of the box that it stays in, metres; where moves are along the world's axes.
        aggregation, scale: how each number of an action adds up, and what 1 stands for in it, as in datasets; a model
            that learned from other actions is refused. None: not compared.
    """

    axes: int
    action_dim: int
    limit: float
    metres: float
    low: Array
    high: Array
    aggregation: tuple[str, ...] | None = None
    scale: tuple[float, ...] | None = None

    def reset(self, observation: Observation) -> None:  # noqa: B027  # most bodies remember nothing
        """Start an episode with its first observation."""

    def aim(self, way: Array) -> None:  # noqa: B027  # ... and need no heading
        """Be told, before every decision, which way (3,) the designated point has to go, metres, world frame."""

    @abstractmethod
    def position(self, observation: Observation) -> Array:
        """Measured position (3,) in the world, metres."""

    @abstractmethod
    def action(self, move: NDArray) -> NDArray[np.float32]:
        """Moves (..., axes), any number of them at once, as actions (..., action_dim) of the environment."""

    def check(self, observation: Observation) -> None:
        """Check that it reads this observation, and makes actions of moves, as a controller expects; after `reset`.

        Raises:
            UsageError: it does not.
        """
        name = type(self).__name__
        place = np.asarray(self.position(observation), np.float64)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise UsageError(
                f"{name}.position gives {place.tolist()}; make it three finite numbers, metres, world frame"
            )
        made, wanted = np.shape(self.action(np.zeros((2, 4, self.axes)))), (2, 4, self.action_dim)
        if made != wanted:
            raise UsageError(
                f"{name}.action makes actions {made} of moves {(2, 4, self.axes)}; make it {wanted}, one for each move"
            )

    def check_follows_axes(self) -> None:
        """Refuse moves that are not along the world's axes.

        Raises:
            UsageError: they are others.
        """
        if self.axes > 3:
            raise UsageError(
                f"a move of the {type(self).__name__} is {self.axes} numbers, not along x and y, or x, y and z; only"
                " controllers with a world model plan such moves"
            )

    def path(self, observation: Observation, moves: NDArray, hold: int) -> Array:
        """Where moves (N, h, axes), each held for `hold` control steps, take it if nothing is in the way: (N, h, 3)."""
        ways = np.zeros((*moves.shape[:2], 3))
        ways[..., : self.axes] = hold * self.metres * np.cumsum(moves, axis=1)
        return np.clip(self.position(observation) + ways, self.low, self.high)


class Arm(Effector):
    """The arm of the tabletop: it is translated, never turned, and the gripper keeps its command of the start."""

    axes, action_dim, limit, metres = 3, 7, 1.0, arm_control.ACTION_SCALE[0]
    aggregation, scale = arm_control.ACTION_AGGREGATION, arm_control.ACTION_SCALE
    low, high = arm_control.WORKSPACE_LOW, arm_control.WORKSPACE_HIGH

    def reset(self, observation: Observation) -> None:
        if np.shape(observation["proprio"]) != (PROPRIO,):
            raise UsageError(
                f"proprio has shape {np.shape(observation['proprio'])}, that of the tabletop's Arm {(PROPRIO,)}; give"
                " the effector of your robot, a planning.effectors.Effector: effector=..."
            )
        self.gripper = held_gripper(observation)

    def position(self, observation: Observation) -> Array:
        return np.asarray(observation["proprio"][TCP], np.float64)

    def action(self, move: NDArray) -> NDArray[np.float32]:
        return env_action(move, self.gripper)


class Tip(Effector):
    """The tip of the planar pusher; the heading is the direction in which the object shall go.

    In the data it is the direction of the coming push, all the way round the object too. Models take a tip that moves
    along the heading for one that pushes, also where nothing is in its way: with each move's own direction as heading
    they foresee pushes everywhere.

    Its limit is half of what the environment allows. Pushes in the data are slower still, and the kernels of the
    models of pictures reach about as far as the tip then goes in a frame gap of 3.
    """

    axes, action_dim, limit, metres = 2, 3, 0.5, push_control.ACTION_SCALE[0]
    aggregation, scale = push_control.ACTION_AGGREGATION, push_control.ACTION_SCALE
    low = np.append(push_control.WORKSPACE_LOW, TIP_HEIGHT)
    high = np.append(push_control.WORKSPACE_HIGH, TIP_HEIGHT)

    heading = 0.0  # rad

    def aim(self, way: Array) -> None:
        self.heading = float(np.arctan2(way[1], way[0]))

    def position(self, observation: Observation) -> Array:
        return np.append(np.asarray(observation["proprio"][:2], np.float64), TIP_HEIGHT)

    def action(self, move: NDArray) -> NDArray[np.float32]:
        move = np.asarray(move, np.float32)
        heading = np.full((*move.shape[:-1], 1), self.heading / push_control.ACTION_SCALE[2], np.float32)
        return np.concatenate([move, heading], axis=-1)


def held_gripper(observation: Observation) -> float:
    """The command, -1 or 1, that keeps the gripper as it is."""
    return 1.0 if observation["proprio"][GRIPPER] >= 0 else -1.0
