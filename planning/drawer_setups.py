"""Setups of the drawer: the hand over the gap behind the handle, a point on the front, how far open it shall be."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.errors import UsageError
from envs.tabletop.table import DRAWER_TRAVEL
from planning.costs import env_action
from planning.point_setups import PointSetup, point_setup, seen_on
from planning.setups import SEED_OFFSET

DRAWER_ENTROPY = 0xD2A_3E2  # sets the seeds of these setups apart from all others
NEAREST, FARTHEST = 0.06, 0.15  # metres that the drawer is to slide
ENDS = (0.005, DRAWER_TRAVEL - 0.02)  # metres open: where the goal may be
BEHIND = np.array([0.0, 0.034, 0.0])  # metres from the handle to the middle of the gap between its bar and the drawer
ABOVE, SIDEWAYS = (0.05, 0.09), 0.02  # metres: the hand's start over that place, and beside it at the most
FRONT_LOW, FRONT_HIGH = np.array([0.05, -0.02, -0.05]), np.array([0.135, -0.005, 0.07])
"""Metres, in the frame of the drawer: its front beside the handle, where the hand does not hide it from the camera."""
CLOSED, CLOSING_STEPS = -1.0, 12  # gripper command; control steps until the fingers have closed
SCENES = 100


def make_drawer_setup(env: gym.Env, index: int, seed: int = 0) -> PointSetup:
    """The setup of that index; the same for every model, every run and every number of setups.

    The table is that of a random episode. The hand is over the gap between the bar of the handle and the drawer's
    front, fingers closed and pointing down: lowered into the gap it can pull the drawer and push it. The point is on
    the front beside the handle; the handle itself is hidden once the hand is lowered.

    Args:
        env: a tabletop environment that renders; its state is changed.
        index: which setup.
        seed: of the evaluation.

    Raises:
        RuntimeError: none was found, which means that the environment is broken.
    """
    tabletop: Any = env.unwrapped
    rng = np.random.default_rng(np.random.SeedSequence((DRAWER_ENTROPY, seed, index)))
    opens = index % 2 == 0  # every other one is to be shut
    for _ in range(SCENES):
        env_seed = SEED_OFFSET + int(rng.integers(2**32))
        offset = np.array([rng.uniform(-SIDEWAYS, SIDEWAYS), 0.0, rng.uniform(*ABOVE)])
        share = rng.random()
        env.reset(seed=env_seed)
        slid = float(tabletop.mj_data.joint("drawer").qpos[0])
        room = ENDS[1] - slid if opens else slid - ENDS[0]
        if room < NEAREST or not _place_hand(env, env_seed, offset):
            continue
        distance = NEAREST + share * (min(FARTHEST, room) - NEAREST)
        near = partial(_on_front, tabletop.mj_data.body("drawer").xpos)
        point = seen_on(env, "drawer", tabletop.observation()["depth"], rng, near)
        if point is None:
            continue
        way = (distance if opens else -distance) * np.array(tabletop.mj_data.joint("drawer").xaxis)
        return point_setup(
            env, index, env_seed, tabletop.get_state(), "drawer", point, way, "open" if opens else "shut"
        )
    raise RuntimeError(f"no drawer to be moved in {SCENES} scenes for setup {index} of seed {seed}")


def _place_hand(env: gym.Env, env_seed: int, offset: NDArray) -> bool:
    """Begin the episode anew, the hand at an offset (3,) from the gap, and close its fingers; False if it cannot be."""
    tabletop: Any = env.unwrapped
    place = gap(tabletop) + offset
    try:
        env.reset(seed=env_seed, options={"tcp": place})  # the same table
    except UsageError:  # out of reach, or in something
        return False
    for _ in range(CLOSING_STEPS):
        env.step(env_action(np.zeros(3), CLOSED))
    return bool(np.linalg.norm(tabletop.tcp_position - place) < 0.005)


def _on_front(drawer: NDArray, points: NDArray) -> NDArray[np.bool_]:
    """Which of points (H, W, 3) are on the front beside the handle of a drawer at a place (3,)."""
    return np.all((points - drawer >= FRONT_LOW) & (points - drawer <= FRONT_HIGH), axis=-1)


def gap(tabletop: Any) -> NDArray[np.float64]:
    """The middle of the gap behind the handle's bar (3,), metres, world frame."""
    return tabletop.mj_data.site("drawer_handle").xpos + BEHIND
