"""Servo setups: a scene, an arm pose, and a goal that can be reached and seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.tabletop.simulate import rollout_tcp
from planning.controllers.base import Goal, Observation, held_gripper
from planning.controllers.baselines import METRES_PER_ACTION
from planning.costs import env_action

SETUP_ENTROPY = 0x5E7_0_90A1  # sets the seeds of setups apart from every seed that makes training data
SEED_OFFSET = 2**62  # environments of setups are seeded above it, those of training data below

NEAREST, FARTHEST = 0.20, 0.45  # metres from the TCP to the goal
REFERENCE_WIDTH = 64  # of the picture that the numbers of pixels below are meant for
NEAREST_PIXELS = 12.0  # from the TCP to the goal in it
BORDER_PIXELS = 4.0  # from TCP and goal to the edge of the picture, so that the hand is in it
CLEARANCE = 0.02  # metres that the goal stands in front of every surface the camera sees around it
ROOM = 0.04  # metres to every side of the goal into which the hand may stray: a push against furniture traps the arm
STEPS, TRAVEL_STEPS = 60, 45  # of the straight-line motion that proves a goal reachable; the rest it stands
REACHED = 0.005  # metres that may be left while it stands
GOALS_PER_SCENE = 40  # tries before the scene is drawn anew
SCENES = 100


@dataclass(frozen=True, eq=False)
class Setup:
    """Where an episode starts and where it is to go.

    Attributes:
        index: of the setup; with the seed of the evaluation it determines all else.
        env_seed: what the environment is reset with.
        state: simulator state after that reset.
        goal: where the TCP is to go.
        distance: metres from the TCP to the goal at the start.
        pixel_distance: the same in the picture, pixels.
        axis_share: share of the way that lies along the optical axis, in [0, 1].
    """

    index: int
    env_seed: int
    state: NDArray[np.float64]
    goal: Goal
    distance: float
    pixel_distance: float
    axis_share: float

    def start(self, env: gym.Env) -> Observation:
        """Put the environment where the setup begins; returns the first observation."""
        tabletop: Any = env.unwrapped
        env.reset(seed=self.env_seed)
        tabletop.set_state(self.state)
        return tabletop.observation()


def make_setup(env: gym.Env, index: int, seed: int = 0) -> Setup:
    """The setup of that index; the same for every model, every run and every number of setups.

    Args:
        env: a tabletop environment that renders; its state is changed.
        index: which setup.
        seed: of the evaluation.

    Raises:
        RuntimeError: no goal was found, which means that the environment is broken.
    """
    tabletop: Any = env.unwrapped
    rng = np.random.default_rng(np.random.SeedSequence((SETUP_ENTROPY, seed, index)))
    for _ in range(SCENES):
        env_seed = SEED_OFFSET + int(rng.integers(2**32))
        observation, _ = env.reset(seed=env_seed)
        state, tcp = tabletop.get_state(), np.array(tabletop.tcp_position)
        gripper = held_gripper(observation)
        for _ in range(GOALS_PER_SCENE):
            goal = _draw_goal(tabletop, tcp, rng)
            if not _in_sight(tabletop, goal, tcp, observation["depth"]):
                continue
            if _reachable(tabletop, state, gripper, goal, tcp):
                return _measured(tabletop, index, env_seed, state, goal, tcp)
    raise RuntimeError(f"no reachable goal in {SCENES} scenes for setup {index} of seed {seed}")


def _draw_goal(tabletop: Any, tcp: NDArray[np.float64], rng: np.random.Generator) -> Goal:
    """A point of the workspace at a uniform distance and direction from the TCP (rejected outside)."""
    low, high = tabletop.workspace
    while True:
        direction = rng.standard_normal(3)
        point: NDArray[np.float64] = tcp + rng.uniform(NEAREST, FARTHEST) * direction / np.linalg.norm(direction)
        if np.all(point >= low) and np.all(point <= high):
            camera = tabletop.camera
            return Goal(point, camera.project(camera.to_camera(point)))


def _in_sight(tabletop: Any, goal: Goal, tcp: NDArray, depth: NDArray) -> bool:
    """Whether TCP and goal are well inside the picture and apart in it, the goal in front of what stands there."""
    camera = tabletop.camera
    scale = camera.width / REFERENCE_WIDTH
    pixels = np.stack([camera.project(camera.to_camera(tcp)), goal.pixel])
    farthest = np.array([camera.width, camera.height]) - 1 - scale * BORDER_PIXELS
    if np.any(pixels < scale * BORDER_PIXELS) or np.any(pixels > farthest):
        return False
    if np.linalg.norm(pixels[1] - pixels[0]) < scale * NEAREST_PIXELS:
        return False
    u, v = np.rint(goal.pixel).astype(int)
    around = depth[v - 1 : v + 2, u - 1 : u + 2]
    return camera.to_camera(goal.point_world)[2] + CLEARANCE < around.min()


def _reachable(tabletop: Any, state: NDArray, gripper: float, goal: Goal, tcp: NDArray) -> bool:
    """Whether the straight way leads there in copies of the simulator, and there is room: no furniture is met.

    The copies go to the goal, then to the points that lie ROOM from it along each axis (or at the workspace's edge).
    """
    offsets = ROOM * np.concatenate([np.eye(3), -np.eye(3)])
    around = np.clip(goal.point_world + offsets, *tabletop.workspace)
    return all(_arrives(tabletop, state, gripper, tcp, ends) for ends in (goal.point_world[None], around))


def _arrives(tabletop: Any, state: NDArray, gripper: float, tcp: NDArray, ends: NDArray) -> bool:
    """Whether straight motions from the TCP arrive at all the ends (N, 3) and come to rest there."""
    moves = np.zeros((len(ends), STEPS, 3))
    moves[:, :TRAVEL_STEPS] = (ends - tcp)[:, None] / TRAVEL_STEPS / METRES_PER_ACTION
    path = rollout_tcp(tabletop, state, env_action(moves, gripper))
    return bool(np.all(np.linalg.norm(path[:, -5:] - ends[:, None], axis=-1) <= REACHED))


def _measured(tabletop: Any, index: int, env_seed: int, state: NDArray, goal: Goal, tcp: NDArray) -> Setup:
    camera = tabletop.camera
    way = camera.to_camera(goal.point_world) - camera.to_camera(tcp)
    distance = float(np.linalg.norm(way))
    pixels = float(np.linalg.norm(goal.pixel - camera.project(camera.to_camera(tcp))))
    return Setup(index, env_seed, state, goal, distance, pixels, float(abs(way[2]) / distance))
