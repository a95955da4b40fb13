"""Where an episode starts: random blocks and fixtures, and an arm somewhere in the workspace that touches nothing."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs import rotations
from envs.errors import UsageError
from envs.reset_options import option_numbers
from envs.tabletop import table
from envs.tabletop.control import WORKSPACE_HIGH, WORKSPACE_LOW, Pose
from envs.tabletop.kinematics import ArmKinematics
from envs.tabletop.layouts import Layout
from envs.tabletop.robot import REST_ARM

GRIPPER_DOWN = np.array([np.pi, 0.0, np.pi / 2])  # Euler xyz; the fingers open along the table
START_LOW, START_HIGH = np.array([-0.27, -0.36, 0.47]), np.array([0.27, 0.04, 0.72])  # m, random starts of the hand
START_TURN = np.array([0.1, 0.1, 0.4])  # rad, random turns about x, y, z
BLOCK_AREA_LOW, BLOCK_AREA_HIGH = np.array([-0.24, -0.165]), np.array([0.28, -0.025])  # m, on the table
SHELF_SHARE = 0.1  # how often a block lies on the shelf behind the door
ATTEMPTS = 100

Array = NDArray[np.float64]


def place_fixtures(data: mujoco.MjData, layout: Layout, rng: np.random.Generator) -> None:
    """Door anywhere; drawer shut or half open; switch up or down; the button at rest."""
    data.joint("door").qpos = rng.uniform(0, layout.door_travel)
    data.joint("drawer").qpos = rng.uniform(0, table.DRAWER_TRAVEL / 2) * rng.integers(2)
    data.joint("switch").qpos = table.SWITCH_TRAVEL * (rng.uniform(0, 0.1) + 0.9 * rng.integers(2))


def place_blocks(data: mujoco.MjData, layout: Layout, rng: np.random.Generator) -> None:
    """Each block flat at a random place and yaw, none touching another or the button."""
    taken = [(np.array([layout.button_x, -0.12]), 0.05)]
    for name, length in zip(table.BLOCKS, layout.block_lengths, strict=True):
        radius = np.hypot(length, table.BLOCK_SIDE) / 2
        on_shelf = rng.random() < SHELF_SHARE
        for _ in range(ATTEMPTS):
            place, floor = _shelf_place(layout, rng) if on_shelf else _table_place(rng)
            if all(np.linalg.norm(place - other) > radius + room for other, room in taken):
                break
        else:
            raise RuntimeError(f"found no free place for {name}")
        taken.append((place, radius))
        yaw = rng.uniform(-np.pi, np.pi)
        height = floor + table.BLOCK_SIDE / 2
        data.joint(name).qpos = [*place, height, *rotations.from_rotvec(np.array([0, 0, yaw]))]


def place_arm(model: mujoco.MjModel, data: mujoco.MjData, kinematics: ArmKinematics, rng: np.random.Generator) -> None:
    """The hand at a random place over the table, pointing down, touching nothing."""
    for _ in range(ATTEMPTS):
        position = rng.uniform(START_LOW, START_HIGH)
        turn = rotations.from_euler(rng.uniform(-START_TURN, START_TURN))
        pose = Pose(position, rotations.multiply(turn, rotations.from_euler(GRIPPER_DOWN)))
        joints = kinematics.solve(pose)
        if joints is not None and _is_clear(model, data, kinematics, joints):
            return
    raise RuntimeError("found no free pose for the arm")


def place_arm_at(model: mujoco.MjModel, data: mujoco.MjData, kinematics: ArmKinematics, place: ArrayLike) -> None:
    """The hand at a given place (3,) in metres, pointing down.

    Raises:
        UsageError: no such place, or it is out of reach, or something is in the way.
    """
    position = option_numbers("tcp", place, 3)
    if (position < WORKSPACE_LOW).any() or (position > WORKSPACE_HIGH).any():
        low, high = WORKSPACE_LOW.tolist(), WORKSPACE_HIGH.tolist()
        raise UsageError(f"option tcp {position.tolist()} is outside the workspace; stay between {low} and {high}")
    joints = kinematics.solve(Pose(position, rotations.from_euler(GRIPPER_DOWN)))
    if joints is None:
        raise UsageError(f"option tcp {position.tolist()} is out of the arm's reach; choose one nearer to its base")
    if not _is_clear(model, data, kinematics, joints):
        raise UsageError(f"option tcp {position.tolist()} is inside of something; choose one in free space")


def place_arm_at_rest(data: mujoco.MjData, kinematics: ArmKinematics) -> None:
    """CALVIN's rest posture."""
    data.qpos[kinematics.qpos_index] = REST_ARM


def _is_clear(model: mujoco.MjModel, data: mujoco.MjData, kinematics: ArmKinematics, joints: Array) -> bool:
    data.qpos[kinematics.qpos_index] = joints
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    contacts = data.contact.geom[: data.ncon]
    return not (model.geom_contype[contacts] == table.ROBOT).any()


def _table_place(rng: np.random.Generator) -> tuple[Array, float]:
    return rng.uniform(BLOCK_AREA_LOW, BLOCK_AREA_HIGH), table.TOP


def _shelf_place(layout: Layout, rng: np.random.Generator) -> tuple[Array, float]:
    left, right = table.opening(layout)
    return rng.uniform([left + 0.06, 0.115], [right - 0.06, 0.14]), table.TOP + 0.004
